"""Simulated recordings of jointed drives with exact Coulomb friction, by `event_exact.c` and without MuJoCo."""

import ctypes
import functools
import math
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

GRAVITY = (0.0, 0.0, -9.81)  # m/s^2
STEP = 5e-6  # s, longest integration step
_DRIVE = ("armature", "viscous", "forward", "backward", "breakaway", "stribeck", "load", "bristle", "kp", "kd", "delay")
_DRIVE += ("torque_limit", "torque_offset", "gain", "ripple", "periods")


@dataclass(frozen=True)
class Link:
    """Body on a hinge.

    Attributes:
        parent: Index of the link that carries it; -1 for the ground.
        axis: Unit vector of the hinge axis.
        place: Hinge position in the parent's frame [m].
        mass: Mass [kg].
        centre: Centre of mass in the link's frame [m].
        inertia: Moments about the centre of mass, along the frame's axes [kg m^2].
    """

    parent: int
    axis: tuple[float, float, float]
    place: tuple[float, float, float]
    mass: float
    centre: tuple[float, float, float]
    inertia: tuple[float, float, float]

    def with_payload(self, mass: float, at: tuple[float, float, float]) -> "Link":
        """Return the link with a point mass [kg] attached at a position [m]."""
        whole = self.mass + mass
        own, point = np.array(self.centre), np.array(at)
        centre = (self.mass * own + mass * point) / whole
        inertia = np.diag(self.inertia).astype(float)
        for part, where in ((self.mass, own - centre), (mass, point - centre)):
            inertia += part * (where @ where * np.eye(3) - np.outer(where, where))
        assert np.allclose(inertia, np.diag(np.diag(inertia)))
        return Link(self.parent, self.axis, self.place, whole, tuple(centre), tuple(np.diag(inertia)))


@dataclass(frozen=True)
class Drive:
    """Actuator, armature and friction of a joint.

    Attributes:
        armature: Armature [kg m^2].
        viscous: Viscous coefficient [N m s/rad].
        forward: Dry friction in fast forward motion [N m].
        backward: Dry friction in fast backward motion [N m]; None for `forward`.
        breakaway: Dry friction at standstill, relative to fast motion.
        stribeck: Stribeck velocity [rad/s].
        load: Dry friction per gear torque, which is the motor torque minus the external torque.
        bristle: Presliding stiffness [N m/rad]; 0 for none.
        kp: Position gain [N m/rad].
        kd: Velocity gain [N m s/rad].
        delay: Command delay [s].
        torque_limit: Torque limit of the motor [N m]; 0 for none.
        torque_offset: Constant torque [N m].
        gain: True gains relative to the known gains.
        ripple: Amplitude of the dry friction's ripple over position [N m].
        periods: Ripple periods per turn.
    """

    armature: float
    viscous: float = 0.0
    forward: float = 0.0
    backward: float | None = None
    breakaway: float = 1.0
    stribeck: float = 0.1
    load: float = 0.0
    bristle: float = 0.0
    kp: float = 20.0
    kd: float = 1.0
    delay: float = 0.0
    torque_limit: float = 0.0
    torque_offset: float = 0.0
    gain: float = 1.0
    ripple: float = 0.0
    periods: float = 12.0

    def friction(
        self,
        velocity: Float[np.ndarray, "_"],
        qpos: Float[np.ndarray, "_"] | float = 0.0,
        load: Float[np.ndarray, "_"] | float = 0.0,
    ) -> Float[np.ndarray, "_"]:
        """Return the friction torque [N m] of a sliding joint at this velocity, position and gear torque."""
        backward = self.forward if self.backward is None else self.backward
        dry = np.where(velocity < 0, backward, self.forward)
        dry = dry * (1 + (self.breakaway - 1) * np.exp(-np.square(velocity / self.stribeck)))
        dry = dry + self.load * np.abs(load) + self.ripple * np.sin(self.periods * np.asarray(qpos))
        return np.sign(velocity) * dry + self.viscous * velocity


