"""Nearest MuJoCo joint friction (frictionloss and damping) for friction models that MuJoCo does not have."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.optimize import nnls

from frictionzoo.core.errors import ExportError, RunError
from frictionzoo.core.segments import Segments
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.fit import Objective, Space
from frictionzoo.fit.blocks import divide, into_blocks
from frictionzoo.fit.chunk import search
from frictionzoo.fit.lm import LevenbergMarquardt
from frictionzoo.fit.normal_equations import trust_region
from frictionzoo.models import FrictionModel
from frictionzoo.models.base import sliding_torque
from frictionzoo.models.mujoco_default import MujocoDefault
from frictionzoo.result.evaluate import Values
from frictionzoo.result.fitted_drive import FittedDrive
from frictionzoo.result.names import name_some
from frictionzoo.simulation import friction_of, make_engine
from frictionzoo.simulation.rollout import Rollout, make_rollout

_ITERATIONS = 50  # usually a dozen suffice
_CLOSE = 1e-6  # relative tolerance of the refit of a drawn drive, which starts close to its solution
MOST_STEPS = 5e8
"""Largest number of joint steps, with all tangents, for refits of drawn drives: some minutes on two cores."""
_SMALLEST, _LARGEST = 1e-6, 1e3  # bounds of friction, as shares of the typical torque


@dataclass(frozen=True)
class Nearest:
    """A drive with MuJoCo's joint friction.

    Attributes:
        bench: Bench parameters by name: refitted armature, gains, delay and offsets.
        frictionloss: [N m or N].
        damping: [N m s/rad or N s/m], without the damping of the test stand, `bench.own_damping`.
        remark: Description of the approximation and its loss of accuracy; empty for MuJoCo's friction model.
        lacks: Reason for differences from the drive, in a few words.
    """

    bench: dict[str, Float[np.ndarray, "nv"]]
    frictionloss: Float[np.ndarray, "nv"]
    damping: Float[np.ndarray, "nv"]
    remark: str = ""
    lacks: str = ""

    @classmethod
    def frictionless(cls, fitted: FittedDrive) -> "Nearest":
        """Return the drive without friction, which its file adds in another way."""
        return cls(dict(fitted.values["bench"]), np.zeros(fitted.bench.nv), np.zeros(fitted.bench.nv))


def find_nearest(fitted: FittedDrive) -> Nearest:
    """Return the drive with MuJoCo's friction, refitted in joints with another friction model.

    Armature, frictionloss and damping are fitted together to the drive's long rollouts, starting from the least-squares
    friction over the measured states. If the rollouts diverge, the initial values are the result, and the remark says
    so.
    """
    model, bench, samples = fitted.model, dict(fitted.values["bench"]), _forget_inputs(fitted)
    velocity, terms = samples.qvel, evaluate_law(model, samples)
    exact, loss, viscous = _find_exact(terms, velocity)
    if exact.all():
        return _take_exact(model, bench, loss[0], viscous[0])
    torque = sliding_torque(np, terms, velocity)
    dry, damping = nearest_frictionloss_and_damping(torque, velocity)
    start = Nearest(bench, np.where(exact, loss[0], dry), np.where(exact, viscous[0], damping))
    try:
        rollouts = fitted.follow(fitted.segments)
    except RunError:
        constant = FrictionTerms(frictionloss=start.frictionloss, damping=start.damping)
        residual = torque - sliding_torque(np, constant, velocity)
        rms, unit = _list(np.sqrt(np.square(residual).mean(axis=0))), fitted.units["torque"]
        what = (
            f", and the fitted drive diverges in its own {fitted.over}, so they could not be refitted to these: "
            f"they fit the model's torque at the measured states, with a difference of {rms} {unit} RMS"
        )
        remark, lacks = _describe(fitted, exact, what)
        return replace(start, remark=remark, lacks=lacks)
    return _refit(fitted, rollouts, start, exact)


def find_nearest_each(fitted: FittedDrive, draws: Sequence[Values]) -> list[Nearest]:
    """Return drawn drives, which differ from the fitted one only in values, with MuJoCo's friction.

    In joints with another friction model, armature, frictionloss and damping are refitted to the rollouts of each drawn
    drive, with the fitted gains, delay and offset; the result has the drawn ones.

    Raises:
        ExportError: A drive diverges, or the refits take too long.
    """
    model, samples = fitted.model, _forget_inputs(fitted)
    exact, *_ = _find_exact(evaluate_law(model, samples), samples.qvel)
    instant = samples.map(lambda signal: signal[:1])
    drives = []
    for values in draws:
        _, loss, viscous = _find_exact(evaluate_law(model, instant, values), instant.qvel)
        drives.append(_take_exact(model, dict(values["bench"]), loss[0], viscous[0]))
    return drives if exact.all() else _refit_each(fitted, drives, draws, exact)


def _forget_inputs(fitted: FittedDrive) -> DriveState:
    """Return the measured states with constant further inputs, such as temperature, since MuJoCo has none."""
    samples = fitted.samples
    return samples._replace(**{n: np.full(samples.qvel.shape, value) for n, value in fitted.model.inputs.items()})


def _find_exact(
    terms: FrictionTerms, velocity: Float[np.ndarray, "samples nv"]
) -> tuple[Bool[np.ndarray, "nv"], Float[np.ndarray, "samples nv"], Float[np.ndarray, "samples nv"]]:
    """Find the joints whose friction model is a constant frictionloss and damping; also return both at each state."""
    explicit, loss, viscous = (np.zeros(velocity.shape) if term is None else term for term in terms)
    exact = (explicit == 0).all(axis=0) & (loss == loss[0]).all(axis=0) & (viscous == viscous[0]).all(axis=0)
    return exact, loss, viscous


def _refit_each(
    fitted: FittedDrive, start: Sequence[Nearest], draws: Sequence[Values], exact: Bool[np.ndarray, "nv"]
) -> list[Nearest]:
    _refuse_long(fitted, len(draws), exact)
    centre, drives = find_nearest(fitted), list[Nearest]()
    with jax.enable_x64(True):
        nominal, rollout = _pose(fitted, _follow(fitted), centre, exact)
        template = nominal.starting(_descend(nominal)[0])
        for initial, values in zip(start, draws, strict=True):
            rollouts = _follow(fitted, _mix(fitted, values, exact))
            objective = copy.copy(template)
            objective.data = into_blocks(rollouts, divide(rollouts), template.space.start.dtype, rollout)
            vector, rms = _descend(objective)
            armature, loss, damping = _read(objective, vector)
            pairs = ((initial.bench["armature"], armature), (initial.frictionloss, loss), (initial.damping, damping))
            armature, loss, damping = (np.where(exact, drawn, refitted) for drawn, refitted in pairs)
            texts = _describe(fitted, exact, _say_refit(fitted, "drawn", rms))
            drives.append(Nearest({**initial.bench, "armature": armature}, loss, damping, *texts))
    return drives


def _follow(fitted: FittedDrive, values: Values | None = None) -> Segments:
    try:
        return fitted.follow(fitted.segments, values)
    except RunError as error:
        raise ExportError(
            f"{fitted.place}: a drive with its draws diverges in its own {fitted.over}, expected none to; narrow the "
            "ranges, or fit another law"
        ) from error


def _read(objective: Objective, vector: Float[np.ndarray, "coordinates"]) -> tuple[Float[np.ndarray, "nv"], ...]:
    """Return armature, frictionloss and damping of a coordinate vector."""
    values = objective.space.values(jnp.asarray(vector))
    both = {**values["bench"], **values["friction"]}
    return tuple(np.array(both[name], np.float64) for name in ("armature", "frictionloss", "damping"))


def _refuse_long(fitted: FittedDrive, count: int, exact: Bool[np.ndarray, "nv"]) -> None:
    segments, nv = fitted.segments, fitted.bench.nv
    steps = segments.count * segments.length * fitted.sampling.substeps * nv * (1 + 3 * int((~exact).sum()))
    if count * steps > MOST_STEPS:
        fewer = int(MOST_STEPS / steps)
        advice = f"draw at most {fewer}, or " if fewer else ""
        raise ExportError(
            f"{_name(fitted, exact)}: MuJoCo's joints have no such friction, and {count} refits of {nv} joints over "
            f"{fitted.over} take too long; {advice}take a law that they have: python -m frictionzoo.distill RUN "
            "model=mujoco_default"
        )


def _mix(fitted: FittedDrive, values: Values, exact: Bool[np.ndarray, "nv"]) -> Values:
    """Return the fitted values with armature and friction of a drawn drive in the joints that are not exact."""
    armature = np.where(exact, fitted.values["bench"]["armature"], values["bench"]["armature"])
    friction = dict(fitted.values["friction"])
    for name, param in fitted.model.params.items():
        friction[name] = np.where(exact[param.members(len(exact))], friction[name], values["friction"][name])
    return {"bench": {**fitted.values["bench"], "armature": armature}, "friction": friction}


def _descend(objective: Objective) -> tuple[Float[np.ndarray, "coordinates"], float]:
    """Minimise the objective from its initial vector; return the solution and the root mean square distance."""
    vector, loss, _ = trust_region(objective.compile_normal_equations(), objective.space.box, _ITERATIONS, _CLOSE)
    return vector, float(np.sqrt(loss))


def _refit(fitted: FittedDrive, followed: Segments, start: Nearest, exact: Bool[np.ndarray, "nv"]) -> Nearest:
    with jax.enable_x64(True):
        objective, _ = _pose(fitted, followed, start, exact)
        progress, _ = search(LevenbergMarquardt(_ITERATIONS, 1e-8), objective)
        armature, loss, damping = _read(objective, np.asarray(progress.best))
    before, after = (float(np.sqrt(loss)) for loss in (progress.method.loss[0], progress.best_loss))
    identified, units = fitted.values["bench"]["armature"], fitted.units
    details = (
        f" ({before:.3g} {units['position']} for the nearest friction torque); armature "
        f"{_list(armature[~exact])} instead of {_list(identified[~exact])} {units['inertia']}"
    )
    texts = _describe(fitted, exact, _say_refit(fitted, "fitted", after) + details)
    return Nearest({**start.bench, "armature": armature}, loss, damping, *texts)


def _pose(
    fitted: FittedDrive, followed: Segments, start: Nearest, exact: Bool[np.ndarray, "nv"]
) -> tuple[Objective, Rollout]:
    """Pose the fit of MuJoCo's friction to rollouts by the mean square position difference; exact joints are fixed."""
    bench, free = fitted.bench.restarted(fitted.values["bench"]), (~exact).tolist()
    bench.params["armature"] = replace(bench.params["armature"], identify=tuple(free))
    torque = float(np.std(fitted.samples.motor_torque)) or 1.0
    sizes = {"frictionloss": torque, "damping": torque / (float(np.std(fitted.samples.qvel)) or 1.0)}
    params = {
        name: {"init": size, "low": _SMALLEST * size, "high": _LARGEST * size, "scale": size, "identify": free}
        for name, size in sizes.items()
    }
    model = MujocoDefault(bench.nv, params)
    for name, value in (("frictionloss", start.frictionloss), ("damping", start.damping)):
        initial = np.where(exact, value, np.clip(value, 2 * _SMALLEST * sizes[name], _LARGEST * sizes[name]))
        model.get_parameter(name).data.copy_(torch.from_numpy(initial))
    constrained = (~exact | (start.frictionloss > 0)).tolist()
    rollout = make_rollout(make_engine("auto", bench, friction_of(model), constrained), fitted.sampling)
    return Objective(Space(bench, model, "float64"), rollout, followed, 1.0, 0.0, "none", 1.0, False), rollout


