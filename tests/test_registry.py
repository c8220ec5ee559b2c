"""Friction models by name, from here and from other packages."""

import sys

import pytest

from frictionzoo.core.errors import ModelError, UnknownModelError
from frictionzoo.core.state import FrictionTerms
from frictionzoo.models import Baseline, FrictionModel, get_model, model_names, register_model, registry

LAW = """
from frictionzoo.models import FrictionModel, register_model
from frictionzoo.core.state import FrictionTerms

@register_model("{name}")
class Rusty(FrictionModel):
    def terms(self, xp, values, state):
        return FrictionTerms(torque=state.qvel)
"""


@pytest.fixture(autouse=True)
def own_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test registers ends with it."""
    monkeypatch.setattr(registry.REGISTRY, "entries", dict(registry.REGISTRY.entries))


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Puts a distribution with one friction law and its entry point on sys.path."""

    def installed(package: str, entry_name: str, law: str, attribute: str = "Rusty") -> None:
        site = tmp_path / package
        info = site / f"{package}-1.0.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[frictionzoo.models]\n{entry_name} = {package}.laws:{attribute}\n")
        (site / package).mkdir()
        (site / package / "__init__.py").write_text("")
        (site / package / "laws.py").write_text(LAW.format(name=law))
        monkeypatch.syspath_prepend(site)
        for module in (package, f"{package}.laws"):
            monkeypatch.delitem(sys.modules, module, raising=False)

    return installed


def sound(name: str) -> type[FrictionModel]:
    return type(name, (FrictionModel,), {"terms": lambda self, xp, values, state: FrictionTerms(torque=state.qvel)})


def test_a_duplicate_name_raises():
    register_model("rusty")(sound("Rusty"))
    with pytest.raises(ModelError, match=r"^rusty: already registered by Rusty; choose another name$"):
        register_model("rusty")(sound("Rustier"))


def test_registering_the_same_class_again_changes_nothing():
    cls = sound("Rusty")
    assert register_model("rusty")(register_model("rusty")(cls)) is cls


def test_a_class_that_is_defined_again_replaces_its_older_self():
    register_model("rusty")(sound("Rusty"))
    newer = register_model("rusty")(sound("Rusty"))
    assert get_model("rusty") is newer
    assert newer in registry.REGISTRY.entries.values()


def test_a_second_name_for_a_class_raises():
    cls = register_model("rusty")(sound("Rusty"))
    with pytest.raises(ModelError, match=r"^rustier: Rusty is already registered as rusty"):
        register_model("rustier")(cls)
    assert cls.name == "rusty"


def test_a_subclass_has_a_name_of_its_own():
    child = register_model("no_friction")(type("Child", (Baseline,), {}))
    assert (child.name, Baseline.name) == ("no_friction", "baseline")


@pytest.mark.parametrize("name", ["Rusty", "rusty-law", "", "2rusty"])
def test_a_name_of_another_form_raises(name):
    with pytest.raises(ModelError, match=r"expected a name in lower case with underscores"):
        register_model(name)(sound("Rusty"))


@pytest.mark.parametrize(
    "thing", [dict, print, type("Empty", (FrictionModel,), {})], ids=["class", "function", "abstract"]
)
def test_what_is_no_complete_model_raises(thing):
    with pytest.raises(ModelError, match=r"expected a FrictionModel class with a `terms` method"):
        register_model("rusty")(thing)


def test_an_unknown_name_raises_with_the_closest():
    with pytest.raises(UnknownModelError, match=r"^coulomb_stribek: no such .* did you mean coulomb_stribeck\?"):
        get_model("coulomb_stribek")


def test_a_model_of_another_package_is_found(install):
    install("rustworks", "rusty", "rusty")
    assert "rusty" in model_names()
    cls = get_model("rusty")
    assert (cls.__module__, cls.name) == ("rustworks.laws", "rusty")
    assert get_model("rusty") is cls


def test_the_backport_of_entry_points_is_understood(install):
    pytest.importorskip("importlib_metadata")  # which takes discovery over once it is imported
    install("rustworks", "rusty", "rusty")
    assert get_model("rusty").name == "rusty"


def test_the_closest_name_may_be_another_packages(install):
    install("rustworks", "rusty", "rusty")
    with pytest.raises(UnknownModelError, match=r"did you mean rusty\?"):
        get_model("rustty")


def test_another_package_cannot_take_a_name(install):
    install("rustworks", "baseline", "baseline")
    with pytest.raises(ModelError, match=r"^baseline: already registered by Baseline"):
        get_model("baseline")


def test_two_packages_with_one_name_raise(install):
    install("rustworks", "rusty", "rusty")
    install("ironworks", "rusty", "rusty")
    with pytest.raises(ModelError, match=r"^rusty: entry points .* both bring it; uninstall one"):
        get_model("rusty")


def test_an_entry_point_without_its_model_raises(install):
    install("rustworks", "rusty", "rustier")
    with pytest.raises(
        ModelError, match=r"^rusty: its entry point rustworks.laws:Rusty registers no model of that name"
    ):
        get_model("rusty")


def test_an_entry_point_that_does_not_load_raises(install):
    install("rustworks", "rusty", "rusty", attribute="Rustee")
    with pytest.raises(ModelError, match=r"^rusty: its entry point rustworks.laws:Rustee does not load \(.*Rustee"):
        get_model("rusty")
