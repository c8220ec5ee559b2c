"""The configuration: where it lies, its resolvers, and what an override may be."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from omegaconf import DictConfig, OmegaConf

from frictionzoo.errors import ConfigError, closest
from frictionzoo.threads import count_cores, jobs_at_once, threads_each

_PACKAGE = Path(__file__).parent
# A wheel ships conf/ inside the package; in a checkout it stands beside it.
CONF_DIR = _PACKAGE / "conf" if (_PACKAGE / "conf").is_dir() else _PACKAGE.parent / "conf"
_NUMBERS = (int, float)
# Options that may be null, with an example of each kind of value that they take besides.
_NULLABLE: dict[str, tuple[Any, ...]] = {
    "resume": ("", True),
    "threads": (0,),
    "compilation_cache": ("",),
    "segments.count": (0,),
    "loop.patience": (0,),
    "evaluation.rollouts": (0,),
    "bench.joint": ("", []),
    "bench.payload": ("",),
    "bench.timestep": (0.1,),
    "data.clean.wrap": (0.1,),
    "data.folder": ("",),
    "data.cache_dir": ("",),
    "data.source": ("",),
    "data.fields_from_name": ("",),
    "data.train": ("", []),
    "data.test": ("", []),
    "data.split.test": ([], 0.0),
    "data.clean.step": (0.0,),
    "data.clean.velocity_lag": (0.0, ""),
}
# Sections whose keys a user chooses: names of fields and signals.
_OPEN = ("data.columns", "data.units", "data.fields", "data.where", "data.exclude", "data.inputs")


def register_resolvers() -> None:
    """Make `mul`, `div`, `run_dir` (the resumed folder, else a new one) and counts of cores known to configurations."""
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


def forget_plugin_schemas() -> None:
    """Let `conf/hydra/` stand alone against configurations of the same name that Hydra's plugins bring.

    Hydra would merge the two, with a warning that this is deprecated, or refuse to.
    """
    Plugins.instance()  # imports the plugins, which store theirs
    store = ConfigStore.instance()
    for path in (CONF_DIR / "hydra").glob("*/*.yaml"):
        store.repo.get("hydra", {}).get(path.parent.name, {}).pop(path.name, None)


def compose_config(*overrides: str) -> DictConfig:
    """The configuration of a job with these overrides, as the command line would compose it.

    Args:
        overrides: `key=value`, as on the command line.
    """
    register_resolvers()
    forget_plugin_schemas()
    with _hydra():
        return compose("config", overrides=list(overrides))


def list_choices(group: str) -> list[str]:
    """Names of the files of a configuration group, those that other packages bring included, sorted.

    Args:
        group: Its folder below conf/.
    """
    with _hydra():
        return GlobalHydra.instance().config_loader().get_group_options(group)


@contextlib.contextmanager
def _hydra() -> Iterator[None]:
    """Hydra as the program that runs has started it, or else started here."""
    if GlobalHydra.instance().is_initialized():
        yield
    else:
        with initialize_config_dir(str(CONF_DIR), version_base="1.3"):
            yield


def check_overrides(config: DictConfig, plain: DictConfig) -> None:
    """Refuse options that do not exist, are gone, or have a value of another type than the one that it replaces.

    Args:
        config: The composed configuration.
        plain: The same with nothing but the choices of groups.

    Raises:
        ConfigError: A key or a value is not what `plain` has in its place.
    """
    before, after = (
        {key: value for key, value in list_options(OmegaConf.to_container(part, resolve=True)) if not _is_open(key)}
        for part in (plain, config)
    )
    for key in [key for key in after if key not in before]:
        inside = [name.removeprefix(f"{key}.") for name in before if name.startswith(f"{key}.")]
        if inside:
            raise ConfigError(f"{key}={_text(after[key])}; expected a section with {', '.join(inside)}")
        raise ConfigError(f"{key}: unknown option; {suggest_option(key, plain)}")
    for key in [key for key in before if key not in after]:
        raise ConfigError(f"{key}: missing; expected a value such as {before[key]}; do not delete it")
    for key, value in after.items():
        _check_value(key, value, before[key])


def _is_open(key: str) -> bool:
    return any(key == section or key.startswith(f"{section}.") for section in _OPEN)


def _check_value(key: str, value: Any, example: Any) -> None:
    name = key.rpartition(".")[2]
    if name == "seed" and not (_same_kind(value, 0) and value >= 0):
        raise ConfigError(f"{key}={_text(value)}; expected a whole number from 0 on, so that the run can be repeated")
    # A parameter's scale is text or a number; `Param` looks at it.
    if name == "scale" or (value is None and (key in _NULLABLE or example is None)):
        return
    examples = _NULLABLE.get(key, () if example is None else (example,))
    if examples and not any(_same_kind(value, other) for other in examples):
        such = "" if example is None else f" such as {example}"
        raise ConfigError(f"{key}={_text(value)}; expected {' or '.join(map(_kind, examples))}{such}")


def _same_kind(value: Any, example: Any) -> bool:
    if isinstance(example, bool) or isinstance(value, bool):
        return isinstance(value, bool) and isinstance(example, bool)
    if isinstance(example, int):
        return isinstance(value, int)
    if isinstance(example, list):
        return isinstance(value, list) and all(_same_kind(item, first) for first in example[:1] for item in value)
    return isinstance(value, _NUMBERS) if isinstance(example, float) else isinstance(value, type(example))


def _text(value: Any) -> str:
    return "null" if value is None else str(value)


def _kind(example: Any) -> str:
    kinds = {bool: "true or false", int: "a whole number", float: "a number", list: "a list", str: "text"}
    return kinds.get(type(example), type(example).__name__)


def list_options(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every value with its dotted key, lists as values.

    Args:
        config: A section, resolved, as nested dictionaries.
        prefix: What its keys begin with.
    """
    for key, value in config.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict):
            yield from list_options(value, f"{name}.")
        else:
            yield name, value


def suggest_option(key: str, config: DictConfig) -> str:
    """Hint for an unknown dotted key: the closest name at the first place where it leaves the configuration."""
    section, known = config, ""
    for name in key.split("."):
        inner = section.get(name) if name in section else None
        if not isinstance(inner, DictConfig):
            return f"{closest(name, map(str, section))}{f' in {known}' if known else ''}"
        section, known = inner, f"{known}.{name}".lstrip(".")
    return closest(key, map(str, config))
