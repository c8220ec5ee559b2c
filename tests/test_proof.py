"""The proof that an engine simulates as MuJoCo C: it holds where they agree, and names what is at fault elsewhere."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from frictionzoo.bench import Bench
from frictionzoo.core.errors import BenchError
from frictionzoo.core.state import Signals
from frictionzoo.models import FrictionModel
from frictionzoo.simulate import mjx, specialised
from frictionzoo.simulate.proof import TOLERANCE, Proof, Recorded, initial_values, prove

LINK = """<mujoco><compiler angle="radian"/><option timestep="0.002" {option}>{flag}</option>{more}<worldbody>
  <body name="arm"><joint name="j" axis="0 1 0" {joint}/><geom type="capsule" size=".02" fromto="0 0 0 0 0 -.2"/></body>
  {world}</worldbody></mujoco>"""
SPRING = 'stiffness="3" damping="0.2"'
TIME = np.linspace(0, 8, 400)[:, None]
RECORDED = Recorded(0.6 * np.sin(TIME), 0.6 * np.cos(TIME), Signals(0.6 * np.sin(TIME + 0.1)), np.zeros((400, 0)))


@pytest.fixture
def prove_on(tmp_path: Path, make: Callable, in_haste: None) -> Callable[..., Proof]:
    """The proof of a law on a link, with parts of its MJCF as given."""

    def run(law: str = "coulomb_smooth", engine: str = "mjx", **parts: str) -> Proof:
        path = tmp_path / "bench.xml"
        path.write_text(LINK.format(**dict.fromkeys(("option", "flag", "more", "joint", "world"), "") | parts))
        bench: Bench = make("bench", f"bench.mjcf={path}", "bench.joint=j")
        model: FrictionModel = make("model", f"model={law}", nv=1)
        return prove(bench, model, engine, initial_values(bench, model), RECORDED)

    return run


@pytest.mark.parametrize(
    ("law", "engine", "parts"),
    [
        ("mujoco_default", "specialised", {"joint": SPRING}),
        ("dahl", "specialised", {}),
        pytest.param("torque_proportional", "mjx", {}, marks=pytest.mark.slow),
        ("neural_friction", "specialised", {"option": 'integrator="implicitfast"'}),
        # The softness of contacts goes with the identified armature, through the body's inverse inertia.
        ("mujoco_default", "mjx", {"world": '<geom type="plane" size="1 1 .1" pos="0 0 -.2"/>'}),
    ],
)
def test_what_is_simulated_as_mujoco_does_is_proven(
    prove_on: Callable[..., Proof], law: str, engine: str, parts: dict[str, str]
) -> None:
    proof = prove_on(law, engine, **parts)
    assert 0 < proof.step <= proof.rollout < 1e-3 * TOLERANCE


@pytest.mark.parametrize(
    ("parts", "fault"),
    [
        ({"flag": '<flag damper="disable"/>', "joint": SPRING}, 'damper="disable" of <flag>'),
        ({"joint": 'stiffness="3 2 1"'}, 'stiffness="3 2 1" of <joint j>'),
        # It goes with the armature: with the initial one, all agrees.
        ({"joint": 'group="2" springdamper="0.2 1"'}, 'springdamper="0.2 1" of <joint j>'),
        ({"more": '<default><joint stiffness="3 2 1"/></default>'}, 'stiffness="3 2 1" of <joint>'),
    ],
)
def test_what_is_not_is_refused_by_name(prove_on: Callable[..., Proof], parts: dict[str, str], fault: str) -> None:
    with pytest.raises(BenchError) as refused:
        prove_on(engine="specialised", **parts)
    line = str(refused.value)
    assert f"does not simulate {fault} as MuJoCo C does" in line and "\n" not in line


def test_what_mjx_lacks_is_one_line(prove_on: Callable[..., Proof]) -> None:
    with pytest.raises(BenchError, match=r"bench\.xml: MJX, in which it is simulated, does not take it \(.+\); leave"):
        prove_on(option='solver="PGS"')


@pytest.mark.parametrize(
    ("engine", "place", "fault"),
    [
        ("specialised", "dry_friction", lambda inertia, force, softness, reference, limit: -0.999 * limit),
        ("mjx", "_drive_state", None),
    ],
)
def test_a_fault_in_an_engine_is_caught(
    prove_on: Callable[..., Proof], monkeypatch: pytest.MonkeyPatch, engine: str, place: str, fault: Any
) -> None:
    right = mjx._drive_state
    module = specialised if engine == "specialised" else mjx
    # Of MJX: the law sees a motor torque that is a millionth too large.
    wrong = fault or (
        lambda data, signals: (state := right(data, signals))._replace(motor_torque=(1 + 1e-6) * state.motor_torque)
    )
    monkeypatch.setattr(module, place, wrong)
    monkeypatch.setattr("frictionzoo.simulate.proof._find_fault", lambda *_: None)
    with pytest.raises(BenchError, match=r"does not simulate something in the MJCF as MuJoCo C does \(position or"):
        prove_on("mujoco_default" if engine == "specialised" else "load_dependent", engine)
