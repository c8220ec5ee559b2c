"""What the drive carried in each recording: one payload a recording, or a table over their fields."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from frictionzoo.core.errors import ConfigError
from frictionzoo.core.log import Payload
from frictionzoo.logs.recording import Recording
from frictionzoo.logs.select import describe, equal


def choose_payloads(given: Sequence[Any], recordings: Sequence[Recording]) -> list[Payload | None]:
    """The payload of each recording.

    Args:
        given: Empty for none; or seven numbers a recording; or entries of `when`, values of fields, and `payload`, the
            seven numbers: mass [kg], centre of mass x, y, z [m], inertia ixx, iyy, izz [kg m^2].
        recordings: The recordings.

    Raises:
        ConfigError: The numbers make no payload, there are more or fewer than recordings, or no entry or two fit one.
    """
    if not given:
        return [None] * len(recordings)
    if isinstance(given[0], Mapping):
        table = [_read_entry(place, entry) for place, entry in enumerate(given)]
        return [_look_up(table, recording) for recording in recordings]
    if len(given) != len(recordings):
        raise ConfigError(
            f"data.payload has {len(given)} entries, expected {len(recordings)}, one a recording, train first"
        )
    return [_read_numbers(recording.name, numbers) for recording, numbers in zip(recordings, given, strict=True)]


def _read_entry(place: int, entry: Any) -> tuple[Mapping[str, Any], Payload]:
    """Condition and payload of an entry of the table."""
    if not isinstance(entry, Mapping) or set(entry) != {"when", "payload"} or not isinstance(entry["when"], Mapping):
        raise ConfigError(f"data.payload[{place}] is {entry}; expected when: {{field: value}} and payload: [7 numbers]")
    return entry["when"], _read_numbers(describe(entry["when"]), entry["payload"])


def _look_up(table: Sequence[tuple[Mapping[str, Any], Payload]], recording: Recording) -> Payload:
    """The payload of the one entry that fits."""
    fields = recording.fields
    fitting = [
        payload
        for when, payload in table
        if all(name in fields and equal(fields[name], value) for name, value in when.items())
    ]
    if len(fitting) == 1:
        return fitting[0]
    asked = {name: fields.get(name, "missing") for when, _ in table for name in when}
    raise ConfigError(
        f"{recording.name}: {len(fitting) or 'no'} entries of data.payload fit {describe(asked)}, expected one; "
        "mend the table or leave the recording out with data.exclude"
    )


def _read_numbers(owner: str, numbers: Any) -> Payload:
    """A payload from its seven numbers."""
    if not isinstance(numbers, Sequence) or len(numbers) != 7 or not all(_is_finite(x) for x in numbers):
        raise ConfigError(
            f"data.payload of {owner} is {numbers}; expected 7 numbers: mass, centre x, y, z, inertia ixx, iyy, izz"
        )
    mass, x, y, z, ixx, iyy, izz = map(float, numbers)
    if min(mass, ixx, iyy, izz) < 0 or 2 * max(ixx, iyy, izz) > (ixx + iyy + izz) * (1 + 1e-9):
        raise ConfigError(
            f"data.payload of {owner} is {numbers}; expected mass and inertia of at least 0, and no inertia above "
            "the sum of the other two, which no body has"
        )
    return Payload(mass, (x, y, z), (ixx, iyy, izz))


def _is_finite(number: Any) -> bool:
    return isinstance(number, int | float) and not isinstance(number, bool) and math.isfinite(number)
