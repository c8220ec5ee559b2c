"""Whether a fit identified the drive at all, and what its numbers are to be compared with."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from frictionzoo.core.params import UNITS, Param
from frictionzoo.result.names import name_some, name_where, say_bounds
from frictionzoo.result.types import ParameterRow, ReferenceRow, Result

BOUNDS = 2  # identified parameters at bounds from which on that is doubted
LITTLE = 1 / 3  # of the test error without friction; a law that identifies a drive leaves less
NOTHING = 2 / 3  # of that error; a law that leaves more explains next to nothing
FAR = 20.0  # times from where it began, at which an identified value of the bench is told
_SIZES = {UNITS[joint][of] for joint in UNITS for of in ("torque", "damping")}
LATE = 0.1  # share of the iterations, the last ones, in which a parameter may not move
MOVING = 1 / 3  # of half its interval, by which it moves then
MOVING_BLINDLY = 0.01  # of its value, where it has no interval


def explain_failure(result: Result) -> list[str] | None:
    """Why a fit did not identify the drive, and the likely reasons, the likeliest first; None where it may have.

    It did not if several parameters ended at a bound and the test error is still more than a third of that without
    friction: then the law makes up for something else with values that no drive has. What ended at the lower bound of a
    friction's size is simply not there: a drive without dry friction is a drive.
    """
    ended = [name_where(p, at_bound=True) for p in result["parameters"] if p["at_bound"] and not _is_absent(p)]
    error, without = (result["metrics"][part]["position_mae"] for part in ("test", "baseline"))
    gained_little = error is None or (without is not None and error > LITTLE * without)
    if len(ended) < BOUNDS or not gained_little:
        return None
    share = "cannot be told" if error is None or not without else f"is {100 * error / without:.0f} % of no friction's"
    return [
        f"{' and '.join(ended)} ended at their bounds, and the test error {share}",
        *result["warnings"],
        "what is taken as known is not so: the actuator's gains, the MJCF's inertia and gravity, the recordings' units",
        "commands act late, which bench.params.delay would find",
        "the recordings do not excite the drive, or the bounds are not those of this drive",
    ]


def _is_absent(parameter: ParameterRow) -> bool:
    """Whether it is the size of a part of the friction, a torque or a damping, and the fit found that there is none."""
    if parameter["owner"] != "friction" or parameter["unit"] not in _SIZES:
        return False
    ended = [row for row in parameter["by_joint"] if row["at_bound"]]
    return all(row["value"] - row["low"] < row["high"] - row["value"] for row in ended)


def doubt_gain(result: Result) -> str | None:
    """That a law explains next to nothing of what a drive without friction leaves; None where it explains more."""
    error, without = (result["metrics"][part]["position_mae"] for part in ("test", "baseline"))
    if result["model"] == "baseline" or error is None or not without or error <= NOTHING * without:
        return None
    return (
        f"on test data the position error is {100 * error / without:.0f} % of that without friction: the law explains "
        "next to nothing, or the recordings or the bench are not what they are taken for"
    )


def doubt_joints(result: Result) -> str | None:
    """Which joints of several the law does not improve on test data; None where it improves all of them."""
    joints = result["by_joint"]
    if result["model"] == "baseline" or len(joints) == 1:
        return None
    worse = []
    for joint in joints:
        error, without = (joint[part]["position_mae"] for part in ("test", "baseline"))
        if error is not None and without and error >= without:
            worse.append(f"{joint['joint']} (+{100 * (error / without - 1):.0f} %)")
    if not worse:
        return None
    return (
        f"on test data {len(worse)} of {len(joints)} joints {'is' if len(worse) == 1 else 'are'} no better than "
        f"without friction: {name_some(worse)}"
    )


def doubt_sizes(
    params: Mapping[str, Param], values: Mapping[str, Float[np.ndarray, "nv"]], joints: Sequence[str], unit: str
) -> list[str]:
    """Identified values of a bench, on a `hinge` or `slide`, of another size than a user expected, a sentence each."""
    doubts = []
    for name, param in params.items():
        if not param.is_identified or param.scale != "log":
            continue
        found = np.ravel(values[name])
        began = param.each("init", len(found))
        times = np.exp(np.abs(np.log(found / began)))
        joint = int(times.argmax())
        if times[joint] > FAR:
            of = f" of {joints[joint]}" if len(found) > 1 else ""
            moved = f"from {began[joint]:g} to {found[joint]:.4g} {param.unit(unit)}, {times[joint]:.2g} times"
            doubts.append(
                f"bench.{name}{of} went {moved}: look at the units of time, qpos and ctrl (data.units) and at the "
                f"bench's gains, or begin elsewhere (bench.params.{name}.init)"
            )
    return doubts


def list_moving(
    history: Mapping[str, Float[np.ndarray, "iterations"]], intervals: Mapping[str, Float[np.ndarray, "2"]]
) -> list[str]:
    """Names of the parameters that still moved when the fit ended.

    The means over the two halves of the last tenth of the iterations differ by more than a third of the half width of
    the parameter's 95 % interval, or by 1 % of its value where it has none.

    Args:
        history: Its values by the parameter's label, `bench.armature`, of several joints `bench.armature/knee`.
        intervals: By label.
    """
    moving = []
    for name, values in history.items():
        half = int(LATE * len(values)) // 2
        if not half:
            continue
        before, last = values[-2 * half : -half].mean(), values[-half:].mean()
        width = MOVING * np.ptp(intervals.get(name, np.full(2, np.nan))) / 2
        if abs(last - before) > (width if np.isfinite(width) else MOVING_BLINDLY * abs(last)):
            moving.append(name)
    return moving


def doubt_reference(parameters: Sequence[ParameterRow | ReferenceRow]) -> str | None:
    """That the drive without friction, by which others are judged, is none by its parameters; None where it may be."""
    ended = [
        f"{name_where(p, at_bound=True)} at its bound of {say_bounds(p)} {p['unit']}"
        for p in parameters
        if p["at_bound"]
    ]
    if not ended:
        return None
    return f"the drive without friction ended with {' and '.join(ended)}: a change against its error says little"
