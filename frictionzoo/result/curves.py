"""`curves.safetensors`: arrays for the figures of a run and of comparisons of runs."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import safetensors
import safetensors.numpy
from jaxtyping import Float, Shaped

from frictionzoo.core.errors import RunError
from frictionzoo.core.output import write_atomically
from frictionzoo.core.state import Signals
from frictionzoo.result.portrait import Portrait

FILE = "curves.safetensors"
OWN = "history", "signals", "train_errors", "portraits", "left_time", "left", "recording", "begins"
"""Fields whose size may differ between runs on the same data. It depends on the iterations of the fit, the bench's
delay, the finite training rollouts, the quantities that the model sees, the bandwidth of the torque comparison, and
the version of the run."""
LATER = "recording", "begins"
"""Fields that runs of earlier versions lack."""
_HISTORY, _PORTRAITS = "history.", "portraits."


@dataclass(frozen=True)
class Curves:
    """Arrays for the figures of a run, in `float64`.

    Attributes:
        measured_qpos: Position in the long test rollouts [rad or m].
        measured_qvel: Velocity in the long test rollouts [rad/s or m/s].
        signals: Signals that drive these rollouts, as in `Segments`.
        load: Changes of the bench's model by their payloads.
        qpos: Simulated position in these rollouts [rad or m].
        qvel: Simulated velocity [rad/s or m/s].
        baseline_qpos: Position simulated without friction [rad or m].
        baseline_qvel: Velocity simulated without friction [rad/s or m/s].
        train_mae: Position MAE of each training rollout of the main horizon [rad or m]; NaN: diverged.
        test_mae: Position MAE of each test rollout of the main horizon.
        local_mae: Position MAE of each short rollout over the test part.
        local_speed: Mean absolute measured velocity in each short rollout [rad/s or m/s].
        local_load: Mean absolute motor torque in each short rollout, with the bench's initial values [N m or N].
        velocity: Velocities of the friction curve [rad/s or m/s].
        friction: Friction torque of the model, median over states recorded at about that velocity [N m or N].
        friction_low: 10 % quantile over these states.
        friction_high: 90 % quantile over these states.
        history: One row per iteration of the fit: `iteration`, `loss`, `grad_norm`, `bench.NAME`, `friction.NAME`.
        train_errors: Position errors in training rollouts of the main horizon, as in `Judgement`.
        portraits: Friction curves of model and recordings, by the quantity on the axis, as returned by `portray`.
        left_time: Time in the analysed training recordings, one after the other [s].
        left: Residual torque in motion [N m or N]; NaN at rest.
        recording: Number of the recording of each long test rollout, within the test part.
        begins: Time in that recording at the first state of the rollout [s].
    """

    measured_qpos: Float[np.ndarray, "rollouts states nv"]
    measured_qvel: Float[np.ndarray, "rollouts states nv"]
    signals: Signals
    load: Float[np.ndarray, "rollouts load"]
    qpos: Float[np.ndarray, "rollouts steps nv"]
    qvel: Float[np.ndarray, "rollouts steps nv"]
    baseline_qpos: Float[np.ndarray, "rollouts steps nv"]
    baseline_qvel: Float[np.ndarray, "rollouts steps nv"]
    train_mae: Float[np.ndarray, "train"]
    test_mae: Float[np.ndarray, "test"]
    local_mae: Float[np.ndarray, "windows"]
    local_speed: Float[np.ndarray, "windows"]
    local_load: Float[np.ndarray, "windows"]
    velocity: Float[np.ndarray, "points"]
    friction: Float[np.ndarray, "points nv"]
    friction_low: Float[np.ndarray, "points nv"]
    friction_high: Float[np.ndarray, "points nv"]
    history: Mapping[str, Shaped[np.ndarray, "iterations ..."]]
    train_errors: Float[np.ndarray, "kept horizon joints"] = field(default_factory=lambda: np.empty((0, 0, 0)))
    portraits: Mapping[str, Portrait] = field(default_factory=dict)
    left_time: Float[np.ndarray, "rows"] = field(default_factory=lambda: np.empty(0))
    left: Float[np.ndarray, "rows drawn"] = field(default_factory=lambda: np.empty((0, 0)))
    recording: Float[np.ndarray, "placed"] = field(default_factory=lambda: np.empty(0))
    begins: Float[np.ndarray, "placed"] = field(default_factory=lambda: np.empty(0))

    def without_recordings(self) -> "Curves":
        """Return the friction curves and the fit's history; arrays of rollouts and recordings are empty."""
        emptied = {name: getattr(self, name)[:0] for name in _ARRAYS if not name.startswith(("velocity", "friction"))}
        return replace(self, signals=self.signals.map(lambda signal: signal[:0]), **emptied)


