"""Findings in a data set: problems and passed checks, with the option that solves each problem."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from frictionzoo.core.log import JITTER
from frictionzoo.diagnostics.findings import Check

SAME = 1e-3  # relative difference of sample intervals above which recordings cannot be fitted together
UNITS = 0.1  # relative difference of measured velocity and derivative above which their units are suspect
VOLTS = 0.05  # relative difference of measured and stated supply above which it is reported
SLOW = 0.5  # share of slow samples above which it is reported
RESTING = 0.5  # share of samples at rest above which it is reported
ONE_SIDED = 0.05  # share of samples in one direction below which the motion counts as one-sided
SATURATED = 0.05  # share of samples at an end of the command's range above which it is reported
TURNS = 20.0  # range of positions above which they may be degrees [rad]
SURE = 0.003  # lower quartile of a delay below which it is not distinguishable from 0 [s]

DEGREES = "data.units.qpos=deg"
FAULTS = {  # faults of clock and samples: singular, plural
    "duplicates": ("repeated sample", "repeated samples"),
    "missing": ("missing sample", "missing samples"),
    "gaps": ("gap", "gaps"),
    "resets": ("reset of the clock", "resets of the clock"),
    "lost": ("sample with NaN", "samples with NaN"),
}


def list_findings(survey: Mapping[str, Any]) -> Iterator[Check]:
    """Yield problems and passed checks of a survey without findings."""
    yield _find_origin(survey["data"])
    yield _find_jitter(survey)
    yield _find_breaks(survey["timing"])
    for joint in survey["joints"]:
        which = f", joint {joint['name']}" if len(survey["joints"]) > 1 else ""
        yield from (replace(finding, title=f"{finding.title}{which}") for finding in _find_in_joint(joint, survey))
    for command in survey["commands"]:
        which = f", joint {command['name']}" if len(survey["commands"]) > 1 else ""
        yield from (replace(finding, title=f"{finding.title}{which}") for finding in _find_saturation(command))
    yield from _find_supply(survey["supply"], survey["data"]["recordings"])
    yield from _find_off(survey["enabled"])


def _find_in_joint(joint: Mapping[str, Any], survey: Mapping[str, Any]) -> Iterator[Check]:
    yield _find_spikes(joint, survey["data"]["recordings"])
    yield _find_resolution(joint, survey["timing"]["interval"]["median"], survey["units"]["position"])
    yield from _find_degrees(joint)
    yield _find_lag(joint, survey["timing"]["interval"]["median"])
    yield _find_delay(joint)
    yield from _find_slowness(joint, survey["units"]["velocity"])
    yield from _find_direction(joint)


def _find_origin(data: Mapping[str, Any]) -> Check:
    if data["origin"] == "simulated":
        return Check("note", "Simulated data", "A simulator made the data: they show nothing about hardware.")
    if data["origin"] == "hardware":
        return Check("good", "Hardware data", "Recorded on hardware, according to data.origin.")
    text = "Your recordings. data.origin does not state whether they come from hardware."
    return Check("note", "Origin", text, "data.origin=hardware")


def _find_jitter(survey: Mapping[str, Any]) -> Check:
    interval, jitter = survey["timing"]["interval"], survey["timing"]["jitter"]
    low, median, high = (1e3 * interval[key] for key in ("low", "median", "high"))
    differ = high / low - 1 > SAME
    if not jitter["high"] and not differ:
        return Check("good", "Clock", f"All intervals are {median:.4g} ms, within {100 * JITTER:g} %.")
    text = ""
    if jitter["high"]:
        text = f"{100 * jitter['median']:.2g} % of a recording's intervals (median) differ by more "
        worst = 100 * survey["timing"]["worst"]["high"]
        text += f"than {100 * JITTER:g} % from the median interval, by up to {worst:.0f} %. "
    if differ:
        text += f"Median intervals range from {low:.4g} to {high:.4g} ms; recordings in one fit need the same. "
    step = float(f"{interval['median']:.2g}")  # rounded as a user would write it
    return Check("caution", "Clock", f"{text}Resample them.", f"data.clean.step={step:g}")


def _find_breaks(timing: Mapping[str, Any]) -> Check:
    counts = [f"{timing[key]} {FAULTS[key][timing[key] > 1]}" for key in FAULTS if timing[key]]
    if not counts:
        return Check("good", "Completeness", "No gaps, and no missing, repeated or NaN samples.")
    text = f"Found: {', '.join(counts)}. Cleaning drops repeated samples, interpolates short gaps and splits at long "
    broken = timing["gaps"] or timing["resets"] or timing["lost"]
    return Check("caution" if broken else "note", "Completeness", f"{text}gaps; data.clean.gap sets the limit.")


def _find_spikes(joint: Mapping[str, Any], recordings: int) -> Check:
    if not joint["spikes"]:
        return Check("good", "Spikes", "No isolated spike in the position.")
    text = f"{joint['spiky']} of {recordings} recordings contain isolated spikes in the position, "
    text += f"{joint['spikes']} in total. Repair them, or drop these recordings with data.clean.spikes=drop."
    return Check("caution", "Spikes", text, "data.clean.spikes=repair")


def _find_resolution(joint: Mapping[str, Any], interval: float, unit: str) -> Check:
    quantum = joint["position_quantum"]
    if quantum is None:
        return Check("good", "Resolution", "No encoder steps are visible in the position.")
    speed = quantum["median"] / interval
    top = max(map(abs, joint["velocity"]))
    text = f"The position moves in steps of {quantum['median']:.3g} {unit}: one step per sample is {speed:.2g} "
    text += f"per second, {100 * speed / max(top, 1e-12):.2g} % of the top speed."
    if speed > 0.1 * top:
        return Check("note", "Resolution", f"{text} Use long segments (segments.length).")
    return Check("note" if speed > 0.01 * top else "good", "Resolution", text)


def _find_degrees(joint: Mapping[str, Any]) -> Iterator[Check]:
    low, high = joint["position"]
    if high - low > TURNS:
        text = f"Positions span {high - low:.4g}. In radians, these are {(high - low) / math.tau:.3g} turns; "
        yield Check("caution", "Units", f"{text}they look like degrees.", DEGREES)
    scale = joint["velocity_scale"]
    if scale is not None and abs(scale["median"] - 1) > UNITS:
        text = f"The measured velocity is {scale['median']:.4g} times the position's derivative: their units differ"
        yield Check("bad", "Units", f"{text} (57.3: deg/s; 9.55: rpm).", "data.units.qvel=...")


def _find_lag(joint: Mapping[str, Any], interval: float) -> Check:
    lag = joint["velocity_lag"]
    if not joint["measured"]:
        text = "No velocity was recorded: it is estimated from the position."
        return Check("note", "Velocity", text, "data.clean.velocity=estimated")
    if lag is None:
        text = "The measured velocity does not match the position's derivative at any delay."
        return Check("caution", "Velocity", text, "data.clean.velocity=estimated")
    if abs(lag["median"]) < max(0.5 * interval, 0.001):
        return Check("good", "Velocity", "The measured velocity has no lag against the position.")
    text = f"The measured velocity {'lags' if lag['median'] > 0 else 'leads'} the position's derivative by "
    text += f"{1e3 * abs(lag['median']):.3g} ms. Estimate it from the position, or shift it with "
    return Check("caution", "Velocity", f"{text}data.clean.velocity_lag=auto.", "data.clean.velocity=estimated")


def _find_delay(joint: Mapping[str, Any]) -> Check:
    delay = joint["delay"]
    if delay is None:
        return Check("note", "Command", "These recordings do not determine the delay of the command.")
    low, middle, high = (1e3 * delay[key] for key in ("low", "seconds", "high"))
    if delay["low"] < SURE:
        text = f"The delay of the {delay['command']} command is not distinguishable from 0 (estimate {middle:.2g} ms)."
        return Check("good", "Command", text)
    text = f"The {delay['command']} command acts about {middle:.0f} ms late (half of {delay['estimates']} estimates "
    text += f"between {low:.0f} and {high:.0f} ms). Identify it: give the bench the parameter delay."
    return Check("caution", "Command", text, "bench.params.delay=...")


def _find_slowness(joint: Mapping[str, Any], unit: str) -> Iterator[Check]:
    slow, rest = joint["slow"], joint["rest"]
    if slow["share"] > SLOW:
        text = f"{100 * slow['share']:.0f} % of the samples are below {slow['speed']:.2g} {unit}, 5 % of the top "
        text += "speed: Stribeck and viscous friction are hard to distinguish. Record more fast motion."
        yield Check("caution", "Excitation", text)
    else:
        text = f"{100 * (1 - slow['share']):.0f} % of the samples are above {slow['speed']:.2g} {unit}, 5 % of "
        yield Check("good", "Excitation", f"{text}the top speed.")
    if rest is not None and rest["median"] > RESTING:
        text = f"The joint is at rest for {100 * rest['median']:.0f} % of a recording (median); at rest, the data show "
        yield Check("note", "Rest", f"{text}only that dry friction is at least the load.")


def _find_direction(joint: Mapping[str, Any]) -> Iterator[Check]:
    if min(joint["forward"], joint["backward"]) < ONE_SIDED:
        text = f"{100 * joint['forward']:.0f} % of the samples move forward and {100 * joint['backward']:.0f} % "
        text += "backward: a torque offset and dry friction are not distinguishable. Record both directions."
        yield Check("caution", "Direction", text)


def _find_saturation(command: Mapping[str, Any]) -> Iterator[Check]:
    saturated = command["saturated"]
    if saturated is not None and saturated["median"] > SATURATED:
        low, high = command["range"]
        text = f"The command is at an end of its range, {low:.3g} or {high:.3g}, for "
        text += f"{100 * saturated['median']:.0f} % of a recording (median): it may be limited."
        yield Check("note", "Saturation", text)


def _find_supply(supply: Mapping[str, Any] | None, recordings: int) -> Iterator[Check]:
    if supply is None:
        return
    measured, stated = supply["measured"], supply["stated"]
    if supply["outliers"]:
        text = f"{supply['outlying']} of {recordings} recordings contain supply voltages far from their median, "
        text += f"{supply['outliers']} samples in total. Repair removes spikes; exclude recordings with longer faults."
        yield Check("caution", "Supply readings", text, "data.clean.spikes=repair")
    text = f"The measured supply is {measured['median']:.3g} V ({measured['low']:.3g} to "
    text += f"{measured['high']:.3g} V over the recordings)"
    if stated is None or abs(stated["median"] / measured["median"] - 1) <= VOLTS:
        yield Check("good", "Supply", f"{text}.")
    else:
        text += f", the header's {supply['field']} is {stated['median']:.3g} V. Use the measured value."
        yield Check("caution", "Supply", text)


def _find_off(enabled: Mapping[str, Any] | None) -> Iterator[Check]:
    if enabled is not None and enabled["low"] < 1:
        text = f"The drive is off for up to {100 * (1 - enabled['low']):.0f} % of a recording: the bench's actuator "
        yield Check("note", "Drive off", f"{text}model needs an input named enable.")
