"""What identified values leave of recorded torque: known shares of it, and where there is nothing to compare."""

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.robots import JOINTS, TRUTH, arm
from helpers.torque_logs import STEP, log_of, move, needed

from frictionzoo.bench import Bench, Force, JointPD
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.log import Log
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.fit import Fit, InverseDynamics, Space
from frictionzoo.fit.known import Known
from frictionzoo.fit.motion import Recordings
from frictionzoo.models import FrictionModel, TorchFriction
from frictionzoo.models.registry import get_model
from frictionzoo.result.section_types import Torque
from frictionzoo.result.torque import choose_filtering, measure_torque

pytestmark = pytest.mark.usefixtures("x64")

WRONG = np.array([0.0, 0.3, 0.0, 0.0, 0.5])
"""What the torques have besides: of the second joint half a wave's height, of the last a constant [N m]."""


@pytest.fixture(scope="module")
def stand(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Bench]:
    """The arm with its true armature, all known, and an actuator law."""
    path = tmp_path_factory.mktemp("arm") / "arm.xml"
    path.write_text(arm())
    armature = {"init": TRUTH["armature"].tolist(), "identify": False}
    return lambda actuator, **more: Bench(str(path), JOINTS, actuator=actuator, params={"armature": armature}, **more)


def true_law() -> FrictionModel:
    return get_model("mujoco_default")(5, {name: TRUTH[name].tolist() for name in ("frictionloss", "damping")})


def record(bench: Bench, seed: int, share: float = 1.0) -> Log:
    """A motion with the torque that it needs, and a share of `WRONG` beside that."""
    motion = move(5, seconds=6.0, seed=seed)
    wave = np.sin(2 * np.pi * STEP * np.arange(len(motion[0])))[:, None] ** [1, 1, 1, 1, 0]
    return log_of(motion[0], needed(bench.compile(constraint=False), motion) + share * WRONG * wave, str(seed))


def measure(bench: Bench, law: FrictionModel, train: list[Log], test: list[Log], fit: Fit | None = None) -> Any:
    logs = tuple(map(bench.accept, train + test))
    space = Space(bench, law, "float64")
    fit = InverseDynamics(held=False) if fit is None else fit
    start, how = np.asarray(space.start), choose_filtering(fit, {})
    return measure_torque(Recordings(bench, law, logs), len(train), space, start, how)


def residuals(found: Torque, part: Any) -> np.ndarray:
    return np.array([row[part]["residual"] for row in found["by_joint"]])


def test_what_is_left_is_what_the_torques_have_besides(stand: Callable[..., Bench]) -> None:
    bench = stand(Force())
    logs = [record(bench, 0, 0.0), record(bench, 1, 0.0), record(bench, 2)]
    found = measure(bench, true_law(), logs[:2], logs[2:])
    assert (found["compared"], found["unit"], found["bandwidth"], found["held"]) == ("ctrl", "N m", 20.0, False)
    assert [row["joint"] for row in found["by_joint"]] == JOINTS
    # Turning round, dry friction jumps, and a low-pass of positions at 100 Hz sees it a little late.
    np.testing.assert_allclose(residuals(found, "train"), 0.0, atol=0.06)
    np.testing.assert_allclose(residuals(found, "test"), WRONG / [1, np.sqrt(2), 1, 1, 1], atol=0.03)
    whole = [row["test"]["torque"] for row in found["by_joint"]]
    np.testing.assert_allclose(whole, np.sqrt(np.mean(np.square(logs[2].ctrl), axis=0)), rtol=0.05)
    for part in ("train", "test"):
        assert np.isclose(found["mean"][part]["residual"], residuals(found, part).mean())


def test_recorded_torque_comes_before_the_command(stand: Callable[..., Bench]) -> None:
    pd = stand(JointPD({"kp": {"init": 400.0}, "kd": {"init": 40.0}}))
    logs = [record(pd, seed) for seed in (0, 1)]
    measured = [replace(log, ctrl=np.zeros_like(log.ctrl), extras={"torque": log.ctrl}) for log in logs]
    found = measure(pd, true_law(), measured[:1], measured[1:], Known())
    assert (found["compared"], found["held"]) == ("torque", False)
    np.testing.assert_allclose(residuals(found, "test"), WRONG / [1, np.sqrt(2), 1, 1, 1], atol=0.03)
    driven = measure(stand(Force()), true_law(), measured[:1], measured[1:])
    assert driven["compared"] == "torque"
    np.testing.assert_allclose(residuals(driven, "test"), residuals(found, "test"), rtol=1e-9)


class OnlyInTorch(TorchFriction):
    name = "only_in_torch"

    def forward(self, state: DriveState) -> FrictionTerms:
        return FrictionTerms(torque=0.1 * torch.tanh(state.qvel))


def test_where_there_is_nothing_to_compare_nothing_is_said(stand, caplog):
    pd, torques = stand(JointPD({"kp": {"init": 400.0}, "kd": {"init": 40.0}})), stand(Force())
    log = record(torques, 0)
    assert measure(pd, true_law(), [log], [log]) is None
    caplog.set_level(logging.INFO)
    assert measure(torques, OnlyInTorch(5), [log], [log]) is None
    assert measure(torques, true_law(), [log], [log.between(0, 100, "cut")]) is None
    having = replace(log, extras={"torque": log.ctrl})
    assert measure(pd, true_law(), [having], [log]) is None
    reasons = ("only_in_torch exists only in torch", "100 samples, expected at least", "torque is not compared")
    assert all(reason in message for reason, message in zip(reasons, caplog.messages, strict=True))


@pytest.mark.parametrize("name", ["baseline", "lugre", "neural_friction", "temperature_linear"])
def test_laws_of_every_kind_leave_a_number(name: str, stand: Callable[..., Bench], make: Callable[..., Any]) -> None:
    law = make("model", f"model={name}", *(["model.hidden=[4,4]"] if name == "neural_friction" else []), nv=5)
    bench = stand(Force()).observing(law.inputs)
    law.bind(bench.joints)
    log = record(bench, 0)
    found = measure(bench, law, [log], [log])
    assert np.isfinite(residuals(found, "test")).all()
    np.testing.assert_array_equal(residuals(found, "train"), residuals(found, "test"))


def test_torque_is_compared_as_the_fit_does_it_unless_an_option_says_otherwise() -> None:
    fit = InverseDynamics(bandwidth=5.0, cutoff=30.0, held=False)
    used, held = choose_filtering(fit, {"bandwidth": None, "held": None})
    assert (used.bandwidth, used.cutoff, held) == (5.0, 30.0, False)
    used, held = choose_filtering(fit, {"bandwidth": 8.0, "held": True})
    assert (used.bandwidth, used.cutoff, held) == (8.0, None, True)
    used, held = choose_filtering(Known(), {})
    assert (used.bandwidth, held) == (20.0, True)
    with pytest.raises(ConfigError, match=r"evaluation.torque.bandwith: unknown; did you mean bandwidth"):
        choose_filtering(fit, {"bandwith": 5.0})
    with pytest.raises(ConfigError, match=r"evaluation.torque.bandwidth=0; expected a positive frequency"):
        choose_filtering(fit, {"bandwidth": 0.0})
