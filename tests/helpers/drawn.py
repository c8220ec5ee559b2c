"""Drives in random states that have not been identified, one for each friction model, and what a target writes."""

from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from conftest import make_run, trace_nothing
from omegaconf import OmegaConf

from frictionzoo.api.identified import Identified
from frictionzoo.core.build import build
from frictionzoo.core.config import compose_config
from frictionzoo.core.log import Payload
from frictionzoo.core.manifest import MANIFEST
from frictionzoo.core.segments import Segments
from frictionzoo.core.state import DriveState, Signals
from frictionzoo.export.base import Export, get_target
from frictionzoo.models import FrictionModel, get_model, model_names
from frictionzoo.models.by_name import complete_laws

PAYLOAD = Payload(0.5, (0.0, 0.0, -0.1), (1e-4, 1e-4, 1e-4))
# Their memory is as long as an option says.
OPTIONAL = ("actuator_lstm", "actuator_network", "history_network", "maxwell_slip")
MODELS = [name for name in model_names() if not get_model(name).memory and name not in OPTIONAL]


class Drawn(Identified):
    """A drive in random states that does not move: nothing is compiled."""

    @cached_property
    def samples(self) -> DriveState:
        rng = np.random.default_rng(0)
        observed = {name: value + 10 * rng.normal(size=(300, 1)) for name, value in self.model.inputs.items()}
        return DriveState(*rng.normal(scale=2.0, size=(5, 300, 1)), **observed)

    def rollout(
        self, segments: Segments | None = None, timestep: float | None = None, values: Any = None
    ) -> tuple[np.ndarray, np.ndarray]:
        return self.segments.qpos[:, 1:], self.segments.qvel[:, 1:]


@cache
def compose_once(*overrides: str) -> Any:
    return OmegaConf.to_container(compose_config(*overrides), resolve=True)


@cache  # with what a drive has compiled
def fit(law: str, *overrides: str, kind: type[Identified] = Identified) -> Identified:
    """A drive with the configuration's initial values, two rollouts of half a second, and overrides."""
    config = compose_once(*(f"+model@laws.{law}={law}" for law in ([law] if overrides else MODELS)), *overrides)
    model = build(complete_laws(config["laws"][law], config), nv=1)
    bench = build(config["bench"]).observing(model.inputs)
    rng, interval = np.random.default_rng(0), 0.01
    sampling = bench.sampling(interval)
    samples = sampling.history + 50
    phase = 5 * interval * np.arange(samples)[:, None] + np.arange(2)[:, None, None]
    known = {"gain": 16.0, "supply": 12.0, "enable": 1.0, "kp": 20.0, "kd": 1.0}
    known |= {"ctrl_velocity": 2.5 * np.cos(phase), "ctrl_torque": 0.5 * np.sin(3 * phase)}
    inputs = {name: np.zeros((2, samples, 1)) + known[name] for name in bench.actuator.inputs}
    observed = {name: value + 10 * np.cos(phase) for name, value in model.inputs.items()}
    signals = Signals(0.5 * np.sin(phase), inputs, observed)
    qpos, qvel = rng.normal(size=(2, 2, 51, 1))
    load = None if bench.payload is None else np.stack(2 * [bench.load(PAYLOAD)])
    model.prepare(DriveState(*rng.normal(size=(5, 100, 1))))
    values = {"bench": bench.initial_values(), "friction": state(model)}
    segments = Segments(qpos, qvel, signals, interval, load)
    drawn = trace_nothing(segments)
    result = make_run(0, model.name, bench.nv).result
    return kind(Path("run"), result, bench, model.double(), {}, values, segments, sampling, drawn)


draw = partial(fit, kind=Drawn)


def state(model: FrictionModel) -> dict[str, np.ndarray]:
    return {name: value.detach().double().numpy() for name, value in model.state_dict().items()}


def write(target: str, fitted: Identified, folder: Path, **options: str) -> Export:
    export = get_target(target)().write(fitted, folder, options)
    assert {path.name for path in folder.iterdir()} - {MANIFEST} == set(export.files)
    assert export.limits
    return export
