"""Plug-ins by name: classes that this package's files hold, and those that other packages bring by entry points."""

import ast
import contextlib
import functools
import importlib
import inspect
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

from frictionzoo.core.errors import ConfigError, FrictionzooError, closest

T = TypeVar("T")
B = TypeVar("B")


class Found(NamedTuple):
    """A plug-in as its file tells it, which need not be imported for that.

    Attributes:
        name: Under which it is registered.
        module: Of the class.
        target: Dotted name of the class, as `_target_` has it.
        summary: First line of its docstring.
    """

    name: str
    module: str
    target: str
    summary: str

    @property
    def package(self) -> str:
        """Who brings it."""
        return self.module.partition(".")[0]


@dataclass(frozen=True)
class Kind:
    """One kind of plug-ins.

    Attributes:
        plural: Its name on the command line and in the entry-point group.
        noun: What one of it is, for messages.
        home: The package whose files hold those of frictionzoo.
        decorator: Name of the function that registers one.
        choice: The option that chooses one, where `{name}` and `{target}` stand for its own.
        offered: Whether `home` has the classes by their own names; else only their files have.
    """

    plural: str
    noun: str
    home: str
    decorator: str
    choice: str
    offered: bool = False

    @property
    def group(self) -> str:
        """Entry-point group of other packages."""
        return f"frictionzoo.{self.plural}"

    def own(self) -> dict[str, Found]:
        """Those of frictionzoo by name: what the files of `home` register, imported or not.

        Raises:
            ConfigError: Two files register one name.
        """
        found: dict[str, Found] = {}
        home = sys.modules.get(self.home)
        inside = Path(__file__).parents[1].joinpath(*self.home.split(".")[1:])
        for folder in home.__path__ if home else [str(inside)]:
            for path in sorted(Path(folder).glob("*.py")):
                for name, cls, summary in _read_file(path, self.decorator):
                    module = f"{self.home}.{path.stem}"
                    one = Found(name, module, f"{self.home if self.offered else module}.{cls}", summary)
                    if found.setdefault(name, one) != one:
                        raise ConfigError(f"{name}: registered by {found[name].target} and {one.target}; rename one")
        return found

    def brought(self) -> list[EntryPoint]:
        """What other packages bring."""
        return _entry_points(tuple(sys.path))[self.group]

    def list_all(self) -> list[Found]:
        """All of them, sorted by name; none is imported."""
        return sorted([*self.own().values(), *map(self.describe, self.brought())])

    def describe(self, point: EntryPoint) -> Found:
        """One that another package brings, as its file tells it."""
        try:
            origin = getattr(find_spec(point.module), "origin", None)
        except Exception as error:  # what another package does when its root is imported is not ours to end over
            return Found(point.name, point.module, point.module, f"does not load: {error}")
        for name, cls, summary in _read_file(Path(origin), self.decorator) if origin else ():
            if name == point.name:
                return Found(name, point.module, f"{point.module}.{cls}", summary)
        return Found(point.name, point.module, point.module, "")


KINDS = {
    kind.plural: kind
    for kind in (
        Kind("models", "friction model", "frictionzoo.models", "register_model", "model={name}", offered=True),
        Kind(
            *("actuators", "actuator law", "frictionzoo.bench.actuators", "register_actuator"),
            *("bench.actuator._target_={target}", True),
        ),
        Kind("sources", "data source", "frictionzoo.logs", "register_source", "data={name}"),
        Kind("formats", "log format", "frictionzoo.logs.formats", "register_format", "data.format={name}"),
        Kind("methods", "fit method", "frictionzoo.fit", "register_method", "fit={name}", offered=True),
        Kind("targets", "export target", "frictionzoo.export", "register_target", "target={name}"),
    )
}
_ALSO_AT = {"actuators": ("frictionzoo.bench",)}  # packages that offer the classes of a kind besides its home
_REGISTRIES: list["Registry"] = []


