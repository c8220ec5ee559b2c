"""Matching of columns to joints: by names in the headers, otherwise by position."""

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from frictionzoo.core.errors import LogError
from frictionzoo.core.log import Columns, Log
from frictionzoo.data.recording import COMMANDS, Recording
from frictionzoo.data.words import GENERIC, KNOWN, list_words, split

MOST_LISTED = 24  # headers listed in a message
OF_DRIVES = (*COMMANDS, "torque")
"""Signals that joints without a drive may lack."""

By = Literal["name", "listed", "place"]


class Named(NamedTuple):
    """Header that names a joint: its other words, and its stem with `*` for the joint's name, equal for one signal."""

    joint: int
    words: tuple[str, ...]
    stem: str


class Pairing(NamedTuple):
    """Columns of one signal in the joints' order, -1 for a passive joint without it, and how they were matched."""

    order: tuple[int, ...]
    by: By


def arrange(
    name: str, columns: Mapping[str, Columns], joints: Sequence[str], passive: Collection[str] = ()
) -> dict[str, Pairing]:
    """Match the columns of all signals of one recording to the joints; `name` is the recording's, for messages.

    Headers that a user listed are matched by name if they name each joint once; otherwise they keep the listed order.
    The signals in `OF_DRIVES` may lack the `passive` joints.

    Raises:
        LogError: As `pair`; or one signal has no joint names and another names the joints in another order.
    """
    pairings = {signal: _arrange(name, signal, origin, joints, passive) for signal, origin in columns.items()}
    reordered = [s for s, pairing in pairings.items() if not columns[s].listed and _moves(columns[s], pairing)]
    by_place = [s for s, (order, by) in pairings.items() if by == "place" and sum(place >= 0 for place in order) > 1]
    if reordered and by_place:
        raise LogError(
            f"{name}: {by_place[0]} has columns without names, {_list(columns[by_place[0]].headers)}, and those of "
            f"{reordered[0]} name joints in another order than the model, {_list(columns[reordered[0]].headers)}; set "
            f"data.columns.{by_place[0]} to one column a joint, in the order {_list(joints)}"
        )
    return pairings


def _arrange(name: str, signal: str, of: Columns, joints: Sequence[str], passive: Collection[str]) -> Pairing:
    recorded = [place for place, header in enumerate(of.headers) if header]  # paired columns may lack passive joints
    as_listed = Pairing(lay_out(signal, recorded, joints, passive) or tuple(recorded), "listed")
    if of.listed and all(map(str.isdecimal, of.headers)):  # columns without headers, by number
        return as_listed
    try:
        pairing = pair_signal(name, signal, [of.headers[place] for place in recorded], joints, passive)
    except LogError:
        if of.listed:
            return as_listed
        raise
    if of.listed and pairing.by != "name":
        return as_listed
    return Pairing(tuple(recorded[place] if place >= 0 else -1 for place in pairing.order), pairing.by)


def lay_out(
    signal: str, places: Sequence[int], joints: Sequence[str], passive: Collection[str]
) -> tuple[int, ...] | None:
    """Return the column of each joint for a signal with one for each joint that is not passive; None for others.

    `places` are its columns in the order of the joints.
    """
    driven = [joint not in passive for joint in joints]
    if signal not in OF_DRIVES or all(driven) or len(places) != sum(driven):
        return None
    remaining = iter(places)
    return tuple(next(remaining) if is_driven else -1 for is_driven in driven)


def in_order(values: Float[np.ndarray, "time columns"], order: Sequence[int]) -> Float[np.ndarray, "time nv"]:
    """Return the columns of a signal in the order of a `Pairing`, 0 where there is none."""
    return np.where(np.array(order) < 0, 0.0, values[:, list(order)]) if -1 in order else values[:, list(order)]


def pair_signal(
    name: str, signal: str, headers: Sequence[str], joints: Sequence[str], passive: Collection[str] = ()
) -> Pairing:
    """Match the headers of a signal as `pair`, with the recording's name and an advice in the error."""
    try:
        return pair(headers, joints, passive if signal in OF_DRIVES else ())
    except LogError as error:
        needed = "" if signal in ("qpos", "ctrl") else f", to [] to omit {signal}"
        raise LogError(f"{name}: {signal} {error}; set data.columns.{signal} to the columns{needed}") from None


def reorder(columns: Mapping[str, Columns], found: Mapping[str, Pairing]) -> dict[str, Columns]:
    """Return the columns in the order from `arrange`."""
    return {
        signal: Columns(
            tuple(columns[signal].headers[place] if place >= 0 else "" for place in order), columns[signal].listed, by
        )
        for signal, (order, by) in found.items()
    }


