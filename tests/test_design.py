"""The command to record next: within limits, soft, and what it says of the parameters beside what a fit then finds."""

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest
import yaml
from conftest import Finished, finish

import frictionzoo as fz
from frictionzoo.bench import Bench, Force
from frictionzoo.bench.limits import Limits, Motion, refuse_unholdable
from frictionzoo.cli.finished import design as main
from frictionzoo.core.errors import ConfigError, FrictionzooError
from frictionzoo.core.log import Log
from frictionzoo.design.excitation import _refuse_beyond, excite, prepare
from frictionzoo.design.information import SensorNoise, inform
from frictionzoo.design.plan import Plan, Request
from frictionzoo.simulation.context import computing

pytestmark = pytest.mark.usefixtures("settings_kept")

BOUNDS = {"position": "[-0.8,1.2]", "velocity": "4", "torque": "3"}
SHORT = {
    **{"seconds": "1.5", "ramp": "0.2", "starts": "2", "iterations": "8", "bandwidth": "4", "segments.length": "100"},
    "velocity_noise": "0.005",
}


@pytest.fixture
def command() -> Callable[..., Finished]:
    """Does in this process what `python -m frictionzoo.design` does in its own."""

    def command(*arguments: str, **options: str) -> Finished:
        return finish(lambda: main([*arguments, *(f"{name}={value}" for name, value in options.items())]))

    return command


def test_a_command_begins_and_ends_at_rest_and_repeats_itself() -> None:
    series = Plan(seconds=7.3, ramp=0.5, period=3.0, bandwidth=3.0).series(0.01, 10)
    coefficients = np.random.default_rng(0).normal(size=(2, 2 * series.harmonics))
    home = np.array([0.3, -0.2])
    ctrl, speed = series.command(np, coefficients, home)
    assert ctrl.shape == speed.shape == (731, 2)
    for end in (0, -1):
        assert np.array_equal(ctrl[end], home) and not speed[end].any()
    jolt = np.abs(np.diff(ctrl, 2, axis=0)).max(axis=1)
    assert max(jolt[0], jolt[-1]) < 0.15 * jolt.max()  # it rises from 0, where it would begin at its largest
    inner = ctrl[series.ramp : -series.ramp]
    assert series.period % 10 == 0 and series.period * series.interval <= 3.0
    np.testing.assert_allclose(inner[series.period :], inner[: -series.period], atol=1e-12)
    np.testing.assert_allclose(speed[1:-1], (ctrl[2:] - ctrl[:-2]) / 0.02, atol=1e-9)
    spectrum = np.abs(np.fft.rfft(inner[: series.period, 0] - home[0]))
    assert spectrum[series.harmonics + 1 :].max() < 1e-9 * spectrum.max()


@pytest.mark.parametrize(
    ("given", "line"),
    [
        ({"velocity": 0}, "velocity=0: expected above 0"),
        ({"position": [1, -1]}, r"position=\[1, -1\]: expected two numbers, the smaller first"),
        ({"position": [1, 2], "home": 0}, "home=0: expected between 1 and 2, the position limits"),
        ({"position": "far"}, r"position=far: expected a number, or two as in \[-1.5,1.8\]"),
        ({"velocity": [1, 2, 3]}, r"velocity=\[1, 2, 3\]: expected a number, or a list of 1, one a joint"),
    ],
)
def test_limits_that_leave_no_room_are_refused(given: dict[str, Any], line: str) -> None:
    with pytest.raises(ConfigError, match=line):
        Limits.read(1, **{"position": 1.0, "velocity": 4.0, "torque": 2.0, **given})


def test_limits_are_of_each_joint() -> None:
    limits = Limits.read(2, position=[[-1, 3], [-0.5, 0.5]], velocity=[4, 5], torque=2.0)
    assert limits.home.tolist() == [1.0, 0.0] and limits.torque.tolist() == [2.0, 2.0]
    half = limits.within(0.5)
    assert half.low.tolist() == [0.0, -0.25] and half.velocity.tolist() == [2.0, 2.5]
    rows = (
        np.array([[3.0, 0.25]]),
        np.array([[-4.0, 0.0]]),
        np.array([[0.0, 0.0]]),
        np.zeros((1, 2)),
        np.array([[1.0, -2]]),
    )
    shares = Motion(*rows).shares(np, limits)[:, 0]
    np.testing.assert_allclose(shares, [[1, 0.5], [1, 0], [0.5, 0], [0, 0], [0.5, 1]])


