"""Exported drives in their target programs: `python benchmarks/targets.py RUN ... --environments FOLDER`.

Each run's drive is exported for each program. The program simulates the run's long test rollouts on the CPU in a
separate process without frictionzoo, and in a separate environment if versions clash. The table compares the difference
of positions from frictionzoo's simulation with the error of that simulation against the recordings.
"""

import json
import os
import subprocess
import sys
import tempfile
import venv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from measure import make_parser, report

from frictionzoo.api.identified import Identified
from frictionzoo.bench.compiled import INERTIAL
from frictionzoo.core.errors import ExportError, FrictionzooError
from frictionzoo.core.units import UNITS
from frictionzoo.export.base import Written, measure
from frictionzoo.export.motor import aim, lag, motors, read_inputs
from frictionzoo.export.simulate import commands_before
from frictionzoo.export.write import write_exports

ROLLED = Path(__file__).parent / "rolled"
COLUMNS = {
    "run": "drive",
    "program": "program",
    "files": "files of",
    "unit": "unit",
    "largest": "largest difference",
    "mean": "mean",
    "error": "drive's own error",
    "share": "mean / error",
    "note": "",
}
LONGEST = 3600.0  # s, time limit of a program
BENCH = ("mjcf", "mujoco")  # the bench's MJCF, and the actuator's controller


@dataclass(frozen=True)
class Program:
    """Program that simulates an exported drive.

    Attributes:
        name: Name in the table if the program does not report its version.
        targets: Exports that its script needs, with their options; the tested export first.
        script: Script in `benchmarks/rolled`, with its options.
        environment: Requirements file in `benchmarks/rolled`; empty for the environment of this process.
        lacks: Brief list of the files' features that it lacks or simulates differently.
        unrun: Brief note on a part of it that another program replaces; added to the note of every row.
    """

    name: str
    targets: tuple[str, ...]
    script: tuple[str, ...]
    environment: str = ""
    lacks: str = ""
    unrun: str = ""


PROGRAMS = {
    "mujoco": Program("MuJoCo", ("mujoco",), ("roll_mujoco.py", "--kind=drive")),
    "mjcf": Program("MuJoCo", BENCH, ("roll_mujoco.py", "--kind=bench")),
    "mujoco4": Program("MuJoCo 4", ("mujoco",), ("roll_mujoco.py", "--kind=drive"), "mujoco4.txt"),
    "mjcf4": Program("MuJoCo 4", BENCH, ("roll_mujoco.py", "--kind=bench"), "mujoco4.txt"),
    "mjx": Program("MJX", ("mjx",), ("roll_mjx.py",)),
    "warp": Program("MuJoCo Warp", BENCH, ("roll_warp.py",), "warp.txt"),
    "newton": Program("Newton", BENCH, ("roll_newton.py",), "newton.txt"),
    "mjlab": Program("mjlab", ("mjlab", "mjcf"), ("roll_mjlab.py",), "mjlab.txt"),
    "isaaclab": Program(
        *("Isaac Lab", ("isaaclab", "mjcf"), ("roll_isaaclab.py",), "isaaclab.txt"),
        unrun="PhysX was not run: MuJoCo moves the joints",
    ),
    "isaaclabnewton": Program(
        "Isaac Lab",
        ("isaaclab physics=newton", "mjcf"),
        ("roll_isaaclab.py", "--target=isaaclab physics=newton"),
        "isaaclab.txt",
        unrun="Newton was not run: MuJoCo moves the joints",
    ),
    "isaaclab2": Program(
        *("Isaac Lab 2", ("isaaclab", "mjcf"), ("roll_isaaclab.py",), "isaaclab2.txt"),
        unrun="PhysX was not run: MuJoCo moves the joints",
    ),
    "genesis": Program("Genesis", BENCH, ("roll_genesis.py",), "genesis.txt"),
    "drake": Program("Drake", ("urdf", *BENCH), ("roll_drake.py", "--target=urdf"), "drake.txt", "no dry friction"),
    "drakesdf": Program("Drake", ("sdf", *BENCH), ("roll_drake.py", "--target=sdf"), "drake.txt", "no dry friction"),
    "drakedry": Program(
        "Drake", ("sdf", *BENCH), ("roll_drake.py", "--target=sdf", "--dry"), "drake.txt", "no solreffriction"
    ),
    "dart": Program("DART", ("urdf", *BENCH), ("roll_dart.py",), "dart.txt", "no armature"),
    "dartrotors": Program(
        "DART",
        ("urdf", *BENCH),
        ("roll_dart.py", "--rotors"),
        "dart.txt",
        "no solreffriction, rotors turn with their links",
    ),
    "gazebo": Program("Gazebo physics", ("sdf", *BENCH), ("roll_gazebo.py",), lacks="no armature"),
    "gazebolinks": Program(
        *("Gazebo physics", ("sdf armature=links", *BENCH), ("roll_gazebo.py", "--target=sdf armature=links")),
        lacks="no solreffriction",
    ),
    "onnx": Program("ONNX Runtime", ("onnx", "mujoco"), ("roll_mujoco.py", "--kind=onnx")),
    "torchscript": Program("torch.jit", ("torchscript", "mujoco"), ("roll_mujoco.py", "--kind=torchscript")),
    "libtorch": Program("libtorch", ("torchscript", "mujoco"), ("roll_mujoco.py", "--kind=libtorch")),
}


