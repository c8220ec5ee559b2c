"""Objects that remember their constructor arguments, so that a run can record them and make them again."""

import importlib
import inspect
import reprlib
from collections.abc import Mapping
from pathlib import PurePath
from typing import Any, ClassVar, TypeVar

import numpy as np

from frictionzoo.core.errors import ConfigError, closest
from frictionzoo.core.registry import dotted_name

T = TypeVar("T")
D = TypeVar("D", bound="Described")


class _Signature:
    """Signature of a class: its constructor's, where Python would show that of `Described.__new__`."""

    def __get__(self, instance: object, owner: type) -> inspect.Signature:
        if instance is not None:  # an object has the signature of its `__call__`
            raise AttributeError("__signature__")
        constructor = inspect.signature(owner.__init__)
        return constructor.replace(parameters=[*constructor.parameters.values()][1:])


class Described:
    """Base class whose objects remember their constructor arguments."""

    __signature__: ClassVar[_Signature] = _Signature()
    records_none: ClassVar[bool] = True
    """Whether a record keeps keyword arguments that are None."""

    def __new__(cls: type[T], *args: Any, **kwargs: Any) -> T:
        """Keep the arguments; TypeError for one that the class does not take, with the closest one."""
        if (args or kwargs) and cls.__init__ is object.__init__:
            raise TypeError(f"{cls.__name__} takes no arguments")
        parameters = inspect.signature(cls).parameters
        if all(parameter.kind is not inspect.Parameter.VAR_KEYWORD for parameter in parameters.values()):
            for name in kwargs.keys() - parameters.keys():
                raise TypeError(f"{cls.__name__}: unknown argument {name}; {closest(name, parameters)}")
        instance = object.__new__(cls)
        object.__setattr__(instance, "_given", (args, kwargs))  # a dataclass may be frozen
        return instance

    def __repr__(self) -> str:
        args, kwargs = getattr(self, "_given")  # noqa: B009 - set in __new__
        named = (f"{name}={reprlib.repr(value)}" for name, value in kwargs.items())
        return f"{type(self).__name__}({', '.join([*map(reprlib.repr, args), *named])})"


def describe(part: Any) -> Any:
    """Return the configuration section from which `build` makes an object again, or a value in plain types.

    Raises:
        ConfigError: The value cannot be written into a record.
    """
    if isinstance(part, Described):
        args, kwargs = getattr(part, "_given")  # noqa: B009 - set in __new__
        return {"_target_": _public_name(type(part)), **_arguments(type(part), args, kwargs)}
    if isinstance(part, Mapping):
        return {str(name): describe(value) for name, value in part.items()}
    if isinstance(part, np.ndarray | np.generic):
        return part.tolist()
    if isinstance(part, list | tuple):
        return [describe(value) for value in part]
    if isinstance(part, PurePath):
        return str(part)
    if part is None or isinstance(part, bool | int | float | str):
        return part
    kind = type(part).__name__
    raise ConfigError(f"{kind}: expected numbers, text, lists or parts of frictionzoo, which a record can hold")


def remake(part: D, **changed: Any) -> D:
    """Return a copy of the object with some constructor arguments changed."""
    args, kwargs = getattr(part, "_given")  # noqa: B009 - set in __new__
    names = [name for name in inspect.signature(type(part).__init__).parameters][1:]
    return type(part)(**{**dict(zip(names, args, strict=False)), **kwargs, **changed})


def _arguments(cls: type[Described], args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> dict[str, Any]:
    signature = inspect.signature(cls.__init__)
    bound = signature.bind(None, *args, **kwargs)
    bound.apply_defaults()
    named: dict[str, Any] = {}
    for name, parameter in list(signature.parameters.items())[1:]:
        value, kind = bound.arguments[name], parameter.kind
        is_omitted = kind is inspect.Parameter.KEYWORD_ONLY and value is None and not cls.records_none
        if kind is inspect.Parameter.VAR_KEYWORD:
            named |= bound.arguments[name]
        elif kind is not inspect.Parameter.VAR_POSITIONAL and not is_omitted:  # a class without a constructor has one
            named[name] = value
    return {name: describe(value) for name, value in named.items()}


def _public_name(cls: type) -> str:
    """Return a class's dotted name in the package that exports it, as in conf/: it outlasts the module's."""
    parts = cls.__module__.split(".")
    for count in range(2, len(parts)):
        package = ".".join(parts[:count])
        if getattr(importlib.import_module(package), cls.__qualname__, None) is cls:
            return f"{package}.{cls.__qualname__}"
    return dotted_name(cls)
