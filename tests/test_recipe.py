"""Automatic settings: choices, their reasons, and options that a user sets."""

import operator
from collections.abc import Callable
from functools import reduce
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf

import frictionzoo as fz
from frictionzoo.bench import Bench
from frictionzoo.core.build import build
from frictionzoo.core.config import compose_config, compose_settings
from frictionzoo.core.described import describe, remake
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.log import Dataset, Log
from frictionzoo.core.params import AUTO
from frictionzoo.core.segments import cut_segments
from frictionzoo.data.signals import find_noise
from frictionzoo.fit import Space
from frictionzoo.fit.loss import Loss
from frictionzoo.identification.choices import OPTIONAL, imply, option_of, settle_gain
from frictionzoo.identification.noise import Misfit, Noise, find_step
from frictionzoo.identification.pilot import Pilot, PilotResult, exact_enough
from frictionzoo.identification.recipe import Parts, _divide_interval, leave_open
from frictionzoo.identification.trials import hold_back

TIMESTEP, DELAY = 0.005, 0.012
PULL = 0.2  # N m, constant
GAIN = 20.0  # N m/rad, of the simulated drive
OPTIONS = ("data=twin", f"data.timestep={TIMESTEP}", "data.substeps=20", "data.samples=2400", "data.cache_dir=null")
DRIVE = {"command_delay": DELAY, "load_share": 0.0, "ripple_torque": 0.0, "static_torque": 0.11}
QUICK: dict[str, Any] = {"evaluation": {"horizons": [0.5], "rollouts": 2, "places": 2, "trajectory": 1.0}}


def knee() -> fz.Bench:
    return fz.Bench("knee_rod.xml", "knee", actuator=fz.PositionPD(kp=20, kd=1.0))


@pytest.fixture(scope="module")
def recorded() -> Dataset:
    """A drive whose commands act late, with a coarse encoder and a noisy velocity."""
    config = compose_config(*OPTIONS, *(f"data.drive.{name}={value}" for name, value in DRIVE.items()))
    settings: Any = OmegaConf.to_container(config.data, resolve=True)
    return build(settings).load()


@pytest.fixture(scope="module")
def pulled(recorded: Dataset) -> list[Log]:
    """A drive that a constant torque pulls besides."""
    return [Log(**{**vars(log), "ctrl": log.ctrl - PULL / 20}) for log in recorded.train]


@pytest.fixture(scope="module")
def found(pulled: list[Log]) -> fz.Identified:
    """What is found with nothing but the recording and the bench."""
    return fz.identify(knee(), "coulomb_smooth", pulled, test=0.2, **QUICK)


@pytest.mark.parametrize("noise", [1e-4, 1e-2])
def test_noise_is_told_from_a_motion(noise: float) -> None:
    time = np.arange(4000) * 0.01
    motion = np.sin(3.0 * time) + 0.3 * np.sin(11.0 * time)
    measured = motion + np.random.default_rng(0).normal(0.0, noise, len(time))
    assert find_noise(measured) == pytest.approx(noise, rel=0.1)
    assert find_noise(motion) < 0.02 * noise
    rounded = np.round(np.sin(0.1 * time) / 0.01) * 0.01
    assert find_noise(rounded) == pytest.approx(0.01 / np.sqrt(12), rel=0.2)


def test_the_step_of_an_encoder_is_found() -> None:
    time, rng = np.arange(4000) * 0.005, np.random.default_rng(0)
    motion = np.sin(3.0 * time) + 0.3 * np.sin(11.0 * time)
    assert find_step([np.round(motion / 0.006) * 0.006]) == pytest.approx(0.006)
    assert find_step([motion]) == 0.0 and find_step([np.ones(100)]) == 0.0
    assert find_step([np.round(motion / 0.006) * 0.006 + rng.normal(0.0, 1e-4, len(time))]) == 0.0


def test_velocities_count_by_their_noise_and_estimated_ones_next_to_nothing(recorded: Dataset) -> None:
    noise = Noise.of(recorded.train)
    assert noise.velocity is not None and noise.velocity == pytest.approx(0.055, rel=0.1)
    assert noise.velocity_weight == pytest.approx((noise.position / noise.velocity).item() ** 2, rel=0.01)
    bare = [Log(**{**vars(log), "velocity_estimated": True}) for log in recorded.train]
    assert Noise.of(bare).velocity is None and Noise.of(bare).velocity_weight < 1e-3 * noise.velocity_weight


