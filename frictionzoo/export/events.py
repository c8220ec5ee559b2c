"""Files with events that randomise an identified drive in mjlab and Isaac Lab."""

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from frictionzoo.core.errors import ConfigError
from frictionzoo.core.templates import Code
from frictionzoo.export.base import match_joint
from frictionzoo.export.module import render
from frictionzoo.export.variants import Quantity
from frictionzoo.result.fitted_drive import FittedDrive

OPERATIONS = ("abs", "scale")
GAINS = ("actuator.stiffness", "actuator.damping")
FRICTION = ("joint.static_friction", "joint.frictionloss", "joint.damping")
_ENTITY = "Set ENTITY and JOINTS to the names in your scene."
_MEANING = (
    "A 95 % interval says how well these recordings fix a value of this law on this unit. Other units, payloads, "
    "temperatures and days are not in it: export with ranges= that hold them."
)


@dataclass(frozen=True)
class Program:
    """A simulator with events, and its name of each quantity, in the order of the changes."""

    file: str
    template: str
    fields: Mapping[str, str]


MJLAB = Program(
    "mjlab_events.py",
    "mjlab_events.py.jinja",
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
    "isaaclab_events.py.jinja",
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
    return render(
        program.template,
        about=textwrap.fill(f"{_MEANING} {_ENTITY}", 110),
        origin={"run": fitted.place, "model": fitted.model.name, "data": fitted.result["data"]["name"]},
        joints={name: match_joint(name) for name in joints},
        delays=delays,
        timestep=f"{fitted.timestep:g}",
        count=len(quantities[0].values),
        changes=[line for name in varied for line in _list_changes(program.fields[name], available[name], fitted)],
        operation=operation,
        cells={name: _list_cells(quantity, joints, operation) for name, quantity in available.items()},
        varied=varied,
        static="joint.static_friction" if "joint.static_friction" in available else "joint.frictionloss",
        friction=[name for name in FRICTION if name in varied],
        gains=[name for name in GAINS if name in varied],
    )


def _list_changes(field: str, quantity: Quantity, fitted: FittedDrive) -> Iterator[str]:
    for joint, name in enumerate(fitted.bench.joints):
        if why := quantity.why[joint]:
            low, high = quantity.ends[joint]
            yield f"{field} [{quantity.unit}] of {name}: {low:.4g} to {high:.4g}, {why} in {fitted.place}"


def _list_cells(quantity: Quantity, joints: Sequence[str], operation: str) -> list[Cell]:
    cells = []
    for joint, name in enumerate(joints):
        nominal, why = quantity.nominal[joint], quantity.why[joint]
        low, high = quantity.ends[joint]
        unit = quantity.unit if why else f"{quantity.unit}, known"  # the reasons for the ranges are in CHANGES
        if operation == "scale":
            if why and nominal == 0:
                raise ConfigError(
                    f"operation=scale: {quantity.name} of {name} is 0, expected one to take shares of; take abs"
                )
            low, high = (low / nominal, high / nominal) if why else (1.0, 1.0)
            unit = f"of {nominal:.6g} {unit}"
        cells.append(Cell(name, Code(f"{low:.6g}"), Code(f"{high:.6g}"), Code(unit), bool(why)))
    return cells
