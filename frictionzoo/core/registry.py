"""Plug-ins by name: classes in this package's files, and those of other packages by entry points."""

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


class Plugin(NamedTuple):
    """Plug-in as read from its file, without importing it; `target` is its class, `summary` begins its docstring."""

    name: str
    module: str
    target: str
    summary: str
    path: Path | None = None

    @property
    def package(self) -> str:
        """Package that provides it."""
        return self.module.partition(".")[0]

    @property
    def cls(self) -> str:
        """Name of the class."""
        return self.target.rpartition(".")[2]


@dataclass(frozen=True)
class Kind:
    """One kind of plug-in.

    Attributes:
        plural: Name on the command line and in the entry-point group.
        noun: Name of one plug-in, for messages.
        home: Package with frictionzoo's plug-ins of this kind.
        decorator: Name of the function that registers one.
        choice: Option that chooses one; `{name}` and `{target}` stand for the plug-in's.
        offered: Whether `home` exports the classes; else only their modules have them.
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

    def own(self, stem: str = "*") -> dict[str, Plugin]:
        """Return frictionzoo's plug-ins by name, read from the files of `home` with this stem, imported or not.

        Raises:
            ConfigError: Two files register one name.
        """
        plugins: dict[str, Plugin] = {}
        home = sys.modules.get(self.home)
        source = Path(__file__).parents[1].joinpath(*self.home.split(".")[1:])
        for folder in home.__path__ if home else [str(source)]:
            for path in sorted(Path(folder).glob(f"{stem}.py")):
                for name, cls, summary in _read_file(path, self.decorator):
                    module = f"{self.home}.{path.stem}"
                    new = Plugin(name, module, f"{self.home if self.offered else module}.{cls}", summary, path)
                    if plugins.setdefault(name, new) != new:
                        raise ConfigError(f"{name}: registered by {plugins[name].target} and {new.target}; rename one")
        return plugins

    def brought(self) -> list[EntryPoint]:
        """Return the entry points of other packages."""
        return _entry_points(tuple(sys.path))[self.group]

    def list_all(self) -> list[Plugin]:
        """Return all plug-ins, sorted by name, without importing them."""
        return sorted([*self.own().values(), *map(self.describe, self.brought())])

    def describe(self, point: EntryPoint) -> Plugin:
        """Return another package's plug-in as read from its file."""
        try:
            origin = getattr(find_spec(point.module), "origin", None)
        except Exception as error:  # another package's import error must not end the listing
            return Plugin(point.name, point.module, point.module, f"does not load: {error}")
        path = Path(origin) if origin else None
        for name, cls, summary in _read_file(path, self.decorator) if path else ():
            if name == point.name:
                return Plugin(name, point.module, f"{point.module}.{cls}", summary, path)
        return Plugin(point.name, point.module, point.module, "")


KINDS = {
    kind.plural: kind
    for kind in (
        Kind("models", "friction model", "frictionzoo.models", "register_model", "model={name}", offered=True),
        Kind(
            *("actuators", "actuator model", "frictionzoo.bench.actuators", "register_actuator"),
            *("bench.actuator._target_={target}", True),
        ),
        Kind("sources", "data source", "frictionzoo.data", "register_source", "data={name}"),
        Kind("formats", "log format", "frictionzoo.data.formats", "register_format", "data.format={name}"),
        Kind("methods", "fit method", "frictionzoo.fit", "register_method", "fit={name}", offered=True),
        Kind("targets", "export target", "frictionzoo.export", "register_target", "target={name}"),
    )
}
_ALSO_AT = {"actuators": ("frictionzoo.bench",)}  # further packages that export the classes
_REGISTRIES: list["Registry"] = []


