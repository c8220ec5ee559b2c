"""Bench and recordings of an identification, read before the slow imports."""

import copy
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

from frictionzoo.bench.base import Bench
from frictionzoo.bench.gains import find_gains, list_missing
from frictionzoo.core.build import build
from frictionzoo.core.errors import MissingValueError
from frictionzoo.core.log import Dataset
from frictionzoo.core.params import Param
from frictionzoo.data.source import Source


class Given(NamedTuple):
    """Input of an identification, read in `seconds` [s] without torch and JAX; `settings` include recorded gains."""

    bench: Bench
    dataset: Dataset
    seconds: float
    settings: Mapping[str, Any]

    @classmethod
    def read(cls, settings: Mapping[str, Any]) -> "Given":
        """Return the bench and recordings of the sections `bench` and `data`; missing gains come from the recordings.

        Raises:
            FrictionzooError: The bench, the recordings or the section of a friction parameter are missing or invalid.
        """
        start = time.perf_counter()
        # The friction model checks names and dimensions when it is built.
        for name, section in (settings.get("model", {}).get("params") or {}).items():
            Param.from_config(name, "1", section)
        source, section = build(settings["data"], Source), settings["bench"]
        bench, missing = build_open(section)
        dataset = source.for_joints(bench.joints, bench.passive).load()
        if missing:
            section = _put_gains(section, find_gains(section, dataset, missing))
            bench = build(section, Bench)
        return cls(bench, dataset, time.perf_counter() - start, {**settings, "bench": section})


def build_open(section: Mapping[str, Any]) -> tuple[Bench, MissingValueError | None]:
    """Return the bench of a section, with 1 for missing gains, and the error if gains are missing.

    Raises:
        FrictionzooError: The section is invalid, or a value other than a gain is missing.
    """
    try:
        return build(section, Bench), None
    except MissingValueError as missing:
        return build(_put_gains(section, dict.fromkeys(list_missing(section), 1.0)), Bench), missing


def _put_gains(section: Mapping[str, Any], gains: Mapping[str, Any]) -> dict[str, Any]:
    """Return a bench's section with these initial values of its actuator's parameters."""
    changed = copy.deepcopy(dict(section))
    for name, value in gains.items():
        changed["actuator"]["params"][name]["init"] = value
    return changed
