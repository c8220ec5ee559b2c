"""Lightning around a fit: chunks of compiled iterations; between them logs, progress, checkpoints, stop, resume."""

import io
import logging
import time
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import lightning.pytorch as pl
import numpy as np
import torch
from jaxtyping import Float, Shaped
from lightning.pytorch.plugins import TorchCheckpointIO
from lightning.pytorch.plugins.environments import LightningEnvironment
from tqdm import tqdm

from frictionzoo.core.errors import CheckpointError, ConfigError, FitError, OutputError, refuse_outside
from frictionzoo.core.output import write_atomically
from frictionzoo.fit.base import Fit, Progress, Trace
from frictionzoo.fit.loggers import RunLogger
from frictionzoo.fit.objective import Objective
from frictionzoo.models import FrictionModel
from frictionzoo.simulate import Values
from frictionzoo.simulate.bridge import load_from_jax

CHECKPOINT = "last.ckpt"
MOST_CHUNK = 1_000_000  # iterations in one call, which returns a row for each
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Outcome:
    """What a fit found.

    Attributes:
        method: The fit's name.
        vector: Coordinates of the best iteration.
        values: Physical values of all parameters there, by owner and name.
        iterations: Iterations done.
        best_iteration: The one with the lowest loss on the whole training set, from 0.
        loss: That loss.
        stopped: `converged`, `finished` (all iterations made), `patience`, or `diverged`.
        message: For a fit that diverged, one line that says at which iteration and for which parameter.
        history: Arrays with one entry an iteration: `iteration`, `loss`, `grad_norm`, and each identified physical
            parameter under its full name, of shape (iterations, nv).
        compile_seconds: Time that tracing and compiling took.
        fit_seconds: Time of the iterations and everything between them.
    """

    method: str
    vector: Float[np.ndarray, "coordinates"]
    values: Values
    iterations: int
    best_iteration: int
    loss: float
    stopped: str
    message: str | None
    history: Mapping[str, Shaped[np.ndarray, "iterations ..."]]
    compile_seconds: float
    fit_seconds: float


@dataclass(frozen=True)
class Record:
    """Where the course of a fit is kept, so that it can be watched and, once interrupted, go on.

    Attributes:
        folder: The run's folder, for `checkpoints/` and what the logger writes.
        logger: What records loss, gradient norm and parameters of every iteration; the caller finishes it.
        identity: What must agree before a checkpoint is taken up: name of the thing to its value.
        hyperparameters: What the logger says about the run, as in `RunLogger.start`.
    """

    folder: Path
    logger: RunLogger
    identity: Mapping[str, str] = field(default_factory=dict)
    hyperparameters: Mapping[str, Any] = field(default_factory=dict)


