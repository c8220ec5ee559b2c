"""Findings in a data set: problems and passed checks, with the option that solves each problem."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from frictionzoo.core.log import JITTER
from frictionzoo.core.telling import say_percent
from frictionzoo.data.units import ONE_WAY, SLOW_JOINT, WHOLE_RANGE
from frictionzoo.diagnostics.findings import Finding

SAME = 1e-3  # relative difference of sample intervals above which recordings cannot be fitted together
UNITS = 0.1  # relative difference of measured velocity and derivative above which their units are suspect
VOLTS = 0.05  # relative difference of measured and stated supply above which it is reported
SLOW = 0.5  # share of slow samples above which it is reported
RESTING = 0.5  # share of samples at rest above which it is reported
ONE_SIDED = 0.05  # share of samples in one direction below which the motion counts as one-sided
SATURATED = 0.05  # share of samples at an end of the command's range above which it is reported
TURNS = 20.0  # range of positions above which they may be degrees [rad]
DEGREES = "data.units.qpos=deg"
SURE = 0.003  # lower quartile of a delay below which it is not distinguishable from 0 [s]

OF_JOINT = ", joint "  # between check and joint in a title
SEVERITY = ("bad", "caution", "note", "good")
_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")

FAULTS = {  # faults of clock and samples: singular, plural
    "duplicates": ("repeated sample", "repeated samples"),
    "missing": ("missing sample", "missing samples"),
    "gaps": ("gap", "gaps"),
    "resets": ("reset of the clock", "resets of the clock"),
    "lost": ("sample with NaN", "samples with NaN"),
}


def list_findings(survey: Mapping[str, Any], stated: bool = False) -> Iterator[Finding]:
    """Yield problems and passed checks of a survey without findings.

    `stated` is whether the unit of the positions was stated, so that they raise no doubt about it.
    """
    yield _check_origin(survey["data"])
    yield _check_clock(survey["timing"])
    yield _check_completeness(survey["timing"])
    for part, check in (("joints", _check_joint), ("commands", _check_command)):
        for entry in survey[part]:
            which = f"{OF_JOINT}{entry['name']}" if len(survey[part]) > 1 else ""
            findings = [finding for finding in check(entry, survey) if not (stated and finding.option == DEGREES)]
            yield from (replace(finding, title=f"{finding.title}{which}") for finding in findings)
    if survey["supply"] is not None:
        yield from _check_supply(survey["supply"], survey["data"]["recordings"])
    enabled = survey["enabled"]
    if enabled is not None and enabled["low"] < 1:
        text = f"The drive is off for up to {100 * (1 - enabled['low']):.0f} % of a recording: the bench's actuator "
        yield Finding("note", "Drive off", f"{text}needs the input enable.")


def split_title(title: str) -> tuple[str, str]:
    """Return check and joint of a title; the joint is empty for all joints together."""
    check, _, joint = title.partition(OF_JOINT)
    return check, joint


def merge_findings(survey: Mapping[str, Any]) -> list[Finding]:
    """Return the findings of a survey, the most severe first; findings that joints share become one.

    Its title has the joints, and its text the range of each number that differs between them.
    """
    groups: dict[tuple[str, ...], dict[str, Finding]] = {}
    for entry in survey["findings"]:
        check, joint = split_title(entry["title"])
        key = entry["state"], check, _NUMBER.sub("0", entry["text"]), entry["option"] or ""
        groups.setdefault(key, {})[joint] = Finding(**entry)
    names, merged = [joint["name"] for joint in survey["joints"]], list[Finding]()
    for (_, check, *_), findings in groups.items():
        first, text = next(iter(findings.values())), _merge_texts([finding.text for finding in findings.values()])
        merged.append(replace(first, title=f"{check}{_say_joints([*findings], names)}", text=text))
    return sorted(merged, key=lambda finding: SEVERITY.index(finding.state))


def _say_joints(joints: Sequence[str], names: Sequence[str]) -> str:
    """Return the end of a title that is shared by these of all joints."""
    others = [name for name in names if name not in joints]
    if len(joints) == 1:
        return f"{OF_JOINT}{joints[0]}" if joints[0] else ""
    if len(others) > len(names) / 2 or not {*joints} <= {*names}:
        return f", joints {', '.join(joints)}"
    return f", all joints except {', '.join(others)}" if others else ", all joints"


def _merge_texts(texts: Sequence[str]) -> str:
    """Merge texts that differ only in numbers."""
    columns = (sorted(column, key=float) for column in zip(*map(_NUMBER.findall, texts), strict=True))
    spans = (column[0] if column[0] == column[-1] else f"{column[0]} to {column[-1]}" for column in columns)
    return _NUMBER.sub(lambda _: next(spans), texts[0])


def _check_joint(joint: Mapping[str, Any], survey: Mapping[str, Any]) -> Iterator[Finding]:
    interval, units = survey["timing"]["interval"]["median"], survey["units"]
    yield _check_spikes(joint, survey["data"]["recordings"])
    yield _check_resolution(joint, interval, units["position"])
    yield from _check_wrap(joint)
    yield from _check_units(joint)
    yield _check_lag(joint, interval)
    yield _check_delay(joint["delay"])
    yield from _check_motion(joint, units["velocity"])


def _check_origin(data: Mapping[str, Any]) -> Finding:
    if data["origin"] == "simulated":
        return Finding("note", "Simulated data", "The data are simulated, not from hardware.")
    if data["origin"] == "hardware":
        return Finding("good", "Hardware data", "Recorded on hardware, according to data.origin.")
    text = "Your recordings. data.origin does not state whether they come from hardware."
    return Finding("note", "Origin", text, "data.origin=hardware")


def _check_clock(timing: Mapping[str, Any]) -> Finding:
    interval, jitter = timing["interval"], timing["jitter"]
    low, median, high = (1e3 * interval[key] for key in ("low", "median", "high"))
    differ = high / low - 1 > SAME
    if not jitter["high"] and not differ:
        return Finding("good", "Clock", f"All intervals are {median:.4g} ms, within {100 * JITTER:g} %.")
    text = ""
    if jitter["high"]:
        text = f"{say_percent(jitter['median'])} of a recording's intervals (median) differ by more than "
        text += f"{100 * JITTER:g} % from the median interval, by up to {100 * timing['worst']['high']:.0f} %. "
    if differ:
        text += f"Median intervals range from {low:.4g} to {high:.4g} ms; one fit needs the same interval. "
    step = float(f"{interval['median']:.2g}")  # rounded as a user would write it
    return Finding("caution", "Clock", f"{text}Resample them.", f"data.clean.step={step:g}")


def _check_completeness(timing: Mapping[str, Any]) -> Finding:
    counts = [f"{timing[key]} {FAULTS[key][timing[key] > 1]}" for key in FAULTS if timing[key]]
    if not counts:
        return Finding("good", "Completeness", "No gaps, and no missing, repeated or NaN samples.")
    text = f"Found: {', '.join(counts)}. Cleaning drops repeated samples, interpolates short gaps and splits at long "
    broken = timing["gaps"] or timing["resets"] or timing["lost"]
    return Finding("caution" if broken else "note", "Completeness", f"{text}gaps; data.clean.gap sets the limit.")


def _check_spikes(joint: Mapping[str, Any], recordings: int) -> Finding:
    if not joint["spikes"]:
        return Finding("good", "Spikes", "No isolated spike in the position.")
    text = f"{joint['spiky']} of {recordings} recordings contain isolated spikes in the position, "
    text += f"{joint['spikes']} in total. Repair them, or drop these recordings with data.clean.spikes=drop."
    return Finding("caution", "Spikes", text, "data.clean.spikes=repair")


def _check_resolution(joint: Mapping[str, Any], interval: float, unit: str) -> Finding:
    quantum = joint["position_quantum"]
    if quantum is None:
        return Finding("good", "Resolution", "No encoder steps are visible in the position.")
    speed = quantum["median"] / interval
    top = max(map(abs, joint["velocity"]))
    text = f"The position moves in steps of {quantum['median']:.3g} {unit}: one step per sample is {speed:.2g} "
    text += f"per second, {say_percent(speed / max(top, 1e-12))} of the top speed."
    text += " Use long segments (segments.length)." if speed > 0.1 * top else ""
    return Finding("note" if speed > 0.01 * top else "good", "Resolution", text)


def _check_wrap(joint: Mapping[str, Any]) -> Iterator[Finding]:
    wrap = joint["wrap"]
    if wrap is not None:
        text = f"The position wraps, with a period of {wrap['median']:.6g}."
        if wrap["median"] != math.tau:
            text += " If this is a whole turn, data.units.qpos must make it 6.28319."
        yield Finding("caution", "Wrap", text, "data.clean.wrap=auto")


def _check_units(joint: Mapping[str, Any]) -> Iterator[Finding]:
    span, scale = joint["position"][1] - joint["position"][0], joint["velocity_scale"]
    turns_on = min(joint["forward"], joint["backward"]) < ONE_WAY or span > WHOLE_RANGE
    if span > TURNS and not turns_on and max(map(abs, joint["velocity"])) > SLOW_JOINT:
        text = f"Positions span {span:.4g}. In radians, these are {span / math.tau:.3g} turns; they look like degrees."
        yield Finding("caution", "Units", text, DEGREES)
    if scale is not None and abs(scale["median"] - 1) > UNITS:
        text = f"The measured velocity is {scale['median']:.4g} times the position's derivative: their units differ"
        yield Finding("bad", "Units", f"{text} (57.3: deg/s; 9.55: rpm).", "data.units.qvel=...")


def _check_lag(joint: Mapping[str, Any], interval: float) -> Finding:
    lag, estimate = joint["velocity_lag"], "data.clean.velocity=estimated"
    if not joint["measured"]:
        return Finding("note", "Velocity", "No velocity was recorded: it is estimated from the position.", estimate)
    if lag is None:
        text = "The measured velocity does not match the position's derivative at any delay."
        return Finding("caution", "Velocity", text, estimate)
    if abs(lag["median"]) < max(0.5 * interval, 0.001):
        return Finding("good", "Velocity", "The measured velocity does not lag the position.")
    text = f"The measured velocity {'lags' if lag['median'] > 0 else 'leads'} the position's derivative by "
    text += f"{1e3 * abs(lag['median']):.3g} ms. Estimate it from the position, or shift it with "
    return Finding("caution", "Velocity", f"{text}data.clean.velocity_lag=auto.", estimate)


def _check_delay(delay: Mapping[str, Any] | None) -> Finding:
    if delay is None:
        return Finding("note", "Command", "These recordings do not determine the delay of the command.")
    low, middle, high = (1e3 * delay[key] for key in ("low", "seconds", "high"))
    if delay["low"] < SURE:
        text = f"The delay of the {delay['command']} command is not distinguishable from 0 (estimate {middle:.2g} ms)."
        return Finding("good", "Command", text)
    text = f"The {delay['command']} command acts about {middle:.0f} ms late ({delay['estimates']} estimates, "
    text += f"quartiles {low:.0f} and {high:.0f} ms). Identify it."
    return Finding("caution", "Command", text, "bench.params.delay.identify=true")


def _check_motion(joint: Mapping[str, Any], unit: str) -> Iterator[Finding]:
    slow, rest, forward, backward = (joint[name] for name in ("slow", "rest", "forward", "backward"))
    if slow["share"] > SLOW:
        text = f"{100 * slow['share']:.0f} % of the samples are below {slow['speed']:.2g} {unit}, 5 % of the top "
        text += "speed: Stribeck and viscous friction are hard to distinguish. Record more fast motion."
        yield Finding("caution", "Excitation", text)
    else:
        text = f"{100 * (1 - slow['share']):.0f} % of the samples are above {slow['speed']:.2g} {unit}, 5 % of "
        yield Finding("good", "Excitation", f"{text}the top speed.")
    if rest is not None and rest["median"] > RESTING:
        text = f"The joint is at rest for {100 * rest['median']:.0f} % of a recording (median); at rest, the data show "
        yield Finding("note", "Rest", f"{text}only that dry friction is at least the load.")
    if min(forward, backward) < ONE_SIDED:
        text = f"{100 * forward:.0f} % of the samples move forward and {100 * backward:.0f} % backward: a torque "
        text += "offset and dry friction are not distinguishable. Record both directions."
        yield Finding("caution", "Direction", text)


def _check_command(command: Mapping[str, Any], survey: Mapping[str, Any]) -> Iterator[Finding]:
    saturated = command["saturated"]
    if saturated is not None and saturated["median"] > SATURATED:
        text = f"The command is at an end of its range for {100 * saturated['median']:.0f} % of a recording "
        text += "(median): it may be limited."
        yield Finding("note", "Saturation", text)


def _check_supply(supply: Mapping[str, Any], recordings: int) -> Iterator[Finding]:
    measured, stated = supply["measured"], supply["stated"]
    if supply["outliers"]:
        text = f"{supply['outlying']} of {recordings} recordings contain supply voltages far from their median, "
        text += f"{supply['outliers']} samples in total. Repair removes spikes; exclude recordings with longer faults."
        yield Finding("caution", "Supply readings", text, "data.clean.spikes=repair")
    text = f"The measured supply is {measured['median']:.3g} V ({measured['low']:.3g} to "
    text += f"{measured['high']:.3g} V over the recordings)"
    if stated is None or abs(stated["median"] / measured["median"] - 1) <= VOLTS:
        yield Finding("good", "Supply", f"{text}.")
    else:
        text += f", the header's {supply['field']} is {stated['median']:.3g} V. Use the measured value."
        yield Finding("caution", "Supply", text)
