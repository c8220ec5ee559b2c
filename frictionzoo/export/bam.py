"""Target `bam`: parameter files of Rhoban's BAM for its MuJoCo controller and its mjlab actuator."""

import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import quote

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls

from frictionzoo.bench.actuators.voltage_servo import VoltageServo
from frictionzoo.bench.read_bam import DUTY, LAWS, load_parameters, read_bench
from frictionzoo.core.errors import ExportError
from frictionzoo.core.output import write_atomically
from frictionzoo.core.state import DriveState, FrictionTerms, Signals
from frictionzoo.export.base import Deviation, Export, Target, measure, read_choice, register_target
from frictionzoo.export.graph import compare
from frictionzoo.export.motor import lag
from frictionzoo.export.nearest import evaluate_law
from frictionzoo.export.simulate import simulate
from frictionzoo.models.base import sliding_torque
from frictionzoo.result.fitted_drive import FittedDrive

_LONGEST = 200  # characters of a file name
_AT_ONCE = 1e3  # faster than any command [rad/s]: otherwise BAM's STS3215 follows commands at its default speed
_INPUTS = "Supply and gain are not in the file: BAM reads them from its logs, or as vin and kp."
KT = "Only kt / R and kt^2 / R are identified: kt and R match these ratios, not a data sheet."
_VISCOUS = {"friction_viscous": "viscous_coefficient"}
_SMOOTH: Mapping[str, tuple[str, Mapping[str, str]]] = {
    "coulomb_smooth": ("m1", {"friction_base": "static_torque", **_VISCOUS}),
    "coulomb_stribeck": ("m2", {"friction_base": "kinetic_torque", **_VISCOUS, "dtheta_stribeck": "stribeck_velocity"}),
}
_NAMES = {name: (model, names) for model, (name, names) in LAWS.items()} | _SMOOTH
"""BAM's model for each friction model, and the parameter for each of BAM's parameters."""


@register_target("bam")
class Bam(Target):
    """BAM parameter file for each joint, with BAM's friction model m1 to m6, or the nearest m3 for other models.

    Source: M. Duclusaud, G. Passault, V. Padois, O. Ly, "Extended friction models for the physics simulation of servo
    actuators", 2024; github.com/Rhoban/bam.
    """

    options: ClassVar[Mapping[str, str]] = {"servo": f"its name in BAM: {', '.join(DUTY)}"}
    packages: ClassVar[tuple[str, ...]] = ("mujoco",)

    def write(self, fitted: FittedDrive, folder: Path, options: Mapping[str, str]) -> Export:
        """See `Target.write`."""
        if not isinstance(fitted.bench.actuator, VoltageServo):
            actual = f"the bench's actuator is a {type(fitted.bench.actuator).__name__}"
            raise ExportError(f"target=bam: {actual}, expected a VoltageServo; write target=mjcf")
        actuator, actuator_remarks = _choose_actuator(fitted, options)
        laws, law_remarks, lacks = to_bam(fitted)
        if fitted.values["bench"]["duty_limit"][0] != DUTY[actuator][1]:
            lacks.append(f"duty cycles end at {DUTY[actuator][1]:g}")
        files = write_parameters(fitted, folder, laws, actuator)
        limits = (*law_remarks, *actuator_remarks, KT, _INPUTS)
        return Export(files, compare_files(fitted, [folder / file for file in files], ", ".join(lacks)), limits)


def write_parameters(
    fitted: FittedDrive, folder: Path, laws: Sequence[Mapping[str, Any]], actuator: str
) -> tuple[str, ...]:
    """Write the parameter file of each joint, with BAM's parameters of its friction; return the names.

    Raises:
        ExportError: A joint's name is too long for a file's.
    """
    # A joint's name may contain "/", a file name may not.
    prefixes = [f"{quote(name, safe='')}_" for name in fitted.bench.joints] if fitted.bench.nv > 1 else [""]
    files = tuple(f"{prefix}{law['model']}.json" for prefix, law in zip(prefixes, laws, strict=True))
    if too_long := [file for file in files if len(file) > _LONGEST]:
        raise ExportError(f"{too_long[0][:40]}... as name of a file, expected shorter names of joints; rename it")
    for joint, (file, law) in enumerate(zip(files, laws, strict=True)):
        # BAM's controllers replace the robot's damping.
        viscous = law["friction_viscous"] + float(fitted.bench.own_damping[joint])
        parameters = {**_motor(fitted, joint, actuator), **law, "friction_viscous": viscous, "actuator": actuator}
        write_atomically(folder / file, (json.dumps(parameters, indent=4) + "\n").encode())
    return files


