"""Hydra's source of friction models: the section of each model, from its class.

frictionzoo's classes are read from their files and not imported, because that would load torch.
"""

import ast
import functools
import importlib
import inspect
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from hydra.core.object_type import ObjectType
from hydra.plugins.config_source import ConfigResult, ConfigSource
from omegaconf import OmegaConf

from frictionzoo.core.params import Parameter
from frictionzoo.core.registry import KINDS, Plugin, dotted_name

_MODELS = KINDS["models"]
_Names = list[str]  # ConfigSource has a method `list`


class ModelSource(ConfigSource):
    """Source of the group `model`: all models whose classes declare their parameters; see Hydra's `ConfigSource`."""

    @staticmethod
    def scheme() -> str:
        """Return the beginning of its place in Hydra's search path."""
        return "frictionzoo"

    def load_config(self, config_path: str) -> ConfigResult:
        """Return the section of a model; one of another package is imported."""
        name = _name_of(config_path)
        if (own := _own(name)) and own.path:
            section = _write_section(own.target, _read_options(own.path, own.cls), _read_parameters(own.path, own.cls))
        else:
            section = section_of(importlib.import_module(_MODELS.home).get_model(name))
        return ConfigResult("frictionzoo", self.full_path(), OmegaConf.create(section), {"package": None})

    def available(self) -> bool:
        """Return True."""
        return True

    def is_group(self, config_path: str) -> bool:
        """Return whether this is the group of models."""
        return config_path.rstrip("/") == "model"

    def is_config(self, config_path: str) -> bool:
        """Return whether this is a model, perhaps one that only this process has registered."""
        if not config_path.startswith("model/"):
            return False
        name, models = _name_of(config_path), sys.modules.get(_MODELS.home)
        registered = models and models.REGISTRY.entries.get(name)
        return bool(_own(name) or name in _list_brought() or is_declared(registered))

    def list(self, config_path: str, results_filter: ObjectType | None) -> _Names:
        """List the models of all installed packages."""
        return sorted({*_MODELS.own(), *_list_brought()}) if results_filter is not ObjectType.GROUP else []


def is_declared(cls: Any) -> bool:
    """Return whether a model class declares all its parameters, and not only their dimensions."""
    return cls is not None and cls.dimensions.keys() == cls.physical_parameters.keys()


def section_of(cls: Any) -> dict[str, Any]:
    """Return the section of a model class: `_target_`, constructor arguments and `params`."""
    arguments = list(inspect.signature(cls.__init__).parameters.values())[2:]  # after self and nv
    options = {each.name: None if each.default is each.empty else each.default for each in arguments}
    return _write_section(dotted_name(cls), options, cls.physical_parameters)


def _write_section(target: str, options: Mapping[str, Any], parameters: Mapping[str, Parameter]) -> dict[str, Any]:
    plain = {name: "${seed}" if name == "seed" else value for name, value in options.items() if name != "params"}
    params = {name: parameter.section() for name, parameter in parameters.items()}
    return {"_target_": target, **plain, **({"params": params} if params else {})}


def _name_of(config_path: str) -> str:
    return config_path.removeprefix("model/").removesuffix(".yaml")


def _own(name: str) -> Plugin | None:
    """Return one of frictionzoo's models; its file usually has its name, and the others need not be read."""
    return _MODELS.own(name).get(name) or _MODELS.own().get(name)


def _list_brought() -> list[str]:
    """Return the names of other packages' models that declare their parameters, and not only their dimensions."""
    plugins = [_MODELS.describe(point) for point in _MODELS.brought()]
    classes = {plugin.name: _find(plugin.path, plugin.cls) for plugin in plugins if plugin.path}
    return [name for name, found in classes.items() if found and not _value(found[1], "dimensions")]


def _read_options(path: Path, name: str) -> dict[str, Any]:
    for _, cls in _lineage(path, name):
        for method in cls.body:
            if isinstance(method, ast.FunctionDef) and method.name == "__init__":
                defaults = [ast.literal_eval(default) for default in method.args.defaults]
                arguments = [each.arg for each in method.args.args]
                return dict(zip(arguments[len(arguments) - len(defaults) :], defaults, strict=True))
    return {}


def _read_parameters(path: Path, name: str) -> dict[str, Parameter]:
    """Return the declared parameters: of `Parameter(...)` with constants, and of `**Other.physical_parameters`."""
    for place, cls in _lineage(path, name):
        declared: Any = _value(cls, "physical_parameters")
        if isinstance(declared, ast.Attribute):
            declared = ast.Dict([None], [declared])
        if declared:
            parameters: dict[str, Parameter] = {}
            for key, value in zip(declared.keys, declared.values, strict=True):
                if key is None:
                    parameters |= _read_parameters(place, value.value.id)
                else:
                    named = {each.arg: ast.literal_eval(each.value) for each in value.keywords}
                    parameters[ast.literal_eval(key)] = Parameter(*map(ast.literal_eval, value.args), **named)
            return parameters
    return {}


def _lineage(path: Path, name: str) -> Iterator[tuple[Path, ast.ClassDef]]:
    """Yield a class and its bases in this folder, each with its file."""
    if found := _find(path, name):
        yield found
        for base in found[1].bases:
            if isinstance(base, ast.Name):
                yield from _lineage(found[0], base.id)


def _find(path: Path, name: str) -> tuple[Path, ast.ClassDef] | None:
    """Return a class and its file: this one, or the one in this folder from which this one imports it."""
    for node in _parse(path) if path.exists() else ():
        if isinstance(node, ast.ClassDef) and node.name == name:
            return path, node
        if isinstance(node, ast.ImportFrom) and name in {alias.name for alias in node.names}:
            return _find(path.with_name(f"{str(node.module).rpartition('.')[2]}.py"), name)
    return None


def _value(cls: ast.ClassDef, name: str) -> ast.expr | None:
    """Return what a class assigns to a name; None if nothing."""
    for node in cls.body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if any(isinstance(target, ast.Name) and target.id == name for target in targets):
            return getattr(node, "value", None)
    return None


@functools.cache
def _parse(path: Path) -> list[ast.stmt]:
    return ast.parse(path.read_text(encoding="utf-8")).body
