"""A drive's nearest one with another law: what it finds, what it costs, and that its folder is that of a run."""

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import safetensors.torch
import torch
from conftest import Finished
from jax.experimental.compilation_cache import compilation_cache as jax_cache

from frictionzoo.compare.comparison import compare_runs
from frictionzoo.compare.runs import read_runs
from frictionzoo.config import compose_config
from frictionzoo.distill.__main__ import main
from frictionzoo.export.__main__ import main as export
from frictionzoo.job import run_job

# Of the teacher: sizes that differ from those with which a student begins, so that it has to move.
ARMATURE = 0.03
FRICTION = {
    **{"static_torque": 0.3, "kinetic_torque": 0.2, "stribeck_velocity": 0.1},
    **{"viscous_coefficient": 0.08, "smoothing_velocity": 0.01},
}
KNOWN = ("fit=known", f"bench.params.armature.init={ARMATURE}", "bench.params.armature.identify=false")


@pytest.fixture(scope="module", autouse=True)
def jax_as_it_was() -> Iterator[None]:
    """Jobs set JAX's precision and caches, for their whole process."""
    names = ("jax_enable_x64", "jax_default_device", "jax_compilation_cache_dir")
    before = {name: getattr(jax.config, name) for name in names}
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    jax_cache.reset_cache()


@pytest.fixture(scope="module")
def identify(tiny: tuple[str, ...], tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Does a small job with this model and these overrides; returns its folder."""
    cache = f"compilation_cache={tmp_path_factory.mktemp('cache')}"

    def identify(model: str, *overrides: str) -> Path:
        folder = tmp_path_factory.mktemp("teacher")
        config = compose_config(*tiny, cache, "segments.count=200", f"model={model}", *overrides)
        _, complaint = run_job(config, model, folder)
        assert complaint is None
        return folder

    return identify


@pytest.fixture(scope="module")
def teacher(identify: Callable[..., Path]) -> Path:
    """The folder of a run that judged given values of `coulomb_stribeck`."""
    friction = [f"model.params.{name}.{to}" for name, x in FRICTION.items() for to in (f"init={x}", "identify=false")]
    return identify("coulomb_stribeck", *KNOWN, *friction)


@pytest.fixture
def distill(capsys: pytest.CaptureFixture[str]) -> Callable[..., Finished]:
    """Does in this process what `python -m frictionzoo.distill` does in its own."""

    def distill(folder: Path, *options: str) -> Finished:
        capsys.readouterr()
        try:
            main([str(folder), *options])
            status = 0
        except SystemExit as end:
            status = int(end.code or 0)
        written = capsys.readouterr()
        return Finished(status, written.out, written.err)

    return distill


def read(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "result.json").read_text())


def values_of(result: dict[str, Any]) -> dict[str, float]:
    return {parameter["name"]: parameter["value"] for parameter in result["parameters"]}


def test_a_law_of_the_same_family_is_found_again(teacher: Path, distill: Callable, tmp_path: Path) -> None:
    finished = distill(teacher, "model=coulomb_stribeck", f"output={tmp_path / 'student'}")
    assert finished.status == 0, finished.err
    found = values_of(read(tmp_path / "student"))
    # The teacher's rollouts have no noise and the student can be equal to it: what is left is the fit's tolerance.
    for name, value in (FRICTION | {"armature": ARMATURE}).items():
        assert found[name] == pytest.approx(value, rel=0.01), name
    note = json.loads((tmp_path / "student" / "distillation.json").read_text())
    assert all(difference["rms"] < 1e-4 for difference in note["differences"])
    assert note["notes"] == []


@pytest.mark.slow
def test_mujocos_friction_is_near_what_slides(teacher: Path, distill: Callable) -> None:
    """And the printed loss is that of both records."""
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
    (row,) = (line for line in finished.out.splitlines() if line.startswith("position MAE"))
    ours, theirs = (result["metrics"]["test"]["position_mae"] for result in (student, before))
    assert row.split()[2:] == [f"{ours:.4g}", f"{theirs:.4g}", "rad", f"{round(100 * (ours / theirs - 1)):+d}", "%"]
    again = distill(teacher, "model=mujoco_default")
    assert again.status == 2 and "exists already" in again.err
    assert read(folder) == student


@pytest.mark.slow
def test_a_networks_student_is_a_run(identify: Callable, distill: Callable, tmp_path: Path) -> None:
    small = ("fit.iterations=3", "model.hidden=[4,4]")
    network, student = identify("neural_friction", *small), tmp_path / "student"
    finished = distill(network, "model=mujoco_default", f"output={student}")
    assert finished.status == 0, finished.err
    assert {"report.html", "curves.safetensors", "friction.safetensors", "identified.xml"} <= {
        path.name for path in student.iterdir()
    }
    assert read(student)["fit"]["method"] == "lm" and read(student)["settings"]["teacher"] == str(network)
    assert not export([str(student), "target=mjcf"])
    assert json.loads((student / "export" / "mjcf" / "export.json").read_text())["model"] == "mujoco_default"
    compared = compare_runs(*read_runs([network, student]))
    assert {run["label"] for run in compared["runs"]} == {"neural_friction", "mujoco_default"}


def test_a_student_may_be_the_larger_law(teacher: Path, distill: Callable, tmp_path: Path) -> None:
    """Adam fits it where it has many weights, and the output says that it is larger."""
    large = ("model=neural_friction", "model.hidden=[16,16]", f"output={tmp_path / 'student'}")
    finished = distill(teacher, *large, "fit=lm")
    assert finished.status == 2 and "use fit=adam" in finished.err
    assert not (tmp_path / "student").exists()
    finished = distill(teacher, *large, "loop.patience=1")
    assert finished.status == 0, finished.err
    assert read(tmp_path / "student")["fit"]["method"] == "adam"
    assert "neural_friction is not the simpler law" in finished.out


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


def test_recordings_that_are_gone_or_changed_are_one_line(
    teacher: Path, recording: Path, distill: Callable, tmp_path: Path
) -> None:
    other = tmp_path / "other.csv"
    copy = copy_teacher(teacher, tmp_path / "copy", other)
    options = ("model=mujoco_default", f"output={tmp_path / 'student'}")
    check_refused(distill(copy, *options), r"other\.csv", tmp_path / "student")
    text = recording.read_text()
    other.write_text(text[: text.rindex("\n", 0, -1) + 1])  # its last sample is lost
    check_refused(distill(copy, *options), "data with SHA-256 .*, expected .* as when it ran", tmp_path / "student")


def test_a_teacher_that_diverges_is_one_line(teacher: Path, recording: Path, distill: Callable, tmp_path: Path) -> None:
    copy = copy_teacher(teacher, tmp_path / "copy", recording)
    law = safetensors.torch.load_file(copy / "friction.safetensors")
    law["viscous_coefficient"] = torch.full_like(law["viscous_coefficient"], -1e4)  # drives the joint
    safetensors.torch.save_file(law, copy / "friction.safetensors")
    long = ("segments.length=300", "segments.count=2")  # steps, so that it leaves the numbers of 64 bits
    finished = distill(copy, "model=mujoco_default", *long, f"output={tmp_path / 'student'}")
    check_refused(finished, "the fitted drive diverges in 2 of 2 rollouts of 0.3 s", tmp_path / "student")
