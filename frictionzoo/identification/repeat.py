"""Another identification of a fitted drive: new recordings, the settings of its run, no automatic settings."""

import copy
from collections.abc import Mapping
from typing import Any, cast

from omegaconf import OmegaConf

from frictionzoo.core.build import build
from frictionzoo.core.config import compose_settings, create_literal, keep_caches_at_home
from frictionzoo.data.logs import Logs
from frictionzoo.fit import Fit
from frictionzoo.identification.problem import Problem
from frictionzoo.identification.recipe import Parts
from frictionzoo.identification.solve import solve
from frictionzoo.result.fitted_drive import FittedDrive

_CHECKED = ("segments", "loss", "evaluation", "loop", "scale", "checkup", "discretisation", "seed")
_CHECKED += ("dtype", "engine", "device", "compilation_cache", "threads")


def repeat_fit(drive: FittedDrive, logs: Logs) -> FittedDrive:
    """Identify a drive again from other recordings, starting at its values, with the settings of its run.

    Automatic settings stay as the run chose them: step, segments, loss, known values and optional parameters.
    Link inertia and gravity stay as the run identified them.

    Raises:
        FrictionzooError: The recordings do not fit the drive or have a definite fault, or a setting is invalid.
    """
    settings = {**_settle(drive.result.settings), "data": dict(logs.section)}
    bench, fit = drive.bench.begun(drive.values["bench"]), build(settings["fit"], Fit)
    parts = Parts.settle(settings, bench, logs.divide(), copy.deepcopy(drive.model), fit)
    with parts.computing() as device:
        return solve(Problem.pose(parts), drive.result.model, device)


def _settle(saved: Mapping[str, Any]) -> dict[str, Any]:
    """Return a run's settings, checked because they may be a stranger's, without searches before the fit."""
    saved = keep_caches_at_home(saved)
    chosen = create_literal({name: saved[name] for name in _CHECKED if name in saved})
    settings = compose_settings(cast(dict[str, Any], OmegaConf.to_container(chosen)), "recipe=given")
    fit = dict(saved["fit"])
    fit |= {name: value for name, value in {"start": None, "links": [], "tilt": False}.items() if name in fit}
    return {**settings, "bench": saved["bench"], "model": saved["model"], "fit": fit, "logger": None}
