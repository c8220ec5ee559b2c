"""Laws that look at a recorded temperature: how it reaches them, and what is hidden in recordings is found again."""

import json
import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
import pytest
import torch
from conftest import Finished, slow_but

from frictionzoo.api.identified import Identified
from frictionzoo.bench import Bench
from frictionzoo.cli.finished import distill
from frictionzoo.core.errors import BenchError, ConfigError
from frictionzoo.core.log import Dataset, Log
from frictionzoo.core.segments import cut_segments
from frictionzoo.core.state import DriveState, Signals
from frictionzoo.export.module import load_module
from frictionzoo.export.write import write_exports
from frictionzoo.fit import LevenbergMarquardt, Objective, Space, estimate_uncertainty
from frictionzoo.fit.chunk import search
from frictionzoo.fit.uncertainty import Uncertainty
from frictionzoo.models.temperature import ABSOLUTE_ZERO
from frictionzoo.result.comparison.runs import read_runs
from frictionzoo.simulation import Values, friction_of, make_engine
from frictionzoo.simulation.rollout import make_rollout

pytestmark = pytest.mark.usefixtures("in_haste", "unrendered")

LAWS = ("temperature_linear", "temperature_arrhenius")
REFERENCE = 25.0  # degC, by default
TRUTH = {
    "temperature_linear": {"frictionloss_slope": -0.008, "damping_slope": -0.012},
    "temperature_arrhenius": {"frictionloss_activation": 800.0, "damping_activation": 2500.0},
}
ARMATURE, FRICTIONLOSS, DAMPING = 0.03, 0.3, 0.3
SAMPLES = 3000
TWO_JOINTS = """<mujoco><option timestep="0.001"/><worldbody>
  <body><geom size="0.1" mass="1" contype="0"/><joint name="a" axis="0 1 0"/>
    <body pos="0 0 -0.3"><geom size="0.1" mass="1" contype="0"/><joint name="b" axis="0 1 0"/></body></body>
</worldbody></mujoco>"""


def coefficients(name: str, temperature: float) -> tuple[float, float]:
    """frictionloss and damping of the true drive, by hand."""
    truth = TRUTH[name]
    if name == "temperature_linear":
        warmer = temperature - REFERENCE
        shares = 1 + truth["frictionloss_slope"] * warmer, 1 + truth["damping_slope"] * warmer
    else:
        colder = 1 / (temperature + 273.15) - 1 / (REFERENCE + 273.15)
        shares = np.exp(truth["frictionloss_activation"] * colder), np.exp(truth["damping_activation"] * colder)
    return FRICTIONLOSS * float(shares[0]), DAMPING * float(shares[1])


def known(name: str) -> dict[str, float]:
    return {"frictionloss": FRICTIONLOSS, "damping": DAMPING, **TRUTH[name]}


def at(temperature: Any, qvel: Any = 0.5) -> DriveState:
    """A joint at these temperatures."""
    qvel = np.full(np.shape(temperature), qvel)
    return DriveState(qvel, qvel, qvel, qvel, qvel, np.asarray(temperature, float))


@pytest.mark.parametrize("name", LAWS)
def test_known_values(make: Callable[..., Any], name: str) -> None:
    law, temperatures = make("model", f"model={name}", nv=1), [-10.0, REFERENCE, 70.0]
    terms = law.terms(np, known(name), at(temperatures))
    expected = np.array([coefficients(name, temperature) for temperature in temperatures])
    np.testing.assert_allclose(np.stack([terms.frictionloss, terms.damping], axis=1), expected, rtol=1e-12)
    assert terms.torque is None
    # The true drive rubs less when it is warm, and the reference is where the coefficients hold.
    assert (np.diff(expected, axis=0) < 0).all() and expected[1].tolist() == [FRICTIONLOSS, DAMPING]


@pytest.mark.parametrize("name", LAWS)
def test_no_temperature_makes_friction_vanish(make: Callable[..., Any], name: str) -> None:
    """At the largest coefficients by default and far from any laboratory; at 0 MuJoCo locks the joint."""
    law = make("model", f"model={name}", nv=1).float()
    state = at(np.linspace(-60, 200, 53)[:, None]).map(lambda signal: torch.tensor(signal, dtype=torch.float32))
    with torch.no_grad():
        for side in ("low", "high"):
            for key in TRUTH[name]:
                law.get_parameter(key).fill_(getattr(law.params[key], side))
            terms = law(state)
            for term, size in ((terms.frictionloss, law.frictionloss), (terms.damping, law.damping)):
                assert torch.isfinite(term).all() and (term > 1e-6 * size).all()


