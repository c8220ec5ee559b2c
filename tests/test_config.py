"""Composing a job, what an override may be, and building parts from their sections."""

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from frictionzoo.build import build
from frictionzoo.config import (
    _NULLABLE,
    CONF_DIR,
    _is_open,
    check_overrides,
    compose_config,
    list_options,
    suggest_option,
)
from frictionzoo.errors import ConfigError
from frictionzoo.fit import Grid
from frictionzoo.models import Baseline, registry

HOMES = {"fit": "fit", "logger": "fit", "bench": "bench", "model": "models"}  # where the classes of a group are
CHOICES = [(path.parent.name, path.stem) for path in sorted(CONF_DIR.glob("*/*.yaml"))]
EXPERIMENTS = sorted((CONF_DIR / "experiment").glob("*.yaml"))


@pytest.mark.parametrize(("group", "name"), CHOICES, ids="=".join)
def test_every_choice_composes_and_resolves(group: str, name: str) -> None:
    config = OmegaConf.to_container(compose_config(f"{group}={name}"), resolve=True)
    assert isinstance(config, dict)
    assert {"bench", "data", "fit", "model", "seed", "segments", "loss", "loop", "evaluation"} <= set(config)
    assert isinstance(config["seed"], int)


@pytest.mark.parametrize(("group", "name"), [choice for choice in CHOICES if choice[0] in HOMES])
def test_every_choice_builds(make: Callable, group: str, name: str) -> None:
    part = make(group, f"{group}={name}", **({"nv": 1} if group == "model" else {}))
    assert type(part).__module__.startswith(f"frictionzoo.{HOMES[group]}")


@pytest.mark.parametrize("path", EXPERIMENTS, ids=lambda path: path.stem)
def test_an_experiment_starts_with_the_command_that_runs_it(path: Path) -> None:
    package, command = path.read_text().splitlines()[:2]
    assert package == "# @package _global_"
    words = shlex.split(command.removeprefix("# "))
    assert words[:4] == ["python", "-m", "frictionzoo.run", f"experiment={path.stem}"]
    chosen = compose_config(*words[3:])
    plain = compose_config(f"data={chosen.data.name}", *words[4:], *_choices(path))
    check_overrides(chosen, plain)


def _choices(path: Path) -> list[str]:
    """Model and fit that an experiment chooses, as overrides."""
    defaults = OmegaConf.load(path).get("defaults", [])
    groups = [(group, f"override /{group}") for group in ("model", "fit")]
    return [f"{group}={entry[key]}" for entry in defaults for group, key in groups if key in entry]


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "subprocess.Popen",
        "builtins.eval",
        "frictionzoo",
        "eval",
        "frictionzoo.errors.closest",  # a function
        "frictionzoo.fit.Newton",
        "frictionzoo.nowhere.Adam",
        "frictionzoo_evil.Adam",
        "frictionzoo.fit.loggers.TensorBoardLogger",  # a class of another package
        "frictionzoo.logs.paths.Path",
    ],
)
def test_build_refuses_foreign_targets(target: str) -> None:
    with pytest.raises(ConfigError, match="_target_="):
        build({"_target_": target})


def test_a_registered_law_is_built_wherever_it_is_defined(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry.REGISTRY, "entries", dict(registry.REGISTRY.entries))

    @registry.register_model("linear_friction")
    class Linear(Baseline):
        pass

    target = f"{Linear.__module__}.{Linear.__qualname__}"
    assert isinstance(build({"_target_": target}, nv=2), Linear)
    with pytest.raises(ConfigError, match="_target_="):
        build({"_target_": target.replace("Linear", "Cubic")}, nv=2)


def test_build_refuses_a_foreign_target_inside_a_section() -> None:
    with pytest.raises(ConfigError, match=r"_target_=os\.system"):
        build({"_target_": "frictionzoo.fit.Grid", "points": {"_target_": "os.system", "command": "true"}})


