"""Data set from a user's files of any format."""

import copy
import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from frictionzoo.core.described import describe
from frictionzoo.core.errors import ConfigError, LogError, closest
from frictionzoo.core.log import ORIGINS, Columns, Dataset, Log, Payload
from frictionzoo.data.clean import Cleaning, clean, summarise_repairs
from frictionzoo.data.columns import list_names, to_recording
from frictionzoo.data.formats import find_files, format_names, read_tables
from frictionzoo.data.logs import InMemory, Logs
from frictionzoo.data.pairing import arrange, arrange_recording, has_names, reorder
from frictionzoo.data.presets import name_motors
from frictionzoo.data.propose import Proposal, propose
from frictionzoo.data.recording import SIGNALS, TURNED, Recording, Table
from frictionzoo.data.registers import SERIES, UNDETECTED, Registers, decode_table, read_registers
from frictionzoo.data.select import Selection, choose_payloads
from frictionzoo.data.source import Source, register_source
from frictionzoo.data.split import Split
from frictionzoo.data.topics import is_sparse, join, separate
from frictionzoo.data.units import ratio

Entry = str | dict[str, str]
"""Path or glob of recordings, or the files of one recording by key."""
UPRIGHT: Mapping[str, int] = dict.fromkeys(TURNED, 1)
"""Default signs, which turn no signal."""
AS_IT_IS = Cleaning()
"""Default cleaning."""
_log = logging.getLogger(__name__)
_Inferred = tuple[dict[str, Any], dict[str, str], Registers | None]  # columns, units and registers of a table


