"""MuJoCo's own joint friction that moves a bench most like a law that MuJoCo does not have."""

from dataclasses import dataclass

import jax
import numpy as np
import torch
from jaxtyping import Float

from frictionzoo.engine import friction_of, make_engine
from frictionzoo.export.fitted import Fitted
from frictionzoo.export.mjcf import (
    evaluate_law,
    is_constant,
    nearest_frictionloss_and_damping,
    say_exact,
    without_inputs,
)
from frictionzoo.fit import LevenbergMarquardt, Objective, Space
from frictionzoo.models import MujocoDefault
from frictionzoo.models.base import sliding_torque
from frictionzoo.params import UNITS
from frictionzoo.rollout import make_rollout
from frictionzoo.types import Segments

_ITERATIONS = 50  # a dozen is usual
_SMALLEST, _LARGEST = 1e-6, 1e3  # of the typical torque, between which friction is looked for


@dataclass(frozen=True)
class Nearest:
    """What MuJoCo's joints can hold of a drive.

    Attributes:
        bench: Values of the bench's parameters.
        frictionloss: [N m or N].
        damping: [N m s/rad or N s/m].
        exact: Whether the law is MuJoCo's own.
        remark: In words, what was done and what that costs; empty where it is exact anywhere.
    """

    bench: dict[str, Float[np.ndarray, "nv"]]
    frictionloss: Float[np.ndarray, "nv"]
    damping: Float[np.ndarray, "nv"]
    exact: bool
    remark: str = ""


def find_nearest(fitted: Fitted) -> Nearest:
    """The drive with MuJoCo's own friction, refitted where the law is another.

    The start is the least-squares friction over the measured states. From there armature, frictionloss and damping
    follow the fitted drive's own long rollouts, so that they make up for each other.

    Args:
        fitted: The drive.
    """
    # What a law looks at besides the state, MuJoCo's joints do not know.
    terms = evaluate_law(fitted.model, without_inputs(fitted.model, fitted.samples))
    velocity = fitted.samples.qvel
    _, loss, viscous = (np.zeros(velocity.shape) if term is None else term for term in terms)
    bench = dict(fitted.values["bench"])
    if terms.torque is None and is_constant(loss) and is_constant(viscous):
        remark = say_exact(fitted.model) if fitted.model.inputs else ""
        return Nearest(bench, loss[0], viscous[0], exact=not remark, remark=remark)
    start = nearest_frictionloss_and_damping(sliding_torque(np, terms, velocity), velocity)
    return _refit(fitted, *start)


def _refit(fitted: Fitted, loss: Float[np.ndarray, "nv"], damping: Float[np.ndarray, "nv"]) -> Nearest:
    followed = fitted.follow(fitted.segments)
    with jax.enable_x64(True):
        objective = _pose(fitted, followed, loss, damping)
        fit = LevenbergMarquardt(_ITERATIONS, 1e-8)
        progress, _ = fit.chunk(objective, _ITERATIONS)(fit.start(objective), _ITERATIONS)
        found = jax.tree.map(lambda value: np.asarray(value, np.float64), objective.space.values(progress.best))
        before = float(np.sqrt(objective.compile(objective.loss)(objective.space.start, objective.data)))
    bench, friction = dict(found["bench"]), found["friction"]
    remark = _say(fitted, bench["armature"], before, float(np.sqrt(progress.best_loss)))
    return Nearest(bench, friction["frictionloss"], friction["damping"], exact=False, remark=remark)


def _pose(
    fitted: Fitted, followed: Segments, loss: Float[np.ndarray, "nv"], damping: Float[np.ndarray, "nv"]
) -> Objective:
    """The mean square distance of MuJoCo's friction from these rollouts, from this friction on."""
    bench = fitted.bench.restarted(fitted.values["bench"])
    torque = float(np.std(fitted.samples.motor_torque)) or 1.0
    sizes = {"frictionloss": torque, "damping": torque / (float(np.std(fitted.samples.qvel)) or 1.0)}
    model = MujocoDefault(bench.nv, {name: _free(size) for name, size in sizes.items()})
    for name, value in (("frictionloss", loss), ("damping", damping)):
        start = np.clip(value, 2 * _SMALLEST * sizes[name], _LARGEST * sizes[name])
        model.get_parameter(name).data.copy_(torch.from_numpy(start))
    rollout = make_rollout(make_engine("auto", bench, friction_of(model), model.constraint), fitted.sampling)
    return Objective(Space(bench, model, "float64"), rollout, followed, 1.0, 0.0, "none", 1.0, False)


def _free(size: float) -> dict[str, float | bool]:
    """Bounds and scale of a friction parameter of about this size."""
    return {"init": size, "low": _SMALLEST * size, "high": _LARGEST * size, "scale": size, "identify": True}


def _say(fitted: Fitted, armature: Float[np.ndarray, "nv"], before: float, after: float) -> str:
    identified, joint_type = fitted.values["bench"]["armature"], fitted.bench.joint_type
    unit, inertia = UNITS[joint_type]["position"], UNITS[joint_type]["inertia"]
    return (
        f"A frictionloss and a damping are no {fitted.model.name}: they and the armature were refitted to the fitted "
        f"drive's own {fitted.over} and leave a position difference of {after:.3g} {unit} RMS ({before:.3g} {unit} "
        f"with the friction nearest to the law's torque); armature {_list(armature)} instead of {_list(identified)} "
        f"{inertia}."
    )


def _list(values: Float[np.ndarray, "nv"]) -> str:
    return ", ".join(f"{value:.4g}" for value in values)
