"""Composing a job, what an override may be, and building parts from their sections."""

import fnmatch
import functools
import inspect
import re
import shlex
from pathlib import Path
from typing import Any

import hypothesis.strategies as st
import pytest
from conftest import check_each, compose_once
from hypothesis import given
from omegaconf import DictConfig, OmegaConf

from frictionzoo import fit
from frictionzoo.core.build import build
from frictionzoo.core.config import (
    _OPEN,
    _TAKES,
    CONF_DIR,
    check_overrides,
    compose_config,
    create_literal,
    list_choices,
    list_options,
)
from frictionzoo.core.described import describe
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.segments import cut_segments
from frictionzoo.data.clean import Cleaning
from frictionzoo.data.files import Files
from frictionzoo.data.split import Split
from frictionzoo.fit import Grid, loggers, run_fit
from frictionzoo.fit.loss import Loss
from frictionzoo.models import Baseline, registry
from frictionzoo.models.by_name import complete_laws
from frictionzoo.result.evaluate import Evaluator

METHODS = {"adam": "Adam", "lm": "LevenbergMarquardt", "auto": "Auto", "grid": "Grid"}
HOMES = {"model": "models", "bench": "bench", "fit": "fit", "logger": "fit"}  # where the classes of a group are
CHOICES = {group: list_choices(group) for group in (*HOMES, "data")}
EXPERIMENTS = sorted((CONF_DIR / "experiment").glob("*.yaml"))
VARIANTS = [
    (experiment.stem, model)
    for experiment in EXPERIMENTS
    for model in CHOICES["model"]
    if (CONF_DIR / "variant" / f"{experiment.stem}_{model}.yaml").exists()
]


def changed(plain: DictConfig, *overrides: str) -> DictConfig:
    """A composed configuration with other values; a key after ~ is left out."""
    config = OmegaConf.create(OmegaConf.to_container(plain))
    for section, _, key in (override[1:].rpartition(".") for override in overrides if override.startswith("~")):
        del OmegaConf.select(config, section)[key]
    return OmegaConf.merge(config, OmegaConf.from_dotlist([text for text in overrides if not text.startswith("~")]))


