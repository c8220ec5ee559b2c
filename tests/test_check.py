"""The contract checker: it passes a sound law and names the clause that a broken one breaks."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from frictionzoo.core.errors import ModelError
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, registry
from frictionzoo.models.contract import check_model

DRY = {"dry": {"init": 0.5, "low": 0.1, "high": 1.0, "scale": "log", "identify": True}}


class Sound(FrictionModel):
    dimensions = {"dry": "torque"}
    dissipative = True

    def __init__(self, nv: int = 2) -> None:
        super().__init__(nv, DRY)
        self.register_buffer("velocity_scale", torch.ones(nv, dtype=torch.float64))

    def prepare(self, samples: DriveState) -> None:
        self.velocity_scale.copy_(torch.tensor(np.std(samples.qvel, axis=0)))

    def terms(self, xp, values, state):
        return FrictionTerms(torque=values["dry"] * xp.tanh(state.qvel / values["velocity_scale"]))


class Unit(Sound):
    dimensions = {"dry": "torqe"}


class Humid(Sound):
    inputs = {"humidity": 0.5}


class Endless(Sound):
    inputs = {"temperature": float("inf")}


class LooksUnasked(Sound):
    def terms(self, xp, values, state):
        return FrictionTerms(torque=values["dry"] * xp.tanh(state.qvel) * state.temperature)


class OutOfBounds(Sound):
    def __init__(self) -> None:
        super().__init__()
        self.dry.data.fill_(2.0)


class NotFinite(Sound):
    def prepare(self, samples):
        self.velocity_scale.copy_(torch.tensor(np.std(samples.qvel, axis=0)) / 0.0)


class WrongShape(Sound):
    def __init__(self) -> None:
        super().__init__()
        self.dry = torch.nn.Parameter(torch.tensor(0.5, dtype=torch.float64))


class NoTerms(Sound):
    def terms(self, xp, values, state):
        return super().terms(xp, values, state).torque


class MissingName(Sound):
    def terms(self, xp, values, state):
        return FrictionTerms(torque=values["dri"] * state.qvel)


class TorchOnly(Sound):
    def terms(self, xp, values, state):
        return FrictionTerms(torque=values["dry"] * xp.tanh(state.qvel).mul(1.0))


class Detached(Sound):
    def terms(self, xp, values, state):
        return FrictionTerms(torque=0.5)


class Summed(Sound):
    def terms(self, xp, values, state):
        return FrictionTerms(torque=xp.stack([values["dry"] * state.qvel] * 2))


class Branches(Sound):
    def terms(self, xp, values, state):
        return super().terms(xp, values, state) if (values["dry"] > 0.2).all() else FrictionTerms(torque=state.qvel)


class Random(Sound):
    def terms(self, xp, values, state):
        torque = super().terms(xp, values, state).torque
        return FrictionTerms(torque=torque * (1 + 1e-6 * np.random.default_rng().random()))


class WritesState(Sound):
    def terms(self, xp, values, state):
        if xp is torch:
            state.ctrl.mul_(0.0)
        return super().terms(xp, values, state)


class ReadsItself(Sound):
    def terms(self, xp, values, state):
        scale = values["velocity_scale"] if xp is not torch else self.velocity_scale
        return FrictionTerms(torque=values["dry"] * xp.tanh(state.qvel / scale))


class TwoFormulas(Sound):
    def terms(self, xp, values, state):
        return FrictionTerms(torque=values["dry"] * xp.tanh(state.qvel) * (1.0 if xp is torch else 1.0 + 1e-10))


class NanOverJax(Sound):
    def terms(self, xp, values, state):
        return FrictionTerms(torque=values["dry"] * xp.tanh(state.qvel) * (1.0 if xp is torch else float("nan")))


class TwoGradients(Sound):
    def terms(self, xp, values, state):
        dry = values["dry"].detach() if xp is torch else values["dry"]
        return FrictionTerms(torque=dry * xp.tanh(state.qvel))


class TwoSetsOfTerms(Sound):
    def terms(self, xp, values, state):
        torque = super().terms(xp, values, state).torque
        return FrictionTerms(torque=torque) if xp is torch else FrictionTerms(torque=torque, damping=values["dry"])


class InfiniteSlope(Sound):
    def terms(self, xp, values, state):
        return FrictionTerms(torque=values["dry"] * xp.sign(state.qvel) * xp.sqrt(xp.abs(state.qvel)))


class InfiniteSlopeUnloaded(Sound):
    def terms(self, xp, values, state):
        return FrictionTerms(torque=values["dry"] * xp.tanh(state.qvel) * xp.sqrt(xp.square(state.motor_torque)))


class Undeclared(Sound):
    def terms(self, xp, values, state):
        return FrictionTerms(frictionloss=values["dry"])


class Missing(Sound):
    constraint = True


class Locks(Sound):
    constraint = True

    def terms(self, xp, values, state):
        return FrictionTerms(frictionloss=values["dry"] * xp.tanh(xp.square(state.qvel)))


class Double(Sound):
    def terms(self, xp, values, state):
        one = torch.ones(self.nv, dtype=torch.float64) if xp is torch else 1.0
        return FrictionTerms(torque=one * values["dry"] * xp.tanh(state.qvel))


class Forgets(Sound):
    scale = 1.0

    def prepare(self, samples):
        self.scale = float(np.std(samples.qvel))

    def terms(self, xp, values, state):
        return FrictionTerms(torque=values["dry"] * xp.tanh(state.qvel / self.scale))


class Grows(Sound):
    def prepare(self, samples):
        self.velocity_scale = torch.ones(1, dtype=torch.float64)


class Drives(Sound):
    def terms(self, xp, values, state):
        return FrictionTerms(torque=values["dry"] * xp.tanh(state.qvel - 0.05))


class DrivesElsewhere(Sound):
    """Not with its initial value, but with lower ones within the bounds."""

    def terms(self, xp, values, state):
        return FrictionTerms(torque=(values["dry"] - 0.4) * xp.tanh(state.qvel))


class Pushes(Sound):
    constraint = True

    def terms(self, xp, values, state):
        dry = values["dry"]
        return FrictionTerms(torque=xp.where(state.qvel == 0, 1.01 * dry, 0 * dry), frictionloss=dry)


class NegativeDamping(Sound):
    """At the samples' speeds the dry friction outweighs it."""

    constraint = True

    def terms(self, xp, values, state):
        return FrictionTerms(frictionloss=10 * values["dry"], damping=-values["dry"])


