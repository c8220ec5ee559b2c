"""Loss of simulated states: weights, robust losses, encoder resolution and impulses."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from frictionzoo.bench import Bench
from frictionzoo.bench.compiled import rigid_inertia_at
from frictionzoo.core.errors import ConfigError, closest, refuse_outside
from frictionzoo.core.segments import Segments
from frictionzoo.fit.blocks import Blocks, each
from frictionzoo.simulation import Values

ROBUST: Mapping[str, Callable[[Any], Any]] = {
    "none": lambda z: z,
    "huber": lambda z: jnp.where(z <= 1, z, 2 * jnp.sqrt(jnp.where(z <= 1, 1.0, z)) - 1),
    "soft_l1": lambda z: 2 * (jnp.sqrt(1 + z) - 1),
    "cauchy": jnp.log1p,
}
"""Robust losses of a squared residual over the squared scale, as in scipy.optimize.least_squares."""
_SOFT = 0.1  # width of the transition at the end of half an encoder step, as a share of that half
_LEAST = 1e-8  # least mean square, as a share of the largest joint's; a joint at rest has none


@dataclass(frozen=True)
class Loss:
    """Weighting of errors.

    Attributes:
        position: Weight of squared position errors [1/rad^2 or 1/m^2].
        velocity: Weight of squared velocity errors [s^2/rad^2 or s^2/m^2].
        robust: Robust loss by scipy's name: `none`, `huber`, `soft_l1` or `cauchy`.
        robust_scale: Weighted residual above which the robust loss grows slower than the square.
        refine: Whether to estimate each segment's initial state from all its samples (multiple shooting); otherwise the
            measured state is used.
        continuity: Weight of the defect between a segment's end and the next initial state in the same recording,
            relative to the other weights; 0 for independent segments. Short segments then act as one long rollout that
            cannot diverge.
        encoder_step: Resolution of the position encoder [rad or m]: errors count beyond half of it; 0 for none.
        by_joint: Whether `balanced` weights the joints.
        impulse: Whether to turn velocity errors into the impulse that each joint lacked in each sample interval.
        slow: Share of a joint's root mean square speed; slower intervals do not count in the impulse.
        size: Root mean square of each joint's position and velocity errors, by which errors are divided; None for 1 in
            SI units.

    Raises:
        ConfigError: A weight is negative, or both are 0; the robust loss is unknown; options cannot be combined.
    """

    position: float = 1.0
    velocity: float = 1.0
    robust: str = "none"
    robust_scale: float = 1.0
    refine: bool = False
    continuity: float = 0.0
    encoder_step: float = 0.0
    by_joint: bool = False
    impulse: bool = False
    slow: float = 0.0
    size: Float[np.ndarray, "nv 2"] | None = None

    def __post_init__(self) -> None:
        position, velocity, robust = self.position, self.velocity, self.robust
        if min(position, velocity) < 0 or max(position, velocity) == 0:
            raise ConfigError(
                f"loss.position={position:g}, loss.velocity={velocity:g}; expected weights of at least 0, not both 0"
            )
        if robust not in ROBUST:
            raise ConfigError(f"loss.robust={robust}: unknown; {closest(robust, ROBUST)}")
        if not self.robust_scale > 0:
            raise ConfigError(f"loss.robust_scale={self.robust_scale:g}; expected a positive number")
        if self.impulse and (self.refine or position):
            raise ConfigError(
                f"loss.impulse=true with loss.refine={str(self.refine).lower()}, loss.position={position:g}; expected "
                "loss.refine=false and loss.position=0, because impulses use measured velocities"
            )
        if self.refine and robust != "none":
            raise ConfigError(f"loss.robust={robust} with loss.refine=true; expected one of them, set the other off")
        if self.refine and not position * velocity:
            raise ConfigError("loss.refine=true with a weight of 0; expected loss.position and loss.velocity above 0")
        if not self.encoder_step >= 0:
            raise ConfigError(f"loss.encoder_step={self.encoder_step:g}; expected 0, for none, or a positive number")
        if not self.continuity >= 0:
            raise ConfigError(f"loss.continuity={self.continuity:g}; expected a weight of at least 0")
        if self.continuity and not self.refine:
            raise ConfigError(f"loss.continuity={self.continuity:g} with loss.refine=false; expected loss.refine=true")
        refuse_outside("loss.slow", self.slow, 0, 1)
        if self.slow and not self.impulse:
            raise ConfigError(f"loss.slow={self.slow:g} with loss.impulse=false; expected loss.impulse=true")

    @property
    def roots(self) -> Float[np.ndarray, "#nv 2"]:
        """Square roots of the weights of position and velocity, joint by joint."""
        return np.sqrt([[self.position, self.velocity]]) / (1.0 if self.size is None else self.size)

    @property
    def gap(self) -> Float[np.ndarray, "#nv 2"] | None:
        """Square roots of the weights of the defects between segments; None for independent segments."""
        return np.sqrt(self.continuity) * self.roots if self.continuity else None

    def unexplained(self, errors: Array) -> Array:
        """Return position errors [rad or m] less the part that encoder rounding explains: all within half a step.

        Anywhere within half a step of a rounded reading is equally probable, and the squared excess keeps estimates
        there. Plain least squares would pull them to the reading, and correlated rounding errors would bias them.
        """
        if not self.encoder_step:
            return errors
        half, width = self.encoder_step / 2, soft_width(self.encoder_step)
        ends = jax.nn.softplus((errors - half) / width), jax.nn.softplus((-errors - half) / width)
        return width * (ends[0] - ends[1])

    def widths(self, nv: int) -> Float[np.ndarray, "nv kinds"]:
        """Return the width over which each weighted error begins to count; 0 where it counts from 0 on."""
        widths = np.array([[soft_width(self.encoder_step), 0.0]]) * self.roots
        return np.broadcast_to(widths[:, self.roots.any(axis=0)], (nv, int(self.roots.any(axis=0).sum())))

    def errors(
        self, start: tuple[Array, Array], predicted: tuple[Array, Array], armature: Any, block: Blocks
    ) -> Float[Array, "segments time nv kinds"]:
        """Return weighted errors of position and velocity, or impulses; a refined initial state's errors come first."""
        errors = []
        rounded = (self.unexplained, lambda missed: missed)  # only positions are rounded
        for root, beyond, begun, after, measured in zip(
            self.roots.T, rounded, start, predicted, (block.qpos, block.qvel), strict=True
        ):
            if not root.any():
                continue
            states = jnp.concatenate([begun[:, None], after], axis=1) if self.refine else after
            missed = beyond(states - (measured if self.refine else measured[:, 1:]))
            errors.append(root * self.counted(missed, armature, block))
        return jnp.stack(errors, axis=-1) * block.weight[:, None, None, None]

    def counted(self, errors: Array, armature: Any, block: Blocks) -> Float[Array, "segments time nv"]:
        """Return the errors, or the impulses that cause them, with 0 where a joint is too slow."""
        missed = impulses(errors, block.inertia, armature) if self.impulse else errors
        return missed if block.counts is None else block.counts * missed

    def over(self, squares: Float[np.ndarray, "nv 2"]) -> "Loss":
        """Return the loss with each joint's errors divided by the roots of these mean squares, with a lower limit.

        Raises:
            ConfigError: They are not finite.
        """
        if not np.isfinite(squares).all():
            raise ConfigError(
                "loss.by_joint=true: rollouts of the segments are not finite at the start of the fit; change the "
                "initial values, or lower segments.length"
            )
        least = _LEAST * np.max(squares, axis=0, initial=np.finfo(float).tiny)
        return replace(self, size=np.sqrt(np.maximum(squares, least)))

    def sum(self, squares: Array) -> Float[Array, ""]:
        """Return the sum of the robust loss over squared residuals."""
        square = self.robust_scale**2
        return jnp.sum(ROBUST[self.robust](squares / square)) * square

    def shares(self, squares: Array, exact: bool) -> tuple[Array, Array]:
        """Return the weight of each residual in the gradient and in the Hessian: the slope of the robust loss.

        With `exact`, the Hessian's weight is the second derivative of the loss, which can be negative.
        """
        squares = squares / self.robust_scale**2
        robust = ROBUST[self.robust]
        share = curvature = jnp.vectorize(jax.grad(robust))(squares)
        if exact:
            curvature = share + 2 * squares * jnp.vectorize(jax.grad(jax.grad(robust)))(squares)
        return share, curvature


