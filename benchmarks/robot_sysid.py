"""Identification by mujoco.sysid for `robot.py`, with model, commands and segments shared by both tools."""

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.bench import Bench
from frictionzoo.core.build import build
from frictionzoo.core.log import Dataset
from frictionzoo.core.params import Param
from frictionzoo.core.segments import Segments, cut_segments

TOLERANCE = 1e-4  # relative change of the loss that ends our and scipy's solver; of the step, for MuJoCo's solver
SETTINGS: dict[str, dict[str, Any]] = {
    "scipy_parallel_fd": {"x_scale": "jac", "ftol": TOLERANCE, "xtol": TOLERANCE, "gtol": TOLERANCE, "diff_step": 1e-6},
    "mujoco": {"x_scale": "jac", "xtol": TOLERANCE, "eps": 1e-6},
}
"""Options of sysid's optimisers. Their smallest finite-difference steps meet the tolerance of MuJoCo's solver."""


def load(settings: Mapping[str, Any]) -> tuple[Bench, dict[str, Param], Segments, Dataset]:
    """Return the bench, the parameters with initial values and bounds, the fitted segments, and the recordings."""
    bench = build(settings["bench"])
    model = build(settings["model"], nv=bench.nv)
    model.bind(bench.joints)
    dataset = bench.accept_all(build(settings["data"]).load())
    sampling = bench.sampling(dataset.logs[0].timestep)
    segments = cut_segments(dataset.train, **settings["segments"], history=sampling.history)
    return bench, {**bench.params, **model.params}, segments, dataset


