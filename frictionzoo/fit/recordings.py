"""What the segments of a fit were cut from."""

from typing import NamedTuple

from frictionzoo.bench import Bench
from frictionzoo.core.log import Log
from frictionzoo.models import FrictionModel


class Recordings(NamedTuple):
    """What the segments were cut from, for a method that looks at whole recordings.

    Attributes:
        bench: The test stand.
        model: The friction law, ready for the data.
        logs: As the bench accepts them.
    """

    bench: Bench
    model: FrictionModel
    logs: tuple[Log, ...]
