"""A guess at which columns are which signals, and in which units, in words that can be pasted into a command."""

import math
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from frictionzoo.logs.recording import SIGNALS, Table
from frictionzoo.logs.signals import Signal
from frictionzoo.logs.units import UNITS, ratio

BAM = {
    **{"time": "timestamp", "qpos": "position", "qvel": "speed", "ctrl": "goal_position"},
    **{"supply": "input_volts", "enable": "torque_enable", "temperature": "temp"},
}
# Words of a header, the most telling first: a goal_position is a command, and torque_enable no torque.
COMMANDED = "goal cmd target ctrl command commands commanded reference ref setpoint desired des action u ff feedforward"
VELOCITY = "dq qd qvel vel velocity speed omega qdot"
EFFORT = "torque tau effort current voltage pwm duty vir force"
WORDS = (
    ("kp", "kp"),
    ("kd", "kd"),
    ("enable", "enable enabled"),
    ("temperature", "temp temperature"),
    ("supply", "volts vin vbus supply battery"),
    ("ctrl", COMMANDED),
    ("time", "t time timestamp timestamps stamp clock seconds"),
    ("qvel", VELOCITY),
    ("qpos", "q qpos pos position angle theta state qm"),
    ("effort", EFFORT),
)
TORQUE = frozenset(("torque", "tau", "effort"))
OTHER_TORQUE = frozenset(("ext", "external", "gravity", "friction", "model", "limit", "max", "min", "error"))
MEASURED = frozenset(("est", "estimated", "meas", "measured", "actual", "act", "sensor"))
ACCELERATION = frozenset(("acc", "accel", "acceleration", "ddq", "qdd", "qacc"))
JOINED = re.compile(r"(q|dq|qd|tau|pos|vel)(cmd|des|ref|ff|est|meas)")  # a word of two: qcmd
BESIDE = ("ctrl_velocity", "ctrl_torque", "kp", "kd", "torque")  # what no recording needs, and few have
SPELLINGS = {
    **{"sec": "s", "secs": "s", "seconds": "s", "degree": "deg", "degrees": "deg", "radians": "rad", "nm": "N m"},
    **{"dps": "deg/s", "deg_s": "deg/s", "rad_s": "rad/s", "radps": "rad/s", "mm_s": "mm/s", "m_s": "m/s"},
    **{"volts": "V", "volt": "V", "amps": "A", "percent": "%", "pct": "%", "turns": "rev"},
    **{"c": "degC", "celsius": "degC"},
}
STEPS = ((0.5, "s"), (200.0, "ms"), (2e5, "us"), (math.inf, "ns"))  # below which median step, of logs at 5 Hz to 5 kHz
NEAR = 0.12  # of the logarithm of a ratio of two signals that still shows its units
ALIKE = 0.9  # correlation from which two signals are taken to be the same quantity
TURNS = 57.0  # rad: nine turns of a joint, or a full turn and a bit in degrees wrongly taken for radians


@dataclass(frozen=True)
class Proposal:
    """Which columns are which signals.

    Attributes:
        columns: Headers of each signal that was found.
        units: Unit of each signal that is not in SI units.
        reasons: Why, a sentence each.
        certain: Whether every name means its signal and nothing else, and no number speaks against SI units.
    """

    columns: Mapping[str, tuple[str, ...]]
    units: Mapping[str, str] = field(default_factory=dict)
    reasons: tuple[str, ...] = ()
    certain: bool = False

    def overrides(self) -> list[str]:
        """Options that say the same on the command line, quoted for a shell where that is needed."""
        columns = [
            f"data.columns.{signal}={_quote(headers[0]) if signal == 'time' else _list(headers)}"
            for signal, headers in self.columns.items()
        ]
        units = [f"data.units.{signal}={_quote(unit)}" for signal, unit in self.units.items()]
        return [_shell(option) for option in (*columns, *units)]


def propose(table: Table) -> Proposal:
    """A guess at the signals of a table, from names and from numbers."""
    for known in ({signal: signal for signal in SIGNALS}, BAM):
        if all(known[signal] in table.columns for signal in ("time", "qpos", "ctrl")):
            columns = {signal: (header,) for signal, header in known.items() if header in table.columns}
            columns = {signal: found for signal, found in columns.items() if _is_usable(table, signal, found)}
            units, reasons = _units(table, columns)
            reason = f"{', '.join(h for (h,) in columns.values())}: by their names"
            return Proposal(columns, units, (reason, *reasons), certain=not units)
    columns, named = _find(table)
    units, reasons = _units(table, columns)
    return Proposal(columns, units, (*named, *reasons))


