"""Files of a command: tables, a ROS 2 trajectory, and LeRobot actions."""

import csv
import io
import json
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from frictionzoo.bench.limits import Motion
from frictionzoo.core.templates import write_yaml
from frictionzoo.data.signals import Signal
from frictionzoo.design.excitation import DesignedCommand


def table(joints: Sequence[str], time: Signal, signals: Mapping[str, Float[np.ndarray, "samples nv"]]) -> bytes:
    """Write a CSV table as `data=files` reads it: a column for each signal, or `SIGNAL_JOINT` for several joints."""
    headers = [name if len(joints) == 1 else f"{name}_{joint}" for name in signals for joint in joints]
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerow(["time", *headers])
    columns = np.concatenate([time[:, None], *signals.values()], axis=1)
    np.savetxt(buffer, columns, fmt="%.10g", delimiter=",")
    return buffer.getvalue().encode()


def trajectory(joints: Sequence[str], time: Signal, motion: Motion, interval: float) -> bytes:
    """Write the command as `trajectory_msgs/JointTrajectory` in YAML, with a point each `interval` [s].

    Each point has position, velocity and acceleration; `ros2 topic pub` publishes it, and `joint_trajectory_controller`
    interpolates by polynomials of fifth degree.
    """
    acceleration = np.gradient(motion.speed, time, axis=0)
    times = np.minimum(interval * np.arange(int(np.ceil(time[-1] / interval - 1e-9)) + 1), time[-1])
    parts = {"positions": motion.ctrl, "velocities": motion.speed, "accelerations": acceleration}
    points = {name: _sample(times, time, signal) for name, signal in parts.items()}
    lines = [f"joint_names: {write_yaml(list(joints))}", "points:"]
    for index, seconds in enumerate(times.tolist()):
        ticks = round(1e9 * seconds)
        row = {name: values[index].tolist() for name, values in points.items()}
        row["time_from_start"] = {"sec": ticks // 10**9, "nanosec": ticks % 10**9}
        lines.append(f"- {json.dumps(row)}")
    return ("\n".join(lines) + "\n").encode()


def actions(joints: Sequence[str], time: Signal, motion: Motion, fps: float) -> bytes:
    """Write the command as a JSON list of actions, one for each frame, with LeRobot's names: `knee.pos`."""
    times = np.arange(int(time[-1] * fps + 1e-9) + 1) / fps
    rows = _sample(times, time, motion.ctrl).tolist()
    named = [dict(zip((f"{joint}.pos" for joint in joints), row, strict=True)) for row in rows]
    lines = ",\n".join(json.dumps(row) for row in named)
    return f'{{"fps": {fps:g}, "actions": [\n{lines}\n]}}\n'.encode()


def files_of(designed: DesignedCommand) -> dict[str, bytes]:
    """Write all files of a command; return their content by name."""
    joints, motion, plan = designed.note["joints"], designed.motion, designed.note["command"]
    time = designed.interval * np.arange(len(motion.ctrl))
    command = {"ctrl": motion.ctrl, **designed.inputs}
    return {
        "command.csv": table(joints, time, command),
        "expected.csv": table(joints, time, {"qpos": motion.qpos, "qvel": motion.qvel, **command}),
        "trajectory.yaml": trajectory(joints, time, motion, 1 / plan["points"]),
        "actions.json": actions(joints, time, motion, plan["fps"]),
    }


def _sample(
    at: Float[np.ndarray, "points"], time: Float[np.ndarray, "samples"], signal: Float[np.ndarray, "samples nv"]
) -> Float[np.ndarray, "points nv"]:
    return np.stack([np.interp(at, time, column) for column in signal.T], axis=1)
