"""A drive's nearest one with another law: what it finds, what it costs, and that its folder is that of a run."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import safetensors.torch
import torch
from conftest import Finished, finish

from frictionzoo.cli.finished import distill as main
from frictionzoo.cli.finished import export
from frictionzoo.cli.run import NOT_IDENTIFIED
from frictionzoo.core.errors import ConfigError
from frictionzoo.fit import Objective, Space
from frictionzoo.fit.adam import Adam
from frictionzoo.fit.lm import MOST_COORDINATES, LevenbergMarquardt
from frictionzoo.result.comparison.record import compare_runs
from frictionzoo.result.comparison.runs import read_runs

pytestmark = pytest.mark.usefixtures("settings_kept")


@pytest.fixture
def teacher(finished_run: Callable[[str], tuple[Path, Finished]]) -> Path:
    """The folder of a run that fitted a law of three parameters."""
    return finished_run("mujoco_default")[0]


@pytest.fixture
def distill() -> Callable[..., Finished]:
    """Does in this process what `python -m frictionzoo.distill` does in its own."""
    return lambda folder, *options: finish(lambda: main([str(folder), *options]))


def read(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "result.json").read_text())


def values_of(result: dict[str, Any]) -> dict[str, float]:
    return {parameter["name"]: parameter["value"] for parameter in result["parameters"]}


@pytest.mark.usefixtures("unrendered")
def test_a_law_of_the_same_family_is_found_again(teacher: Path, distill: Callable, tmp_path: Path) -> None:
    finished = distill(teacher, "model=mujoco_default", f"output={tmp_path / 'student'}")
    assert finished.status == 0, finished.err
    student = read(tmp_path / "student")
    found = values_of(student)
    # The teacher's rollouts have no noise and the student can be equal to it: what is left is the fit's tolerance.
    for name, value in values_of(read(teacher)).items():
        assert found[name] == pytest.approx(value, rel=1e-4), name
    assert student["fit"]["method"] == "lm"
    page = (tmp_path / "student" / "report.html").read_text(encoding="utf-8")
    assert "Distilled: fitted to the simulated motion of the run" in page and str(tmp_path) not in page
    compared = json.loads((tmp_path / "student" / "comparison" / "comparison.json").read_text())
    assert len(compared["runs"]) == 2 and "2 runs on" in finished.out
    errors = [run["metrics"]["test"]["position_mae"] for run in (student, read(teacher))]
    assert errors[0] == pytest.approx(errors[1], rel=1e-3)


# Of the teacher: sizes that differ from those with which a student begins, so that it has to move.
ARMATURE = 0.03
FRICTION = {
    **{"static_torque": 0.3, "kinetic_torque": 0.2, "stribeck_velocity": 0.1},
    **{"viscous_coefficient": 0.08, "smoothing_velocity": 0.01},
}
KNOWN = ("fit=known", f"bench.params.armature.init={ARMATURE}", "bench.params.armature.identify=false")


@pytest.mark.slow
@pytest.mark.usefixtures("in_haste")
def test_mujocos_friction_is_near_what_slides(call, tiny, distill, tmp_path):
    friction = [f"model.params.{name}.{to}" for name, x in FRICTION.items() for to in (f"init={x}", "identify=false")]
    teacher = tmp_path / "teacher"
    judged = call(*tiny, "segments.count=200", "model=coulomb_stribeck", *KNOWN, *friction, f"hydra.run.dir={teacher}")
    assert judged.status == 0, judged.err
    finished = distill(teacher, "model=mujoco_default")
    assert finished.status == 0, finished.err
    folder = teacher / "distilled" / "mujoco_default"
    student, before = read(folder), read(teacher)
    found = values_of(student)
    # The bump below 0.1 rad/s is rarely visited: above, sliding friction and inertia are what MuJoCo has too.
    assert found["armature"] == pytest.approx(ARMATURE, rel=0.05)
    speed = np.array([0.5, 2.0])
    expected = FRICTION["kinetic_torque"] + FRICTION["viscous_coefficient"] * speed
    np.testing.assert_allclose(found["frictionloss"] + found["damping"] * speed, expected, rtol=0.1)

    assert student["evaluation"] == before["evaluation"] and student["data"] == before["data"]
    assert student["metrics"]["baseline"] == pytest.approx(before["metrics"]["baseline"])
    assert [item["name"] for item in student["parameters"] if item["owner"] == "bench" and item["identified"]] == [
        "armature"
    ]
    again = distill(teacher, "model=mujoco_default")
    assert again.status == 2 and "exists already" in again.err
    assert read(folder) == student


@pytest.mark.slow
@pytest.mark.usefixtures("in_haste")
def test_a_networks_student_is_a_run(finished_run: Callable, distill: Callable, tmp_path: Path) -> None:
    network, student = finished_run("neural_friction")[0], tmp_path / "student"
    finished = distill(network, "model=mujoco_default", f"output={student}")
    assert finished.status in (0, NOT_IDENTIFIED), finished.err
    assert {"report.html", "curves.safetensors", "friction.safetensors", "identified.xml"} <= {
        path.name for path in student.iterdir()
    }
    assert read(student)["fit"]["method"] == "lm" and read(student)["settings"]["teacher"] == str(network)
    assert not export([str(student), "target=mjcf"])
    assert json.loads((student / "export" / "mjcf" / "export.json").read_text())["model"] == "mujoco_default"
    compared = compare_runs(*read_runs([network, student]))
    assert {run["label"] for run in compared["runs"]} == {"neural_friction", "mujoco_default"}


@pytest.mark.slow
@pytest.mark.usefixtures("in_haste")
def test_an_actuator_network_learns_from_a_run(finished_run: Callable, distill: Callable, tmp_path: Path) -> None:
    network = tmp_path / "network"
    options = ("model=actuator_network", "fit=adam", "fit.iterations=3", f"output={network}")
    finished = distill(finished_run("coulomb_stribeck")[0], *options)
    assert finished.status in (0, NOT_IDENTIFIED), finished.err
    assert not export([str(network), "target=actuator_net"])
    assert {"actuator_net.pt", "actuator_net.onnx"} <= {path.name for path in (network / "export").rglob("*")}


def test_the_fit_suits_the_size_of_the_model(make: Callable[..., Any]) -> None:
    auto, lm = make("fit", "fit=auto"), make("fit", "fit=lm")
    objectives = [
        Mock(Objective, space=Mock(Space, start=np.zeros(weights), names=["weight"]), torch_law=torch_law)
        for weights, torch_law in ((MOST_COORDINATES, False), (MOST_COORDINATES + 1, False), (1, True))
    ]
    assert [type(auto.choose(objective)) for objective in objectives] == [LevenbergMarquardt, Adam, Adam]
    with pytest.raises(ConfigError, match="use fit=adam"):
        lm.total(objectives[1])


MISTAKES = {
    "model=stribek": r"model=stribek: no such model; did you mean stribeck\?",
    "fit=lm": "model is missing; give model=NAME",
    "model=stribeck model=baseline": "model is given twice",
    "model=stribeck fit.iteration=3": r"fit.iteration: unknown option; did you mean iterations\?",
    "model=stribeck evaluation.places=3": "evaluation.places: teacher and student share it",
}


@pytest.mark.parametrize("options", MISTAKES)
def test_a_mistaken_option_is_one_line(teacher: Path, distill: Callable, options: str, tmp_path: Path) -> None:
    finished = distill(teacher, *options.split(), f"output={tmp_path / 'student'}")
    check_refused(finished, MISTAKES[options], tmp_path / "student")


def check_refused(finished: Finished, reason: str, student: Path) -> None:
    """One line, and nothing written."""
    assert finished.status == 2 and finished.out == ""
    (line,) = finished.err.splitlines()
    assert line.startswith("frictionzoo: ")
    with pytest.raises(ValueError, match=reason):
        raise ValueError(line)
    assert not student.exists()


def copy_teacher(teacher: Path, place: Path, recording: Path) -> Path:
    """The teacher's folder, as if it had read another file."""
    shutil.copytree(teacher, place)
    result = read(teacher)
    result["settings"]["data"]["train"] = [str(recording)]
    (place / "result.json").write_text(json.dumps(result))
    return place


