"""Export of a run's drive to one program or to all, with a note of its accuracy."""

import json
import platform
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from frictionzoo import __version__
from frictionzoo.core.errors import ConfigError, ExportError, FrictionzooError, OutputError, closest
from frictionzoo.core.output import take_place, to_json, write_atomically, write_json
from frictionzoo.core.telling import align, escape_all, tell
from frictionzoo.export.base import Export, Written, get_target, read_optional, target_names
from frictionzoo.result.fitted_drive import FittedDrive
from frictionzoo.result.names import name_some
from frictionzoo.result.simulator import RK4, find_limited

NOTE = "export.json"
ALL = "all"
COMMON = ("target", "timestep", "integrator", "output")
_DISTRIBUTIONS = {"pxr": "usd-core"}  # of packages that pip installs under another name


def write_exports(folder: Path, options: Mapping[str, str]) -> list[Written]:
    """Write the targets that `options` request from the run in a folder.

    Options are `target`, a name or `all`; `timestep` [s] and `integrator` of the simulator; `output`, a folder; and
    options of the target, all as text.

    Returns:
        One entry for each target. With `all`, also for targets that cannot represent this drive or lack a package.

    Raises:
        FrictionzooError: An option is invalid, the run cannot be read, or the single target cannot represent the drive.
    """
    names = _choose(options)
    fitted = _in_simulator(FittedDrive.load(folder), options)
    output = Path(options.get("output", folder / "export"))
    if options["target"] != ALL:
        place = output if "output" in options else output / names[0]
        return [_write(fitted, names[0], place, options)]
    written = []
    for name in names:
        try:
            written.append(_write(fitted, name, output / name, options))
        except OutputError:
            raise
        except FrictionzooError as error:
            written.append(Written(name, reason=str(error)))
    return written


def summarise_exports(written: Sequence[Written]) -> str:
    """Return a table with a row for each comparison, then the limits of each target and the folders of the files."""
    rows: list[Sequence[str]] = [("target", "compared", "over", "largest difference", "mean", "error", "limits", "")]
    limits, reasons = list[str](), list[str]()
    for one in written:
        if one.export is None:
            rows.append((one.target, *5 * ("",), "not written", ""))
            reasons.append(f"{one.target}: nothing written: {one.reason}")
            continue
        limits += [f"{one.target}: {limit}" for limit in one.export.limits]
        for difference in one.export.differences:
            sizes = difference.largest, difference.mean, difference.error
            shown = ("" if size is None else f"{size:.2g}" for size in sizes)
            compared = one.target, f"{difference.quantity} [{difference.unit}]", difference.over
            rows.append((*compared, *shown, str(len(one.export.limits) or "none"), one.mark(difference)))
    files = [f"files: {one.folder}" for one in written if one.folder]
    return "\n\n".join("\n".join(block) for block in ([align(rows)], *escape_all([limits, reasons, files])) if block)


def export_to(drive: FittedDrive, target: str, path: Path, options: Mapping[str, Any]) -> Written:
    """Write a drive for one program.

    `path` is a folder; or a file, which is replaced by the target's only file with this extension. `options` are
    `timestep` [s] and `integrator` of the simulator, and options of the target; other values than text are converted
    to the text of the command line.

    Raises:
        FrictionzooError: An option is invalid, the target cannot represent the drive, or has no such file.
    """
    asked = {name: value if isinstance(value, str) else json.dumps(to_json(value)) for name, value in options.items()}
    asked["target"] = target
    (name, *others) = _choose(asked)
    if others:
        raise ConfigError(f"target={target}; expected one target; {closest(target, target_names())}")
    drive = _in_simulator(drive, asked)
    if not path.suffix:
        return _write(drive, name, path, asked)
    with tempfile.TemporaryDirectory() as scratch:
        written = _write(drive, name, Path(scratch, name), asked)
        files = written.export.files if written.export else ()
        matching = [file for file in files if file.endswith(path.suffix)]
        if len(matching) != 1:
            raise ConfigError(f"{path}: target={name} writes {', '.join(files)}; expected a folder, or one's ending")
        write_atomically(path, Path(scratch, name, matching[0]).read_bytes())
    return replace(written, folder=path.parent)


