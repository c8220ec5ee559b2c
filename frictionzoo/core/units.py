"""Dimensions of physical quantities: their units, and their typical values on a bench."""

_UNITS = {
    "position": ("rad", "m"),
    "velocity": ("rad/s", "m/s"),
    "torque": ("N m", "N"),
    "inertia": ("kg m^2", "kg"),
    "damping": ("N m s/rad", "N s/m"),
    "damping/velocity": ("N m s^2/rad^2", "N s^2/m^2"),
    "damping/velocity^2": ("N m s^3/rad^3", "N s^3/m^3"),
    "stiffness": ("N m/rad", "N/m"),
    "1/velocity": ("s/rad", "s/m"),
    "1/position": ("1/rad", "1/m"),
    "1/torque": ("1/(N m)", "1/N"),
    "torque/command": ("N m/(unit of ctrl)", "N/(unit of ctrl)"),
    "torque/voltage": ("N m/V", "N/V"),
    "temperature": ("K", "K"),
    "1/temperature": ("1/K", "1/K"),
    "time": ("s", "s"),
    "1": ("1", "1"),
}
DIMENSIONS = tuple(_UNITS)
"""Names of the dimensions."""
UNITS: dict[str, dict[str, str]] = {
    joint_type: {dimension: units[at] for dimension, units in _UNITS.items()}
    for at, joint_type in enumerate(("hinge", "slide"))
}
"""Unit of each dimension on a hinge (rotation) and on a slide (translation)."""

TYPICAL = {
    "position": "${mul:%s,${scale.velocity}}",  # of 1 s
    "velocity": "${mul:%s,${scale.velocity}}",
    "torque": "${mul:%s,${scale.torque}}",
    "inertia": "${mul:%s,${scale.inertia}}",
    "damping": "${mul:%s,${scale.damping}}",
    "damping/velocity": "${mul:%s,${div:${scale.damping},${scale.velocity}}}",
    "damping/velocity^2": "${mul:%s,${div:${scale.damping},${mul:${scale.velocity},${scale.velocity}}}}",
    "stiffness": "${mul:%s,${div:${scale.torque},${scale.velocity}}}",  # typical torque over the position above
    "1/velocity": "${div:%s,${scale.velocity}}",
    "1/position": "${div:%s,${scale.velocity}}",
    "1/torque": "${div:%s,${scale.torque}}",
}
"""Multiple of a bench's typical value of a dimension, in a configuration; other dimensions have SI units there."""
