"""Target `randomisation`: drives drawn within the uncertainty of the identification, for training a policy."""

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, NamedTuple

import mujoco
import numpy as np

from frictionzoo.bench import Robot
from frictionzoo.core.errors import ConfigError, FrictionzooError
from frictionzoo.core.templates import Code
from frictionzoo.export import isaaclab, mjlab
from frictionzoo.export.base import (
    Deviation,
    Export,
    Target,
    match_joint,
    measure,
    read_choice,
    read_optional,
    register_target,
)
from frictionzoo.export.bench import say_limits, write_bench
from frictionzoo.export.module import render
from frictionzoo.export.motor import INPUTS, LIMITS, read_inputs
from frictionzoo.export.nearest import Nearest, find_nearest, find_nearest_each
from frictionzoo.export.robot import ACTUATORS, put_into
from frictionzoo.export.simulate import run_loaded
from frictionzoo.export.variants import Quantity, draw_variants, list_quantities, read_ranges
from frictionzoo.result.fitted_drive import FittedDrive

SAMPLES, FOLDER, NOMINAL = "samples.npz", "samples", "nominal"
_COUNT, _FILES, _MOST = 256, 8, 100_000
_OFFSETS = ("position_offset", "torque_offset")
_WHOLE = 1e-6  # rounding tolerance, as a share of a step
Drive = tuple[FittedDrive, Nearest]
"""A drive, and the same with MuJoCo's joint friction."""
OPERATIONS = ("abs", "scale")
GAINS = ("actuator.stiffness", "actuator.damping")
FRICTION = ("joint.static_friction", "joint.frictionloss", "joint.damping")
_ABOUT = (
    "A 95 % interval states how well these recordings determine a value of this model on this unit. It excludes other "
    "units, payloads, temperatures and days: export with ranges= for these. Set ENTITY and JOINTS to the names in "
    "your scene."
)


@register_target("randomisation")
class Randomisation(Target):
    """Drives drawn from the identified distribution: samples, MJCF files, and events for mjlab and Isaac Lab.

    Source: mjlab 1.6, `mjlab.envs.mdp.dr`; Isaac Lab 2.3.2 and 3.0.0, `isaaclab.envs.mdp.events`.
    """

    options: ClassVar[Mapping[str, str]] = {
        "ranges": "shares of values that parameters may have, '{bench.armature: [0.8, 1.2]}', or low and high",
        "count": f"drives to draw; default: {_COUNT}",
        "files": f"of these that become MJCF; default: {_FILES}",
        "seed": "of the draws; default: 0",
        "operation": "of ranges in events: abs, in the unit, or scale, as shares",
        **INPUTS,
    }
    packages: ClassVar[tuple[str, ...]] = ("mujoco",)

    def write(self, fitted: FittedDrive, folder: Path, options: Mapping[str, str]) -> Export:
        """See `Target.write`."""
        operation = read_choice(options, "operation", OPERATIONS)
        count = _read_count(options, "count", _COUNT, 2, _MOST)
        number = _read_count(options, "files", min(_FILES, count), 1, count)
        ranges = read_ranges(options["ranges"], fitted) if "ranges" in options else {}
        seed = _read_count(options, "seed", 0, 0, 2**31)
        parameters = draw_variants(fitted, count, seed, ranges)
        draws = [fitted.with_values({one.name: one.values[draw] for one in parameters}) for draw in range(count)]
        nominal, refitted = find_nearest(fitted), find_nearest_each(fitted, draws)
        values, nearest = (fitted.values, *draws), (nominal, *refitted)
        joint_quantities = list_quantities(fitted, parameters, values, nearest, read_inputs(fitted, options))
        quantities, delays = (*parameters, *joint_quantities), _list_delays(fitted, parameters)
        write_samples(folder / SAMPLES, fitted, quantities, seed)
        for program in (MJLAB, ISAAC_LAB):
            text = write_events(program, fitted, quantities, delays, operation)
            compile(text, program.file, "exec")
            (folder / program.file).write_text(text, encoding="utf-8")
        drawn = [replace(fitted, values=of) for of in draws[:number]]
        drives = [(fitted, nominal), *zip(drawn, refitted[:number], strict=True)]
        files, remarks = write_files(folder, drives)
        differences, spread = _run_benches(drives)
        limits = (*say_limits(fitted, nominal), *remarks, spread, *_say(parameters, joint_quantities, delays))
        return Export((SAMPLES, MJLAB.file, ISAAC_LAB.file, *files), differences, limits)


