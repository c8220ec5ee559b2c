"""Rollouts of the bench's URDF or SDF in Drake, in whole steps of its discrete plant with delayed commands.

Drake reads neither MuJoCo's actuators nor dry friction: the caller computes the torque, and with `--dry` the friction.
"""

import argparse
from importlib.metadata import version
from typing import Any

import mujoco
import numpy as np
from caller import find_matter, make_torque
from given import Given, load_module, read_given
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RotationalInertia, SpatialInertia

SWEEPS = 100  # maximum, over all joints; they end at convergence


def main() -> None:
    """Simulate each rollout from its initial state."""
    given, options = read_given(__doc__, add_options)
    module: Any = load_module(given.folder / "mujoco" / "drive.py")
    file = given.folder / options.target / f"bench.{options.target}"
    found = np.empty((len(given.qpos), given.steps, len(given.joints)))
    for rollouts in given.alike():
        bench = mujoco.MjModel.from_xml_string(given.bench("mjcf", rollouts[0], late=False))
        bench.dof_frictionloss[:] *= options.dry
        plant = MultibodyPlant(given.timestep)
        plant.SetUseSampledOutputPorts(False)
        Parser(plant).AddModels(str(file))
        plant.mutable_gravity_field().set_gravity_vector(bench.opt.gravity)
        plant.Finalize()
        for rollout in rollouts:
            found[rollout] = roll(given, module, bench, plant, rollout)
    given.write(given.sampled(found), drake=version("drake") + options.dry * " with dry friction")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for the file and for what Drake does not read."""
    parser.add_argument("--target", choices=("urdf", "sdf"), required=True)
    parser.add_argument("--dry", action="store_true", help="the caller brings the file's dry friction")


def roll(given: Given, module: Any, bench: mujoco.MjModel, plant: MultibodyPlant, rollout: int) -> np.ndarray:
    """Return the positions after each simulation step of this rollout."""
    context, torque, found = plant.CreateDefaultContext(), make_torque(given, module, bench, rollout), []
    if given.load.shape[1]:
        put_payload(bench, plant, context, given.body)
    at = [plant.GetJointByName(name).velocity_start() for name in given.joints]
    loss = bench.dof_frictionloss
    port = plant.get_applied_generalized_force_input_port()

    def step(forces: np.ndarray) -> np.ndarray:
        port.FixValue(context, order(forces))
        return plant.EvalUniquePeriodicDiscreteUpdate(context).value().reshape(2, -1)[:, at]

    def order(values: np.ndarray) -> np.ndarray:
        return values[np.argsort(at)]

    qpos, qvel = given.qpos[rollout] - bench.qpos0, given.qvel[rollout]  # Drake's zero is the pose in the file
    for number in range(given.steps):
        driven = torque(number, qpos + bench.qpos0, qvel)
        plant.SetPositionsAndVelocities(context, np.concatenate([order(qpos), order(qvel)]))
        after = step(driven)
        if loss.any():
            inertia = plant.CalcMassMatrix(context)[np.ix_(at, at)] + given.timestep * np.diag(bench.dof_damping)
            after = step(driven - stop(after[1], given.timestep * np.linalg.inv(inertia), loss))
        qpos, qvel = after
        found.append(qpos + bench.qpos0)
    return np.array(found)


def stop(qvel: np.ndarray, response: np.ndarray, loss: np.ndarray) -> np.ndarray:
    """Return the dry friction that stops the joints within a step, limited to `loss` in each.

    Args:
        qvel: Velocities after the step without dry friction.
        response: Change of each velocity in the step per unit of torque in each joint.
        loss: Limit of the friction in each joint.
    """
    friction = np.zeros(len(qvel))
    for _ in range(SWEEPS):
        before = friction.copy()
        for joint, row in enumerate(response):
            left = friction[joint] + (qvel[joint] - row @ friction) / row[joint]
            friction[joint] = np.clip(left, -loss[joint], loss[joint])
        if np.allclose(friction, before, rtol=1e-12, atol=0.0):
            break
    return friction


def put_payload(bench: mujoco.MjModel, plant: MultibodyPlant, context: Any, body: int) -> None:
    """Set a link's inertia to the inertia of its body in MuJoCo."""
    mass, centre, inertia = find_matter(bench, body)
    entries = (*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2])
    matter = SpatialInertia.MakeFromCentralInertia(mass, centre, RotationalInertia(*entries))
    plant.GetBodyByName(bench.body(body).name).SetSpatialInertiaInBodyFrame(context, matter)


if __name__ == "__main__":
    main()