class Motion(NamedTuple):
    """States at samples, of shape (time, joints), and the share of time in which joints stick."""

    qpos: Float[np.ndarray, "time nv"]
    qvel: Float[np.ndarray, "time nv"]
    sticking: float


def simulate(
    links: Sequence[Link], drives: Sequence[Drive], ctrl: Float[np.ndarray, "time nv"], interval: float
) -> Motion:
    """Return the motion from rest at the first command; each command is held for an interval [s]."""
    count, samples = len(links), len(ctrl)
    geometry = np.array(
        [[*of.axis, *of.place, of.mass, *of.centre, *np.diag(of.inertia).ravel()] for of in links], np.float64
    )
    numbers = np.array(
        [[of.forward if (value := getattr(of, name)) is None else value for name in _DRIVE] for of in drives],
        np.float64,
    )
    parents, out = np.array([of.parent for of in links], np.int32), np.empty((samples, 2, count))
    steps = math.ceil(interval / STEP - 1e-9)
    simulated = _library().simulate
    simulated.restype = ctypes.c_double
    arrays = [
        array.ctypes.data_as(ctypes.c_void_p) for array in (parents, geometry, numbers, np.array(GRAVITY, np.float64))
    ]
    command = np.ascontiguousarray(ctrl, np.float64)
    sticking = simulated(
        count,
        *arrays,
        samples,
        ctypes.c_double(interval),
        steps,
        command.ctypes.data_as(ctypes.c_void_p),
        out.ctypes.data_as(ctypes.c_void_p),
    )
    return Motion(out[:, 0], out[:, 1], sticking)


@functools.cache
def _library() -> ctypes.CDLL:
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "event_exact.so"
        source = Path(__file__).with_suffix(".c")
        subprocess.run(["cc", "-O3", "-shared", "-fPIC", "-o", library, source, "-lm"], check=True)
        return ctypes.CDLL(str(library))


def write_mjcf(links: Sequence[Link], names: Sequence[str], timestep: float = 0.001) -> str:
    """Return the links as MJCF, without armature and friction."""
    children: dict[int, list[int]] = {}
    for index, link in enumerate(links):
        children.setdefault(link.parent, []).append(index)

    def text(numbers: Sequence[float]) -> str:
        return " ".join(f"{number:.17g}" for number in numbers)

    def body(index: int) -> str:
        link, name = links[index], names[index]
        inside = "".join(map(body, children.get(index, [])))
        inertial = f'<inertial pos="{text(link.centre)}" mass="{link.mass:.17g}" diaginertia="{text(link.inertia)}"/>'
        joint = f'<joint name="{name}" axis="{text(link.axis)}"/>'
        return f'<body name="{name}_link" pos="{text(link.place)}">{joint}{inertial}{inside}</body>'

    bodies = "".join(map(body, children[-1]))
    head = f'<compiler angle="radian"/><option timestep="{timestep:.17g}" gravity="{text(GRAVITY)}"/>'
    return f'<mujoco model="stand">{head}<worldbody>{bodies}</worldbody></mujoco>\n'


def round_to(qpos: Float[np.ndarray, "time nv"], bits: int) -> Float[np.ndarray, "time nv"]:
    """Round positions to an encoder with this many bits per turn."""
    step = 2 * np.pi / 2**bits
    return np.round(qpos / step) * step


def filter_velocity(qpos: Float[np.ndarray, "time nv"], interval: float, cutoff: float) -> Float[np.ndarray, "time nv"]:
    """Return backward differences of positions after a first-order low-pass [Hz], as drives compute velocity."""
    raw = np.diff(qpos, axis=0, prepend=qpos[:1]) / interval
    share, out = 1 - math.exp(-2 * np.pi * cutoff * interval), np.zeros_like(raw)
    for at in range(1, len(raw)):
        out[at] = out[at - 1] + share * (raw[at] - out[at - 1])
    return out
