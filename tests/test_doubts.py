"""Recordings that cannot be right: what is said of each kind of fault, and that clean ones pass."""

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest
from conftest import make_run, needs_data

from frictionzoo.bench import Bench, Force
from frictionzoo.bench.regressor import inverse_torque
from frictionzoo.core.errors import ConfigError, LogError
from frictionzoo.core.log import Dataset, Log
from frictionzoo.data.twin import Twin
from frictionzoo.diagnostics.commands import takes_energy
from frictionzoo.diagnostics.dataset import check_motion
from frictionzoo.diagnostics.findings import Repair
from frictionzoo.diagnostics.following import Followed, check_following
from frictionzoo.diagnostics.lags import compare
from frictionzoo.diagnostics.recordings import check_up, find_all
from frictionzoo.diagnostics.torque import check_recorded
from frictionzoo.identification.solve import list_moving
from frictionzoo.result.types import ParameterRecord, Result, Value
from frictionzoo.result.verdict import doubt_errors, doubt_reference, explain_failure

ARMATURE = {"init": 50.0, "low": 1.0, "high": 1e3, "scale": "log", "identify": True}
RNG = np.random.default_rng(0)


def late(values: np.ndarray, samples: int) -> np.ndarray:
    return np.concatenate([np.repeat(values[:1], samples, axis=0), values[:-samples]])


def put(values: np.ndarray, number: float) -> np.ndarray:
    return np.where(np.arange(len(values))[:, None] == 1000, number, values)


def advance(values: np.ndarray, share: float) -> np.ndarray:
    """By a clock that gets ahead."""
    at = np.arange(len(values))
    return np.interp(at * (1 - share), at, values[:, 0])[:, None]


def one_way(log: Log) -> dict[str, np.ndarray]:
    qpos = np.cumsum(np.abs(np.diff(log.qpos, axis=0, prepend=log.qpos[:1])), axis=0)
    return {"qpos": qpos, "qvel": np.abs(log.qvel), "ctrl": qpos + (log.ctrl - log.qpos) * np.sign(log.qvel)}


def frozen(values: np.ndarray) -> np.ndarray:
    at = np.arange(len(values))[:, None]
    return np.where((at > 900) & (at < 1400), values[900], values)


def cut_off(values: np.ndarray) -> np.ndarray:
    return np.clip(values, *np.quantile(values, [0.2, 0.8]))


@pytest.fixture(scope="session")
def recorded(make: Callable) -> tuple[Log, Bench]:
    """Six seconds of a known drive."""
    twin: Twin = make("data", "data=twin_clean", "data.samples=8001", "data.cache_dir=null")
    return twin.load().train[0], make("bench")


def doubts(log: Log, bench: Bench) -> str:
    told = check_up(Dataset("one", (bench.accept(log),), (bench.accept(log),)), bench, "strict")
    return "\n".join(doubt.text for doubt in told)


def test_a_clean_recording_raises_no_doubt(recorded: tuple[Log, Bench]) -> None:
    assert doubts(*recorded) == ""


def test_a_position_that_rests_where_it_is_told_to_is_not_cut_off(recorded: tuple[Log, Bench]) -> None:
    log, bench = recorded
    trapezoids = cut_off(log.ctrl) * (1 + 1e-9 * RNG.normal(size=log.ctrl.shape))
    assert "clipped" in doubts(replace(log, ctrl=trapezoids), bench)
    assert "clipped" not in doubts(replace(log, qpos=late(trapezoids, 30), ctrl=trapezoids), bench)


def test_a_command_of_steps_is_not_cut_off(recorded: tuple[Log, Bench]) -> None:
    log, bench = recorded
    ctrl = np.sign(log.ctrl)  # with the traces that resampling leaves
    ctrl[::400] *= 0.3
    ctrl[1::2] *= 1 - 1e-9
    assert "clipped" not in doubts(replace(log, ctrl=ctrl), bench)


