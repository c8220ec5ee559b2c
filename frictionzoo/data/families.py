"""Families of headers that name one signal, one header a joint, and the choice of one family a signal."""

import re
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from frictionzoo.core.errors import LogError
from frictionzoo.data.pairing import OF_DRIVES, Named, find_name, pair_signal
from frictionzoo.data.recording import SIGNALS, Table
from frictionzoo.data.words import MEASURED, POSITION, TORQUE, find_signal, list_words, split

OTHER_TORQUE = frozenset(("ext", "external", "gravity", "friction", "model", "limit", "max", "min", "error"))
BESIDE = ("ctrl_velocity", "ctrl_torque", "kp", "kd", "torque")  # optional signals that few recordings have

Families = dict[tuple[int, str], list[str]]
"""Headers that differ only in the joint, by rank (lower is clearer) and by stem, the common part of the headers."""


def find_columns(
    table: Table, joints: Sequence[str], said: Collection[str], passive: Collection[str] = ()
) -> dict[str, tuple[str, ...]]:
    """Find the headers of each signal, in the table's order; arguments as `propose`.

    Raises:
        LogError: As `propose`.
    """
    columns: dict[str, tuple[str, ...]] = {}
    names = {header: name for header in table.columns if (name := find_name(header, tuple(joints)))}
    families = _families(table, names)
    for signal in (signal for signal in SIGNALS if families.get(signal)):
        try:
            headers = tuple(_choose(table, signal, families[signal], names, joints, passive))
        except LogError:
            if signal in said:
                continue
            raise
        counts = {1, len(joints) or len(columns.get("qpos", ())), len(joints) - len(passive)}
        if signal not in BESIDE or len(headers) in counts:
            columns[signal] = headers
    time_header = table.times.get(columns.get("qpos", ("",))[0])
    return {**columns, "time": (time_header,)} if time_header else columns


def _choose(
    table: Table,
    signal: str,
    found: Families,
    names: Mapping[str, Named],
    joints: Sequence[str],
    passive: Collection[str],
) -> Sequence[str]:
    """Return a signal's headers: those with joint names if there are any, otherwise the family of lowest rank."""
    best = found[min(found, key=lambda key: key[0])]
    if signal == "time" or best[0] not in names:
        return best[:1] if signal == "time" else best
    numbers = list(range(len(joints)))
    driven = [number for number in numbers if signal not in OF_DRIVES or joints[number] not in passive]
    complete = [
        headers for headers in found.values() if sorted(names[header].joint for header in headers) in (numbers, driven)
    ]
    if len(complete) == 1 or (best in complete and any(table.signals.get(header) for header in best)):
        return best if best in complete else complete[0]
    all_headers = sorted((header for headers in found.values() for header in headers), key=list(table.columns).index)
    pair_signal(table.name, signal, all_headers, joints, passive)
    return all_headers


def _families(table: Table, names: Mapping[str, Named]) -> dict[str, Families]:
    families: dict[str, Families] = {}
    joints = {} if names else _find_joints(table)
    for header in sorted(table.columns, key=lambda header: joints.get(header, ("", 0))[1]):
        if header in names:
            stem, words = names[header].stem, names[header].words
        elif header in joints:
            stem, words = joints[header][0], list_words(split(joints[header][0]))
        else:  # joints differ in the text in brackets, or in a number
            stem, words = re.sub(r"\[[^]]*\]|\d+", "#", header), list_words(split(header))
        specified = table.signals.get(header)
        role = find_signal(words) if specified is None else (specified, 0)
        if header not in table.times.values() and role and role[0]:
            signal, rank = role
            families.setdefault(signal, {}).setdefault((rank, stem), []).append(header)
    families = {signal: _prefer_named(found, names) for signal, found in families.items()}
    efforts = families.pop("effort", {})
    families |= {signal: _keep_usable(table, signal, families.get(signal, {})) for signal in ("kp", "kd")}
    if "ctrl" not in families:  # a drive with a velocity or torque command, or a torque as the only input
        commands = families.pop("ctrl_velocity", {}) | families.pop("ctrl_torque", {}) | efforts
        return families | ({"ctrl": _prefer_named(commands, names)} if commands else {})
    usable = {signal: _keep_usable(table, signal, families.get(signal, {})) for signal in BESIDE}
    usable["torque"] = _keep_usable(table, "torque", _pick_torque(efforts))
    # The drive does not follow a constant command.
    commands = families["ctrl"].items()
    moving = {key: headers for key, headers in commands if any(_moves(table.columns[header]) for header in headers)}
    return {**families, "ctrl": moving or families["ctrl"], **usable}


