"""`fz.drift`: whether a drive has changed since its runs."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from frictionzoo.api.identified import Identified
from frictionzoo.core.errors import FaultError, FitError, RunError, refuse_outside
from frictionzoo.core.log import Log
from frictionzoo.core.output import RUN_FILES, claim, write_json
from frictionzoo.data.logs import Logs
from frictionzoo.identification.solve import repeat_fit
from frictionzoo.report.terminal import summarise_drift
from frictionzoo.result.comparison.drift import Drift, judge_drift
from frictionzoo.result.fitted_drive import FittedDrive
from frictionzoo.simulation.context import refuse_late_fork

FILE = "drift.json"
ALARM = 0.01
"""Default probability of a false alarm."""
SMALLEST = 0.01
"""Default share below which a change does not count."""
_STANDS = ("bench.xml", "identified.xml")  # of a robot, and of a test stand


@dataclass(frozen=True, eq=False, repr=False)
class Drifted:
    """Drive compared with its finished runs.

    Attributes:
        record: Content of `drift.json`.
        drive: The drive as identified from the new recordings; None if they have a definite fault.
    """

    record: Drift
    drive: Identified | None

    @property
    def verdict(self) -> str:
        """`unchanged`, `changed` or `cannot tell`."""
        return self.record.verdict

    def save(self, folder: str | Path) -> None:
        """Write `drift.json` and the new identification, as a further run.

        Raises:
            OutputError: A foreign file is in the way, or a file cannot be written.
        """
        folder = Path(folder)
        with claim(folder, "run", (*RUN_FILES, FILE)):
            if self.drive:
                self.drive.save(folder)
            write_json(folder / FILE, self.record)

    def __repr__(self) -> str:
        return summarise_drift(self.record, None)


def drift(
    runs: FittedDrive | Sequence[FittedDrive],
    logs: Logs | Log | Sequence[Log],
    *,
    alarm: float = ALARM,
    smallest: float = SMALLEST,
) -> Drifted:
    """Test whether a drive has changed: identify it again from new recordings, with the settings of its first run.

    Args:
        runs: The drive's finished run, as `load` returns it. Several runs of the unchanged drive, with the same bench
            and model, show how far its parameters differ between repetitions; a change must exceed this too.
        logs: New recordings of the drive.
        alarm: Probability that an unchanged drive is reported as changed, over all parameters together.
        smallest: Smallest change that counts, as a share of the value, or of the scale of a parameter that may be 0.

    Returns:
        The verdict with each parameter then and now, and the new identification.

    Raises:
        RunError: A run has no intervals, its model file has changed, or the runs are not comparable.
        FrictionzooError: The recordings do not fit the drive, or an option is invalid.
    """
    refuse_late_fork()
    refuse_outside("alarm", alarm, 1e-6, 0.5)
    refuse_outside("smallest", smallest, 0.0, 10.0)
    drives = [runs] if isinstance(runs, FittedDrive) else list(runs)
    _refuse_incomparable(drives)
    reason, now = "", None
    try:
        now = Identified.of(repeat_fit(drives[0], Logs.of(logs)))
    except (FaultError, FitError) as error:
        reason = str(error)
    return Drifted(judge_drift(drives, now, alarm, smallest, reason), now)


def _refuse_incomparable(drives: Sequence[FittedDrive]) -> None:
    """Refuse runs without intervals, with a changed model file, or of another drive or model than the first one."""
    if not drives:
        raise RunError("runs: none, expected at least one finished run; load one")
    first = drives[0]
    for drive in drives:
        if drive.result.covariance is None:
            why = drive.result.no_intervals or "the data determine none of its parameters"
            raise RunError(f"{drive.place}: {why}, expected intervals to compare; use a run that has them")
        _refuse_changed_file(drive)
        for what in ("joints", "model"):
            own, expected = drive.result[what], first.result[what]
            if own != expected:
                raise RunError(f"{drive.place}: {what} {own}, expected {expected} as in {first.place}; leave it out")
        if body := _find_other_body(drive.bench.compile(constraint=False), first.bench.compile(constraint=False)):
            raise RunError(
                f"{drive.place}: another model file, body {body} differs, expected that of {first.place}; leave it out"
            )


def _refuse_changed_file(drive: FittedDrive) -> None:
    """Refuse a run whose model file is not the one that the run used, judged by the model that the run wrote."""
    path = next((path for name in _STANDS if drive.folder and (path := drive.folder / name).exists()), None)
    if path is None:
        return
    try:
        written = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise RunError(f"{path}: {' '.join(str(error).split())[:200]}; expected the file that the run wrote") from None
    if body := _find_other_body(drive.bench.compile(constraint=False), written):
        raise RunError(
            f"{drive.bench.source}: body {body} differs from {path}, expected the model file of that run; restore it, "
            "or identify the drive again"
        )


def _find_other_body(present: mujoco.MjModel, expected: mujoco.MjModel) -> str | None:
    """Return the first body that has other mass, inertia or place in another model, or is not in it."""
    for number in range(present.nbody):
        name = present.body(number).name
        other = mujoco.mj_name2id(expected, mujoco.mjtObj.mjOBJ_BODY, name) if name else number
        fields = ("body_mass", "body_inertia", "body_ipos", "body_pos")
        pairs = [
            (getattr(present, field)[number], getattr(expected, field)[other])
            for field in fields
            if 0 <= other < expected.nbody
        ]
        if not pairs or not all(np.allclose(own, old, rtol=1e-5, atol=1e-9) for own, old in pairs):
            return name or str(number)
    return None
