"""Configuration: its location, resolvers and valid overrides."""

import contextlib
import copy
import functools
import json
import math
import re
import sys
from collections.abc import Iterator, Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, cast

import yaml
from hydra import compose, initialize_config_dir
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf

from frictionzoo.core.declared import ModelSource
from frictionzoo.core.described import describe
from frictionzoo.core.errors import ConfigError, closest
from frictionzoo.core.params import AUTO
from frictionzoo.core.registry import KINDS
from frictionzoo.core.threads import count_cores, jobs_at_once, threads_each

_PACKAGE = Path(__file__).parents[1]
# A wheel ships conf/ inside the package; in a checkout it lies next to the package.
CONF_DIR = _PACKAGE / "conf" if (_PACKAGE / "conf").is_dir() else _PACKAGE.parent / "conf"
# Options that accept other kinds of values than in conf/: an example of each kind, None for null.
_TAKES: dict[str, tuple[Any, ...]] = {
    "bench.actuator.params.k[pd].init": (0.1, [0.1], None),
    **dict.fromkeys(("threads", "segments.count", "loop.patience", "evaluation.rollouts"), (0, None)),
    **dict.fromkeys(("compilation_cache", "bench.payload"), ("", None)),
    **{f"data.{part}": ("", None) for part in ("folder", "origin", "cache_dir", "source", "fields_from_name")},
    **{f"loss.{part}": (0.1,) for part in ("position", "velocity", "robust_scale", "encoder_step")},
    **dict.fromkeys(("loss.refine", "loss.by_joint", "bench.second_order"), (True,)),
    **dict.fromkeys(("evaluation.torque.bandwidth", "bench.timestep"), (0.1, None)),
    **{f"data.clean.{part}": (0.1, None) for part in ("step", "command_lag", "cutoff")},
    **dict.fromkeys(("data.train", "data.test"), ("", [])),
    **{f"*.params.*.{part}": (0.1, [0.1]) for part in ("init", "low", "high")},
    "resume": ("", True, None),
    "model.laws": ("", []),
    "segments.length": (0,),
    "loss.robust": ("",),
    "fit.start": ({}, None),
    "evaluation.torque.held": (True, None),
    "bench.joint": ("", [""], 0, [0], None),  # a joint may be called 0
    "bench.solreffriction": ([0.1], ""),
    "*.params.*.scale": ("", 0.1),
    "*.params.*.identify": (True, [True]),
    "data.columns.*": ("", [""], 0, [0], None),  # columns without a header are numbered
    "data.units.*": ("", 0.1, None),
    "data.sign.*": (1, [1]),
    "data.split.test": ([], "", 0.0),
    "data.split.gap": (1.0, None),
    **dict.fromkeys(("data.clean.velocity_lag", "data.clean.wrap"), (0.1, "", None)),
    "data.registers": ("", {}, None),
}
_OWN_CACHE = "user"  # the user's cache folder of the operating system
_LARGEST, _LARGEST_SEED = 2**31 - 1, 2**63 - 1  # JAX counts in 32 bits, generators take 64-bit seeds
_KINDS = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    list: "a list",
    str: "text",
    dict: "a section",
}
# Sections whose keys a user chooses: names of fields and signals, patterns of joints and their groups.
_OPEN = (
    *("model.laws", "bench.tie"),
    *(f"data.{part}" for part in ("columns", "units", "registers", "fields", "where", "exclude", "inputs")),
    *(f"*.params.*.{part}" for part in ("init", "low", "high", "identify", "tie")),
)


