"""One job from a recording to an identified drive, for every model: what it leaves behind holds together."""

import json
import re
from pathlib import Path

import jsonschema
import mujoco
import numpy as np
import pytest
import safetensors
import safetensors.torch
import torch
from conftest import RUNS, Finished
from omegaconf import OmegaConf
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from frictionzoo import __version__
from frictionzoo.api.identified import Identified
from frictionzoo.cli.run import NOT_IDENTIFIED
from frictionzoo.core.state import DriveState
from frictionzoo.export.mjcf import write_identified
from frictionzoo.identification.solve import judge_baseline
from frictionzoo.models import Baseline, FrictionModel
from frictionzoo.result.record import read_schema
from frictionzoo.simulation.drive import Drive

JOBS = {  # options besides those of `tiny`
    "mujoco_grid_search": ("fit.points=2",),
    "neural_friction": (*RUNS["neural_friction"][1:], "fit.derivative=reverse", "dtype=float32"),
    "residual_network": ("fit.iterations=3", "model.hidden=[4]"),
}
FIGURES = ("figure3_parameters.png", "figure4_trajectory.png", "figure5_error.png")


@pytest.mark.parametrize("name", ["mujoco_default", "coulomb_smooth", "neural_friction", "baseline"])
def test_a_finished_run_is_a_whole_record(finished_run, make, tiny, name):
    run, finished = finished_run("sweep" if name == "baseline" else name)
    module = make("model", *RUNS.get(name, ["model=baseline"]), *tiny, nv=1)
    check_record(run / "0_baseline" if name == "baseline" else run, finished, name, module)


@pytest.mark.slow
@pytest.mark.usefixtures("in_haste")
@pytest.mark.parametrize("name", JOBS)
def test_a_job_leaves_a_whole_record(call, make, tiny, tmp_path, name):
    overrides = (*tiny, f"model={name}", *JOBS[name])
    finished = call(*overrides, "hydra.run.dir=run")
    assert finished.status in (0, NOT_IDENTIFIED), finished.err
    check_record(tmp_path / "run", finished, name, make("model", *overrides, nv=1))


def check_record(run: Path, finished: Finished, name: str, module: FrictionModel) -> None:
    """What the run printed and what its files hold, as `module`, the law as it was built, has been fitted."""
    result = json.loads((run / "result.json").read_text())
    check_result(result, name)
    check_friction(run, module, result)
    check_mjcf(run, result)
    check_scalars(run, result)
    assert all((run / "figures" / figure).read_bytes().startswith(b"\x89PNG") for figure in FIGURES)
    checkpoint = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["frictionzoo"]
    assert checkpoint["identity"]["model"] == name
    page = (run / "report.html").read_text(encoding="utf-8")
    assert f"<title>{name} on files" in page and 'href="friction.safetensors"' in page
    assert re.search(r"\[test\] from 1\.\d+ s on", page)  # of 1.5 s, the last part is the test's
    assert not [path for path in run.rglob("*") if path.suffix == ".part"]

    assert f"{name} on files. Your recordings." in finished.out
    assert all(f"{entry['owner']}.{entry['name']}" in finished.out for entry in result["parameters"])
    assert "no friction" in finished.out and str(run) in finished.out


def check_result(result: dict, name: str) -> None:
    """Valid, and about this job."""
    jsonschema.validate(result, read_schema())
    assert result["model"] == name
    assert result["data"]["samples"] == 1150 + 300  # 1500, less the gap of 50, a fifth for the test
    assert result["data"]["origin"] is None
    fit = result["fit"]
    ends = {"adam": (3, "finished"), "grid": (2**3, "finished"), "lm": (fit["iterations"], "converged")}
    assert (fit["iterations"], fit["stopped"]) == ends[fit["method"]]
    assert 0 <= fit["best_iteration"] < fit["iterations"]
    parts = (result["timing"][part] for part in ("setup", "compile", "fit", "uncertainty", "evaluate"))
    assert sum(parts) <= result["timing"]["total"]


def check_friction(run: Path, module: FrictionModel, result: dict) -> None:
    """The weights load into a module that was built anew, which then is the fitted law."""
    path = run / "friction.safetensors"
    before = {key: tensor.clone() for key, tensor in module.state_dict().items()}
    module.load_state_dict(safetensors.torch.load_file(path), strict=True)
    with safetensors.safe_open(path, "pt") as file:
        assert file.metadata() == {"frictionzoo": f"{module.name}, version {__version__}"}
    fitted = {p["name"]: p["value"] for p in result["parameters"] if p["owner"] == "friction"}
    for key, value in fitted.items():
        np.testing.assert_array_equal(np.ravel(module.state_dict()[key].numpy()), np.ravel(value))
    # One iteration moves weights by a hundredth: a state that stayed as it was built would show.
    if before and result["fit"]["best_iteration"] > 0:
        assert any(not torch.equal(before[key], tensor) for key, tensor in module.state_dict().items())
    state = DriveState(*torch.linspace(-1, 1, 12, dtype=torch.float64).reshape(6, 2, 1))
    assert all(
        torch.isfinite(term).all() for term in module.terms(torch, module.state_dict(), state) if term is not None
    )


def check_mjcf(run: Path, result: dict) -> None:
    """MuJoCo C loads it, with the identified armature and friction or what an export puts in their place."""
    path = run / "identified.xml"
    model = mujoco.MjModel.from_xml_path(str(path))
    values = {p["name"]: np.ravel(p["value"]) for p in result["parameters"]}
    if result["model"].startswith("mujoco"):
        for name in ("armature", "frictionloss", "damping"):
            np.testing.assert_array_equal(getattr(model, f"dof_{name}"), values[name])
    elif result["model"] != "baseline":
        fitted = Identified.load(run)
        (model,) = write_identified(fitted)
        assert path.read_bytes() == model.content
        assert "Frictionloss and damping cannot represent" in path.read_text()


def check_scalars(run: Path, result: dict) -> None:
    """TensorBoard has the loss, the gradient's norm and every identified parameter of every iteration."""
    events = EventAccumulator(str(run / "tensorboard"), size_guidance={"scalars": 0}).Reload()
    identified = {f"{p['owner']}.{p['name']}" for p in result["parameters"] if p["identified"]}
    steps = list(range(result["fit"]["iterations"]))
    for tag in {"loss", "grad_norm"} | identified:
        assert [event.step for event in events.Scalars(tag)] == steps
    best = events.Scalars("loss")[result["fit"]["best_iteration"]].value
    assert best == pytest.approx(result["fit"]["loss"], rel=1e-6)  # TensorBoard keeps 32 bits


def test_a_known_bench_is_judged_as_it_is_without_friction(pose_problem, compose, tiny):
    config = compose(*tiny, "bench.params.armature.identify=false")
    problem = pose_problem(OmegaConf.to_container(config, resolve=True))
    np.testing.assert_array_equal(problem.samples.qpos, np.concatenate([log.qpos for log in problem.dataset.train]))
    # No value of the bench is free: what is left without friction is the bench as it was given.
    drive = Drive.assemble(problem.bench, Baseline(1), "specialised", problem.sampling)
    expected = problem.evaluation.judge(
        drive.rollout.compiled, {"bench": problem.bench.initial_values(), "friction": {}}
    )
    judged, values = judge_baseline(problem)
    assert values["bench"] == problem.bench.initial_values()
    np.testing.assert_array_equal(judged.prediction.qpos, expected.prediction.qpos)
    assert (judged.rollout_mae["test"] > 0).all()
