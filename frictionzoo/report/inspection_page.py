"""`inspect.html`: diagnostics of a data set on one page that works offline."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from frictionzoo.data.recording import Recording
from frictionzoo.data.signals import derive_velocity, find_spikes, regular_stretch, repair_spikes
from frictionzoo.diagnostics.findings import Finding
from frictionzoo.diagnostics.survey import pool_velocities, rank_by_faults
from frictionzoo.diagnostics.survey_findings import merge_findings, split_title
from frictionzoo.report.colors import BASELINE, BEST, MODEL
from frictionzoo.report.figure import Axis, Bars, Curve, Figure, Mark, Panel, Stripe
from frictionzoo.report.inspection_tables import judge, list_quantities, tabulate_checks
from frictionzoo.report.page import save_page

BINS = 61
LISTED = 50  # largest number of recordings in the table; inspect.json has all
SMALL = 220  # height of a small figure [px]


def write_page(path: Path, survey: Mapping[str, Any], recordings: Sequence[Recording], command: str = "") -> None:
    """Write the page of a survey (content of `inspect.json`) and its recordings, with the `command` to run next.

    Raises:
        OutputError: The file cannot be written.
    """
    ranked = rank_by_faults(survey)
    worst = next(recording for recording in recordings if recording.name == ranked[0]["name"])
    joints = [
        {
            "name": entry["name"],
            "quantities": list(list_quantities(survey, entry["name"])),
            "checks": [Finding(**one) for one in survey["findings"] if split_title(one["title"])[1] == entry["name"]],
            "columns": [row["columns"] for each in survey["columns"] for row in each["joints"][joint : joint + 1]],
            "figures": f"joint {joint}",
        }
        for joint, entry in enumerate(survey["joints"])
    ]
    figures = {
        entry["figures"]: list(_plot_joint(recordings, worst, joint, survey)) for joint, entry in enumerate(joints)
    }
    save_page(
        path,
        "report/inspect.html.jinja",
        figures | {"spread": list(_plot_spreads(survey))},
        merge_findings(survey),
        survey=survey,
        verdict=judge(survey),
        command=command,
        joints=joints,
        columns=tabulate_checks(survey),
        quantities=list(list_quantities(survey)),
        rows=ranked[:LISTED],
        version=survey["version"],
    )


def _plot_joint(
    recordings: Sequence[Recording], worst: Recording, joint: int, survey: Mapping[str, Any]
) -> Iterator[Figure]:
    yield _plot_velocities(recordings, joint, survey)
    yield _plot_recording(worst, joint, survey)
    entries = [entry["joints"][joint] for entry in survey["recordings"]]
    lags = [1e3 * entry["velocity_lag"] for entry in entries if entry["velocity_lag"] is not None]
    yield from _plot_spread("Velocity lag", "ms", lags)
    yield from _plot_spread("Top speed", survey["units"]["velocity"], [entry["top_speed"] for entry in entries])
    yield from _plot_spread("Slow samples", "%", [100 * entry["slow"] for entry in entries])


def _plot_velocities(recordings: Sequence[Recording], joint: int, survey: Mapping[str, Any]) -> Figure:
    velocity, slow = pool_velocities(recordings, joint), survey["joints"][joint]["slow"]
    low, high = survey["joints"][joint]["velocity"]
    bars = _count(velocity, low, high, "share of the samples")
    band = Stripe(low=-slow["speed"], high=slow["speed"], color=BASELINE, opacity=0.18)
    panel = Panel((band, bars), Axis("velocity", survey["units"]["velocity"]), Axis("share of the samples", "%"))
    text = f"Velocities of all samples, estimated from the position. {100 * slow['share']:.0f} % are in the band, "
    text += f"below {slow['speed']:.2g} {survey['units']['velocity']}."
    return Figure("Velocities", text, (panel,))


def _plot_recording(recording: Recording, joint: int, survey: Mapping[str, Any]) -> Figure:
    units = survey["units"]
    time = recording.time - recording.time[0]
    position, spikes = recording.signals["qpos"][:, joint], find_spikes(recording.signals["qpos"][:, joint])
    upper_marks: list[Mark] = [Curve(x=time, y=position, name="position")]
    ctrl = recording.signals["ctrl"]
    if ctrl.shape[1] > joint:
        upper_marks.insert(0, Curve(x=time, y=ctrl[:, joint], name="command", color=BASELINE))
    if len(spikes):
        look: dict[str, Any] = {"name": "spike", "color": BEST}
        upper_marks.append(Curve(x=time[spikes], y=position[spikes], width=0.0, marker="circle-open", size=9.0, **look))
    smooth = repair_spikes(position)
    grid, _ = regular_stretch(time, smooth)
    velocity = derive_velocity(time, smooth)
    lower_marks: list[Mark] = []
    if "qvel" in recording.signals:
        lower_marks.append(Curve(x=time, y=recording.signals["qvel"][:, joint], name="velocity, measured"))
    if len(velocity) == len(grid):
        lower_marks.append(Curve(x=grid, y=velocity, name="velocity, from the position", color=MODEL))
    axis = Axis("time", "s")
    upper = Panel(upper_marks, axis, Axis("position, command"), share=3.0)
    lower = Panel(lower_marks, axis, Axis("velocity", units["velocity"]), share=2.0)
    text = f"{recording.name}: position [{units['position']}] and command at the top, velocity at the bottom; the "
    text += "estimate covers the longest stretch without a gap."
    return Figure("Recording with the most faults", text, (upper, lower))


def _plot_spreads(survey: Mapping[str, Any]) -> Iterator[Figure]:
    recordings = survey["recordings"]
    yield from _plot_spread("Sample interval", "ms", [1e3 * entry["timing"]["interval"] for entry in recordings])
    yield from _plot_spread("Uneven intervals", "%", [100 * entry["timing"]["jitter"] for entry in recordings])
    supplies = [entry["supply"]["median"] for entry in recordings if entry["supply"]]
    yield from _plot_spread("Supply", "V", supplies)


def _plot_spread(title: str, unit: str, values: Sequence[float]) -> Iterator[Figure]:
    if len(values) < 2:
        return
    numbers = np.array(values, float)
    bars = _count(numbers, float(numbers.min()), float(numbers.max()), "recordings", bins=31, share=False)
    text = f"{np.min(numbers):.4g} to {np.max(numbers):.4g} {unit}, median {np.median(numbers):.4g}."
    panel = Panel((bars,), Axis(title.lower(), unit), Axis("recordings"))
    yield Figure(title, text, (panel,), height=SMALL, small=True)


def _count(
    values: Float[np.ndarray, "samples"], low: float, high: float, name: str, bins: int = BINS, share: bool = True
) -> Bars:
    """Return a histogram; values outside the range count in the outermost bins."""
    room = max(high - low, 1e-3 * max(abs(low), abs(high)), 1e-9)
    counts, edges = np.histogram(np.clip(values, low, high), bins, (low - 0.01 * room, high + 0.01 * room))
    length, width = 100 * counts / len(values) if share else counts.astype(float), float(edges[1] - edges[0])
    shared: dict[str, Any] = {"name": name, "color": MODEL, "upright": True}
    return Bars(at=0.5 * (edges[1:] + edges[:-1]), length=length, width=0.96 * width, legend=False, **shared)
