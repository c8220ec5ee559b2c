"""Model files for MuJoCo, loaded like a user loads them, and compared with the identified drive."""

from dataclasses import dataclass
from typing import Literal, cast

import mujoco
import numpy as np

from frictionzoo.bench.delay import is_filtered, stretch
from frictionzoo.core.params import UNITS
from frictionzoo.export.base import measure
from frictionzoo.export.nearest import Nearest
from frictionzoo.export.simulate import Place, run_loaded
from frictionzoo.export.written import Difference
from frictionzoo.result.evaluate import Prediction
from frictionzoo.result.fitted_drive import FittedDrive
from frictionzoo.result.names import name_some
from frictionzoo.result.run_types import WrittenRow
from frictionzoo.result.simulator import RK4

EXACT = 1e-9
"""Largest position difference that counts as rounding [rad or m]."""


@dataclass(frozen=True)
class ModelFile:
    """A model file with the drive.

    Attributes:
        timestep: Time step of the loaded model [s].
        difference: Position difference from the identified drive; None if the file was not run, see `limits`.
        limits: Limits of the file and remarks for users, a sentence each.
        notes: Remarks that hold only on this machine, a sentence each; the file and `result.json` do not have them.
    """

    name: str
    content: bytes
    timestep: float
    difference: Difference | None
    limits: tuple[str, ...]
    notes: tuple[str, ...] = ()

    def describe(self, fitted: FittedDrive) -> WrittenRow:
        """Return its entry in `result.json`."""
        difference, error = self.difference, read_error(fitted)
        return {
            "file": self.name,
            "timestep": self.timestep,
            "mean": difference and difference.mean,
            "largest": difference and difference.largest,
            "unit": cast(Literal["rad", "m"], UNITS[fitted.bench.joint_type]["position"]),
            "share": difference.mean / error if difference and error else None,
            "exact": difference is not None and difference.largest <= EXACT,
            "over": difference.over if difference else "",
            "reason": difference.reason if difference else "",
            "limits": list(self.limits),
        }


def play(
    model: mujoco.MjModel, fitted: FittedDrive, expected: Prediction, why: list[str], place: Place | None = None
) -> tuple[Difference | None, tuple[str, ...]]:
    """Run a loaded model over the long test rollouts, and compare it with the drive's rollouts.

    Payloads are added to `model`. `why` lists reasons for a difference. Without `place`, the model is the bench's MJCF.

    Returns:
        The position difference; or None, and a sentence with the reason.
    """
    stable = ~expected.diverged
    if not stable.any():
        return None, (f"It is not compared with the fitted drive, which diverges in all of its {fitted.over}.",)
    qpos = run_loaded(model, fitted, place)
    diverged = stable & ~np.isfinite(qpos).all(axis=(1, 2))
    if diverged.any():
        return None, (f"As loaded, it diverges in {diverged.sum()} of {fitted.over}: do not use it.",)
    over = None if stable.all() else f"{stable.sum()} of {fitted.over}, in which the drive does not diverge"
    return measure("qpos", fitted, qpos[stable], expected.qpos[stable], over, ", ".join(why)), ()


def is_clipped(model: mujoco.MjModel, fitted: FittedDrive, place: Place) -> bool:
    """Return whether the model's actuators clip the recorded commands."""
    actuator, signals = fitted.bench.actuator, fitted.segments.signals
    if actuator.needs_state:
        return False
    command = actuator.combine(fitted.values["bench"], signals.ctrl, signals.inputs)
    low, high = model.actuator_ctrlrange[place.actuator].T
    return bool((model.actuator_ctrllimited[place.actuator] & ((command < low) | (command > high))).any())


def read_error(fitted: FittedDrive) -> float | None:
    """Return the drive's mean absolute position error in its held-out rollouts; None if there is none."""
    return fitted.result["metrics"]["test"]["position_mae"]


def say_difference(fitted: FittedDrive, difference: Difference) -> str:
    """Describe the difference of a file from the drive, for the file's comment."""
    prefix = f"Loaded unchanged in MuJoCo and played under held-out commands ({difference.over}):"
    if difference.largest <= EXACT:
        return f"{prefix} the identified drive is represented exactly, positions within {EXACT:g} {difference.unit}."
    error = read_error(fitted)
    share = f" ({100 * difference.mean / error:.2g} % of the drive's own test error)" if error else ""
    reason = f": {difference.reason}" if difference.reason else ""
    return (
        f"{prefix} its positions differ from the identified drive's by {difference.mean:.3g} {difference.unit} in the "
        f"mean{share} and {difference.largest:.3g} {difference.unit} at most{reason}."
    )


def list_lacks(fitted: FittedDrive, nearest: Nearest, timestep: float) -> list[str]:
    """List the differences of a file with this time step [s] from the drive, in a few words each."""
    lacks = [nearest.lacks] if nearest.lacks else []
    if say_delay(fitted, timestep):
        lacks.append("a delay below one step is a filter")
    continuous = fitted.is_simulated
    drive_timestep = fitted.origin.timestep if fitted.origin is not None and not continuous else fitted.timestep
    if not np.isclose(timestep, drive_timestep, rtol=1e-6):
        lacks.append(f"steps of {timestep:g} s in place of {drive_timestep:g} s")
    elif continuous:
        lacks.append(f"steps of {timestep:g} s in place of continuous time")
    return lacks


def say_delay(fitted: FittedDrive, timestep: float) -> list[str]:
    """Describe the delays that become filters with this time step [s]; empty if none does."""
    delays = fitted.values["bench"].get("delay", np.empty(0))
    if fitted.bench.actuator.needs_state:  # the caller delays the commands
        return []
    delays = stretch(delays, timestep) if fitted.integrator == RK4 else delays
    joint_delays = zip(fitted.bench.joints, map(float, delays), strict=False)
    filtered = [(joint, delay) for joint, delay in joint_delays if is_filtered(delay, timestep)]
    if not filtered:
        return []
    joints = "" if len(filtered) == fitted.bench.nv else f" of {name_some([joint for joint, _ in filtered])}"
    listed = ", ".join(dict.fromkeys(f"{delay:.4g}" for _, delay in filtered))
    return [
        f"MuJoCo's actuators delay commands by one step or more: the delay of {listed} s{joints} is a filter with the "
        f"same lag in steps of {timestep:g} s. Its `act` begins at 0: set `act` to `ctrl` where a simulation is reset."
    ]
