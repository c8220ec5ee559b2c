"""Interface of a fit method: its start, one iteration, and whether it has converged."""

from abc import ABC, abstractmethod
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from frictionzoo.core.described import Described
from frictionzoo.core.errors import ConfigError, refuse_unlike
from frictionzoo.core.registry import KINDS, Registry
from frictionzoo.fit.blocks import Blocks
from frictionzoo.fit.link_inertia import LinkInertia
from frictionzoo.fit.motion import Filtering, Recordings
from frictionzoo.fit.normal_equations import Scores
from frictionzoo.fit.objective import Objective


class Evaluation(NamedTuple):
    """Evaluation at a vector: objective, gradient (zeros if unused), and whether the method cannot continue from it."""

    loss: Any
    gradient: Any
    lost: Any


class Fit(Described, ABC):
    """Iterative method that finds parameters, one vector per iteration.

    The loop handles chunks of iterations, history, the best vector and checkpoints. A method is immutable: it keeps
    what changes in a state, a pytree of arrays.

    Attributes:
        name: Name in results, set by `register_method`.
        traced: Whether `step` is a JAX function that the loop compiles; otherwise it is called from Python.
        start: The method whose best vector is the starting point; None for the initial values.
        filtering: Default filtering of torques when the evaluation compares recorded and identified torque.
        held: Whether a recorded command acts until the next sample in that comparison.
    """

    name: ClassVar[str]
    traced: ClassVar[bool] = True
    start: "Fit | None" = None
    filtering: Filtering = Filtering()
    held: bool = True

    def revise(self, recordings: Recordings) -> LinkInertia | None:
        """Identify link inertia and gravity of the bench before any simulation; None to change nothing."""
        return None if self.start is None else self.start.revise(recordings)

    def choose(self, objective: Objective) -> "Fit":
        """Return the method to run for this objective: this one, unless its choice depends on the model."""
        return self

    @abstractmethod
    def total(self, objective: Objective) -> int:
        """Return the largest number of iterations of the whole fit.

        Raises:
            ConfigError: The method cannot search this space.
        """

    def init(self, objective: Objective) -> tuple[Any, Any]:
        """Return the first vector to try, and the method's initial state."""
        return objective.space.start, ()

    @abstractmethod
    def step(self, objective: Objective, vector: Any, state: Any, data: Blocks) -> tuple[Evaluation, Any, Any]:
        """Do one iteration: evaluate the vector, of shape (coordinates,).

        `data` is the data argument of the objective's functions.

        Returns:
            The evaluation at the vector, the next vector, and the next state.
        """

    def done(self, state: Any) -> Any:
        """Return whether the method has converged."""
        return False

    def prepare(self, objective: Objective) -> None:
        """Compile what `step` calls, if the loop does not compile `step` itself."""

    def compile_scores(self, objective: Objective) -> Scores:
        """Return the function from which confidence intervals follow: the objective's, unless the loss differs."""
        return objective.compile_scores()


class Search(Fit):
    """Method whose vectors do not depend on earlier results, so that the loop evaluates many at once."""

    @abstractmethod
    def candidate(self, objective: Objective, iteration: Any) -> Float[Array, "coordinates"]:
        """Return the vector of an iteration, counted from 0."""

    def init(self, objective: Objective) -> tuple[Any, Any]:
        """See `Fit.init`."""
        return self.candidate(objective, jnp.asarray(0)), jnp.asarray(0)

    def step(self, objective: Objective, vector: Any, state: Any, data: Blocks) -> tuple[Evaluation, Any, Any]:
        """See `Fit.step`. A loss that is not finite does not end the search."""
        following = state + 1
        evaluation = Evaluation(objective.loss(vector, data), jnp.zeros_like(vector), lost=False)
        return evaluation, self.candidate(objective, following), following


REGISTRY = Registry(KINDS["methods"], Fit, "step")

register_method = REGISTRY.register
"""Class decorator that registers a fit method under a name; see `Registry.register`."""


def as_start(start: Any) -> Fit | None:
    """Return an argument `start` if it is a method or None; raise ConfigError otherwise."""
    if start is not None:
        refuse_unlike("fit.start", start, Fit, "another fit, such as start=inverse_dynamics, or null")
    return start


def refuse_nothing(objective: Objective) -> None:
    """Raise ConfigError if there is no parameter to identify."""
    if not objective.space.names:
        raise ConfigError(
            "no parameter is to be identified, expected at least one; set identify: true for one, or fit=known"
        )


def refuse_torch(objective: Objective, name: str) -> None:
    """Raise ConfigError for a model that exists only in torch, which has a gradient but no Jacobian."""
    if objective.torch_law:
        raise ConfigError(
            f"fit={name}: {objective.torch_law} exists only in torch, expected a formula over xp; use fit=adam"
        )