def friction_budget(parameters: Mapping[str, Any], state: DriveState) -> FrictionTerms:
    """Evaluate dry friction and damping of BAM's m1 to m6 with a file's parameters, at states in numpy arrays."""
    _, names = LAWS[parameters["model"]]
    values = defaultdict(float, {bam: parameters[bam] for bam in names})
    motor, external = state.motor_torque, state.external_torque
    quadratic_load = np.where(
        np.abs(external) < np.abs(motor),
        values["load_friction_external_quad"] * external**2,
        values["load_friction_motor_quad"] * motor**2,
    )
    load, stribeck_load = (
        values[f"load_friction_{undirected}"] * np.abs(external - motor)
        + np.abs(values[f"load_friction_external{part}"] * external - values[f"load_friction_motor{part}"] * motor)
        for undirected, part in (("base", ""), ("stribeck", "_stribeck"))
    )
    dry = values["friction_base"] + load
    if "dtheta_stribeck" in values:
        share = np.exp(-(np.abs(state.qvel / values["dtheta_stribeck"]) ** values["alpha"]))
        dry = dry + share * (
            values["friction_stribeck"] + stribeck_load + (np.sign(external) != np.sign(motor)) * quadratic_load
        )
    return FrictionTerms(frictionloss=dry, damping=np.full(np.shape(state.qvel), values["friction_viscous"]))


def holds_exactly(fitted: FittedDrive) -> bool:
    """Return whether the drive is a voltage servo with BAM's own friction in all joints, and not MuJoCo's alone."""
    names = {fitted.model.of_joint(joint)[0].name for joint in range(fitted.bench.nv)}
    exact = {name for name, _ in LAWS.values()}
    return isinstance(fitted.bench.actuator, VoltageServo) and names <= exact and names != {LAWS["m1"][0]}


def to_bam(fitted: FittedDrive) -> tuple[list[dict[str, Any]], list[str], list[str]]:
    """Return BAM's parameters of each joint, remarks, and in a few words each why BAM moves differently."""
    laws = [_rename(fitted, joint) for joint in range(fitted.bench.nv)]
    names = [fitted.model.of_joint(joint)[0].name for joint in range(fitted.bench.nv)]
    others = [joint for joint, law in enumerate(laws) if law is None]
    remarks, lacks = list[str](), ["friction uses the torques of the previous step"]
    lacks += [f"m3 cannot represent {name}" for name in dict.fromkeys(names[joint] for joint in others)]
    if any(name in _SMOOTH and law for name, law in zip(names, laws, strict=True)):
        remarks.append("BAM's joint sticks at rest; with the model's smooth sign it creeps.")
        lacks.append("it sticks at rest")
    if others:
        nearest, nearest_remarks = _nearest(fitted, others)
        laws, remarks = [law or nearest[joint] for joint, law in enumerate(laws)], [*nearest_remarks, *remarks]
    return [law for law in laws if law], remarks, lacks


def _rename(fitted: FittedDrive, joint: int) -> dict[str, Any] | None:
    """Return BAM's parameters of a joint's friction model; None if BAM has no such model."""
    law, index, prefix = fitted.model.of_joint(joint)
    values = {name: float(fitted.values["friction"][prefix + name][index]) for name in law.params}
    excess = values.get("static_torque", 0.0) - values.get("kinetic_torque", 0.0)
    if law.name not in _NAMES or excess < 0:
        return None
    model, names = _NAMES[law.name]
    renamed = {"model": model, **{bam: values[param] for bam, param in names.items()}}
    return renamed | ({"friction_stribeck": excess, "alpha": 2.0} if law.name == "coulomb_stribeck" else {})


def _nearest(fitted: FittedDrive, joints: Sequence[int]) -> tuple[dict[int, dict[str, Any]], list[str]]:
    """Fit m3 to the friction torque of these joints at the recorded states, by least squares with all terms >= 0."""
    samples = fitted.samples
    torque = sliding_torque(np, evaluate_law(fitted.model, samples), samples.qvel)
    load = np.abs(samples.external_torque - samples.motor_torque)
    laws, residuals = {}, []
    for joint in joints:
        velocity = samples.qvel[:, joint]
        columns = np.stack([np.sign(velocity), np.sign(velocity) * load[:, joint], velocity], axis=1)
        (base, share, viscous), distance = nnls(columns, torque[:, joint])
        laws[joint] = {"model": "m3", "friction_base": base, "load_friction_base": share, "friction_viscous": viscous}
        residuals.append(distance / np.sqrt(len(velocity)))
    size = np.sqrt(np.square(torque[:, joints]).mean())
    names = ", ".join(dict.fromkeys(fitted.model.of_joint(joint)[0].name for joint in joints))
    listed = ", ".join(f"{rms:.3g}" for rms in residuals)
    return laws, [
        f"BAM has no {names}: m3 was fitted to its torque at the recorded states, by least squares with "
        f"all terms >= 0; RMS residual {listed} N m of {size:.3g} N m."
    ]