def _read_count(options: Mapping[str, str], name: str, default: int, low: int, high: int) -> int:
    number = read_optional(options, name)
    number = default if number is None else number
    if number != int(number) or not low <= number <= high:
        raise ConfigError(f"{name}={options[name]}; expected a whole number from {low} to {high}; change it")
    return int(number)


def write_samples(path: Path, fitted: FittedDrive, quantities: Sequence[Quantity], seed: int) -> None:
    """Write the drives as plain arrays.

    Each quantity is an array of shape (count, nv) under its name. `joints` lists the nv joints, `names` the quantities
    and `units` their units. `nominal`, `low` and `high`, of shape (quantities, nv), are the values of the fitted drive
    and the ranges. `seed` is the seed of the draws.
    """
    low, high = (np.array([quantity.ends[:, end] for quantity in quantities]) for end in (0, 1))
    arrays = {
        "seed": np.array(seed),
        **{quantity.name: quantity.values for quantity in quantities},
        "joints": np.array(fitted.bench.joints),
        "names": np.array([quantity.name for quantity in quantities]),
        "units": np.array([quantity.unit for quantity in quantities]),
        "nominal": np.array([quantity.nominal for quantity in quantities]),
        **{"low": low, "high": high},
    }
    np.savez_compressed(path, **arrays)  # pyright: ignore[reportArgumentType] - a keyword is a name here


def _list_delays(fitted: FittedDrive, parameters: Sequence[Quantity]) -> dict[str, tuple[int, int]]:
    """Return smallest and largest delay by joint where it varies, rounded outwards to whole steps."""
    delays = {}
    for parameter in parameters:
        for joint, name in enumerate(fitted.bench.joints) if parameter.name == "bench.delay" else ():
            if parameter.why[joint]:
                low, high = parameter.ends[joint] / fitted.timestep
                delays[name] = (int(np.floor(low + _WHOLE)), int(np.ceil(high - _WHOLE)))
    return delays


def write_files(folder: Path, drives: Sequence[Drive]) -> tuple[list[str], tuple[str, ...]]:
    """Write the MJCF of each drive, or the robot's file for a robot; return their names, and remarks."""
    (folder / FOLDER).mkdir()
    fitted, names = drives[0][0], [NOMINAL, *(f"{FOLDER}/{number:03d}" for number in range(len(drives) - 1))]
    benches, suffix, remarks = [write_bench(*drive) for drive in drives], ".xml", tuple[str, ...]()
    contents = [bench.encode() for bench in benches]
    if isinstance(fitted.bench, Robot):
        where = Path(fitted.bench.source), fitted.bench.joints, ACTUATORS[0]
        try:
            robots = [put_into(*where, *drive, bench) for drive, bench in zip(drives, benches, strict=True)]
        except FrictionzooError as error:
            remarks = (f"The files contain only the bench, not the robot: {error}.",)
        else:
            suffix, remarks = ".urdf" if robots[0].urdf else ".xml", robots[0].notes
            contents = [robot.commented().content for robot in robots]
            if b"file=" in robots[0].content or b"filename=" in robots[0].content:
                remarks += (
                    "The robot's files refer to the original's files (meshes): put them in the original's folder.",
                )
    for name, content in zip(names, contents, strict=True):
        (folder / f"{name}{suffix}").write_bytes(content)
    return [f"{name}{suffix}" for name in names], remarks


def _run_benches(drives: Sequence[Drive]) -> tuple[tuple[Deviation, ...], str]:
    fitted = drives[0][0]
    positions = [run_loaded(mujoco.MjModel.from_xml_string(write_bench(*drive)), drive[0]) for drive in drives]
    expected = [fitted.rollout(values=drive.values)[0] for drive, _ in drives]
    drawn, drawn_expected = np.array(positions[1:]), np.array(expected[1:])
    over = f"{len(drawn)} draws of them, each against itself"
    differences = (
        measure("qpos", fitted, positions[0], expected[0], reason=drives[0][1].lacks),
        measure("qpos", fitted, drawn, drawn_expected, over, drives[0][1].lacks),
    )
    unit, error = fitted.units["position"], fitted.result.metrics.test.position_mae
    test_error = "" if error is None else f"; the fitted drive's mean test error is {error:.2g} {unit}"
    return differences, (
        f"Positions of the {len(drawn)} drives in {FOLDER}/ are {drawn.std(axis=0).mean():.2g} {unit} apart (standard "
        f"deviation, mean over {fitted.over}) and {np.ptp(drawn, axis=0).max():.2g} {unit} at most{test_error}."
    )