def test_a_reference_is_above_absolute_zero(make: Callable[..., Any]) -> None:
    with pytest.raises(ConfigError, match=r"model\.reference=-300\.0; expected a temperature above -273\.15 degC"):
        make("model", "model=temperature_linear", "model.reference=-300.0", nv=1)
    assert ABSOLUTE_ZERO == -273.15


def make_log(bench: Bench, temperature: np.ndarray | None, name: str = "a.csv", samples: int = 40) -> Log:
    zero = np.zeros((samples, bench.nv))
    extras = {} if temperature is None else {"temperature": temperature}
    return Log(name, bench.timestep * np.arange(samples), zero, zero, zero, "", True, extras=extras)


@pytest.fixture
def arm(make: Callable[..., Any], tmp_path: Path) -> Bench:
    (tmp_path / "arm.xml").write_text(TWO_JOINTS)
    return make("bench", f"bench.mjcf={tmp_path / 'arm.xml'}", "bench.joint=[a,b]").observing({"temperature": 25.0})


def test_one_column_serves_all_joints_or_there_is_one_a_joint(arm: Bench) -> None:
    time = np.arange(40.0)[:, None]
    for columns in (time, np.concatenate([time, 2 * time], axis=1)):
        log = arm.accept(make_log(arm, columns))
        seen = log.signals.observed["temperature"]
        np.testing.assert_array_equal(seen, np.broadcast_to(columns, (40, 2)))
        cut = cut_segments([log], None, 10).signals
        assert cut.ctrl.shape == (3, 10, 2)
        assert cut.observed["temperature"].tolist() == seen[:30].reshape(3, 10, 2).tolist()
        assert log.between(10, 20, "part").observed["temperature"].tolist() == seen[10:20].tolist()
    assert arm.accept(make_log(arm, None)).observed["temperature"].tolist() == 40 * [[25.0, 25.0]]
    with pytest.raises(BenchError, match=r"a\.csv: temperature has 3 columns, expected 1 for all joints or 2, one a"):
        arm.accept(make_log(arm, np.zeros((40, 3))))
    with pytest.raises(BenchError, match=r"a\.csv: temperature is NaN or infinite in 40 of 40 samples"):
        arm.accept(make_log(arm, np.full((40, 1), np.nan)))
    with pytest.raises(ConfigError, match=r"input humidity: unknown; .*temperature"):
        arm.observing({"humidity": 0.5})


def test_a_data_set_has_the_temperature_everywhere_or_nowhere(arm: Bench, caplog: pytest.LogCaptureFixture) -> None:
    having, lacking = make_log(arm, np.full((40, 1), 30.0), "a.csv"), make_log(arm, None, "b.csv")
    with pytest.raises(BenchError, match=r"^b\.csv: no temperature, which a\.csv has and the friction model uses;"):
        arm.accept_all(Dataset("mixed", (having,), (lacking,)))
    caplog.set_level(logging.INFO)
    arm.accept_all(Dataset("all", (having,), (having,)))
    assert not caplog.messages
    arm.accept_all(Dataset("none", (lacking,), (lacking,)))
    assert caplog.messages == ["none: no temperature recorded; the friction model uses 25"]
    arm.observing({}).accept_all(Dataset("mixed", (having,), (lacking,)))  # nothing looks at it