@pytest.mark.parametrize(
    ("spoil", "line"),
    [
        (lambda log: {"qvel": 0 * log.qvel}, r"qvel is constant, expected .* set data\.clean\.velocity=estimated"),
        (lambda log: {"ctrl": -log.ctrl}, r"moves opposite to ctrl .* set data\.sign\.ctrl=-1"),
        (lambda log: {"qpos": -log.qpos, "qvel": -log.qvel}, "moves opposite .* or the sign of both qpos and qvel"),
        (lambda log: {"ctrl": late(log.ctrl, 200)}, r"is ahead of ctrl by 120 ms.* set data\.clean\.command_lag=0\.17"),
        (lambda log: {"ctrl": 57.3 * log.ctrl}, r"ratio 0\.01725: set data\.units\.ctrl=deg"),
        (lambda log: {"qpos": 57.3 * log.qpos, "qvel": 57.3 * log.qvel}, r"ratio 56\.65: set data\.units\.qpos=deg"),
        (
            lambda log: {"qpos": 30 * log.qpos, "qvel": 30 * log.qvel},
            r"a missing gear ratio, data\.units\.qpos=0\.0337",
        ),
        (
            lambda log: {"qpos": log.qvel, "qvel": log.qpos},
            "qvel does not match the position's derivative.*swapped columns",
        ),
        (lambda log: {"units": {"qpos": "mm"}}, "qpos is in mm, expected angles for knee of knee_rod.xml, a hinge"),
        (
            lambda log: {"units": {"ctrl": "V"}},
            "ctrl is in V, expected a desired position for PositionPD of knee_rod.xml",
        ),
        (lambda log: {"qvel": -log.qvel}, r"have opposite signs, expected the same; set data\.sign\.qvel=-1"),
        (lambda log: {"qpos": -log.qpos}, r"have opposite signs.*or data\.sign\.qpos=-1"),
        (lambda log: {"qpos": log.qpos % (2 * np.pi)}, r"jumps by a whole turn \d+ times.*data\.clean\.wrap=6\.28"),
        (lambda log: {"time": 1000 * log.time}, r"1 s between samples, expected .*; set data\.units\.time=ms"),
        (lambda log: {"qpos": 0 * log.qpos, "qvel": 0 * log.qvel}, "spans only 0, while ctrl spans"),
        (lambda log: {"qpos": RNG.normal(size=log.qpos.shape)}, "jumps between samples like noise"),
        (lambda log: {"ctrl": put(log.ctrl, 1e300)}, r"ctrl is 1e\+300 at sample 1000, expected at most 1e\+09"),
    ],
)
def test_what_is_certain_is_refused_with_what_mends_it(recorded, spoil, line):
    log, bench = recorded
    with pytest.raises(LogError, match=line):
        doubts(replace(log, **spoil(log)), bench)


@pytest.mark.parametrize(
    ("spoil", "text"),
    [
        (lambda log: {"qvel": late(log.qvel, 15)}, "qvel lags qpos by 15.1 ms; set data.clean.velocity_lag=auto"),
        (lambda log: {"qpos": late(log.qpos, 15)}, "qpos lags qvel by 14.9 ms; set data.clean.velocity_lag=auto"),
        (lambda log: {"time": 2 * log.time}, "qvel is 2 times the position's derivative: check the units of time"),
        (lambda log: {"ctrl": 0 * log.ctrl + 1}, "ctrl is constant, 1"),
        (lambda log: {"ctrl": cut_off(log.ctrl)}, "it seems to be clipped"),
        (lambda log: {"qpos": frozen(log.qpos)}, "qpos is constant from sample 900 on and jumps by"),
        (lambda log: {"qpos": put(log.qpos, 40)}, "qpos has outliers (1), such as 40 at"),
        (lambda log: {"qvel": put(log.qvel, 1e6)}, "qvel has outliers (1), such as 1e+06"),
        (lambda log: {"ctrl": put(log.ctrl, 40)}, "set data.clean.spikes=repair"),
        (
            lambda log: {"units": {}} | {name: 57.3 * getattr(log, name) for name in ("qpos", "qvel", "ctrl")},
            "it looks like degrees; set data.units.qpos=deg",
        ),
        (lambda log: {"qpos": late(log.qpos, 400), "qvel": late(log.qvel, 400)}, "identify bench.params.delay"),
        (lambda log: {"ctrl": advance(log.ctrl, 0.07)}, "their clocks drift; record both with one clock"),
        (lambda log: one_way(log), "the motion hardly reverses (0 % in the other direction)"),
        (lambda log: {"qpos": log.qpos + 5}, "both have the same zero"),
    ],
)
def test_what_is_likely_is_told_with_what_mends_it(recorded, spoil, text):
    log, bench = recorded
    assert text in doubts(replace(log, **spoil(log)), bench)