def _find(table: Table) -> tuple[dict[str, tuple[str, ...]], list[str]]:
    """For each signal the headers that speak for it, and a sentence on them."""
    columns, reasons = {}, []
    families = _families(table)
    for signal in SIGNALS:
        found = families.get(signal)
        if found:
            best = min(found, key=lambda key: key[0])
            headers = tuple(found[best][:1] if signal == "time" else found[best])
            if signal in BESIDE and len(headers) not in (1, len(columns.get("qpos", ()))):
                continue
            columns[signal] = headers
            others = [headers[0] for key, headers in found.items() if key != best]
            also = f"; {', '.join(others)} could be as well" if others else ""
            reasons.append(f"{signal}: {', '.join(headers)}, by name{also}")
    own = table.times.get(columns.get("qpos", ("",))[0])
    return ({**columns, "time": (own,)} if own else columns), reasons


Families = dict[tuple[int, str], list[str]]
"""Headers that differ in the joint alone, by how plainly they speak of their signal, and what they have in common."""


def _families(table: Table) -> dict[str, Families]:
    """The headers that speak for each signal."""
    families: dict[str, Families] = {}
    joints = _find_joints(table)
    for header in sorted(table.columns, key=lambda header: joints.get(header, ("", 0))[1]):
        # Joints of one signal differ in their names, or in what stands in brackets, or in a number.
        stem = joints[header][0] if header in joints else re.sub(r"\[[^]]*\]|\d+", "#", header)
        if header not in table.times.values() and (role := _role(stem if header in joints else header)):
            signal, rank = role
            families.setdefault(signal, {}).setdefault((rank, stem), []).append(header)
    efforts = families.pop("effort", {})
    families |= {signal: _keep_usable(table, signal, families.get(signal, {})) for signal in ("kp", "kd")}
    if "ctrl" not in families:  # a drive that is told a velocity or a torque, or whose torque is what drives it
        commands = families.pop("ctrl_velocity", {}) | families.pop("ctrl_torque", {}) | efforts
        return families | ({"ctrl": commands} if commands else {})
    usable = {signal: _keep_usable(table, signal, families.get(signal, {})) for signal in BESIDE}
    usable["torque"] = _keep_usable(table, "torque", _pick_torque(efforts))
    return {**families, **usable}


def _keep_usable(table: Table, signal: str, found: Families) -> Families:
    return {key: headers for key, headers in found.items() if _is_usable(table, signal, headers)}


def _is_usable(table: Table, signal: str, headers: Sequence[str]) -> bool:
    """Whether a signal that no recording needs would not cost samples: of a torque, none may be missing."""
    finite = [np.isfinite(table.columns[header]) for header in headers]
    if signal not in BESIDE:
        return True
    # A gain that is said once, beside signals with samples, is none.
    sampled = all(len(of) > 1 for of in finite)
    return sampled and all(of.all() if signal == "torque" else of.any() for of in finite)


def _pick_torque(efforts: Families) -> Families:
    """What can only be the measured torque of the joints."""
    found = {key: headers for key, headers in efforts.items() if TORQUE & {*_words(key[1])}}
    found = {key: headers for key, headers in found.items() if not OTHER_TORQUE & {*_words(key[1])}}
    plain = {key: headers for key, headers in found.items() if MEASURED & {*_words(key[1])}}
    return found if len(found) == 1 else plain if len(plain) == 1 else {}


def _find_joints(table: Table) -> dict[str, tuple[str, int]]:
    """Of headers with a joint's name in them, what they have in common, and the joint's number in the order of qpos.

    Names are what is left of headers of positions, if headers of commands have the same: FL_hip of qpos_FL_hip and
    ctrl_FL_hip.
    """
    best: dict[str, tuple[str, int]] = {}
    for names in _candidates(table).values():
        shared = [_stems(table, name) for name in names]
        stems = set.intersection(*map(set, shared))
        told = {role[0] for role in map(_role, stems) if role}
        if told & {"ctrl", "ctrl_velocity", "ctrl_torque", "effort"} and len(names) > 1:
            found = {of[stem]: (stem, number) for number, of in enumerate(shared) for stem in stems}
            best = found if len(found) > len(best) else best
    return best


def _candidates(table: Table) -> dict[str, list[str]]:
    """What may be names of joints: what stands before or after the word of a position, by all else in the header."""
    names: dict[str, list[str]] = {}
    positions = dict(WORDS)["qpos"].split()
    for header in table.columns:
        role = _role(header)
        for word in re.finditer(r"[A-Za-z]+", header) if role and role[0] == "qpos" else ():
            if word.group().lower() in positions:
                for part in (header[: word.start()], header[word.end() :]):
                    name = part.strip("_ ./-")
                    if re.fullmatch(r"[\w.-]*[A-Za-z][\w.-]*", name):
                        names.setdefault(header.replace(name, "*", 1), []).append(name)
    return names


