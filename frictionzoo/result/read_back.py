"""Reading a run's folder back: the law's values, the bench's, and the rollouts that it was judged on."""

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
from frictionzoo.core.output import RESULT
from frictionzoo.core.segments import Segments
from frictionzoo.models import FrictionModel
from frictionzoo.result.curves import Curves
from frictionzoo.result.types import Result

LAW = "friction.safetensors"


def build_drive(folder: Path, settings: Mapping[str, Any]) -> tuple[Bench, FrictionModel]:
    """The bench and the law of saved settings, which may be a stranger's.

    Args:
        folder: Of the run or card, for messages.
        settings: Its settings; the law's has the laws of several joints whole.

    Raises:
        RunError: No bench or law can be made of them.
        FrictionzooError: The MJCF is not there any more or does not fit them, or the law does not.
    """
    try:
        bench = build(settings.get("bench"), Bench)
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


def load_law(model: FrictionModel, path: Path) -> dict[str, torch.Tensor]:
    """Write the saved values into the model, and return them."""
    return put_law(model, read_tensors(path, model.name), path)


def read_tensors(path: Path, whose: str) -> dict[str, torch.Tensor]:
    """What a file of safetensors holds, which is numbers, so nothing is executed.

    Args:
        path: Of the file.
        whose: Whose values it has, for messages.

    Raises:
        RunError: It cannot be read.
    """
    try:
        return safetensors.torch.load(path.read_bytes())
    except OSError as error:
        raise RunError(f"{path}: {error.strerror}; expected the folder of a finished run; run it again") from None
    except safetensors.SafetensorError as error:
        raise RunError(
            f"{path}: {' '.join(str(error).split())}; expected the values of {whose}; run it again"
        ) from None


def put_law(model: FrictionModel, saved: dict[str, torch.Tensor], path: Path) -> dict[str, torch.Tensor]:
    """Write values into the model, and return them; RunError, which names their file, where they are another's."""
    try:
        model.double().load_state_dict(saved)
        return saved
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise RunError(f"{path}: {reason}; expected the values of {model.name}; run it again") from None


def read_bench(result: Result, bench: Bench) -> dict[str, Float[np.ndarray, "nv"]]:
    """Values of the bench's parameters by name; RunError where they are not those of its settings."""
    found = {row["name"]: row["value"] for row in result["parameters"] if row["owner"] == "bench"}
    if set(found) != set(bench.params):
        came, expected = (", ".join(sorted(names)) for names in (found, bench.params))
        line = f"parameters {came} of the bench, expected {expected} as in its settings; run it again"
        raise RunError(f"{RESULT}: {line}")
    return {name: np.broadcast_to(np.asarray(found[name], np.float64), bench.nv).copy() for name in bench.params}


def read_segments(path: Path, curves: Curves, interval: float, bench: Bench) -> Segments:
    """The long test rollouts; RunError where they do not fit the bench.

    Args:
        path: Where they were read from, for messages.
        curves: What was read.
        interval: Of the samples [s].
        bench: The test stand.
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
    """Every so many samples of the same segments, and as many of the command before them as late commands need."""
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
    """The same segments with each command held for so many samples, as where others do not arrive."""
    if every == 1:
        return segments
    sample = every * (np.arange(-segments.history, segments.length) // every)
    held = np.maximum(segments.history + sample, 0)
    return replace(segments, signals=segments.signals.map(lambda signal: signal[:, held]))