def record(bench: Bench, name: str, temperature: np.ndarray) -> Log:
    """Three seconds of the drive in MuJoCo C, with encoder steps and noise of the velocity."""
    values = bench.initial_values() | {"armature": np.array([ARMATURE])}
    model = mujoco.MjModel.from_xml_string(bench.mjcf(values, np.ones(1)))
    data, time = mujoco.MjData(model), np.arange(SAMPLES) * model.opt.timestep
    ctrl = 0.8 * np.sin(4 * time) + 0.3 * np.sin(13 * time) + 0.1 * np.sin(29 * time)
    states = np.empty((SAMPLES, 2))
    for sample, command in enumerate(ctrl):
        states[sample] = data.qpos.item(), data.qvel.item()
        data.ctrl[0] = command
        model.dof_frictionloss[0], model.dof_damping[0] = coefficients(name, temperature[sample])
        mujoco.mj_step(model, data)
    states[:, 0] = 1e-5 * np.round(states[:, 0] / 1e-5)
    states[:, 1] += np.random.default_rng(0).normal(scale=2e-3, size=SAMPLES)
    extras = {"temperature": temperature[:, None]}
    return Log(name, time, states[:, :1], states[:, 1:], ctrl[:, None], "", True, extras=extras)


def pose(make: Callable[..., Any], name: str, log: Log) -> Objective:
    law = make("model", f"model={name}", nv=1)
    bench = make("bench").observing(law.inputs)
    segments = cut_segments([bench.accept(log)], None, 50)
    rollout = make_rollout(make_engine("specialised", bench, friction_of(law), law.constraint))
    return Objective(Space(bench, law, "float64"), rollout, segments, 1.0, 1.0, "none", 1.0, False)


def identify(make: Callable[..., Any], name: str, log: Log) -> tuple[Values, Uncertainty]:
    objective = pose(make, name, log)
    fit = LevenbergMarquardt(30, 1e-8)
    progress, _ = search(fit, objective)
    return objective.space.values(progress.best), estimate_uncertainty(objective, np.asarray(progress.best))


WARMING = 40 - 20 * np.cos(2 * np.pi * np.arange(SAMPLES) / SAMPLES)  # degC


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("name", slow_but(LAWS[:1], LAWS))
def test_a_known_drive_is_found_again(make: Callable[..., Any], name: str, knee: Bench) -> None:
    values, uncertainty = identify(make, name, record(knee, name, WARMING))
    assert values["bench"]["armature"].item() == pytest.approx(ARMATURE, rel=0.05)
    for key, value in known(name).items():
        low, high = uncertainty.intervals[f"friction.{key}"][0]
        found = values["friction"][key].item()
        assert found == pytest.approx(value, rel=0.05) or low <= value <= high, (key, found)
        assert uncertainty.identifiable[f"friction.{key}"], key
        # An interval as wide as the value would hold anything.
        assert high - low < 0.5 * abs(value), key


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("name", slow_but(LAWS[:1], LAWS))
def test_at_one_temperature_its_effect_is_not_identifiable(make: Callable[..., Any], name: str, knee: Bench) -> None:
    """Away from the reference a coefficient and its change are one; at the reference the change has no effect."""
    dry, viscous = (f"friction.{key}" for key in TRUTH[name])
    log = record(knee, name, np.full(SAMPLES, 45.0))
    _, uncertainty = identify(make, name, log)
    for change, of in ((dry, "friction.frictionloss"), (viscous, "friction.damping")):
        assert not uncertainty.identifiable[change] and not uncertainty.identifiable[of]
        assert any({change, of} <= set(group) for group in uncertainty.indistinct)
    values, uncertainty = identify(make, name, replace(log, extras={}))
    assert not uncertainty.identifiable[dry] and not uncertainty.identifiable[viscous]
    assert uncertainty.identifiable["friction.frictionloss"] and uncertainty.identifiable["friction.damping"]
    assert uncertainty.indistinct == ()
    # Acting as at the reference, the law is Coulomb and viscous friction: it finds what acts at 45 degC.
    found = [values["friction"][key].item() for key in ("frictionloss", "damping")]
    assert found == pytest.approx(coefficients(name, 45.0), rel=0.05)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("kind", ["specialised", pytest.param("mjx", marks=pytest.mark.slow)])
