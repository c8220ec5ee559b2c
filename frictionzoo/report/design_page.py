"""`report.html`: a designed command on one self-contained page, beginning with the expected accuracy."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from frictionzoo import __version__
from frictionzoo.bench.limits import Motion
from frictionzoo.core.anonymous import list_paths, list_paths_in, without_paths
from frictionzoo.core.telling import say_percent
from frictionzoo.diagnostics.findings import Finding
from frictionzoo.report.colors import BASELINE, BEST, MODEL
from frictionzoo.report.figure import Axis, Bars, Curve, Figure, Mark, Panel, Stripe, frame
from frictionzoo.report.page import save_page
from frictionzoo.report.run_page import LEAST, MOST

WIDE = 0.5  # largest half interval, as a share of the value, that counts as known
ROOM = 4.0  # limits that span more than this many times the motion are outside the frame
_DASH = (4.0, 3.0)
_QUANTITIES = ("position", "velocity", "torque")


def write_page(path: Path, note: Mapping[str, Any], interval: float, motion: Motion) -> None:
    """Write the page of a command and its expected motion into the command's folder.

    `note` is the content of `excitation.json`, `interval` the time between samples [s].

    Raises:
        OutputError: The page cannot be written.
    """
    # A page that is passed on must not contain personal paths.
    paths = {*list_paths(dict(note)), *(path for step in note["next"] for path in list_paths_in(step["command"]))}
    note = without_paths(dict(note), paths, note["joints"], Path.cwd())
    joints = list(range(len(note["joints"])))
    sections = {
        "motion": [_plot_motion(note, interval, motion, joint) for joint in joints],
        "phase": [_plot_phase(note, motion, joint) for joint in joints],
        "spectrum": [_plot_spectrum(note, interval, motion, joint) for joint in joints],
    }
    save_page(
        path,
        "report/design.html.jinja",
        sections,
        list(check_command(note)),
        points=max(LEAST, MOST // len(joints)),
        note=note,
        headline=_say_headline(note),
        parameters=_group_parameters(note),
        joints=_list_joints(note),
        wide=WIDE,
        version=__version__,
    )


def check_command(note: Mapping[str, Any]) -> Iterator[Finding]:
    """Yield the checks of the command; `note` is the content of `excitation.json`."""
    unknown = [row["name"] for row in note["parameters"] if not row["identifiable"]]
    used = max(note["limits"], key=lambda row: row["share"])
    joint = f" of {used['joint']}" if len(note["joints"]) > 1 else ""
    largest = f"the {used['quantity']}{joint}, {100 * used['share']:.0f} % of its limit"
    if unknown:
        text = (
            f"Not identifiable with this command: {', '.join(unknown)}. Highest use: {largest}. Set such a parameter "
        )
        text += "to a known value, use a model without it, raise the limits, or record longer."
        yield Finding("caution", "Parameters", text)
    else:
        yield Finding("good", "Parameters", f"All {len(note['parameters'])} parameters are identifiable.")
    rows = [row for row in note["parameters"] if None not in (row["share"], row["share_now"])]
    if no_gain := [row["name"] for row in rows if row["share_now"] <= row["share"]]:
        text = f"The run is already as accurate for {', '.join(no_gain)}: design a longer command (seconds), longer"
        yield Finding(
            "caution", "Gain", f"{text} segments (segments.length), or with wider limits; or fit both recordings."
        )
    yield Finding("good", "Limits", f"In MuJoCo C the motion respects all limits. Highest use: {largest}.")
    noise, units = note["noise"], {row["quantity"]: row["unit"] for row in note["limits"]}
    text = (
        f"The prediction includes only noise: an encoder step of {noise['quantum']:.3g} {units['position']}, position "
        f"noise of {noise['position_noise']:.3g} {units['position']} and velocity noise of "
        f"{noise['velocity_noise']:.3g} {units['velocity']}. Half the noise, half the interval. It does not include "
        "missing terms of the model, or a wrong delay or mass."
    )
    yield Finding("note", "Noise", text)
    source = f"those of the run {note['run']}" if note["run"] else "initial values, not fitted"
    text = f"The drive's values are {source}. The design depends on them: fit the recording, and design again."
    yield Finding("note", "Values", text)


def _say_headline(note: Mapping[str, Any]) -> str:
    rows = [row for row in note["parameters"] if row["identifiable"] and row["share"] is not None]
    command, count = note["command"], len(note["parameters"])
    identifiable = sum(row["identifiable"] for row in note["parameters"])
    text = f"{command['seconds']:g} s at {command['rate']:g} samples/s: {identifiable} of {count} parameters of "
    text += f"{note['model']} are identifiable"
    if not rows:
        return f"{text}."
    best, worst = (choose(rows, key=lambda row: row["share"]) for choose in (min, max))
    accuracy = f"from ± {say_percent(best['share'])} ({best['name']})"
    return f"{text}, {accuracy} to ± {say_percent(worst['share'])} ({worst['name']})."


def _group_parameters(note: Mapping[str, Any]) -> list[dict[str, Any]]:
    grouped: dict[str, list[Any]] = {}
    for row in note["parameters"]:
        full, _, joint = row["name"].partition("/")
        grouped.setdefault(full, []).append({**row, "joint": joint})
    groups = []
    for full, rows in grouped.items():
        owner, _, name = full.partition(".")
        shares = sorted(row["share"] for row in rows if row["identifiable"] and row["share"] is not None)
        ends = dict.fromkeys(say_percent(share) for share in (*shares[:1], *shares[-1:]))
        unknown = sum(not row["identifiable"] for row in rows)
        doubt = "not identifiable" if len(rows) == 1 else f"{unknown} of {len(rows)} not identifiable"
        shown = {"name": name, "owner": owner, "rows": rows, "known": f"± {' to '.join(ends)}" if ends else ""}
        groups.append({**shown, "doubt": doubt if unknown else ""})
    return groups


def _list_joints(note: Mapping[str, Any]) -> list[dict[str, Any]]:
    rows = {joint: [row for row in note["limits"] if row["joint"] == joint] for joint in note["joints"]}
    shares = {joint: max(limits, key=lambda row: row["share"]) for joint, limits in rows.items()}
    largest = max(shares, key=lambda joint: shares[joint]["share"])
    return [{"name": j, "limits": limits, "most": shares[j], "open": j == largest} for j, limits in rows.items()]


def _find_limits(note: Mapping[str, Any], joint: int) -> dict[str, Any]:
    name = note["joints"][joint]
    return {row["quantity"]: row for row in note["limits"] if row["joint"] == name}


def _plot_motion(note: Mapping[str, Any], interval: float, motion: Motion, joint: int) -> Figure:
    limits, time = _find_limits(note, joint), interval * np.arange(len(motion.ctrl))
    commanded = {"position": motion.ctrl, "velocity": motion.speed}
    expected = {"position": motion.qpos, "velocity": motion.qvel, "torque": motion.torque}
    panels, outside = [], []
    for quantity in _QUANTITIES:
        curves = {"expected": expected[quantity][:, joint]}
        if quantity in commanded:
            curves = {"command": commanded[quantity][:, joint], **curves}
        axis, shown = _scale(limits[quantity], quantity, list(curves.values()))
        outside += [] if shown else [quantity]
        colors = {"command": BASELINE, "expected": MODEL}
        marks: list[Mark] = [*_draw_limits(limits[quantity], level=True)]
        marks += [Curve(x=time, y=curve, name=name, color=colors[name]) for name, curve in curves.items()]
        panels.append(Panel(marks, Axis("time", "s", limits=(0.0, float(time[-1]))), axis))
    rows = [limits[quantity] for quantity in _QUANTITIES]
    ends = ", ".join("{:.3g} to {:.3g} {}".format(*row["reached"], row["unit"]) for row in rows)
    text = f"Command of {note['joints'][joint]} and expected motion in MuJoCo C; dashed: the limits. Ranges: {ends}."
    text += f" Outside the frame: the limits of {' and '.join(outside)}." if outside else ""
    return Figure(f"Motion of {note['joints'][joint]}", text, tuple(panels), height=620)


def _draw_limits(row: Mapping[str, Any], level: bool) -> Iterator[Mark]:
    for end in row["allowed"]:
        yield Stripe(low=end, high=end, level=level, color=BEST, dash=_DASH)


def _scale(row: Mapping[str, Any], quantity: str, curves: Sequence[Float[np.ndarray, "samples"]]) -> tuple[Axis, bool]:
    """Return an axis, and whether it includes the limits; it leaves them out if they would flatten the motion."""
    values, ends = np.concatenate(curves), np.array(row["allowed"])
    near = bool(np.ptp(ends) <= ROOM * np.ptp(values))
    return Axis(quantity, row["unit"], limits=frame([np.concatenate([values, ends]) if near else values])), near


def _plot_phase(note: Mapping[str, Any], motion: Motion, joint: int) -> Figure:
    limits, name = _find_limits(note, joint), note["joints"][joint]
    position, velocity = motion.qpos[:, joint], motion.qvel[:, joint]
    x, _ = _scale(limits["position"], "position", [position])
    y, _ = _scale(limits["velocity"], "velocity", [velocity])
    marks: list[Mark] = [*_draw_limits(limits["position"], level=False), *_draw_limits(limits["velocity"], level=True)]
    marks.append(Curve(x=position, y=velocity, name="expected", color=MODEL, width=1.2, legend=False))
    text = f"Expected velocity over position of {name}; dashed: the limits, if near. The recording contains no "
    return Figure(f"Phase plot of {name}", f"{text}information outside this region.", (Panel(marks, x, y),))


def _plot_spectrum(note: Mapping[str, Any], interval: float, motion: Motion, joint: int) -> Figure:
    name, unit = note["joints"][joint], _find_limits(note, joint)["velocity"]["unit"]
    speed = motion.speed[:, joint]
    frequency = np.fft.rfftfreq(len(speed), interval)
    shown = frequency <= 1.2 * note["command"]["bandwidth"]
    amplitude = 2 * np.abs(np.fft.rfft(speed))[shown] / len(speed)
    look: dict[str, Any] = {"upright": True, "color": MODEL, "legend": False}
    bars = Bars(at=frequency[shown], length=amplitude, width=0.9 * float(frequency[1]), name="amplitude", **look)
    panel = Panel((bars,), Axis("frequency", "Hz"), Axis("amplitude of the velocity", unit))
    text = f"Frequencies of the command of {name}, up to the bandwidth of {note['command']['bandwidth']:g} Hz; "
    return Figure(f"Spectrum of {name}", f"{text}the ramps broaden each line slightly.", (panel,))
