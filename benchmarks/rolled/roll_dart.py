"""Rollouts of the bench's URDF in DART, Gazebo's default engine, in whole simulation steps with delayed commands.

DART reads links, damping and dry friction from the URDF; it does not read SDF of the version of bench.sdf. It has no
MuJoCo actuators: the caller computes the torque. It has no armature: with `--rotors` the caller adds it to the links.
"""

import argparse
import xml.etree.ElementTree as ElementTree
from typing import Any

import dartpy
import mujoco
import numpy as np
from caller import find_matter, make_torque
from given import Given, load_module, read_given

ROTOR = "{http://drake.mit.edu}rotor_inertia"  # at gear ratio 1, one per joint, in joint order


def main() -> None:
    """Simulate each rollout from its initial state."""
    given, options = read_given(__doc__, add_options)
    module: Any = load_module(given.folder / "mujoco" / "drive.py")
    file = given.folder / "urdf" / "bench.urdf"
    rotors = [float(tag.get("value", "nan")) for tag in ElementTree.parse(file).iter(ROTOR)]
    found = np.empty((len(given.qpos), given.steps, len(given.joints)))
    for rollouts in given.alike():
        bench = mujoco.MjModel.from_xml_string(given.bench("mjcf", rollouts[0], late=False))
        world, skeleton = dartpy.simulation.World(), dartpy.utils.DartLoader().parseSkeleton(str(file))
        world.setTimeStep(given.timestep)
        world.setGravity(bench.opt.gravity)
        world.addSkeleton(skeleton)
        if given.load.shape[1]:
            put_payload(bench, skeleton, given.body)
        if options.rotors:
            for name, inertia in zip(given.joints, rotors, strict=True):
                add_rotor(skeleton.getJoint(name), inertia)
        for rollout in rollouts:
            found[rollout] = roll(given, module, bench, world, rollout)
    given.write(given.sampled(found), dart=dartpy.__version__ + options.rotors * " with rotors in links")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the option for what DART does not read."""
    parser.add_argument("--rotors", action="store_true", help="the caller adds the file's rotors to the links")


def roll(given: Given, module: Any, bench: mujoco.MjModel, world: dartpy.simulation.World, rollout: int) -> np.ndarray:
    """Return the positions after each simulation step of this rollout."""
    skeleton, torque, found = world.getSkeleton(0), make_torque(given, module, bench, rollout), []
    at = [skeleton.getJoint(name).getIndexInSkeleton(0) for name in given.joints]
    order = np.argsort(at)
    world.reset()
    skeleton.setPositions((given.qpos[rollout] - bench.qpos0)[order])  # DART's zero is the pose in the file
    skeleton.setVelocities(given.qvel[rollout][order])
    for number in range(given.steps):
        qpos, qvel = skeleton.getPositions()[at] + bench.qpos0, skeleton.getVelocities()[at]
        skeleton.setForces(torque(number, qpos, qvel)[order])
        world.step()
        found.append(skeleton.getPositions()[at] + bench.qpos0)
    return np.array(found)


def put_payload(bench: mujoco.MjModel, skeleton: dartpy.dynamics.Skeleton, body: int) -> None:
    """Set a link's inertia to the inertia of its body in MuJoCo."""
    matter = dartpy.dynamics.Inertia(*find_matter(bench, body))
    skeleton.getBodyNode(bench.body(body).name).setInertia(matter)


def add_rotor(joint: Any, inertia: float) -> None:
    """Add a rotor's inertia about its joint's axis to the link.

    Exact for links attached to the world. Otherwise the rotor also turns with the link's parents, unlike armature.
    """
    link, along = joint.getChildBodyNode(), joint.getRelativeJacobian()
    link.setInertia(dartpy.dynamics.Inertia(link.getInertia().getSpatialTensor() + inertia * along @ along.T))


if __name__ == "__main__":
    main()
