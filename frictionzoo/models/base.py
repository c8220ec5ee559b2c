"""The plug-in interface of a friction model, and of one that exists only in torch."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch

from frictionzoo.core.described import Described
from frictionzoo.core.errors import ConfigError, ModelError
from frictionzoo.core.params import Param, Parameter, read_params, refuse_negative
from frictionzoo.core.state import DriveState, FrictionTerms

Values = Mapping[str, Any]
"""Arrays of a model under the names of its `state_dict`."""
Params = Mapping[str, Mapping[str, Any] | Sequence[float] | float | int]
"""Section of each physical parameter (`init`, `low`, `high`, `scale`, `identify`), or its value if it is known: one for
all joints or a list."""
Within = Mapping[str, str | float | Callable[[Values], Any]]
"""Parameter values at which a model equals a nested model: a number, the name of the nested model's parameter, or a
one-to-one function of the nested model's values. Parameters that are not listed have the same name in both."""


class FrictionModel(Described, torch.nn.Module, ABC):
    """Friction model: a torch module that owns its parameters, with one formula over an array namespace.

    A model declares its physical parameters in `physical_parameters`. They become `torch.nn.Parameter`s of shape (nv,)
    in SI units, so a saved state contains physical values. Any other registered parameter, such as a network's weights,
    is optimised directly, without bounds. The other arguments of the constructor are options, with their defaults.

    Attributes:
        name: Name of the model, set by `register_model`.
        physical_parameters: Dimension, initial value and bounds of each physical parameter, the options
            `model.params.NAME`. In frictionzoo's files, which are read without running them, write a dictionary of
            `Parameter(...)` with constants, and `**Other.physical_parameters` for those of another model.
        dimensions: Dimension of each parameter, one of `frictionzoo.core.units.DIMENSIONS`. A class may declare
            these alone; `params`, or a YAML file of the model's package, then has the rest.
        constraint: Whether `terms` returns a `frictionloss`, so the simulated joint needs MuJoCo's friction constraint.
        constrained: `constraint` of each joint; a joint without it has `frictionloss` 0 if other joints have one.
        dissipative: Whether the model never adds energy to the drive, for any values within bounds: the sum of its
            terms opposes the motion of a sliding joint and holds a joint at rest. For a model with memory this applies
            at constant velocity, because a deflected spring returns energy.
        inputs: Signals that the model reads in addition to the state, each with the value that applies if the
            recordings lack it. Each is a field of `DriveState` that recordings have among their extras.
        contains: Nested models by name, with the parameter values at which this model equals them. Parameters that only
            this model has, and that are not listed, have no effect then.
        valleys: Parameters over which the loss is known to have several minima, with the multiples of the initial value
            from which a search also starts.
        memory: Number of memory values per joint, carried from step to step; 0 for a function of the present state.
        shortest_segment: Minimum segment length [s] that a recipe chooses for recordings ten times as long. A rollout
            starts with a guessed memory, and must forget it early in each segment.
        sees: Quantities on which the friction depends, of `frictionzoo.models.sees.SEES`: `speed`; `slow`, friction
            falls as the speed rises; `fast`, friction grows faster than the speed; `direction`, friction differs
            between the two; `load`, `position`, `temperature`; `reversal`, friction depends on how long ago the motion
            reversed. A run's verdict uses it to suggest a model with a missing term, never one with empty `sees`.
        export_target: Target of the export that a run suggests. By default `mujoco`, which writes the exact model; set
            `mjcf` if its methods cannot be written as source text, for example because of arrays in attributes.
        params: Initial value, bounds and scale of each physical parameter.

    Raises:
        ConfigError: There is no joint, or a parameter is missing, unknown, or has invalid bounds.
    """

    name: ClassVar[str]
    physical_parameters: ClassVar[Mapping[str, Parameter]] = {}
    dimensions: ClassVar[Mapping[str, str]] = {}
    constraint: bool = False
    dissipative: bool = False
    inputs: Mapping[str, float] = {}
    contains: ClassVar[Mapping[str, Within]] = {}
    valleys: ClassVar[Mapping[str, Sequence[float]]] = {}
    memory: int = 0
    shortest_segment: float = 0.0
    sees: ClassVar[tuple[str, ...]] = ()
    export_target: str = "mujoco"

    def __init_subclass__(cls, **more: Any) -> None:
        super().__init_subclass__(**more)
        if "advance" in vars(cls) and "advance_midway" not in vars(cls):
            cls.advance_midway = FrictionModel.advance_midway  # a parent's would ignore what this class changes
        if "physical_parameters" in vars(cls):
            cls.dimensions = {name: parameter.dimension for name, parameter in cls.physical_parameters.items()}

    def __init__(self, nv: int, params: Params | None = None) -> None:
        super().__init__()
        if not isinstance(nv, int) or isinstance(nv, bool) or nv < 1:
            raise ConfigError(f"nv={nv!r}; expected the number of joints, a whole one from 1 on")
        self.nv = nv
        self.params: dict[str, Param] = read_params(type(self).__name__, self.dimensions, params or {})
        refuse_negative(f"{type(self).__name__}: ", self.params)
        for name, param in self.params.items():
            self.register_parameter(name, torch.nn.Parameter(_initial(param, nv), requires_grad=param.is_identified))

    def __repr__(self) -> str:
        weights = sum(weights.numel() for name, weights in self.named_parameters() if name not in self.params)
        head = f"{self.name}, {self.nv} joint{'s' * (self.nv > 1)}"
        head += f", {weights} weights" * (weights > 0) + ", in units of a hinge" * bool(self.params)
        lines = (param.line(self.get_parameter(name).tolist(), "hinge") for name, param in self.params.items())
        return "\n  ".join([head, *lines])

    @property
    def constrained(self) -> tuple[bool, ...]:
        """`constraint` of each joint; see the class."""
        return self.nv * (self.constraint,)

    def of_joint(self, joint: int) -> tuple["FrictionModel", int, str]:
        """Return a joint's model, its index in that model, and the prefix of that model's names in `values`."""
        return self, joint, ""

    def begin(self, values: Mapping[str, Any]) -> None:
        """Set initial values of parameters by name, each of shape (nv,)."""
        for name, value in values.items():
            self.get_parameter(name).data.copy_(torch.tensor(np.asarray(value)))

    def bind(self, joints: Sequence[str]) -> None:
        """Resolve parameters given by patterns of joint names; parameters that have values keep them.

        Raises:
            ConfigError: A joint matches no pattern, or the length of a list is not the number of joints.
        """
        for name, param in self.params.items():
            if not param.is_resolved:
                self.params[name] = param.for_joints(joints)
                self.get_parameter(name).data.copy_(_initial(self.params[name], self.nv))

    @abstractmethod
    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Compute the friction terms; a pure function: no attribute that a fit changes, no branch on a value.

        For a model with memory, compute its friction at constant velocity.

        Args:
            xp: Array namespace, `torch` or `jax.numpy`.
            values: Arrays of this namespace under the names of `state_dict`.
            state: State of the drive, arrays of shape (..., nv).

        Returns:
            Terms of shape (..., nv), or broadcastable to it.
        """

    def settle(self, xp: Any, values: Values, state: DriveState) -> Any:
        """Return the memory, of shape (..., nv, memory), as if this state had long lasted; arguments as in `terms`."""
        return xp.zeros((*state.qvel.shape, self.memory))

    def advance(
        self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> tuple[FrictionTerms, Any]:
        """Advance one simulation step: return the terms that act until the next state, and the memory in this state.

        A model with memory overrides this method and `settle`. It is pure like `terms` and takes the same arguments,
        the memory that the previous call returned, of shape (..., nv, memory), and the timestep of the simulation [s].
        It first advances that memory to this state, and returns the terms with the memory expected at the end of the
        step. Second-order rollouts know the slope over velocity only from `damping`: put what is linear there.
        """
        return self.terms(xp, values, state), memory

    def advance_midway(
        self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> tuple[FrictionTerms, Any]:
        """Advance one step of a second-order rollout, whose states are half a step apart; arguments as in `advance`.

        The torque belongs to the middle of the step from `state.qvel` to the next velocity, and the memory in this
        state is the memory there. By default `advance`, of first order for a model with memory. A class that overrides
        `advance` does not inherit this method from a parent that has both.
        """
        return self.advance(xp, values, state, memory, timestep)

    def prepare(self, samples: DriveState) -> None:
        """Take constants, such as a normalisation, from training samples of shape (samples, nv), in numpy.

        Most models need none. An identification calls it before it reads the model's values. The model may already have
        been fitted: set constants on which other values depend, such as weights, only once, and keep them in later
        calls.
        """

    def forward(self, state: DriveState) -> FrictionTerms:
        """Compute the terms in torch with this module's values, for torch tensors of shape (..., nv)."""
        return self.terms(torch, self.state_dict(keep_vars=True), state)


