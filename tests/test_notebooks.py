"""Every notebook runs from top to bottom, in a short mode, and is stored without outputs."""

import json
from pathlib import Path

import nbformat
import pytest
from conftest import ROOT
from nbclient import NotebookClient

NOTEBOOKS = {path.stem: path for path in sorted((ROOT / "notebooks").glob("*.ipynb"))}

# Jupyter's own: it warns of a change in where it will keep files, and of sockets that the kernel leaves open.
pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning:jupyter_core"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.usefixtures("in_haste"),
]


def hold_parameters(printed: list[str], count: int) -> None:
    """The hidden parameters come out within 5 %: what 8 s of this noise allow."""
    errors = [float(line.split()[-2]) for line in printed if " hidden " in line]
    assert len(errors) == count and all(abs(error) < 5.0 for error in errors), printed


def hold_quickstart(folder: Path, printed: list[str]) -> None:
    assert (folder / "run" / "result.json").exists()
    hold_parameters(printed, 3)


def hold_a_law(folder: Path, printed: list[str]) -> None:
    """The new law is found again and recommended: the others are worse by more than noise."""
    hold_parameters(printed, 5)
    comparison = json.loads((folder / "comparison" / "comparison.json").read_text())
    assert {run["label"] for run in comparison["runs"]} == {"asymmetric_coulomb", "coulomb_smooth", "mujoco_default"}
    assert comparison["recommendation"]["run"] == "asymmetric_coulomb"
    verdicts = [pair["verdict"] for pair in comparison["pairs"] if pair["other"] == "asymmetric_coulomb"]
    assert verdicts == ["worse", "worse"]


def hold_paper(folder: Path, printed: list[str]) -> None:
    """The order of the paper: the model without friction is last, and the two laws are worth their parameters."""
    comparison = json.loads((folder / "sweep" / "comparison" / "comparison.json").read_text())
    errors = {run["label"]: run["test"]["position_mae"] for run in comparison["runs"]}
    assert set(errors) == {"baseline", "coulomb_smooth", "mujoco_default"} and not comparison["failures"]
    assert all(errors[name] < 0.5 * errors["baseline"] for name in ("coulomb_smooth", "mujoco_default")), errors
    assert comparison["recommendation"]["run"] != "baseline"
    # MuJoCo's law and the smooth one agree on the armature, and not with the model that has to do without friction.
    armature = {line.split()[0]: float(line.split()[2]) for line in printed if " armature " in line}
    assert armature["mujoco_default"] == pytest.approx(armature["coulomb_smooth"], rel=0.1)
    assert armature["baseline"] > 1.5 * armature["mujoco_default"]


SHORT = {  # a notebook's parameters in its short mode, how many figures it shows, and what it has to leave
    "quickstart": ('FOLDER = "quickstart"\nSECONDS = 8.0\nITERATIONS = 250', 3, hold_quickstart),
    "add_a_law": ('FOLDER = "add_a_law"\nSECONDS = 8.0\nOTHERS = ("mujoco_default", "coulomb_smooth")', 3, hold_a_law),
    "paper": (
        'FOLDER = "paper"\nMODELS = "baseline,coulomb_smooth,mujoco_default"\n'
        'OPTIONS = ["data.samples=30000", "data.cache_dir=null", "segments.count=1000", "fit.iterations=300", '
        '"evaluation.trajectory=1.0", "evaluation.rollouts=3", "evaluation.places=3", "discretisation=false"]',
        5,
        hold_paper,
    ),
}


def test_notebooks_are_stored_without_outputs():
    assert NOTEBOOKS.keys() == SHORT.keys()
    for path in NOTEBOOKS.values():
        for cell in nbformat.read(path, as_version=4).cells:
            assert cell.cell_type != "code" or (not cell.outputs and cell.execution_count is None), path


@pytest.mark.slow
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_runs(name, tmp_path, compilation_cache, monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(compilation_cache))
    short, images, hold = SHORT[name]
    notebook = nbformat.read(NOTEBOOKS[name], as_version=4)
    (parameters,) = (cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", []))
    parameters.source = short
    NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == images
    printed = "".join(output.text for output in outputs if output.output_type == "stream").splitlines()
    hold(tmp_path / name, printed)
