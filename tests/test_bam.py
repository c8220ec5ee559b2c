"""BAM's parameter files: read, simulated by BAM's own equations apart from this package, and identified again."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from helpers.bam import M1, M2, M3, M4, M5, M6, dry, options, write_logs
from omegaconf import OmegaConf

from frictionzoo.bench.read_bam import LAWS, main, read_bam
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.state import DriveState
from frictionzoo.export.bam import friction_budget
from frictionzoo.fit.chunk import search
from frictionzoo.models import get_model


def test_bams_own_equations_are_followed_and_identified(compose, pose_problem, write_bam_file, tmp_path):
    """With the law that has all terms, over 3 s of motion by 1 rad; steps of 0.5 ms against 0.2 ms.

    kt and R are known: at a constant supply, back-EMF kt^2 / R and damping brake alike, and only their sum shows.
    """
    logs = tmp_path / "logs"
    logs.mkdir()
    write_logs(logs, M6, seconds=3.1)
    start = "{{init:{},low:1e-3,high:2,scale:log,identify:true}}".format
    free = {"bench.params.armature": 0.01, "model.params.frictionloss": 0.15, "model.params.damping": 0.02}
    freed = (f"{name}={start(init)}" for name, init in free.items())
    settings = compose(*options(logs, write_bam_file(M6), "fit=lm", *freed))
    problem = pose_problem(OmegaConf.to_container(settings, resolve=True))
    progress, _ = search(problem.fit, problem.objective)
    found = jax.tree.map(np.asarray, problem.objective.space.values(progress.best))
    assert found["friction"]["damping"] == pytest.approx(M6["friction_viscous"], rel=0.02)
    assert found["friction"]["frictionloss"] == pytest.approx(M6["friction_base"], rel=0.02)
    assert found["bench"]["armature"] == pytest.approx(M6["armature"], rel=0.05)

    measured = problem.evaluation.trajectories
    said = {"frictionloss": M6["friction_base"], "damping": M6["friction_viscous"]}
    friction = found["friction"] | {name: np.array([value]) for name, value in said.items()}
    values = {"bench": found["bench"] | {"armature": np.array([M6["armature"]])}, "friction": friction}
    states = measured.qpos[:, 0], measured.qvel[:, 0]
    qpos, _ = problem.drive.rollout.compiled(values, *states, measured.signals, measured.load)
    assert np.abs(np.asarray(qpos) - measured.qpos[:, 1:]).max() < 0.003


@pytest.mark.parametrize("bam", [M1, M2, M3, M4, M5, M6], ids=lambda bam: bam["model"])
def test_a_parameter_file_is_the_law_itself(write_bam_file: Callable[..., Path], bam: dict[str, Any]) -> None:
    """Its limit is BAM's over states of both signs and at rest, by the law here and by what the target `bam` computes.

    At rest the share is exp(-1e-12^(alpha / 2)), 8e-9 below 1 with this alpha.
    """
    drive = read_bam(write_bam_file(bam))
    law = get_model(drive.model)
    assert drive.model == LAWS[bam["model"]][0]
    assert set(law.dimensions) == set(drive.friction)
    state = DriveState(*np.random.default_rng(0).normal(scale=2.0, size=(5, 200)))
    state.qvel[:50] *= 0.1
    state.qvel[:5] = 0.0
    section = {name: {"init": 1.0, "low": 0.0, "high": 2.0, "scale": 1.0, "identify": True} for name in drive.friction}
    terms = law(1, section).terms(np, {name: np.array(value) for name, value in drive.friction.items()}, state)
    expected = dry(bam, state.motor_torque, state.external_torque, state.qvel)
    np.testing.assert_allclose(terms.frictionloss, expected, rtol=1e-7)
    np.testing.assert_allclose(friction_budget(bam, state).frictionloss, expected, rtol=1e-12)
    assert terms.damping == bam["friction_viscous"]


def test_what_bam_does_and_we_do_not_is_said(write_bam_file: Callable[..., Path]) -> None:
    assert "max_velocity" in " ".join(read_bam(write_bam_file(M1 | {"max_velocity": 5.3})).remarks)
    assert not read_bam(write_bam_file(M1)).remarks


def test_the_command_prints_options(write_bam_file: Callable[..., Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(write_bam_file(M1))]) == 0
    options = capsys.readouterr().out.split()
    assert options[:2] == ["model=mujoco_default", "fit=known"]
    assert f"bench.actuator.params.kt_over_r={{init:{M1['kt'] / M1['R']!r}," in " ".join(options)


@pytest.mark.parametrize(
    ("bam", "message"),
    [
        ({"model": "m1"}, "no model"),
        (M1 | {"actuator": "erob80_50"}, "actuator=erob80_50"),
        (M1 | {"model": "m6"}, "friction_stribeck is missing"),
        (M1 | {"model": ["m1"]}, "no model"),
        (M2 | {"alpha": 0.0}, "alpha is 0"),
        (M1 | {"R": 0.0}, "R is 0"),
        (M1 | {"friction_base": None}, "friction_base is missing"),
        (M1 | {"armature": float("nan")}, "armature is nan"),
    ],
)
def test_a_file_that_we_cannot_hold_is_refused(write_bam_file, capsys, bam, message):
    path = write_bam_file(bam)
    with pytest.raises(ConfigError, match=message):
        read_bam(path)
    assert main([str(path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_file_that_is_not_json_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("kt=1")
    for name in ("a.json", "none.json"):
        with pytest.raises(ConfigError, match=name):
            read_bam(tmp_path / name)
