"""MuJoCo's own joint friction that moves a bench most like a law that MuJoCo does not have."""

import copy
from dataclasses import dataclass, replace

import jax
import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.optimize import nnls

from frictionzoo.core.errors import RunError
from frictionzoo.core.params import UNITS
from frictionzoo.core.segments import Segments
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.fit import Objective, Space
from frictionzoo.fit.chunk import search
from frictionzoo.fit.lm import LevenbergMarquardt
from frictionzoo.models import FrictionModel
from frictionzoo.models.base import sliding_torque
from frictionzoo.models.mujoco_default import MujocoDefault
from frictionzoo.result.identified import Identified
from frictionzoo.result.names import name_some
from frictionzoo.simulate import friction_of, make_engine
from frictionzoo.simulate.rollout import make_rollout

_ITERATIONS = 50  # a dozen is usual
_SMALLEST, _LARGEST = 1e-6, 1e3  # of the typical torque, between which friction is looked for


@dataclass(frozen=True)
class Nearest:
    """What MuJoCo's joints can hold of a drive.

    Attributes:
        bench: Values of the bench's parameters.
        frictionloss: [N m or N].
        damping: [N m s/rad or N s/m].
        remark: In words, what was done and what that costs; empty where the law is MuJoCo's own.
    """

    bench: dict[str, Float[np.ndarray, "nv"]]
    frictionloss: Float[np.ndarray, "nv"]
    damping: Float[np.ndarray, "nv"]
    remark: str = ""


def find_nearest(fitted: Identified) -> Nearest:
    """The drive with MuJoCo's own friction, refitted where the law is another.

    The start is the least-squares friction over the measured states. From there armature, frictionloss and damping
    follow the fitted drive's own long rollouts, so that they make up for each other. Where those diverge, it stays at
    the start, and says so.
    """
    model, samples, bench = fitted.model, fitted.samples, dict(fitted.values["bench"])
    velocity = samples.qvel
    # What a law looks at besides the state, MuJoCo's joints do not know.
    unknown = {name: np.full(velocity.shape, value) for name, value in model.inputs.items()}
    terms = evaluate_law(model, samples._replace(**unknown))
    explicit, loss, viscous = (np.zeros(velocity.shape) if term is None else term for term in terms)
    exact = (explicit == 0).all(axis=0) & (loss == loss[0]).all(axis=0) & (viscous == viscous[0]).all(axis=0)
    if exact.all():
        return Nearest(bench, loss[0], viscous[0], say_exact(model) if model.inputs else "")
    torque = sliding_torque(np, terms, velocity)
    dry, damping = nearest_frictionloss_and_damping(torque, velocity)
    start = np.where(exact, loss[0], dry), np.where(exact, viscous[0], damping)
    try:
        followed = fitted.follow(fitted.segments)
    except RunError:
        left = torque - sliding_torque(np, FrictionTerms(frictionloss=start[0], damping=start[1]), velocity)
        rms, unit = _list(np.sqrt(np.square(left).mean(axis=0))), UNITS[fitted.bench.joint_type]["torque"]
        return Nearest(
            *(bench, *start),
            f"A frictionloss and a damping are no {_name(fitted, exact)}, and the fitted drive diverges in its own "
            f"{fitted.over}, so that they could not be refitted to those: they are the nearest to the law's torque at "
            f"the measured states, from which they differ by {rms} {unit} RMS.{_say_others(model, exact)}",
        )
    return _refit(fitted, followed, *start, exact)


def _refit(
    fitted: Identified,
    followed: Segments,
    loss: Float[np.ndarray, "nv"],
    damping: Float[np.ndarray, "nv"],
    exact: Bool[np.ndarray, "nv"],
) -> Nearest:
    with jax.enable_x64(True):
        objective = _pose(fitted, followed, loss, damping, exact)
        progress, _ = search(LevenbergMarquardt(_ITERATIONS, 1e-8), objective)
        found = jax.tree.map(lambda value: np.asarray(value, np.float64), objective.space.values(progress.best))
    bench, friction = dict(found["bench"]), found["friction"]
    before, after = (float(np.sqrt(loss)) for loss in (progress.method.loss[0], progress.best_loss))
    remark = _say(fitted, bench["armature"], before, after, exact)
    return Nearest(bench, friction["frictionloss"], friction["damping"], remark)


