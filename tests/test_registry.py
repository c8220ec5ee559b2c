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


def test_a_name_is_of_one_class_and_a_class_of_one_name():
    cls = sound("Rusty")
    assert register_model("rusty")(register_model("rusty")(cls)) is cls
    newer = register_model("rusty")(sound("Rusty"))  # defined again, it replaces its older self
    assert get_model("rusty") is newer and newer in registry.REGISTRY.entries.values()
    with pytest.raises(ModelError, match=r"^rusty: already registered by Rusty; choose another name$"):
        register_model("rusty")(sound("Rustier"))
    with pytest.raises(ModelError, match=r"^rustier: Rusty is already registered as rusty"):
        register_model("rustier")(newer)
    assert newer.name == "rusty"


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


RUSTY = ("rustworks", "rusty", "rusty")


@pytest.mark.parametrize(
    ("packages", "name", "error", "line"),
    [
        ([], "coulomb_stribek", UnknownModelError, "^coulomb_stribek: no such .* did you mean coulomb_stribeck"),
        ([RUSTY], "rustty", UnknownModelError, r"did you mean rusty\?"),
        ([("rustworks", "baseline", "baseline")], "baseline", ModelError, "^baseline: already registered by Baseline"),
        ([RUSTY, ("ironworks", *RUSTY[1:])], "rusty", ModelError, "^rusty: entry points .* both bring it; uninstall"),
        ([(*RUSTY[:2], "rustier")], "rusty", ModelError, "^rusty: its entry point rustworks.laws:Rusty registers no"),
        ([(*RUSTY, "Rustee")], "rusty", ModelError, r"^rusty: .* rustworks.laws:Rustee does not load \(.*Rustee"),
    ],
)
def test_what_no_package_brings_or_several_do_is_refused(install, packages, name, error, line):
    for package in packages:
        install(*package)
    with pytest.raises(error, match=line):
        get_model(name)
