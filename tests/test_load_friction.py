"""Laws whose dry friction depends on load and speed: what is hidden in recordings is found again."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest
from helpers.bam import M5, options, write_logs
from omegaconf import OmegaConf

from frictionzoo.bench.read_bam import read_bam
from frictionzoo.core.log import Log, Payload
from frictionzoo.core.segments import cut_segments
from frictionzoo.fit import Objective, Space, fit_reference
from frictionzoo.fit.chunk import search
from frictionzoo.result.evaluate import predict
from frictionzoo.simulation import Values, friction_of, make_engine
from frictionzoo.simulation.rollout import Rollout, make_rollout

pytestmark = pytest.mark.usefixtures("in_haste")

INTERVAL, SAMPLES = 0.01, 600
PAYLOAD = Payload(1.0, (0.0, 0.0, -0.12), (1e-3, 1e-3, 1e-3))
TRUTH = {
    **{"frictionloss": 0.06, "damping": 0.04, "armature": 0.03},
    **{"stribeck_torque": 0.08, "stribeck_velocity": 0.3, "stribeck_exponent": 1.5},
    **{"load_friction": 0.1, "stribeck_load_friction": 0.06},
    **{"load_friction_motor": 0.06, "load_friction_external": 0.15},
    **{"stribeck_load_friction_motor": 0.04, "stribeck_load_friction_external": 0.08},
    **{"quadratic_load_friction_motor": 0.05, "quadratic_load_friction_external": 0.08},
    **{"cubic_damping": 0.002, "periods": 12.0, "sine_1": 0.3, "cosine_1": -0.2, "sine_2": 0.1, "cosine_2": 0.05},
}
KNOWN = (
    *("bench.params.delay.init=0", "bench.params.delay.identify=false", "bench.params.position_offset.identify=false"),
    *(f"bench.actuator.params.{name}.identify=false" for name in ("kt_over_r", "kt2_over_r")),
)


def command(seed: int) -> np.ndarray:
    """Slow swings, in which the joint sticks, and faster ones."""
    time, phase = INTERVAL * np.arange(SAMPLES), np.random.default_rng(seed).uniform(0, 6, size=3)
    swings = zip((0.8, 0.3, 0.1), (0.25, 0.9, 2.3), phase, strict=True)
    return np.sum([size * np.sin(2 * np.pi * rate * time + start) for size, rate, start in swings], axis=0)


def still(bench: Any, gain: float, payload: Payload | None) -> Log:
    """The command of a recording, with which the drive is simulated."""
    zero = np.zeros((SAMPLES, 1))
    extras = {"gain": zero + gain, "supply": zero + 12.0, "enable": zero + 1.0}
    time = INTERVAL * np.arange(SAMPLES)
    log = Log("servo", time, zero, zero, command(int(gain))[:, None], "", True, payload, extras=extras)
    return bench.accept(log)


def record(bench: Any, rollout: Rollout, values: Values) -> list[Log]:
    """What the drive with these values does, with a payload and without, at two gains."""
    logs = [still(bench, gain, payload) for gain in (4.0, 16.0) for payload in (PAYLOAD, None)]
    moved = predict(rollout.compiled, values, cut_segments(logs, count=None, length=SAMPLES - 1))
    assert np.abs(moved.qpos).max() > 0.5
    states = [
        {name: np.concatenate([[[0.0]], signal[i]]) for name, signal in (("qpos", moved.qpos), ("qvel", moved.qvel))}
        for i in range(len(logs))
    ]
    return [replace(log, **state) for log, state in zip(logs, states, strict=True)]


@pytest.mark.parametrize(
    "name",
    [
        *(pytest.param(law, marks=pytest.mark.slow) for law in ("stribeck", "load_dependent")),
        *(pytest.param(law, marks=pytest.mark.slow) for law in ("stribeck_load_dependent", "directional")),
        pytest.param("harmonic_drive", marks=pytest.mark.slow),
        "quadratic",  # has the parts of the others
    ],
)
def test_a_law_is_found_again(make: Callable[..., Any], name: str) -> None:
    """From the configuration's own initial values; nothing but its own truth is in the recordings."""
    options = ("bench=sts3215", f"model={name}", "bench.timestep=0.002", *KNOWN)
    with jax.enable_x64(True):
        bench, law = make("bench", *options), make("model", *options, nv=1)
        rollout = make_rollout(make_engine("specialised", bench, friction_of(law), True), bench.sampling(INTERVAL))
        armature = np.array([TRUTH["armature"]])
        friction = {key: np.array([TRUTH[key]]) for key in law.params}
        logs = record(bench, rollout, {"bench": bench.initial_values() | {"armature": armature}, "friction": friction})
        segments = cut_segments(logs, count=None, length=50)
        objective = Objective(Space(bench, law, "float64"), rollout, segments, 1.0, 0.01, "none", 1.0, False)
        found = fit_reference(objective)
    assert found["bench"]["armature"] == pytest.approx(armature, rel=1e-4)
    # The quadratic terms act at rest alone, and are the last to settle.
    assert {key: found["friction"][key].item() for key in law.params} == pytest.approx(
        {key: TRUTH[key] for key in law.params}, rel=1e-4
    )


@pytest.mark.slow
def test_load_friction_of_bams_own_equations_is_identified(compose, pose_problem, write_bam_file, tmp_path):
    """What acts in motion. MuJoCo's constraint is soft where BAM's joint sticks, and shifts what acts at rest alone."""
    (logs := tmp_path / "logs").mkdir()
    write_logs(logs, M5, seconds=4.0)
    start = "{{init:{},low:1e-3,high:2,scale:log,identify:true}}".format
    file = write_bam_file(M5)
    friction = read_bam(file).friction
    free = {"bench.params.armature": 0.01} | {f"model.params.{name}": 1.5 * value for name, value in friction.items()}
    free.pop("model.params.stribeck_exponent")
    overrides = [f"{name}={start(init)}" for name, init in free.items()]
    settings = compose(*options(logs, file, "fit=lm", *overrides))
    problem = pose_problem(OmegaConf.to_container(settings, resolve=True))
    progress, _ = search(problem.fit, problem.objective)
    found = jax.tree.map(lambda value: value.item(), problem.objective.space.values(progress.best))
    moving = ("frictionloss", "damping", "load_friction_motor", "load_friction_external")
    expected = {name: friction[name] for name in moving} | {"armature": M5["armature"]}
    identified = {**found["friction"], **found["bench"]}
    assert {name: identified[name] for name in expected} == pytest.approx(expected, rel=0.02)