def _pose(
    fitted: Identified,
    followed: Segments,
    loss: Float[np.ndarray, "nv"],
    damping: Float[np.ndarray, "nv"],
    exact: Bool[np.ndarray, "nv"],
) -> Objective:
    """The mean square distance of MuJoCo's friction from these rollouts, from this friction on; exact joints stay."""
    bench, free = fitted.bench.restarted(fitted.values["bench"]), (~exact).tolist()
    bench.params["armature"] = replace(bench.params["armature"], identify=tuple(free))
    torque = float(np.std(fitted.samples.motor_torque)) or 1.0
    sizes = {"frictionloss": torque, "damping": torque / (float(np.std(fitted.samples.qvel)) or 1.0)}
    params = {
        name: {"init": size, "low": _SMALLEST * size, "high": _LARGEST * size, "scale": size, "identify": free}
        for name, size in sizes.items()
    }
    model = MujocoDefault(bench.nv, params)
    for name, value in (("frictionloss", loss), ("damping", damping)):
        start = np.where(exact, value, np.clip(value, 2 * _SMALLEST * sizes[name], _LARGEST * sizes[name]))
        model.get_parameter(name).data.copy_(torch.from_numpy(start))
    constrained = (~exact | (loss > 0)).tolist()
    rollout = make_rollout(make_engine("auto", bench, friction_of(model), constrained), fitted.sampling)
    return Objective(Space(bench, model, "float64"), rollout, followed, 1.0, 0.0, "none", 1.0, False)


def _say(
    fitted: Identified, armature: Float[np.ndarray, "nv"], before: float, after: float, exact: Bool[np.ndarray, "nv"]
) -> str:
    identified, units = fitted.values["bench"]["armature"], UNITS[fitted.bench.joint_type]
    unit, inertia = units["position"], units["inertia"]
    return (
        f"A frictionloss and a damping are no {_name(fitted, exact)}: they and the armature were refitted to the "
        f"fitted drive's own {fitted.over} and leave a position difference of {after:.3g} {unit} RMS ({before:.3g} "
        f"{unit} with the friction nearest to the law's torque); armature {_list(armature[~exact])} instead of "
        f"{_list(identified[~exact])} {inertia}.{_say_others(fitted.model, exact)}"
    )


def _name(fitted: Identified, exact: Bool[np.ndarray, "nv"]) -> str:
    """The laws that MuJoCo does not have, and where not all joints have such, those that do."""
    joints = np.flatnonzero(~exact).tolist()
    laws = ", ".join(dict.fromkeys(fitted.model.of_joint(joint)[0].name for joint in joints))
    return f"{laws} (of {name_some([fitted.bench.joints[joint] for joint in joints])})" if exact.any() else laws


def _say_others(model: FrictionModel, exact: Bool[np.ndarray, "nv"]) -> str:
    return f" Those of the other joints are their law's{_say_where(model)}." if exact.any() else ""


def _list(values: Float[np.ndarray, "nv"]) -> str:
    return ", ".join(f"{value:.4g}" for value in values)


def nearest_frictionloss_and_damping(
    torque: Float[np.ndarray, "samples nv"], velocity: Float[np.ndarray, "samples nv"]
) -> tuple[Float[np.ndarray, "nv"], Float[np.ndarray, "nv"]]:
    """Coulomb [N m or N] and viscous friction [N m s/rad or N s/m] nearest to a friction torque [N m or N], both >= 0.

    By non-negative least squares a joint; the torque is positive against a positive velocity [rad/s or m/s].
    """
    fits = [nnls(np.stack([np.sign(v), v], axis=1), t)[0] for t, v in zip(torque.T, velocity.T, strict=True)]
    loss, viscous = np.array(fits).T
    return loss, viscous


def evaluate_law(model: FrictionModel, samples: DriveState) -> FrictionTerms:
    """The law's terms on numpy samples of shape (samples, nv), as float64 arrays of this shape, or None."""
    double = copy.deepcopy(model).double()
    terms = double(samples.map(lambda signal: torch.as_tensor(np.asarray(signal, dtype=np.float64))))
    shape = np.shape(samples.qvel)
    return FrictionTerms(*(None if term is None else np.broadcast_to(term.detach().numpy(), shape) for term in terms))


def say_exact(model: FrictionModel) -> str:
    """In words, that a frictionloss and a damping are the law, and where."""
    return f"{model.name}: represented exactly by the frictionloss and damping below{_say_where(model)}."


def _say_where(model: FrictionModel) -> str:
    return "".join(f", at {name} {value:g} and at no other" for name, value in model.inputs.items())
