"""Parameter files of Rhoban's BAM, read as values of a bench and a friction model.

`python -m frictionzoo.bench.read_bam FILE.json` prints them as options of a run:

    python -m frictionzoo.run data=sts3215 $(python -m frictionzoo.bench.read_bam FILE.json)
"""

import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from frictionzoo.core.errors import ConfigError, FrictionzooError, closest
from frictionzoo.core.telling import Parser, escape_controls, say

_M1 = {"friction_base": "frictionloss", "friction_viscous": "damping"}
_M2 = _M1 | {
    "friction_stribeck": "stribeck_torque",
    "dtheta_stribeck": "stribeck_velocity",
    "alpha": "stribeck_exponent",
}
_M3 = _M1 | {"load_friction_base": "load_friction"}
_M5 = _M2 | {
    "load_friction_motor": "load_friction_motor",
    "load_friction_external": "load_friction_external",
    "load_friction_motor_stribeck": "stribeck_load_friction_motor",
    "load_friction_external_stribeck": "stribeck_load_friction_external",
}
_M6 = _M5 | {
    "load_friction_motor_quad": "quadratic_load_friction_motor",
    "load_friction_external_quad": "quadratic_load_friction_external",
}
LAWS: Mapping[str, tuple[str, Mapping[str, str]]] = {
    "m1": ("mujoco_default", _M1),
    "m2": ("stribeck", _M2),
    "m3": ("load_dependent", _M3),
    "m4": ("stribeck_load_dependent", _M2 | _M3 | {"load_friction_stribeck": "stribeck_load_friction"}),
    "m5": ("directional", _M5),
    "m6": ("quadratic", _M6),
}
"""Friction model for each of BAM's, and its parameter for each of BAM's parameters."""
DUTY: Mapping[str, tuple[float, float]] = {
    "mx64": (0.158, 0.9625),
    "mx106": (0.158, 0.9625),
    "xl320": (0.05048199, 1.0),
    "xl330": (0.00246, 1.0),
    "sts3215": (0.166, 0.97),
}
"""Duty cycle per radian of error at unit gain [1/rad] and its limit [1], for each voltage servo of BAM."""
_NEGLIGIBLE = 1e-9  # smallest frictionloss [N m]: at 0 MuJoCo's friction constraint would lock the joint


@dataclass(frozen=True)
class BamDrive:
    """A drive from a BAM parameter file.

    Attributes:
        bam: BAM's name of the friction model, `m1` to `m6`.
        actuator: BAM's name of the servo.
        bench: Values of the parameters of the bench and of `VoltageServo`.
        friction: Values of the parameters of `model`; the others have their defaults.
        remarks: Differences from BAM, a sentence each.
    """

    bam: str
    actuator: str
    bench: Mapping[str, float]
    model: str
    friction: Mapping[str, float]
    remarks: tuple[str, ...]

    def overrides(self) -> list[str]:
        """Return the values as known parameters in options of a run, for a bench with a `VoltageServo`."""
        bench = {f"bench.params.{name}": self.bench[name] for name in ("armature", "delay", "position_offset")}
        actuator = {f"bench.actuator.params.{k}": v for k, v in self.bench.items() if f"bench.params.{k}" not in bench}
        values = bench | actuator | {f"model.params.{name}": value for name, value in self.friction.items()}
        return [f"model={self.model}", "fit=known", *(f"{name}={_known(value)}" for name, value in values.items())]


def read_bam(path: Path) -> BamDrive:
    """Read a parameter file, JSON from BAM's `fit`.

    Raises:
        ConfigError: It is not such a file, or its servo is not driven by voltage.
    """
    data = load_parameters(path)
    bench = read_bench(path, data)
    model, names = LAWS[data["model"]]
    readers = {"dtheta_stribeck": _positive, "alpha": _positive}
    friction = {name: readers.get(bam, _number)(path, data, bam) for bam, name in names.items()}
    friction["frictionloss"] = max(friction["frictionloss"], _NEGLIGIBLE)
    remarks = ()
    if "max_velocity" in data:
        speed = _positive(path, data, "max_velocity")
        remarks = (f"max_velocity: BAM's servo follows commands at {speed:.4g} rad/s at most; here at once.",)
    return BamDrive(data["model"], data["actuator"], bench, model, friction, remarks)


def load_parameters(path: Path) -> dict[str, Any]:
    """Load the content of a parameter file.

    Raises:
        ConfigError: It is not such a file.
    """
    try:
        data = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else f"not JSON ({error})"
        raise ConfigError(f"{path}: {reason}; expected a parameter file of BAM; name one") from None
    if not isinstance(data, dict) or data.get("model") not in list(LAWS) or not isinstance(data.get("actuator"), str):
        raise ConfigError(f"{path}: no model ({', '.join(LAWS)}) and actuator in it; expected a parameter file of BAM")
    return data


def read_bench(path: Path, data: Mapping[str, Any]) -> dict[str, float]:
    """Return values of the parameters of the bench and of `VoltageServo` from a file's content.

    Raises:
        ConfigError: The servo is not driven by voltage, or a value is invalid.
    """
    actuator = data["actuator"]
    if actuator not in DUTY:
        raise ConfigError(f"{path}: actuator={actuator}; {closest(actuator, DUTY)}; others are not voltage servos")
    gain, limit = DUTY[actuator]
    torque_constant, resistance = (_positive(path, data, name) for name in ("kt", "R"))
    return {
        "armature": _positive(path, data, "armature"),
        "delay": _number(path, data, "command_delay", 0.0),
        "position_offset": _number(path, data, "q_offset", 0.0),
        "kt_over_r": torque_constant / resistance,
        "kt2_over_r": torque_constant**2 / resistance,
        "duty_gain": gain * _number(path, data, "error_gain_ratio", 1.0),
        "duty_limit": limit,
    }


def _number(path: Path, data: Mapping[str, Any], name: str, default: float | None = None) -> float:
    value = data.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        problem = "is missing" if value is None else f"is {value}"
        raise ConfigError(f"{path}: {name} {problem}, expected a number for model={data['model']}; fix the file")
    return float(value)


def _positive(path: Path, data: Mapping[str, Any], name: str) -> float:
    value = _number(path, data, name)
    if value <= 0:
        raise ConfigError(f"{path}: {name} is {value:g}, expected a positive number; fix the file")
    return value


def _known(value: float) -> str:
    bound = 2 * abs(value) or 1.0
    low = -bound if value < 0 else 0.0
    return f"{{init:{value!r},low:{low!r},high:{bound!r},scale:1.0,identify:false}}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a file as options of a run; return the exit status, 2 for an invalid input."""
    parser = Parser(
        prog="python -m frictionzoo.bench.read_bam",
        description="Print a BAM parameter file as options of python -m frictionzoo.run.",
    )
    parser.add_argument("file", type=Path, help="JSON, as BAM's fit writes it")
    try:
        drive = read_bam(parser.parse_args(arguments).file)
    except FrictionzooError as error:
        print(f"frictionzoo: {escape_controls(str(error))}", file=sys.stderr)
        return 2
    say(" ".join(drive.overrides()))
    for remark in drive.remarks:
        print(f"frictionzoo: {escape_controls(remark)}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
