"""The interface of a data source: recordings, divided into those that train and those that test."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

from frictionzoo.core.described import Described
from frictionzoo.core.log import Dataset
from frictionzoo.core.registry import KINDS, Registry


class Source(Described, ABC):
    """What a file of `conf/data` builds. Its attribute `name` is the data set's; of the class, the registered one."""

    name: str

    def find(self) -> None:
        """Look whether the recordings are there, before anything is read or a slow import is waited for.

        Raises:
            LogError: A path leads to no file.
        """

    def for_joints(self, joints: Sequence[str]) -> "Source":
        """Return the same source for a bench with these joints, whose columns it picks by name where it can."""
        return self

    @abstractmethod
    def load(self) -> Dataset:
        """The recordings.

        Raises:
            LogError: They are not there, or not what was expected.
        """


REGISTRY = Registry(KINDS["sources"], Source, "load")

register_source = REGISTRY.register
"""Class decorator that makes a data source known by its name, as `Registry.register`."""