class Search:
    """Identification of some joints by mujoco.sysid.

    Attributes:
        parameters: Number of identified parameters.
        iterations: Number of evaluated Jacobians.
        rollouts: Number of parameter vectors for which all segments were rolled out.
    """

    def __init__(
        self, bench: Bench, params: Mapping[str, Param], segments: Segments, joints: list[int], together: bool
    ) -> None:
        self.iterations = self.rollouts = 0
        self._nv, self._together = len(joints), together
        self._bench = bench.only(joints) if self._nv < bench.nv else bench
        self._params = {name: param.only(joints) for name, param in params.items()}
        self._segments, self._aim = segments, aim_of(bench, segments)[..., joints]
        self._measured = np.concatenate([segments.qpos[..., joints], segments.qvel[..., joints]], axis=2)
        self._parameters = self._declare()
        self.parameters = self._parameters.size

    def run(self, optimizer: str, iterations: int) -> dict[str, np.ndarray]:
        """Identify and return the values of each parameter."""
        import absl.logging
        from mujoco import sysid

        absl.logging.set_verbosity(absl.logging.ERROR)  # sysid warns that states are not model sensors
        function = sysid.build_residual_fn(
            models_sequences=[self._sequences()],
            modify_residual=self._residual,
            custom_rollout=self._roll_out,
            resample_true=False,
        )
        options = {**SETTINGS[optimizer], "max_iters": iterations}

        def residuals(vectors: np.ndarray, params: Any) -> tuple[list[np.ndarray], list, list]:
            columns = vectors.size // self.parameters
            self.rollouts, self.iterations = self.rollouts + columns, self.iterations + (columns > 1)
            found, *rest = function(vectors, params)
            # sysid returns a column per vector and segment; its solvers expect a column per vector.
            if self._together and vectors.ndim > 1:
                each = found[0].reshape(-1, columns, self._segments.count)
                found = [each.transpose(2, 0, 1).reshape(-1, columns)]
            return found, *rest

        found, _ = sysid.optimize(self._parameters, residuals, optimizer, verbose=False, **options)
        return {name: self._value(name, found) for name in self._params}

    def _declare(self) -> Any:
        from mujoco import sysid

        parameters = sysid.ParameterDict()
        for name, param in self._params.items():
            start, low, high = (param.each(what, self._nv) for what in ("init", "low", "high"))
            if name == "delay":  # common to all joints; set in the rollout, not in the model
                parameters.add(sysid.Parameter(name, start[0], low[0], high[0]))
            elif param.is_identified:
                parameters.add(sysid.Parameter(name, start, low, high, modifier=self._writer(name)))
        return parameters

    def _writer(self, name: str) -> Any:
        joints, own = self._bench.joints, self._bench.own_damping

        def write(spec: mujoco.MjSpec, parameter: Any) -> None:
            for joint, value, damping in zip(joints, parameter.value, own, strict=True):
                if name == "torque_offset":
                    spec.actuator(joint).biasprm[0] = value
                elif name == "position_offset":
                    spec.joint(joint).ref = -value
                else:  # damping is a polynomial of speed with the viscous coefficient first
                    setattr(spec.joint(joint), name, [value + damping, 0.0, 0.0] if name == "damping" else value)

        return write

    def _sequences(self) -> Any:
        from mujoco import sysid

        start = {name: self._value(name) for name in self._params}
        spec = mujoco.MjSpec.from_string(text_of(self._bench, start))
        model = spec.compile()
        times = np.arange(self._segments.length + 1) * self._bench.timestep
        names = [f"{joint}_{part}" for part in ("qpos", "qvel") for joint in self._bench.joints]
        kinds = [sysid.SignalType.MjStateQPos] * self._nv + [sysid.SignalType.MjStateQVel] * self._nv
        mapping = {name: (kind, np.array([at])) for at, (name, kind) in enumerate(zip(names, kinds, strict=True))}
        acting = self._aim[:, self._segments.history :]
        sequences = sysid.ModelSequences(
            "robot",
            spec,
            [f"segment {number}" for number in range(self._segments.count)],
            [sysid.create_initial_state(model, each[0, : self._nv], each[0, self._nv :]) for each in self._measured],
            [sysid.TimeSeries.from_control_names(times[:-1], aim, model) for aim in acting],
            [sysid.TimeSeries(times, each, mapping) for each in self._measured],
            allow_missing_sensors=True,
        )
        self._places = {id(each.initial_state): place for place, each in enumerate(sequences.measured_rollout)}
        if self._together:  # as one list
            sequences.measured_rollout = [sequences.measured_rollout]
        return sequences

    def _value(self, name: str, found: Any = ()) -> np.ndarray:
        known = name not in found
        return self._params[name].each("init", self._nv) if known else np.broadcast_to(found[name].value, self._nv)

    def _roll_out(self, *, models: Any, datas: Any, initial_states: Any, param_dicts: Any, **mappings: Any) -> Any:
        """Roll out in sysid with commands delayed by each parameter vector's delay."""
        from mujoco import sysid

        times, empty = np.arange(self._segments.length + 1) * self._bench.timestep, np.zeros((1, self._nv))
        rolled = initial_states[: len(initial_states) // len(param_dicts)]
        aim = self._aim[[self._places[id(state)] for state in rolled]]
        controls = []
        for params in param_dicts:
            late = delayed(aim, self._value("delay", params), self._segments, self._bench.timestep)
            # sysid drops the last sample of a command.
            controls += [sysid.TimeSeries(times, np.concatenate([each, empty])) for each in late]
        named = {name: mappings[name] for name in ("rollout_signal_mapping", "rollout_state_mapping", "ctrl_mapping")}
        return sysid.sysid_rollout(models, datas, controls, initial_states, **named)

    def _residual(self, params: Any, predicted: Any, measured: Any, *_: Any, state: np.ndarray, **__: Any) -> tuple:
        # Plain errors: sysid's default residual scales each signal by its size.
        return state[:, 1 : 1 + self._nv] - measured.data[1:, : self._nv], measured, measured


def text_of(bench: Bench, values: Mapping[str, np.ndarray]) -> str:
    """Return the MJCF with these values and without delay: `delayed` delays the commands."""
    own = {name: value for name, value in values.items() if name not in ("frictionloss", "damping", "delay")}
    known = {**bench.initial_values(), **own, "delay": np.zeros(bench.nv)}
    return bench.mjcf(known, values["frictionloss"], values["damping"])


def aim_of(bench: Bench, segments: Segments) -> Float[np.ndarray, "batch samples nv"]:
    """Return the command of MuJoCo's position actuator: the desired position plus the term of the desired velocity."""
    ctrl, inputs, _ = segments.signals
    return bench.actuator.combine(bench.initial_values(), ctrl, inputs)


def delayed(
    command: Float[np.ndarray, "batch samples nv"], delay: Float[np.ndarray, "nv"], segments: Segments, timestep: float
) -> Float[np.ndarray, "batch steps nv"]:
    """Delay commands held from sample to sample; return their mean over each simulation step."""
    each = round(segments.timestep / timestep)
    steps = np.arange(segments.length * each + 1)[:, None] / each
    at = segments.history + steps - delay / segments.timestep
    sample = np.clip(np.floor(at).astype(int), 0, command.shape[1] - 1)
    sums = np.concatenate([np.zeros_like(command[:, :1]), np.cumsum(command, axis=1)], axis=1)
    joint = np.arange(command.shape[2])
    until = sums[:, sample, joint] + (at - sample) * command[:, sample, joint]
    return np.diff(until, axis=1) * each
