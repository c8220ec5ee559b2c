"""What can be read of an identification before the slow imports: its test stand and its recordings."""

import time
from collections.abc import Mapping
from typing import Any, NamedTuple

from frictionzoo.bench.base import Bench
from frictionzoo.bench.gains import find_gains, stand_in
from frictionzoo.bench.sections import put_options
from frictionzoo.core.build import build
from frictionzoo.core.errors import MissingValueError
from frictionzoo.core.log import Dataset
from frictionzoo.core.params import Param
from frictionzoo.logs.source import Source


class Given(NamedTuple):
    """The input of an identification besides its options; neither torch nor JAX is imported for it.

    Attributes:
        bench: The test stand.
        dataset: Recordings, train and test.
        seconds: What reading them took [s].
        settings: All options of the run, with gains that the recordings state.
    """

    bench: Bench
    dataset: Dataset
    seconds: float
    settings: Mapping[str, Any]

    @classmethod
    def read(cls, settings: Mapping[str, Any]) -> "Given":
        """Return the bench and the recordings that the sections `bench` and `data` describe.

        Gains of a controller that have no value are taken from the recordings, where these tell them.

        Raises:
            FrictionzooError: One of them is not there, or not what was expected, or a parameter of the law is none.
        """
        began = time.perf_counter()
        # Which law has it, and of what dimension it is, is asked when the law is built.
        for name, section in (settings.get("model", {}).get("params") or {}).items():
            Param.from_config(name, "1", section)
        source, section = build(settings["data"], Source), settings["bench"]
        bench, missing = build_open(section)
        dataset = source.for_joints(bench.joints).load()
        if missing:
            section = put_options(section, find_gains(section, dataset, missing))
            bench = build(section, Bench)
        return cls(bench, dataset, time.perf_counter() - began, {**settings, "bench": section})


def build_open(section: Mapping[str, Any]) -> tuple[Bench, MissingValueError | None]:
    """Return the bench of a section, and what it lacks: gains that have no value are 1 then, so that joints are known.

    Raises:
        FrictionzooError: The section is not a bench's, or another value is missing.
    """
    try:
        return build(section, Bench), None
    except MissingValueError as missing:
        return build(put_options(section, stand_in(section)), Bench), missing