def bend(errors: Array, widths: Array) -> Array:
    """Return the curvature factor 1 + e e'' / e'^2: the second derivative of e^2 / 2 over the square of e's slope.

    Gauss-Newton assumes 1, which holds for an error that counts from 0 on. Within half an encoder step the factor is up
    to 2, and a Gauss-Newton step would be nearly twice too long.

    The errors e are those of `Loss.unexplained`, e = w (log(1 + exp((x - h) / w)) - log(1 + exp((-x - h) / w))), about
    2 w exp(-h / w) sinh(x / w) for |x| < h. There e e'' / e'^2 is tanh(x / w)^2; elsewhere it is
    (e / w) / (exp(e / w) - 1). The widths w are 0 where the error is x.
    """
    soft = widths > 0
    ratio = jnp.where(soft, jnp.abs(errors) / jnp.where(soft, widths, 1.0), 0.0)
    sinh = jnp.square(ratio * math.exp(1 / _SOFT) / 2)
    least = jnp.maximum(ratio, jnp.finfo(errors.dtype).tiny ** 0.5)
    return 1 + least / jnp.expm1(least) * sinh / (1 + sinh)


def soft_width(encoder_step: float) -> float:
    """Return the width over which errors begin to count at half an encoder step [rad or m], like noise of that size."""
    return _SOFT * encoder_step / 2


