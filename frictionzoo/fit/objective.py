"""What a fit minimises."""

import copy
from collections.abc import Callable, Hashable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import torch
from jax.sharding import NamedSharding, PartitionSpec
from jaxtyping import Array, Float

from frictionzoo.bench import Bench
from frictionzoo.core.errors import ConfigError, closest
from frictionzoo.core.log import Log
from frictionzoo.core.segments import Segments
from frictionzoo.core.threads import usable_threads
from frictionzoo.fit.blocks import MOST_STRETCHES, Blocks, devices_of, each, into_blocks
from frictionzoo.fit.normal_equations import NormalEquations
from frictionzoo.fit.space import Space
from frictionzoo.fit.sparsity import Sparsity
from frictionzoo.models import FrictionModel
from frictionzoo.simulate import Values
from frictionzoo.simulate.bridge import as_torch_function, to_arrays, to_tensors
from frictionzoo.simulate.linear import solve_spd
from frictionzoo.simulate.rollout import FORWARD, Rollout
from frictionzoo.simulate.torch_rollout import TorchRollout

T = TypeVar("T")
_REFINEMENTS = 5  # steps for an initial state; rollouts are nearly linear in it but for sticking and sliding
_ROBUST: Mapping[str, Callable[[Any], Any]] = {
    "none": lambda z: z,
    "huber": lambda z: jnp.where(z <= 1, z, 2 * jnp.sqrt(jnp.where(z <= 1, 1.0, z)) - 1),
    "soft_l1": lambda z: 2 * (jnp.sqrt(1 + z) - 1),
    "cauchy": jnp.log1p,
}
"""Losses of a squared residual over the squared scale, as in scipy.optimize.least_squares."""


class Recordings(NamedTuple):
    """What the segments were cut from, for a method that looks at whole recordings.

    Attributes:
        bench: The test stand.
        model: The friction law, ready for the data.
        logs: As the bench accepts them.
    """

    bench: Bench
    model: FrictionModel
    logs: tuple[Log, ...]


