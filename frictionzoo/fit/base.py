"""The interface of a fit method: where it begins, one iteration, and whether there is more to gain."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from frictionzoo.core.described import Described
from frictionzoo.core.errors import ConfigError, refuse_unlike
from frictionzoo.core.registry import KINDS, Registry
from frictionzoo.fit.blocks import Blocks
from frictionzoo.fit.link_inertia import LinkInertia
from frictionzoo.fit.motion import Filtering
from frictionzoo.fit.normal_equations import NormalEquations
from frictionzoo.fit.objective import Objective
from frictionzoo.fit.recordings import Recordings

Scores = Callable[
    [Float[np.ndarray, "coordinates"]], tuple[NormalEquations, Float[np.ndarray, "stretches coordinates"]]
]
"""From a vector to the normal equations there, and the part of the gradient that comes from each stretch of time."""


class Seen(NamedTuple):
    """What a method saw at one vector.

    Attributes:
        loss: The objective, of shape ().
        gradient: Its gradient, of shape (coordinates,); zeros where the method uses none.
        lost: Whether the method cannot go on from here.
    """

    loss: Any
    gradient: Any
    lost: Any


class Fit(Described, ABC):
    """A way of finding parameters, vector by vector.

    What goes around it is the loop's: chunks of iterations, history, the best vector, checkpoints. A method keeps what
    it needs in a state of its own, a pytree of arrays, and holds nothing that changes.

    Attributes:
        name: Its name in results, set by `register_method`.
        traced: Whether `step` is a JAX function, which the loop compiles; otherwise it is called from Python.
        start: The method at whose best vector this one begins; None: at the initial values.
        filtering: How recorded torque is compared with what the identified drive needs, where the evaluation does not
            say otherwise.
        held: Whether a recorded command acts until the next sample there.
    """

    name: ClassVar[str]
    traced: ClassVar[bool] = True
    start: "Fit | None" = None
    filtering: Filtering = Filtering()
    held: bool = True

    def revise(self, recordings: Recordings) -> LinkInertia | None:
        """What the method finds of the test stand itself, before anything is simulated; None: it stays as it is."""
        return None if self.start is None else self.start.revise(recordings)

    def choose(self, objective: Objective) -> "Fit":
        """The method that does the work for this objective: this one, unless it leaves the choice to the law."""
        return self

    @abstractmethod
    def total(self, objective: Objective) -> int:
        """Largest number of iterations that the whole fit takes.

        Raises:
            ConfigError: The method cannot search this space.
        """

    def init(self, objective: Objective) -> tuple[Any, Any]:
        """The vector that is tried first, and the method's state then."""
        return objective.space.start, ()

    @abstractmethod
    def step(self, objective: Objective, vector: Any, state: Any, data: Blocks) -> tuple[Seen, Any, Any]:
        """One iteration.

        Args:
            objective: What is minimised.
            vector: What is tried, of shape (coordinates,).
            state: The method's own.
            data: What the objective's functions take.

        Returns:
            What was seen at the vector, the vector that is tried next, and the state then.
        """

    def done(self, state: Any) -> Any:
        """Whether the method sees nothing left to gain."""
        return False

    def prepare(self, objective: Objective) -> None:
        """Compile what `step` calls, where the loop does not compile it as a whole."""

    def compile_scores(self, objective: Objective) -> Scores:
        """What intervals of the result are taken from: the objective's own, unless the method has another loss."""
        return objective.compile_scores()


class Search(Fit):
    """A method whose iterations do not look at what the ones before found: the loop tries many vectors at once."""

    @abstractmethod
    def candidate(self, objective: Objective, iteration: Any) -> Float[Array, "coordinates"]:
        """The vector of an iteration, counted from 0."""

    def init(self, objective: Objective) -> tuple[Any, Any]:
        """See `Fit.init`."""
        return self.candidate(objective, jnp.asarray(0)), jnp.asarray(0)

    def step(self, objective: Objective, vector: Any, state: Any, data: Blocks) -> tuple[Seen, Any, Any]:
        """See `Fit.step`. A vector without a finite loss loses; it does not end the search."""
        following = state + 1
        seen = Seen(objective.loss(vector, data), jnp.zeros_like(vector), lost=False)
        return seen, self.candidate(objective, following), following


REGISTRY = Registry(KINDS["methods"], Fit, "step")

register_method = REGISTRY.register
"""Class decorator that makes a fit method known by its name, as `Registry.register`."""


def as_start(start: Any) -> Fit | None:
    """What an argument `start` gives, a method or None; ConfigError for anything else."""
    if start is not None:
        refuse_unlike("fit.start", start, Fit, "another fit, such as start=inverse_dynamics, or null")
    return start


def refuse_nothing(objective: Objective) -> None:
    """ConfigError where nothing is to be identified."""
    if not objective.space.names:
        raise ConfigError(
            "no parameter is to be identified, expected at least one; set identify: true for one, or fit=known"
        )


def refuse_torch(objective: Objective, name: str) -> None:
    """ConfigError for a law that exists only in torch, of which there is a gradient and nothing else."""
    if objective.torch_law:
        raise ConfigError(
            f"fit={name}: {objective.torch_law} exists only in torch, expected a formula over xp; use fit=adam"
        )
