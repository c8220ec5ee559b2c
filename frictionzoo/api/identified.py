"""`Identified`: the drive that `identify` and `load` return, with its plots, files and exports."""

import copy
import importlib.util
import time
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import safetensors.torch
from matplotlib.figure import Figure

from frictionzoo import __version__
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.output import RESULT, RUN_FILES, claim, write_atomically, write_json
from frictionzoo.export.base import Written
from frictionzoo.result.curves import write_curves
from frictionzoo.result.fitted_drive import FittedDrive
from frictionzoo.result.read_back import LAW
from frictionzoo.result.types import Result

if TYPE_CHECKING:
    import pandas  # pyright: ignore[reportMissingImports] - optional


@dataclass(frozen=True, eq=False, repr=False)
class Identified(FittedDrive):
    """Identified drive of one run: parameters with intervals, errors, plots, simulation and export."""

    @classmethod
    def of(cls, drive: FittedDrive) -> "Identified":
        """Return the same drive with plots, files and exports."""
        return cls(**{field.name: getattr(drive, field.name) for field in fields(drive)})

    def save(self, folder: str | Path) -> Result:
        """Write figures, values, curves, MJCF and page, and replace unchanged files of an earlier run.

        `result.json` comes last and marks a complete folder.

        Returns:
            Content of `result.json`; `written` gives the deviation of each model file from the drive.

        Raises:
            OutputError: A foreign file is in the way, or a file cannot be written.
            RunError: The drive comes from a card.
        """
        self.recorded  # noqa: B018 - raises for a card
        began, folder = time.perf_counter(), Path(folder)
        with claim(folder, "run", RUN_FILES) as manifest:
            manifest.remove(RESULT)
            return self._write(folder, began)

    def _write(self, folder: Path, began: float) -> Result:
        # Imported late: plotting libraries slow down reading a run.
        from frictionzoo.export.mjcf import write_identified
        from frictionzoo.report.replay import record_replay
        from frictionzoo.report.run_page import write_report
        from frictionzoo.report.run_plots import write_figures

        write_figures(folder / "figures", self.result, self.curves)
        # One entry: safetensors writes several in an order that changes from run to run.
        header = {"frictionzoo": f"{self.model.name}, version {__version__}"}
        write_atomically(folder / LAW, safetensors.torch.save(dict(self.state), header))
        write_curves(folder, self.curves)
        # Same files as `python -m frictionzoo.export RUN target=mjcf`.
        models = write_identified(self)
        for model in models:
            write_atomically(folder / model.name, model.content)
        result = copy.deepcopy(self.result)
        result.written = [model.describe(self) for model in models]
        result.timing.total += time.perf_counter() - began
        replay = record_replay(self.bench, self.values["bench"], self.curves, self.segments.timestep)
        write_report(folder / "report.html", result, self.curves, replay)
        write_json(folder / RESULT, result)
        return result

    def plot(self) -> Figure:
        """Plot measured and simulated motion of the first long test rollout, with and without friction.

        Raises:
            RunError: The drive comes from a card.
        """
        # Imported late: plotting libraries slow down other uses.
        from frictionzoo.report.run_plots import draw_rollout

        self.recorded  # noqa: B018 - raises for a card
        return draw_rollout(self.result, self.curves)

    def to_frame(self) -> "pandas.DataFrame":
        """Return the physical parameters of bench and friction model as a table, one row per joint.

        Columns: `name` (`bench.armature`), `joint`, `value`, ends `low` and `high` of the 95 % interval (NaN: none),
        `unit`, `identified`.

        Raises:
            ConfigError: pandas is not installed.
        """
        if importlib.util.find_spec("pandas") is None:
            raise ConfigError("to_frame: pandas not found, expected an installed package; pip install pandas")
        import pandas  # pyright: ignore[reportMissingImports]

        rows = [
            (name, joint, row.value, *(row.interval or (np.nan, np.nan)), parameter.unit, row.identified)
            for name, parameter in self.parameters.items()
            for row in parameter.by_joint
            for joint in row.joints
        ]
        return pandas.DataFrame(rows, columns=["name", "joint", "value", "low", "high", "unit", "identified"])

    def export(self, target: str, path: str | Path, **options: str | float | int | Mapping[str, Any]) -> Written:
        """Write the drive for another program, as `python -m frictionzoo.export` does.

        Args:
            target: Name of a target, such as `mjcf`; the documentation lists them.
            path: Folder for all files of the target, or one file, selected by its suffix.
            options: `timestep` [s] and `integrator` of the simulator, and options of the target.

        Returns:
            Written files, their deviation from this drive, and what they cannot represent.

        Raises:
            FrictionzooError: The target or an option is unknown, or the target cannot represent the drive.
        """
        from frictionzoo.export.write import export_to

        return export_to(self, target, Path(path), options)

    def __repr__(self) -> str:
        """Return parameters with intervals, test errors with and without friction, and warnings."""
        from frictionzoo.report.terminal import summarise

        return summarise(self.result, self.folder)

    def _repr_html_(self) -> str:
        from frictionzoo.report.terminal import summarise_in_html

        return summarise_in_html(self.result, self.folder)
