"""Lightning module of a fit, and the fit's outcome."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import lightning.pytorch as pl
import numpy as np
import torch
from jaxtyping import Float, Shaped

from frictionzoo.core.errors import CheckpointError, FitError
from frictionzoo.fit.base import Fit
from frictionzoo.fit.chunk import Chunk, Progress, Trace, begin, make_chunk
from frictionzoo.fit.objective import Objective
from frictionzoo.models import FrictionModel
from frictionzoo.simulation import Values
from frictionzoo.simulation.bridge import load_from_jax


@dataclass(frozen=True)
class Outcome:
    """Outcome of a fit.

    Attributes:
        vector: Coordinates of the best iteration.
        values: Physical values of all parameters there, by owner and name.
        best_iteration: The iteration with the lowest loss on the whole training set, from 0.
        loss: That loss.
        stopped: `converged`, `finished` (all iterations done), `patience`, `diverged`, or `interrupted`.
        message: For a fit that diverged, one line with the iteration and the parameter.
        history: Arrays with one entry per iteration: `iteration`, `loss`, `grad_norm`, and each identified physical
            parameter by full name, of shape (iterations, nv).
        compile_seconds: Time of tracing and compiling [s].
        fit_seconds: Time of the iterations and of everything between them [s].
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


class FitModule(pl.LightningModule):
    """Lightning module of a fit: one epoch is one chunk of iterations, and the method does the updates.

    Args:
        model: The friction model; a checkpoint holds its state_dict.
        identity: Values by name that must agree with the checkpoint's before the fit resumes.
        chunk: Iterations in one compiled call.
        patience: Number of iterations without a better loss after which to stop; None for no limit.
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
        fit = fit.choose(objective)
        self.automatic_optimization = False
        self.friction: FrictionModel = model
        self.total: int = fit.total(objective)
        self.chunk: int = min(chunk, self.total)
        self.progress: Progress = begin(fit, objective)
        self.history: list[Trace] = []
        self._fit = fit
        self.objective: Objective = objective
        self._identity = dict(identity)
        self._patience = patience
        self._run: Chunk = make_chunk(fit, objective, self.chunk)

    @property
    def iteration(self) -> int:
        """Number of iterations done."""
        return int(self.progress.iteration)

    @property
    def stopped(self) -> str | None:
        """Why the fit is over, or None while it runs; depends on the progress only."""
        if bool(self.progress.broken):
            return "diverged"
        if bool(self.progress.converged):
            return "converged"
        if self.iteration >= self.total:
            return "finished"
        waited = self.iteration - 1 - int(self.progress.best_iteration)
        return "patience" if self._patience is not None and waited >= self._patience else None

    def on_train_start(self) -> None:
        """Log the history of a resumed fit again, because its loggers start empty."""
        self._log_rows(0, self._whole_history())

    def training_step(self, *_: Any) -> None:
        """Run one chunk of iterations."""
        if self.stopped:
            self.trainer.should_stop = True
            return
        before = self.iteration
        self.progress, trace = self._run(self.progress, min(self.chunk, self.total - before))
        trace = jax.tree.map(lambda rows: np.asarray(rows)[: self.iteration - before], trace)
        self.history.append(trace)
        load_from_jax(self.friction, self.objective.space.values(self.progress.vector)["friction"])
        self._log_rows(before, trace)
        self.trainer.should_stop = self.stopped is not None

    def train_dataloader(self) -> Iterable[int]:
        """Return one item, for one step per epoch; the objective holds the segments."""
        return [0]

    def configure_optimizers(self) -> None:
        """Return None: the method does the updates."""

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Save tensors and text only, so that a checkpoint loads without unpickling."""
        checkpoint["frictionzoo"] = {
            "identity": self._identity,
            "progress": _to_tensors(self.progress),
            "history": _to_tensors(self._whole_history()),
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore progress and history."""
        try:
            saved = checkpoint["frictionzoo"]
            progress = _from_tensors(saved["progress"], self.progress)
            history = _from_tensors(saved["history"], self._whole_history(), rows=int(progress.iteration))
        except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
            raise CheckpointError(
                f"last.ckpt: its progress cannot be read ({error}), expected a checkpoint of this run; start a new run"
            ) from None
        self.progress, self.history = progress, [jax.tree.map(np.asarray, history)]

    def outcome(self, compile_seconds: float, fit_seconds: float) -> Outcome:
        """Return the outcome so far.

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
            values=jax.tree.map(np.asarray, self.objective.space.values(self.progress.best)),
            iterations=self.iteration,
            best_iteration=int(self.progress.best_iteration),
            loss=float(np.asarray(self.progress.best_loss, self.progress.vector.dtype)),
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
        has_best = int(self.progress.best_iteration) >= 0
        earlier = "the best earlier iteration is kept" if has_best else "no earlier iteration is finite"
        lower = "lower fit.learning_rate, or " if self._fit.name == "adam" else ""
        return (
            f"fit diverged at iteration {self.iteration}: {self._name_divergence()}; {earlier}; {lower}start from "
            "other initial values or narrower bounds"
        )

    def _name_divergence(self) -> str:
        space, gradient = self.objective.space, np.asarray(self.progress.gradient)
        if np.isfinite(gradient).any():
            return f"the gradient of {space.first_nonfinite(gradient)} is not finite"
        # A loss that is not finite has no finite gradient entry, so the gradient does not show the cause.
        if int(self.progress.best_iteration) < 0:
            return f"the loss or its gradient is not finite at the initial values of {', '.join(space.names)}"
        farthest = space.farthest(np.asarray(self.progress.vector), np.asarray(self.progress.best))
        return f"the loss or its gradient is not finite, with {farthest} farthest from its best value"

    def _whole_history(self) -> Trace:
        if self.history:
            return jax.tree.map(lambda *parts: np.concatenate(parts), *self.history)
        empty = np.zeros(0, self.progress.vector.dtype)
        params = self.objective.space.identified(self.progress.vector)
        return Trace(empty, empty, {name: np.zeros((0, *value.shape), value.dtype) for name, value in params.items()})

    def _log_rows(self, before: int, trace: Trace) -> None:
        columns = {"loss": trace.loss, "grad_norm": trace.grad_norm}
        columns |= self.objective.space.pick({name: values.T for name, values in trace.params.items()})
        for row in range(len(trace.loss)):
            for logger in self.loggers:
                logger.log_metrics({name: float(column[row]) for name, column in columns.items()}, step=before + row)
        for logger in self.loggers:
            logger.save()  # so that a viewer shows it at once


def _to_tensors(tree: Any) -> list[torch.Tensor]:
    return [torch.from_numpy(np.array(leaf)) for leaf in jax.tree.leaves(tree)]


def _from_tensors(tensors: list[torch.Tensor], like: Any, rows: int | None = None) -> Any:
    """Return the tensors as a pytree like `like`, with `rows` rows if given; raise ValueError on a mismatch."""
    expected = jax.tree.leaves(like)
    for tensor, leaf in zip(tensors, expected, strict=True):
        array, kind = tensor.numpy(), np.asarray(leaf).dtype
        shape = np.shape(leaf) if rows is None else (rows, *np.shape(leaf)[1:])
        if array.dtype != kind or array.shape != shape:
            raise ValueError(f"{array.dtype} of shape {array.shape}, expected {kind} of shape {shape}")
    # numpy stays numpy: JAX would round float64 in 32-bit mode.
    leaves = [
        tensor.numpy() if isinstance(leaf, np.ndarray) else jnp.asarray(tensor.numpy())
        for tensor, leaf in zip(tensors, expected, strict=True)
    ]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)