class TorchFriction(FrictionModel):
    """Friction model without a formula over `xp`: any torch module, for example of `torch.nn` parts.

    Write `forward` in plain torch and register the class like any other model. `dimensions` declares physical
    parameters, which `forward` reads as attributes; any other parameter of the module is a weight. All parameters and
    buffers are float64, and float32 in a job that computes in float32: take every number from them, from the state, or
    from Python.

    Each step of a rollout leaves JAX for this model. This is exact, but slower than a formula: write a formula if you
    can.

    Cannot represent: a memory; a function of the whole batch, such as batch normalisation.
    """

    export_target = "mjcf"

    @abstractmethod
    def forward(self, state: DriveState) -> FrictionTerms:
        """Compute the friction terms; pure and deterministic, with this module's values.

        The state has tensors of shape (..., nv). The terms broadcast to it; `frictionloss` is above 0. Their gradient
        is finite, also at qvel = 0.
        """

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the terms of `forward` with these values in place of the module's; see `FrictionModel.terms`.

        Raises:
            ModelError: `xp` is not torch.
        """
        if xp is not torch:
            label = getattr(type(self), "name", type(self).__name__)
            raise ModelError(f"{label}: it exists only in torch, not in {xp.__name__}; derive it from FrictionModel")
        return torch.func.functional_call(self, dict(values), (state,))


def sliding_torque(xp: Any, terms: FrictionTerms, qvel: Any) -> Any:
    """Return the total friction torque of a sliding joint, positive against positive velocity [N m or N].

    `xp` is `numpy`, `torch` or `jax.numpy`. The terms broadcast to the shape of the velocity, or are None.
    """
    torque, frictionloss, damping = (xp.zeros_like(qvel) if term is None else term for term in terms)
    return torque + frictionloss * xp.sign(qvel) + damping * qvel


def _initial(param: Param, nv: int) -> torch.Tensor:
    """Return initial values of shape (nv,); NaN while joint names for the patterns are missing."""
    if not param.is_resolved:
        return torch.full((nv,), torch.nan, dtype=torch.float64)
    param.for_joints([None] * nv)  # raises if a list has another length
    return torch.tensor(param.each("init", nv), dtype=torch.float64)
