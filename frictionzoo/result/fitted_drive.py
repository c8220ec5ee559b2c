"""Fitted drive of one run, computed by a fit or read from the run's folder: parameters, draws, simulation."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
import torch
from jaxtyping import Float

from frictionzoo.bench import Bench
from frictionzoo.core.errors import RunError
from frictionzoo.core.records import Proof
from frictionzoo.core.segments import Sampling, Segments
from frictionzoo.core.state import DriveState, Signals
from frictionzoo.core.units import UNITS
from frictionzoo.fit.posterior import Fitted
from frictionzoo.models import FrictionModel
from frictionzoo.models.formula import as_numpy, torch_values
from frictionzoo.result.curves import FILE as CURVES
from frictionzoo.result.curves import Curves
from frictionzoo.result.draws import (
    Posterior,
    PredictionInterval,
    draw_parameters,
    draw_with_chains,
    predict_band,
    put_values,
)
from frictionzoo.result.evaluate import Prediction, Values
from frictionzoo.result.read_back import LAW, build_drive, hold, load_law, read_bench, read_segments
from frictionzoo.result.record import read_run
from frictionzoo.result.simulator import RK4, put_into_simulator
from frictionzoo.result.types import JointErrors, Metrics, Result
from frictionzoo.result.values import ParameterArrays, read_parameters
from frictionzoo.simulation import Engine
from frictionzoo.simulation.drive import Drive
from frictionzoo.simulation.proof import Recorded, prove
from frictionzoo.simulation.rollout import applied, make_observer

PARTS = "train", "test", "baseline"
_Drive = TypeVar("_Drive", bound="FittedDrive")
Positions = Float[np.ndarray, "batch time nv"]


@dataclass(frozen=True, eq=False, repr=False)
class FittedDrive:
    """Fitted drive of one run, with the recordings of its evaluation.

    Attributes:
        folder: Folder of the run; None: in memory only.
        result: Content of `result.json`.
        model: Friction model with its identified values, in float64.
        state: These values as saved, in the model's dtypes.
        values: Values of all parameters and network weights, by owner (`bench`, `friction`) and name, as numpy arrays
            in float64. Shape: (nv,) for the bench, the `state_dict`'s for the friction model.
        segments: Long test rollouts: measured states and driving signals; empty for a drive from a card.
        sampling: Conversion of their samples to simulation steps.
        curves: Data of the figures; without rollouts for a drive from a card.
        complaint: One line if the fit diverged; None otherwise.
        fitted: Minimised loss with the training data; None for a drive read from a folder.
        origin: Drive that this one represents in a simulator (see `at`); None: this drive is the original.
    """

    folder: Path | None
    result: Result
    bench: Bench
    model: FrictionModel
    state: Mapping[str, torch.Tensor]
    values: Values
    segments: Segments
    sampling: Sampling
    curves: Curves
    complaint: str | None = None
    fitted: Fitted | None = None
    origin: "FittedDrive | None" = None

    @classmethod
    def load(cls: type[_Drive], folder: Path) -> _Drive:
        """Read a run's folder.

        Raises:
            RunError: The folder holds no finished run of this version, or a file is damaged.
            BenchError: The bench's MJCF is missing or has changed.
        """
        result, curves = read_run(folder)
        settings = result.settings
        bench, model = build_drive(folder, settings)
        state = load_law(model, folder / LAW)
        segments = read_segments(folder / CURVES, curves, result.data.timestep, bench)
        sampling = bench.sampling(segments.timestep)
        if sampling.history != segments.history:
            raise RunError(
                f"{folder / CURVES}: {segments.history} samples of ctrl before the rollouts, expected "
                f"{sampling.history} by the delay's bounds; run it again"
            )
        values = {"bench": read_bench(result, bench), "friction": as_numpy(torch_values(model))}
        return cls(folder, result, bench, model, state, values, segments, sampling, curves)

    @property
    def place(self) -> str:
        """Name of the drive for messages: its folder or its friction model."""
        return str(self.folder) if self.folder else f"the drive with {self.result.model}"

    @property
    def parameters(self) -> dict[str, ParameterArrays]:
        """Physical parameters of bench and friction model by full name, `bench.armature`."""
        return read_parameters(self.result, self.bench.nv)

    def sample(self, count: int, seed: int = 0) -> dict[str, Float[np.ndarray, "count nv"]]:
        """Draw drives consistent with the training data, with the correlations of the parameters.

        The draws come from a multivariate Student's t distribution of the optimiser's coordinates (`covariance` in
        `result.json`) and are clipped to the bounds. Of many draws, 95 % of a parameter's values lie in its interval.

        Returns:
            Values of each parameter that the data determine in any joint, by full name, in its unit; other joints keep
            their values.

        Raises:
            ConfigError: `count` is below 1.
            RunError: No parameter has an interval.
        """
        return draw_parameters(self.place, self.result, self.bench, self.model, count, seed)

    def posterior(self, count: int = 1000, seed: int = 0) -> Posterior:
        """Draw drives from the posterior distribution.

        The draws follow the shape of the loss within the bounds; `sample` is faster and has the same distribution where
        the loss is quadratic over the intervals. Four NUTS chains run on the loss, adjusted to the covariance of the
        intervals; see `frictionzoo.fit.posterior`. All parameters with an interval are drawn, identifiable or not.

        Needs a drive returned by `identify`, for its training data, and blackjax (extra `posterior`).

        Returns:
            Values by full name, in their unit, with convergence diagnostics of the chains.

        Raises:
            ConfigError: `count` is below 1, too many parameters were identified, or blackjax is not installed.
            FitError: The fit has not converged, there are too few data, or the chains do not agree.
            RunError: No parameter has an interval, or the drive was read from a folder.
        """
        return draw_with_chains(self.place, self.result, self.bench, self.fitted, count, seed)

    def band(self, segments: Segments | None = None, count: int = 100, seed: int = 0) -> PredictionInterval:
        """Predict the 95 % interval of the measured position in rollouts at each instant; see `predict_band`.

        Combines `count` drives from `sample` with the fitted drive's errors at the same time in training rollouts.
        Default `segments`: the run's long test rollouts. The interval ends at the evaluation's main horizon.

        Raises:
            RunError: Fewer than two training rollouts of the evaluation stayed finite.
        """
        segments = self.recorded if segments is None else segments
        draws = self.sample(count, seed) if self.result.covariance else {}

        def simulate(drawn: Mapping[str, Float[np.ndarray, "nv"]]) -> Positions:
            return self.rollout(segments, values=self.with_values(drawn))[0]

        return predict_band(self.place, simulate, draws, self.curves)

    def with_values(self, drawn: Mapping[str, Float[np.ndarray, "nv"] | float]) -> Values:
        """Return the values of all parameters with some replaced, by full name as from `sample`.

        Raises:
            ConfigError: A parameter is unknown; or a value has the wrong shape, is not finite, or is negative although
                the lower bound is not.
        """
        params = {"bench": self.bench.params, "friction": self.model.params}
        return put_values(self.values, drawn, params, self.bench.nv)

    @property
    def metrics(self) -> dict[str, Metrics]:
        """Errors of open-loop rollouts by part: `train`, `test`, and `baseline` (test part without friction)."""
        return {part: self.result.metrics[part] for part in PARTS}

    @property
    def by_joint(self) -> dict[str, dict[str, JointErrors]]:
        """Errors of each joint by name, on the parts of `metrics`."""
        return {row.joint: {part: row[part] for part in PARTS} for row in self.result.by_joint}

    @property
    def timestep(self) -> float:
        """Simulation step [s]."""
        return self.bench.timestep

    @property
    def units(self) -> Mapping[str, str]:
        """Unit of each dimension for the joints."""
        return UNITS[self.bench.joint_type]

    @property
    def recorded(self) -> Segments:
        """Long test rollouts; RunError if the drive comes from a card, which has no recordings."""
        if not self.segments.count:
            raise RunError(
                f"{self.place}: a card without recordings, expected segments or a run's folder; give "
                "rollout(segments), or use the run"
            )
        return self.segments

    @property
    def over(self) -> str:
        """Number and length of the long test rollouts, in words."""
        return f"{self.segments.count} rollouts of {self.segments.length * self.segments.timestep:g} s"

    def at(self: _Drive, timestep: float | None = None, integrator: str | None = None) -> _Drive:
        """Return the drive for a simulator with MuJoCo's steps.

        A drive with parameters in continuous time (`bench.second_order`) gets parameters that reproduce its motion in
        this simulator. With `RK4`, and for any other drive, the parameters stay the same. If the recordings' interval
        is not a whole number of steps, only every n-th sample is kept.

        Args:
            timestep: Simulation step [s]. None: the step of this drive; in continuous time, the model file's step if a
                few samples of the recordings last a whole number of such steps.
            integrator: `Euler`, `implicitfast`, or `RK4` for a drive in continuous time; None: integrator of the bench.

        Raises:
            ConfigError: No small number of samples lasts a whole number of such steps, the integrator is unknown, or
                `RK4` is requested for a drive with parameters for its simulation step.
        """
        drive = self.origin if self.origin is not None and self.is_simulated else self
        parts = drive.bench, drive.model, drive.values, drive.segments
        simulated = put_into_simulator(*parts, drive.result.settings["bench"], timestep, integrator)
        return cast(Any, replace(drive, **simulated._asdict(), origin=drive))

    @property
    def is_simulated(self) -> bool:
        """Whether the drive represents, in a simulator, a drive in continuous time."""
        return self.origin is not None and self.origin.bench.second_order

    @property
    def integrator(self) -> str:
        """Integrator of the simulator for which the drive's parameters hold."""
        return RK4 if self.is_simulated and self.bench.second_order else self.bench.integrator

    def predict_origin(self) -> Prediction:
        """Predict the original drive's long test rollouts at this drive's samples, each command held until the next."""
        if self.origin is None:
            return Prediction(*self.rollout())
        return Prediction(*map(self._pick, self.origin.rollout(hold(self.origin.recorded, self._every))))

    def find_residual(self) -> Positions:
        """Return measured minus simulated positions of the original drive, in its simulation steps [rad or m]."""
        origin = self.origin or self
        return self._pick(origin.recorded.qpos[:, 1:] - origin.rollout()[0])

    def find_errors(self, qpos: Positions) -> Positions:
        """Return measured minus simulated positions of the long test rollouts in a simulator [rad or m].

        A simulator that keeps only every n-th sample holds commands longer than the recording did; the resulting change
        of the drive's motion is added to the measured position.
        """
        return self.find_residual() + self.predict_origin().qpos - qpos

    @property
    def _every(self) -> int:
        """Number of recorded samples per sample of the drive."""
        return max(1, round(self.segments.timestep / (self.origin or self).segments.timestep))

    def _pick(self, rows: Positions) -> Float[np.ndarray, "batch samples nv"]:
        return rows[:, self._every - 1 :: self._every][:, : self.segments.length]

    def rollout(
        self, segments: Segments | None = None, timestep: float | None = None, values: Values | None = None
    ) -> tuple[Positions, Positions]:
        """Simulate the drive in float64; return qpos and qvel after each sample interval.

        Args:
            segments: Initial states and commands; None: the run's long test rollouts.
            timestep: Simulation step [s]; None: the step of this drive.
            values: Values of another drive with this bench and friction model; None: values of this drive.
        """
        drive = self if timestep is None else self.at(timestep)
        segments = drive.recorded if segments is None else segments
        with jax.enable_x64(True):
            start = segments.qpos[:, 0], segments.qvel[:, 0]
            parameters = drive.jax_values if values is None else values
            qpos, qvel = drive._drive.rollout.compiled(parameters, *start, segments.signals, segments.load)
            return np.array(qpos, np.float64), np.array(qvel, np.float64)

    def follow(self, segments: Segments, values: Values | None = None) -> Segments:
        """Return the segments with simulated states in place of measured ones after the first state.

        `values` may come from another drive with this bench and friction model.

        Raises:
            RunError: The drive diverges in a segment.
        """
        is_origin = self.is_simulated and values is None and segments is self.segments
        prediction = self.predict_origin() if is_origin else Prediction(*self.rollout(segments, values=values))
        pairs = zip((segments.qpos, segments.qvel), (prediction.qpos, prediction.qvel), strict=True)
        qpos, qvel = (np.concatenate([states[:, :1], simulated], axis=1) for states, simulated in pairs)
        diverged = Prediction(qpos, qvel).diverged
        if diverged.any():
            raise RunError(
                f"{self.place}: the fitted drive diverges in {diverged.sum()} of {segments.count} rollouts of "
                f"{segments.length * segments.timestep:g} s, expected none; fit it again"
            )
        return replace(segments, qpos=qpos, qvel=qvel)

    def acting(self, late: bool = True) -> Signals:
        """Return the signals at each step of the long test rollouts, (batch, time, substeps, nv); `late`: delayed."""
        with jax.enable_x64(True):
            bench = self.jax_values["bench"] if late else {}
            signals = self.recorded.signals.map(jnp.asarray)
            return applied({"bench": bench}, signals, self.sampling).map(lambda signal: np.asarray(signal, np.float64))

    @cached_property
    def samples(self) -> DriveState:
        """Inputs of the friction model at the measured states of the rollouts, of shape (samples, nv)."""
        segments = self.recorded
        qpos, qvel = segments.qpos[:, :-1], segments.qvel[:, :-1]
        with jax.enable_x64(True):
            observer = jax.jit(make_observer(self.engine, self.sampling))
            inputs = observer(self.jax_values, qpos, qvel, segments.signals, segments.loads)
            return inputs.map(lambda signal: np.array(signal, np.float64).reshape(-1, self.bench.nv))

    @cached_property
    def proof(self) -> Proof:
        """Verification of the simulation, with the fitted values, against MuJoCo C.

        Raises:
            BenchError: The two differ; see `frictionzoo.simulation.proof.prove`.
        """
        segments = self.recorded
        qpos, qvel, signals = jax.tree.map(
            lambda signal: signal.reshape(-1, self.bench.nv),
            (segments.qpos[:, :-1], segments.qvel[:, :-1], segments.acting),
        )
        recorded = Recorded(qpos, qvel, signals, np.repeat(segments.loads, segments.length, axis=0))
        return prove(self.bench, self.model, "auto", self.values, recorded)

    @property
    def engine(self) -> Engine:
        """Engine that computes one simulation step."""
        return self._drive.engine

    @cached_property
    def jax_values(self) -> Mapping[str, Mapping[str, Any]]:
        """`values` as JAX arrays in float64."""
        with jax.enable_x64(True):
            return jax.tree.map(lambda value: jnp.asarray(value, jnp.float64), self.values)

    @cached_property
    def _drive(self) -> Drive:
        with jax.enable_x64(True):
            # A simulator that moves as a drive of second order takes its torques as that does.
            midway = self.sampling.second_order or self.is_simulated
            return Drive.assemble(self.bench, self.model, "auto", self.sampling, midway)
