"""Recordings of jointed drives with exact Coulomb friction, from `event_exact.c`, which knows nothing of MuJoCo."""

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
STEP = 5e-6  # s, the longest
_DRIVE = ("armature", "viscous", "forward", "backward", "breakaway", "stribeck", "load", "bristle", "kp", "kd", "delay")
_DRIVE += ("torque_limit", "torque_offset", "gain", "ripple", "periods")


@dataclass(frozen=True)
class Link:
    """A body on a hinge.

    Attributes:
        parent: Index of the link that carries it; -1 for the ground.
        axis: Of the hinge, of length 1.
        place: Of the hinge in the parent's frame [m].
        mass: [kg].
        centre: Centre of mass in the link's frame [m].
        inertia: About the centre, along the frame's axes [kg m^2].
    """

    parent: int
    axis: tuple[float, float, float]
    place: tuple[float, float, float]
    mass: float
    centre: tuple[float, float, float]
    inertia: tuple[float, float, float]

    def with_payload(self, mass: float, at: tuple[float, float, float]) -> "Link":
        """The link with a point mass [kg] at this place [m]."""
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
    """What moves and brakes a joint.

    Attributes:
        armature: [kg m^2].
        viscous: [N m s/rad].
        forward: Dry friction of a fast forward motion [N m].
        backward: The same backward; None for `forward`.
        breakaway: Dry friction at standstill over that.
        stribeck: Speed over which the one goes over into the other [rad/s].
        load: Dry friction over the torque that the gear passes on, the motor's less that from outside.
        bristle: Stiffness of presliding [N m/rad]; 0 for none.
        kp: Gain of position [N m/rad].
        kd: Gain of velocity [N m s/rad].
        delay: Of commands [s].
        torque_limit: Of the motor [N m]; 0 for none.
        torque_offset: Constant torque [N m].
        gain: Over the gains that are known.
        ripple: Amplitude of the dry friction's change with the position [N m].
        periods: Of that in a turn.
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
        """Return the friction torque of a joint that slides at this position, under this load of its gear [N m]."""
        backward = self.forward if self.backward is None else self.backward
        dry = np.where(velocity < 0, backward, self.forward)
        dry = dry * (1 + (self.breakaway - 1) * np.exp(-np.square(velocity / self.stribeck)))
        dry = dry + self.load * np.abs(load) + self.ripple * np.sin(self.periods * np.asarray(qpos))
        return np.sign(velocity) * dry + self.viscous * velocity


class Motion(NamedTuple):
    """States at samples, of shape (time, joints), and the share of time that joints stick."""

    qpos: Float[np.ndarray, "time nv"]
    qvel: Float[np.ndarray, "time nv"]
    sticking: float


def simulate(
    links: Sequence[Link], drives: Sequence[Drive], ctrl: Float[np.ndarray, "time nv"], interval: float
) -> Motion:
    """Return the motion under commands that are held for an interval [s] each, from rest at the first of them."""
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
    """Return the links as MJCF, without armatures and friction."""
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
    """Return positions as an encoder of so many bits a turn reads them."""
    step = 2 * np.pi / 2**bits
    return np.round(qpos / step) * step


def filter_velocity(qpos: Float[np.ndarray, "time nv"], interval: float, cutoff: float) -> Float[np.ndarray, "time nv"]:
    """Return backward differences of positions behind a first-order low-pass [Hz], as drives compute velocities."""
    raw = np.diff(qpos, axis=0, prepend=qpos[:1]) / interval
    share, out = 1 - math.exp(-2 * np.pi * cutoff * interval), np.zeros_like(raw)
    for at in range(1, len(raw)):
        out[at] = out[at - 1] + share * (raw[at] - out[at - 1])
    return out
