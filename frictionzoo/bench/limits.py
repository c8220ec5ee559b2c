"""Limits of a designed command and its motion, and the shares of them in use."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.bench import Bench
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.units import UNITS

KINDS = ("commanded position", "commanded velocity", "position", "velocity", "torque")
"""Limited quantities, in the order of `Motion.shares`."""
_MOVED = 1e-3  # displacement of command or joint that tests the actuator [rad or m]


@dataclass(frozen=True)
class Limits:
    """Limits of each joint: `low` and `high` positions [rad or m], speed [rad/s or m/s] and actuator torque [N m or N].

    The motion begins and ends at `home`.

    Raises:
        ConfigError: The limits allow no motion.
    """

    home: Float[np.ndarray, "nv"]
    low: Float[np.ndarray, "nv"]
    high: Float[np.ndarray, "nv"]
    velocity: Float[np.ndarray, "nv"]
    torque: Float[np.ndarray, "nv"]

    def __post_init__(self) -> None:
        for name in ("velocity", "torque"):
            if not (getattr(self, name) > 0).all():
                raise ConfigError(f"{name}={_say(getattr(self, name))}: expected above 0")
        if not (self.low < self.high).all():
            value = f"position=[{_say(self.low)}, {_say(self.high)}]"
            raise ConfigError(f"{value}: expected two numbers, the smaller first")
        if not ((self.low < self.home) & (self.home < self.high)).all():
            raise ConfigError(
                f"home={_say(self.home)}: expected between {_say(self.low)} and {_say(self.high)}, the position limits"
            )

    @classmethod
    def read(cls, nv: int, position: Any, velocity: Any, torque: Any, home: Any = None) -> "Limits":
        """Read limits from options: a number for all joints or one for each; for positions, a reach or [low, high].

        Raises:
            ConfigError: A limit is invalid, or the limits allow no motion.
        """
        is_nested = isinstance(position, list) and all(isinstance(entry, list) for entry in position)
        pairs = np.array([_pair(position)] if nv == 1 or not is_nested else list(map(_pair, position)))
        if len(pairs) not in (1, nv):
            raise ConfigError(f"position={position}: {len(pairs)} pairs, expected {nv}, one a joint")
        low, high = np.broadcast_to(pairs, (nv, 2)).T
        middle = (low + high) / 2 if home is None else _per_joint("home", home, nv)
        return cls(middle, low, high, _per_joint("velocity", velocity, nv), _per_joint("torque", torque, nv))

    def within(self, share: float) -> "Limits":
        """Return the limits reduced to this share, around `home`."""
        low, high = (self.home + share * (end - self.home) for end in (self.low, self.high))
        return replace(self, low=low, high=high, velocity=share * self.velocity, torque=share * self.torque)

    def position_share(self, xp: Any, position: Any) -> Any:
        """Return the used share of the range of positions, on the side of `home` where the position is."""
        above, below = (position - self.home) / (self.high - self.home), (self.home - position) / (self.home - self.low)
        return xp.maximum(above, below)


class Motion(NamedTuple):
    """A command, its derivative and its motion, (..., samples, nv); `torque` is the actuator's from each sample on."""

    ctrl: Any
    speed: Any
    qpos: Any
    qvel: Any
    torque: Any

    def shares(self, xp: Any, limits: Limits) -> Any:
        """Return each of `KINDS` relative to its limit, (5, ..., nv)."""
        commanded, reached = (limits.position_share(xp, position) for position in (self.ctrl, self.qpos))
        velocities = abs(self.speed) / limits.velocity, abs(self.qvel) / limits.velocity
        return xp.stack([commanded, velocities[0], reached, velocities[1], abs(self.torque) / limits.torque])


def refuse_unholdable(bench: Bench, values: Mapping[str, Any], inputs: Mapping[str, Any], limits: Limits) -> None:
    """Refuse a drive that no command can hold at a position, and limits that do not let it rest at `home`.

    Raises:
        ConfigError: The command is not a position, or holding the drive takes more than the allowed torque.
    """
    still = np.zeros(bench.nv)
    inputs = {"ctrl_velocity": still, **inputs}

    def torque(qpos: np.ndarray, command: np.ndarray) -> np.ndarray:
        control = bench.actuator.control(np, values, qpos, still, command, inputs)
        gain, constant, stiffness, _ = bench.actuator.affine(values)
        return gain * control + constant + stiffness * qpos

    home, aside = limits.home, limits.home + _MOVED
    if not (torque(aside, home) < torque(home, home)).all() or not np.allclose(
        torque(aside, aside), torque(home, home)
    ):
        raise ConfigError(
            f"{type(bench.actuator).__name__}: its command is not a position, so the drive may leave its limits; set "
            "bench.actuator to the position controller, such as PositionPD"
        )
    model = bench.compile(constraint=False)
    data = mujoco.MjData(model)
    data.qpos[:] = home
    mujoco.mj_forward(model, data)
    holding_torque = np.abs(data.qfrc_bias - data.qfrc_passive)
    if not (holding_torque < limits.torque).all():
        joint = int(np.argmax(holding_torque / limits.torque))
        unit = UNITS[bench.joint_type]
        raise ConfigError(
            f"torque={limits.torque[joint]:g}: holding {bench.joints[joint]} at {home[joint]:.4g} {unit['position']} "
            f"already needs {holding_torque[joint]:.4g} {unit['torque']}, expected more; raise it, or set home"
        )


def _pair(given: Any) -> tuple[float, float]:
    try:
        if isinstance(given, list):
            low, high = map(float, given)
        else:
            low, high = -float(given), float(given)
    except (TypeError, ValueError):
        raise ConfigError(f"position={given}: expected a number, or two as in [-1.5,1.8]") from None
    return low, high


def _per_joint(name: str, given: Any, nv: int) -> Float[np.ndarray, "nv"]:
    try:
        values = np.asarray(given, np.float64)
    except (TypeError, ValueError):
        values = np.array(np.nan)
    if values.shape not in ((), (1,), (nv,)) or not np.isfinite(values).all():
        raise ConfigError(f"{name}={given}: expected a number, or a list of {nv}, one a joint")
    return np.broadcast_to(values, nv)


def _say(values: np.ndarray) -> str:
    return ", ".join(f"{value:g}" for value in values)
