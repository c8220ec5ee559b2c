"""What can be read of an identification before the slow imports: its test stand and its recordings."""

import time
from collections.abc import Mapping
from typing import Any, NamedTuple

from frictionzoo.bench.base import Bench
from frictionzoo.core.build import build
from frictionzoo.core.log import Dataset
from frictionzoo.core.params import Param
from frictionzoo.logs.source import Source


class Given(NamedTuple):
    """The input of an identification besides its options; neither torch nor JAX is imported for it.

    Attributes:
        bench: The test stand.
        dataset: Recordings, train and test.
        seconds: What reading them took [s].
    """

    bench: Bench
    dataset: Dataset
    seconds: float

    @classmethod
    def read(cls, settings: Mapping[str, Any]) -> "Given":
        """The bench and the recordings that the sections `bench` and `data` describe.

        Raises:
            FrictionzooError: One of them is not there, or not what was expected, or a parameter of the law is none.
        """
        began = time.perf_counter()
        # Which law has it, and of what dimension it is, is asked when the law is built.
        for name, section in (settings.get("model", {}).get("params") or {}).items():
            Param.from_config(name, "1", section)
        bench, dataset = build(settings["bench"], Bench), build(settings["data"], Source).load()
        return cls(bench, dataset, time.perf_counter() - began)
