"""Summary printed by `python -m frictionzoo.design`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from frictionzoo.core.telling import align, escape_all, say_percent


def summarise_excitation(note: Mapping[str, Any], folder: Path) -> str:
    """Summarise `excitation.json`: accuracy of each parameter, use of the limits, and the folder of the files."""
    note = escape_all(note)
    command, noise = note["command"], note["noise"]
    several = len(note["joints"]) > 1
    rows = [("parameter", "value", "known to", "unit", "")]
    for row in note["parameters"]:
        identifiable = row["identifiable"]
        share = "" if row["share"] != row["share"] else say_percent(row["share"])
        width = f"+- {row['half_width']:.2g}" if identifiable else ""
        rows.append(
            (row["name"], f"{row['value']:.4g}", width, row["unit"], share if identifiable else "not identifiable")
        )
    used: list[tuple[str, ...]] = [
        ("in MuJoCo C", *(["joint"] if several else []), "from", "to", "allowed", "unit", "of the limit")
    ]
    for row in note["limits"]:
        low, high = row["allowed"]
        joint = [row["joint"]] if several else []
        reached = [f"{end:.4g}" for end in row["reached"]]
        share = f"{100 * row['share']:.0f} %"
        used.append((row["quantity"], *joint, *reached, f"{low:.4g} to {high:.4g}", row["unit"], share))
    return "\n\n".join(
        [
            f"{command['seconds']:g} s at {command['rate']:g} samples/s, soft within {command['ramp']:g} s at both "
            f"ends.\nExpected of a fit of segments of {note['fit']['length']} samples, with an encoder step of "
            f"{noise['quantum']:.3g},\nposition noise of {noise['position_noise']:.3g} and velocity noise of "
            f"{noise['velocity_noise']:.3g}:",
            align(rows),
            align(used),
            f"files: {folder}",
        ]
    )