class _ModelPath(SearchPathPlugin):
    """Friction models in frictionzoo's search path, after the files of all packages, which have precedence."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        if any(element.path == str(CONF_DIR) for element in search_path.get_path()):
            search_path.append("frictionzoo", f"{ModelSource.scheme()}://")


def prepare_hydra() -> None:
    """Register friction models, `mul`, `div`, `run_dir` (the resumed folder, else a new one) and core counts.

    Remove schemas of Hydra plug-ins named like a file in `conf/hydra/`: merging them would warn or fail.
    """
    resolvers = {
        "mul": lambda factor, other: float(factor) * float(other),
        "div": lambda dividend, divisor: float(dividend) / float(divisor),
        "run_dir": lambda resume, new: new if resume in (None, "None") else resume,
        "cores": count_cores,
        "threads_each": threads_each,
        "jobs_at_once": jobs_at_once,
    }
    for name, resolver in resolvers.items():
        OmegaConf.register_new_resolver(name, resolver, replace=True)
    Plugins.instance().register(ModelSource)  # after the plugins, which it imports; they store their schemas
    Plugins.instance().register(_ModelPath)
    store = ConfigStore.instance()
    for path in (CONF_DIR / "hydra").glob("*/*.yaml"):
        store.repo.get("hydra", {}).get(path.parent.name, {}).pop(path.name, None)


def compose_config(*overrides: str) -> DictConfig:
    """Compose the configuration of a job from overrides, `key=value`, as on the command line."""
    with _hydra():
        return compose("config", overrides=list(overrides))


def compose_settings(given: Mapping[str, Any], *choices: str) -> dict[str, Any]:
    """Compose, check and resolve the configuration with these choices, `group=name`, and options by section.

    Objects among the options become the sections that make them.

    Raises:
        ConfigError: An option does not exist or cannot have this value.
    """
    plain = _compose_plain(choices)
    config = copy.deepcopy(plain)
    OmegaConf.set_struct(config, False)
    config = cast(DictConfig, OmegaConf.merge(config, describe(given)))
    check_overrides(config, plain)
    return resolve(config)


def _compose_plain(choices: tuple[str, ...]) -> DictConfig:
    """Compose a configuration without options; remember it, because Hydra reads all files again, for 0.1 s."""
    if GlobalHydra.instance().is_initialized():  # the program's search path may have folders of the user
        return compose_config(*choices)
    models = sys.modules.get(KINDS["models"].home)
    entries = models.REGISTRY.entries if models else {}
    # A notebook may define a model again.
    return _remember_plain(choices, tuple(entries.get(choice.removeprefix("model=")) for choice in choices), *sys.path)


@functools.lru_cache(maxsize=64)
def _remember_plain(choices: tuple[str, ...], models: tuple[type | None, ...], *path: str) -> DictConfig:
    return compose_config(*choices)


def merge_saved(saved: Mapping[str, Any], before: DictConfig, after: DictConfig) -> DictConfig:
    """Return a run's saved settings with the changes of the current command.

    `before` has the run's choices of files, `after` the command's options too. The logger is the command's. Caches stay
    in the user's folder: compiled functions from a cache are executed, and the saved settings may come from a stranger.
    """
    plain, changed = (json.loads(json.dumps(resolve(part))) for part in (before, after))
    merged = _carry_over(keep_caches_at_home(saved), plain, changed)
    return create_literal({**merged, "logger": changed["logger"], "resume": changed["resume"]})


def create_literal(settings: Mapping[str, Any]) -> DictConfig:
    """Return resolved settings, perhaps a stranger's, as a configuration in which `${...}` refers to nothing.

    Raises:
        ConfigError: A setting is `???`, which stands for a missing value.
    """
    return cast(DictConfig, OmegaConf.create(_escape(settings)))


def _escape(settings: Any) -> Any:
    if isinstance(settings, Mapping):
        return {key: _escape(value) for key, value in settings.items()}
    if isinstance(settings, list):
        return [_escape(value) for value in settings]
    if settings == "???":
        raise ConfigError("??? in saved settings, expected values; run it again")
    if isinstance(settings, str) and "${" in settings:
        return re.sub(r"(\\*)\$\{", lambda match: rf"{match[1] * 2}\${{", settings)
    return settings


def keep_caches_at_home(saved: Mapping[str, Any]) -> dict[str, Any]:
    """Return saved settings with caches in other folders moved to the user's."""
    settings = dict(saved)
    if settings.get("compilation_cache") not in (None, _OWN_CACHE):
        settings["compilation_cache"] = _OWN_CACHE
    data = settings.get("data")
    if isinstance(data, Mapping) and data.get("cache_dir") not in (None, _OWN_CACHE):
        settings["data"] = {**data, "cache_dir": _OWN_CACHE}
    return settings