def test_each_joint_has_its_own_temperature_in_a_step(make: Callable[..., Any], arm: Bench, kind: str) -> None:
    """Joint b is warmer, in both the state that the law sees and in what MuJoCo C does with its friction."""
    law = make("model", "model=temperature_linear", nv=2)
    engine = make_engine(kind, arm, friction_of(law), law.constraint)
    friction = {key: np.full(2, value) for key, value in known("temperature_linear").items()}
    values = {"bench": arm.initial_values(), "friction": friction}
    qpos, qvel, command, warm = (np.array(pair) for pair in ([0.1, 0.2], [0.5, -0.3], [0.3, -0.1], [20.0, 60.0]))
    signals = Signals(command, observed={"temperature": warm})
    load, memory = np.zeros(0), np.zeros((2, 0))
    state = jax.jit(engine.drive_state)(values, qpos, qvel, signals, load)
    assert state.ctrl.tolist() == command.tolist() and state.temperature.tolist() == warm.tolist()
    ours = jax.jit(engine.step)(values, qpos, qvel, signals, load, memory)[:2]
    dry, viscous = np.array([coefficients("temperature_linear", temperature) for temperature in warm]).T
    model = mujoco.MjModel.from_xml_string(arm.mjcf(arm.initial_values(), dry, viscous))
    data = mujoco.MjData(model)
    data.qpos, data.qvel, data.ctrl = qpos, qvel, command
    mujoco.mj_step(model, data)
    # The solver's tolerance for two joints; other temperatures change the velocity a thousand times as much.
    np.testing.assert_allclose(np.stack(ours), [data.qpos, data.qvel], atol=1e-8)


@pytest.fixture
def runs(call, recording, tiny, tmp_path):
    """Identifies a drive from the recording of tests with a temperature beside it; its folder, and what it said."""
    table = np.loadtxt(recording, delimiter=",", skiprows=1)
    warm = np.linspace(20, 60, len(table))[:, None]
    path = tmp_path / "warm.csv"
    np.savetxt(path, np.concatenate([table, warm], 1), delimiter=",", header="time,qpos,qvel,ctrl,warm", comments="")

    def run(model: str, *overrides: str) -> tuple[Path, Finished]:
        folder = tmp_path / f"{model} {' '.join(overrides)}".replace("/", " ")[:80].strip()
        options = (f"data.train=[{path}]", f"model={model}", "fit=lm", f"hydra.run.dir='{folder}'", *overrides)
        finished = call(*tiny, *options)
        assert finished.status == 0, finished.err
        return folder, finished

    return run


def parameters(folder: Path) -> dict[str, dict[str, Any]]:
    return {row["name"]: row for row in json.loads((folder / "result.json").read_text())["parameters"]}


@pytest.mark.slow
def test_a_run_with_and_without_temperature(runs: Callable[..., tuple[Path, Finished]], tmp_path: Path) -> None:
    """Both are judged on the same rollouts as other laws, exported, and followed by other laws."""
    warm, said = runs("temperature_linear", "data.columns.temperature=warm")
    assert "no temperature" not in said.err
    cold, said = runs("temperature_linear")
    assert said.err.count("no temperature recorded; the friction model uses 25") == 1
    plain, _ = runs("mujoco_default")
    with_it, without, other = map(parameters, (warm, cold, plain))
    for key in TRUTH["temperature_linear"]:
        assert without[key]["identifiable"] is False and without[key]["value"] == 0
        assert with_it[key]["interval"] is not None and with_it[key]["value"] != 0
    for key in ("armature", "frictionloss", "damping"):  # the same law, but for where the fit stops
        assert without[key]["value"] == pytest.approx(other[key]["value"], rel=0.01)
    read_runs([warm, cold, plain])  # refuses runs that were judged on other rollouts

    for folder, targets in ((warm, ["all"]), (cold, ["mjcf", "mujoco", "onnx"])):
        assert Identified.load(folder).samples.temperature is not None
        written = {one.target: one.export for target in targets for one in write_exports(folder, {"target": target})}
        for target, quantity, promise in (("mujoco", "qpos", 1e-9), ("onnx", "torque", 1e-12)):
            (difference, *_) = written[target].differences
            assert difference.quantity == quantity and difference.largest < promise
        assert "is the frictionloss and damping below, at temperature 25 and at no other" in written["mjcf"].limits[0]
    drive = load_module(warm / "export" / "mujoco" / "drive.py")
    assert drive.OBSERVED == {"temperature": 25.0} and drive.INPUTS == ()

    # Of a teacher that looks at the temperature and a student that does not, and the other way round.
    for teacher, student in ((warm, "mujoco_default"), (plain, "temperature_arrhenius")):
        distill([str(teacher), f"model={student}", f"output={tmp_path / 'students' / student}"])
        assert parameters(tmp_path / "students" / student)["armature"]["value"] > 0
