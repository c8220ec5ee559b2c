"""Models by name: their sections of a configuration, with the user's options."""

from collections.abc import Mapping
from typing import Any

from frictionzoo.core.config import compose_settings, list_choices
from frictionzoo.core.declared import is_declared
from frictionzoo.core.errors import ConfigError, ModelError
from frictionzoo.core.registry import dotted_name
from frictionzoo.models.registry import get_model


def law_section(name: str, shared: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the section that makes a model: its options with `options` in place of their defaults.

    `shared` has a job's `scale` and `seed`, if known; other entries are ignored. A model that declares only the
    dimensions of its parameters, and has no file, has no defaults.

    Raises:
        UnknownModelError: There is no such model.
        ConfigError: An option does not exist, or its value is invalid.
    """
    if "_target_" in options:
        raise ConfigError(f"{name}: unknown option _target_, which would select another law; name that law")
    if name not in list_choices("model") and not is_declared(law := get_model(name)):
        return {"_target_": dotted_name(law), **options}
    job = {key: shared[key] for key in ("scale", "seed") if key in shared}  # to which the models' sections refer
    return complete_laws(compose_settings({**job, "model": options}, f"model={name}")["model"], shared)


def complete_laws(section: Mapping[str, Any], shared: Mapping[str, Any]) -> dict[str, Any]:
    """Return a model's section; if it has several models, with the complete section of each in place of its name.

    Raises:
        UnknownModelError: One of the models does not exist.
        ConfigError: An option of one of them does not exist or is invalid; or an entry is not a model.
    """
    if section.get("_target_") != "frictionzoo.models.ByJoint":
        return dict(section)
    laws = section["laws"]
    if isinstance(laws, str):
        laws = {".*": laws}
    if isinstance(laws, Mapping):
        return {**section, "laws": {pattern: _complete(pattern, law, shared) for pattern, law in laws.items()}}
    if isinstance(laws, list | tuple):
        return {**section, "laws": [_complete(f"[{index}]", law, shared) for index, law in enumerate(laws)]}
    raise ConfigError(f"model.laws={laws!r}; expected the name of a law, or patterns of joints' names with a law each")


def _complete(where: str, law: Any, shared: Mapping[str, Any]) -> dict[str, Any]:
    """Return the section of a model given as a name, as a section with name and options, or complete."""
    if isinstance(law, Mapping) and "_target_" in law:
        return dict(law)
    options = dict(law) if isinstance(law, Mapping) else {"law": law}
    name = options.pop("law", None)
    if not isinstance(name, str):
        raise ConfigError(
            f"model.laws: {where}: {law!r}, expected the name of a law, or a section {{law: NAME}} with its options"
        )
    try:
        return law_section(name, shared, options)
    except (ConfigError, ModelError) as error:
        raise type(error)(f"model.laws: {where}: {error}") from None
