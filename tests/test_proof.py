"""The proof that an engine simulates as MuJoCo C: it holds where they agree, and names what is at fault elsewhere."""

from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from frictionzoo.bench import Bench
from frictionzoo.bench.actuators.position_pd import PositionPD
from frictionzoo.core.errors import BenchError
from frictionzoo.core.state import FrictionTerms, Signals
from frictionzoo.models import FrictionModel
from frictionzoo.simulation import mjx, specialised
from frictionzoo.simulation.base import without_memory
from frictionzoo.simulation.proof import TOLERANCE, Proof, Recorded, initial_values, prove

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
def test_what_is_simulated_as_mujoco_does_is_proven(prove_on, law, engine, parts):
    proof = prove_on(law, engine, **parts)
    assert 0 < proof.step <= proof.rollout < 1e-3 * TOLERANCE


@pytest.mark.parametrize(
    ("parts", "fault"),
    [
        ({"flag": '<flag damper="disable"/>', "joint": SPRING}, 'damper="disable" of <flag>'),
        pytest.param({"joint": 'stiffness="3 2 1"'}, 'stiffness="3 2 1" of <joint j>', marks=pytest.mark.slow),
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


@pytest.mark.parametrize("engine", ["specialised", pytest.param("mjx", marks=pytest.mark.slow)])
def test_a_balanced_rotor_is_simulated_as_mujoco_does(tmp_path, make, in_haste, engine):
    """Its centre of mass lies on its axis: MuJoCo takes shortcuts with such a body."""
    (tmp_path / "rotor.xml").write_text(
        '<mujoco><option timestep="0.001"/><worldbody><body><joint name="axis" axis="0 0 1"/>'
        '<inertial pos="0 0 0" mass="0.2" diaginertia="2e-4 2e-4 2e-4"/></body></worldbody></mujoco>'
    )
    bench: Bench = make("bench", f"bench.mjcf={tmp_path / 'rotor.xml'}", "bench.joint=axis")
    model: FrictionModel = make("model", "model=mujoco_default", nv=1)
    proof = prove(bench, model, engine, initial_values(bench, model), RECORDED)
    assert proof.rollout < 1e-3 * TOLERANCE


@pytest.mark.parametrize("seed", range(8))
def test_the_softness_of_dry_friction_goes_with_the_armature_as_in_mujoco_c(tmp_path: Path, seed: int) -> None:
    """Of random trees, among them bodies that turn about their centre of mass or only slide."""
    rng = np.random.default_rng(seed)
    kind, bodies, ends = rng.choice(["hinge", "slide"]), "", ""
    for index in range(3):
        bodies, ends = (bodies + ends, "") if rng.random() < 0.5 else (bodies, ends)
        axis, centre = np.eye(3)[rng.integers(3)], rng.choice([0.0, 0.1], 3, p=[0.8, 0.2])
        bodies += (
            f'<body pos="0 0 {0.2 * index}"><joint name="j{index}" type="{kind}" axis="{" ".join(map(str, axis))}"/>'
            f'<inertial pos="{" ".join(map(str, centre))}" mass="0.7" diaginertia="0.02 0.03 0.04"/>'
        )
        ends += "</body>"
    (tmp_path / "tree.xml").write_text(f"<mujoco><worldbody>{bodies}{ends}</worldbody></mujoco>")
    joints = ["j0", "j1", "j2"]
    bench = Bench(str(tmp_path / "tree.xml"), joints, actuator=PositionPD(kp=1, kd=1), params={"armature": 0.3})
    values = {"bench": bench.initial_values() | {"armature": rng.uniform(0.01, 1, 3)}}
    with jax.enable_x64(True):
        engine = mjx.MjxEngine(bench, without_memory(lambda *_: FrictionTerms()), True)
        inputs = engine.model_inputs(values, jnp.zeros(0))
    compiled = mujoco.MjModel.from_xml_string(bench.mjcf(values["bench"], np.ones(3)))
    np.testing.assert_allclose(inputs.invweight0, compiled.dof_invweight0, rtol=1e-9)


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
def test_a_fault_in_an_engine_is_caught(prove_on, monkeypatch, engine, place, fault):
    right = mjx._drive_state
    module = specialised if engine == "specialised" else mjx
    # Of MJX: the law sees a motor torque that is a millionth too large.
    wrong = fault or (
        lambda data, signals: (state := right(data, signals))._replace(motor_torque=(1 + 1e-6) * state.motor_torque)
    )
    monkeypatch.setattr(module, place, wrong)
    monkeypatch.setattr("frictionzoo.simulation.proof._find_fault", lambda *_: None)
    with pytest.raises(BenchError, match=r"does not simulate something in the MJCF as MuJoCo C does \(position or"):
        prove_on("mujoco_default" if engine == "specialised" else "load_dependent", engine)