def test_a_drive_that_cannot_rest_within_its_limits_is_refused(knee: Bench) -> None:
    limits = Limits.read(1, position=[0.9, 2.1], velocity=4, torque=0.2)
    with pytest.raises(
        ConfigError, match=r"torque=0\.2: holding knee at 1\.5 rad already needs 0\.2867 N m, expected more"
    ):
        refuse_unholdable(knee, knee.initial_values(), {}, limits)
    refuse_unholdable(knee, knee.initial_values(), {}, replace(limits, torque=np.array([0.3])))
    driven = Bench("knee_rod.xml", actuator=Force())
    with pytest.raises(ConfigError, match="Force: its command is not a position, so the drive may leave its limits"):
        refuse_unholdable(driven, driven.initial_values(), {}, replace(limits, torque=np.array([3.0])))


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"velocity": None}, "velocity is missing; state what the drive may do: position=1.5 velocity=4 torque=2"),
        ({"starts": "1.5"}, "starts=1.5: expected a whole number"),
        ({"seconds": "1"}, "seconds=1: expected more than both ramps of 1 s"),
        ({"position": "[1"}, r"position=\[1: cannot be read"),
        ({"criterion": "best"}, "criterion=best: unknown; .*determinant, worst"),
        ({"quantum": "0", "velocity_noise": "0"}, "are 0: expected noise; state your sensor's"),
        ({"fit.iterations": "3"}, "fit.iterations: unknown option; "),
        ({"model": "stribek"}, "model=stribek: unknown; did you mean stribeck"),
        ({"bench.joints": "knee"}, "bench.joints: unknown option; did you mean joint"),
    ],
)
def test_an_impossible_request_is_one_line(options: dict[str, str | None], line: str) -> None:
    given = {name: value for name, value in {**BOUNDS, **options}.items() if value is not None}
    with pytest.raises(ConfigError, match=line):
        Request.read(given, None)


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"inputs.supply": "12"}, "inputs.supply: PositionPD needs nothing besides the command; leave it out"),
        ({"bench": "sts3215"}, "inputs.gain is missing: VoltageServo needs it; give inputs.gain=VALUE"),
        ({"model": "neural_friction"}, "neural_friction: a network, whose weights no recording determines"),
        ({"model": "baseline", "bench.params.armature.identify": "false"}, "nothing is identified"),
        ({"rate": "3000"}, "rate=3000: 0.000333333 s per sample, expected 0.001 s"),
    ],
)
def test_a_drive_of_which_nothing_can_be_told_is_refused(options: dict[str, str], line: str) -> None:
    with computing("float64"), pytest.raises(FrictionzooError, match=line):
        prepare(Request.read({**BOUNDS, **options}, None), None)


def test_a_controller_gets_the_commands_velocity_and_late_commands_have_a_past(knee: Bench) -> None:
    law, late = {"bench.actuator._target_": "frictionzoo.bench.JointPD"}, {"bench.params.delay.init": "0.0025"}
    with computing("float64"):
        task = prepare(Request.read({**BOUNDS, **law, **late, "inputs.ctrl_torque": "0.5"}, None), None)
        refuse_unholdable(task.bench, task.values["bench"], task.constants, Limits.read(1, 1, 4, 2))
    ctrl = np.arange(5.0)[None, :, None]
    signals = task.signals(np, ctrl, 10 * ctrl)
    assert signals.ctrl.ravel().tolist() == [0, 0, 0, 0, 1, 2, 3]  # the last one acts after the last sample
    assert np.array_equal(signals.inputs["ctrl_velocity"], 10 * signals.ctrl)
    assert (signals.inputs["ctrl_torque"] == 0.5).all()


def test_the_covariance_is_that_of_independent_noise_in_every_sample() -> None:
    """Against the same written as one matrix from the noise of all samples to the gradient."""
    rng, segments, length, nv, count = np.random.default_rng(0), 3, 4, 2, 3
    slopes = rng.normal(size=(segments, count + 2 * nv, 1, length, nv, 2))
    noise, weights = SensorNoise(quantum=0.0, position_noise=0.3, velocity_noise=0.7), (2.0, 0.5)
    with jax.enable_x64(True):
        found = inform(jax.numpy.asarray(slopes), weights, noise)
        covariance = found.covariance[0]
    samples = segments * length + 1
    gradient, hessian = np.zeros((count, samples, nv, 2)), np.zeros((count, count))
    for segment in range(segments):
        for step in range(length):
            by_value, by_state = np.split(slopes[segment, :, 0, step], [count])
            hessian += np.einsum("ijk,hjk,k->ih", by_value, by_value, weights)
            gradient[:, segment * length + step + 1] += np.array(weights) * by_value
            # Predicted minus measured: an error of the initial state acts through its own derivative.
            began = np.einsum("ijk,sjk,k->is", by_value, by_state, weights).reshape(count, 2, nv)
            gradient[:, segment * length] -= np.moveaxis(began, 1, 2)
    spread = np.einsum("itjk,htjk,k->ih", gradient, gradient, [0.09, 0.49])
    np.testing.assert_allclose(found.hessian[0], hessian, rtol=1e-12)
    np.testing.assert_allclose(found.spread[0], spread, rtol=1e-12)
    inverse = np.linalg.inv(hessian)
    np.testing.assert_allclose(covariance, inverse @ spread @ inverse, rtol=1e-6)


def test_a_command_beyond_a_limit_in_mujoco_c_is_refused(knee: Bench) -> None:
    _refuse_beyond(np.ones((5, 1)), knee)
    for share in (1.25, np.nan):
        with pytest.raises(ConfigError, match=f"the torque of knee takes {share} of its limit"):
            _refuse_beyond(np.array([[0.9], [0.9], [0.9], [0.9], [share]]), knee)