def _say_refit(fitted: FittedDrive, whose: str, rms: float) -> str:
    return (
        f": they were refitted, with the armature, to the {whose} drive's own {fitted.over}; remaining position "
        f"difference {rms:.3g} {fitted.units['position']} RMS"
    )


def _describe(fitted: FittedDrive, exact: Bool[np.ndarray, "nv"], what: str) -> tuple[str, str]:
    """Return `remark` and `lacks` of a `Nearest`; `what` continues the remark."""
    name = _name(fitted, exact)
    others = f" The other joints have the values of their model{_say_where(fitted.model)}." if exact.any() else ""
    cannot = f"cannot represent {name}"
    return f"Frictionloss and damping {cannot}{what}.{others}", f"frictionloss and damping {cannot}"


def _take_exact(
    model: FrictionModel, bench: dict[str, Float[np.ndarray, "nv"]], loss: np.ndarray, damping: np.ndarray
) -> Nearest:
    """Return a drive whose friction model is MuJoCo's, for constant values of its further inputs."""
    if not model.inputs:
        return Nearest(bench, loss, damping)
    return Nearest(bench, loss, damping, say_law(model), f"friction of one {', '.join(model.inputs)}")


def _name(fitted: FittedDrive, exact: Bool[np.ndarray, "nv"]) -> str:
    """Name the friction models that MuJoCo does not have, and their joints unless all joints have one."""
    joints = np.flatnonzero(~exact).tolist()
    laws = ", ".join(dict.fromkeys(fitted.model.of_joint(joint)[0].name for joint in joints))
    return f"{laws} (of {name_some([fitted.bench.joints[joint] for joint in joints])})" if exact.any() else laws


