"""Proposed columns and units of signals, as options for the command line."""

import math
import re
import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from frictionzoo.data.families import find_columns, is_usable
from frictionzoo.data.recording import SIGNALS, Table
from frictionzoo.data.registers import SERIES, Registers, decode_table, find_kind
from frictionzoo.data.signals import ALIKE, Signal, find_wrap, unwrap
from frictionzoo.data.units import UNITS, could_be_degrees, ratio
from frictionzoo.data.words import POSITION, VELOCITY, list_words, split

BAM = {
    **{"time": "timestamp", "qpos": "position", "qvel": "speed", "ctrl": "goal_position"},
    **{"supply": "input_volts", "enable": "torque_enable", "temperature": "temp"},
}
SPELLINGS = {
    **{"sec": "s", "secs": "s", "seconds": "s", "degree": "deg", "degrees": "deg", "radians": "rad", "nm": "N m"},
    **{"dps": "deg/s", "deg_s": "deg/s", "rad_s": "rad/s", "radps": "rad/s", "mm_s": "mm/s", "m_s": "m/s"},
    **{"volts": "V", "volt": "V", "amps": "A", "percent": "%", "pct": "%", "turns": "rev"},
    **{"c": "degC", "celsius": "degC"},
}
STEPS = ((0.5, "s"), (200.0, "ms"), (2e5, "us"), (math.inf, "ns"))  # largest median step by unit, 5 Hz to 5 kHz
NEAR = 0.12  # largest error of a ratio's logarithm for which the ratio shows the units
TURNS = 57.0  # rad; nine turns of a joint, more likely a motion recorded in degrees
LENGTHS = ("m", "mm", "um")  # positions that belong to velocities in lengths per second
IN_TURNS = (frozenset(("pos_estimate", "vel_estimate")), frozenset(("position", "velocity", "q_current")))
"""Ends of headers, all in one table, of drives that log turns and turns per second: ODrive and moteus."""
FASTEST = 500.0  # turns/s; faster velocities are in another unit
FEWEST = 20  # ticks; a register that moves less shows no unit
OF_REGISTERS = frozenset(("present", "goal"))
"""Words in the makers' names of registers, such as Present_Position."""


@dataclass(frozen=True)
class Proposal:
    """Proposed columns of a table, and units of signals outside SI.

    Attributes:
        certain: Whether all names are unambiguous and all signals seem to be in SI units.
        registers: Name of the series in `SERIES` whose raw registers the signals are; None: no registers.
    """

    columns: Mapping[str, tuple[str, ...]]
    units: Mapping[str, str] = field(default_factory=dict)
    certain: bool = False
    registers: str | None = None

    def overrides(self) -> list[str]:
        """Return the proposal as command-line options, quoted for a shell if needed."""
        options = []
        for signal, headers in self.columns.items():
            names = ",".join(map(_quote, headers))
            options.append(f"data.columns.{signal}={_quote(headers[0]) if signal == 'time' else f'[{names}]'}")
        options += [f"data.units.{signal}={_quote(unit)}" for signal, unit in self.units.items()]
        options += [f"data.registers={self.registers}"] if self.registers else []
        # Brackets around words need no quotes.
        return [option if re.fullmatch(r"[\w.=/,\[\]-]*", option) else shlex.quote(option) for option in options]


def propose(
    table: Table,
    joints: Sequence[str] = (),
    said: Collection[str] = (),
    registers: Registers | str | None = None,
    passive: Collection[str] = (),
) -> Proposal:
    """Propose columns and units for the signals of a table, from names and numbers.

    `joints` names the joints whose columns are wanted; empty if unknown. `said` lists signals whose columns a user set.
    `registers` is the user's `data.registers`: registers, None to detect them, or a text to read none. Commands of the
    `passive` joints may be missing.

    Raises:
        LogError: Headers of a signal not in `said` name only some of the joints, or a joint twice.
    """
    columns = _find_plain(table)
    is_plain = bool(columns)
    columns = columns or find_columns(table, joints, said, passive)
    series = None
    if registers is None:
        series = _guess_registers(table, columns)
        registers = SERIES.get(series or "")
    if isinstance(registers, Registers):
        table = decode_table(table, columns, registers)
    units = _find_units(table, columns)
    return Proposal(columns, units, is_plain and not units and not series, series)


def _find_plain(table: Table) -> dict[str, tuple[str, ...]]:
    """Return the columns of a table whose headers are the names of signals, or those of BAM logs; empty otherwise."""
    for names in ({signal: signal for signal in SIGNALS}, BAM):
        if all(names[signal] in table.columns for signal in ("time", "qpos", "ctrl")):
            columns = {signal: (header,) for signal, header in names.items() if header in table.columns}
            return {signal: headers for signal, headers in columns.items() if is_usable(table, signal, headers)}
    return {}


Columns = Mapping[str, tuple[str, ...]]
Units = dict[str, str]


