"""Recordings from which the segments of a fit were cut."""

from typing import NamedTuple

from frictionzoo.bench import Bench
from frictionzoo.core.log import Log
from frictionzoo.models import FrictionModel


class Recordings(NamedTuple):
    """Bench, model and whole recordings of a fit, for methods that need more than segments.

    Attributes:
        bench: The test stand.
        model: The friction model, ready for the data.
        logs: The recordings, in the form that the bench accepts.
    """

    bench: Bench
    model: FrictionModel
    logs: tuple[Log, ...]