def _carry_over(saved: Any, before: Any, after: Any) -> Any:
    """Return the saved value with the changes from `before` to `after`."""
    if not all(isinstance(value, Mapping) for value in (saved, before, after)):
        return saved if before == after else after
    kept = {key: value for key, value in saved.items() if key not in before or key in after}
    shared = {key: _carry_over(kept[key], before[key], after[key]) for key in kept if key in before}
    changed = {key: value for key, value in after.items() if key not in kept and value != before.get(key)}
    return kept | shared | changed


def read_value(option: str) -> DictConfig:
    """Return the configuration with one option, `KEY=VALUE`; ConfigError if the value is not YAML."""
    try:
        return OmegaConf.from_dotlist([option])
    except yaml.YAMLError:
        raise ConfigError(f"{option}: cannot be read, expected KEY=VALUE; close quotes and brackets") from None


def override(plain: DictConfig, options: Mapping[str, str]) -> DictConfig:
    """Return a configuration with these options, as text by dotted key.

    Raises:
        ConfigError: An option does not exist, or its value is not YAML or of the wrong kind.
    """
    values = (read_value(f"{key}={value}") for key, value in options.items())
    config = cast(DictConfig, OmegaConf.merge(plain, *values))
    check_overrides(config, plain)
    return config


def resolve(config: DictConfig) -> dict[str, Any]:
    """Return a configuration as dictionaries and lists without references."""
    return cast(dict[str, Any], OmegaConf.to_container(config, resolve=True))


def list_choices(group: str) -> list[str]:
    """List the files of a configuration group by name, including those of other packages."""
    with _hydra():
        return GlobalHydra.instance().config_loader().get_group_options(group)


def is_choice(group: str, name: str) -> bool:
    """Return whether `list_choices` has this name, without reading all files; never for a path, which may lead out."""
    if not name.isidentifier():
        return False
    with _hydra():
        sources = GlobalHydra.instance().config_loader().get_sources()
    return any(source.is_config(f"{group}/{name}") for source in sources)


@contextlib.contextmanager
def _hydra() -> Iterator[None]:
    """Use Hydra as the running program started it, else start it."""
    prepare_hydra()
    if GlobalHydra.instance().is_initialized():
        yield
    else:
        with initialize_config_dir(str(CONF_DIR), version_base="1.3"):
            yield


def check_overrides(config: DictConfig, plain: DictConfig) -> None:
    """Refuse options that do not exist, are missing, or have a value of the wrong kind.

    Raises:
        ConfigError: A key or a value differs in kind from `plain`, which has only the choices of groups.
    """
    # Unresolved values first: a value that refers to a mistaken one fails to resolve, under the wrong name.
    for resolve in (False, True):
        before, after = (dict(list_options(OmegaConf.to_container(part, resolve=resolve))) for part in (plain, config))
        _check_keys(before, after, plain)
        for key, value in after.items():
            _check_value(key, value, before.get(key))


def _check_keys(before: Mapping[str, Any], after: Mapping[str, Any], plain: DictConfig) -> None:
    for key in [key for key in after if key not in before]:
        options = [name.removeprefix(f"{key}.") for name in before if name.startswith(f"{key}.")]
        if options:
            raise ConfigError(f"{key}={_text(after[key])}; expected a section with {', '.join(options)}")
        if not _is_open(key):
            raise ConfigError(f"{key}: unknown option; {suggest_option(key, plain)}")
    for key in [key for key in before if key not in after and not _is_open(key)]:
        raise ConfigError(f"{key}: missing; expected a value such as {before[key]}; do not delete it")


