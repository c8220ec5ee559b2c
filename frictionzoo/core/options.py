"""Options of a command that are written KEY=VALUE, as those of a run are."""

from collections.abc import Sequence

from frictionzoo.core.errors import ConfigError


def read_options(texts: Sequence[str], example: str) -> dict[str, str]:
    """Values by key, as text, of a command's arguments; `example` is one as it should be, for messages.

    Raises:
        ConfigError: One is not KEY=VALUE, or a key is given twice.
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