@register_source("files")
class Files(Source):
    """Data set from files: separate training and test files, or a division by time, by file or by a field.

    `conf/recordings/files.yaml` describes each argument under the same name.

    Raises:
        ConfigError: An option is unknown or impossible.
    """

    def __init__(
        self,
        name: str = "files",
        train: Any = (),
        test: Any = (),
        folder: str | None = None,
        source: str | None = None,
        format: str = "auto",
        columns: Mapping[str, Any] | None = None,
        units: Mapping[str, str | None] | None = None,
        registers: Any = None,
        sign: Mapping[str, int | Sequence[int]] = UPRIGHT,
        fields: Any = None,
        fields_from_name: str | None = None,
        where: Any = None,
        exclude: Any = None,
        clean: Cleaning = AS_IT_IS,
        payload: Sequence[Any] = (),
        inputs: Any = None,
        split: Mapping[str, Any] | None = None,
        origin: str | None = None,
    ) -> None:
        if format not in ("auto", *format_names()):
            raise ConfigError(f"data.format={format}: no such format; {closest(format, ('auto', *format_names()))}")
        if origin not in ORIGINS:
            raise ConfigError(f"data.origin={origin}: unknown; {closest(str(origin), filter(None, ORIGINS))}, or null")
        self.name, self.folder, self.source, self.format = name, folder, source, format
        self.train, self.test = _entries("train", train), _entries("test", test)
        self.columns = {s: list_names(f"columns.{s}", value) for s, value in _signals("columns", columns).items()}
        self.units = {signal: str(unit) for signal, unit in _signals("units", units).items()}
        self.registers, self.sign = read_registers(registers), _signs(sign)
        for signal, unit in self.units.items():
            ratio(signal, unit)  # refuses an unknown unit, even of a signal that no file has
        by_field = {"fields": fields, "where": where, "exclude": exclude}
        self.selection = Selection(
            **{n: _mapping(n, given) for n, given in by_field.items()}, from_name=fields_from_name
        )
        self.inputs = _mapping("inputs", inputs)
        self.clean, self.payload, self.simulated = clean, payload, ORIGINS[origin]
        self.joints: tuple[str, ...] = ()
        self.passive: tuple[str, ...] = ()
        self.split = Split(**(split or {}))
        if self.test and self.split.by != "time":
            raise ConfigError(f"data.split.by={self.split.by} and data.test={self.test}; expected one of them")

    def find(self) -> None:
        """Check that the files exist, see `Source.find`."""
        for entry in (*self.train, *self.test):
            self._find(entry)

    def for_joints(self, joints: Sequence[str], passive: Collection[str] = ()) -> "Files":
        """Return the same source for these joints, see `Source.for_joints`."""
        other = copy.copy(self)
        other.joints, other.passive = tuple(joints), tuple(passive)
        return other

    def recordings(self) -> list[Recording]:
        """Return all recordings before cleaning, test-only recordings last.

        Raises:
            LogError: A file cannot be read or lacks a column that `columns` names, or no recording is kept.
        """
        train, test = self._interpret_all()
        for recording in train + test:
            if recording.notes:
                _log.info("%s: %s: %s", self.name, recording.name, "; ".join(recording.notes))
        return train + test

    def load(self) -> Dataset:
        """Load, clean and divide the recordings; see `read` and `Logs.divide` for errors."""
        return self.read().divide()

    def read(self, tables: Sequence[Table] = ()) -> Logs:
        """Read and clean the recordings, and further training recordings `tables` from memory, without dividing them.

        Raises:
            LogError: A file cannot be read or lacks a column that `columns` names, or cleaning leaves no log.
            ConfigError: A payload is invalid, or a recording matches no payload.
        """
        train, test = self._interpret_all(tables)
        recordings = train + test
        payloads = choose_payloads(self.payload, recordings)
        cleaned = tuple(tuple(self._clean(*pair)) for pair in zip(recordings, payloads, strict=True))
        self._report(recordings, cleaned)
        section = describe(self) | {"train": [*self.train, *(table.name for table in tables)]}
        if tables:
            section |= describe(InMemory([table.name for table in tables]))
        return Logs(self.name, tuple(recordings), cleaned, len(test), self.split, section)

    def _interpret_all(self, tables: Sequence[Table] = ()) -> tuple[list[Recording], list[Recording]]:
        if not self.train and not tables:
            raise LogError("data.train=[]: no recording; name files, as in data.train=[a.csv] data.test=[b.csv]")
        train, test = [*self._tables(self.train), *tables], self._tables(self.test)
        held_out = {table.name for table in test}
        shared = [table.name for table in train if table.name in held_out]
        if shared:
            raise LogError(f"{shared[0]}: in data.train and in data.test; expected each recording in one of them")
        recordings = self._interpret(self.selection.keep(train + test))
        training = [recording for recording in recordings if recording.name not in held_out]
        testing = [recording for recording in recordings if recording.name in held_out]
        if not training or (held_out and not testing):
            part = "test" if training else "train"
            raise LogError(f"{self.name}: data.where and data.exclude leave no {part} recording")
        return training, testing

    def _find(self, entry: Entry) -> list[dict[str, str]]:
        """Return the files of the recordings of an entry, by key; a single file has no key."""
        keyed = entry if isinstance(entry, Mapping) else {"": entry}
        paths = {key: find_files([name], self.folder, self.source) for key, name in keyed.items()}
        if len({len(files) for files in paths.values()}) > 1:
            counts = ", ".join(f"{len(files)} of {key}" for key, files in paths.items())
            raise LogError(f"{dict(keyed)}: {counts}, expected as many files of each; name them one by one")
        return [dict(zip(paths, files, strict=True)) for files in zip(*paths.values(), strict=True)]

    def _tables(self, entries: Sequence[Entry]) -> list[Table]:
        tables = [table for entry in entries for paths in self._find(entry) for table in self._read(paths)]
        return list({table.name: table for table in tables}.values())

    def _read(self, paths: Mapping[str, str]) -> list[Table]:
        tables = {key: read_tables(path, self.format) for key, path in paths.items()}
        if "" in tables:
            return tables[""]
        for key, found in tables.items():
            if len(found) != 1:
                raise LogError(f"{paths[key]}: {len(found)} recordings, expected one with the key {key}; unpack it")
        return [join({key: found[0] for key, found in tables.items()}, self.columns.get("time", ()))]

    def _interpret(self, tables: Sequence[Table]) -> list[Recording]:
        """Convert tables to recordings; infer missing options once for all tables with the same headers."""
        inferred: dict[frozenset[str], _Inferred] = {}
        recordings = []
        for table in tables:
            if any(map(is_sparse, table.columns.values())):
                columns = propose(table, self.joints, self.columns, passive=self.passive).columns
                table = separate(table, {**columns, **self.columns})
            table = self._name_motors(table)
            headers = frozenset(table.columns)
            if headers not in inferred:
                inferred[headers] = self._complete(table)
            recordings.append(self._convert(table, *inferred[headers]))
        turned = [replace(each, signals={name: self._turn(each, name) for name in each.signals}) for each in recordings]
        return self._arrange(turned) if self.joints else turned

    def _convert(
        self, table: Table, columns: Mapping[str, Any], units: Mapping[str, str], registers: Registers | None
    ) -> Recording:
        """Convert a table to a recording that knows which units were stated."""
        stated = dict(self.units)
        if registers is not None:
            signals = {signal: list_names(f"columns.{signal}", names) for signal, names in columns.items()}
            table = decode_table(table, signals, registers)
            stated = dict.fromkeys(("qpos", "qvel"), "ticks") | stated
        return replace(to_recording(table, columns, units, self.simulated, self.columns), units=stated)

    def _name_motors(self, table: Table) -> Table:
        if any(header in table.columns for headers in self.columns.values() for header in headers):
            return table  # a user names the numbers
        table, sentence = name_motors(table, self.joints)
        if sentence:
            _log.info("%s: %s", table.name, sentence)
        return table

    def _turn(self, recording: Recording, signal: str) -> np.ndarray:
        """Return a signal times its sign, or times one sign a column."""
        sign, values = self.sign.get(signal, 1), recording.signals[signal]
        if isinstance(sign, list | tuple):
            setting, columns = f"data.sign.{signal}={list(sign)}", recording.columns[signal]
            if len(sign) != values.shape[1]:
                expected = f"expected {values.shape[1]}, one a column"
                raise ConfigError(f"{setting}: {len(sign)} signs, {expected} of {recording.name}")
            if not columns.listed and has_names(columns.headers):
                raise ConfigError(
                    f"{setting}: one sign per column, but the columns of {recording.name} are matched by name; list "
                    f"them in data.columns.{signal} in the order of the signs"
                )
        return np.asarray(sign) * values

    def _arrange(self, recordings: Sequence[Recording]) -> list[Recording]:
        arranged = [arrange_recording(recording, self.joints, self.passive) for recording in recordings]
        for line in dict.fromkeys(line for _, lines in arranged for line in lines):
            _log.info("%s: %s", self.name, line)
        return [recording for recording, _ in arranged]

    def _complete(self, table: Table) -> "_Inferred":
        given = {signal: headers for signal, headers in self.columns.items() if signal != "time" or not table.is_joined}
        proposal = self._propose(table, given)
        columns = {signal: headers for signal, headers in proposal.columns.items() if signal not in given}
        # An inferred unit holds only for the inferred headers, which the options may name too.
        same = {signal for signal, headers in proposal.columns.items() if given.get(signal, headers) == headers}
        units = {signal: unit for signal, unit in proposal.units.items() if signal in same - set(self.units)}
        already_named = all(headers == (signal,) for signal, headers in columns.items())
        if not already_named or units or proposal.registers:
            level = logging.INFO if proposal.certain else logging.WARNING
            origins = {signal: Columns(headers) for signal, headers in columns.items()}
            if self.joints:
                origins = reorder(origins, arrange(table.name, origins, self.joints, self.passive))
            headers = {signal: origin.headers for signal, origin in origins.items()}
            text = " ".join(replace(proposal, columns=headers, units=units).overrides())
            _log.log(level, "%s: inferred from names and numbers in %s: %s", self.name, table.name, text)
        registers = SERIES[proposal.registers] if proposal.registers else self.registers
        stated = registers if isinstance(registers, Registers) else None
        return {**columns, **given}, {**units, **self.units}, stated

    def _propose(self, table: Table, given: Mapping[str, Sequence[str]]) -> Proposal:
        """Propose columns and units; no registers for a position column or unit that the user stated otherwise."""
        proposal = propose(table, self.joints, given, self.registers, self.passive)
        if proposal.registers is None:
            return proposal
        headers, unit = proposal.columns["qpos"], self.units.get("qpos")
        if given.get("qpos", headers) == headers and SERIES[proposal.registers].suits(unit):
            return proposal
        return propose(table, self.joints, given, UNDETECTED, self.passive)

    def _clean(self, recording: Recording, payload: Payload | None) -> list[Log]:
        logs = []
        for log in clean(recording, self.clean):
            constants = {name: _constant(recording, name, value) for name, value in self.inputs.items()}
            inputs = {name: np.full((log.samples, 1), value) for name, value in constants.items()}
            logs.append(replace(log, payload=payload, extras={**log.extras, **inputs}))
        return logs

    def _report(self, recordings: Sequence[Recording], logs: Sequence[Sequence[Log]]) -> None:
        """Log one line on the cleaning; LogError if no log remains."""
        kept = [log for cleaned in logs for log in cleaned]
        dropped = [recording.name for recording, cleaned in zip(recordings, logs, strict=True) if not cleaned]
        if not kept:
            raise LogError(
                f"{dropped[0]}: cleaning removes all of it and of {len(dropped) - 1} others; expected "
                f"{self.clean.shortest:g} s (data.clean.shortest) without gaps and NaN, and no spikes with "
                "data.clean.spikes=drop; check the file or change data.clean"
            )
        sentences = [f"{len(dropped)} left out by data.clean, such as {dropped[0]}"] if dropped else []
        sentences += summarise_repairs(kept)
        if sentences:
            counts = len(recordings), len(kept)
            _log.info("%s: recordings read: %d; logs: %d; %s", self.name, *counts, "; ".join(sentences))