def _stems(table: Table, name: str) -> dict[str, str]:
    """The headers with this name in them, by what they are without it."""
    place = re.compile(rf"(?<![A-Za-z0-9]){re.escape(name)}(?![A-Za-z0-9])")
    return {place.sub("*", header, count=1): header for header in table.columns if place.search(header)}


def _words(header: str) -> list[str]:
    words = re.findall(r"[a-z]+", re.sub(r"([a-z])([A-Z])", r"\1_\2", header).lower())
    joined = {word: found.groups() for word in words if (found := JOINED.fullmatch(word))}
    return [part for word in words for part in joined.get(word, (word,))]


def _role(header: str) -> tuple[str, int] | None:
    """The signal of which a header speaks, and how plainly: the lower the number, the plainer."""
    words = _words(header)
    if not ACCELERATION.isdisjoint(words):
        return None
    for place, (signal, telling) in enumerate(WORDS):
        if set(words).isdisjoint(telling.split()) or (signal == "qpos" and not TORQUE.isdisjoint(words)):
            continue  # state.tau_est is no position
        signal = _commanded({*words}) if telling is COMMANDED else signal
        return (signal, 10 * place + len(words)) if signal else None
    return None


def _commanded(words: set[str]) -> str | None:
    """What a command is a command of; None where it is something that is fed forward, and what is not said."""
    if not words.isdisjoint(VELOCITY.split()):
        return "ctrl_velocity"
    if TORQUE & words:
        return "ctrl_torque"
    return None if words & {"ff", "feedforward"} else "ctrl"


@np.errstate(all="ignore")  # numbers as they come: what overflows or is infinite leaves no guess
def _units(table: Table, columns: Mapping[str, tuple[str, ...]]) -> tuple[dict[str, str], list[str]]:
    """Units by the headers, and by the numbers where these say nothing."""
    units, reasons = {}, []
    for signal, headers in columns.items():
        unit = _unit_of(signal, headers[0])
        if unit is not None and not table.units.get(headers[0]):
            units[signal] = unit
            reasons.append(f"{signal} in {unit}: its header {headers[0]} says so")
    for guess in (_guess_time, _guess_rate, _guess_turns, _guess_command, _guess_command_rate):
        for signal, unit, reason in guess(table, columns, units):
            units[signal] = unit
            reasons.append(f"{signal} in {unit}: {reason}")
    return {signal: unit for signal, unit in units.items() if _si(signal, unit) != 1}, reasons


def _unit_of(signal: str, header: str) -> str | None:
    """The unit that stands in a header, in brackets or at its end."""
    known = {name.replace(" ", "").lower(): name for name in UNITS[signal]}
    inside = re.findall(r"[\[(]([^\])]*)[\])]\s*$", header)
    parts = re.split(r"[_\s.]+", header.lower())
    for word in (*inside, "_".join(parts[-2:]), *(parts[-1:] if len(parts) > 1 else ())):
        word = SPELLINGS.get(word.strip().lower(), word.strip())
        name = known.get(word.replace(" ", "").replace("*", "").replace("·", "").lower())
        if name is not None and not name.isdigit():
            return name
    return None


Guess = list[tuple[str, str, str]]
Columns = Mapping[str, tuple[str, ...]]


def _guess_time(table: Table, columns: Columns, units: Mapping[str, str]) -> Guess:
    """The unit of time, by its steps."""
    if "time" not in columns or "time" in units or columns["time"][0] in table.units:
        return []
    steps = np.diff(table.columns[columns["time"][0]].astype(float))
    steps = steps[np.isfinite(steps) & (steps > 0)]
    if not len(steps):
        return []
    step = float(np.median(steps))
    unit = next((unit for limit, unit in STEPS if step < limit), STEPS[-1][1])
    return [] if unit == "s" else [("time", unit, f"its step is {step:g}")]


