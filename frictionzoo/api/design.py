"""`design_recording`: the next command to record, and its files."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from frictionzoo.core.output import claim, refuse_existing, to_json, write_atomically, write_json
from frictionzoo.design.excitation import DesignedCommand, excite
from frictionzoo.design.write import files_of
from frictionzoo.report.design_page import write_page
from frictionzoo.result.fitted_drive import FittedDrive

NOTE = "excitation.json"


@dataclass(frozen=True)
class Design(DesignedCommand):
    """A command ready to record, with its expected motion."""

    def save(self, folder: str | Path) -> None:
        """Write the command, its expected motion and the page, and `excitation.json` last.

        Raises:
            OutputError: The folder exists, or cannot be written; then no files remain.
        """
        folder = Path(folder)
        refuse_existing(folder)
        parts = files_of(self)
        with claim(folder, "excitation", undone=True):
            for name, content in parts.items():
                write_atomically(folder / name, content)
            note = to_json({**self.note, "files": list(parts)})
            write_page(folder / "report.html", note, self.interval, self.motion)
            write_json(folder / NOTE, note)


def design_recording(options: Mapping[str, str], run: FittedDrive | None = None) -> Design:
    """Design the next command to record, as `python -m frictionzoo.design` does.

    Args:
        options: Options as text; see `frictionzoo.design.excitation.excite`.
        run: Run whose identified values describe the drive; None for the initial values of conf/.

    Raises:
        FrictionzooError: An option or the run is invalid, or no command keeps the limits.
    """
    return Design(**vars(excite(options, run)))
