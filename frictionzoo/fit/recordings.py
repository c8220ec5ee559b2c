"""Recordings from which the segments of a fit were cut."""

from typing import NamedTuple

from frictionzoo.bench import Bench
from frictionzoo.core.log import Log
from frictionzoo.models import FrictionModel


class Recordings(NamedTuple):
    """Bench, model and logs of a fit, ready for each other, for methods that need more than segments."""

    bench: Bench
    model: FrictionModel
    logs: tuple[Log, ...]
