"""The identified drive as MJCF, which MuJoCo C loads as it is."""

import copy

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import nnls

from frictionzoo.bench.base import Bench
from frictionzoo.evaluate import Values
from frictionzoo.models.base import FrictionModel, sliding_torque
from frictionzoo.params import UNITS
from frictionzoo.types import DriveState, FrictionTerms


def export_mjcf(bench: Bench, values: Values, model: FrictionModel, samples: DriveState) -> str:
    """The bench with its identified values and the law's friction, or the nearest that MJCF can represent.

    A law is represented exactly if it answers with a constant `frictionloss` and `damping` and no torque of its own.
    The nearest to any other law is the least-squares one over the training samples with frictionloss and damping >= 0.
    A law that looks at more than the state is written as it is where recordings lack that.

    Args:
        bench: The bench.
        values: Identified and known values; those of the section `bench` are written.
        model: The friction law, holding its identified values.
        samples: Training samples as numpy arrays of shape (samples, nv).
    """
    velocity = np.asarray(samples.qvel, dtype=np.float64)
    terms = evaluate_law(model, without_inputs(model, samples))
    _, frictionloss, damping = (np.zeros(velocity.shape) if term is None else term for term in terms)
    if terms.torque is None and is_constant(frictionloss) and is_constant(damping):
        loss, viscous = frictionloss[0], damping[0]
        comment = say_exact(model)
    else:
        total = sliding_torque(np, terms, velocity)
        loss, viscous = nearest_frictionloss_and_damping(total, velocity)
        difference = total - sliding_torque(np, FrictionTerms(frictionloss=loss, damping=viscous), velocity)
        comment = _disclaim(model.name, np.sqrt(np.square(difference).mean(axis=0)), bench.joint_type)
    return bench.mjcf(
        values["bench"],
        frictionloss=loss if loss.any() else None,  # 0 would be a constraint without effect
        damping=viscous,
        comments=(comment,),
    )


def nearest_frictionloss_and_damping(
    torque: Float[np.ndarray, "samples nv"], velocity: Float[np.ndarray, "samples nv"]
) -> tuple[Float[np.ndarray, "nv"], Float[np.ndarray, "nv"]]:
    """Coulomb and viscous friction nearest to a friction torque, both >= 0, by non-negative least squares a joint.

    Args:
        torque: Friction torque or force, positive against positive velocity [N m or N].
        velocity: Joint velocity [rad/s or m/s].

    Returns:
        frictionloss [N m or N] and damping [N m s/rad or N s/m].
    """
    fits = [nnls(np.stack([np.sign(v), v], axis=1), t)[0] for t, v in zip(torque.T, velocity.T, strict=True)]
    loss, viscous = np.array(fits).T
    return loss, viscous


def evaluate_law(model: FrictionModel, samples: DriveState) -> FrictionTerms:
    """The law's terms on samples as float64 numpy arrays of shape (samples, nv), or None.

    Args:
        model: The law with its values.
        samples: Numpy arrays of shape (samples, nv).
    """
    double = copy.deepcopy(model).double()
    terms = double(samples.map(lambda signal: torch.as_tensor(np.asarray(signal, dtype=np.float64))))
    shape = np.shape(samples.qvel)
    return FrictionTerms(*(None if term is None else np.broadcast_to(term.detach().numpy(), shape) for term in terms))


def without_inputs(model: FrictionModel, samples: DriveState) -> DriveState:
    """The samples as if the recordings lacked what the law looks at besides the state.

    Args:
        model: The law.
        samples: Numpy arrays of shape (samples, nv).
    """
    return samples._replace(**{name: np.full(np.shape(samples.qvel), value) for name, value in model.inputs.items()})


def say_exact(model: FrictionModel) -> str:
    """In words, that a frictionloss and a damping are the law, and where."""
    where = "".join(f", at {name} {value:g} and at no other" for name, value in model.inputs.items())
    return f"{model.name}: represented exactly by the frictionloss and damping below{where}."


def is_constant(values: Float[np.ndarray, "samples nv"]) -> bool:
    """Whether a term is the same in all samples."""
    return bool((values == values[0]).all())


def _disclaim(name: str, rms: Float[np.ndarray, "nv"], joint_type: str) -> str:
    unit = UNITS[joint_type]["torque"]
    listed = ", ".join(f"{joint:.4g}" for joint in rms)
    return (
        f"{name} is not representable in MJCF by a frictionloss and a damping. Those below are the nearest to it in "
        f"the least-squares sense over the training samples, not the law itself: RMS difference {listed} {unit}."
    )
