"""Each notebook runs from top to bottom and prints what it is stored with."""

import math
import re

import nbformat
import pytest
from conftest import ROOT
from nbclient import NotebookClient

NOTEBOOKS = {path.stem: path for path in sorted((ROOT / "notebooks").glob("*.ipynb"))}
FIGURES = {"quickstart": 2, "add_a_law": 3, "paper": 5}
WITHIN = {"quickstart": 1.0, "add_a_law": 5.0}  # deviation of identified parameters from the true ones [%]
NUMBER = re.compile(r"[+-]?\d+\.\d+|[+-]\d+")

# Jupyter's own: it warns of a change in where it will keep files, and of sockets that the kernel leaves open.
pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning:jupyter_core"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


def read(name):
    return nbformat.read(NOTEBOOKS[name], as_version=4)


def list_outputs(notebook):
    return [output for cell in notebook.cells for output in cell.get("outputs", [])]


def join_printed(notebook):
    return "".join(output.text for output in list_outputs(notebook) if output.output_type == "stream")


def list_lines(notebook):
    """Printed lines, without those of the network in float32, which depend on the rounding of 700 iterations."""
    return [line for line in join_printed(notebook).splitlines() if "neural_friction" not in line]


def agree(shown: str, stored: str) -> bool:
    """Whether two numbers differ by at most 5 %, or by at most 10 units of their last digit."""
    last = 10.0 ** -len(stored.partition(".")[2])
    return math.isclose(float(shown), float(stored), rel_tol=0.05, abs_tol=10 * last)


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_is_stored_with_its_outputs(name):
    notebook = read(name)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))  # in one go
    outputs = list_outputs(notebook)
    assert not [output for output in outputs if output.output_type == "error" or output.get("name") == "stderr"]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == FIGURES[name]
    assert not re.search(r"/(home|root|tmp|Users)/", nbformat.writes(notebook))  # no path of the machine that ran it
    imports = re.findall(r"^(?:from|import) (frictionzoo\S*)", "\n".join(cell.source for cell in cells), re.MULTILINE)
    assert set(imports) == {"frictionzoo"}  # the public names are enough
    errors = [float(line.split()[-2]) for line in list_lines(notebook) if " true " in line]
    assert all(abs(error) < WITHIN.get(name, math.inf) for error in errors)


@pytest.mark.slow
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_prints_what_is_stored(name, tmp_path, compilation_cache, monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(compilation_cache))
    notebook, stored = read(name), list_lines(read(name))
    NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = list_lines(notebook)
    assert [NUMBER.sub("#", line) for line in shown] == [NUMBER.sub("#", line) for line in stored]
    pairs = zip(*(NUMBER.findall("\n".join(lines)) for lines in (shown, stored)), strict=True)
    assert not [pair for pair in pairs if not agree(*pair)]
    assert sum("image/png" in output.get("data", {}) for output in list_outputs(notebook)) == FIGURES[name]