@pytest.mark.parametrize(("unit", "size"), [("rev", 1 / (2 * np.pi)), ("deg", 180 / np.pi), (None, 1.0)])
def test_a_recorded_torque_shows_the_unit_of_the_position(recorded, unit, size):
    log, bench = recorded
    model, qacc = bench.compile(constraint=False), np.gradient(log.qvel, log.timestep, axis=0)
    torque = inverse_torque(model, log.qpos, log.qvel, qacc) + 0.02 * qacc + 0.1 * np.sign(log.qvel)
    scaled = replace(log, qpos=size * log.qpos, qvel=size * log.qvel, extras={**log.extras, "torque": torque})
    found = list(check_recorded(bench.accept(scaled), bench, model))
    assert [(row.state, f"data.units.qpos={unit}" in row.text) for row in found] == [("bad", True)] * bool(unit)
    (other,) = check_recorded(bench.accept(replace(log, extras={"torque": 1e3 * torque})), bench, model)
    assert other.state == "caution" and "data.units.torque" in other.text


def test_what_is_certain_is_a_warning_if_the_user_says_so(recorded: tuple[Log, Bench]) -> None:
    log, bench = recorded
    turned = replace(bench.accept(log), ctrl=-log.ctrl)
    dataset = Dataset("one", (turned,), (turned,))
    with pytest.raises(LogError, match=r"if the recording is correct, set checkup=warn$"):
        check_up(dataset, bench, "strict")
    (told,) = check_up(dataset, bench, "warn")
    assert "data.sign.ctrl=-1" in told.text and told.text.endswith("(1 of 2 logs)")
    assert told.repairs == (Repair("data.sign.ctrl", -1, 0, is_factor=True),)
    with pytest.raises(ConfigError, match=r"checkup=lenient: unknown; .*strict"):
        check_up(dataset, bench, "lenient")


def test_a_position_on_a_bench_of_torques_is_told(recorded: tuple[Log, Bench], make: Callable) -> None:
    log, bench = replace(recorded[0], units={}), make("bench", "bench=emps")
    said = doubts(log, bench)
    assert "qpos follows ctrl like a desired position" in said and "(bench=NAME)" in said


def test_a_torque_before_a_gear_and_one_that_was_recorded_late_are_told(recorded: tuple[Log, Bench]) -> None:
    log, _ = recorded
    bench = Bench("knee_rod.xml", actuator=Force(force_gain=1.0, force_offset=0.0))
    torque = 20 * (log.ctrl - log.qpos) - log.qvel

    def kinds(ctrl: np.ndarray) -> dict[str, str]:
        spoilt = replace(log, ctrl=ctrl, units={})
        return {finding.title: finding.text for finding in find_all(Dataset("one", (spoilt,), (spoilt,)), bench)}

    assert kinds(torque) == {}
    assert "force_gain" in kinds(torque / 30)["torque"] and "gear ratio" in kinds(torque / 30)["torque"]
    assert "data.sign.ctrl=-1" in kinds(-torque)["opposed"]
    assert "data.clean.command_lag=0.099 (s)" in kinds(late(torque, 100))["early"]


@pytest.mark.parametrize("gravity", [None, [0.0, 0.0, 0.0]])
def test_a_strong_gear_with_a_large_armature_is_no_other_unit(gravity: list[float] | None) -> None:
    bench = Bench("knee_rod.xml", actuator=Force(force_gain=1.0, force_offset=0.0), gravity=gravity)
    time = np.arange(12_000)[:, None] * 0.002
    qpos = np.sum([0.3 / w * np.sin(w * time + 7 * w) for w in (1.3, 2.9, 5.1, 8.3)], axis=0)
    qvel = np.gradient(qpos, 0.002, axis=0)
    qacc = np.gradient(qvel, 0.002, axis=0)
    links = inverse_torque(bench.compile(constraint=False), qpos, qvel, qacc)
    # Friction that falls with the speed, as no column of the balance does.
    torque = links + 5.0 * qacc + 10.0 * np.sign(qvel) * (1 + 0.5 * np.exp(-np.abs(qvel) / 0.3))
    strong = bench.accept(Log("a", time[:, 0], qpos, qvel, torque, "0" * 64, None))
    assert doubts(strong, bench) == ""


