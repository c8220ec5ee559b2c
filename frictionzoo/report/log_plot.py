"""Figure of one recording: position, velocity and command of each joint."""

from collections.abc import Sequence

from matplotlib.figure import Figure as Drawing

from frictionzoo.core.log import Log
from frictionzoo.report.colors import BASELINE, MODEL
from frictionzoo.report.figure import Axis, Curve, Figure, Panel, Sheet
from frictionzoo.report.run_plots import COLUMNS
from frictionzoo.report.with_matplotlib import draw


def draw_log(log: Log, joints: Sequence[str], units: Sequence[str]) -> Drawing:
    """Draw a log with the names of its joints and the units of position and velocity.

    A joint without a command has an empty panel.
    """
    figures = [_plot_joint(log, joint, name, units) for joint, name in enumerate(joints)]
    return draw(Sheet(log.name, figures, 6.0, columns=min(len(joints), COLUMNS), headings=len(joints) > 1))


def _plot_joint(log: Log, joint: int, name: str, units: Sequence[str]) -> Figure:
    is_estimated = log.velocity_estimated or joint in log.without_velocity
    panels = [
        Panel(
            [Curve(x=log.time, y=values[:, joint], color=color)] if joint < values.shape[1] else [],
            Axis("time", "s"),
            Axis(quantity, unit),
            note="estimated from the position" if is_estimated and quantity == "velocity" else "",
        )
        for quantity, values, unit, color in (
            ("position", log.qpos, units[0], MODEL),
            ("velocity", log.qvel, units[1], MODEL),
            ("command", log.ctrl, "unit of ctrl", BASELINE),
        )
    ]
    return Figure(name, f"Position, velocity and command of {name} in {log.name}.", tuple(panels))
