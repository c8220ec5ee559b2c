"""Diagnostics of declared units: do they suit the bench's joints and actuators?"""

from collections.abc import Iterator

from frictionzoo.bench import Bench
from frictionzoo.core.log import Dataset
from frictionzoo.diagnostics.findings import Finding

UNITS = {
    **dict.fromkeys(("rad", "mrad", "deg", "rev"), "hinge"),
    **dict.fromkeys(("m", "mm", "um"), "slide"),
    **dict.fromkeys(("Nm", "mNm", "N", "A", "mA", "V", "mV"), "effort"),
}
"""Quantity of each unit; other units, such as the factor of a raw register, are not checked."""
MEANS = {"hinge": "angles", "slide": "lengths"}


def check_declared(dataset: Dataset, bench: Bench, to_position: bool) -> Iterator[Finding]:
    """Find lengths on a hinge, angles on a slide, and commands that the actuator law does not accept."""
    unit: dict[str, str] = {}
    for log in dataset.logs:
        unit |= log.units
    joints = ", ".join(bench.joints[:3]) + (", ..." if bench.nv > 3 else "")
    for signal in ("qpos", "ctrl"):
        kind = UNITS.get(unit.get(signal, "").replace(" ", ""))
        if kind in MEANS and (signal == "qpos" or to_position) and kind != bench.joint_type:
            yield Finding(
                f"declared {signal}",
                True,
                f"{dataset.name}: {signal} is in {unit[signal]}, expected {MEANS[bench.joint_type]} for {joints} of "
                f"{bench.source}, a {bench.joint_type}; choose the bench of these recordings (bench=NAME, or "
                f"bench.mjcf and bench.joint), or set data.units.{signal}",
            )
        elif signal == "ctrl" and kind is not None and (kind != "effort") != to_position:
            law = type(bench.actuator).__name__
            wanted = "a desired position" if to_position else "a torque, force or current"
            yield Finding(
                "declared ctrl",
                True,
                f"{dataset.name}: ctrl is in {unit[signal]}, expected {wanted} for {law} of {bench.source}; choose the "
                "bench of these recordings (bench=NAME) or its actuator (bench.actuator._target_), or set "
                "data.units.ctrl",
            )