def _guess_rate(table: Table, columns: Columns, units: Mapping[str, str]) -> Guess:
    """The unit of position or velocity, by the ratio of the one's derivative to the other."""
    signals = _values(table, columns, ("time", "qpos", "qvel"))
    if signals is None or {"qpos", "qvel"} <= set(units) or columns["qpos"][0] in table.units:
        return []
    time, position, velocity = signals
    seconds = time * np.divide(*ratio("time", units.get("time") or table.units.get(columns["time"][0], "s")))
    moved = np.isfinite(seconds) & (np.diff(seconds, prepend=-math.inf) > 0)
    if moved.sum() < 3:
        return []
    size = _ratio(np.gradient(position[moved], seconds[moved]), velocity[moved])
    if size is None:
        return []
    distance, a, b = min(
        (abs(math.log(size / (_si("qvel", b) / _si("qpos", a)))), a, b)
        for a in ([units["qpos"]] if "qpos" in units else ["rad", "deg", "rev", "mm"])
        for b in ([units["qvel"]] if "qvel" in units else ["rad/s", "deg/s", "rpm", "mm/s"])
    )
    alike = abs(math.log(size)) < NEAR and not units.keys() & {"qpos", "qvel"}
    if distance > NEAR or alike:
        return []
    reason = f"the derivative of {columns['qpos'][0]} is {size:.3g} times {columns['qvel'][0]}"
    pairs = (("qpos", a), ("qvel", b))
    return [(signal, unit, reason) for signal, unit in pairs if signal not in units and _si(signal, unit) != 1]


def _guess_turns(table: Table, columns: Columns, units: Mapping[str, str]) -> Guess:
    """Degrees, where a position in radians would be many turns away."""
    if "qpos" not in columns or "qpos" in units or columns["qpos"][0] in table.units:
        return []
    largest = float(np.nanmax(np.abs(table.columns[columns["qpos"][0]]), initial=0.0))
    if not TURNS < largest < math.inf:
        return []
    rate = [("qvel", "deg/s", "as its position")] if "qvel" in columns and "qvel" not in units else []
    return [("qpos", "deg", f"it reaches {largest:.4g}, nine turns in radians"), *rate]


def _guess_command(table: Table, columns: Columns, units: Mapping[str, str]) -> Guess:
    """The unit of a command that the position follows."""
    return _guess_followed(table, columns, units, "qpos", "ctrl", ("rad", "deg"))


def _guess_command_rate(table: Table, columns: Columns, units: Mapping[str, str]) -> Guess:
    """The unit of a desired velocity that the velocity follows."""
    return _guess_followed(table, columns, units, "qvel", "ctrl_velocity", ("rad/s", "deg/s"))


def _guess_followed(
    table: Table, columns: Columns, units: Mapping[str, str], signal: str, told: str, possible: tuple[str, ...]
) -> Guess:
    """The unit of a command that a signal follows, by the ratio of the two."""
    if told in units or columns.get(told, ("",))[0] in table.units:
        return []
    signals = _values(table, columns, (signal, told))
    if signals is None:
        return []
    known = units.get(signal) or table.units.get(columns[signal][0], possible[0])
    size = _ratio(*signals, of_same=True)
    if size is None:
        return []
    distance, unit = min((abs(math.log(size * _si(signal, known) / _si(signal, u))), u) for u in possible)
    # A position that falls short of its command is no other unit, as one of 57 times less is.
    if distance > 10 * NEAR or _si(signal, unit) == 1:
        return []
    return [(told, unit, f"{columns[signal][0]} follows it at {size:.3g} times its size")]


def _values(table: Table, columns: Columns, signals: tuple[str, ...]) -> list[Signal] | None:
    """The first column of each signal, where all of them are there at the same times."""
    if not all(signal in columns for signal in signals):
        return None
    values = [table.columns[columns[signal][0]].astype(float) for signal in signals]
    return values if len({len(each) for each in values}) == 1 else None


def _ratio(first: Signal, second: Signal, of_same: bool = False) -> float | None:
    """By how much the first is larger than the second; None where they are not the same quantity."""
    fine = np.isfinite(first) & np.isfinite(second) & (np.abs(first) < 1e100) & (np.abs(second) < 1e100)
    if fine.sum() < 3 or not np.ptp(first[fine]) > 0 or not np.ptp(second[fine]) > 0:
        return None
    a, b = first[fine] - np.median(first[fine]), second[fine] - np.median(second[fine])
    products = float(a @ b), float(a @ a), float(b @ b)
    if min(products) <= 0 or products[0] < (ALIKE if of_same else 0.3) * math.sqrt(products[1] * products[2]):
        return None
    return products[0] / products[2]  # noise is in the first, the derivative


def _si(signal: str, unit: str) -> float:
    numerator, denominator = ratio(signal, unit)
    return numerator / denominator


def _quote(name: str) -> str:
    """A value of an option, in quotes where Hydra would read more into it."""
    return name if re.fullmatch(r"[A-Za-z_][\w/ -]*", name) else '"' + name.replace('"', '\\"') + '"'


def _list(headers: tuple[str, ...]) -> str:
    return f"[{','.join(_quote(header) for header in headers)}]"


def _shell(option: str) -> str:
    """An option as one word of a shell, which leaves brackets of words alone."""
    return option if re.fullmatch(r"[\w.=/,\[\]-]*", option) else shlex.quote(option)
