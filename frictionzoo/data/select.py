"""Selection of recordings and payloads by fields: values of a whole recording, such as gains or trajectory."""

import contextlib
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from frictionzoo.core.errors import ConfigError, LogError, closest
from frictionzoo.core.log import Payload
from frictionzoo.data.recording import Recording, Table


@dataclass(frozen=True)
class Selection:
    """Additional fields, and the selection of recordings by fields.

    Args:
        fields: Values of fields for all files; they override the fields in a file and its name.
        from_name: Regular expression, searched in the file's name, whose named groups become fields; None for none.
        where: Field values of recordings to keep.
        exclude: Field values of recordings to leave out.

    Raises:
        ConfigError: An option has the wrong form.
    """

    fields: Mapping[str, Any]
    from_name: str | None
    where: Mapping[str, Any]
    exclude: Mapping[str, Any]

    def __post_init__(self) -> None:
        for option in ("where", "exclude"):
            for name, values in getattr(self, option).items():
                if isinstance(values, str) or not isinstance(values, Sequence):
                    raise ConfigError(f"data.{option}.{name}={values}: expected a list of values, as in [{values}]")
        for name, value in self.fields.items():
            if not isinstance(value, str | int | float):
                raise ConfigError(f"data.fields.{name}={value}: expected a number or text")
        if self.from_name is not None and not _compile(self.from_name).groupindex:
            setting = f"data.fields_from_name={self.from_name}"
            raise ConfigError(f"{setting}: no named group, expected one, as in (?P<kp>\\d+)")

    def keep(self, tables: Sequence[Table]) -> list[Table]:
        """Return the selected tables with all their fields.

        Raises:
            LogError: A name does not match `from_name`, no table has a requested field or value, or none is selected.
        """
        tables = [replace(table, fields=self._all_fields(table)) for table in tables]
        for option, asked in (("where", self.where), ("exclude", self.exclude)):
            for name, values in asked.items():
                refuse_absent(tables, name, values, f"data.{option}", f"data.{option}.{name}")

        def is_kept(fields: Mapping[str, Any]) -> bool:
            wanted = all(is_among(fields.get(name), values) for name, values in self.where.items())
            return wanted and not any(is_among(fields.get(name), values) for name, values in self.exclude.items())

        kept = [table for table in tables if is_kept(table.fields)]
        if not kept:
            raise LogError(f"data.where and data.exclude leave none of {len(tables)} recordings; relax them")
        return kept

    def _all_fields(self, table: Table) -> dict[str, Any]:
        named: dict[str, Any] = {}
        if self.from_name is not None:
            match = _compile(self.from_name).search(table.name)
            if match is None:
                raise LogError(
                    f"{table.name}: data.fields_from_name={self.from_name} does not match; correct the pattern"
                )
            for name, text in match.groupdict().items():
                if text is not None:
                    named[name] = text
                    with contextlib.suppress(ValueError):
                        named[name] = float(text)
        added = {name: value if isinstance(value, str) else float(value) for name, value in self.fields.items()}
        return {**table.fields, **named, **added}


def _equal(one: Any, other: Any) -> bool:
    if isinstance(one, int | float) and isinstance(other, int | float):
        return math.isclose(one, other, rel_tol=1e-9)
    return one == other


def is_among(value: Any, values: Iterable[Any]) -> bool:
    """Return whether a field's value is one of these."""
    return any(_equal(value, other) for other in values)


def refuse_absent(carriers: Sequence[Any], name: str, values: Iterable[Any], option: str, asked: str) -> None:
    """Raise LogError for a field, or a value of it, that no carrier has; `option` and `asked` name them."""
    present = list(dict.fromkeys(carrier.fields[name] for carrier in carriers if name in carrier.fields))
    if not present:
        known = {known for carrier in carriers for known in carrier.fields}
        raise LogError(f"{option}: no recording has a field {name}; {closest(name, known)}")
    present.sort(key=lambda value: (isinstance(value, str), value))
    for value in values:
        if not is_among(value, present):
            raise LogError(f"{asked}={value}: no recording has it; expected one of {', '.join(map(str, present))}")


def _compile(pattern: str) -> re.Pattern[str]:
    try:
        return re.compile(pattern)
    except re.error as error:
        raise ConfigError(f"data.fields_from_name={pattern}: {error}; expected a regular expression") from None


def choose_payloads(given: Sequence[Any], recordings: Sequence[Recording]) -> list[Payload | None]:
    """Return the payload of the drive in each recording, training before test.

    `given` is empty for none; or seven numbers a recording; or entries with `when` (values of fields) and `payload`
    (seven numbers). The numbers are mass [kg], centre of mass x, y, z [m], inertia ixx, iyy, izz [kg m^2].

    Raises:
        ConfigError: A payload is invalid, payloads and recordings differ in number, or a recording does not match
            exactly one entry.
    """
    if not given:
        return [None] * len(recordings)
    if isinstance(given[0], Mapping):
        table = []
        for place, entry in enumerate(given):
            keys = {*entry} if isinstance(entry, Mapping) else set()
            if keys != {"when", "payload"} or not isinstance(entry["when"], Mapping):
                expected = "when: {field: value} and payload: [7 numbers]"
                raise ConfigError(f"data.payload[{place}] is {entry}; expected {expected}")
            table.append((entry["when"], _read_numbers(_describe(entry["when"]), entry["payload"])))
        return [_look_up(table, recording) for recording in recordings]
    if len(given) != len(recordings):
        expected = f"expected {len(recordings)}, one a recording, train first"
        raise ConfigError(f"data.payload has {len(given)} entries, {expected}")
    return [_read_numbers(recording.name, numbers) for recording, numbers in zip(recordings, given, strict=True)]


def _look_up(table: Sequence[tuple[Mapping[str, Any], Payload]], recording: Recording) -> Payload:
    fields = recording.fields
    asked = {name: fields.get(name, "missing") for when, _ in table for name in when}
    matching = [load for when, load in table if all(n in fields and _equal(fields[n], v) for n, v in when.items())]
    if len(matching) == 1:
        return matching[0]
    problem = f"{recording.name}: {len(matching) or 'no'} entries of data.payload fit {_describe(asked)}"
    raise ConfigError(f"{problem}, expected one; correct the table or leave the recording out with data.exclude")


def _read_numbers(owner: str, numbers: Any) -> Payload:
    subject = f"data.payload of {owner} is {numbers}"
    values = numbers if isinstance(numbers, Sequence) else ()
    is_number = (isinstance(x, int | float) and not isinstance(x, bool) and math.isfinite(x) for x in values)
    if len(values) != 7 or not all(is_number):
        raise ConfigError(f"{subject}; expected 7 numbers: mass, centre x, y, z, inertia ixx, iyy, izz")
    mass, x, y, z, ixx, iyy, izz = map(float, numbers)
    if min(mass, ixx, iyy, izz) < 0 or 2 * max(ixx, iyy, izz) > (ixx + iyy + izz) * (1 + 1e-9):
        expected = "mass and inertia of at least 0, and no inertia above the sum of the other two"
        raise ConfigError(f"{subject}; expected {expected}")
    return Payload(mass, (x, y, z), (ixx, iyy, izz))


def _describe(fields: Mapping[str, Any]) -> str:
    return ", ".join(f"{name}={value}" for name, value in fields.items())
