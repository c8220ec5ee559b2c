"""Reader of a run's folder: values of friction model and bench, and the rollouts of the evaluation."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.torch
import torch
from jaxtyping import Float

from frictionzoo.bench import Bench
from frictionzoo.core.build import build
from frictionzoo.core.errors import ConfigError, RunError
from frictionzoo.core.jobs import read_begun
from frictionzoo.core.output import RESULT
from frictionzoo.core.segments import Segments
from frictionzoo.models import FrictionModel
from frictionzoo.result.curves import Curves
from frictionzoo.result.types import Result

LAW = "friction.safetensors"


def build_drive(folder: Path, settings: Mapping[str, Any]) -> tuple[Bench, FrictionModel]:
    """Build bench and friction model from saved settings, which may come from someone else; `folder` is for messages.

    Raises:
        RunError: The settings do not describe a bench and a model.
        FrictionzooError: The MJCF is missing, or MJCF or model do not fit the settings.
    """
    try:
        bench = build(_find_model_file(folder, settings.get("bench")), Bench)
        model = build(settings.get("model"), FrictionModel, nv=bench.nv)
        model.bind(bench.joints)
        return bench.observing(model.inputs), model
    except ConfigError as error:
        raise RunError(f"{folder}: its settings: {error}") from None
    except (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
        reason = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        raise RunError(
            f"{folder}: no bench and model can be built from its settings ({reason}); expected a folder that this "
            "program wrote"
        ) from None


def _find_model_file(folder: Path, bench: Any) -> Any:
    """Return a bench's settings; a relative path of its model file may start where the run was started."""
    started = read_begun(folder, "hydra", "hydra", "runtime", "cwd")
    mjcf = bench.get("mjcf") if isinstance(bench, Mapping) else None
    if not isinstance(started, str) or not isinstance(mjcf, str) or Path(mjcf).exists():
        return bench
    path = Path(started) / mjcf
    return {**bench, "mjcf": str(path)} if path.is_file() else bench


def load_law(model: FrictionModel, path: Path) -> dict[str, torch.Tensor]:
    """Load saved values into the model and return them; the file holds numbers only and executes nothing.

    Raises:
        RunError: The file cannot be read, or its values do not fit the model.
    """
    try:
        saved = safetensors.torch.load(path.read_bytes())
        model.double().load_state_dict(saved)
        return saved
    except OSError as error:
        raise RunError(f"{path}: {error.strerror}; expected the folder of a finished run; run it again") from None
    except (safetensors.SafetensorError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise RunError(f"{path}: {reason}; expected the values of {model.name}; run it again") from None


def read_bench(result: Result, bench: Bench) -> dict[str, Float[np.ndarray, "nv"]]:
    """Read the bench's parameter values by name; raise RunError if the names differ from its settings."""
    values = {row.name: row.value for row in result.parameters if row.owner == "bench"}
    if set(values) != set(bench.params):
        saved, expected = (", ".join(sorted(names)) for names in (values, bench.params))
        line = f"parameters {saved} of the bench, expected {expected} as in its settings; run it again"
        raise RunError(f"{RESULT}: {line}")
    return {name: np.broadcast_to(np.asarray(values[name], np.float64), bench.nv).copy() for name in bench.params}


def read_segments(path: Path, curves: Curves, interval: float, bench: Bench) -> Segments:
    """Rebuild the long test rollouts from the curves; `path` is for messages, `interval` the sample interval [s].

    Raises:
        RunError: The curves do not fit the bench.
    """
    signals, states = curves.signals, curves.measured_qpos.shape[1]
    (samples, joints), *others = (signal.shape[1:] for signal in signals.named().values())
    if curves.measured_qpos.shape[2] != bench.nv or joints != bench.nv or samples < states - 1:
        raise RunError(
            f"{path}: {joints} joints and {samples} commands for {states} states, expected {bench.nv} joints and a "
            "command for each step; run it again"
        )
    if {*signals.inputs, *signals.observed} != {*bench.inputs} or any(shape != (samples, joints) for shape in others):
        raise RunError(
            f"{path}: inputs {', '.join([*signals.inputs, *signals.observed]) or 'nothing'}, expected "
            f"{', '.join(bench.inputs) or 'nothing'}, {samples} samples each; run it again"
        )
    load = curves.load if curves.load.shape[1] else None
    return Segments(curves.measured_qpos, curves.measured_qvel, signals, interval, load)


def thin(segments: Segments, every: int, history: int) -> Segments:
    """Keep one sample in `every`, and `history` commands before the first state for the delay."""
    steps = segments.length // every
    state = every * np.arange(steps + 1)
    command = np.maximum(segments.history + every * np.arange(-history, steps), 0)
    return replace(
        segments,
        qpos=segments.qpos[:, state],
        qvel=segments.qvel[:, state],
        signals=segments.signals.map(lambda signal: signal[:, command]),
        timestep=every * segments.timestep,
    )


def hold(segments: Segments, every: int) -> Segments:
    """Hold each command for `every` samples, as if those between did not arrive."""
    if every == 1:
        return segments
    sample = every * (np.arange(-segments.history, segments.length) // every)
    commands = np.maximum(segments.history + sample, 0)
    return replace(segments, signals=segments.signals.map(lambda signal: signal[:, commands]))