class Objective:
    """Weighted mean square error of predicted states over all segments, as a function of a `Space`'s vector.

    Source: Kovalev et al., Proc. MIPT 18(2), 2026, equation (3), with a mean in place of the sum and one weight each
    for position and velocity.

    Attributes:
        space: The coordinates.
        data: What the functions below take as their last argument: the segments, spread over all local devices.
        devices: How many these are.
        stretches: Into how many stretches of consecutive segments the data are divided, one after the other in time.
        compile: `jax.jit` for functions that call these.
        recordings: What the segments were cut from; None where they follow another drive.
        torch_law: Name of the friction law if it exists only in torch, None for any other. Its functions below are
            called with arrays and cannot be compiled, and it has a gradient and no Jacobian.

    Args:
        space: The coordinates.
        rollout: The simulated drive.
        segments: What was measured.
        position: Weight of squared position errors [1/rad^2 or 1/m^2].
        velocity: Weight of squared velocity errors [s^2/rad^2 or s^2/m^2].
        robust: What becomes of a squared residual: `none`, `huber`, `soft_l1` or `cauchy`, as scipy names them.
        robust_scale: Weighted residual from which on it counts less than its square.
        refine: Whether each segment's initial state is estimated along, from its measured state and from all that
            follows (multiple shooting), instead of being taken as measured.

    Raises:
        ConfigError: A weight is negative, or both are 0; the robust loss is unknown or cannot be combined; initial
            states are to be refined with a law that exists only in torch.
    """

    def __init__(
        self,
        space: Space,
        rollout: Rollout,
        segments: Segments,
        position: float = 1.0,
        velocity: float = 1.0,
        robust: str = "none",
        robust_scale: float = 1.0,
        refine: bool = False,
    ) -> None:
        if min(position, velocity) < 0 or max(position, velocity) == 0:
            raise ConfigError(
                f"loss.position={position:g}, loss.velocity={velocity:g}; expected weights of at least 0, not both 0"
            )
        if robust not in _ROBUST:
            raise ConfigError(f"loss.robust={robust}: unknown; {closest(robust, _ROBUST)}")
        if not robust_scale > 0:
            raise ConfigError(f"loss.robust_scale={robust_scale:g}; expected a positive number")
        if refine and robust != "none":
            raise ConfigError(f"loss.robust={robust} with loss.refine=true; expected one of them, set the other off")
        if refine and not position * velocity:
            raise ConfigError("loss.refine=true with a weight of 0; expected loss.position and loss.velocity above 0")
        if refine and isinstance(rollout, TorchRollout):
            raise ConfigError(
                f"loss.refine=true: {rollout.law} exists only in torch, with no forward mode; set loss.refine=false"
            )
        self.space: Space = space
        self.compile: Callable[..., Any] = rollout.compile
        self.stretches: int = min(segments.count, MOST_STRETCHES)
        self.data: Blocks = into_blocks(segments, self.stretches, space.start.dtype, devices_of(rollout))
        self.devices: int = len(self.data.weight.sharding.device_set)
        self._first = min(self.data.weight.sharding.device_set, key=lambda device: device.id)
        self._rollout = rollout
        self._roots = np.sqrt([position, velocity])
        self._robust, self._scale = _ROBUST[robust], robust_scale
        self._refine = refine
        self.recordings: Recordings | None = None
        self._programs: dict[Any, Any] = {}  # compiled equations: a fit's own serve again when it is judged
        self._sparsity = Sparsity.of(space, rollout.branches)
        self._terms = segments.count * (segments.length + refine) * segments.qpos.shape[2]

    def for_drive(self, space: Space, rollout: Rollout) -> "Objective":
        """The same objective of another drive on the same bench, on the data that the devices hold already."""
        other = copy.copy(self)
        other.space, other.compile, other._rollout = space, rollout.compile, rollout
        other._sparsity = Sparsity.of(space, rollout.branches)
        other.recordings, other._programs = None, {}
        return other

    def starting(self, vector: Float[np.ndarray, "coordinates"]) -> "Objective":
        """The same objective with other initial coordinates, brought into the bounds."""
        other = copy.copy(self)
        other.space = self.space.starting(vector)
        return other

    def remember(self, what: Hashable, make: Callable[[], T]) -> T:
        """What was made for this objective before, under the same name, or what is made now."""
        if what not in self._programs:
            self._programs[what] = make()
        return self._programs[what]

    @property
    def torch_law(self) -> str | None:
        """Name of a law that exists only in torch."""
        return self._rollout.law if isinstance(self._rollout, TorchRollout) else None

    def spread(self, tree: Any) -> Any:
        """The same arrays on every device that holds data, as functions compiled for several expect them."""
        sharding = self.data.weight.sharding
        if self.devices == 1:
            return tree
        return jax.device_put(tree, NamedSharding(sharding.mesh, PartitionSpec()))

    def collect(self, tree: Any) -> Any:
        """The same arrays on the first device again, where torch can take them."""
        return tree if self.devices == 1 else jax.device_put(tree, self._first)

    def loss(self, vector: Float[Array, "coordinates"], data: Blocks) -> Float[Array, ""]:
        """The objective."""
        if self.torch_law:
            return jnp.sum(jnp.stack([self._block_loss(vector, block) for block in each(data)]))
        return jnp.sum(jax.lax.map(lambda block: self._block_loss(vector, block), data))

    def value_and_grad(self, derivative: str) -> Callable[[Array, Blocks], tuple[Array, Array]]:
        """The objective and its gradient as one function of a vector and the data, not compiled.

        Args:
            derivative: `forward` (a tangent for each coordinate), `reverse`, or `auto` for the cheaper one.

        Raises:
            ConfigError: The engine has no reverse mode for this bench, or the law has no other.
        """
        if isinstance(self._rollout, TorchRollout):
            return self._value_and_grad_in_torch(self._rollout, derivative)
        if derivative == "reverse" and not self._rollout.reverse:
            raise ConfigError(
                "fit.derivative=reverse: engine=mjx solves the constraints of several joints in a loop, which reverse "
                "mode cannot pass; set fit.derivative=forward or engine=specialised"
            )
        few = len(self.space.start) <= self._rollout.forward_limit or not self._rollout.reverse
        reverse = derivative == "reverse" or (derivative == "auto" and not few)

        def of_block(vector: Array, block: Blocks) -> tuple[Array, Array]:
            if reverse:
                return jax.value_and_grad(self._block_loss)(vector, block)
            slope = jax.vmap(lambda tangent: jax.jvp(lambda x: self._block_loss(x, block), (vector,), (tangent,)))
            losses, gradient = slope(jnp.eye(len(vector), dtype=vector.dtype))
            return losses[0], gradient

        def of_all(vector: Array, data: Blocks) -> tuple[Array, Array]:
            losses, gradients = jax.lax.map(lambda block: of_block(vector, block), data)
            return jnp.sum(losses), jnp.sum(gradients, axis=0)

        return of_all

    def _value_and_grad_in_torch(
        self, rollout: TorchRollout, derivative: str
    ) -> Callable[[Array, Blocks], tuple[Array, Array]]:
        """The same for a law that exists only in torch, block by block: what lies in JAX is a torch operation."""
        if derivative == "forward":
            raise ConfigError(
                f"fit.derivative=forward: {rollout.law} exists only in torch, where there is a reverse mode alone; set "
                "fit.derivative=reverse or auto"
            )
        if not rollout.reverse:
            raise ConfigError(
                f"{rollout.law} exists only in torch and needs reverse mode, which engine=mjx has not where it solves "
                "the constraints of several joints; set engine=specialised"
            )
        values_of, loss_of = map(as_torch_function, (self.space.values, self._loss_of_prediction))

        def of_block(vector: torch.Tensor, block: Blocks) -> torch.Tensor:
            start = block.qpos[:, 0], block.qvel[:, 0]
            return loss_of(rollout.in_torch(values_of(vector), *start, block.signals, block.load), block)

        def of_all(vector: Array, data: Blocks) -> tuple[Array, Array]:
            moving = to_tensors(vector).requires_grad_()
            losses = []
            for block in each(data):
                loss = of_block(moving, to_tensors(block))
                loss.backward()  # at once, so that the steps of one block are kept and not those of all
                losses.append(loss.detach())
            return to_arrays((torch.stack(losses).sum(), moving.grad))

        return of_all

    def compile_normal_equations(self) -> Callable[[Float[np.ndarray, "coordinates"]], NormalEquations]:
        """The compiled function of a vector that gives the normal equations, with exact Jacobians.

        They are summed block by block, so that no Jacobian of all residuals is ever kept; the sum over blocks is in
        float64. With refined initial states these are eliminated (Schur complement).
        """
        evaluate = self._compile_equations(exact=False)
        return lambda vector: evaluate(vector)[0]

    def compile_scores(
        self,
    ) -> Callable[
        [Float[np.ndarray, "coordinates"]], tuple[NormalEquations, Float[np.ndarray, "stretches coordinates"]]
    ]:
        """As `compile_normal_equations`, with the part of the gradient that comes from each stretch of segments.

        For a robust loss a residual counts in the second derivative by that of its loss, which can be negative, and not
        by the loss's slope, which keeps the step of a fit a descent.
        """
        return self._compile_equations(exact=self._robust is not _ROBUST["none"])

    def _compile_equations(self, exact: bool) -> Callable[[np.ndarray], tuple[NormalEquations, np.ndarray]]:
        if exact not in self._programs:
            traced = self.compile(lambda vector, block: self._block_equations(vector, block, exact), FORWARD)
            self._programs[exact] = traced.lower(self.spread(self.space.start), next(each(self.data))).compile()
        compiled = self._programs[exact]

        def evaluate(vector: Float[np.ndarray, "coordinates"]) -> tuple[NormalEquations, np.ndarray]:
            moved = self.spread(jnp.asarray(vector, self.space.start.dtype))

            def of_block(block: Blocks) -> list[Float[np.ndarray, "..."]]:
                return [np.asarray(part, np.float64) for part in compiled(moved, block)]

            # A block's operations are too small for several threads, blocks side by side are not. Devices have theirs.
            with ThreadPoolExecutor(usable_threads() if self.devices == 1 else 1) as pool:
                parts = list(pool.map(of_block, each(self.data)))
            loss, scores, hessian = (np.stack(part).sum(axis=0) for part in zip(*parts, strict=True))
            return NormalEquations(float(loss), scores.sum(axis=0), hessian), scores

        return evaluate

    def _block_loss(self, vector: Array, block: Blocks) -> Float[Array, ""]:
        values = self.space.values(vector)
        residuals = self._residuals(values, *self._initial(values, block), block)
        return self._sum(jnp.square(residuals)) / self._terms

    def _loss_of_prediction(self, predicted: tuple[Array, Array], block: Blocks) -> Float[Array, ""]:
        """A block's part of the objective where initial states are not refined."""
        errors = self._errors(block.qpos[:, 0], block.qvel[:, 0], predicted, block)
        return self._sum(jnp.square(errors)) / self._terms

    def _sum(self, squares: Array) -> Array:
        square = self._scale**2
        return jnp.sum(self._robust(squares / square)) * square

    def _residuals(self, values: Values, qpos: Array, qvel: Array, block: Blocks) -> Float[Array, "segments time nv 2"]:
        return self._errors(qpos, qvel, self._rollout(values, qpos, qvel, block.signals, block.load), block)

    def _errors(
        self, qpos: Array, qvel: Array, predicted: tuple[Array, Array], block: Blocks
    ) -> Float[Array, "segments time nv 2"]:
        """Weighted errors of position and velocity, with that of the initial state first where it is refined."""
        errors = []
        for root, start, after, measured in zip(
            self._roots, (qpos, qvel), predicted, (block.qpos, block.qvel), strict=True
        ):
            whole = jnp.concatenate([start[:, None], after], axis=1) if self._refine else after
            errors.append(root * (whole - (measured if self._refine else measured[:, 1:])))
        return jnp.stack(errors, axis=-1) * block.weight[:, None, None, None]

    def _initial(self, values: Values, block: Blocks) -> tuple[Array, Array]:
        """Where the segments start: as measured, or as fits the whole segment best.

        No derivative goes through the search: at its end the objective does not change with the initial states, so
        that its derivative is that at fixed ones.
        """
        state = (block.qpos[:, 0], block.qvel[:, 0])
        if not self._refine:
            return state
        values, block = jax.lax.stop_gradient((values, block))
        unused = self._unused_states(block)

        def improve(_: Any, search: tuple) -> tuple:
            """One step of Levenberg and Marquardt in every segment; it counts where it lowers the error."""
            state, residuals, slopes, damping = search
            curvature = jnp.einsum("ibsk,jbsk->bsij", slopes, slopes)
            damped = curvature * (1 + damping[:, :, None, None] * jnp.eye(len(slopes))) + unused
            step = jax.vmap(jax.vmap(solve_spd))(damped, jnp.einsum("ibsk,bsk->bsi", slopes, residuals))
            trial = state - step
            tried, sloped = self._with_slopes(values, trial, block)
            better = jnp.sum(jnp.square(tried), axis=2) < jnp.sum(jnp.square(residuals), axis=2)
            return (
                jnp.where(better[:, :, None], trial, state),
                jnp.where(better[:, :, None], tried, residuals),
                jnp.where(better[:, :, None], sloped, slopes),
                damping * jnp.where(better, 0.1, 10.0),
            )

        start = self._sparsity.states_by_branch(jnp.concatenate(state, axis=1))
        search = (start, *self._with_slopes(values, start, block), jnp.full(start.shape[:2], 1e-3, start.dtype))
        found = self._sparsity.states_together(jax.lax.fori_loop(0, _REFINEMENTS, improve, search)[0])
        qpos, qvel = jnp.split(jax.lax.stop_gradient(found), 2, axis=1)
        return qpos, qvel

    def _unused_states(self, block: Blocks) -> Float[Array, "branches segments state state"]:
        """What makes equations of initial states solvable that do not count."""
        identity = jnp.eye(len(self._sparsity.states)) * (1 - block.weight[:, None, None])
        return self._sparsity.unit_states(block.weight.dtype)[:, None] + identity

    def _with_slopes(
        self, values: Values, state: Float[Array, "branches segments state"], block: Blocks
    ) -> tuple[Float[Array, "branches segments terms"], Float[Array, "state branches segments terms"]]:
        """Residuals, and their derivative with respect to each entry of a branch's initial position and velocity."""

        def residuals(state: Array) -> Array:
            qpos, qvel = jnp.split(state, 2, axis=1)
            return self._sparsity.by_branch(self._residuals(values, qpos, qvel, block))

        whole = self._sparsity.states_together(state)
        units = jnp.asarray(self._sparsity.states, whole.dtype)[:, None, :] * jnp.ones_like(whole[:, :1])
        return residuals(whole), jax.vmap(lambda unit: jax.jvp(residuals, (whole,), (unit,))[1])(units)

    def _block_equations(self, vector: Array, block: Blocks, exact: bool) -> tuple[Array, Array, Array]:
        """Loss, gradient of each stretch, and second derivative."""
        qpos, qvel = self._initial(self.space.values(vector), block)

        def residuals(vector: Array) -> Array:
            return self._sparsity.by_branch(self._residuals(self.space.values(vector), qpos, qvel, block))

        errors = residuals(vector)
        slopes = jax.vmap(lambda unit: jax.jvp(residuals, (vector,), (unit,))[1])(
            jnp.asarray(self._sparsity.seeds, vector.dtype)
        )
        loss = self._sum(jnp.square(errors))
        # For a robust loss every residual counts by the slope of its loss, as in iteratively reweighted least squares.
        squares = jnp.square(errors) / self._scale**2
        each = jnp.vectorize(jax.grad(self._robust))
        share = curvature = each(squares)
        if exact:
            curvature = share + 2 * squares * jnp.vectorize(jax.grad(jax.grad(self._robust)))(squares)
        # A GPU rounds the factors of a product to 10 bits unless told otherwise: too few to see what is collinear.
        of_segment = jnp.einsum("ibsk,bsk->bsi", slopes, share * errors, precision="highest")
        hessian = jnp.einsum("ibsk,jbsk->bij", slopes, curvature * slopes, precision="highest")
        if self._refine:
            start = self._sparsity.states_by_branch(jnp.concatenate([qpos, qvel], axis=1))
            _, own = self._with_slopes(self.space.values(vector), start, block)
            inverse_of = jnp.einsum("ibsk,jbsk->bsij", own, own) + self._unused_states(block)
            mixed = jnp.einsum("ibsk,jbsk->bsji", own, slopes)
            right = jnp.einsum("ibsk,bsk->bsi", own, errors)
            solved = jax.vmap(jax.vmap(jax.vmap(solve_spd, in_axes=(None, 0))))(inverse_of, mixed)
            of_segment = of_segment - jnp.einsum("bsji,bsi->bsj", solved, right)
            hessian = hessian - jnp.einsum("bsji,bski->bjk", solved, mixed)
        members = jax.nn.one_hot(block.stretch, self.stretches, dtype=vector.dtype)
        gradient, hessian = self._sparsity.gradient(of_segment), self._sparsity.hessian(hessian)
        scores = jnp.einsum("sg,si->gi", members, gradient, precision="highest")
        return loss / self._terms, scores / self._terms, hessian / self._terms