def test_a_validation_block_is_not_fitted(recorded: Dataset) -> None:
    segments = cut_segments(recorded.train, None, 20)
    fitted, block = hold_back(segments, recorded.train)
    assert fitted.sum() == pytest.approx(0.8 * len(fitted), rel=0.02)
    assert segments.begins is not None and segments.begins[fitted][-1] + 20 * TIMESTEP < block[0].time[0]
    assert recorded.train[0].samples == pytest.approx(5 * block[0].samples, rel=0.01)
    several = tuple(Log(**{**vars(recorded.train[0]), "name": str(number)}) for number in range(10))
    segments = cut_segments(several, None, 20)
    fitted, block = hold_back(segments, several)
    assert [log.name for log in block] == ["0[validation]", "5[validation]"]
    assert segments.recording is not None and {*segments.recording[fitted]} == {1, 2, 3, 4, 6, 7, 8, 9}


@pytest.mark.usefixtures("in_haste")
def test_a_drive_is_found_with_nothing_said(found: fz.Identified) -> None:
    values = {row["name"]: row["value"] for row in found.result["parameters"]}
    assert values["armature"] == pytest.approx(0.04, rel=0.05)
    assert values["delay"] == pytest.approx(DELAY, abs=5e-4)
    assert values["torque_offset"] == pytest.approx(PULL, rel=0.05)
    chosen = {row["option"]: row["value"] for row in found.result["recipe"]}
    identified = {name: chosen.get(f"{option_of(name)}.identify") for name in OPTIONAL}
    assert identified == {"delay": True, "position_offset": False, "torque_offset": True, "kp": None}
    assert chosen["loss.refine"] is True and chosen["dtype"] == found.result["dtype"] == "float64"
    for option, value in chosen.items():
        assert reduce(operator.getitem, option.split("."), found.result["settings"]) == value, option
    reasons = {row["option"]: row["reason"] for row in found.result["recipe"]}
    assert all(reasons.values()) and "of this timestep" in reasons["bench.timestep"]  # the effect of a halving


@pytest.mark.usefixtures("in_haste")
@pytest.mark.parametrize("stated", [0.98 * GAIN, 1.5 * GAIN])
def test_a_gain_that_only_a_file_states_is_judged_by_the_recordings(
    stated: float, recorded: Dataset, tmp_path: Path
) -> None:
    """A second run reads the choices; a gain that the user states stays closed, so that no pilot judges it."""
    text = (resources.files("frictionzoo.bench") / "assets" / "knee_rod.xml").read_text()
    servo = f'<actuator><position joint="knee" kp="{stated}" kv="1"/></actuator></mujoco>'
    (tmp_path / "servo.xml").write_text(text.replace("</mujoco>", servo))
    law = fz.law("coulomb_smooth")

    def open_for(**how: Any) -> tuple[dict[str, Any], Bench]:
        bench = fz.Robot(str(tmp_path / "servo.xml"), **how)
        settings = compose_settings(QUICK, "recipe=auto")
        settings["bench"] = leave_open(describe(bench), settings["bench"], from_file=True)
        return settings, bench

    def settle() -> Parts:
        settings, bench = open_for()
        return Parts.settle(settings, bench, recorded, law, build(settings["fit"]), tmp_path)

    told = settle_gain(*open_for(actuator=fz.JointPD(kp=stated, kd=1.0)))["bench"]["actuator"]
    assert told["kp"] == stated and AUTO not in str(told)
    judged = settle()
    assert judged.bench.params["kp"].is_identified == (stated > GAIN)
    if stated > GAIN:
        again = settle()
        assert again.bench.params["kp"].is_identified and judged.start is not None and again.start is not None
        found = dict(zip(judged.start.labels, judged.start.vector, strict=True))["bench.kp"]
        assert np.exp(found) == pytest.approx(GAIN, rel=2e-3)


@pytest.mark.parametrize(
    ("options", "identify"),
    [
        ("", "auto"),
        ("recipe=given", False),
        ("bench.actuator.params.kp.init=30", False),
        ("bench.actuator.params.kp.identify=false", False),
        ("bench.actuator.params.kp.identify=true", True),
    ],
)
def test_a_gain_is_judged_unless_someone_has_decided(options: str, identify: Any, tmp_path: Path) -> None:
    text = (resources.files("frictionzoo.bench") / "assets" / "knee_rod.xml").read_text()
    servo = '<actuator><position joint="knee" kp="20" kv="1"/></actuator></mujoco>'
    (tmp_path / "servo.xml").write_text(text.replace("</mujoco>", servo))
    settings = compose_settings(
        {}, "recipe=auto", "bench=robot", f"bench.mjcf={tmp_path / 'servo.xml'}", *options.split()
    )
    settled = settle_gain(settings, build(settings["bench"], Bench))
    assert settled["bench"]["actuator"]["params"]["kp"]["identify"] == identify