def run_fit(
    fit: Fit,
    objective: Objective,
    model: FrictionModel,
    record: Record | None = None,
    *,
    chunk: int = 25,
    patience: int | None = None,
    progress: bool = True,
) -> Outcome:
    """Run a fit to its end, from the record's checkpoint if it has one.

    An interrupted fit that is run again ends with the same bits, wherever it was interrupted.

    Args:
        fit: The method.
        objective: What it minimises.
        model: The friction model; it holds the best values afterwards.
        record: Where its course is kept; None to keep it in memory only.
        chunk: Iterations in one compiled call.
        patience: Stop after so many iterations without a better loss; None to run all.
        progress: Whether to show a progress bar where the terminal can.

    Raises:
        CheckpointError: The checkpoint cannot be read, or belongs to another run.
        FitError: The first iteration already has no finite loss or gradient.
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


class FitModule(pl.LightningModule):
    """A fit as Lightning sees it: one epoch is one chunk of iterations, which optax and not Lightning updates.

    Args:
        fit: The method.
        objective: What it minimises.
        model: The friction model, so that a checkpoint holds its state_dict.
        identity: What must agree before a checkpoint is taken up.
        chunk: Iterations in one compiled call.
        patience: Stop after so many iterations without a better loss.
    """

    def __init__(
        self,
        fit: Fit,
        objective: Objective,
        model: FrictionModel,
        identity: Mapping[str, str],
        chunk: int,
        patience: int | None,
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.friction = model
        self.total = fit.total(objective)
        self.chunk = min(chunk, self.total)
        self.progress: Progress = fit.start(objective)
        self.history: list[Trace] = []
        self._fit = fit
        self._objective = objective
        self._identity = dict(identity)
        self._patience = patience
        self._run = fit.chunk(objective, self.chunk)

    @property
    def iteration(self) -> int:
        """Iterations done."""
        return int(self.progress.iteration)

    @property
    def stopped(self) -> str | None:
        """Why the fit is over, or None while it is not; it depends on nothing but the progress."""
        if bool(self.progress.broken):
            return "diverged"
        if bool(self.progress.converged):
            return "converged"
        if self.iteration >= self.total:
            return "finished"
        waited = self.iteration - 1 - int(self.progress.best_iteration)
        return "patience" if self._patience is not None and waited >= self._patience else None

    def on_train_start(self) -> None:
        """A logger begins anew, also where the fit goes on from a checkpoint."""
        self._log_rows(0, self._whole_history())

    def training_step(self, *_: Any) -> None:
        """One chunk of iterations."""
        if self.stopped:
            self.trainer.should_stop = True
            return
        before = self.iteration
        self.progress, trace = self._run(self.progress, min(self.chunk, self.total - before))
        trace = jax.tree.map(lambda rows: np.asarray(rows)[: self.iteration - before], trace)
        self.history.append(trace)
        load_from_jax(self.friction, self._objective.space.values(self.progress.vector)["friction"])
        self._log_rows(before, trace)
        self.trainer.should_stop = self.stopped is not None

    def train_dataloader(self) -> Iterable[int]:
        """One step an epoch; the segments are inside the objective."""
        return [0]

    def configure_optimizers(self) -> None:
        """None: optax owns the update."""

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Tensors and text only, so that a checkpoint loads without unpickling."""
        checkpoint["frictionzoo"] = {
            "identity": self._identity,
            "progress": _to_tensors(self.progress),
            "history": _to_tensors(self._whole_history()),
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take up progress and history where they were."""
        saved = checkpoint["frictionzoo"]
        self.progress = _from_tensors(saved["progress"], self.progress)
        self.history = [jax.tree.map(np.asarray, _from_tensors(saved["history"], self._whole_history()))]

    def outcome(self, compile_seconds: float, fit_seconds: float) -> Outcome:
        """What has been found so far.

        Raises:
            FitError: No iteration had a finite loss.
        """
        message = self._explain_divergence()
        if int(self.progress.best_iteration) < 0:
            raise FitError(message or "no combination has a finite loss; expected at least one; change the bounds")
        trace = self._whole_history()
        return Outcome(
            method=self._fit.name,
            vector=np.asarray(self.progress.best),
            values=jax.tree.map(np.asarray, self._objective.space.values(self.progress.best)),
            iterations=self.iteration,
            best_iteration=int(self.progress.best_iteration),
            loss=float(self.progress.best_loss),
            stopped=self.stopped or "interrupted",
            message=message,
            history={
                "iteration": np.arange(len(trace.loss)),
                "loss": trace.loss,
                "grad_norm": trace.grad_norm,
                **trace.params,
            },
            compile_seconds=compile_seconds,
            fit_seconds=fit_seconds,
        )

    def _explain_divergence(self) -> str | None:
        if not bool(self.progress.broken):
            return None
        kept = (
            "the best of the iterations before it is kept"
            if int(self.progress.best_iteration) >= 0
            else "none before it"
        )
        return (
            f"fit diverged at iteration {self.iteration}: {self._name_divergence()}; {kept}; "
            f"{'lower fit.learning_rate, or ' if self._fit.name == 'adam' else ''}start from other initial values or "
            "narrower bounds"
        )

    def _name_divergence(self) -> str:
        space, gradient = self._objective.space, np.asarray(self.progress.gradient)
        if np.isfinite(gradient).any():
            return f"the gradient of {space.first_nonfinite(gradient)} is not finite"
        # A loss that is not finite has no finite gradient at all: that tells nothing about where it comes from.
        if int(self.progress.best_iteration) < 0:
            return f"the loss or its gradient is not finite at the initial values of {', '.join(space.names)}"
        moved = space.farthest(np.asarray(self.progress.vector), np.asarray(self.progress.best))
        return f"the loss or its gradient is not finite, with {moved} farthest from its best value"

    def _whole_history(self) -> Trace:
        if self.history:
            return jax.tree.map(lambda *parts: np.concatenate(parts), *self.history)
        empty = np.zeros(0, self.progress.vector.dtype)
        params = self._objective.space.identified(self.progress.vector)
        return Trace(empty, empty, {name: np.zeros((0, *value.shape), value.dtype) for name, value in params.items()})

    def _log_rows(self, before: int, trace: Trace) -> None:
        for row in range(len(trace.loss)):
            scalars = {"loss": trace.loss[row], "grad_norm": trace.grad_norm[row]}
            for name, values in trace.params.items():
                scalars |= _by_joint(name, values[row])
            for logger in self.loggers:
                logger.log_metrics({name: float(value) for name, value in scalars.items()}, step=before + row)


class _AtomicFiles(TorchCheckpointIO):
    """A checkpoint is put in place in one step, from the same folder.

    Lightning's own way goes through the temporary folder, and moving a file to another disk can be interrupted.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        content = io.BytesIO()
        torch.save(checkpoint, content)
        write_atomically(Path(path), content.getvalue())


class _Saver(pl.Callback):
    """A checkpoint after each chunk.

    Lightning's ModelCheckpoint counts steps of torch optimisers, of which there is none, and would save nothing.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        trainer.save_checkpoint(self._path)


class _ProgressBar(pl.Callback):
    """Iterations with the loss and the parameters of the last one."""

    _bar: tqdm | None = None

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        assert isinstance(pl_module, FitModule)
        # disable=None: tqdm shows nothing where the output is not a terminal.
        self._bar = tqdm(total=pl_module.total, initial=pl_module.iteration, unit="it", disable=None)

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        assert isinstance(pl_module, FitModule) and self._bar is not None
        self._bar.update(pl_module.iteration - self._bar.n)
        trace = pl_module.history[-1]
        if len(trace.loss):
            last = {name.partition(".")[2]: _short(values[-1]) for name, values in trace.params.items()}
            self._bar.set_postfix({"loss": f"{trace.loss[-1]:.3e}", **last})

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self._close()

    def on_exception(self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException) -> None:
        self._close()  # what is said about it stands on a line of its own

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()


def _train(module: FitModule, record: Record | None, checkpoint: Path | None, progress: bool) -> None:
    place = record.folder if record else Path()
    callbacks: list[pl.Callback] = [_Saver(record.folder / "checkpoints" / CHECKPOINT)] if record else []
    # Lightning's advice about data loaders and GPUs does not apply: its loader holds one item.
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module="lightning")
        try:
            trainer = pl.Trainer(
                accelerator="cpu",
                devices=1,
                max_epochs=-1,
                logger=record.logger.start(record.folder, record.hyperparameters) if record else False,
                callbacks=[*callbacks, *([_ProgressBar()] if progress else [])],
                plugins=[LightningEnvironment(), _AtomicFiles()],
                enable_checkpointing=False,
                enable_progress_bar=False,
                enable_model_summary=False,
                default_root_dir=place,
            )
            trainer.fit(module, ckpt_path=checkpoint, weights_only=True)
        except OSError as error:
            raise OutputError(
                f"{place}: {error.strerror or error} while writing the fit's progress; free space or set hydra.run.dir"
            ) from None


def _checked_checkpoint(folder: Path, identity: Mapping[str, str]) -> Path | None:
    """The folder's checkpoint if it has one and it belongs to this very run."""
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


def _to_tensors(tree: Any) -> list[torch.Tensor]:
    return [torch.from_numpy(np.array(leaf)) for leaf in jax.tree.leaves(tree)]


def _from_tensors(tensors: list[torch.Tensor], like: Any) -> Any:
    # numpy stays numpy: in JAX, float64 would be rounded where it computes in 32 bits.
    leaves = [
        tensor.numpy() if isinstance(leaf, np.ndarray) else jnp.asarray(tensor.numpy())
        for tensor, leaf in zip(tensors, jax.tree.leaves(like), strict=True)
    ]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _by_joint(name: str, values: np.ndarray) -> dict[str, float]:
    if len(values) == 1:
        return {name: float(values[0])}
    return {f"{name}/{joint}": float(value) for joint, value in enumerate(values)}


def _short(values: np.ndarray) -> str:
    return " ".join(f"{value:.4g}" for value in values)