def _motor(fitted: FittedDrive, joint: int, actuator: str) -> dict[str, float]:
    bench = {name: float(value[joint]) for name, value in fitted.values["bench"].items()}
    torque_constant = bench["kt2_over_r"] / bench["kt_over_r"]
    motor = {
        "kt": torque_constant,
        "R": torque_constant / bench["kt_over_r"],
        "armature": bench["armature"],
        "q_offset": bench.get("position_offset", 0.0),
        "command_delay": bench.get("delay", 0.0),
    }
    if actuator == "sts3215":
        motor |= {"error_gain_ratio": bench["duty_gain"] / DUTY[actuator][0], "max_velocity": _AT_ONCE}
    return motor


def _choose_actuator(fitted: FittedDrive, options: Mapping[str, str]) -> tuple[str, list[str]]:
    gain = float(fitted.values["bench"]["duty_gain"][0])
    nearest = min(DUTY, key=lambda name: abs(np.log(DUTY[name][0] / gain)))
    chosen, remarks = read_choice({"servo": nearest, **options}, "servo", DUTY), list[str]()
    if "servo" not in options:
        remarks.append(f"servo={chosen} was chosen by its gain; set servo to another name in BAM if wrong.")
    if chosen != "sts3215" and not np.isclose(gain, DUTY[chosen][0], rtol=1e-3):
        remarks.append(f"BAM's {chosen} has a duty cycle of {DUTY[chosen][0]:.4g} per radian and gain, not {gain:.4g}.")
    limit = float(fitted.values["bench"]["duty_limit"][0])
    if limit != DUTY[chosen][1]:
        remarks.append(f"BAM's {chosen} limits the duty cycle to {DUTY[chosen][1]:g}, not {limit:g}.")
    return chosen, remarks


def compare_files(
    fitted: FittedDrive, paths: Sequence[Path], reason: str, inputs: Mapping[str, Float[np.ndarray, "nv"]] | None = None
) -> tuple[Deviation, ...]:
    """Compare friction at the recorded states, and rollouts in MuJoCo C; `reason` explains the difference.

    With `inputs`, those of the servos are constant, delays are whole steps, and the torque is at most that at
    standstill, as in BAM's actuator for mjlab.
    """
    files = [load_parameters(path) for path in paths]
    bench = [read_bench(path, data) for path, data in zip(paths, files, strict=True)]
    stacked = {name: np.array([values[name] for values in bench]) for name in bench[0]}
    if inputs is not None:
        stacked["delay"] = np.array([lag(fitted, joint) * fitted.timestep for joint in range(fitted.bench.nv)])
    written = replace(fitted, values={"bench": stacked, "friction": fitted.values["friction"]})
    values, ones = {name: value for name, value in stacked.items() if name != "delay"}, np.ones(written.bench.nv)
    model = mujoco.MjModel.from_xml_string(written.bench.mjcf(values, ones, ones))  # each step sets the friction
    if inputs is not None:
        stall = inputs["supply"] * stacked["kt_over_r"]
        model.actuator_forcelimited[:], model.actuator_forcerange[:] = 1, np.stack([-stall, stall], axis=1)

    def step(data: mujoco.MjData, signals: Signals) -> None:
        """Do a step of BAM's MuJoCo controller: MuJoCo's friction constraint, set from the state before the step."""
        external = data.qfrc_passive + model.dof_damping * data.qvel - data.qfrc_bias
        terms = _budgets(files, DriveState(data.qpos, data.qvel, data.qpos, data.qfrc_actuator, external))
        model.dof_frictionloss[:], model.dof_damping[:] = terms.frictionloss, terms.damping
        given = signals.inputs if inputs is None else inputs
        data.ctrl[:] = written.bench.actuator.control(np, stacked, data.qpos, data.qvel, signals.ctrl, given)
        mujoco.mj_step(model, data)

    qpos = simulate(model, written, step)
    terms = _budgets(files, fitted.samples)
    return (
        compare(fitted, terms._replace(damping=terms.damping - fitted.bench.own_damping), "BAM's formula"),
        measure("qpos", fitted, qpos, fitted.rollout()[0], reason=reason),
    )


def _budgets(files: list[dict[str, Any]], state: DriveState) -> FrictionTerms:
    states = [state.map(lambda signal, joint=joint: signal[..., joint]) for joint in range(len(files))]
    terms = [friction_budget(data, joint_state) for data, joint_state in zip(files, states, strict=True)]
    loss, damping = (np.stack([getattr(term, name) for term in terms], -1) for name in ("frictionloss", "damping"))
    return FrictionTerms(frictionloss=loss, damping=damping)
