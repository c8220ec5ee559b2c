"""Rollouts of the bench's SDF in Gazebo's physics, in whole simulation steps with delayed commands.

Debian packages provide it, with DART as its engine. Like DART it has no MuJoCo actuators, so the caller computes the
torque, and no armature.
"""

import argparse
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from caller import find_matter, make_torque
from given import Given, load_module, read_given
from native import Running, compile_program

LIBRARIES = ("ignition-physics5-sdf", "ignition-plugin1-loader")  # names for pkg-config
PLUGIN = Path("ign-physics-5", "engine-plugins", "libignition-physics5-dartsim-plugin.so.5")
DEBIAN = "g++ pkg-config libeigen3-dev libignition-physics-sdf-dev libignition-physics5-dartsim-plugin5"


def main() -> None:
    """Simulate each rollout from its initial state."""
    given, options = read_given(__doc__, add_options)
    flags, plugin = find_gazebo()
    program, file = given.out.with_suffix(".gazebo"), given.out.with_suffix(".sdf")
    compile_program("gazebo.cpp", program, flags)
    module: Any = load_module(given.folder / "mujoco" / "drive.py")
    found, version = np.empty((len(given.qpos), given.steps, len(given.joints))), ""
    for rollouts in given.alike():
        bench = mujoco.MjModel.from_xml_string(given.bench("mjcf", rollouts[0], late=False))
        file.write_text(write_sdf(given, bench, options.target))
        numbers = [repr(float(number)) for number in (given.timestep, *bench.opt.gravity)]
        gazebo = Running([program, plugin, file, *numbers, str(given.steps), *given.joints])
        version = gazebo.version
        for rollout in rollouts:
            found[rollout] = roll(given, module, bench, gazebo, rollout)
    given.write(given.sampled(found), **{"gazebo physics": version})


def find_gazebo() -> tuple[list[str], Path]:
    """Return the flags for g++ and the path of the plugin; exit if they are missing."""
    try:
        flags, folder = (
            subprocess.run(["pkg-config", *asked], check=True, capture_output=True, text=True).stdout
            for asked in (("--cflags", "--libs", *LIBRARIES), ("--variable=libdir", "ignition-physics5"))
        )
        plugin = (folder.strip() / PLUGIN).resolve(strict=True)
        subprocess.run(["g++", "--version"], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        sys.exit(f"no Gazebo physics: apt-get install {DEBIAN}")
    return flags.split(), plugin


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the option for the exported file to read."""
    parser.add_argument("--target", default="sdf", help="folder of the file")


def write_sdf(given: Given, bench: mujoco.MjModel, target: str) -> str:
    """Return the SDF with the payload's inertia in its link. Each body except MuJoCo's world has one link."""
    text = (given.folder / target / "bench.sdf").read_text()
    if not given.load.shape[1]:
        return text
    root = ElementTree.fromstring(text)
    mass, centre, moment = find_matter(bench, given.body)
    said = {"mass": mass, "pose": [*centre, 0.0, 0.0, 0.0]}
    for row, column in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)):
        said[f"inertia/i{'xyz'[row]}{'xyz'[column]}"] = moment[row, column]
    inertial = root.findall("./model/link/inertial")[given.body - 1]
    for path, numbers in said.items():
        element = inertial.find(path)
        assert element is not None
        element.text = " ".join(map(repr, np.atleast_1d(numbers).tolist()))
    return ElementTree.tostring(root, encoding="unicode")


def roll(given: Given, module: Any, bench: mujoco.MjModel, gazebo: Running, rollout: int) -> np.ndarray:
    """Return the positions after each simulation step of this rollout."""
    torque, found = make_torque(given, module, bench, rollout), []
    qpos, qvel = given.qpos[rollout] - bench.qpos0, given.qvel[rollout]  # Gazebo's zero is the pose in the file
    gazebo.tell(np.stack([qpos, qvel]))
    for number in range(given.steps):
        qpos, qvel = gazebo.ask(torque(number, qpos + bench.qpos0, qvel), 2, len(given.joints))
        found.append(qpos + bench.qpos0)
    return np.array(found)


if __name__ == "__main__":
    main()
