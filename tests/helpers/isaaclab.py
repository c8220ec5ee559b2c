"""Names and signatures of Isaac Lab that written files use: recorded ones, and those of an installed package.

`python -m helpers.isaaclab SITE ...` (in `tests`) records those of the packages in these site-packages folders, one for
Isaac Lab 2 and one for 3. The sources are read, not run: they would start Isaac Sim.
"""

import ast
import json
import sys
from collections.abc import Iterator
from dataclasses import make_dataclass
from importlib.metadata import distributions
from pathlib import Path
from types import ModuleType
from typing import Any

RECORDED = Path(__file__).with_suffix(".json")
CONFIGURATIONS = ("ActuatorBaseCfg", "IdealPDActuatorCfg", "DelayedPDActuatorCfg", "DCMotorCfg")
WRITERS = ("armature", "friction_coefficient", "stiffness", "damping")
_INNER = "isaaclab/source/isaaclab/isaaclab"
_ARTICULATION = "assets/articulation/articulation.py"
SOURCES = {
    "2": {"": _INNER, "physx": f"{_INNER}/{_ARTICULATION}"},
    "3": {"": "isaaclab", "physx": f"isaaclab_physx/{_ARTICULATION}", "newton": f"isaaclab_newton/{_ARTICULATION}"},
}


def load_recorded() -> dict[str, Any]:
    """By major version: `version`, `fields` of each configuration, arguments of `writers`, `events` and `functions`."""
    return json.loads(RECORDED.read_text())


def read_signatures(site: Path) -> tuple[str, dict[str, Any]]:
    """Return major version and signatures of the package in a site-packages folder."""
    (version,) = [one.version for one in distributions(path=[str(site)]) if one.name == "isaaclab"]
    major = version.partition(".")[0]
    of, suffix = SOURCES[major], "_index" if major == "3" else ""
    package = site / of[""]
    actuators = [*package.glob("actuators/*_cfg.py")]
    classes = {node.name: node for path in actuators for node in _classes(path)}
    writers = [f"write_joint_{name}_to_sim{suffix}" for name in WRITERS]
    events = {
        node.name: _arguments(_method(node, "__call__"))
        for node in _classes(package / "envs/mdp/events.py")
        if node.name in ("randomize_actuator_gains", "randomize_joint_parameters")
    }
    native = package / "actuators/newton/adapter.py"
    functions = {node.name: _arguments(node) for node in _functions(native)} if native.exists() else {}
    return major, {
        "version": version,
        "fields": {name: sorted(_fields(classes, name)) for name in CONFIGURATIONS},
        "writers": {
            backend: {name: _arguments(_method(_classes(site / path)[0], name)) for name in writers}
            for backend, path in of.items()
            if backend
        },
        "events": events,
        "functions": {name: functions[name] for name in ("write_group_parameter",) if name in functions},
    }


def stub_configurations(major: str) -> ModuleType:
    """Return `isaaclab.actuators` with the recorded configuration classes, all of whose fields may be left out."""
    module: Any = ModuleType("isaaclab.actuators")
    for name, fields in load_recorded()[major]["fields"].items():
        setattr(module, name, make_dataclass(name, [(field, Any, None) for field in fields]))
    return module


def _classes(path: Path) -> list[ast.ClassDef]:
    return [node for node in ast.parse(path.read_text()).body if isinstance(node, ast.ClassDef)]


def _functions(path: Path) -> list[ast.FunctionDef]:
    return [node for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef)]


def _method(node: ast.ClassDef, name: str) -> ast.FunctionDef:
    (found,) = [one for one in node.body if isinstance(one, ast.FunctionDef) and one.name == name]
    return found


def _arguments(node: ast.FunctionDef) -> list[str]:
    return [one.arg for one in (*node.args.args, *node.args.kwonlyargs) if one.arg != "self"]


def _fields(classes: dict[str, ast.ClassDef], name: str) -> Iterator[str]:
    for base in classes[name].bases:
        if isinstance(base, ast.Name) and base.id in classes:
            yield from _fields(classes, base.id)
    for node in classes[name].body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.target.id != "class_type":
            yield node.target.id


if __name__ == "__main__":
    found = dict(read_signatures(Path(site)) for site in sys.argv[1:])
    RECORDED.write_text(json.dumps(dict(sorted(found.items())), indent=2) + "\n")
