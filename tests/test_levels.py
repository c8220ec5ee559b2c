"""The order of the package: a room imports only from the rooms above it, and no imports go in a circle."""

import ast
import pkgutil
import re
from graphlib import TopologicalSorter
from pathlib import Path

from helpers.imports import imports

PACKAGE = Path(__file__).parent.parent / "frictionzoo"
ROOMS = ["core", "data", "models", "bench", "diagnostics", "simulation", "fit", "result", "identification"]
ROOMS += ["design", "report", "export", "api", "cli"]
SIBLINGS = {"design", "report", "export"}  # rooms that do not import each other
FORBIDDEN = {
    "core": {"torch", "jax", "mujoco"},
    "models": {"jax", "mujoco"},
    **{name: {"torch", "jax"} for name in ("data", "bench", "diagnostics")},
    "simulation": {"torch"},
}
ALLOWED = {
    **dict.fromkeys(("bridge", "differentiable", "drive", "proof", "pt", "torch_rollout"), "torch"),
    **dict.fromkeys(("contract", "formula"), "jax"),
}
"""Libraries that a room forbids, and the files in it that are there to join them."""
FILES = {".".join(path.relative_to(PACKAGE).with_suffix("").parts): path for path in sorted(PACKAGE.rglob("*.py"))}
FILES.pop("__init__")  # it names where everything public lives, and imports none of it


def test_the_guide_names_what_exists() -> None:
    """The functions on the way from `identify` to a `Result`, in CONTRIBUTING."""
    rows = re.findall(r"^\| (`(?:api|\w+)\.\w+.*?) \|", (PACKAGE.parent / "CONTRIBUTING.md").read_text(), re.MULTILINE)
    names = [name for row in rows for name in re.findall(r"`(\w+\.[\w.]+)`", row) if not name.endswith(".py")]
    assert len(names) >= 12, names
    for name in names:
        assert pkgutil.resolve_name(f"frictionzoo.{name}"), name


def room(file: str) -> str:
    """Room of a file; a file outside the rooms, and `python -m` of one, are commands."""
    first = file.partition(".")[0]
    return first if first in ROOMS and not file.endswith(".__main__") else "cli"


def mistakes(file: str, source: str) -> list[str]:
    """Imports of a file that its room forbids."""
    own, wrong = room(file), []
    for name in imports(source):
        package, *inside = name.split(".")
        if package == "frictionzoo" and inside and inside[0] in ROOMS:
            other = inside[0]
            if ROOMS.index(other) > ROOMS.index(own) or (other != own and {own, other} <= SIBLINGS):
                wrong.append(name)
        stem = file.rpartition(".")[2]
        if not package or (package in FORBIDDEN.get(own, ()) and ALLOWED.get(stem) != package):
            wrong.append(name)
    return wrong


WRONG = {
    "core.log": "from frictionzoo.data.files import Files",
    "core.segments": "def cut():\n    import jax.numpy as jnp",
    "data.files": "import torch",
    "models.baseline": "from jax import numpy",
    "simulation.mjx": "from torch import nn",
    "result.evaluate": "import frictionzoo.cli.job",
    "export.bam": "from frictionzoo.report.page import render_page",
    "design.plan": "if TYPE_CHECKING:\n    from frictionzoo.api.identified import Identified",
    "fit.grid": "from .adam import Adam",
}


def test_a_room_imports_only_from_rooms_above_it() -> None:
    wrong = [f"{file}: {name}" for file, path in FILES.items() for name in mistakes(file, path.read_text())]
    assert not wrong, "\n".join(wrong)
    assert all(len(mistakes(file, source)) == 1 for file, source in WRONG.items())


def test_no_files_import_each_other_in_a_circle() -> None:
    def named(name: str) -> str | None:
        """Return the file that an import of ours reads."""
        package, _, inside = name.partition(".")
        module = inside.rpartition(".")[0]
        places = (inside, module, f"{inside}.__init__", f"{module}.__init__") if package == "frictionzoo" else ()
        return next((place for place in places if place in FILES), None)

    graph = {file: {*map(named, imports(path.read_text()))} - {file, None} for file, path in FILES.items()}
    TopologicalSorter(graph).prepare()  # its error names the files


def test_every_room_is_a_folder_with_files() -> None:
    assert {path.parent.name for path in PACKAGE.glob("*/__init__.py")} == {*ROOMS} and len(FILES) > 150


def test_no_file_and_no_function_is_too_long() -> None:
    """At most 400 lines a file, and 60 a function without its docstring."""
    too_long = []
    for file, path in FILES.items():
        tree = ast.parse(source := path.read_text())
        too_long += [file] if source.count("\n") > 400 else []
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                first = node.body[1] if ast.get_docstring(node) and len(node.body) > 1 else node.body[0]
                too_long += [f"{file}.{node.name}"] if (node.end_lineno or 0) - first.lineno >= 60 else []
    assert not too_long
