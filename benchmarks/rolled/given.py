"""Input and output shared by the scripts of this folder, which run in target environments without frictionzoo."""

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
"""Commands (`ctrl`) and other input signals by name, each of shape (batch, steps, nv)."""


@dataclass(frozen=True)
class Given:
    """Rollouts to simulate, with the exported files of the drive.

    Attributes:
        folder: Folder of the exported files, one subfolder per target.
        out: NPZ file to write.
        joints: Joint names.
        timestep: Simulation timestep [s].
        substeps: Simulation steps per sample.
        qpos: Initial positions, of shape (batch, nv) [rad or m].
        qvel: Initial velocities, of shape (batch, nv) [rad/s or m/s].
        recorded: Recorded signals in each simulation step.
        acting: The same signals, delayed by the drive's delay.
        before: Recorded signals before the initial state, the newest last.
        targets: Desired positions of a position-controlled motor, not delayed; empty for other drives.
        targets_before: The same before the initial state.
        lags: Command delay in whole simulation steps, one per joint.
        load: Mass, centre of mass, orientation and principal inertia of the body with the payload, one row per rollout;
            rows are empty without a payload.
        body: Index of that body in the model; -1 without a payload.
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
        """Return the number of simulation steps in a rollout."""
        return self.recorded["ctrl"].shape[1]

    def alike(self) -> Iterator[np.ndarray]:
        """Yield the indices of all rollouts with the same payload, which share one model."""
        rows = np.unique(self.load, axis=0, return_inverse=True)[1].reshape(-1)
        for payload in range(rows.max() + 1):
            yield np.flatnonzero(rows == payload)

    def bench(self, target: str, rollout: int, late: bool = True) -> str:
        """Return a target's MJCF with the payload of a rollout; unless `late`, without the delay of its actuators."""
        root = ElementTree.parse(self.folder / target / "bench.xml").getroot()
        if self.load.shape[1]:
            body = list(root.iter("body"))[self.body - 1]  # MuJoCo numbers bodies in file order, the world first
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
        """Select the positions after each sample from those after each simulation step, on the second axis."""
        return qpos[:, self.substeps - 1 :: self.substeps]

    def write(self, qpos: np.ndarray, *packages: str, **versions: str) -> None:
        """Write positions after each sample, (batch, time, nv), with the simulating packages and their versions."""
        said = versions | {name: version(name) for name in packages}
        np.savez(self.out, qpos=qpos, program=", ".join(f"{name} {number}" for name, number in said.items()))


def read_given(
    description: str | None, add: Callable[[argparse.ArgumentParser], Any] = lambda parser: None
) -> tuple[Given, argparse.Namespace]:
    """Parse the command line; return the rollouts, and the options that `add` defines."""
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
    """Import an exported Python file."""
    spec = importlib.util.spec_from_file_location(f"exported_{path.stem}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
