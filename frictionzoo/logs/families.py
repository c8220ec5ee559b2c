"""Headers that speak of the same signal, one a joint, and which of them are taken for it."""

import re
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from frictionzoo.core.errors import LogError
from frictionzoo.logs.pairing import Named, find_name, pair
from frictionzoo.logs.recording import SIGNALS, Table
from frictionzoo.logs.words import MEASURED, POSITION, TORQUE, find_signal, list_words, split

OTHER_TORQUE = frozenset(("ext", "external", "gravity", "friction", "model", "limit", "max", "min", "error"))
BESIDE = ("ctrl_velocity", "ctrl_torque", "kp", "kd", "torque")  # what no recording needs, and few have

Families = dict[tuple[int, str], list[str]]
"""Headers that differ in the joint alone, by how plainly they speak of their signal, and what they have in common."""


def find_columns(
    table: Table, joints: Sequence[str], said: Collection[str]
) -> tuple[dict[str, tuple[str, ...]], list[str]]:
    """Find the headers of each signal, in the table's order, and a sentence on each.

    Args:
        table: What a file holds.
        joints: Names of the joints whose columns are wanted; none where they are not known.
        said: Signals of which a user said the columns.

    Raises:
        LogError: Headers of another signal name some of the joints and not all, or one of them twice.
    """
    columns, reasons = {}, []
    names = {header: name for header in table.columns if (name := find_name(header, tuple(joints)))}
    families = _families(table, names)
    for signal in SIGNALS:
        found = families.get(signal)
        if found:
            try:
                headers = tuple(_choose(table, signal, found, names, joints))
            except LogError:
                if signal in said:
                    continue
                raise
            if signal in BESIDE and len(headers) not in (1, len(joints) or len(columns.get("qpos", ()))):
                continue
            columns[signal] = headers
            others = [other[0] for other in found.values() if not {*other} & {*headers}]
            also = f"; also possible: {', '.join(others)}" if others else ""
            reasons.append(f"{signal}: {', '.join(headers)}, by name{also}")
    own = table.times.get(columns.get("qpos", ("",))[0])
    return ({**columns, "time": (own,)} if own else columns), reasons


def _choose(
    table: Table, signal: str, found: Families, names: Mapping[str, Named], joints: Sequence[str]
) -> Sequence[str]:
    """The headers of a signal: those with the joints' names where there are any, else the plainest."""
    best = found[min(found, key=lambda key: key[0])]
    if signal == "time" or best[0] not in names:
        return best[:1] if signal == "time" else best
    everyone = list(range(len(joints)))
    complete = [headers for headers in found.values() if sorted(names[header].joint for header in headers) == everyone]
    if len(complete) == 1:
        return complete[0]
    every = sorted((header for headers in found.values() for header in headers), key=list(table.columns).index)
    try:
        pair(every, joints)
    except LogError as error:
        option = f"data.columns.{signal}"
        needed = "" if signal in ("qpos", "ctrl") else f", to [] to omit {signal}"
        raise LogError(f"{table.name}: {signal} {error}; set {option} to the columns{needed}") from None
    return every


def _families(table: Table, names: Mapping[str, Named]) -> dict[str, Families]:
    """The headers that speak for each signal."""
    families: dict[str, Families] = {}
    joints = {} if names else _find_joints(table)
    for header in sorted(table.columns, key=lambda header: joints.get(header, ("", 0))[1]):
        if header in names:
            stem, words = names[header].stem, names[header].words
        elif header in joints:
            stem, words = joints[header][0], list_words(split(joints[header][0]))
        else:  # joints differ in what stands in brackets, or in a number
            stem, words = re.sub(r"\[[^]]*\]|\d+", "#", header), list_words(split(header))
        if header not in table.times.values() and (role := find_signal(words)):
            signal, rank = role
            families.setdefault(signal, {}).setdefault((rank, stem), []).append(header)
    families = {signal: _prefer_named(found, names) for signal, found in families.items()}
    efforts = families.pop("effort", {})
    families |= {signal: _keep_usable(table, signal, families.get(signal, {})) for signal in ("kp", "kd")}
    if "ctrl" not in families:  # a drive that is told a velocity or a torque, or whose torque is what drives it
        commands = families.pop("ctrl_velocity", {}) | families.pop("ctrl_torque", {}) | efforts
        return families | ({"ctrl": commands} if commands else {})
    usable = {signal: _keep_usable(table, signal, families.get(signal, {})) for signal in BESIDE}
    usable["torque"] = _keep_usable(table, "torque", _pick_torque(efforts))
    return {**families, "ctrl": _prefer_moving(table, families["ctrl"]), **usable}


def _prefer_named(found: Families, names: Mapping[str, Named]) -> Families:
    """Headers with joints' names, where any have them: others are of other joints."""
    return {key: headers for key, headers in found.items() if headers[0] in names} or found


def _prefer_moving(table: Table, found: Families) -> Families:
    """Commands that change, where any do: one that never changes is not what the drive follows."""
    moving = {key: headers for key, headers in found.items() if any(_moves(table.columns[h]) for h in headers)}
    return moving or found


def _moves(values: np.ndarray) -> bool:
    finite = values[np.isfinite(values)]
    return len(finite) > 0 and bool((finite != finite[0]).any())


def _keep_usable(table: Table, signal: str, found: Families) -> Families:
    return {key: headers for key, headers in found.items() if is_usable(table, signal, headers)}


def is_usable(table: Table, signal: str, headers: Sequence[str]) -> bool:
    """Return whether a signal that no recording needs would not cost samples: of a torque, none may be missing."""
    finite = [np.isfinite(table.columns[header]) for header in headers]
    if signal not in BESIDE:
        return True
    # A gain that is said once, beside signals with samples, is none.
    sampled = all(len(of) > 1 for of in finite)
    return sampled and all(of.all() if signal == "torque" else of.any() for of in finite)


def _pick_torque(efforts: Families) -> Families:
    """What can only be the measured torque of the joints."""
    words = {key: {*list_words(split(key[1]))} for key in efforts}
    found = {key: headers for key, headers in efforts.items() if TORQUE & words[key] and not OTHER_TORQUE & words[key]}
    plain = {key: headers for key, headers in found.items() if MEASURED & words[key]}
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
        told = {role[0] for role in map(_find_role, stems) if role}
        if told & {"ctrl", "ctrl_velocity", "ctrl_torque", "effort"} and len(names) > 1:
            found = {of[stem]: (stem, number) for number, of in enumerate(shared) for stem in stems}
            best = found if len(found) > len(best) else best
    return best


def _candidates(table: Table) -> dict[str, list[str]]:
    """What may be names of joints: what stands before or after the word of a position, by all else in the header."""
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
    """The headers with this name in them, by what they are without it."""
    place = re.compile(rf"(?<![A-Za-z0-9]){re.escape(name)}(?![A-Za-z0-9])")
    return {place.sub("*", header, count=1): header for header in table.columns if place.search(header)}


def _find_role(header: str) -> tuple[str, int] | None:
    return find_signal(list_words(split(header)))
