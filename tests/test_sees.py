"""What laws say that their friction changes with is so, and the law that is named has what another lacks."""

import pytest

import frictionzoo as fz
from frictionzoo.api.library import law
from frictionzoo.core.errors import ModelError
from frictionzoo.models import FrictionModel, TorchFriction
from frictionzoo.models.registry import REGISTRY
from frictionzoo.models.sees import simpler_law, suggest_law


def made(name: str) -> FrictionModel:
    cls = REGISTRY.get(name)
    return cls(1, params=dict.fromkeys(cls.dimensions, 0.1))


@pytest.mark.parametrize(
    ("present", "missing", "expected"),
    [
        ("coulomb_smooth", "slow", ("coulomb_stribeck", True)),
        ("mujoco_default", "slow", ("stribeck", True)),
        ("mujoco_default", "direction", ("asymmetric", True)),
        ("stribeck", "load", ("stribeck_load_dependent", True)),
        ("stribeck_load_dependent", "load", ("directional", True)),
        ("stribeck_load_dependent", "position", ("harmonic_drive", True)),
        ("mujoco_default", "temperature", ("temperature_arrhenius", True)),
        ("temperature_linear", "load", ("load_dependent", False)),
        ("coulomb_stribeck", "reversal", ("lugre", True)),
        ("load_dependent", "reversal", ("dahl_load_dependent", True)),
        ("stribeck_load_dependent", "reversal", ("lugre_load_dependent", True)),
        ("dahl", "load", ("dahl_load_dependent", True)),
        ("ripple", "direction", ("residual_network", True)),
    ],
)
def test_the_law_that_is_named_has_the_present_terms_and_the_missing_one(present, missing, expected):
    model = made(present)
    assert suggest_law(model, {*model.sees}, missing) == expected
    named = REGISTRY.get(expected[0])
    assert missing in named.sees and ({*model.sees} <= {*named.sees}) == expected[1]


def test_a_law_with_a_term_less_is_named() -> None:
    assert simpler_law(made("stribeck_load_dependent"), {"speed", "slow", "load"}) == "load_dependent"
    assert simpler_law(made("mujoco_default"), {"speed"}) is None


def test_every_law_says_what_it_sees() -> None:
    laws = {name: REGISTRY.get(name) for name in REGISTRY.names() if name in REGISTRY.kind.own()}
    silent = {name for name, law in laws.items() if not law.sees and not issubclass(law, TorchFriction)}
    assert silent == {"baseline", "by_joint"}


def test_a_law_that_says_what_it_does_not_see_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    model = law("ripple", nv=2)
    for wrong, text in (
        (("speed",), "it declares speed, but friction depends on position, speed"),
        (("speed", "position", "load"), "it declares load, position, speed, but friction depends on position, speed"),
        (("speeed",), "speeed is not a known quantity; did you mean speed"),
    ):
        monkeypatch.setattr(type(model), "sees", wrong)
        with pytest.raises(ModelError, match=text):
            fz.check_model(model)
