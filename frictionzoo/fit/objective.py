"""Loss that a fit minimises: mean square error of simulated segments."""

import copy
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import torch
from jax.sharding import NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float

from frictionzoo.core.errors import ConfigError
from frictionzoo.core.segments import Segments
from frictionzoo.fit.blocks import Blocks, divide, each, each_part, into_blocks, measured_states
from frictionzoo.fit.equations import Residuals, compile_equations
from frictionzoo.fit.loss import Loss, count_terms, is_moving, mean_squares, rigid_inertia_of
from frictionzoo.fit.motion import Recordings
from frictionzoo.fit.normal_equations import Evaluate, NormalEquations, Scores
from frictionzoo.fit.shooting import DAMPING, SearchStart
from frictionzoo.fit.space import Space
from frictionzoo.fit.sparsity import Sparsity
from frictionzoo.simulation.bridge import as_torch_function, to_arrays, to_tensors
from frictionzoo.simulation.rollout import Rollout
from frictionzoo.simulation.torch_rollout import TorchRollout

T = TypeVar("T")


class Objective:
    """Weighted mean square error of simulated positions and velocities over all segments, by the fit's coordinates.

    Source: Kovalev et al., Proc. MIPT 18(2), 2026, equation (3), with a mean in place of the sum and one weight each
    for position and velocity.

    Attributes:
        data: The segments, spread over all local devices: the last argument of `loss` and `value_and_grad`.
        devices: Number of these devices.
        stretches: Number of stretches of consecutive segments; see `divide`.
        compile: `jax.jit` for functions that call these methods.
        interval: Sample interval [s].
        sizes: Mean squares by which `balanced` divides squared errors, of shape (nv, 2); None without it.
        recordings: Recordings that the segments were cut from; None where the segments follow another drive.

    Args:
        loss: Arguments of `Loss`.

    Raises:
        ConfigError: The options of the loss are invalid; the model exists only in torch and `refine` or `impulse` is
            set; `continuity` is set but no segment follows another.
    """

    def __init__(self, space: Space, rollout: Rollout, segments: Segments, *loss: Any, **options: Any) -> None:
        self._loss = Loss(*loss, **options)
        refine, continuity = self._loss.refine, self._loss.continuity
        for option, reason in (("refine", "with no forward mode"), ("impulse", "where the loss has no armature")):
            if isinstance(rollout, TorchRollout) and getattr(self._loss, option):
                raise ConfigError(
                    f"loss.{option}=true: {rollout.law} exists only in torch, {reason}; set loss.{option}=false"
                )
        if continuity and (segments.follows is None or not segments.follows.any()):
            raise ConfigError(
                f"loss.continuity={continuity:g}: no segment begins where another ends; expected neighbours, as "
                "segments.count=null and a shorter segments.length give them"
            )
        self.space: Space = space
        self.compile: Callable[..., Any] = rollout.compile
        self.interval: float = segments.timestep
        stretch = divide(segments)
        self.stretches: int = int(stretch[-1]) + 1
        counts = is_moving(segments, self._loss.slow) if self._loss.slow else None
        inertia = rigid_inertia_of(space.bench, segments) if self._loss.impulse else None
        self.data: Blocks = into_blocks(segments, stretch, space.start.dtype, rollout, counts, inertia)
        self.devices: int = len(self.data.weight.sharding.device_set)
        self._rollout = rollout
        self.recordings: Recordings | None = None
        self._programs: dict[Any, Any] = {}  # compiled equations, which the evaluation uses again
        self.sizes: np.ndarray | None = None
        self._begun: SearchStart | None = None
        self._wider: tuple[Objective, np.ndarray, np.ndarray] | None = None
        self._correction: tuple[Array, Array] | None = None  # added to measured states
        self._sparsity = Sparsity.of(space, rollout.branches)
        self._terms = float(count_terms(self.data).sum()) + refine * segments.count * segments.qpos.shape[2]

    def for_drive(self, space: Space, rollout: Rollout) -> "Objective":
        """Return this objective for another drive on the same bench; the data stay on the devices."""
        other = copy.copy(self)
        other.space, other.compile, other._rollout = space, rollout.compile, rollout
        other._sparsity = Sparsity.of(space, rollout.branches)
        other.recordings, other._programs, other._wider, other._correction = None, {}, None, None
        return other.beginning(np.asarray(measured_states(self.data.qpos, self.data.qvel)))

    def starting(self, vector: Float[np.ndarray, "coordinates"]) -> "Objective":
        """Return this objective with other initial coordinates, clipped to the bounds."""
        other = copy.copy(self)
        other.space = self.space.starting(vector)
        return other

    @property
    def begun(self) -> SearchStart | None:
        """Start of the search for initial states with their derivatives; None where they are not estimated."""
        if not self._loss.refine:
            return None
        if self._begun is not None:
            return self._begun
        objective, vector = self._whole(self.space.start)
        sparsity, states = objective._sparsity, np.asarray(self.data.begun, np.float64)
        slopes = np.zeros((len(sparsity.joints), self.data.weight.size, len(sparsity.states), len(sparsity.seeds)))
        return SearchStart(states, vector, slopes, np.asarray(np.inf), np.full(slopes.shape[:2], DAMPING))

    @property
    def negligible(self) -> float:
        """Relative decrease of the loss that is worth no further trial where initial states are estimated, else 0.

        It is a decrease of chi-square by 0.1: every parameter is within a third of its standard error of the minimum.
        """
        return 0.1 / self._terms if self._loss.refine else 0.0

    @property
    def timestep(self) -> float:
        """Time step of the simulation whose normal equations are compiled [s]."""
        return self._whole(self.space.start)[0].space.bench.timestep

    def beginning(self, begun: SearchStart | Float[np.ndarray, "blocks segments twice_nv"] | None) -> "Objective":
        """Return this objective with another start for the search for initial states; None changes nothing."""
        if begun is None:
            return self
        other, like = copy.copy(self), self.data.begun
        other._begun, states = (begun, begun.states) if isinstance(begun, SearchStart) else (None, begun)
        other.data = self.data._replace(begun=jax.device_put(np.asarray(states, like.dtype), like.sharding))
        return other

    def among(self, kept: Bool[np.ndarray, "segments"] | None) -> "Objective":
        """Return this objective restricted to these segments; None changes nothing."""
        if kept is None:
            return self
        other, weight = copy.copy(self), self.data.weight
        counts = np.zeros(weight.size, weight.dtype)
        counts[: len(kept)] = kept
        other.data = self.data._replace(weight=weight * jax.device_put(counts.reshape(weight.shape), weight.sharding))
        return other

    def balanced(self, sizes: Float[np.ndarray, "nv 2"] | None = None) -> "Objective":
        """Return this objective with errors divided by their size at the start of the fit, joint by joint.

        The size is the root mean square of position and velocity errors from measured initial states, as in weighted
        least squares. `sizes` holds the mean squares; None computes them. Without `by_joint` nothing changes.

        Raises:
            ConfigError: The rollouts at the start are not finite.
        """
        if not self._loss.by_joint:
            return self
        other = copy.copy(self)
        if sizes is None:
            sizes = mean_squares(self._loss, self._rollout.compiled, self.space.values(self.space.start), self.data)
        other.sizes, other._loss, other._programs = sizes, self._loss.over(sizes), {}
        return other

    def within(self, wider: "Objective", vector: Float[np.ndarray, "wider"]) -> "Objective":
        """Return this objective evaluated by the equations of `wider`, whose further coordinates `vector` fixes."""
        other = copy.copy(self)
        indices = np.array([wider.space.labels.index(label) for label in self.space.labels], int)
        other._wider, other._programs = (wider, indices, vector), {}
        return other

    def predict(
        self, vector: Float[np.ndarray, "coordinates"], states: Any = None
    ) -> list[Float[Array, "blocks segments time nv"]]:
        """Return simulated positions and velocities by block and segment.

        `states` are initial states, (blocks, segments, twice nv); None uses those at which their search begins.
        """
        values = self.space.values(jnp.asarray(vector, self.space.start.dtype))
        # numpy, on no device yet: arrays on a device would compile the rollouts again.
        states = np.asarray(self.data.begun if states is None else states)
        starts = (jnp.split(jnp.asarray(state), 2, axis=1) for state in states)
        parts = [
            self._rollout.compiled(values, *start, block.signals, block.load)
            for start, block in zip(starts, each(self.data), strict=True)
        ]
        return [jnp.stack(part) for part in zip(*parts, strict=True)]

    def approaching(self, finer: "Objective", vector: Float[np.ndarray, "coordinates"]) -> "Objective":
        """Return this objective with the residuals of a finer simulation near a vector, but its present derivatives.

        Measured states are shifted by the difference of the rollouts, so the finer simulation needs no derivatives.
        `finer` may have more coordinates; see `within`.

        Source: V. Pereyra, "Iterated deferred corrections for nonlinear boundary value problems", 1968.
        """
        other, begun, (wider, coordinates) = copy.copy(self), self.data.begun, self._whole(vector)
        fine = finer.predict(coordinates if finer.space.labels == wider.space.labels else vector, begun)
        pairs = zip(wider.predict(coordinates, begun), fine, strict=True)
        qpos, qvel = (coarse - fine for coarse, fine in pairs)
        other._correction = qpos, qvel
        return other

    def _whole(self, vector: Any) -> tuple["Objective", Float[np.ndarray, "wider"]]:
        """Return the objective whose equations are compiled, and its coordinates."""
        if self._wider is None:
            return self, np.asarray(vector, np.float64)
        wider, places, fixed = self._wider
        coordinates = np.array(fixed, np.float64)
        coordinates[places] = vector
        return wider, coordinates

    def describe(self) -> str:
        """Return the compiled program of a block's residuals as text, with the settings of the loss."""

        def residuals(vector: Array, block: Blocks) -> Array:
            measured = measured_states(block.qpos[None], block.qvel[None])[0]
            return self._residuals(self.space.values(vector), measured, measured, block)

        block = next(each(self.data))
        return self.compile(residuals, forward=True).lower(self.space.start, block).as_text() + repr(self._loss)

    def remember(self, what: Hashable, make: Callable[[], T]) -> T:
        """Return the object stored under this name, or make and store it."""
        if what not in self._programs:
            self._programs[what] = make()
        return self._programs[what]

    @property
    def torch_law(self) -> str | None:
        """Name of the friction model if it exists only in torch, else None.

        With such a model the loss takes concrete arrays, cannot be compiled, and has a gradient but no Jacobian.
        """
        return self._rollout.law if isinstance(self._rollout, TorchRollout) else None

    def spread(self, tree: Any) -> Any:
        """Copy arrays to every device that holds data, as functions compiled for several devices expect."""
        sharding = self.data.weight.sharding
        if self.devices == 1:
            return tree
        return jax.device_put(tree, NamedSharding(sharding.mesh, PartitionSpec()))

    def collect(self, tree: Any) -> Any:
        """Copy arrays back to the first device, where torch can read them."""
        devices = self.data.weight.sharding.device_set
        return tree if self.devices == 1 else jax.device_put(tree, min(devices, key=lambda device: device.id))

    def loss(self, vector: Float[Array, "coordinates"], data: Blocks) -> Float[Array, ""]:
        """Return the objective at a vector."""
        residuals = self._residuals
        states = residuals.states(vector, data)
        if self.torch_law:
            return jnp.sum(jnp.stack([residuals.block_loss(vector, *part) for part in each_part(data, states)]))
        return jnp.sum(jax.lax.map(lambda part: residuals.block_loss(vector, *part), (data, *states)))

    def value_and_grad(self, derivative: str) -> Callable[[Array, Blocks], tuple[Array, Array]]:
        """Return a function of a vector and the data that gives the objective and its gradient, not compiled.

        `derivative` is `forward` (one tangent per coordinate), `reverse`, or `auto` for the cheaper one.

        Raises:
            ConfigError: The engine has no reverse mode for this bench, or the model has no forward mode.
        """
        if isinstance(self._rollout, TorchRollout):
            return self._value_and_grad_in_torch(self._rollout, derivative)
        if derivative == "reverse" and not self._rollout.engine.reverse:
            raise ConfigError(
                "fit.derivative=reverse: engine=mjx solves the constraints of several joints in a loop, which reverse "
                "mode cannot pass; set fit.derivative=forward or engine=specialised"
            )
        engine = self._rollout.engine
        few = len(self.space.start) <= engine.forward_limit or not engine.reverse
        reverse, residuals = derivative == "reverse" or (derivative == "auto" and not few), self._residuals

        def of_block(vector: Array, part: tuple[Blocks, Array, Array]) -> tuple[Array, Array]:
            if reverse:
                return jax.value_and_grad(residuals.block_loss)(vector, *part)
            slope = jax.vmap(lambda tangent: jax.jvp(lambda x: residuals.block_loss(x, *part), (vector,), (tangent,)))
            losses, gradient = slope(jnp.eye(len(vector), dtype=vector.dtype))
            return losses[0], gradient

        def of_all(vector: Array, data: Blocks) -> tuple[Array, Array]:
            parts = (data, *residuals.states(vector, data))
            losses, gradients = jax.lax.map(lambda part: of_block(vector, part), parts)
            return jnp.sum(losses), jnp.sum(gradients, axis=0)

        return of_all

    def _value_and_grad_in_torch(
        self, rollout: TorchRollout, derivative: str
    ) -> Callable[[Array, Blocks], tuple[Array, Array]]:
        if derivative == "forward":
            raise ConfigError(
                f"fit.derivative=forward: {rollout.law} exists only in torch, which has reverse mode only; set "
                "fit.derivative=reverse or auto"
            )
        if not rollout.engine.reverse:
            raise ConfigError(
                f"{rollout.law} exists only in torch and needs reverse mode, which engine=mjx lacks for "
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
                loss.backward()  # block by block, so that memory holds the steps of one block only
                losses.append(loss.detach())
            return to_arrays((torch.stack(losses).sum(), moving.grad))

        return of_all

    def _loss_of_prediction(self, predicted: tuple[Array, Array], block: Blocks) -> Float[Array, ""]:
        """Return a block's part of the objective where initial states are not estimated."""
        errors = self._loss.errors((block.qpos[:, 0], block.qvel[:, 0]), predicted, None, block)
        return self._loss.sum(jnp.square(errors)) / self._terms

    def compile_normal_equations(self) -> Evaluate:
        """Return a compiled function of a vector that gives the normal equations with exact Jacobians.

        Blocks are summed one by one in float64, so no Jacobian of all residuals is in memory. Estimated initial states
        are eliminated.
        """
        evaluate = self._compile_equations(exact=False)
        return lambda vector: evaluate(vector)[0]

    def compile_scores(self) -> Scores:
        """Return the function of `compile_normal_equations`, extended by the gradient of each stretch of segments.

        A robust loss enters the Hessian with its exact second derivative, which can be negative. A fit uses its slope
        instead, so that every step descends.
        """
        return self._compile_equations(exact=self._loss.robust != "none")

    def _compile_equations(self, exact: bool) -> Scores:
        places = slice(None) if self._wider is None else self._wider[1]
        objective = self._whole(self.space.start)[0]
        start = objective.spread(objective.space.start)
        compiled = objective.remember(
            exact, lambda: compile_equations(objective._residuals, objective.data, start, exact)
        )

        def evaluate(vector: Float[np.ndarray, "coordinates"]) -> tuple[NormalEquations, np.ndarray]:
            coordinates = self.spread(jnp.asarray(self._whole(vector)[1], self.space.start.dtype))
            loss, scores, hessian, begun = compiled(coordinates, self._corrected, self._begun)
            scores, hessian = scores[:, places], hessian[places][:, places]
            return NormalEquations(float(loss), scores.sum(axis=0), hessian, begun), scores

        return evaluate

    @property
    def _corrected(self) -> Blocks:
        """Data of the compiled equations, with the correction of `approaching` added to the measured states."""
        wider, data = self._whole(self.space.start)[0], self.data
        if wider is not self:  # with a delay among its coordinates, its commands start earlier
            data = wider.data._replace(qpos=data.qpos, qvel=data.qvel, weight=data.weight, begun=data.begun)
        if (correction := self._correction or wider._correction) is None:
            return data
        states = zip((data.qpos, data.qvel), correction, strict=True)
        qpos, qvel = (measured.at[:, :, 1:].add(shift) for measured, shift in states)
        return data._replace(qpos=qpos, qvel=qvel)

    @property
    def _residuals(self) -> Residuals:
        sums = self._sparsity, self.interval, self._terms, self.stretches
        return Residuals(self.space, self._rollout, self._loss, *sums)
