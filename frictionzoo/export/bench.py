"""The bench's MJCF with MuJoCo's joint friction, and its limits."""

from collections.abc import Sequence

import numpy as np

from frictionzoo.bench.delay import is_filtered, stretch
from frictionzoo.export.base import list_values
from frictionzoo.export.in_place import InPlace
from frictionzoo.export.nearest import Nearest, say_law
from frictionzoo.export.robot import set_option, write_late
from frictionzoo.export.simulate import PAYLOADS
from frictionzoo.result.fitted_drive import FittedDrive
from frictionzoo.result.names import name_some
from frictionzoo.result.simulator import RK4


def write_bench(fitted: FittedDrive, nearest: Nearest, remarks: Sequence[str] = ()) -> str:
    """Return the bench's MJCF with these values and the drive's time step, with remarks as comments."""
    loss = nearest.frictionloss if nearest.frictionloss.any() else None  # a constraint of 0 has no effect
    comments, delays = (nearest.remark or say_law(fitted.model), *remarks), write_late(fitted, nearest, fitted.timestep)
    text = fitted.bench.mjcf({**nearest.bench, **delays}, loss, nearest.damping, comments, limited=True)
    if fitted.integrator == fitted.bench.integrator:
        return text
    file = InPlace.read(text.encode())
    set_option(file, fitted)
    return file.write().decode()


def say_limits(fitted: FittedDrive, nearest: Nearest, timestep: float | None = None) -> tuple[str, ...]:
    """List the limits of an MJCF with the drive, for this time step [s] or the drive's."""
    law, limits = fitted.bench.actuator, [nearest.remark] if nearest.remark else []
    limits += say_delay(fitted, fitted.timestep if timestep is None else timestep)
    if not law.needs_state and any(np.any(fitted.segments.signals.inputs[name]) for name in fitted.sampling.commands):
        limits.append("`ctrl` is the command plus (kd ctrl_velocity + ctrl_torque) / kp, as in the recordings.")
    if law.needs_state:
        delay = (
            f", from commands delayed by {list_values(fitted.values['bench']['delay'])} s"
            if "delay" in fitted.bench.params
            else ""
        )
        limits.append(
            f"MuJoCo's actuator has no {type(law).__name__}: `ctrl` is the controller's output, which the caller "
            f"computes in each step{delay}, as in the comparison above; target=mujoco writes the code."
        )
    if fitted.bench.payload is not None:
        limits.append(PAYLOADS)
    return tuple(limits)


def list_lacks(fitted: FittedDrive, nearest: Nearest, timestep: float) -> list[str]:
    """List the differences of a file with this time step [s] from the drive, in a few words each."""
    lacks = [nearest.lacks] if nearest.lacks else []
    if say_delay(fitted, timestep):
        lacks.append("a delay below one step is a filter")
    continuous = fitted.is_simulated
    drive_timestep = fitted.origin.timestep if fitted.origin is not None and not continuous else fitted.timestep
    if not np.isclose(timestep, drive_timestep, rtol=1e-6):
        lacks.append(f"steps of {timestep:g} s instead of {drive_timestep:g} s")
    elif continuous:
        lacks.append(f"steps of {timestep:g} s instead of continuous time")
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
        f"same lag in steps of {timestep:g} s. Its `act` begins at 0: set `act` to `ctrl` when you reset a simulation."
    ]
