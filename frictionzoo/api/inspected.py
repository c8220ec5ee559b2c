"""`fz.inspect`: diagnostics of recordings before a fit."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from frictionzoo.core.errors import LogError, refuse_unlike
from frictionzoo.core.log import Log
from frictionzoo.core.output import claim, write_json
from frictionzoo.data.logs import Logs
from frictionzoo.data.pairing import arrange_recording
from frictionzoo.data.recording import Recording
from frictionzoo.diagnostics.findings import Finding
from frictionzoo.diagnostics.survey import Survey, as_recording, put_in_order, survey_recordings
from frictionzoo.report.inspection_page import write_page
from frictionzoo.report.inspection_terminal import summarise

if TYPE_CHECKING:  # a survey without a bench does not import MuJoCo
    from frictionzoo.bench.base import Bench

FILES = ("inspect.html", "inspect.json")


@dataclass(frozen=True, eq=False, repr=False)
class Inspected:
    """Diagnostics of recordings; its text is the summary of `python -m frictionzoo.inspect`.

    Attributes:
        survey: Content of `inspect.json`.
        recordings: The recordings before cleaning, with columns in one joint order.
    """

    survey: Survey
    recordings: Sequence[Recording]

    @classmethod
    def of(
        cls, name: str, recordings: Sequence[Recording], joints: Sequence[str] = (), joint_type: str | None = None
    ) -> "Inspected":
        """Survey raw recordings; `joints` and `joint_type` are those of their bench, if it is known.

        Raises:
            LogError: A recording is incomplete or too short, or the shapes of its signals disagree.
        """
        ordered, names = put_in_order(recordings, joints)
        return cls(survey_recordings(name, ordered, joint_type, names), ordered)

    @property
    def findings(self) -> list[Finding]:
        """Outcomes of all checks."""
        return [Finding(**finding) for finding in self.survey["findings"]]

    def save(self, folder: str | Path, command: str = "") -> None:
        """Write the page `inspect.html`, with the `command` to run next if any, and `inspect.json`.

        Raises:
            OutputError: A foreign file is in the way, or a file cannot be written.
        """
        folder = Path(folder)
        with claim(folder, "inspection", FILES):
            write_page(folder / "inspect.html", self.survey, self.recordings, command)
            write_json(folder / "inspect.json", self.survey)

    def __repr__(self) -> str:
        return summarise(self.survey, None)


def inspect(logs: Logs | Log | Sequence[Log], bench: "Bench | None" = None) -> Inspected:
    """Check recordings before a fit, as `python -m frictionzoo.inspect` does; write nothing.

    Args:
        logs: Recordings as `read` returns them, checked as they were before cleaning; or logs in memory.
        bench: Their test stand, which gives the names and units of the joints; None: not known.

    Raises:
        LogError: A recording is too short, or its columns do not match the joints of the bench.
        ConfigError: An argument has another type.
    """
    collected, joints, joint_type = Logs.of(logs), (), None
    recordings = [each for each in collected.recordings if each.signals] or [as_recording(log) for log in collected]
    if bench is not None:
        from frictionzoo.bench.base import Bench

        refuse_unlike("bench", bench, Bench, "a Bench, or None")
        recordings = [_arrange(recording, bench) for recording in recordings]
        joints, joint_type = bench.joints, bench.joint_type
    return Inspected.of(collected.name, recordings, joints, joint_type)


def _arrange(recording: Recording, bench: "Bench") -> Recording:
    """Return a recording with its columns in the order of the joints; without headers they have it."""
    if recording.columns:
        recording, _ = arrange_recording(recording, bench.joints, bench.passive)
    if (columns := recording.signals["qpos"].shape[1]) != bench.nv:
        joints = f"{bench.nv} for the joints {', '.join(bench.joints)}"
        raise LogError(f"{recording.name}: qpos has {columns} columns, expected {joints}; choose another bench.joint")
    return recording
