"""The contract checker: it passes a sound law and names the clause that a broken one breaks."""

from collections.abc import Callable
from typing import Any

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


class OutOfBounds(Sound):
    def __init__(self) -> None:
        super().__init__()
        self.dry.data.fill_(2.0)


class WrongShape(Sound):
    def __init__(self) -> None:
        super().__init__()
        self.dry = torch.nn.Parameter(torch.tensor(0.5, dtype=torch.float64))


class WritesState(Sound):
    def terms(self, xp, values, state):
        if xp is torch:
            state.ctrl.mul_(0.0)
        return super().terms(xp, values, state)


class Forgets(Sound):
    scale = 1.0

    def prepare(self, samples):
        self.scale = float(np.std(samples.qvel))

    def terms(self, xp, values, state):
        return FrictionTerms(torque=values["dry"] * xp.tanh(state.qvel / self.scale))


class Drives(Sound):
    def terms(self, xp, values, state):
        return FrictionTerms(torque=values["dry"] * xp.tanh(state.qvel - 0.05))


def sound(xp: Any, values: Any, state: DriveState) -> Any:
    return values["dry"] * xp.tanh(state.qvel)


def law(terms: Callable[..., FrictionTerms], base: type[Sound] = Sound, **attributes: Any) -> type[Sound]:
    """A law of these terms, a function of xp, values and state."""
    return type("Law", (base,), {**attributes, "terms": lambda self, *given: terms(*given)})


def torque(formula: Callable[..., Any], **attributes: Any) -> type[Sound]:
    return law(lambda *given: FrictionTerms(torque=formula(*given)), **attributes)


def declared(**attributes: Any) -> type[Sound]:
    return type("Law", (Sound,), attributes)


BROKEN = {  # the clause, and what of it the message names
    "units: dry .*torqe": declared(dimensions={"dry": "torqe"}),
    "inputs: humidity": declared(inputs={"humidity": 0.5}),
    "inputs: temperature is inf": declared(inputs={"temperature": float("inf")}),
    "terms: fails over torch .*NoneType": torque(lambda xp, v, s: sound(xp, v, s) * s.temperature),
    "bounds: dry=": OutOfBounds,
    "values: velocity_scale": declared(prepare=lambda self, samples: self.velocity_scale.fill_(torch.inf)),
    "values: dry": WrongShape,
    "terms: gives Tensor over torch": law(sound),
    r"terms: fails over torch \('dri'\)": torque(lambda xp, v, s: v["dri"] * s.qvel),
    "terms: fails over jax.numpy": torque(lambda xp, v, s: sound(xp, v, s).mul(1.0)),
    "terms: torque is a float over torch": torque(lambda xp, v, s: 0.5),
    "shape: torque over torch": torque(lambda xp, v, s: xp.stack([v["dry"] * s.qvel] * 2)),
    "pure: jax.jit": torque(lambda xp, v, s: sound(xp, v, s) if (v["dry"] > 0.2).all() else s.qvel),
    "deterministic:": torque(lambda xp, v, s: sound(xp, v, s) * (1 + 1e-6 * np.random.default_rng().random())),
    "pure: terms writes": WritesState,
    "pure: terms reads": declared(
        terms=lambda self, xp, v, s: FrictionTerms(
            torque=sound(xp, v, s) * (v["velocity_scale"] if xp is not torch else self.velocity_scale)
        )
    ),
    "torch equals JAX: value on the samples of torque differs by [0-9]": torque(
        lambda xp, v, s: sound(xp, v, s) * (1.0 if xp is torch else 1.0 + 1e-10)
    ),
    "torch equals JAX: value on the samples of torque differs by nan": torque(
        lambda xp, v, s: sound(xp, v, s) * (1.0 if xp is torch else float("nan"))
    ),
    "torch equals JAX: gradient on the samples of dry": torque(
        lambda xp, v, s: (v["dry"].detach() if xp is torch else v["dry"]) * xp.tanh(s.qvel)
    ),
    "torch equals JAX: terms": law(
        lambda xp, v, s: FrictionTerms(sound(xp, v, s), damping=None if xp is torch else v["dry"])
    ),
    "gradient: with respect to qvel .* on the samples": torque(
        lambda xp, v, s: v["dry"] * xp.sign(s.qvel) * xp.sqrt(xp.abs(s.qvel))
    ),
    "gradient: with respect to motor_torque .* where all is 0": torque(
        lambda xp, v, s: sound(xp, v, s) * xp.sqrt(xp.square(s.motor_torque))
    ),
    "constraint: is not declared": law(lambda xp, v, s: FrictionTerms(frictionloss=v["dry"])),
    "constraint: is declared": declared(constraint=True),
    "frictionloss:": law(
        lambda xp, v, s: FrictionTerms(frictionloss=v["dry"] * xp.tanh(xp.square(s.qvel))), constraint=True
    ),
    "type: torque": torque(
        lambda xp, v, s: sound(xp, v, s) * (torch.ones(2, dtype=torch.float64) if xp is torch else 1.0)
    ),
    "state_dict: is not complete": Forgets,
    "state_dict: does not go .* velocity_scale": declared(
        prepare=lambda self, samples: setattr(self, "velocity_scale", torch.ones(1, dtype=torch.float64))
    ),
    "contains: in sliding, it differs from mujoco_default": declared(
        contains={"mujoco_default": {"dry": "frictionloss"}}
    ),
    "contains: wet": declared(contains={"mujoco_default": {"wet": 0.0}}),
    "dissipative: friction drives .*=": Drives,
    # Not with its initial value, but with lower ones within the bounds.
    "dissipative: friction drives": torque(lambda xp, v, s: (v["dry"] - 0.4) * xp.tanh(s.qvel)),
    "dissipative: torque moves": law(
        lambda xp, v, s: FrictionTerms(xp.where(s.qvel == 0, 1.01 * v["dry"], 0 * v["dry"]), v["dry"]), constraint=True
    ),
    # At the samples' speeds the dry friction outweighs it.
    "dissipative: damping": law(
        lambda xp, v, s: FrictionTerms(frictionloss=10 * v["dry"], damping=-v["dry"]), constraint=True
    ),
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


def test_only_the_sum_of_the_terms_has_to_dissipate(register):
    """Dry friction of another limit in each direction: the torque alone drives the joint, all terms never do."""
    biased = law(lambda xp, v, s: FrictionTerms(torque=0.9 * v["dry"], frictionloss=v["dry"]), constraint=True)
    check_model(register(biased)())


@pytest.mark.parametrize("clause", BROKEN)
def test_a_broken_law_is_named_with_its_clause(register, clause):
    with pytest.raises(ModelError, match=rf"^law_under_test: {clause}") as caught:
        check_model(register(BROKEN[clause])())
    assert "\n" not in str(caught.value)


def test_a_law_without_a_name_of_its_own_is_named(register):
    for cls in (Sound, type("Child", (register(Sound),), {})):
        with pytest.raises(ModelError, match=rf"name: class {cls.__name__}"):
            check_model(cls())


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