@np.errstate(all="ignore")  # raw numbers: overflow or infinity gives no guess
def _find_units(table: Table, columns: Columns) -> Units:
    """Find units from headers, or from numbers if headers state none."""
    units: Units = {}
    for signal, headers in columns.items():
        unit = _unit_of(signal, headers[0])
        if unit is not None and not table.units.get(headers[0]):
            units[signal] = unit
    for guess in (_guess_time, _guess_makers_turns, _guess_wrap, _guess_rate, _guess_degrees):
        units |= guess(table, columns, units)
    is_velocity = "ctrl" in columns and find_kind("ctrl", columns["ctrl"][0]) == "velocity"
    for signal, command in (("qvel" if is_velocity else "qpos", "ctrl"), ("qvel", "ctrl_velocity")):
        units |= _guess_followed(signal, command, table, columns, units)
    return {signal: unit for signal, unit in units.items() if _si(signal, unit) != 1}


def _unit_of(signal: str, header: str) -> str | None:
    """Return the unit in a header, in brackets or at its end."""
    names = {name.replace(" ", "").lower(): name for name in UNITS[signal]}
    inside = re.findall(r"[\[(]([^\])]*)[\])]\s*$", header)
    parts = re.split(r"[_\s.]+", header.lower())
    for word in (*inside, "_".join(parts[-2:]), *(parts[-1:] if len(parts) > 1 else ())):
        word = SPELLINGS.get(word.strip().lower(), word.strip())
        name = names.get(word.replace(" ", "").replace("*", "").replace("·", "").lower())
        if name is not None and not name.isdigit():
            return name
    return None


def _is_stated(signal: str, table: Table, columns: Columns, units: Units) -> bool:
    """Return whether the unit of a signal is known already, or there is no such signal."""
    return signal not in columns or signal in units or columns[signal][0] in table.units


def _guess_time(table: Table, columns: Columns, units: Units) -> Units:
    if _is_stated("time", table, columns, units):
        return {}
    steps = np.diff(table.columns[columns["time"][0]].astype(float))
    steps = steps[np.isfinite(steps) & (steps > 0)]
    if not len(steps):
        return {}
    step = float(np.median(steps))
    return {"time": next((unit for limit, unit in STEPS if step < limit), STEPS[-1][1])}


def _guess_makers_turns(table: Table, columns: Columns, units: Units) -> Units:
    words = [list_words(split(header)) for header in table.columns]
    ends = {"_".join(each[-count:]) for each in words for count in (1, 2)}
    signals = {"qpos": "rev", "qvel": "rev/s", "ctrl_velocity": "rev/s"}
    command = {*list_words(split(columns["ctrl"][0]))} if "ctrl" in columns else set[str]()
    if command & {*VELOCITY.split(), *POSITION.split()}:
        signals["ctrl"] = "rev/s" if command & {*VELOCITY.split()} else "rev"
    is_named = any(names <= ends for names in IN_TURNS)
    fastest = _values(table, columns, ("qvel",))
    if not is_named or _is_stated("qpos", table, columns, units) or fastest is None:
        return {}
    if not np.nanmax(np.abs(fastest[0]), initial=0.0) < FASTEST:
        return {}
    return {signal: unit for signal, unit in signals.items() if not _is_stated(signal, table, columns, units)}


def _guess_wrap(table: Table, columns: Columns, units: Units) -> Units:
    if _is_stated("qpos", table, columns, units):
        return {}
    wrap = find_wrap(table.columns[columns["qpos"][0]].astype(float))
    unit = None if wrap is None else {360.0: "deg", 1.0: "rev"}.get(wrap)
    if wrap is not None and wrap > 360 and math.log2(wrap).is_integer():
        unit = repr(math.tau / wrap)  # ticks of an encoder
    return {"qpos": unit} if unit else {}


@np.errstate(all="ignore")
def _guess_registers(table: Table, columns: Columns) -> str | None:
    """Guess the series whose raw registers position and velocity are; None if neither numbers nor names show one."""
    signals = _values(table, columns, ("time", "qpos"))
    if signals is None or any(columns[signal][0] in table.units for signal in ("qpos", "qvel") if signal in columns):
        return None
    position = signals[1][np.isfinite(signals[1])]
    if not len(position) or np.any(position != np.round(position)) or not np.ptp(position) > FEWEST:
        return None
    units = _guess_time(table, columns, {})
    is_named = bool(OF_REGISTERS & {*list_words(split(columns["qpos"][0]))})
    for series, registers in sorted(SERIES.items(), key=lambda item: item[1].zero):  # the smallest range that suits
        decoded = decode_table(table, columns, registers)
        turned = decoded.columns[columns["qpos"][0]] + registers.zero
        if turned.min() < 0 or not turned.max() <= 2 * registers.zero:
            continue
        if "qvel" not in columns:  # a range that only one zero suits
            if is_named and turned.max() >= 2 * SERIES["feetech_scs"].zero:
                return series
            continue
        scale = _find_rate(decoded, columns, units)
        raw, signed = table.columns[columns["qvel"][0]], decoded.columns[columns["qvel"][0]]
        velocity = registers.units("velocity") / registers.units("position")
        is_special = is_named or abs(math.log(velocity)) > NEAR or bool(np.any(raw != signed))
        if scale is not None and is_special and abs(math.log(scale / velocity)) < NEAR:
            return series
    return None