def test_a_runs_drive_gets_its_next_command(finished_run, command, tmp_path):
    """Within limits along its motion in MuJoCo C; its files say the same; a second one does not replace it."""
    run, folder = finished_run("mujoco_default")[0], tmp_path / "next"
    finished = command(str(run), **BOUNDS, **SHORT, output=str(folder))
    assert finished.status == 0, finished.err
    note = json.loads((folder / "excitation.json").read_text())
    values = {
        f"{row['owner']}.{row['name']}": row["value"]
        for row in json.loads((run / "result.json").read_text())["parameters"]
    }
    for row in note["parameters"]:
        assert row["value"] == pytest.approx(values[row["name"]], rel=1e-6)
        assert row["half_width"] > 0 and f"+- {row['half_width']:.2g}" in finished.out
    assert [row["quantity"] for row in note["limits"] if row["share"] > 1] == []
    assert max(row["share"] for row in note["limits"]) > 0.5
    assert np.less(note["search"]["ended"], note["search"]["began"]).all()

    assert "output=excitation_test" in note["next"][0]["command"] and note["model"] == "mujoco_default"
    assert (folder / "report.html").stat().st_size < 1.5e6

    log = next(iter(fz.read(str(folder / "expected.csv"))))
    assert log.samples == 1501 and log.timestep == pytest.approx(1e-3)
    assert log.qpos.min() > -0.8 and log.qpos.max() < 1.2 and np.abs(log.qvel).max() < 4
    told = np.loadtxt(folder / "command.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(told, np.column_stack([log.time, log.ctrl]), atol=1e-9)
    points = yaml.safe_load((folder / "trajectory.yaml").read_text())
    assert points["joint_names"] == ["knee"]
    time = [point["time_from_start"]["sec"] + 1e-9 * point["time_from_start"]["nanosec"] for point in points["points"]]
    np.testing.assert_allclose(time, np.linspace(0, 1.5, 151), atol=1e-9)
    position, speed = ([point[name][0] for point in points["points"]] for name in ("positions", "velocities"))
    np.testing.assert_allclose(position, log.ctrl[::10, 0], atol=1e-9)
    assert speed[0] == speed[-1] == 0
    frames = json.loads((folder / "actions.json").read_text())
    assert frames["fps"] == 50
    np.testing.assert_allclose([action["knee.pos"] for action in frames["actions"]], log.ctrl[::20, 0], atol=1e-9)

    again = command(str(run), **BOUNDS, starts="1000", output=str(folder))  # before it searches
    assert again.status == 2 and "it exists already" in again.err
    mistaken = command(str(run), **BOUNDS, model="stribeck", output=str(tmp_path / "other"))
    assert mistaken.status == 2 and "has chosen it; leave it out" in mistaken.err and not (tmp_path / "other").exists()


TRUTH = {"bench.armature": 0.04, "friction.frictionloss": 0.2, "friction.damping": 0.1}
OPTIONS = ("bench.params.armature.init", "model.params.frictionloss.init", "model.params.damping.init")


@pytest.mark.slow
@pytest.mark.usefixtures("in_haste")
def test_what_is_expected_is_what_a_fit_finds(knee: Bench) -> None:
    """Of four recordings with the noise that was stated, from a start elsewhere."""
    sensors = {"quantum": "1e-5", "velocity_noise": "0.01", "model": "mujoco_default", "segments.length": "100"}
    drive = dict(zip(OPTIONS, map(str, TRUTH.values()), strict=True))
    length = {"seconds": "30", "period": "5", "starts": "1", "iterations": "15"}
    designed = excite({**BOUNDS, **sensors, **drive, **length})
    # A fit trains on nine tenths.
    half = {row["name"]: row["half_width"] / 0.9**0.5 for row in designed.note["parameters"]}
    cut, judging = {"length": 100, "count": None}, {"horizons": [0.1], "places": 1, "trajectory": 0.2}
    motion, rng, ratios = designed.motion, np.random.default_rng(0), []
    for _ in range(4):
        qpos = 1e-5 * np.round(motion.qpos / 1e-5)
        qvel = motion.qvel + 0.01 * rng.normal(size=qpos.shape)
        log = Log("designed", 1e-3 * np.arange(len(qpos)), qpos, qvel, motion.ctrl, "", simulated=True)
        how: dict[str, Any] = {"recipe": "given", "method": "lm", "segments": cut, "evaluation": judging}
        how["discretisation"] = False  # noise alone is expected
        fit = fz.identify(knee, "mujoco_default", log, test=0.1, **how)
        for name, value in TRUTH.items():  # within four standard deviations
            assert fit.parameters[name].value[0] == pytest.approx(value, abs=2 * half[name])
        ratios.append([np.ptp(fit.parameters[name].interval[0]) / 2 / half[name] for name in TRUTH])
    # An interval of 30 stretches scatters by an eighth, and few segments in a stretch widen it a little.
    np.testing.assert_allclose(np.mean(ratios, axis=0), 1, atol=0.2)
