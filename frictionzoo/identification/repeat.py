"""Another identification of a fitted drive: new recordings, the settings of its run, no automatic settings."""

import copy
from collections.abc import Mapping
from typing import Any

from frictionzoo.core.build import build
from frictionzoo.core.config import keep_caches_at_home
from frictionzoo.data.logs import Logs
from frictionzoo.fit import Fit
from frictionzoo.identification.problem import Problem
from frictionzoo.identification.recipe import Parts
from frictionzoo.identification.solve import solve
from frictionzoo.result.fitted_drive import FittedDrive


def repeat_fit(drive: FittedDrive, logs: Logs) -> FittedDrive:
    """Identify a drive again from other recordings, starting at its values, with the settings of its run.

    Automatic settings stay as the run chose them: step, segments, loss, known values and optional parameters.
    Link inertia and gravity stay as the run identified them.

    Raises:
        FrictionzooError: The recordings do not fit the drive, or have a certain fault.
    """
    settings = {**_settle(drive.result.settings), "data": dict(logs.section)}
    bench, fit = drive.bench.begun(drive.values["bench"]), build(settings["fit"], Fit)
    parts = Parts.settle(settings, bench, logs.divide(), copy.deepcopy(drive.model), fit)
    with parts.computing() as device:
        return solve(Problem.pose(parts), drive.result.model, device)


def _settle(saved: Mapping[str, Any]) -> dict[str, Any]:
    """Return a run's settings, perhaps a stranger's, without searches before the fit."""
    settings, fit = keep_caches_at_home(saved), dict(saved["fit"])
    fit |= {name: value for name, value in {"start": None, "links": [], "tilt": False}.items() if name in fit}
    return {**settings, "fit": fit, "recipe": "given", "logger": None, "resume": None}