def say_order(columns: Mapping[str, Columns], found: Mapping[str, Pairing]) -> list[str]:
    """Return sentences on signals that `arrange` orders the first time, unless headers simply name the joints."""
    new = {signal: pairing for signal, pairing in found.items() if not columns[signal].by and len(pairing.order) > 1}
    moved = [signal for signal, found in new.items() if columns[signal].listed and _moves(columns[signal], found)]
    signals = {
        "have no joints' names; taken by position in the joints' order": [s for s, p in new.items() if p.by == "place"],
        "do not name the joints; taken in the order of data.columns": [s for s, p in new.items() if p.by == "listed"],
        "name the joints; taken by name, not in the order of data.columns": moved,
    }
    return [f"columns of {', '.join(named)} {what}" for what, named in signals.items() if named]


def arrange_recording(
    recording: Recording, joints: Sequence[str], passive: Collection[str] = ()
) -> tuple[Recording, list[str]]:
    """Return a recording with its columns in the order of the joints, and the sentences of `say_order`.

    Raises:
        LogError: As `arrange`.
    """
    pairings = arrange(recording.name, recording.columns, joints, passive)
    signals = {signal: in_order(recording.signals[signal], order) for signal, (order, _) in pairings.items()}
    ordered = replace(recording, signals=signals, columns=reorder(recording.columns, pairings))
    return ordered, say_order(recording.columns, pairings)


def describe_columns(carriers: Sequence[Log] | Sequence[Recording], joints: Sequence[str]) -> list[dict[str, Any]]:
    """Return the columns of each joint, ready for JSON; logs or recordings with the same columns share one entry.

    Carriers without columns in the order of the joints are skipped.
    """
    names: dict[tuple[tuple[str, Columns], ...], list[str]] = {}
    for item in carriers:
        origins = item.columns.values()
        if origins and all(origin.by and len(origin.headers) in (1, len(joints)) for origin in origins):
            names.setdefault(tuple(item.columns.items()), []).append(item.name)
    return [
        {
            "logs": log_names,
            "by": {signal: origin.by for signal, origin in columns},
            "joints": [{"joint": joint, "columns": _pick(columns, place)} for place, joint in enumerate(joints)],
        }
        for columns, log_names in names.items()
    ]


def _pick(columns: Sequence[tuple[str, Columns]], joint: int) -> dict[str, str]:
    """Return each signal's header for one joint; a single column serves all joints, and "" is none."""
    headers = {signal: origin.headers[joint if len(origin.headers) > 1 else 0] for signal, origin in columns}
    return {signal: header for signal, header in headers.items() if header}


def _moves(of: Columns, pairing: Pairing) -> bool:
    """Return whether matching by name reorders columns or leaves some out."""
    recorded = [place for place, header in enumerate(of.headers) if header]
    return pairing.by == "name" and [place for place in pairing.order if place >= 0] != recorded


def pair(headers: Sequence[str], joints: Sequence[str], optional: Collection[str] = ()) -> Pairing:
    """Match the headers of one signal to the joints.

    A header names a joint if it contains the joint's name as whole words. Case, separators and words such as `joint` do
    not count. A prefix or suffix that all joint names share may be missing if all other words of the header are known.
    Headers of other joints are left out. Headers that differ only in one number are matched by position, unless the
    joints' names differ in the same numbers. The `optional` joints may have no header.

    Raises:
        LogError: Only some joints are named, two headers name one joint, or the headers contain names of no joint. The
            message lists them and continues a sentence that begins with the signal's name.
    """
    named = {place: match.joint for place, header in enumerate(headers) if (match := find_name(header, tuple(joints)))}
    if not named:
        driven = [joint for joint in joints if joint not in optional]
        if len(headers) != len(driven) or len(driven) == len(joints):
            return _pair_numbers(headers, joints)
        order, by = _pair_numbers(headers, driven)
        return Pairing(tuple(order[driven.index(joint)] if joint in driven else -1 for joint in joints), by)
    counts = Counter(named.values())
    lacking = [joint for number, joint in enumerate(joints) if number not in counts]
    if max(counts.values()) == 1 and all(joint in optional for joint in lacking):
        places = {joint: place for place, joint in named.items()}
        return Pairing(tuple(places.get(joint, -1) for joint in range(len(joints))), "name")
    found = [[headers[place] for place, joint in named.items() if joint == number] for number in range(len(joints))]
    pairs = [f"{joint} <- {_list(columns) or 'none'}" for joint, columns in zip(joints, found, strict=True)]
    raise LogError(
        f"has columns for {len(counts)} of {len(joints)} joints, {_list(pairs)}; expected one column for each joint"
    )