def _say(parameters: Sequence[Quantity], taken: Sequence[Quantity], delays: Mapping[str, tuple[int, int]]) -> list[str]:
    bench_names = [quantity.name.partition(".")[2] for quantity in parameters if quantity.name.startswith("bench.")]
    in_motor = any(quantity.name == "actuator.stiffness" for quantity in taken)
    missing = [name for name in bench_names if name in _OFFSETS or not (in_motor or name in ("armature", "delay"))]
    missing += [name for quantity in taken if (name := quantity.name.partition(".")[2]) in LIMITS]
    limits = [
        "mjlab and Isaac Lab themselves were not run.",
        "A 95 % interval states how well these recordings determine the values of this model on this unit. It excludes "
        "other units, payloads, temperatures and days: set ranges for these.",
    ]
    if missing:
        limits.append(
            f"Only {SAMPLES} and the MJCF files have {', '.join(missing)}: the programs have no event for them."
        )
    if delays:
        limits.append("The programs draw the delay themselves, in whole steps and independently: DELAYS.")
    return limits


@dataclass(frozen=True)
class Program:
    """A simulator with events, its supported versions, and its name of each quantity, in the order of the changes."""

    file: str
    versions: str
    fields: Mapping[str, str]


MJLAB = Program(
    "mjlab_events.py",
    mjlab.VERSIONS,
    {
        "joint.armature": "dof_armature",
        "joint.frictionloss": "dof_frictionloss",
        "joint.damping": "dof_damping",
        "actuator.stiffness": "kp of the actuator",
        "actuator.damping": "kd of the actuator",
    },
)
ISAAC_LAB = Program(
    "isaaclab_events.py",
    isaaclab.VERSIONS,
    {
        "joint.armature": "armature",
        "joint.static_friction": "static friction",
        "joint.frictionloss": "dynamic friction",
        "joint.damping": "viscous friction",
        "actuator.stiffness": "stiffness of the actuator",
        "actuator.damping": "damping of the actuator",
    },
)


class Cell(NamedTuple):
    """Range of a quantity in a joint, in its unit or as shares; for shares, `unit` has the reference value."""

    joint: str
    low: Code
    high: Code
    unit: Code
    varies: bool


def write_events(
    program: Program,
    fitted: FittedDrive,
    quantities: Sequence[Quantity],
    delays: Mapping[str, tuple[int, int]],
    operation: str,
) -> str:
    """Write the file of a simulator; quantities that the simulator does not have are ignored.

    `delays` has smallest and largest delay [steps] by joint, where the delay varies; `operation` is one of
    `OPERATIONS`.

    Raises:
        ConfigError: The operation is `scale`, and a quantity is 0.
    """
    joints = fitted.bench.joints
    available = {quantity.name: quantity for quantity in quantities if quantity.name in program.fields}
    varied = [name for name in program.fields if name in available and any(available[name].why)]
    changes = [
        f"{program.fields[name]} [{available[name].unit}] of {joint}: {low:.4g} to {high:.4g}, {why} in {fitted.place}"
        for name in varied
        for joint, (low, high), why in zip(joints, available[name].ends, available[name].why, strict=True)
        if why
    ]
    return render(
        f"{program.file}.jinja",
        versions=program.versions,
        about=textwrap.fill(_ABOUT, 110),
        origin={"run": fitted.place, "model": fitted.model.name, "data": fitted.result.data.name},
        joints={name: match_joint(name) for name in joints},
        delays=delays,
        timestep=f"{fitted.timestep:g}",
        count=len(quantities[0].values),
        changes=changes,
        fields=program.fields,
        operation=operation,
        cells={name: _list_cells(quantity, joints, operation) for name, quantity in available.items()},
        varied=varied,
        static="joint.static_friction" if "joint.static_friction" in available else "joint.frictionloss",
        friction=[name for name in FRICTION if name in varied],
        gains=[name for name in GAINS if name in varied],
    )


def _list_cells(quantity: Quantity, joints: Sequence[str], operation: str) -> list[Cell]:
    cells, columns = [], zip(joints, quantity.nominal, quantity.ends, quantity.why, strict=True)
    for name, nominal, (low, high), why in columns:
        unit = quantity.unit if why else f"{quantity.unit}, known"  # the reasons for the ranges are in CHANGES
        if operation == "scale":
            if why and nominal == 0:
                raise ConfigError(f"operation=scale: {quantity.name} of {name} is 0, expected another value; use abs")
            low, high = (low / nominal, high / nominal) if why else (1.0, 1.0)
            unit = f"of {nominal:.6g} {unit}"
        cells.append(Cell(name, Code(f"{low:.6g}"), Code(f"{high:.6g}"), Code(unit), bool(why)))
    return cells