def test_joints_with_larger_errors_have_no_longer_tails() -> None:
    """Noise of two sizes is noise; and where each counts over its size, a robust loss begins at the same for both."""
    errors, noise = np.random.default_rng(0).normal(size=(50, 100, 2)), np.array([0.25, 0.25])
    alike, unlike = (Misfit.of(errors * by, noise * by, by_joint=True) for by in (np.ones(2), np.array([1.0, 30.0])))
    assert unlike == pytest.approx(alike) and alike.kurtosis == pytest.approx(3, rel=0.1)
    assert alike.beyond == pytest.approx(4, rel=0.1) and alike.scale == pytest.approx(0.75, rel=0.1)
    assert Misfit.of(errors, noise, by_joint=False).scale == pytest.approx(0.75)  # three times the noise, in rad
    assert alike.is_more_than_noise and not Misfit.of(errors, np.ones(2), True).is_more_than_noise
    even = np.random.default_rng(1).uniform(-0.5, 0.5, (50, 100, 2))
    assert Misfit.of(even, np.full(2, 0.29), True).is_rounding and not Misfit.of(errors, np.ones(2), True).is_rounding


def test_a_late_command_need_not_be_known_better_than_an_armature() -> None:
    """Both to a share of their values, the one moved as a logarithm and the other over its scale of 10 ms."""
    params = {"delay": {"init": 0.035, "low": 0.0, "high": 0.04, "scale": 0.01, "identify": True}}
    bench = remake(knee(), params=params)
    space = Space(bench, fz.law("baseline"), "float32")
    enough = dict(zip(space.labels, exact_enough(space, np.asarray(space.start, np.float64)), strict=True))
    assert enough["bench.delay"] == pytest.approx(3.5 * enough["bench.armature"], rel=1e-5)
    none = dict(zip(space.labels, exact_enough(space, np.zeros(2)), strict=True))
    assert none["bench.delay"] == enough["bench.armature"]  # near 0 a share of the scale


@pytest.mark.slow
@pytest.mark.usefixtures("in_haste")
def test_halving_the_step_that_was_chosen_moves_nothing(found: fz.Identified, pulled: list[Log]) -> None:
    """Discretisation is checked: with half the step, parameters stay within a third of half their intervals."""
    settings = found.result["settings"]
    params = {name: {"init": 0.0, **own} for name, own in settings["bench"]["params"].items()}
    order, timestep = settings["bench"]["second_order"], settings["bench"]["timestep"] / 2
    bench = remake(knee(), params=params, timestep=timestep, second_order=order)
    how = {name: settings[name] for name in ("segments", "loss")}
    finer = fz.identify(bench, "coulomb_smooth", pulled, recipe="given", dtype="float64", test=0.2, **how, **QUICK)
    for one, other in zip(found.result["parameters"], finer.result["parameters"], strict=True):
        (of_joint,), (again,) = one["by_joint"], other["by_joint"]
        if ends := of_joint["interval"]:
            assert abs(of_joint["value"] - again["value"]) < 0.25 * (ends[1] - ends[0]), one["name"]


USUAL: dict[str, Any] = {"position": 1.0, "velocity": 0.1, "robust": "none", "robust_scale": 1.0, "encoder_step": 0.0}


@pytest.mark.parametrize(
    "given",
    [
        *({}, {"robust": "huber"}, {"velocity": 0.0, "robust": "huber"}, {"velocity": 0.0}),
        *({"impulse": True, "slow": 0.1}, {"continuity": 1.0}, {"refine": False}),
    ],
    ids=str,
)
def test_a_loss_that_is_given_in_part_is_made_whole(given: dict[str, Any]) -> None:
    """What is chosen goes with what a user says, whatever else the recordings show."""
    settings = compose_settings({"loss": given}, "recipe=auto")
    implied = {choice.option: choice.value for choice in imply(settings["loss"])}
    chosen = USUAL | {"refine": True, "by_joint": False}
    chosen |= {option.partition(".")[2]: value for option, value in implied.items() if option.startswith("loss.")}
    loss = settings["loss"] | {name: chosen[name] for name, value in settings["loss"].items() if value == AUTO}
    assert Loss(**loss) and given.items() <= loss.items()
    assert implied.get("segments.count", 0) is None or not given.get("continuity")


@pytest.mark.slow
@pytest.mark.usefixtures("in_haste")
def test_what_a_user_says_stays(recorded: Dataset) -> None:
    bench = remake(knee(), params={"delay": DELAY}, timestep=TIMESTEP)
    how: dict[str, Any] = {"segments": {"length": 30}, "loss": {"velocity": 0.5, "robust": "huber"}, "dtype": "float64"}
    fit = fz.identify(bench, "coulomb_smooth", list(recorded.train), test=0.2, discretisation=False, **how, **QUICK)
    chosen = {row["option"] for row in fit.result["recipe"]}
    assert chosen.isdisjoint({"segments.length", "loss.velocity", "loss.robust", "dtype", "bench.timestep"})
    assert "bench.params.delay.identify" not in chosen
    settings = fit.result["settings"]
    assert settings["segments"]["length"] == 30 and settings["loss"]["velocity"] == 0.5
    assert settings["loss"]["robust"] == "huber" and settings["bench"]["timestep"] == TIMESTEP
    assert settings["loss"]["refine"] is False and 0 < settings["loss"]["robust_scale"] < 0.1  # rad
    assert {row["name"]: row["value"] for row in fit.result["parameters"]}["delay"] == DELAY