def mean_squares(
    loss: Loss, rollout: Callable[..., tuple[Any, Any]], values: Values, data: Blocks
) -> Float[np.ndarray, "nv 2"]:
    """Return the mean squares of each joint's errors over all segments, from measured initial states."""
    squares, counts = np.zeros((data.qpos.shape[3], 2)), np.zeros(data.qpos.shape[3])
    for block in each(data):
        predicted = rollout(values, block.qpos[:, 0], block.qvel[:, 0], block.signals, block.load)
        measured, armature = (block.qpos[:, 1:], block.qvel[:, 1:]), values["bench"]["armature"]
        missed = [loss.counted(new - old, armature, block) for new, old in zip(predicted, measured, strict=True)]
        squares += np.einsum("stvk,s->vk", np.square(np.stack(missed, axis=-1)), block.weight)
        counts += count_terms(block)
    return squares / np.maximum(counts, 1)[:, None]


def count_terms(data: Blocks) -> Float[np.ndarray, "nv"]:
    """Return the number of intervals, over all segments, in which each joint counts."""
    *_, intervals, nv = np.shape(data.qpos)
    if data.counts is None:
        return np.full(nv, (intervals - 1) * float(np.sum(data.weight)))
    counts = np.asarray(data.counts)
    return np.einsum("stv,s->v", counts.reshape(-1, *counts.shape[-2:]), np.ravel(data.weight))


def impulses(
    errors: Float[Array, "segments intervals nv"],
    inertia: Float[Array, "segments nv nv"],
    armature: Float[Array, "nv"],
) -> Float[Array, "segments intervals nv"]:
    """Return the momentum that each sample interval adds to a rollout's velocity errors [N m s or N s].

    A missing torque appears once, in the joint and interval where it acts. As a velocity error it would appear in all
    joints that it moves, divided by their inertia, and in all later samples.

    The armature is the one under trial. Impulses are therefore linear in it, with the measured acceleration as
    derivative, as in inverse dynamics. Velocity errors are torque over inertia, and torque noise would bias the
    armature upwards.

    `inertia` excludes the armature and holds at the start of each segment; both are in kg m^2 or kg.

    Source: W. Fuller, "Measurement Error Models", 1987, for the effect of noise in a regressor.
    """
    added = jnp.diff(errors, axis=1, prepend=jnp.zeros_like(errors[:, :1]))
    return jnp.einsum("sij,stj->sti", inertia, added, precision="highest") + armature * added


def rigid_inertia_of(bench: Bench, segments: Segments) -> Float[np.ndarray, "segments nv nv"]:
    """Return the joint-space inertia without armature at the start of segments, with payloads [kg m^2 or kg]."""
    model, inertia = bench.compile(constraint=False), np.zeros((segments.count, bench.nv, bench.nv))
    if "position_offset" in (values := bench.initial_values()):
        model.qpos0[:] = -values["position_offset"]
    loads, of_load = np.unique(segments.loads, axis=0, return_inverse=True)
    for number, load in enumerate(loads):
        members = of_load.ravel() == number
        bench.put_load(model, load)
        inertia[members] = rigid_inertia_at(model, segments.qpos[members, 0])
    return inertia


def is_moving(segments: Segments, slow: float) -> Bool[np.ndarray, "segments intervals nv"]:
    """Return in which intervals a joint is faster than this share of its root mean square speed."""
    speed = np.abs(segments.qvel[:, 1:] + segments.qvel[:, :-1]) / 2
    return speed > slow * np.sqrt(np.mean(np.square(segments.qvel), axis=(0, 1)))
