"""A finding's repair is the first command, complete and runnable; a result that is not to be used goes nowhere."""

import json
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Finished
from omegaconf import OmegaConf

from frictionzoo.bench import Bench
from frictionzoo.bench.given import Given
from frictionzoo.core.config import compose_config
from frictionzoo.diagnostics.findings import Repair
from frictionzoo.diagnostics.recordings import check_up
from frictionzoo.identification.commands import complete_options
from frictionzoo.report.run_page import find_target, list_uses
from frictionzoo.report.terminal import summarise
from frictionzoo.result.record import read_run
from frictionzoo.result.section_types import SuggestedCommand
from frictionzoo.result.verdict import DO_NOT_USE, is_usable, judge

KP, KD = 20 * 0.151, 0.151  # N m/rad, N m s/rad
HARDWARE = ("frictionzoo.export", ".export(", "frictionzoo.design", "design_recording(")
COMMANDS = {
    "repair": "python -m frictionzoo.run bench.actuator.params.kp.init=3",
    "inspect": "python -m frictionzoo.inspect",
    "law": "python -m frictionzoo.run model=ripple",
    "recording": "python -m frictionzoo.design a torque=8.4",
    "export": "python -m frictionzoo.export a",
}
Run = Callable[[str], tuple[Path, Finished]]