@pytest.mark.parametrize("number", range(max(map(len, CHOICES.values()))), ids=CHOICES["model"])
def test_every_choice_composes_resolves_and_builds(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """With each law a file of each other group; but for data, which choose their bench, no group looks at another."""
    monkeypatch.setattr(loggers, "_require", lambda *packages: None)  # loggers whose package is not installed
    chosen = {group: names[number % len(names)] for group, names in CHOICES.items() if group != "bench"}
    gains = [f"bench.actuator.params.{name}.init=2" for name in ("kp", "kd") if chosen["data"] == "files"]
    config = OmegaConf.to_container(compose_once(*map("=".join, chosen.items()), *gains), resolve=True)
    assert set(config) >= {*CHOICES, "seed", "segments", "loss", "loop", "evaluation"}
    assert isinstance(config["seed"], int)
    for group, home in HOMES.items():
        section = complete_laws(config[group], config) if group == "model" else config[group]
        if "FRICTIONZOO_DATA/" in str(section.get("mjcf")):
            continue  # a robot's own file, which comes with its recordings, and these are not here
        part = build(section, **({"nv": 1} if group == "model" else {}))
        assert type(part).__module__.startswith(f"frictionzoo.{home}")


DEFAULTS = {  # what Python takes where nothing is said, by the choice and the section that say it for the command line
    **{f"fit={name}": getattr(fit, cls) for name, cls in METHODS.items()},
    **{f"logger={name}": getattr(loggers, name.capitalize()) for name in ("wandb", "mlflow")},
    "data=files": Files,
    "data=files clean": Cleaning,
    "data=files split": Split,
    "segments": cut_segments,
    "loss": Loss,
    "evaluation": Evaluator,
    "loop": run_fit,
}
LEFT_TO_THE_JOB = {"history", "params", "_target_"}


@pytest.mark.parametrize("place", DEFAULTS)
def test_defaults_of_the_command_line_are_those_of_python(place: str) -> None:
    choice, _, section = place.partition(" ")
    group, _, _ = choice.partition("=")
    said = OmegaConf.to_container(compose_once(*[choice] if "=" in choice else []), resolve=True)[group]
    said = without_nulls(said[section] if section else said)
    function = DEFAULTS[place].__init__ if isinstance(DEFAULTS[place], type) else DEFAULTS[place]
    parameters = inspect.signature(function).parameters.values()
    defaults = without_nulls({p.name: describe(p.default) for p in parameters if p.default is not p.empty})
    left = LEFT_TO_THE_JOB | ({"clean", "split"} if place == "data=files" else set())
    assert {k: v for k, v in said.items() if k not in left} == {k: v for k, v in defaults.items() if k not in left}


def without_nulls(section: dict[str, Any]) -> dict[str, Any]:
    """A section without what it says nothing of."""
    inner = {name: without_nulls(value) if isinstance(value, dict) else value for name, value in section.items()}
    return {name: value for name, value in inner.items() if value not in (None, {}, [])}


def test_every_bench_and_every_variant_is_looked_at() -> None:
    chosen = [OmegaConf.load(CONF_DIR / "data" / f"{name}.yaml").get("defaults", []) for name in CHOICES["data"]]
    benches = {entry["override /bench"] for defaults in chosen for entry in defaults if "override /bench" in entry}
    assert benches | {"knee"} == set(CHOICES["bench"])
    variants = {path.stem for path in (CONF_DIR / "variant").glob("*.yaml")}
    assert variants - {"_".join(pair) for pair in VARIANTS} == {"sts3215_network"}  # what others begin with


def test_a_variant_is_taken_with_its_experiment_and_model() -> None:
    check_each(check_variant, VARIANTS)


def check_variant(experiment: str, model: str) -> None:
    name, config = f"{experiment}_{model}", compose_once(f"experiment={experiment}", f"model={model}")
    asked = OmegaConf.load(CONF_DIR / "variant" / f"{name}.yaml")
    for file in [*(base for base in asked.pop("defaults", []) if base != "_self_"), name]:
        for key, value in list_options(OmegaConf.to_container(OmegaConf.load(CONF_DIR / "variant" / f"{file}.yaml"))):
            assert key == "defaults" or OmegaConf.select(config, key) == value, key


def test_an_experiment_starts_with_the_command_that_runs_it() -> None:
    """As it is on a page."""
    pages = [page.read_text() for page in (CONF_DIR.parent / "experiments").glob("*/README.md")]
    check_each(functools.partial(check_experiment, pages=pages), EXPERIMENTS)


def check_experiment(path: Path, pages: list[str]) -> None:
    package, command = path.read_text().splitlines()[:2]
    assert package == "# @package _global_"  # Hydra reads it in the first line only
    assert any(command.removeprefix("# ") in page for page in pages)
    words = shlex.split(command.removeprefix("# "))
    assert words[:4] == ["python", "-m", "frictionzoo.run", f"experiment={path.stem}"]
    chosen = compose_once(*words[3:])
    plain = compose_once(f"data={chosen.data.name}", *words[4:], *_choices(path))
    check_overrides(chosen, plain)


def _choices(path: Path) -> list[str]:
    """Model, fit and start that an experiment chooses, as overrides."""
    defaults = OmegaConf.load(path).get("defaults", [])
    groups = [(group, f"override /{group}") for group in ("model", "fit", "start")]
    return [f"{group}={entry[key]}" for entry in defaults for group, key in groups if key in entry]


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "frictionzoo",
        "eval",
        "frictionzoo.core.errors.closest",  # a function
        "frictionzoo.fit.Newton",
        "frictionzoo_evil.Adam",
        "frictionzoo.fit.loggers.TensorBoardLogger",  # a class of another package
        "frictionzoo.data.formats.Path",
    ],
)
def test_build_refuses_foreign_targets(target: str) -> None:
    with pytest.raises(ConfigError, match=rf"_target_={target}; expected a class"):
        build({"_target_": target})
    with pytest.raises(ConfigError, match=rf"_target_={target}; expected a class"):  # inside a section
        build({"_target_": "frictionzoo.fit.Grid", "points": {"_target_": target, "command": "true"}})


def test_a_registered_law_is_built_wherever_it_is_defined(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry.REGISTRY, "entries", dict(registry.REGISTRY.entries))

    @registry.register_model("linear_friction")
    class Linear(Baseline):
        pass

    target = f"{Linear.__module__}.{Linear.__qualname__}"
    assert isinstance(build({"_target_": target}, nv=2), Linear)
    with pytest.raises(ConfigError, match="_target_="):
        build({"_target_": target.replace("Linear", "Cubic")}, nv=2)