def main() -> None:
    """Simulate each drive in each program, print and write the table."""
    parser = make_parser("targets", __doc__)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folder of a finished run")
    parser.add_argument("--programs", nargs="+", choices=PROGRAMS, default=list(PROGRAMS), help="all by default")
    parser.add_argument("--environments", type=Path, metavar="FOLDER", help="which keeps environments; a temporary one")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        environments = (arguments.environments or Path(scratch, "environments")).resolve()
        rows = []
        for run in arguments.runs:
            rows += try_drive(run, arguments.programs, environments, Path(scratch, f"run{len(rows)}"))
    report(arguments.out, rows, COLUMNS)


def try_drive(run: Path, programs: Sequence[str], environments: Path, folder: Path) -> list[dict[str, Any]]:
    """Export and simulate the drive of a run; return a row for each program.

    Args:
        run: Folder of the run.
        programs: Names of `PROGRAMS`.
        environments: Folder of the environments, which are created if missing.
        folder: Folder for the exported files and the simulated positions.
    """
    fitted = Identified.load(run)
    folder.mkdir(parents=True)
    write_given(fitted, folder / "given.npz")
    exports = export(run, {target for name in programs for target in PROGRAMS[name].targets}, folder)
    label, unit = f"{run.name}: {fitted.result['model']}", UNITS[fitted.bench.joint_type]["position"]
    rows = []
    for name in programs:
        print(f"{label} in {PROGRAMS[name].name}", file=sys.stderr, flush=True)
        program, out = PROGRAMS[name], folder / f"{name}.npz"
        needed = [exports[target] for target in program.targets]
        missing = next((one.reason for one in needed if one.export is None), "")
        reason = missing or simulate(program, environments, folder, out)
        row = {"run": label, "program": program.name, "files": program.targets[0], "unit": unit, "note": reason}
        rows.append(row if reason else row | compare(fitted, out, needed[0], program))
    return rows


def export(run: Path, targets: set[str], folder: Path) -> dict[str, Written]:
    """Write these targets, with their options, to folders of the same names; failed exports carry a reason."""
    written = {}
    for target in sorted(targets):
        name, *options = target.split()
        given = dict(option.split("=") for option in options)
        try:
            (written[target],) = write_exports(run, {"target": name, "output": str(folder / target), **given})
        except FrictionzooError as error:
            written[target] = Written(name, reason=str(error))
    return written


