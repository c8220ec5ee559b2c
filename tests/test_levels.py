"""The order of the package: a file imports only from the levels above it, or from its own."""

import ast
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "frictionzoo"
LEVELS = {
    **{"core": 0, "logs": 1, "models": 2},
    **dict.fromkeys(("bench", "simulate"), 3),
    **dict.fromkeys(("checkup", "models/contained", "models/contract", "models/formula", "simulate/bridge"), 4),
    **dict.fromkeys(("simulate/differentiable", "simulate/drive", "simulate/proof", "simulate/torch_rollout"), 4),
    **{"fit": 5, "identification": 7},
    **dict.fromkeys(("result", "show", "comparison", "export", "inspect", "excite", "card"), 6),
    **dict.fromkeys(("library", "cli", "run", "compare", "list", "distill"), 8),
    **{f"{part}/__main__": 8 for part in ("export", "inspect", "excite", "card")},
}
FORBIDDEN = {0: {"torch", "jax", "mujoco"}, 1: {"torch", "jax"}, 2: {"jax"}, 3: {"torch"}}
FILES = [path for path in sorted(PACKAGE.rglob("*.py")) if path != PACKAGE / "__init__.py"]


def part(names: tuple[str, ...]) -> str:
    """The part of the package to which a dotted name under it belongs, or a file's own level in it."""
    own = "/".join(names[:2]).removesuffix(".py")
    return own if own in LEVELS else names[0].removesuffix(".py")


def imports(tree: ast.Module) -> Iterator[str]:
    """Dotted names of all modules that a file imports, wherever in it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{'.' * node.level}{node.module or ''}.{alias.name}" for alias in node.names)


def mistakes(path: Path, source: str) -> list[str]:
    """Imports of a file that its level forbids."""
    level = LEVELS[part(path.relative_to(PACKAGE).parts)]
    found = []
    for name in imports(ast.parse(source)):
        package, *inside = name.split(".")
        if package == "frictionzoo" and inside and LEVELS.get(part(tuple(inside)), 0) > level:
            found.append(name)
        if not package or package in FORBIDDEN.get(level, ()):  # a relative import is none of ours
            found.append(name)
    return found


def test_a_file_imports_only_from_its_level_and_those_above() -> None:
    wrong = [f"{path}: {name}" for path in FILES for name in mistakes(path, path.read_text())]
    assert not wrong, "\n".join(wrong)


def test_a_wrong_import_is_found() -> None:
    wrong = {
        "core/log.py": "from frictionzoo.logs.files import Files",
        "logs/files.py": "import torch",
        "core/segments.py": "def cut():\n    import jax.numpy as jnp",
        "models/baseline.py": "from jax import numpy",
        "bench/base.py": "import torch.nn",
        "simulate/mjx.py": "from frictionzoo.simulate import bridge",
        "simulate/rollout.py": "from frictionzoo.simulate.drive import Drive",
        "fit/adam.py": "from frictionzoo.show.run_plots import write_figures",
        "result/evaluate.py": "import frictionzoo.cli.job",
        "fit/grid.py": "from .adam import Adam",
    }
    missed = [file for file, source in wrong.items() if len(mistakes(PACKAGE / file, source)) != 1]
    assert not missed, missed


def test_every_part_has_a_level() -> None:
    assert {part(path.relative_to(PACKAGE).parts) for path in FILES} <= set(LEVELS) and len(FILES) > 300
