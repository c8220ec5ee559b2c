"""Interface of a data source, which loads training and test recordings."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Sequence

from frictionzoo.core.described import Described
from frictionzoo.core.log import Dataset
from frictionzoo.core.registry import KINDS, Registry


class Source(Described, ABC):
    """Data source that a file of `conf/data` configures; `name` is the data set's, on the class the registered name."""

    name: str

    def find(self) -> None:
        """Check that the recordings exist, before any reading or slow import.

        Raises:
            LogError: A path matches no file.
        """

    def for_joints(self, joints: Sequence[str], passive: Collection[str] = ()) -> "Source":
        """Return the same source for these joints; their columns are matched by name if possible.

        Recordings may lack commands of the `passive` joints.
        """
        return self

    @abstractmethod
    def load(self) -> Dataset:
        """Load the recordings; LogError if they are missing or have unexpected contents."""


REGISTRY = Registry(KINDS["sources"], Source, "load")

register_source = REGISTRY.register
"""Class decorator that registers a data source under a name, see `Registry.register`."""