class ContainsOther(Sound):
    contains = {"mujoco_default": {"dry": "frictionloss"}}


class ContainsUnnamed(Sound):
    contains = {"mujoco_default": {"wet": 0.0}}


BROKEN = {
    Unit: "units: dry has dimension torqe on a hinge; did you mean torque?",
    Humid: "inputs: humidity is no recorded signal of DriveState; .*temperature",
    Endless: "inputs: temperature is inf where recordings lack it",
    LooksUnasked: "terms: fails over torch .*NoneType.* declared inputs",
    OutOfBounds: r"bounds: dry=\[2.0, 2.0\] outside \[0.1, 1\]",
    NotFinite: "values: velocity_scale is NaN or infinite",
    WrongShape: r"values: dry is no parameter of shape \(2,\)",
    NoTerms: "terms: gives Tensor over torch; return FrictionTerms",
    MissingName: r"terms: fails over torch \('dri'\)",
    TorchOnly: "terms: fails over jax.numpy",
    Detached: "terms: torque is a float over torch",
    Summed: r"shape: torque over torch is \(2, 2\), expected \(2,\)",
    Branches: "pure: jax.jit cannot compile terms",
    Random: "deterministic: two calls",
    WritesState: "pure: terms writes into values, state or the module",
    ReadsItself: "pure: terms reads a parameter or buffer from the module",
    TwoFormulas: "torch equals JAX: value on the samples of torque differs by",
    NanOverJax: "torch equals JAX: value on the samples of torque differs by nan",
    TwoGradients: "torch equals JAX: gradient on the samples of dry differs by",
    TwoSetsOfTerms: "torch equals JAX: terms",
    InfiniteSlope: "gradient: with respect to qvel is not finite on the samples",
    InfiniteSlopeUnloaded: "gradient: with respect to motor_torque is not finite where all is 0",
    Undeclared: "constraint: is not declared and frictionloss is given",
    Missing: "constraint: is declared and frictionloss is None",
    Locks: "frictionloss: is 0 or negative somewhere",
    Double: "type: torque is torch.float64 of float32 inputs over torch",
    Forgets: "state_dict: is not complete",
    ContainsOther: "contains: slides otherwise than mujoco_default by .* see the values in contains",
    ContainsUnnamed: "contains: wet is none of its parameters; name one of dry",
    Grows: r"state_dict: does not go through safetensors and back \(Error.* size mismatch for velocity_scale",
    Drives: "dissipative: friction drives the joint at qvel=",
    DrivesElsewhere: "dissipative: friction drives the joint at qvel=",
    Pushes: "dissipative: torque moves a joint that stands still",
    NegativeDamping: "dissipative: damping is negative",
}


@pytest.fixture
def register(monkeypatch: pytest.MonkeyPatch) -> Callable[[type[FrictionModel]], type[FrictionModel]]:
    """Registers a law for one test only."""
    monkeypatch.setattr(registry.REGISTRY, "entries", dict(registry.REGISTRY.entries))
    return lambda cls: registry.register_model("law_under_test")(type(cls.__name__, (cls,), {}))


@pytest.mark.parametrize("nv", [1, 3])
def test_a_sound_law_passes_and_stays_as_it_was(register, nv):
    model = register(Sound)(nv)
    check_model(model)
    assert torch.equal(model.velocity_scale, torch.ones(nv, dtype=torch.float64))


class Biased(Sound):
    """Dry friction of another limit in each direction: the torque alone drives the joint, all terms never do."""

    constraint = True

    def terms(self, xp, values, state):
        return FrictionTerms(torque=0.9 * values["dry"], frictionloss=values["dry"])


def test_only_the_sum_of_the_terms_has_to_dissipate(register):
    check_model(register(Biased)())


@pytest.mark.parametrize("broken", BROKEN, ids=lambda cls: cls.__name__)
def test_a_broken_law_is_named_with_its_clause(register, broken):
    with pytest.raises(ModelError, match=r"^law_under_test: " + BROKEN[broken]) as caught:
        check_model(register(broken)())
    assert "\n" not in str(caught.value)


def test_an_unregistered_law_is_named():
    with pytest.raises(ModelError, match=r"Sound: name: class Sound is not registered"):
        check_model(Sound())


def test_a_law_under_its_parents_name_is_named(register):
    child = type("Child", (register(Sound),), {})
    with pytest.raises(ModelError, match=r"name: class Child is not registered"):
        check_model(child())


def test_an_undeclared_source_of_energy_is_allowed(register):
    cls = register(Drives)
    cls.dissipative = False
    check_model(cls())


def test_the_callers_states_are_used(register):
    """Drives only gives energy to a joint between 0 and 0.05."""
    speeds = np.linspace(0.1, 1.0, 20)[:, None].repeat(2, axis=1)
    check_model(register(Drives)(), DriveState(*[speeds] * 5))
    with pytest.raises(ModelError, match=r"qvel=0.03"):
        check_model(registry.get_model("law_under_test")(), DriveState(*[speeds * 0.3] * 5))