def test_build_makes_the_class_with_its_arguments() -> None:
    with pytest.raises(ConfigError, match=r"fit\.points=1; expected at least 2"):
        build({"_target_": "frictionzoo.fit.Grid", "points": 1})
    assert isinstance(build({"_target_": "frictionzoo.fit.Grid"}, points=2), Grid)


@pytest.mark.parametrize("arguments", [{}, {"points": 3, "speed": 1}])
def test_build_refuses_other_arguments(arguments: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=r"frictionzoo\.fit\.Grid"):
        build({"_target_": "frictionzoo.fit.Grid", **arguments})


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        ["segments.count=null", "loop.patience=3", "evaluation.rollouts=null", "data.cache_dir=null"],
        ["fit.learning_rate=1", "evaluation.horizons=[1,0.5]", "bench.joint=[knee]", "bench.joint=null"],
        ["model.params.static_torque.scale=2.0", "resume=outputs/yesterday", "seed=7", "loop.progress=false"],
        ["data=emps", "segments.count=3", "data.folder=somewhere"],
        ["data=files", "data.where={kp:[4,8]}", "data.inputs={gain:kp}", "data.train=a.csv", "data.split.test=0.2"],
        ["data=files", "data.clean.velocity_lag=auto", "data.clean.step=0.01", "data.split.gap=0"],
    ],
    ids=str,
)
def test_overrides_of_the_right_kind_pass(overrides: list[str]) -> None:
    check_overrides(
        compose_config(*overrides), compose_config(*(o for o in overrides if o in ("data=emps", "data=files")))
    )


def test_options_that_may_be_null_exist_and_no_other_is_null() -> None:
    """The list in the code and the files in conf/ must not drift apart."""
    groups = [("data", "emps"), ("data", "files"), ("data", "twin")]
    nulls, keys = set(), set()
    for group, name in groups:
        plain = dict(list_options(OmegaConf.to_container(compose_config(f"{group}={name}"), resolve=True)))
        keys |= set(plain)
        nulls |= {key for key, value in plain.items() if value is None and not _is_open(key)}
    assert nulls <= set(_NULLABLE) <= keys


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("segments.count=many", r"segments\.count=many; expected a whole number such as 20000"),
        ("segments.length=true", r"segments\.length=True; expected a whole number"),
        ("segments.length=null", r"segments\.length=null; expected a whole number"),
        ("loss.position=[1.0]", r"loss\.position=\[1\.0\]; expected a number such as 1\.0"),
        ("loop.progress=1", r"loop\.progress=1; expected true or false"),
        ("loop.patience=2.5", r"loop\.patience=2\.5; expected a whole number"),
        ("evaluation.horizons=[true]", r"evaluation\.horizons=\[True\]; expected a list such as"),
        ("dtype=64", r"dtype=64; expected text such as float"),
        ("bench.joint=3", r"bench\.joint=3; expected text or a list"),
        ("evaluation.seed=-1", r"evaluation\.seed=-1; expected a whole number from 0 on"),
        ("+bench.friction=3", r"bench\.friction: unknown option; did you mean solreffriction\?"),
        ("+loop.chunks=3", r"loop\.chunks: unknown option; did you mean chunk\?"),
        ("~loss.position", r"loss\.position: missing; expected a value such as 1\.0"),
        ("loss=3", r"loss=3; expected a section with position, velocity"),
    ],
)
def test_overrides_of_another_kind_are_refused(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        check_overrides(compose_config(override), compose_config())


@pytest.mark.parametrize(
    ("key", "hint"),
    [
        ("sed", "did you mean seed?"),
        ("segments.cuont", "did you mean count? (expected one of count, length) in segments"),
        ("model.params.static_torque.inti", "did you mean init?"),
        ("modl.params", "did you mean model?"),
        ("seed.deep", "expected one of"),
    ],
)
def test_the_closest_option_is_named(key: str, hint: str) -> None:
    assert hint in suggest_option(key, compose_config())


def test_runs_of_other_seeds_are_judged_on_the_same_rollouts() -> None:
    config = compose_config("seed=5", "model=neural_friction")
    assert config.model.seed == 5 and config.evaluation.seed == compose_config().evaluation.seed
