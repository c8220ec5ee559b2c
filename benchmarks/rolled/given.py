"""What the scripts of this folder share. They run in a target's own environment: numpy, and no frictionzoo."""

import argparse
import importlib.util
import json
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

Signals = dict[str, np.ndarray]
"""Commands (`ctrl`) and what else acts, by name, each of shape (batch, steps, nv)."""


@dataclass(frozen=True)
class Given:
    """Rollouts, and the files of the drive that is to move in them.

    Attributes:
        folder: With the exported files, a folder a target.
        out: NPZ file that is to be written.
        joints: Their names.
        timestep: Of the simulation [s].
        substeps: Steps of the simulation in a sample.
        qpos: Where rollouts begin, of shape (batch, nv) [rad or m].
        qvel: Likewise [rad/s or m/s].
        recorded: What was commanded in each step.
        acting: The same, as late as the drive's delay makes it.
        before: What was commanded before the first state, the newest last.
        targets: Desired positions, as a position-controlled motor is given them, not late; empty for other drives.
        targets_before: Likewise before the first state.
        lags: Whole steps of the simulation by which the drive delays commands, one a joint.
        load: Of the body with the payload in each rollout: mass, centre of mass, orientation, principal inertia.
        body: Its index in the model.
    """

    folder: Path
    out: Path
    joints: list[str]
    timestep: float
    substeps: int
    qpos: np.ndarray
    qvel: np.ndarray
    recorded: Signals
    acting: Signals
    before: Signals
    targets: np.ndarray
    targets_before: np.ndarray
    lags: list[int]
    load: np.ndarray
    body: int

    @property
    def steps(self) -> int:
        """Of the simulation, in a rollout."""
        return self.recorded["ctrl"].shape[1]

    def alike(self) -> Iterator[np.ndarray]:
        """Numbers of the rollouts that one model serves: those with one payload."""
        rows = np.unique(self.load, axis=0, return_inverse=True)[1].reshape(-1)
        for payload in range(rows.max() + 1):
            yield np.flatnonzero(rows == payload)

    def bench(self, target: str, rollout: int, late: bool = True) -> str:
        """MJCF of a target, with a rollout's payload in it; where commands are not `late` in it, its caller delays."""
        root = ElementTree.parse(self.folder / target / "bench.xml").getroot()
        if self.load.shape[1]:
            body = list(root.iter("body"))[self.body - 1]  # MuJoCo numbers them as they stand, the world first
            for element in body.findall("inertial"):
                body.remove(element)
            mass, centre, turned, inertia = np.split(self.load[rollout], (1, 4, 8))
            parts = {"mass": mass, "pos": centre, "quat": turned, "diaginertia": inertia}
            said = {name: " ".join(map(repr, part.tolist())) for name, part in parts.items()}
            body.insert(0, ElementTree.Element("inertial", said))
        for actuator in [] if late else root.findall("./actuator/*"):
            for name in ("delay", "nsample"):
                actuator.attrib.pop(name, None)
        return ElementTree.tostring(root, encoding="unicode")

    def sampled(self, qpos: np.ndarray) -> np.ndarray:
        """Of positions after each step, on the second axis, those after each sample."""
        return qpos[:, self.substeps - 1 :: self.substeps]

    def write(self, qpos: np.ndarray, *packages: str, **versions: str) -> None:
        """Write positions after each sample, (batch, time, nv), and the packages and versions that simulated them."""
        said = versions | {name: version(name) for name in packages}
        np.savez(self.out, qpos=qpos, program=", ".join(f"{name} {number}" for name, number in said.items()))


def read_given(
    description: str | None, add: Callable[[argparse.ArgumentParser], Any] = lambda parser: None
) -> tuple[Given, argparse.Namespace]:
    """What a script of this folder was given, and its own options, which `add` adds."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("given", type=Path, help="NPZ file of benchmarks/targets.py")
    parser.add_argument("folder", type=Path, help="with the exported files, a folder a target")
    parser.add_argument("out", type=Path, help="NPZ file that is written")
    add(parser)
    options = parser.parse_args()
    with np.load(options.given, allow_pickle=False) as file:
        arrays = dict(file)
    by_kind: dict[str, Signals] = {"recorded": {}, "acting": {}, "before": {}}
    for name in [name for name in arrays if "." in name]:
        kind, _, signal = name.partition(".")
        by_kind[kind][signal] = arrays.pop(name)
    known: dict[str, Any] = json.loads(str(arrays.pop("settings")))
    return Given(options.folder, options.out, **known | arrays | by_kind), options


def load_module(path: Path) -> ModuleType:
    """An exported Python file."""
    spec = importlib.util.spec_from_file_location(f"exported_{path.stem}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