def _prefer_named(found: Families, names: Mapping[str, Named]) -> Families:
    """Return the families with joint names, or all if none has: those without belong to other joints."""
    return {key: headers for key, headers in found.items() if headers[0] in names} or found


def _moves(values: np.ndarray) -> bool:
    finite = values[np.isfinite(values)]
    return len(finite) > 0 and bool((finite != finite[0]).any())


def _keep_usable(table: Table, signal: str, found: Families) -> Families:
    return {key: headers for key, headers in found.items() if is_usable(table, signal, headers)}


def is_usable(table: Table, signal: str, headers: Sequence[str]) -> bool:
    """Return whether an optional signal has samples; a torque must be complete, or cleaning would drop samples."""
    if signal not in BESIDE:
        return True
    finite = [np.isfinite(table.columns[header]) for header in headers]
    # A single value is not a sampled gain.
    return all(len(each) > 1 and bool(each.all() if signal == "torque" else each.any()) for each in finite)


def _pick_torque(efforts: Families) -> Families:
    """Return the family that is certainly the measured joint torque; empty in case of doubt."""
    words = {key: {*list_words(split(key[1]))} for key in efforts}
    likely = {key: headers for key, headers in efforts.items() if TORQUE & words[key] and not OTHER_TORQUE & words[key]}
    measured = {key: headers for key, headers in likely.items() if MEASURED & words[key]}
    return likely if len(likely) == 1 else measured if len(measured) == 1 else {}


def _find_joints(table: Table) -> dict[str, tuple[str, int]]:
    """Return the stem of headers with a joint's name, and the joint's number in the order of qpos.

    A joint's name is the part that position and command headers share: FL_hip in qpos_FL_hip and ctrl_FL_hip.
    """
    best: dict[str, tuple[str, int]] = {}
    for names in _candidates(table).values():
        shared = [_stems(table, name) for name in names]
        stems = set.intersection(*map(set, shared))
        signals = {role[0] for role in map(_find_role, stems) if role}
        if signals & {"ctrl", "ctrl_velocity", "ctrl_torque", "effort"} and len(names) > 1:
            named = {headers[stem]: (stem, number) for number, headers in enumerate(shared) for stem in stems}
            best = named if len(named) > len(best) else best
    return best


def _candidates(table: Table) -> dict[str, list[str]]:
    """Return possible joint names, the text before or after a position word, by the rest of the header."""
    names: dict[str, list[str]] = {}
    positions = POSITION.split()
    for header in table.columns:
        role = _find_role(header)
        for word in re.finditer(r"[A-Za-z]+", header) if role and role[0] == "qpos" else ():
            if word.group().lower() in positions:
                for part in (header[: word.start()], header[word.end() :]):
                    name = part.strip("_ ./-")
                    if re.fullmatch(r"[\w.-]*[A-Za-z][\w.-]*", name):
                        names.setdefault(header.replace(name, "*", 1), []).append(name)
    return names


def _stems(table: Table, name: str) -> dict[str, str]:
    place = re.compile(rf"(?<![A-Za-z0-9]){re.escape(name)}(?![A-Za-z0-9])")
    return {place.sub("*", header, count=1): header for header in table.columns if place.search(header)}


def _find_role(header: str) -> tuple[str, int] | None:
    return find_signal(list_words(split(header)))