_NAMED = "signals", "history", "portraits"
_ARRAYS = tuple(each.name for each in fields(Curves) if each.name not in _NAMED)


def write_curves(folder: Path, curves: Curves) -> None:
    """Write `curves.safetensors` into a run's folder; OutputError if it cannot be written."""
    arrays = {name: getattr(curves, name) for name in _ARRAYS} | curves.signals.named()
    arrays |= {f"{_HISTORY}{name}": values for name, values in curves.history.items()}
    arrays |= {
        f"{_PORTRAITS}{o}.{n}": a for o, portrait in curves.portraits.items() for n, a in portrait._asdict().items()
    }
    tensors = {name: np.ascontiguousarray(values, dtype=np.float64) for name, values in arrays.items()}
    write_atomically(folder / FILE, safetensors.numpy.save(tensors))


def read_curves(folder: Path) -> Curves:
    """Read `curves.safetensors` of a run; RunError if the file is missing, damaged or of another version."""
    path = folder / FILE
    try:
        arrays: dict[str, Any] = safetensors.numpy.load(path.read_bytes())
        history = {key.removeprefix(_HISTORY): value for key, value in arrays.items() if key.startswith(_HISTORY)}
        signals = Signals.from_named(arrays)
        quantities = sorted({key.split(".")[1] for key in arrays if key.startswith(_PORTRAITS)})
        portraits = {
            name: Portrait(*(arrays[f"{_PORTRAITS}{name}.{part}"] for part in Portrait._fields)) for name in quantities
        }
        mappings = {"signals": signals, "history": history, "portraits": portraits}
        names = [name for name in _ARRAYS if name in arrays or name not in LATER]
        curves = Curves(**{name: arrays[name] for name in names}, **mappings)
        _check_shapes(curves)
        return curves
    except OSError as error:
        raise RunError(f"{path}: {error.strerror}; expected the folder of a finished run; run it again") from None
    except (safetensors.SafetensorError, KeyError, ValueError) as error:
        raise RunError(
            f"{path}: {' '.join(str(error).split())}; expected the file that this version writes; run it again"
        ) from None


def _check_shapes(curves: Curves) -> None:
    """Raise ValueError if an array does not match the shape in its annotation; all arrays share named sizes."""
    sizes: dict[str, int] = {}
    _check_record(curves, get_type_hints(Curves), sizes)
    for quantity, portrait in curves.portraits.items():
        _check_record(portrait, get_type_hints(Portrait), {"nv": sizes["nv"]}, f"{_PORTRAITS}{quantity}.")
    for name, values in curves.history.items():
        if values.ndim not in (1, 2) or len(values) != len(curves.history["iteration"]) or "loss" not in curves.history:
            raise ValueError(
                f"{_HISTORY}{name} of shape {values.shape}, expected a row an iteration, and {_HISTORY}loss"
            )
    for name, values in curves.signals.named().items():
        if values.ndim != 3 or len(values) != sizes["rollouts"]:
            raise ValueError(f"{name} of shape {values.shape}, expected {sizes['rollouts']} rollouts of samples")


def _check_record(record: Any, types: Mapping[str, Any], sizes: dict[str, int], prefix: str = "") -> None:
    for name, annotated in types.items():
        if not hasattr(annotated, "dim_str"):
            continue
        array, wanted = getattr(record, name), annotated.dim_str.split()
        shared = [sizes.setdefault(dimension, size) for dimension, size in zip(wanted, array.shape, strict=False)]
        if len(wanted) != array.ndim or shared != [*array.shape] or array.dtype != np.float64:
            raise ValueError(
                f"{prefix}{name} of type {array.dtype} and shape {array.shape}, expected ({annotated.dim_str})"
            )