def test_joints_that_are_swapped_or_turned_are_told(leg: Callable, make: Callable) -> None:
    """Hip and knee swing on their own, as MuJoCo C simulates them, each at frequencies of its own."""
    bench: Bench = leg()
    time = 0.001 * np.arange(6000)
    asked = np.column_stack([0.5 * np.sin(7 * time) + 0.3, 0.8 * np.sin(11 * time) - 0.9])
    model = mujoco.MjModel.from_xml_string(bench.mjcf(bench.initial_values(), damping=np.full(2, 0.2)))
    data, states = mujoco.MjData(model), []
    for command in asked:
        states.append((data.qpos.copy(), data.qvel.copy()))
        data.ctrl[:] = command
        mujoco.mj_step(model, data)
    qpos, qvel = (np.array(values) for values in zip(*states, strict=True))
    log = Log("leg", time, qpos, qvel, asked, "0" * 64, simulated=True)

    def said(qpos: np.ndarray, qvel: np.ndarray, ctrl: np.ndarray) -> str:
        spoilt = replace(log, qpos=qpos, qvel=qvel, ctrl=ctrl)
        return "\n".join(finding.text for finding in find_all(Dataset("leg", (spoilt,), (spoilt,)), bench))

    assert said(qpos, qvel, asked) == ""
    log = replace(log, without_velocity=(1,))
    assert {line.partition(";")[0] for line in said(qpos, qvel, asked).splitlines()} == {
        "the velocity of knee is estimated from qpos, not read from the recording"
    }
    log = replace(log, without_velocity=())
    assert "qpos of hip follows ctrl of knee: columns are swapped" in said(qpos, qvel, asked[:, ::-1])
    assert "hip and knee are swapped: exchange them in bench.joint or data.columns" in said(
        qpos[:, ::-1], qvel[:, ::-1], asked[:, ::-1]
    )
    turn = np.array([1.0, -1.0])
    # Of a leg that hangs down, either joint turned round gives the mirror image of the other.
    assert re.search("(hip|knee) is reversed: set data.sign.qpos", said(turn * qpos, turn * qvel, turn * asked))


def test_a_joint_that_others_move_may_brake_them(recorded: tuple[Log, Bench], leg: Callable) -> None:
    """And then need not follow a command that asks for little."""
    alone, (of, beside) = recorded[1], (leg(), 1)
    assert takes_energy(alone, 0, -0.1) and not takes_energy(alone, 0, 0.1)
    assert takes_energy(of, beside, -0.6) and not takes_energy(of, beside, -0.1)

    log = recorded[0]
    ctrl = 0.1 * np.sin(40 * log.time)[:, None]  # to which the position pays no heed
    both = replace(log, ctrl=ctrl)
    joint = Followed(
        *(signal[:, 0] for signal in (log.qpos, ctrl)),
        np.ones(log.samples, bool),
        compare(log.qpos[:, 0], ctrl[:, 0], log.timestep, np.ones(log.samples, bool)),
        0.05,
        -0.1,
    )
    told = {bench.nv: list(check_following(both, "", bench, 0, joint, False, None)) for bench in (alone, of)}
    assert [(fault.title, fault.certain) for fault in told[1]] == [("ignored", True)]
    assert [(fault.title, fault.certain) for fault in told[2]] == [("ignored", False)]


@needs_data
def test_a_bench_of_another_unit_is_refused(make: Callable) -> None:
    dataset, bench = make("data", "data=emps").load(), make("bench")
    with pytest.raises(LogError, match=r"emps: qpos is in m, expected angles for knee .* choose the bench"):
        check_up(bench.accept_all(dataset), bench, "strict")