def _list(values: Float[np.ndarray, "nv"]) -> str:
    return ", ".join(f"{value:.4g}" for value in values)


def nearest_frictionloss_and_damping(
    torque: Float[np.ndarray, "samples nv"], velocity: Float[np.ndarray, "samples nv"]
) -> tuple[Float[np.ndarray, "nv"], Float[np.ndarray, "nv"]]:
    """Fit Coulomb [N m or N] and viscous friction [N m s/rad or N s/m], both >= 0, to a friction torque [N m or N].

    Non-negative least squares for each joint; a torque against a positive velocity [rad/s or m/s] is positive.
    """
    fits = [nnls(np.stack([np.sign(v), v], axis=1), t)[0] for t, v in zip(torque.T, velocity.T, strict=True)]
    loss, viscous = np.array(fits).T
    return loss, viscous


def evaluate_law(model: FrictionModel, samples: DriveState, values: Values | None = None) -> FrictionTerms:
    """Evaluate a model, with `values` if given, on numpy samples (samples, nv); terms are float64 or None."""
    double = copy.deepcopy(model).double()
    if values is not None:
        double.load_state_dict({name: torch.as_tensor(value) for name, value in values["friction"].items()})
    terms = double(samples.map(lambda signal: torch.as_tensor(np.asarray(signal, dtype=np.float64))))
    shape = np.shape(samples.qvel)
    return FrictionTerms(*(None if term is None else np.broadcast_to(term.detach().numpy(), shape) for term in terms))


def say_law(model: FrictionModel) -> str:
    """State that frictionloss and damping are the friction model, and for which inputs."""
    return f"{model.name}: its friction is the frictionloss and damping below{_say_where(model)}."


def _say_where(model: FrictionModel) -> str:
    return "".join(f", at {name} {value:g} and at no other" for name, value in model.inputs.items())
