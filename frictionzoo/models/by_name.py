"""Laws by name: their sections as `conf/model` has them, with a user's options."""

from collections.abc import Mapping
from typing import Any

from frictionzoo.core.config import compose_settings, list_choices
from frictionzoo.core.errors import ConfigError, ModelError
from frictionzoo.core.registry import dotted_name
from frictionzoo.models.registry import get_model

OF_SEVERAL = "frictionzoo.models.ByJoint"
_SHARED = ("scale", "seed")  # options of a job that laws' files refer to


def law_section(name: str, shared: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """The section that makes a law: that of its file in `conf/model`, or, where there is none, its class alone.

    Args:
        name: Of the file, or of a law that was registered in this program.
        shared: A job's `scale` and `seed`, where they are known; anything else in it does not count.
        options: Of the law, in place of the file's.

    Raises:
        UnknownModelError: No such law.
        ConfigError: No such option, or a value that it cannot have.
    """
    if "_target_" in options:
        raise ConfigError(f"{name}: unknown option _target_, which would make it another law; name that law")
    if name not in list_choices("model"):
        return {"_target_": dotted_name(get_model(name)), **options}
    known = {key: shared[key] for key in _SHARED if key in shared}
    return complete_laws(compose_settings({**known, "model": options}, f"model={name}")["model"], shared)


def complete_laws(section: Mapping[str, Any], shared: Mapping[str, Any]) -> dict[str, Any]:
    """A law's section; of one with several laws in it, with the whole section of each in place of its name.

    Args:
        section: Of any law.
        shared: As in `law_section`.

    Raises:
        UnknownModelError: One of them does not exist.
        ConfigError: One of them has no such option, or a value that it cannot have; or it is no law.
    """
    if section.get("_target_") != OF_SEVERAL:
        return dict(section)
    laws = section["laws"]
    if isinstance(laws, str):
        laws = {".*": laws}
    if isinstance(laws, Mapping):
        return {**section, "laws": {pattern: _complete(pattern, law, shared) for pattern, law in laws.items()}}
    if isinstance(laws, list | tuple):
        return {**section, "laws": [_complete(f"[{at}]", law, shared) for at, law in enumerate(laws)]}
    raise ConfigError(f"model.laws={laws!r}; expected the name of a law, or patterns of joints' names with a law each")


def _complete(where: str, law: Any, shared: Mapping[str, Any]) -> dict[str, Any]:
    """The section of a law that is a name, or a section with its name and options, or complete already."""
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