def test_recordings_that_are_gone_or_changed_are_one_line(teacher, recording, distill, tmp_path):
    other = tmp_path / "other.csv"
    copy = copy_teacher(teacher, tmp_path / "copy", other)
    options = ("model=mujoco_default", f"output={tmp_path / 'student'}")
    check_refused(distill(copy, *options), r"other\.csv", tmp_path / "student")
    assert "exists already" in distill(copy, "model=mujoco_default", f"output={copy}").err
    text = recording.read_text()
    other.write_text(text[: text.rindex("\n", 0, -1) + 1])  # its last sample is lost
    check_refused(distill(copy, *options), "data with SHA-256 .*, expected .* as in that run", tmp_path / "student")


def test_a_teacher_that_diverges_is_one_line(finished_run, recording, distill, tmp_path):
    copy = copy_teacher(finished_run("coulomb_stribeck")[0], tmp_path / "copy", recording)
    law = safetensors.torch.load_file(copy / "friction.safetensors")
    law["viscous_coefficient"] = torch.full_like(law["viscous_coefficient"], -1e4)  # drives the joint
    safetensors.torch.save_file(law, copy / "friction.safetensors")
    long = ("segments.length=300", "segments.count=2")  # steps, so that it leaves the numbers of 64 bits
    finished = distill(copy, "model=mujoco_default", *long, f"output={tmp_path / 'student'}")
    check_refused(finished, "the fitted drive diverges in 2 of 2 rollouts of 0.3 s", tmp_path / "student")