def write_given(fitted: Identified, path: Path) -> None:
    """Write initial states, commands and payloads of the long test rollouts for `benchmarks/rolled/given.py`."""
    segments, bench, sampling = fitted.segments, fitted.bench, fitted.sampling
    arrays = {"qpos": segments.qpos[:, 0], "qvel": segments.qvel[:, 0]}
    for kind, late in (("recorded", False), ("acting", True)):
        signals = fitted.acting(late=late).map(lambda signal: signal.reshape(segments.count, -1, bench.nv))
        named = {"ctrl": signals.ctrl, **signals.inputs, **signals.observed}
        arrays |= {f"{kind}.{name}": signal for name, signal in named.items()}
    held = [commands_before(fitted, rollout) for rollout in range(segments.count)]
    for name in ("ctrl", *held[0].inputs):
        of = [one.ctrl if name == "ctrl" else one.inputs[name] for one in held]
        arrays[f"before.{name}"] = np.stack(of)
    try:
        aims = aim(fitted, motors(fitted, read_inputs(fitted, {})))
        arrays["targets"] = aims(fitted.acting(late=False)).reshape(segments.count, -1, bench.nv)
        arrays["targets_before"] = np.stack([aims(one) for one in held])
    except ExportError:
        none = np.empty((segments.count, 0, bench.nv))  # no position-controlled motor
        arrays |= {"targets": none, "targets_before": none}
    arrays["load"] = np.empty((segments.count, 0)) if segments.load is None else segments.load[:, :INERTIAL]
    settings = {"joints": list(bench.joints), "timestep": fitted.timestep, "substeps": sampling.substeps}
    settings["lags"] = [lag(fitted, joint) for joint in range(bench.nv)]
    settings["body"] = -1 if bench.payload is None else bench.payload
    np.savez(path, settings=json.dumps(settings), **arrays)


def simulate(program: Program, environments: Path, folder: Path, out: Path) -> str:
    """Simulate the exports of a folder in a program; return a one-line reason for failure, or an empty string."""
    python = Path(sys.executable)
    if program.environment:
        python, reason = make_environment(ROLLED / program.environment, environments)
        if reason:
            return reason
    script, *options = program.script
    command = [str(python), str(ROLLED / script), str(folder / "given.npz"), str(folder), str(out), *options]
    # PYTHONPATH belongs to this process's environment.
    variables = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    try:
        ended = subprocess.run(command, env=variables, capture_output=True, text=True, timeout=LONGEST, cwd=folder)
    except subprocess.TimeoutExpired:
        return f"not finished after {LONGEST:g} s"
    if ended.returncode:
        (folder / f"{out.stem}.log").write_text(ended.stderr)
        return next(iter(reversed(ended.stderr.strip().splitlines())), f"exit status {ended.returncode}")
    return ""


def make_environment(requirements: Path, environments: Path) -> tuple[Path, str]:
    """Create an environment if missing; return its Python and a one-line reason for failure, or an empty string."""
    place = environments / requirements.stem
    python, made = place / "bin" / "python", place / "made_of.txt"
    if made.exists() and made.read_bytes() == requirements.read_bytes():
        return python, ""
    venv.create(place, with_pip=True, clear=True)
    # Isaac Lab 3 and BAM ask for Python 3.12; what is used of them also runs on 3.11.
    options = ["--quiet", "--no-deps", "--ignore-requires-python"]
    command = [str(python), "-m", "pip", "install", *options, "-r", str(requirements)]
    ended = subprocess.run(command, capture_output=True, text=True)
    if ended.returncode:
        return python, f"no environment: {next(iter(reversed(ended.stderr.strip().splitlines())), 'pip failed')}"
    made.write_bytes(requirements.read_bytes())
    return python, ""


def compare(fitted: Identified, path: Path, written: Written, of: Program) -> dict[str, Any]:
    """Compare a program's simulation of the exported files with frictionzoo's simulation of the drive."""
    assert written.export is not None
    with np.load(path, allow_pickle=False) as file:
        came, program = file["qpos"], str(file["program"])
    promised = written.export.differences[0]
    reason = ", ".join(filter(None, (promised.reason, of.lacks)))
    found = measure("qpos", fitted, came, fitted.rollout()[0], reason=reason)
    if promised.quantity == "qpos" and not of.lacks and not found.mean <= 2 * promised.mean:
        found = replace(found, reason=f"the export's own difference is {promised.mean:.2g}: the program does otherwise")
    note = "; ".join(filter(None, (written.mark(found), of.unrun)))
    return {
        **{"program": program, "largest": found.largest, "mean": found.mean, "error": written.error},
        **{"share": written.share(found), "note": note or None},
    }


if __name__ == "__main__":
    main()
