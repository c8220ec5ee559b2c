"""Fit loop in Lightning: chunks of compiled iterations, with logs, progress, checkpoints and stopping between them."""

import contextlib
import io
import logging
import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import lightning.pytorch as pl
import torch
from lightning.pytorch.plugins import TorchCheckpointIO
from lightning.pytorch.plugins.environments import LightningEnvironment
from tqdm import tqdm

from frictionzoo.core.errors import CheckpointError, ConfigError, OutputError, refuse_outside
from frictionzoo.core.output import claim, write_atomically
from frictionzoo.core.telling import is_watched, tell
from frictionzoo.fit.base import Fit
from frictionzoo.fit.loggers import RunLogger
from frictionzoo.fit.module import FitModule, Outcome
from frictionzoo.fit.objective import Objective
from frictionzoo.models import FrictionModel
from frictionzoo.simulation.bridge import load_from_jax

CHECKPOINT = "last.ckpt"
BESIDE = 60  # terminal columns for the bar, its counts and its times
MOST_CHUNK = 1_000_000  # iterations in one call, which returns one row per iteration
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FitFiles:
    """Record of a fit on disk, for viewers and for resuming the fit after an interruption.

    Attributes:
        folder: The run's folder, for `checkpoints/` and the logger's files.
        logger: Logger of loss, gradient norm and parameters of every iteration; the caller finishes it.
        identity: Values by name that must agree with the checkpoint's before the fit resumes.
        hyperparameters: Description of the run for the logger; see `RunLogger.start`.
    """

    folder: Path
    logger: RunLogger
    identity: Mapping[str, str] = field(default_factory=dict)
    hyperparameters: Mapping[str, Any] = field(default_factory=dict)


def run_fit(
    fit: Fit,
    objective: Objective,
    model: FrictionModel,
    record: FitFiles | None = None,
    *,
    chunk: int = 25,
    patience: int | None = None,
    progress: bool = True,
) -> Outcome:
    """Run a fit to its end, from the record's checkpoint if there is one; `model` then holds the best values.

    An interrupted and resumed fit ends with the same bits as an uninterrupted one. Without `record` the history is in
    memory only. `chunk` is the number of iterations in one compiled call, `patience` the number without a better loss
    after which to stop. `progress` shows a bar if the output is a terminal.

    Raises:
        CheckpointError: The checkpoint cannot be read, or belongs to another run.
        FitError: No iteration has a finite loss and gradient.
        OutputError: A checkpoint or the logger's record cannot be written.
        ConfigError: An argument is out of range.
    """
    refuse_outside("loop.chunk", chunk, 1, MOST_CHUNK)
    if patience is not None and patience < 1:
        raise ConfigError(f"loop.patience={patience}; expected at least 1")
    checkpoint = _checked_checkpoint(record.folder, record.identity) if record else None
    began = time.perf_counter()
    module = FitModule(fit, objective, model, record.identity if record else {}, chunk, patience)
    compile_seconds = time.perf_counter() - began
    _train(module, record, checkpoint, progress)
    outcome = module.outcome(compile_seconds, time.perf_counter() - began - compile_seconds)
    load_from_jax(model, jax.tree.map(jnp.asarray, outcome.values["friction"]))
    return outcome


class _AtomicFiles(TorchCheckpointIO):
    """Checkpoint writer that replaces a file atomically; Lightning moves it between disks, which can be interrupted."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        content = io.BytesIO()
        torch.save(checkpoint, content)
        write_atomically(Path(path), content.getvalue())


class _Saver(pl.Callback):
    """Callback that saves after each chunk; Lightning's ModelCheckpoint counts torch optimiser steps, always 0 here."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        trainer.save_checkpoint(self._path)


class _ProgressBar(pl.Callback):
    _bar: tqdm | None = None

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        assert isinstance(pl_module, FitModule)
        tell("")
        done, total = pl_module.iteration, pl_module.total
        self._bar = tqdm(desc="fit", total=total, initial=done, unit="it", disable=not is_watched())
        tell("", self._bar.refresh)

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        assert isinstance(pl_module, FitModule) and self._bar is not None
        self._bar.update(pl_module.iteration - self._bar.n)
        trace = pl_module.history[-1]
        if len(trace.loss) and not self._bar.disable:
            values = (
                f"{name.partition('.')[2]}={' '.join(f'{v:.4g}' for v in rows[-1])}"
                for name, rows in trace.params.items()
            )
            text = ", ".join([f"loss={trace.loss[-1]:.3e}", *values])
            self._bar.set_postfix_str(text[: (self._bar.ncols or 80) - BESIDE])

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self._close()

    def on_exception(self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException) -> None:
        self._close()  # so that the error message starts on a new line

    def _close(self) -> None:
        if self._bar is not None:
            tell("")
            self._bar.close()


def _train(module: FitModule, record: FitFiles | None, checkpoint: Path | None, progress: bool) -> None:
    folder = record.folder if record else Path()
    callbacks: list[pl.Callback] = [_Saver(record.folder / "checkpoints" / CHECKPOINT)] if record else []
    limits = module.objective.space.limits()
    # Lightning's advice about data loaders and GPUs does not apply: its loader holds one item.
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    claimed = claim(folder, "run") if record else contextlib.nullcontext()
    with warnings.catch_warnings(), claimed:
        warnings.filterwarnings("ignore", module="lightning")
        try:
            trainer = pl.Trainer(
                accelerator="cpu",
                devices=1,
                max_epochs=-1,
                logger=record.logger.start(folder, record.hyperparameters, limits) if record else False,
                callbacks=[*callbacks, *([_ProgressBar()] if progress else [])],
                plugins=[LightningEnvironment(), _AtomicFiles()],
                enable_checkpointing=False,
                enable_progress_bar=False,
                enable_model_summary=False,
                default_root_dir=folder,
            )
            trainer.fit(module, ckpt_path=checkpoint, weights_only=True)
        except OSError as error:
            raise OutputError(
                f"{folder}: {error.strerror or error} while writing the fit's progress; free space or set hydra.run.dir"
            ) from None


def _checked_checkpoint(folder: Path, identity: Mapping[str, str]) -> Path | None:
    """Return the folder's checkpoint, or None; raise CheckpointError if it belongs to another run."""
    path = folder / "checkpoints" / CHECKPOINT
    if not path.exists():
        return None
    try:
        saved = dict(torch.load(path, weights_only=True, map_location="cpu")["frictionzoo"]["identity"])
    except Exception as error:  # torch raises a dozen types for files that are not checkpoints
        raise CheckpointError(
            f"{path}: cannot be read ({type(error).__name__}), expected a checkpoint of this version; start a new run"
        ) from None
    for name, value in identity.items():
        if saved.get(name) != value:
            raise CheckpointError(
                f"{path}: {name} {saved.get(name)}, expected {value}; resume with the command that began the run, or "
                "start a new one"
            )
    _log.info("resuming from %s", path)
    return path
