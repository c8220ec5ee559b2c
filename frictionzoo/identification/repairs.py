"""Repairs of a run's findings as shell options or as a Python call."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from frictionzoo.bench import Bench
from frictionzoo.core.described import describe
from frictionzoo.data.clean import Cleaning
from frictionzoo.data.files import Files
from frictionzoo.diagnostics.findings import Repair

_PARAMS, _SIGN, _BENCH, _DATA = ".params.", "data.sign.", "bench.", "data."
_WIDER = 10.0  # distance factor of a new bound from a repaired value outside the bounds
_READ = ("format", "columns", "units", "sign", "fields", "fields_from_name", "where", "exclude", "inputs", "payload")


def complete_options(repairs: Iterable[Repair], bench: Bench, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that make all these repairs; lists have an entry for each joint, repaired or not.

    Args:
        repairs: Repairs of one or several findings; the first one for an option and joint counts.
        bench: The test stand of the run.
        settings: All options of the run.
    """
    options: dict[str, Any] = {}
    done: set[tuple[str, int | None]] = set()
    for repair in repairs:
        option, value, joint = repair.option, repair.value, repair.joint
        if (option, joint) in done:
            continue
        done.add((option, joint))
        if joint is None:
            options.setdefault(option, value)
            continue
        entries = options.setdefault(option, _present(option, bench, settings))
        entries[joint] = _round(entries[joint] * value) if repair.is_factor else value
    options |= _widen(options, settings)
    return {name: value[0] if isinstance(value, list) and len(value) == 1 else value for name, value in options.items()}


def _present(option: str, bench: Bench, settings: Mapping[str, Any]) -> list[Any]:
    """Return the current value of an option for each joint."""
    if option.startswith(_SIGN):
        sign = (settings["data"].get("sign") or {}).get(option.removeprefix(_SIGN), 1)
        return np.broadcast_to(sign, bench.nv).tolist()
    name = option.partition(_PARAMS)[2].partition(".")[0]
    return bench.initial_values()[name].tolist()


def _round(value: float | int) -> float | int:
    return value if isinstance(value, int) else float(f"{value:.4g}")


def _widen(options: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return wider bounds for parameters that a repair puts outside their current bounds."""
    wider: dict[str, Any] = {}
    for option, values in options.items():
        *path, last = option.split(".")
        section: Any = settings
        for name in path:
            section = section.get(name, {}) if isinstance(section, Mapping) else {}
        if last != "init" or not isinstance(section, Mapping):
            continue
        low, high = section.get("low"), section.get("high")
        stem = ".".join(path)
        if isinstance(high, int | float) and max(values) > high:
            wider[f"{stem}.high"] = _WIDER * max(values)
        if isinstance(low, int | float) and min(values) < low:
            wider[f"{stem}.low"] = min(values) / _WIDER
    return wider


def bench_call(options: Mapping[str, Any]) -> str:
    """Return Python code for the bench with these options."""
    own = {name.removeprefix(_BENCH): value for name, value in options.items() if name.startswith(_BENCH)}
    return f"bench.with_options({own!r})" if own else "bench"


def logs_call(options: Mapping[str, Any], section: Mapping[str, Any]) -> str | None:
    """Return Python code that reads the recordings with these options; None if they are in no file.

    Args:
        options: Options by name.
        section: The data settings of the run.
    """
    own = {name.removeprefix(_DATA): value for name, value in options.items() if name.startswith(_DATA)}
    if not own:
        return "logs"
    if section["_target_"].rpartition(".")[2] != Files.__name__:
        return None
    read = {name: section[name] for name in _READ if section.get(name) not in (None, [], {}, "auto")}
    clean = {name: value for name, value in section["clean"].items() if name != "_target_"}
    for name, value in own.items():
        part, _, key = name.partition(".")
        if part == "clean":
            clean[key] = value
        else:
            read[part] = {**read.get(part, {}), key: value}
    if "sign" in read:
        read["sign"] = {name: value for name, value in read["sign"].items() if value != 1}
    usual = describe(Cleaning())
    changed = [f"{name}={value!r}" for name, value in clean.items() if value != usual[name]]
    named = [*map(repr, section["train"]), *([f"test={section['test']!r}"] if section["test"] else [])]
    named += [f"{name}={value!r}" for name, value in read.items() if value != {}]
    named += [f"clean=fz.Cleaning({', '.join(changed)})"] if changed else []
    return f"fz.read({', '.join(named)})"