def _constant(recording: Recording, name: str, given: str | float) -> float:
    if not isinstance(given, str):
        return float(given)
    if given not in recording.fields:
        raise LogError(
            f"{recording.name}: data.inputs.{name}={given}: no such field; {closest(given, map(str, recording.fields))}"
        )
    value = recording.fields[given]
    if isinstance(value, str) or not np.isfinite(value):
        raise LogError(f"{recording.name}: data.inputs.{name}: its field {given} is {value}, expected a number")
    return float(value)


def _entries(option: str, given: Any) -> list[Entry]:
    entries = [] if given in (None, "") else [given] if isinstance(given, str | Mapping) else given
    if not isinstance(entries, Sequence):
        raise ConfigError(f"data.{option}={given}: expected a list of paths, as in [a.csv, b.csv]")
    for entry in entries:
        texts = (*entry, *entry.values()) if isinstance(entry, Mapping) and len(entry) > 1 else (entry,)
        if not all(isinstance(text, str) and text for text in texts):
            expected = "a path, or several files of one recording, as in {state: a.csv, command: b.csv}"
            raise ConfigError(f"data.{option}: {entry!r}, expected {expected}")
    return [entry if isinstance(entry, str) else dict(entry) for entry in entries]


def _mapping(option: str, given: Any) -> dict[str, Any]:
    if given is not None and not isinstance(given, Mapping):
        raise ConfigError(f"data.{option}={given}: expected names with values, as in {{kp: 16}}")
    return dict(given or {})


def _signs(given: Mapping[str, Any]) -> dict[str, Any]:
    for signal, sign in given.items():
        if signal not in TURNED:
            raise ConfigError(f"data.sign.{signal}: unknown signal; {closest(str(signal), TURNED)}")
        if not all(factor in (1, -1) for factor in (sign if isinstance(sign, list | tuple) else [sign])):
            raise ConfigError(f"data.sign.{signal}={sign}: expected 1 or -1, or a list of them, one a column")
    return dict(given)


def _signals(option: str, given: Mapping[str, Any] | None) -> dict[str, Any]:
    given = given or {}
    for signal in given:
        if signal not in SIGNALS:
            raise ConfigError(f"data.{option}.{signal}: unknown signal; {closest(str(signal), SIGNALS)}")
    return {signal: value for signal, value in given.items() if value is not None}
