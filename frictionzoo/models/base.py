"""The whole plug-in interface of a friction model."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch

from frictionzoo.core.described import Described
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.params import Param, read_params, refuse_negative
from frictionzoo.core.state import DriveState, FrictionTerms

Values = Mapping[str, Any]
"""Arrays of a law under the names of its `state_dict`."""
Params = Mapping[str, Mapping[str, Any] | Sequence[float] | float | int]
"""Of each physical parameter its section, `init`, `low`, `high`, `scale`, `identify`, or its value if that is known,
one for all joints or a list."""
Within = Mapping[str, str | float | Callable[[Values], Any]]
"""What parameters of a law are where it is another one: a number that they have then, the name of the other's parameter
that they equal, or a function of the other's values, one to one. What is not listed has one name in both."""


class FrictionModel(Described, torch.nn.Module, ABC):
    """A friction law: a torch module that owns its parameters, and one formula written over an array namespace.

    A law declares its physical parameters in `dimensions`; they become `torch.nn.Parameter`s of shape (nv,) that hold
    values in SI units, so that a saved state reads as physics. Anything else it registers as a parameter (the weights
    of a network) is optimised as it is, without bounds.

    Attributes:
        name: The law's name, set by `register_model`.
        dimensions: Dimension of each physical parameter, a key of `frictionzoo.core.params.UNITS`.
        constraint: Whether the law answers with a `frictionloss`, so that the simulated joint needs MuJoCo's friction
            constraint.
        constrained: The same of each joint; where not, the `frictionloss` that others answer with is 0.
        dissipative: Whether the law promises never to give energy to the drive, whatever its values within bounds: all
            its terms together oppose the motion while the joint slides, and hold it where it stands still. Of a law
            with a memory: at constant velocity, for what bends springs back.
        inputs: What the law looks at in each sample besides the state, a field of `DriveState` that recordings have
            among their extras, and the value at which it acts where they lack it.
        contains: Laws that this one is with certain values, by name, and these values. What it has besides is without
            effect then.
        valleys: Parameters over which the loss is known to have several minima, and multiples of the initial value at
            which a search begins besides.
        memory: Numbers that the law remembers of each joint from step to step; 0 for a function of the present state.
        shortest_segment: Length of segments [s] that a recipe chooses at least, in recordings of ten times that: a
            rollout begins with a memory that is guessed, and has to forget it early in each.
        sees: What the friction changes with, of `frictionzoo.models.sees.SEES`: `speed`; `slow`, that it falls as the
            speed rises; `fast`, that it grows faster than the speed; `direction`, that it differs between the two;
            `load`, `position`, `temperature`; `reversal`, that it remembers how long ago the motion turned round. By
            this a run's verdict names the law that has a term which another lacks; a law that says nothing is not
            named.
        params: Each physical parameter's initial value, bounds and scale.

    Args:
        nv: Number of joints.
        params: As `Params` says.

    Raises:
        ConfigError: There is no joint, or a parameter is missing, unknown, or its bounds make no sense.
    """

    name: ClassVar[str]
    dimensions: ClassVar[Mapping[str, str]] = {}
    constraint: bool = False
    dissipative: bool = False
    inputs: Mapping[str, float] = {}
    contains: ClassVar[Mapping[str, Within]] = {}
    valleys: ClassVar[Mapping[str, Sequence[float]]] = {}
    memory: int = 0
    shortest_segment: float = 0.0
    sees: ClassVar[tuple[str, ...]] = ()

    def __init__(self, nv: int, params: Params | None = None) -> None:
        super().__init__()
        if not isinstance(nv, int) or isinstance(nv, bool) or nv < 1:
            raise ConfigError(f"nv={nv!r}; expected the number of joints, a whole one from 1 on")
        self.nv = nv
        self.params: dict[str, Param] = read_params(type(self).__name__, self.dimensions, params or {})
        refuse_negative(f"{type(self).__name__}: ", self.params)
        for name, param in self.params.items():
            self.register_parameter(name, torch.nn.Parameter(_initial(param, nv), requires_grad=param.is_identified))

    @property
    def constrained(self) -> tuple[bool, ...]:
        """See above."""
        return self.nv * (self.constraint,)

    def of_joint(self, joint: int) -> tuple["FrictionModel", int, str]:
        """The law of one joint, its place in that law, and what stands before that law's names in this one's values.

        Args:
            joint: Its index.
        """
        return self, joint, ""

    def begin(self, values: Mapping[str, Any]) -> None:
        """Let parameters begin with these values, each of shape (nv,), by name."""
        for name, value in values.items():
            self.get_parameter(name).data.copy_(torch.tensor(np.asarray(value)))

    def bind(self, joints: Sequence[str]) -> None:
        """Give each joint what parameters say by patterns of joints' names; what has a value already keeps it.

        Raises:
            ConfigError: A joint fits no pattern, or a list has not an entry for each joint.
        """
        for name, param in self.params.items():
            if not param.is_resolved:
                self.params[name] = param.for_joints(joints)
                self.get_parameter(name).data.copy_(_initial(self.params[name], self.nv))

    @abstractmethod
    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """The law itself, pure: no attribute that a fit changes, no branch on a value.

        Of a law with a memory: what it comes down to at constant velocity.

        Args:
            xp: Array namespace, `torch` or `jax.numpy`.
            values: Arrays of this namespace under the names of `state_dict`.
            state: What the drive is doing, arrays of shape (..., nv).

        Returns:
            Terms of shape (..., nv), or that broadcast to it.
        """

    def settle(self, xp: Any, values: Values, state: DriveState) -> Any:
        """The memory that a simulation begins with, of shape (..., nv, memory): as if the drive had long been so.

        Arguments are as in `terms`.
        """
        return xp.zeros((*state.qvel.shape, self.memory))

    def advance(
        self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> tuple[FrictionTerms, Any]:
        """One step of a simulation: the terms that act until the next state, and the memory in this one.

        A law with a memory overrides it together with `settle`; pure like `terms`, with the same arguments, what the
        step before left, of shape (..., nv, memory), and the timestep of the simulation [s].
        """
        return self.terms(xp, values, state), memory

    def prepare(self, samples: DriveState) -> None:
        """Take constants (normalisation) from the training data; most laws need none.

        An identification calls it before it takes the law's values, with a law that may have been fitted before. So
        constants that other values belong to, such as weights, are taken once: a later call leaves them as they are.

        Args:
            samples: Training samples as numpy arrays of shape (samples, nv).
        """

    def forward(self, state: DriveState) -> FrictionTerms:
        """The law in torch with this module's own values, of torch tensors of shape (..., nv)."""
        return self.terms(torch, self.state_dict(keep_vars=True), state)


def sliding_torque(xp: Any, terms: FrictionTerms, qvel: Any) -> Any:
    """The torque of all terms of a law while the joint slides, positive against positive velocity [N m or N].

    Args:
        xp: Array namespace, `numpy`, `torch` or `jax.numpy`.
        terms: The law's answer, arrays that broadcast to the velocity's shape, or None.
        qvel: Velocity [rad/s or m/s].
    """
    torque, frictionloss, damping = (xp.zeros_like(qvel) if term is None else term for term in terms)
    return torque + frictionloss * xp.sign(qvel) + damping * qvel


def _initial(param: Param, nv: int) -> torch.Tensor:
    """Initial values of the joints, of shape (nv,); NaN while patterns of names wait for the names."""
    if not param.is_resolved:
        return torch.full((nv,), torch.nan, dtype=torch.float64)
    param.for_joints([None] * nv)  # a list of another length is refused
    return torch.tensor(param.each("init", nv), dtype=torch.float64)