def _choose(options: Mapping[str, str]) -> list[str]:
    if "target" not in options:
        raise ConfigError(f"target is missing; give target=NAME, {closest('', [*target_names(), ALL])}")
    asked, existing = options["target"], target_names()
    if asked not in (*existing, ALL):
        raise ConfigError(f"target={asked}: no such target; {closest(asked, [*existing, ALL])}")
    names = existing if asked == ALL else [asked]
    allowed = {*COMMON, *(option for name in names for option in get_target(name).options)}
    for option in options:
        if option not in allowed:
            raise ConfigError(f"{option}: unknown option of target={asked}; {closest(option, allowed)}")
    return names


def _in_simulator(fitted: FittedDrive, options: Mapping[str, str]) -> FittedDrive:
    """Return the drive for the requested simulator, by default with the time step of its model file."""
    timestep, integrator = read_optional(options, "timestep"), options.get("integrator")
    if timestep is None and integrator is None and (fitted.origin is not None or not fitted.bench.second_order):
        return fitted
    return fitted.at(timestep, integrator)


def _write(moved: FittedDrive, name: str, place: Path, options: Mapping[str, str]) -> Written:
    target = get_target(name)()
    for package in target.packages:
        if find_spec(package) is None:
            missing = _DISTRIBUTIONS.get(package, package)
            raise ExportError(f"target={name}: {missing} is not installed; pip install {missing}")
    if moved.integrator not in target.integrators:
        raise ConfigError(
            f"integrator={moved.integrator}: target={name} takes {' or '.join(target.integrators)}; change it, "
            "or write target=mjcf"
        )
    if target.instant and moved.model.memory:
        raise ExportError(
            f"target={name}: {moved.model.name} has memory, expected a model without memory; use "
            "target=mujoco or mjx, whose modules have memory, or fit another model"
        )
    if "mujoco" in target.packages:
        moved.proof  # noqa: B018 - raises where MuJoCo would simulate something else than what was fitted
    target_options = {option: value for option, value in options.items() if option in target.options}
    tell(f"export to {name}: writing and checking")
    with take_place(place, "export", [NOTE]) as fresh:
        export = target.write(moved, fresh, target_options)
        export = replace(export, limits=(*export.limits, *_say_simulator(moved)))
        written = Written(name, place, export, error=moved.result.metrics.test.position_mae)
        write_json(fresh / NOTE, to_json(_note(moved, written, export, target.packages)))
    return written


def _say_simulator(moved: FittedDrive) -> list[str]:
    origin, step, integrator = moved.origin, moved.timestep, moved.integrator
    if origin is None or (np.isclose(origin.timestep, step, rtol=1e-6) and not moved.is_simulated):
        return []
    qpos, unit = moved.rollout()[0], moved.units["position"]
    distance = np.abs(qpos - moved.predict_origin().qpos)
    gap = f"by {distance.mean():.2g} {unit} on average and {distance.max():.2g} {unit} at most, over {moved.over}"
    if not moved.is_simulated:
        fitted = f"those of {origin.timestep:g} s with which it was fitted"
        return [f"In steps of {step:g} s the drive moves differently than in {fitted}: {gap}."]
    error, continuous_error = (
        f"{np.abs(errors).mean():.2g} {unit}" for errors in (moved.find_errors(qpos), moved.find_residual())
    )
    parameters = f"Parameters are those for steps of {step:g} s with the integrator {integrator}"
    if integrator == RK4:
        return [
            f"{parameters}: those of continuous time, with a softer solreffriction. In continuous time the mean error "
            f"under held-out commands is {continuous_error}."
        ]
    remarks = [
        f"{parameters}, and others for other steps. In these the drive moves differently than in continuous time: "
        f"{gap}. Its mean error under held-out commands is {error}, in continuous time {continuous_error}."
    ]
    if limited := find_limited(moved.values, origin.values):
        joints = name_some([moved.bench.joints[joint] for joint in limited])
        remarks.append(f"For {joints} an armature cannot be as small as such steps need: take shorter ones.")
    return remarks


def _note(fitted: FittedDrive, written: Written, export: Export, packages: Sequence[str]) -> dict[str, object]:
    names = metadata.packages_distributions()
    versions = {package: metadata.version(names.get(package, [package])[0]) for package in packages}
    return {
        "target": written.target,
        "run": str(fitted.folder.resolve()) if fitted.folder else None,
        "model": fitted.result.model,
        "joints": list(fitted.bench.joints),
        "timestep": fitted.timestep,
        "files": list(export.files),
        "error": written.error,
        "differences": [asdict(difference) | {"mark": written.mark(difference)} for difference in export.differences],
        "limits": list(export.limits),
        "versions": {"python": platform.python_version(), "frictionzoo": __version__, **versions},
    }