@dataclass
class Registry(Generic[B]):
    """The plug-ins of one kind.

    Attributes:
        kind: Which.
        base: Class that all of them derive from.
        method: The method that they have to write.
        error: Raised for a plug-in that is none.
        unknown: Raised for a name that nobody registered.
        entries: The registered classes that have been imported, by name.
    """

    kind: Kind
    base: type[B]
    method: str
    error: type[FrictionzooError] = ConfigError
    unknown: type[FrictionzooError] = ConfigError
    entries: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _REGISTRIES.append(self)

    @property
    def noun(self) -> str:
        """The kind in one word."""
        return self.kind.noun.split()[-1]

    def register(self, name: str) -> Callable[[T], T]:
        """Class decorator that makes a plug-in available under a name.

        Raises:
            FrictionzooError: The name is taken or not lower case with underscores, or the class is not complete or has
                a name already.
        """
        return lambda cls: self._add(name, cls)

    def get(self, name: str) -> type[B]:
        """The class of that name, registered here or brought by another package.

        Raises:
            FrictionzooError: No such name, and the message names the closest; or two packages bring it, or the one that
                does is broken.
        """
        own, outside = self.kind.own(), self._outside()
        if name in own:
            self._load(own[name])
        elif name not in self.entries and name not in outside:
            raise self.unknown(f"{name}: no such {self.kind.noun}; {closest(name, self.names())}")
        if name in outside:
            self._load_outside(outside[name])
        return self.entries[name]

    def names(self) -> list[str]:
        """All names, sorted."""
        return sorted({*self.kind.own(), *self._outside(), *self.entries})

    def find_class(self, name: str) -> type[B]:
        """One of this package's classes by its own name: the `__getattr__` of the package that holds them.

        Raises:
            AttributeError: There is none.
        """
        for found in self.kind.own().values():
            if found.target == f"{self.kind.home}.{name}":
                return self._load(found)
        raise AttributeError(f"module {self.kind.home!r} has no attribute {name!r}")

    def _add(self, name: str, cls: T) -> T:
        known: Any = cls
        if not (isinstance(known, type) and issubclass(known, self.base)) or inspect.isabstract(known):
            expected = f"a {self.base.__name__} class with a `{self.method}` method"
            raise self.error(f"{name}: {cls!r} is registered, expected {expected}")
        if not name.isidentifier() or name != name.lower():
            raise self.error(f"{name}: expected a name in lower case with underscores; rename the {self.noun}")
        own = self.kind.own().get(name)
        if own and own.module != known.__module__:
            self._load(own)
        # A class that is defined again, as when a notebook's cell is run again, replaces its older self.
        if dotted_name(self.entries.get(name, known)) != dotted_name(known):
            raise self.error(f"{name}: already registered by {self.entries[name].__qualname__}; choose another name")
        # A subclass inherits its parent's name, which is not its own.
        if vars(known).get("name", name) != name:
            raise self.error(f"{name}: {known.__qualname__} is already registered as {known.name}; one name each")
        known.name = name
        self.entries[name] = cls
        return cls

    def _load(self, found: Found) -> type[B]:
        """Import one of this package's own."""
        cls = getattr(importlib.import_module(found.module), found.target.rpartition(".")[2])
        return self.entries.setdefault(found.name, cls)

    def _outside(self) -> dict[str, EntryPoint]:
        """What other packages bring, by name."""
        points: dict[str, EntryPoint] = {}
        for point in self.kind.brought():
            if points.setdefault(point.name, point).value != point.value:
                both = f"entry points {points[point.name].value} and {point.value} both bring it"
                raise self.error(f"{point.name}: {both}; uninstall one of the packages")
        return points

    def _load_outside(self, point: EntryPoint) -> None:
        """Import what an entry point names and see that it registered the class itself, not one of the same name."""
        try:
            point.load()
        except (ImportError, AttributeError) as error:
            raise self.error(f"{point.name}: its entry point {point.value} does not load ({error}); fix it") from error
        if point.name not in self.entries:
            message = f"its entry point {point.value} registers no {self.noun} of that name"
            raise self.error(f'{point.name}: {message}; decorate it @{self.kind.decorator}("{point.name}")')
        owner = self.entries[point.name].__module__
        if owner.partition(".")[0] != point.module.partition(".")[0]:
            both = f"brought by both {owner} and {point.value}"
            raise self.error(f"{point.name}: {both}; uninstall one or rename its {self.noun}")


def find_plugin(target: str) -> type | None:
    """Return the registered class of this dotted name, as `_target_` has it; None where there is none.

    Of this package, the file that registers it is imported; of another one, the modules that its entry points name.
    """
    if registered := find_registered(target):
        return registered
    module, _, name = target.rpartition(".")
    for kind in KINDS.values():
        for found in kind.own().values():
            own, _, cls = found.target.rpartition(".")
            if name == cls and module in (own, found.module, *_ALSO_AT.get(kind.plural, ())):
                return import_class(found.target)
    root = target.partition(".")[0]
    brought = [(k, p) for k in KINDS.values() for p in k.brought() if p.module.partition(".")[0] == root]
    named = [point for kind, point in brought if kind.describe(point).target == target]
    for point in named or [point for _, point in brought]:
        with contextlib.suppress(ImportError, AttributeError):  # told where the plug-in is asked for by its name
            point.load()
    # Its package may offer the class in another module than the one that defines it.
    offered = getattr(sys.modules.get(module), name, None) if brought else None
    return find_registered(target) or next((cls for cls in _list_registered() if cls is offered), None)


def import_class(target: str) -> type:
    """Return the class of a dotted name that this package knows; never one that a file or a user names."""
    module, _, name = target.rpartition(".")
    return getattr(importlib.import_module(module), name)


def find_registered(target: str) -> Any:
    """The class of this dotted name among those that were registered in this process, in a notebook say; else None."""
    return next((cls for cls in _list_registered() if dotted_name(cls) == target), None)


def _list_registered() -> Iterator[Any]:
    return (cls for registry in _REGISTRIES for cls in registry.entries.values())


def plug_in_packages() -> set[str]:
    """The packages that bring plug-ins of any kind, frictionzoo among them."""
    return {"frictionzoo", *(point.module.partition(".")[0] for kind in KINDS.values() for point in kind.brought())}


def dotted_name(cls: type) -> str:
    """Dotted name of a class, as `_target_` has it."""
    return f"{cls.__module__}.{cls.__qualname__}"


@functools.cache
def _entry_points(path: tuple[str, ...]) -> dict[str, list[EntryPoint]]:
    """What the packages on this path bring, by group; looking through all of them takes as long as reading a file."""
    found = entry_points()
    # The backport importlib_metadata takes discovery over where it is imported, with a class of its own.
    return {
        kind.group: [EntryPoint(point.name, point.value, kind.group) for point in found.select(group=kind.group)]
        for kind in KINDS.values()
    }


@functools.cache
def _read_file(path: Path, decorator: str) -> tuple[tuple[str, str, str], ...]:
    """Name, class and first line of the docstring of each plug-in that a file registers with this decorator."""
    text = path.read_text(encoding="utf-8")
    if f"{decorator}(" not in text:
        return ()
    return tuple(
        (call.args[0].value, node.name, (ast.get_docstring(node) or "").partition("\n")[0])
        for node in ast.parse(text).body
        if isinstance(node, ast.ClassDef)
        for call in node.decorator_list
        if isinstance(call, ast.Call) and decorator in (getattr(call.func, "id", ""), getattr(call.func, "attr", ""))
        if call.args and isinstance(call.args[0], ast.Constant) and isinstance(call.args[0].value, str)
    )