def _pair_numbers(headers: Sequence[str], joints: Sequence[str]) -> Pairing:
    """Match headers without joint names: a single one, or several that differ only in a number."""
    in_order = Pairing(tuple(range(len(headers))), "place")
    if len(headers) == 1:
        return in_order
    if has_names(headers):
        raise LogError(
            f"has columns with names, {_list(headers)}, and none is a joint's ({_list(joints)}); expected the joints' "
            "names"
        )
    numbers, joint_numbers = _find_numbers(headers), _find_numbers(joints)
    if numbers is None:
        return in_order
    if joint_numbers is not None and {*numbers} == {*joint_numbers}:
        return Pairing(tuple(numbers.index(number) for number in joint_numbers), "name")
    if joint_numbers is not None and list(joint_numbers) != sorted(joint_numbers):
        raise LogError(
            f"has columns with numbers, {_list(headers)}, other than those of the joints ({_list(joints)}), which do "
            "not increase; expected the joints' names"
        )
    return Pairing(tuple(sorted(range(len(numbers)), key=numbers.__getitem__)), "place")


def label(headers: Sequence[str]) -> tuple[str, ...]:
    """Return names for unknown joints: headers without signal words, or numbers from 1 if these are no names."""
    names = []
    for header in headers:
        words = [
            word
            for word in re.finditer(r"[^\W\d_]+|\d+", header)
            if word.group().isdecimal() or not KNOWN.issuperset(list_words(split(word.group())))
        ]
        names.append(header[words[0].start() : words[-1].end()] if words else "")
    if not has_names(headers) or not all(names) or len({*names}) < len(names):
        return tuple(str(number) for number in range(1, len(headers) + 1))
    return tuple(names)


def has_names(headers: Sequence[str]) -> bool:
    """Return whether headers differ in more than numbers."""
    return len({tuple("#" if part.isdecimal() else part for part in split(header)) for header in headers}) > 1


def _find_numbers(names: Sequence[str]) -> tuple[int, ...] | None:
    """Return the only number in which the names differ; None if they differ otherwise."""
    parts = [split(name) for name in names]
    if len(parts) < 2 or has_names(names):
        return None
    varying = [column for column in zip(*parts, strict=True) if len({*column}) > 1]
    if len(varying) != 1 or len({*varying[0]}) < len(names):
        return None
    return tuple(map(int, varying[0]))


def find_name(header: str, joints: tuple[str, ...]) -> Named | None:
    """Find the joint that a header names; the longest match wins. None if no joint matches or two match equally."""
    parts, forms = split(header), _list_forms(joints)
    longest = max(map(len, forms), default=0)
    matches: list[tuple[int, int, int, int]] = []
    for begin in range(len(parts)):
        text = ""
        for end in range(begin + 1, len(parts) + 1):
            text += _join(parts[end - 1 : end])
            if len(text) > longest:
                break
            for joint, is_bare in forms.get(text, {}).items():
                rest = list_words((*parts[:begin], *parts[end:]))
                if not is_bare or KNOWN.issuperset(rest):
                    matches.append((len(text), joint, begin, end))
    best = [match for match in matches if match[0] == max(matches)[0]]
    if len({joint for _, joint, *_ in best}) != 1:
        return None
    _, joint, begin, end = best[-1]
    rest = list_words((*parts[:begin], *parts[end:])) or list_words(parts)
    return Named(joint, tuple(rest), " ".join((*parts[:begin], "*", *parts[end:])))


@cache
def _list_forms(joints: tuple[str, ...]) -> dict[str, dict[int, bool]]:
    """Return short and full forms of joint names; True marks a form that needs a header of otherwise known words.

    Forms that two joints share are left out, and numbers that are not a whole name.
    """
    full = [split(name) for name in joints]
    short = [[part for part in parts if part not in GENERIC] for parts in full]
    prefix = _count_shared(short)
    suffix = _count_shared([parts[prefix:][::-1] for parts in short])
    bare = [parts[prefix : len(parts) - suffix] for parts in short]
    forms_by_text: dict[str, dict[int, bool]] = {}
    for forms, is_bare in ((full, False), (short, False), (bare, True)):
        texts = [_join(parts) for parts in forms]
        counts = Counter(texts)
        for joint, text in enumerate(texts):
            is_number = all(part.isdecimal() for part in forms[joint]) and forms[joint] != full[joint]
            if text and counts[text] == 1 and not is_number:
                forms_by_text.setdefault(text, {}).setdefault(joint, is_bare)
    return forms_by_text


def _count_shared(names: Sequence[Sequence[str]]) -> int:
    """Count the leading parts that all names share, but leave each name one part."""
    count = 0
    while len(names) > 1 and all(len(parts) > count + 1 for parts in names) and len({p[count] for p in names}) == 1:
        count += 1
    return count


def _join(parts: Sequence[str]) -> str:
    return "".join(f"<{part}>" if part.isdecimal() else part for part in parts)


def _list(names: Sequence[str]) -> str:
    rest = f" and {len(names) - MOST_LISTED} more" if len(names) > MOST_LISTED else ""
    return ", ".join(names[:MOST_LISTED]) + rest
