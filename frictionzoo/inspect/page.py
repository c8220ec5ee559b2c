"""`inspect.html`: a data set on one page that opens without a network."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from frictionzoo.core.output import write_atomically
from frictionzoo.inspect.survey import pool_velocities, rank_by_faults
from frictionzoo.inspect.terminal import list_quantities
from frictionzoo.logs.recording import Recording
from frictionzoo.logs.signals import derive_velocity, find_spikes, regular_stretch, repair_spikes
from frictionzoo.show.colors import BASELINE, BEST, MODEL
from frictionzoo.show.page import (
    MEASURED,
    Check,
    Plot,
    draw_points,
    escape,
    make_axis,
    make_layout,
    render_page,
    round_points,
)

BINS = 61
LISTED = 50  # recordings in the table; inspect.json has all
SMALL = 220  # pixels


def write_page(path: Path, survey: Mapping[str, Any], recordings: Sequence[Recording]) -> None:
    """Write the page.

    Args:
        path: The file; `inspect.json` lies beside it.
        survey: What that holds.
        recordings: The same recordings.

    Raises:
        OutputError: It cannot be written.
    """
    ranked = rank_by_faults(survey)
    worst = next(recording for recording in recordings if recording.name == ranked[0]["name"])
    sections = {
        "velocity": [_plot_velocities(recordings, joint, survey) for joint in range(len(survey["joints"]))],
        "worst": [_plot_recording(worst, joint) for joint in range(len(survey["joints"]))],
        "spread": list(_plot_spreads(survey)) if len(recordings) > 1 else [],
    }
    checks = [
        Check(finding["state"], finding["title"], finding["text"])
        if finding["option"] is None
        else Check(finding["state"], finding["title"], f"{finding['text']} [{finding['option']}]")
        for finding in survey["findings"]
    ]
    page = render_page(
        "inspect/inspect.html.jinja",
        [plot.figure for plots in sections.values() for plot in plots],
        survey=survey,
        quantities=list(list_quantities(survey)),
        checks=checks,
        doubts=sum(check.state in ("caution", "bad") for check in checks),
        sections=sections,
        rows=ranked[:LISTED],
        version=survey["version"],
    )
    write_atomically(path, page)


def _plot_velocities(recordings: Sequence[Recording], joint: int, survey: Mapping[str, Any]) -> Plot:
    velocity, slow = pool_velocities(recordings, joint), survey["joints"][joint]["slow"]
    low, high = survey["joints"][joint]["velocity"]
    shares, edges = _count(velocity, low, high)
    bars = _draw_bars(shares, edges, "share of the samples", "rad/s or m/s")
    band = {"type": "rect", "yref": "paper", "y0": 0, "y1": 1, "x0": -slow["speed"], "x1": slow["speed"]}
    layout = _lay_out("velocity [rad/s or m/s]", "share of the samples [%]")
    layout["shapes"] = [band | {"fillcolor": BASELINE, "opacity": 0.18, "line": {"width": 0}}]
    text = f"Velocities of all samples, estimated from the position. {100 * slow['share']:.0f} % lie in the band, "
    text += f"under {slow['speed']:.2g} rad/s or m/s."
    return Plot(_name("Velocities", joint, survey), text, {"data": [bars], "layout": layout})


def _plot_recording(recording: Recording, joint: int) -> Plot:
    """Position and command above velocity, over time, with the spikes marked."""
    time = recording.time - recording.time[0]
    position, spikes = recording.signals["qpos"][:, joint], find_spikes(recording.signals["qpos"][:, joint])
    data = [_line(time, position, "position", MEASURED, "y")]
    ctrl = recording.signals["ctrl"]
    if ctrl.shape[1] > joint:
        data.insert(0, _line(time, ctrl[:, joint], "command", BASELINE, "y"))
    if len(spikes):
        marks = {"mode": "markers", "marker": {"color": BEST, "size": 9, "symbol": "circle-open"}, "name": "spike"}
        marked = {"x": round_points(time[spikes]), "y": round_points(position[spikes])}
        data.append({"type": "scatter", "xaxis": "x", "yaxis": "y", **marks, **marked})
    smooth = repair_spikes(position)
    grid, _ = regular_stretch(time, smooth)
    velocity = derive_velocity(time, smooth)
    if "qvel" in recording.signals:
        data.append(_line(time, recording.signals["qvel"][:, joint], "velocity, measured", MEASURED, "y2"))
    if len(velocity) == len(grid):
        data.append(_line(grid, velocity, "velocity, from the position", MODEL, "y2"))
    layout = make_layout(
        xaxis=make_axis("time [s]", anchor="y2"),
        yaxis=make_axis("position, command", domain=[0.42, 1]),
        yaxis2=make_axis("velocity [rad/s or m/s]", domain=[0, 0.36]),
    )
    text = f"{recording.name}: position [rad or m] and command above the velocity, estimated over the longest stretch "
    return Plot(escape(recording.name), f"{text}without a gap.", {"data": data, "layout": layout})


def _line(
    x: Float[np.ndarray, "points"], y: Float[np.ndarray, "points"], name: str, color: str, axis: str
) -> dict[str, Any]:
    shared = {"type": "scatter", "mode": "lines", "name": name, "line": {"color": color, "width": 1.4}}
    return {**shared, **draw_points(x, y), "xaxis": "x", "yaxis": axis, "hovertemplate": "%{y:.4g}"}


def _plot_spreads(survey: Mapping[str, Any]) -> Iterator[Plot]:
    """How quantities differ between the recordings."""
    recordings = survey["recordings"]
    yield from _plot_spread("Sample interval", "ms", [1e3 * entry["timing"]["interval"] for entry in recordings])
    yield from _plot_spread("Uneven intervals", "%", [100 * entry["timing"]["jitter"] for entry in recordings])
    for joint in range(len(survey["joints"])):
        entries = [entry["joints"][joint] for entry in recordings]
        lags = [1e3 * entry["velocity_lag"] for entry in entries if entry["velocity_lag"] is not None]
        yield from _plot_spread(_name("Velocity lag", joint, survey), "ms", lags)
        tops = [entry["top_speed"] for entry in entries]
        yield from _plot_spread(_name("Top speed", joint, survey), "rad/s or m/s", tops)
        yield from _plot_spread(_name("Slow samples", joint, survey), "%", [100 * entry["slow"] for entry in entries])
    supplies = [entry["supply"]["median"] for entry in recordings if entry["supply"]]
    yield from _plot_spread("Supply", "V", supplies)


def _plot_spread(title: str, unit: str, values: Sequence[float]) -> Iterator[Plot]:
    """How many recordings have which value; nothing where there are not two."""
    if len(values) < 2:
        return
    known = np.array(values, float)
    shares, edges = _count(known, float(known.min()), float(known.max()), bins=31, share=False)
    bars = _draw_bars(shares, edges, "recordings", unit)
    layout = _lay_out(f"{title.lower()} [{unit}]", "recordings", nticks=5)
    layout["margin"] = {"l": 44, "r": 8, "t": 8, "b": 40}
    text = f"{np.min(known):.4g} to {np.max(known):.4g} {unit}, median {np.median(known):.4g}."
    yield Plot(title, text, {"data": [bars], "layout": layout}, height=SMALL)


def _count(
    values: Float[np.ndarray, "samples"], low: float, high: float, bins: int = BINS, share: bool = True
) -> tuple[Float[np.ndarray, "bins"], Float[np.ndarray, "edges"]]:
    """A histogram; what lies outside counts in the outermost bins."""
    room = max(high - low, 1e-3 * max(abs(low), abs(high)), 1e-9)
    counts, edges = np.histogram(np.clip(values, low, high), bins, (low - 0.01 * room, high + 0.01 * room))
    return (100 * counts / len(values) if share else counts.astype(float)), edges


def _draw_bars(
    heights: Float[np.ndarray, "bins"], edges: Float[np.ndarray, "edges"], name: str, unit: str
) -> dict[str, Any]:
    middles = round_points(0.5 * (edges[1:] + edges[:-1]))
    shown = {
        "marker": {"color": MODEL},
        "name": name,
        "hovertemplate": f"%{{y:.3g}} at %{{x:.4g}} {unit}<extra></extra>",
    }
    return {"type": "bar", "x": middles, "y": round_points(heights), **shown}


def _lay_out(x: str, y: str, **options: Any) -> dict[str, Any]:
    """Of a histogram; `options` are those of its axes."""
    axes = make_layout(xaxis=make_axis(x, **options), yaxis=make_axis(y, **options))
    return axes | {"showlegend": False, "bargap": 0.04}


def _name(quantity: str, joint: int, survey: Mapping[str, Any]) -> str:
    return f"{quantity}, joint {joint + 1}" if len(survey["joints"]) > 1 else quantity