def _find_rate(table: Table, columns: Columns, units: Units) -> float | None:
    """Return the ratio of the position's derivative per second to the velocity, without units; None if unlike."""
    signals = _values(table, columns, ("time", "qpos", "qvel"))
    if signals is None:
        return None
    time, position, velocity = signals
    seconds = time * _si("time", units.get("time") or table.units.get(columns["time"][0], "s"))
    advances = np.isfinite(seconds) & (np.diff(seconds, prepend=-math.inf) > 0)
    if advances.sum() < 3:
        return None
    position = unwrap(position, find_wrap(position))
    return _ratio(np.gradient(position[advances], seconds[advances]), velocity[advances])


def _guess_rate(table: Table, columns: Columns, units: Units) -> Units:
    """Guess the units of position and velocity from the ratio of the position's derivative to the velocity."""
    if {"qpos", "qvel"} <= set(units) or "qpos" not in columns or columns["qpos"][0] in table.units:
        return {}
    scale = _find_rate(table, columns, units)
    if scale is None:
        return {}
    distance, position_unit, velocity_unit = min(
        (abs(math.log(scale / (_si("qvel", velocity_unit) / _si("qpos", position_unit)))), position_unit, velocity_unit)
        for position_unit in ([units["qpos"]] if "qpos" in units else ["rad", "deg", "rev", "mm"])
        for velocity_unit in ([units["qvel"]] if "qvel" in units else ["rad/s", "deg/s", "rpm", "rev/s", "mm/s"])
        if (position_unit in LENGTHS) == (velocity_unit.split("/")[0] in LENGTHS)
        or {position_unit, velocity_unit} & {"rad", "rad/s"}
    )
    alike = abs(math.log(scale)) < NEAR and not units.keys() & {"qpos", "qvel"}
    found = {"qpos": position_unit, "qvel": velocity_unit}
    return {} if distance > NEAR or alike else {s: u for s, u in found.items() if s not in units and _si(s, u) != 1}


def _guess_degrees(table: Table, columns: Columns, units: Units) -> Units:
    """Guess degrees if the position in radians would be many turns, and the motion suits a joint's range in degrees."""
    if _is_stated("qpos", table, columns, units):
        return {}
    signals = _values(table, columns, ("time", "qpos"))
    time, position = signals if signals is not None else (np.zeros(0), table.columns[columns["qpos"][0]].astype(float))
    largest = float(np.nanmax(np.abs(position), initial=0.0))
    seconds = time * _si("time", units.get("time", "s")) if len(time) else None
    if not TURNS < largest < math.inf or not could_be_degrees(position, seconds):
        return {}
    return {"qpos": "deg"} | ({"qvel": "deg/s"} if "qvel" in columns and "qvel" not in units else {})


def _guess_followed(signal: str, command: str, table: Table, columns: Columns, units: Units) -> Units:
    """Guess the unit of a command from the ratio of the signal that follows it."""
    signals = _values(table, columns, (signal, command))
    if signals is None or _is_stated(command, table, columns, units):
        return {}
    possible = ["rad", "deg"] if signal == "qpos" else ["rad/s", "deg/s"]
    measured_unit = units.get(signal) or table.units.get(columns[signal][0], possible[0])
    possible += [measured_unit]
    scale = _ratio(*signals, of_same=True)
    if scale is None:
        return {}
    distance, unit = min((abs(math.log(scale * _si(signal, measured_unit) / _si(signal, u))), u) for u in possible)
    # A position short of its command does not show another unit; a factor of 57 does.
    return {} if distance > 10 * NEAR or _si(signal, unit) == 1 else {command: unit}


def _values(table: Table, columns: Columns, signals: tuple[str, ...]) -> list[Signal] | None:
    """Return the first column of each signal; None unless all exist with equal length."""
    if not all(signal in columns for signal in signals):
        return None
    values = [table.columns[columns[signal][0]].astype(float) for signal in signals]
    return values if len({len(column) for column in values}) == 1 else None


def _ratio(first: Signal, second: Signal, of_same: bool = False) -> float | None:
    """Return the ratio of the first signal to the second; None if they are not the same quantity."""
    usable = np.isfinite(first) & np.isfinite(second) & (np.abs(first) < 1e100) & (np.abs(second) < 1e100)
    if usable.sum() < 3 or not np.ptp(first[usable]) > 0 or not np.ptp(second[usable]) > 0:
        return None
    a, b = first[usable] - np.median(first[usable]), second[usable] - np.median(second[usable])
    products = float(a @ b), float(a @ a), float(b @ b)
    if min(products) <= 0 or products[0] < (ALIKE if of_same else 0.3) * math.sqrt(products[1] * products[2]):
        return None
    return products[0] / products[2]  # the first, a derivative, has the noise


def _si(signal: str, unit: str) -> float:
    numerator, denominator = ratio(signal, unit)
    return numerator / denominator


def _quote(name: str) -> str:
    """Return an option's value, quoted if Hydra would parse it as syntax."""
    return name if re.fullmatch(r"[A-Za-z_][\w/ -]*", name) else '"' + name.replace('"', '\\"') + '"'