@needs_data
@pytest.mark.parametrize("data", ["emps", "xl330"])
def test_real_recordings_raise_no_doubt(make: Callable, data: str) -> None:
    bench, dataset = (make(group, f"data={data}") for group in ("bench", "data"))
    assert check_up(bench.accept_all(dataset.load()), bench, "strict") == []


def test_what_mujoco_would_touch_on_the_way_is_told(recorded: tuple[Log, Bench], make: Callable, tmp_path) -> None:
    path, log = tmp_path / "bench.xml", recorded[0]
    path.write_text(
        '<mujoco><worldbody><geom name="floor" type="plane" size="1 1 .1" pos="0 0 -.18"/><body><joint name="j"'
        ' axis="0 1 0" range="-20 90" limited="true"/><geom name="rod" size=".01" fromto="0 0 0 0 0 -.2" type="capsule"'
        "/>"
        "</body></worldbody></mujoco>"
    )
    bench = make("bench", f"bench.mjcf={path}", "bench.joint=j")
    told = [finding.text for finding in check_motion(Dataset("one", (log,), (log,)), bench)]
    assert any("joint j is at its limit in" in sentence for sentence in told)
    assert any("geoms floor and rod touch in" in sentence for sentence in told)


def at_bounds(
    *names: str, owner: Any = "bench", unit: str = "kg", value: float = 0.1, low: float = 0.1
) -> list[ParameterRecord]:
    """Parameters of a knee that ended at a bound."""
    about: Any = {"value": value, "low": low, "high": 2.0, "identified": True, "at_bound": True}
    unknown: Any = {"interval": None, "identifiable": None}
    rows = [Value(name="knee", joints=["knee"], **about, **unknown)]
    return [ParameterRecord(name=name, owner=owner, unit=unit, by_joint=rows, **about, **unknown) for name in names]


def errors(result: Result, test: float | None) -> Result:
    result.metrics.test.position_mae, result.metrics.baseline.position_mae = test, 0.1
    return result


def test_a_fit_at_its_bounds_that_gains_little_did_not_identify_the_drive() -> None:
    result = errors(make_run(0, "stribeck").result, 0.04)
    result.parameters, result.warnings = at_bounds("armature", "kp"), ["qvel is late"]
    why, first, *_ = explain_failure(result) or [""]
    assert "bench.armature and bench.kp ended at their bounds, and the test error is 40 % of" in why
    assert first == "qvel is late"
    assert explain_failure(errors(result, 0.03)) is None
    assert explain_failure(errors(result, None))
    result.parameters = at_bounds("armature")
    assert explain_failure(errors(result, 0.04)) is None
    for value, refused in ((0.1, False), (2.0, True)):  # a drive without dry friction is a drive
        result.parameters = at_bounds("static_torque", "kinetic_torque", owner="friction", unit="N m", value=value)
        assert (explain_failure(result) is not None) == refused


def test_a_parameter_that_moves_when_the_fit_ends_is_named() -> None:
    rest, drift = np.full(100, 2.0), np.linspace(1, 2, 100)
    history = {"friction.damping": rest, "bench.armature": drift}
    assert list_moving(history, {}) == ["bench.armature"]
    # From the mean over one twentieth to that over the next it moves by 0.05.
    for half, moving in ((0.14, ["bench.armature"]), (0.16, [])):
        assert list_moving(history, {"bench.armature": np.array([2 - half, 2 + half])}) == moving
    assert list_moving({"bench.armature": drift[:9]}, {}) == []  # too few iterations to tell


def test_a_drive_without_friction_at_a_bound_is_no_reference() -> None:
    (row,) = at_bounds("armature", low=1.0)
    said = doubt_reference([row])
    assert said is not None and "bench.armature ended at a bound of [1, 2] kg" in said
    row.at_bound = False
    assert doubt_reference([row]) is None


def test_a_law_that_explains_next_to_nothing_is_told() -> None:
    result = errors(make_run(0, "stribeck").result, 0.09)
    (finding,) = doubt_errors(result)
    assert "is 90 % of the error without friction" in finding.text
    assert not [*doubt_errors(errors(make_run(0, "baseline").result, 0.09))]
    assert not [*doubt_errors(errors(result, 0.05))]
