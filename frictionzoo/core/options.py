"""Command options written KEY=VALUE, as for a run."""

from collections.abc import Sequence

from frictionzoo.core.errors import ConfigError


def read_options(texts: Sequence[str], example: str) -> dict[str, str]:
    """Return the values of KEY=VALUE arguments by key, as text; messages show the `example`.

    Raises:
        ConfigError: An argument is not KEY=VALUE, or a key is given twice.
    """
    options: dict[str, str] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not key or not value:
            raise ConfigError(f"{text}: expected KEY=VALUE, such as {example}")
        if key in options:
            raise ConfigError(f"{text}: {key} is given twice; give it once")
        options[key] = value
    return options