def _is_open(key: str) -> bool:
    return any(fnmatchcase(key, section) or fnmatchcase(key, f"{section}.*") for section in _OPEN)


def _check_value(key: str, value: Any, default: Any) -> None:
    if any(isinstance(text, str) and "${" in text for text in (value, default)) or value == default == AUTO:
        return
    _refuse_open(key, value, default)
    examples = next((kinds_taken for name, kinds_taken in _TAKES.items() if fnmatchcase(key, name)), (default,))
    if default is None or key.endswith(".torque_limit.init"):  # a robot's file may state it
        examples = (*examples, None) if None not in examples else examples
    if examples == (None,):  # the code that takes the value checks its kind
        return _check_numbers(key, value, _LARGEST_SEED)
    hint = "" if default in (None, "") else f" such as {default}"
    kinds = {type(example): hint if _is_like(default, example) else "" for example in examples if example is not None}
    expected = " or ".join(f"{_KINDS[kind]}{hint}" for kind, hint in kinds.items())
    if None in examples:
        expected += ", or null"
    if seed := key.rpartition(".")[2] == "seed":
        expected = "a whole number from 0 on, so that the run can be repeated"
    matching = [example for example in examples if _is_like(value, example)]
    if not matching or (seed and value < 0):
        raise ConfigError(f"{key}={_text(value)}; expected {expected}")
    is_count = isinstance(matching[0], int) and not seed
    _check_numbers(key, value, _LARGEST if is_count else _LARGEST_SEED)
    if key.startswith("scale.") and not value > 0:
        raise ConfigError(f"{key}={_text(value)}; expected a number above 0{hint}")


def _refuse_open(key: str, value: Any, default: Any) -> None:
    if value == AUTO and key in _list_left_open():
        hint = "" if default is None else f" such as {default}"
        raise ConfigError(f"{key}={AUTO}: recipe=given leaves nothing open, expected a value{hint}; or add recipe=auto")


@functools.cache
def _list_left_open() -> frozenset[str]:
    options = OmegaConf.to_container(OmegaConf.load(CONF_DIR / "open" / "auto.yaml"))
    return frozenset(key for key, value in list_options(options) if value == AUTO)


def _check_numbers(key: str, value: Any, largest: int) -> None:
    for number in _numbers(value):
        if isinstance(number, int) and abs(number) > largest:
            raise ConfigError(f"{key}={_text(value)}; expected whole numbers of at most {largest}")
        if not math.isfinite(number):
            raise ConfigError(f"{key}={_text(value)}; expected a finite number")


def _is_like(value: Any, example: Any) -> bool:
    """Return whether a value is of an example's kind; empty text is of no kind."""
    if isinstance(example, bool) or isinstance(value, bool):
        return isinstance(value, bool) and isinstance(example, bool)
    if isinstance(example, list):
        return isinstance(value, list) and all(_is_like(item, sample) for sample in example[:1] for item in value)
    if isinstance(example, float):
        return isinstance(value, int | float)
    return isinstance(value, type(example)) and value != ""


def _numbers(value: Any) -> Iterator[int | float]:
    if isinstance(value, list | dict):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _numbers(item)
    elif isinstance(value, int | float):
        yield value


def _text(value: Any) -> str:
    return "null" if value is None else str(value)


def list_options(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every value of nested dictionaries with its dotted key; lists are values."""
    for key, value in config.items():
        if isinstance(value, dict):
            yield from list_options(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def suggest_option(key: str, config: DictConfig) -> str:
    """Return a hint for an unknown dotted key: the closest name where the key leaves the configuration."""
    section, path = config, ""
    for name in key.split("."):
        inner = section.get(name) if name in section else None
        if not isinstance(inner, DictConfig):
            options = [str(option) for option in section if option != "_target_"]  # the class is not an option
            return f"{closest(name, options)}{f' in {path}' if path else ''}"
        section, path = inner, f"{path}.{name}".lstrip(".")
    return closest(key, map(str, config))
