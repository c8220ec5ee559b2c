"""Plug-ins by name: classes of this package, and those that other packages bring by entry points."""

import functools
import inspect
import sys
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar

from frictionzoo.core.errors import FrictionzooError, closest

T = TypeVar("T")


@dataclass
class Registry:
    """Plug-ins of one kind.

    Attributes:
        kind: What a class of it is, for messages.
        base: Class that all of them derive from.
        method: The method that they have to write.
        decorator: Name of the function that registers one.
        group: Entry-point group of other packages.
        error: Raised for a plug-in that is none.
        unknown: Raised for a name that nobody registered.
        entries: The registered classes by name.
    """

    kind: str
    base: type
    method: str
    decorator: str
    group: str
    error: type[FrictionzooError]
    unknown: type[FrictionzooError]
    entries: dict[str, Any] = field(default_factory=dict)

    @property
    def noun(self) -> str:
        """The kind in one word."""
        return self.kind.split()[-1]

    def add(self, name: str, cls: T) -> T:
        """Register a class under its name, and its name into the class.

        Raises:
            FrictionzooError: The name is taken or not lower case with underscores, or the class is not complete or has
                a name already.
        """
        known: Any = cls
        if not (isinstance(known, type) and issubclass(known, self.base)) or inspect.isabstract(known):
            raise self.error(
                f"{name}: {cls!r} is registered, expected a {self.base.__name__} class with a `{self.method}` method"
            )
        if not name.isidentifier() or name != name.lower():
            raise self.error(f"{name}: expected a name in lower case with underscores; rename the {self.noun}")
        # A class that is defined again, as when a notebook's cell is run again, replaces its older self.
        if dotted_name(self.entries.get(name, known)) != dotted_name(known):
            raise self.error(f"{name}: already registered by {self.entries[name].__qualname__}; choose another name")
        # A subclass inherits its parent's name, which is not its own.
        if vars(known).get("name", name) != name:
            raise self.error(f"{name}: {known.__qualname__} is already registered as {known.name}; one name each")
        known.name = name
        self.entries[name] = cls
        return cls

    def get(self, name: str) -> Any:
        """The class of that name, registered here or brought by another package.

        Raises:
            FrictionzooError: No such name, two packages bring it, or the one that does is broken.
        """
        outside = self.outside()
        if name not in self.entries and name not in outside:
            raise self.unknown(f"{name}: no such {self.kind}; {closest(name, {*outside, *self.entries})}")
        if name in outside:
            self._load(outside[name])
        return self.entries[name]

    def names(self) -> list[str]:
        """All names, sorted."""
        return sorted({*self.outside(), *self.entries})

    def outside(self) -> dict[str, EntryPoint]:
        """What other packages bring, by name."""
        points: dict[str, EntryPoint] = {}
        for point in _entry_points(self.group, tuple(sys.path)):
            if points.setdefault(point.name, point).value != point.value:
                raise self.error(
                    f"{point.name}: entry points {points[point.name].value} and {point.value} both bring it; "
                    "uninstall one of the packages"
                )
        return points

    def _load(self, point: EntryPoint) -> None:
        """Import what an entry point names and see that it registered the class itself, not one of the same name."""
        try:
            point.load()
        except (ImportError, AttributeError) as error:
            raise self.error(f"{point.name}: its entry point {point.value} does not load ({error}); fix it") from error
        if point.name not in self.entries:
            raise self.error(
                f"{point.name}: its entry point {point.value} registers no {self.noun} of that name; "
                f'decorate it @{self.decorator}("{point.name}")'
            )
        owner = self.entries[point.name].__module__
        if owner.partition(".")[0] != point.module.partition(".")[0]:
            raise self.error(
                f"{point.name}: brought by both {owner} and {point.value}; uninstall one or rename its {self.noun}"
            )


@functools.cache
def _entry_points(group: str, path: tuple[str, ...]) -> list[EntryPoint]:
    """What the packages on this path bring; looking through all of them takes as long as reading a small file."""
    # The backport importlib_metadata takes discovery over where it is imported, with a class of its own.
    return [EntryPoint(found.name, found.value, found.group) for found in entry_points(group=group)]


def dotted_name(cls: type) -> str:
    """Dotted name of a class, as `_target_` has it."""
    return f"{cls.__module__}.{cls.__qualname__}"