@pytest.fixture(scope="module")
def weak(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six seconds of the paper's rod under a controller whose gains are 0.151 times the published ones."""
    timestep, finer, inertia = 1e-3, 10, 0.0011 + 0.26 * 0.1127**2 + 0.02
    time = timestep * np.arange(6001)
    ctrl = 0.7 * np.sin(2 * np.pi * 0.7 * time) + 0.4 * np.sin(2 * np.pi * 1.7 * time + 1)
    states, q, v = np.empty((len(time), 2)), float(ctrl[0]), 0.0
    for state, command in zip(states, ctrl, strict=True):
        state[:] = q, v
        for _ in range(finer):
            friction = 0.03 * np.tanh(v / 0.01) + 0.02 * v
            torque = KP * (command - q) - KD * v - 0.26 * 9.81 * 0.1127 * np.sin(q) - friction
            v += timestep / finer * torque / inertia
            q += timestep / finer * v
    path = tmp_path_factory.mktemp("weak") / "a.csv"
    table = np.column_stack([time, states, ctrl])
    np.savetxt(path, table, fmt="%.9g", delimiter=",", header="time,qpos,qvel,ctrl", comments="")
    return path


def options_of(recording: Path, *more: str) -> list[str]:
    return ["data=files", "bench=knee", f"data.train=[{recording}]", "data.split.gap=0.05", "recipe=given", *more]


def doubts_of(options: list[str]) -> tuple[Any, Given]:
    given = Given.read(OmegaConf.to_container(compose_config(*options), resolve=True))
    return check_up(given.bench.accept_all(given.dataset), given.bench, "warn"), given


def test_a_factor_of_the_gains_is_a_repair_that_ends_the_finding(weak: Path) -> None:
    doubts, given = doubts_of(options_of(weak))
    (doubt,) = [doubt for doubt in doubts if "kp and kd to" in doubt.text]
    options = complete_options(doubt.repairs, given.bench, given.settings)
    assert list(options) == ["bench.actuator.params.kp.init", "bench.actuator.params.kd.init"]
    assert [*options.values()] == pytest.approx([KP, KD], rel=0.1)
    repaired, _ = doubts_of(options_of(weak, *(f"{name}={value}" for name, value in options.items())))
    assert not any(doubt.repairs for doubt in repaired)


@pytest.mark.slow
@pytest.mark.usefixtures("in_haste")
def test_the_first_command_is_the_repair_and_runs(call: Callable[..., Finished], weak: Path, tmp_path: Path) -> None:
    evaluation = ("evaluation.horizons=[0.2]", "evaluation.trajectory=0.5", "evaluation.places=2")
    small = ("model=mujoco_default", "fit=lm", "dtype=float64", "segments.count=60", "segments.length=20")
    more = (*small, *evaluation, "discretisation=false", "loop.progress=false")
    first = call(*options_of(weak, *more), "hydra.run.dir=first")
    verdict = json.loads((tmp_path / "first" / "result.json").read_text())["verdict"]
    kinds = [row["kind"] for row in verdict["commands"]]
    assert kinds[0] == "repair" and "recording" not in kinds
    assert any("kp and kd to 0.15" in finding["text"] for finding in verdict["findings"])
    command = verdict["commands"][0]["command"]
    assert first.out.partition("next: the corrected run")[2].splitlines()[1].strip() == command
    again = call(*shlex.split(command)[3:], "hydra.run.dir=second")
    assert again.status == 0, again.err
    result = json.loads((tmp_path / "second" / "result.json").read_text())
    assert not any("kp and kd to" in finding["text"] for finding in result["verdict"]["findings"])
    assert result["verdict"]["commands"][0]["kind"] != "repair" and result["model"] == "mujoco_default"
    armature = next(row["value"] for row in result["parameters"] if row["name"] == "armature")
    assert armature == pytest.approx(0.02, rel=0.3)


@pytest.mark.parametrize("repair", [False, True])
def test_what_is_not_to_be_used_goes_neither_to_hardware_nor_elsewhere(finished_run: Run, repair: bool) -> None:
    """And a run with a repair designs no recording."""
    usable = read_run(finished_run("mujoco_default")[0])[0]
    rows = [SuggestedCommand(kind, text) for kind, text in COMMANDS.items() if repair or kind != "repair"]  # pyright: ignore
    usable.not_identified = None
    kept = judge(usable, rows)
    assert kept.grade != DO_NOT_USE
    usable.verdict = kept
    assert any("frictionzoo.export" in line for line in list_uses("a", find_target(usable)))
    if repair:
        assert [row.kind for row in kept.commands] == ["repair", "law", "export"]
    spoilt = usable
    spoilt.not_identified = ["friction ended at its bounds", "gains"]
    spoilt.verdict = judge(spoilt, rows)
    assert spoilt.verdict.grade == DO_NOT_USE and not is_usable(spoilt)
    assert [row.kind for row in spoilt.verdict.commands] == [*["repair"] * repair, "inspect"]
    for shown in (summarise(spoilt, None), "\n".join(list_uses("a", find_target(spoilt)))):
        assert not any(word in shown for word in HARDWARE)


def test_a_repair_of_one_joint_keeps_what_the_others_have(two_joints: Bench) -> None:
    settings = {"data": {"sign": {"ctrl": [1, -1], "qpos": 1}}, "bench": {}}
    repairs = [
        Repair("data.sign.ctrl", -1, 1, is_factor=True),
        Repair("data.sign.qpos", -1, 0, is_factor=True),
        Repair("bench.actuator.params.kp.init", 0.5, 1, is_factor=True),
        Repair("data.clean.spikes", "repair"),
    ]
    assert complete_options(repairs, two_joints, settings) == {
        **{"data.sign.ctrl": [1, 1], "data.sign.qpos": [-1, 1], "bench.actuator.params.kp.init": [20.0, 10.0]},
        "data.clean.spikes": "repair",
    }


def test_a_value_outside_its_bounds_takes_the_bounds_along(two_joints: Bench) -> None:
    params = {"actuator": {"params": {"kp": {"init": 20.0, "low": 1.0, "high": 100.0}}}}
    repairs = [Repair("bench.actuator.params.kp.init", 30.0, joint, is_factor=True) for joint in (0, 1)]
    options = complete_options(repairs, two_joints, {"bench": params, "data": {}})
    assert options["bench.actuator.params.kp.init"] == [600.0, 600.0]
    assert options["bench.actuator.params.kp.high"] == 6000.0