@pytest.mark.slow
@pytest.mark.usefixtures("in_haste")
def test_long_tails_call_for_a_robust_loss(recorded: Dataset) -> None:
    """Where the drive is pushed now and then, and what pushed it is not in the log."""
    log = recorded.train[0]
    qpos, qvel = log.qpos.copy(), log.qvel.copy()
    for at in range(300, log.samples - 100, 600):
        push = 0.3 * np.sin(np.linspace(0, np.pi, 40))[:, None]
        qpos[at : at + 40] += push
        qvel[at : at + 40] += np.gradient(push[:, 0], TIMESTEP)[:, None]
    pushed = Log(**{**vars(log), "qpos": qpos, "qvel": qvel})
    fit = fz.identify(knee(), "coulomb_smooth", pushed, test=0.2, discretisation=False, **QUICK)
    chosen = {row["option"]: row for row in fit.result["recipe"]}
    assert chosen["loss.robust"]["value"] == "soft_l1" and "validation error" in chosen["loss.robust"]["reason"]


def test_a_network_has_no_pilot(recorded: Dataset, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", logger="frictionzoo")
    config = compose_config("data=twin", "recipe=auto", "model=neural_friction", "fit=adam")
    settings: Any = OmegaConf.to_container(config, resolve=True)
    law = fz.law("neural_friction", hidden=[4, 4])
    settled = Parts.settle(settings, knee(), recorded, law, build(settings["fit"]))
    chosen = {choice.option: choice.value for choice in settled.choices}
    assert "the report gives the reasons" in caplog.text and "hydra" not in caplog.text  # as called from Python
    assert settled.start is None and chosen["loss.refine"] is False and chosen["dtype"] == "float32"
    assert chosen["bench.params.delay.identify"] is False
    assert "auto" not in [
        str(value) for section in ("segments", "loss") for value in settled.settings[section].values()
    ]


@pytest.mark.parametrize(("stated", "chosen"), [(None, 7.5e-4), (AUTO, AUTO), (1e-3, 1e-3)])
def test_the_interval_of_recordings_decides_on_a_step_that_nobody_asked_for(stated: Any, chosen: Any) -> None:
    """Of the model file's 1 ms, no whole number lasts 1.5 ms."""
    bench, settings = _divide_interval(knee(), {"bench": {"timestep": stated}}, 1.5e-3)
    assert settings["bench"]["timestep"] == (chosen if chosen == AUTO else pytest.approx(chosen))
    assert bench.timestep == pytest.approx(1e-3 if stated == 1e-3 else 7.5e-4)


def test_a_recipe_that_does_not_exist_is_refused(recorded: Dataset) -> None:
    with pytest.raises(ConfigError, match=r"^recipe=best: "):
        fz.identify(knee(), "coulomb_smooth", list(recorded.train), recipe="best")


def test_what_is_open_is_nothing_without_a_recipe(call: Callable, tiny: tuple[str, ...]) -> None:
    for option in ("segments.length=auto", "bench.timestep=auto", "dtype=auto", "loss.robust=auto"):
        finished = call(*tiny, "recipe=given", option)
        assert finished.status == 2 and finished.err.startswith(f"frictionzoo: {option}"), finished.err


@pytest.mark.usefixtures("x64")
def test_a_prediction_stays_within_bounds(pulled: list[Log]) -> None:
    """The drive is pulled by 0.2 N m; a quarter of that is allowed."""
    free = {
        name: fz.free(0.0, low=-bound, high=bound)
        for name, bound in (("position_offset", 1.0), ("torque_offset", 0.05))
    }
    bench = fz.Bench("knee_rod.xml", "knee", actuator=fz.PositionPD(kp=GAIN, kd=1.0), params=free)
    settings = compose_settings({}, "recipe=given")
    pilot = Pilot(bench, fz.law("coulomb_smooth"), pulled, settings["segments"], settings["loss"], "specialised")
    offset = pilot.fit(PilotResult.begun(pilot.space.labels, pilot.start), ["torque_offset"])
    end = pilot.foresee(offset, "position_offset", "torque_offset")
    torque = dict(zip(end.labels, end.vector * 1.0, strict=True))["bench.torque_offset"]
    assert np.asarray(bench.params["torque_offset"].from_coordinate(torque, np)) == pytest.approx(0.05)
    assert end.at_bound[end.labels.index("bench.torque_offset")]