def test_build_makes_the_class_with_its_arguments() -> None:
    with pytest.raises(ConfigError, match=r"fit\.points=1; expected at least 2"):
        build({"_target_": "frictionzoo.fit.Grid", "points": 1})
    assert isinstance(build({"_target_": "frictionzoo.fit.Grid"}, points=2), Grid)


@pytest.mark.parametrize(
    ("target", "arguments"), [("frictionzoo.bench.Bench", {}), ("frictionzoo.fit.Grid", {"points": 3, "speed": 1})]
)
def test_build_refuses_other_arguments(target: str, arguments: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=re.escape(target)):
        build({"_target_": target, **arguments})


@pytest.mark.parametrize(
    ("data", "overrides"),
    [
        ("twin", ["segments.count=null", "loop.patience=3", "loop.progress=false", "data.cache_dir=null"]),
        ("twin", ["fit.learning_rate=1", "evaluation.horizons=[1,0.5]", "bench.joint=[knee]", "threads=3"]),
        ("twin", ["model.params.static_torque.scale=2.0", "resume=outputs/yesterday", "seed=7", "bench.joint=null"]),
        ("emps", ["segments.count=3", "data.folder=somewhere"]),
        ("files", ["data.where={kp: [4,8]}", "data.inputs={gain: kp}", "data.train=a.csv", "data.split.test=0.2"]),
        ("files", ["data.clean.velocity_lag=auto", "data.clean.step=0.01", "data.split.gap=0"]),
    ],
)
def test_overrides_of_the_right_kind_pass(data: str, overrides: list[str]) -> None:
    plain = compose_once(f"data={data}")
    check_overrides(changed(plain, *overrides), plain)


def test_options_that_take_more_than_conf_shows_exist_and_no_other_is_null() -> None:
    """The list in the code and the files in conf/ must not drift apart."""
    nulls, keys = set(), set()
    for choice in ("data=emps", "data=files", "data=twin", "model=by_joint"):
        plain = dict(list_options(OmegaConf.to_container(compose_once(choice), resolve=True)))
        keys |= set(plain)
        nulls |= {key for key, value in plain.items() if value is None and key not in _OPEN}
    assert all(fnmatch.filter(keys, name) for name in _TAKES)
    assert nulls == {key for name, kinds in _TAKES.items() if None in kinds for key in fnmatch.filter(nulls, name)}


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("segments.count=many", "segments.count=many; expected a whole number such as 20000"),
        ("segments.length=true", "segments.length=True; expected a whole number such as 5"),
        ("loop.progress=1", "loop.progress=1; expected true or false"),
        ("loop.patience=2.5", "loop.patience=2.5; expected a whole number"),
        ("evaluation.horizons=1", "evaluation.horizons=1; expected a list such as [1.0]"),
        ("evaluation.horizons=[long]", "evaluation.horizons=['long']; expected a list such as [1.0]"),
        ("dtype=auto", "dtype=auto: recipe=given leaves nothing open, expected a value such as float"),
        ("bench.timestep=auto", "expected a value; or add recipe=auto"),
        ("bench.joint=3.5", "bench.joint=3.5; expected text such as knee"),
        ("seed=x", "seed=x; expected a whole number from 0 on"),
        ("bench.friction=3", "bench.friction: unknown option; did you mean solreffriction?"),
        ("modl.params=3", "modl.params: unknown option; did you mean model?"),
        ("seed.deep=3", "seed.deep: unknown option; did you mean seed? (expected one of "),
        ("segments.cuont=3", "did you mean count? (expected one of count, length) in segments"),
        ("~segments.count", "segments.count: missing; expected a value such as 20000"),
        ("loss=3", "loss=3; expected a section with position, velocity"),
    ],
)
def test_overrides_of_another_kind_are_refused(override: str, message: str) -> None:
    with pytest.raises(ConfigError) as refused:
        check_overrides(changed(compose_once("data=twin"), override), compose_once("data=twin"))
    assert message in str(refused.value)


@given(st.lists(st.sampled_from([*"\\${}'\": .a", "${", "\\${", "${seed}", "${oc.env:HOME}"])).map("".join))
def test_saved_text_refers_to_nothing(text: str) -> None:
    settings = {"bench": {"joint": text, "tie": [text]}}
    assert OmegaConf.to_container(create_literal(settings), resolve=True) == settings


def test_runs_of_other_seeds_are_judged_on_the_same_rollouts() -> None:
    config = compose_config("seed=5", "model=neural_friction")
    assert config.model.seed == 5 and config.evaluation.seed == compose_once("data=twin").evaluation.seed