@dataclass
class Registry(Generic[B]):
    """Plug-ins of one kind, which derive from `base` and define `method`.

    Attributes:
        error: Error for an invalid plug-in.
        unknown: Error for a name that is not registered.
        entries: Registered classes that have been imported, by name.
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
        """Return a class decorator that registers a plug-in under a name.

        Raises:
            FrictionzooError: The name is taken or not lower case with underscores, or the class is incomplete or has a
                name.
        """
        return lambda cls: self._add(name, cls)

    def get(self, name: str) -> type[B]:
        """Return the class with this name, from this package or another one.

        Raises:
            FrictionzooError: The name is unknown, two packages provide it, or its package is broken.
        """
        builtin, outside = self.kind.own(), self._outside()
        if name in builtin:
            self._load(builtin[name])
        elif name not in self.entries and name not in outside:
            raise self.unknown(f"{name}: no such {self.kind.noun}; {closest(name, self.names())}")
        if name in outside:
            self._load_outside(outside[name])
        return self.entries[name]

    def names(self) -> list[str]:
        """Return all names, sorted."""
        return sorted({*self.kind.own(), *self._outside(), *self.entries})

    def find_class(self, name: str) -> type[B]:
        """Return one of this package's classes by its class name, as `__getattr__` of the package that exports it.

        Raises:
            AttributeError: There is no such class.
        """
        for plugin in self.kind.own().values():
            if plugin.target == f"{self.kind.home}.{name}":
                return self._load(plugin)
        raise AttributeError(f"module {self.kind.home!r} has no attribute {name!r}")

    def _add(self, name: str, cls: T) -> T:
        new: Any = cls
        if not (isinstance(new, type) and issubclass(new, self.base)) or inspect.isabstract(new):
            expected = f"a {self.base.__name__} class with a `{self.method}` method"
            raise self.error(f"{name}: {cls!r} is registered, expected {expected}")
        if not name.isidentifier() or name != name.lower():
            raise self.error(f"{name}: expected a name in lower case with underscores; rename the {self.noun}")
        builtin = self.kind.own().get(name)
        if builtin and builtin.module != new.__module__:
            self._load(builtin)
        # A class defined again, as in a notebook cell, replaces the old one.
        if dotted_name(self.entries.get(name, new)) != dotted_name(new):
            raise self.error(f"{name}: already registered by {self.entries[name].__qualname__}; choose another name")
        # A subclass inherits its parent's `name`; only the class's own counts.
        if vars(new).get("name", name) != name:
            raise self.error(f"{name}: {new.__qualname__} is already registered as {new.name}; one name each")
        new.name = name
        self.entries[name] = cls
        return cls

    def _load(self, plugin: Plugin) -> type[B]:
        cls = getattr(importlib.import_module(plugin.module), plugin.cls)
        return self.entries.setdefault(plugin.name, cls)

    def _outside(self) -> dict[str, EntryPoint]:
        points: dict[str, EntryPoint] = {}
        for point in self.kind.brought():
            if points.setdefault(point.name, point).value != point.value:
                conflict = f"entry points {points[point.name].value} and {point.value} both bring it"
                raise self.error(f"{point.name}: {conflict}; uninstall one of the packages")
        return points

    def _load_outside(self, point: EntryPoint) -> None:
        """Import an entry point's target and check that it registered the class itself, not one of the same name."""
        try:
            point.load()
        except (ImportError, AttributeError) as error:
            raise self.error(f"{point.name}: its entry point {point.value} does not load ({error}); fix it") from error
        if point.name not in self.entries:
            message = f"its entry point {point.value} registers no {self.noun} of that name"
            raise self.error(f'{point.name}: {message}; decorate it @{self.kind.decorator}("{point.name}")')
        owner = self.entries[point.name].__module__
        if owner.partition(".")[0] != point.module.partition(".")[0]:
            conflict = f"brought by both {owner} and {point.value}"
            raise self.error(f"{point.name}: {conflict}; uninstall one or rename its {self.noun}")


def find_plugin(target: str) -> type | None:
    """Return the plug-in class with this dotted name, or None; import its file, or its package's entry points."""
    if registered := find_registered(target):
        return registered
    module, _, name = target.rpartition(".")
    for kind in KINDS.values():
        for plugin in kind.own().values():
            home, _, cls = plugin.target.rpartition(".")
            if name == cls and module in (home, plugin.module, *_ALSO_AT.get(kind.plural, ())):
                return import_class(plugin.target)
    root = target.partition(".")[0]
    candidates = [(k, p) for k in KINDS.values() for p in k.brought() if p.module.partition(".")[0] == root]
    matching = [point for kind, point in candidates if kind.describe(point).target == target]
    for point in matching or [point for _, point in candidates]:
        with contextlib.suppress(ImportError, AttributeError):  # reported when the plug-in is asked for by name
            point.load()
    # The package may export the class from another module than its home.
    exported = getattr(sys.modules.get(module), name, None) if candidates else None
    return find_registered(target) or next((cls for cls in _list_registered() if cls is exported), None)


def import_class(target: str) -> type:
    """Import a class by its dotted name in this package's code; never pass a name from a file or a user."""
    module, _, name = target.rpartition(".")
    return getattr(importlib.import_module(module), name)


def find_registered(target: str) -> Any:
    """Return the class with this dotted name registered in this process, for instance in a notebook; else None."""
    return next((cls for cls in _list_registered() if dotted_name(cls) == target), None)


def _list_registered() -> Iterator[Any]:
    return (cls for registry in _REGISTRIES for cls in registry.entries.values())


def plug_in_packages() -> set[str]:
    """Return the packages with plug-ins of any kind, including frictionzoo."""
    return {"frictionzoo", *(point.module.partition(".")[0] for kind in KINDS.values() for point in kind.brought())}


def dotted_name(cls: type) -> str:
    """Return the dotted name of a class, as in `_target_`."""
    return f"{cls.__module__}.{cls.__qualname__}"


@functools.cache
def _entry_points(path: tuple[str, ...]) -> dict[str, list[EntryPoint]]:
    """Return the entry points of the packages on this path, by group; cached, because the search is slow."""
    points = entry_points()
    # The backport importlib_metadata, once imported, takes over discovery with its own class.
    return {
        kind.group: [EntryPoint(point.name, point.value, kind.group) for point in points.select(group=kind.group)]
        for kind in KINDS.values()
    }


@functools.cache
def _read_file(path: Path, decorator: str) -> tuple[tuple[str, str, str], ...]:
    """Return name, class and first docstring line of each plug-in that a file registers with this decorator."""
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
