"""Bench: the MJCF around the drive, the identified joints and their actuator."""

import copy
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, ClassVar

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.bench.actuators import Actuator
from frictionzoo.bench.branches import number_branches
from frictionzoo.bench.compiled import INERTIAL, NO_PAYLOAD, combine, put_inertial
from frictionzoo.bench.delay import write_delay
from frictionzoo.bench.interval import MOST_STEPS, count_substeps, refuse_interval
from frictionzoo.bench.signals import add_inputs, pair_log, refuse_columns, say_lacking
from frictionzoo.bench.template import INTEGRATORS, Joints, Template, in_full, read_options, read_solreffriction
from frictionzoo.core.described import Described
from frictionzoo.core.errors import BenchError, ConfigError, closest, refuse_unlike
from frictionzoo.core.log import Dataset, Log, Payload
from frictionzoo.core.params import AUTO, LARGEST, Param, group_joints, read_params, read_tie, refuse_negative
from frictionzoo.core.segments import Sampling
from frictionzoo.core.state import DriveState
from frictionzoo.core.telling import escape_controls

PARAMS = {"armature": "inertia", "delay": "time", "position_offset": "position", "torque_offset": "torque"}
"""Dimension of each parameter of a bench."""
DEFAULTS: dict[str, dict[str, Any]] = {
    "armature": {"init": 0.01, "low": 1e-5, "high": 1.0, "scale": "log", "identify": True},
    "delay": {"init": 0.0, "low": 0.0, "high": 0.1, "scale": 0.01, "identify": False},
    "position_offset": {"init": 0.0, "low": -0.2, "high": 0.2, "scale": 0.1, "identify": False},
    "torque_offset": {"init": 0.0, "low": -20.0, "high": 20.0, "scale": 1.0, "identify": False},
}
"""Default parameter sections: armature of a servo joint [kg m^2], no delay [s], no offsets [rad or m, N m or N]."""
_OF_ASSEMBLY = re.compile(r"(.*\.)?(\w+_offset|(sine|cosine)_\d+)")  # offset of a sensor or cable, phase of a gear


class Bench(Described):
    """Simulated test stand of one drive.

    The MJCF is a template without friction, armature or actuator at the identified joints; `mjcf` adds these. The
    fitted and the exported MJCF therefore differ in numbers only.

    Attributes:
        armature_high: Default upper bound of the armature [kg m^2 or kg].
        joints: Names of the identified joints, in MuJoCo's order.
        joint_type: `hinge` or `slide`.
        params: The armature, the delay and offsets if any, and the actuator's parameters.
        own_damping: Damping of each joint in the template [N m s/rad or N s/m].
        payload: Index of the body that carries payloads, or None.
        notes: Features of a robot's file that the bench lacks, one line each.
        unlimited: Position limits of a robot's file that the bench lacks [rad or m], (nv, 2); NaN without a limit.
        passive: Joints that no actuator of a robot's file moves; recordings need no commands of them.
        observed: Inputs of the friction model in addition to the state, with their values for recordings without them.

    Args:
        mjcf: Path of the template, or the name of a template in the package (`knee_rod.xml`, `emps.xml`).
        joint: Names of the identified joints, or patterns as in `Robot`; None for a template with a single joint.
        actuator: Actuator law, which converts a command into torque.
        params: Sections of `armature` and of three optional parameters: `delay` of the commands [s], `position_offset`,
            added to the measured position [rad or m], and `torque_offset`, a constant torque, for example of a cable
            [N m or N]. A number is a known value. `DEFAULTS` completes the sections. An optional parameter known to be
            0 is dropped. Values, bounds and `identify` may be lists with one entry per joint, or mappings by pattern.
        solreffriction: Time constant [s] and damping ratio of MuJoCo's friction constraint. With MuJoCo's default,
            (0.02, 1), dry friction is viscous at low speed; a shorter time constant makes sticking stiffer. None is
            the default; so is `auto` until a recipe chooses the value.
        second_order: Whether rollouts are of second order in the simulation step. The parameters then describe the
            drive in continuous time; otherwise rollouts match MuJoCo at this step. In second-order rollouts dry
            friction is Coulomb friction without creep if the time constant in `solreffriction` is two steps, the least
            that MuJoCo allows. None is false; so is `auto` until a recipe chooses the value.
        integrator: `Euler` or `implicitfast`; None for the template's.
        payload: Name of the body that carries the payloads of recordings; None for recordings without payloads.
        timestep: Simulation step [s]; None for the template's, also used for `auto` until a recipe chooses the step.
        inertia: Ten parameters of bodies by name, as in `frictionzoo.bench.inertia`, which replace the template's.
        gravity: Gravity in the world frame [m/s^2], for an inclined base; None for the template's.
        tie: Joints that share the values of every parameter of motor and gear: patterns of joint names by group name,
            or true for all joints. Offsets and the phase of a ripple depend on the assembly and stay per joint. `tie`
            in a parameter's section has precedence.

    Raises:
        BenchError: The template cannot be read or compiled, or lacks these joints.
        ConfigError: An option or a parameter's section is invalid.
    """

    armature_high: ClassVar[float] = DEFAULTS["armature"]["high"]

    def __init__(
        self,
        mjcf: str,
        joint: Joints = None,
        *,
        actuator: Actuator,
        params: Mapping[str, Any] | None = None,
        solreffriction: Sequence[float] | str | None = None,
        payload: str | None = None,
        timestep: float | str | None = None,
        tie: Any = None,
        inertia: Mapping[str, Sequence[float | int]] | None = None,
        gravity: Sequence[float | int] | None = None,
        second_order: bool | str | None = None,
        integrator: str | None = None,
    ) -> None:
        refuse_unlike("bench.actuator", actuator, Actuator, "an actuator, such as PositionPD(kp=15, kd=0.5)")
        self.source = mjcf
        self.actuator = actuator
        self._start: dict[str, np.ndarray] = {}  # initial values that override `params`
        self.solreffriction: list[float] = read_solreffriction(solreffriction)
        if second_order not in (True, False, None, AUTO):
            raise ConfigError(f"bench.second_order={second_order}; expected true or false")
        self.second_order: bool = second_order is True
        self.notes: tuple[str, ...] = ()
        self.inertia: Mapping[str, Sequence[float | int]] = inertia or {}
        self.gravity: Sequence[float | int] | None = gravity
        options = read_options(timestep, gravity, integrator)
        self._template: Template = self._open(mjcf, joint).with_inertia(self.inertia).with_options(options)
        self.joints: tuple[str, ...] = self._template.joints
        self.unlimited: np.ndarray = np.full((self.nv, 2), np.nan)
        self._tie = read_tie("bench.tie", tie)
        group_joints("bench.tie", self._tie, self.joints)  # refuses patterns that match no joint
        own = read_params("bench", PARAMS, params or {}, PARAMS.keys() - {"armature"}, DEFAULTS)
        filled = self._fill({**own, **actuator.params})
        self.params: dict[str, Param] = {name: param.for_joints(self.joints) for name, param in filled.items()}
        refuse_negative("bench.params.", {name: param for name, param in self.params.items() if name in PARAMS})
        model = self.compile(constraint=False)
        self._template.refuse_unfit(model, moved="position_offset" in self.params)
        self.joint_type: str = self._template.joint_type(model)
        self.integrator: str = INTEGRATORS[mujoco.mjtIntegrator(model.opt.integrator)]
        self.timestep: float = float(model.opt.timestep)
        self.own_damping: np.ndarray = model.dof_damping.copy()
        self.passive: tuple[str, ...] = ()
        self._limited: np.ndarray = model.jnt_limited.astype(bool)
        self.payload: int | None = None if payload is None else self._template.find_body(model, payload)
        self.observed: dict[str, float] = {}
        self._loads: dict[Payload, np.ndarray] = {}  # recordings often share a payload

    def _open(self, mjcf: str, joint: Joints) -> Template:
        return Template.read(mjcf, joint)

    def _fill(self, params: Mapping[str, Param]) -> Mapping[str, Param]:
        """Return the parameters with missing values filled in; the base class has none to add."""
        return params

    def initial_friction(self, params: Mapping[str, Param]) -> dict[str, Float[np.ndarray, "nv"]]:
        """Return the bench file's initial values of a friction model's parameters, by name."""
        return {}

    @property
    def nv(self) -> int:
        """Number of identified joints."""
        return len(self.joints)

    def sampling(self, interval: float) -> Sampling:
        """Return the simulation steps per sample and the history of commands for a sample interval [s].

        Raises:
            ConfigError: The delay may exceed the longest history of commands.
        """
        longest = 0.0
        if (delay := self.params.get("delay")) is not None:
            init, high, free = (delay.each(field, self.nv) for field in ("init", "high", "identify"))
            longest = float(np.where(free, high, init).max())
        history = int(np.ceil(longest / interval - 1e-9))
        if history > MOST_STEPS:
            raise ConfigError(
                f"bench.params.delay: up to {longest:g} s, which are {history} samples, expected at most "
                f"{MOST_STEPS}; lower its init or high"
            )
        substeps = count_substeps(interval, self.timestep)
        return Sampling(interval, substeps, history, self.actuator.commands, self.second_order)

    def initial_values(self) -> dict[str, np.ndarray]:
        """Return the initial value of each parameter, of shape (nv,)."""
        return {name: np.array(param.each("init", self.nv)) for name, param in self.params.items()} | self._start

    def groups(self, param: Param) -> list[str]:
        """Return each joint's group for a parameter; the group of an untied joint is the joint's name.

        Raises:
            ConfigError: A joint belongs to two groups, or a pattern matches no joint.
        """
        if param.tie is not None:
            return group_joints(f"{param.name}.tie", param.tie, self.joints)
        return group_joints("bench.tie", None if _OF_ASSEMBLY.fullmatch(param.name) else self._tie, self.joints)

    @property
    def is_stiff(self) -> bool:
        """Whether the friction constraint is as stiff as MuJoCo allows, with a time constant of at most two steps."""
        return 0 < self.solreffriction[0] <= 2 * self.timestep * (1 + 1e-9)

    @cached_property
    def branches(self) -> tuple[int, ...]:
        """Branch number of each joint, from 0; joints of different branches do not affect each other."""
        return number_branches(self.compile(constraint=False))

    def only(self, joints: Sequence[int]) -> "Bench":
        """Return the bench with only the branches of these joints, given by index.

        Raises:
            BenchError: MuJoCo does not compile the MJCF without the other branches.
        """
        names = tuple(self.joints[joint] for joint in joints)
        return self._changed(
            _template=self._template.only(names),
            _tie=None,
            _start={name: value[list(joints)] for name, value in self._start.items()},
            joints=names,
            params={name: param.only(joints) for name, param in self.params.items()},
            own_damping=self.own_damping[list(joints)],
        )

    def with_inertia(self, inertia: Mapping[str, Sequence[float | int]]) -> "Bench":
        """Return the bench with other link inertias, in the format of the argument `inertia`."""
        merged = {**self.inertia, **{name: list(map(float, parameters)) for name, parameters in inertia.items()}}
        return self._recorded(inertia=merged)._changed(_template=self._template.with_inertia(inertia))

    def with_gravity(self, gravity: Sequence[float | int]) -> "Bench":
        """Return the bench with another gravity [m/s^2]."""
        template = self._template.with_options(read_options(gravity=gravity))
        return self._recorded(gravity=list(gravity))._changed(_template=template)

    def __repr__(self) -> str:
        values, kind = self.initial_values(), type(self.actuator).__name__
        lines = (param.line(values[name], self.joint_type) for name, param in self.params.items())
        head = f"{type(self).__name__} of {self.source}, {', '.join(self.joints)}, {kind}"
        return "\n  ".join([escape_controls(head), *lines])

    def _recorded(self, **arguments: Any) -> "Bench":
        """Return the bench with other arguments in its record, and as attributes."""
        args, kwargs = getattr(self, "_given")  # noqa: B009 - of `Described`
        return self._changed(**arguments, _given=(args, kwargs | arguments))

    def _changed(self, **attributes: Any) -> "Bench":
        other = copy.copy(self)
        vars(other).update(attributes, _loads={})
        return other

    def restarted(self, values: Mapping[str, Float[np.ndarray, "nv"]]) -> "Bench":
        """Return the bench with fitted values for a fit of another friction model; only the armature is free."""
        # A fit would change the other parameters to compensate for errors of the friction model.
        params = {name: replace(param, identify=False) for name, param in self.params.items()}
        free = np.asarray(values["armature"]) > 0  # a joint without a drive may have none
        if len(own := np.asarray(values["armature"])[free].tolist()):
            bounds = min(own) / 100, max(own) * 100, "log"
            params["armature"] = Param("armature", "inertia", own[0], *bounds, tuple(free.tolist()))
        return self.begun(values)._changed(params=params, _tie=None)

    def begun(self, values: Mapping[str, Float[np.ndarray, "nv"]]) -> "Bench":
        """Return the bench with fitted values as initial values."""
        return self._changed(_start={name: np.array(value) for name, value in values.items()})

    def observing(self, inputs: Mapping[str, float]) -> "Bench":
        """Return the bench for a friction model with these `inputs` in addition to the state.

        Raises:
            ConfigError: `DriveState` has no such signal.
        """
        recorded = tuple(DriveState._field_defaults)
        for name in inputs:
            if name not in recorded:
                raise ConfigError(f"the friction model's input {name}: unknown; {closest(name, recorded)}")
        return self._changed(observed=dict(inputs))

    @property
    def inputs(self) -> tuple[str, ...]:
        """Inputs of the actuator law and the friction model in each sample, in addition to the command."""
        return (*self.actuator.inputs, *self.observed)

    def mjcf(
        self,
        values: Mapping[str, np.ndarray],
        frictionloss: np.ndarray | None = None,
        damping: np.ndarray | None = None,
        comments: Sequence[str] = (),
        limited: bool = False,
    ) -> str:
        """Return the complete MJCF at full precision.

        Without `frictionloss` [N m or N] it has no friction constraint; `damping` [N m s/rad or N s/m] adds to the
        template's. `limited` lets MuJoCo's actuators limit the torque if they can, for the `ctrl` of
        `Actuator.combine`.
        """
        affine, joints, actuators = self.actuator.affine(values), [], []
        ends = self.actuator.force_range(values) if limited else None
        # A controller that needs the state combines delayed commands with the present state: its output has no delay.
        delayed = "delay" in values and not self.actuator.needs_state
        for index, name in enumerate(self.joints):
            joint = {"armature": in_full(values["armature"][index])}
            if "position_offset" in values:
                unit = np.pi / 180 if self.joint_type == "hinge" and not self._template.has_radians else 1.0
                joint["ref"] = in_full(-values["position_offset"][index] / unit)
            joint["solreffriction"] = in_full(self.solreffriction)
            if frictionloss is not None:
                joint["frictionloss"] = in_full(frictionloss[index])
                if not self._limited[index]:  # MuJoCo ignores it; Genesis softens dry friction with it
                    joint["solreflimit"] = joint["solreffriction"]
            if damping is not None:  # added to the template's damping, as in the simulation
                joint["damping"] = in_full(damping[index] + self.own_damping[index])
            joints.append(joint)
            gain, *bias = (coefficient[index] for coefficient in affine)
            law = {"gainprm": in_full(gain), "biastype": "affine", "biasprm": in_full(bias)}
            if ends is not None and not np.abs(ends[index]).min() > 0.1 * LARGEST:  # beyond, it is unlimited
                law |= {"forcelimited": "true", "forcerange": in_full(ends[index])}
            if delayed:
                law |= write_delay(float(values["delay"][index]), self.timestep)
            actuators.append({"name": name, "joint": name, **law})
        return self._template.write(joints, actuators, comments)

    def template(self) -> str:
        """Return the MJCF with link inertias, gravity and step, without friction, armature and actuators."""
        return self._template.write(self.nv * [{}], [])

    def compile(self, constraint: bool | Sequence[bool]) -> mujoco.MjModel:
        """Return the compiled model with initial values; `constraint` adds friction constraints to all or some joints.

        MJX fixes the rows when it reads the model: the limit is compiled as positive and set to its value later.

        Raises:
            BenchError: MuJoCo refuses the template, or an option of it is not supported.
        """
        rows = np.broadcast_to(constraint, self.nv)
        by_rollouts = ("delay", "position_offset")  # delay of the command, and the engine's reference position
        values = {name: value for name, value in self.initial_values().items() if name not in by_rollouts}
        return self._template.compile(self.mjcf(values, rows.astype(float) if rows.any() else None), bool(rows.any()))

    def accept(self, log: Log) -> Log:
        """Return the log in the order of the joints, with its load and the inputs of actuator and friction model.

        Raises:
            LogError: Column headers name only some of the joints, a joint twice, or unknown joints.
            BenchError: The log has another number of joints, an unsuitable interval, a payload without a body that
                carries it, or lacks an input of the actuator law.
        """
        log = pair_log(log, self.joints, self.passive)
        refuse_columns(log, self.joints, self.source)
        self.check_interval(log.timestep, log.name)
        log = add_inputs(log, self.actuator, self.observed, self.initial_values())
        if self.payload is None and log.payload is not None:
            raise BenchError(
                f"{log.name}: a payload of {log.payload.mass:g} kg, but bench.payload=null; name the body of "
                f"{self.source} that carries it"
            )
        return log if self.payload is None else replace(log, load=self.load(log.payload or NO_PAYLOAD))

    def accept_all(self, dataset: Dataset) -> Dataset:
        """Return the data set with each log accepted.

        All recordings must contain an input of friction model or actuator, or none may: the model then uses a constant,
        and the effect of other values is not identifiable.

        Raises:
            BenchError: A log is not accepted, or only some logs contain an input.
        """
        say_lacking(dataset, self.observed, "friction model", ", or take another model")
        say_lacking(dataset, self.actuator.optional_inputs, "actuator")
        return Dataset(dataset.name, *(tuple(map(self.accept, logs)) for logs in (dataset.train, dataset.test)))

    def load(self, payload: Payload) -> Float[np.ndarray, "load"]:
        """Return the inertia of the model with a payload; empty for a bench without a payload body.

        It consists of mass [kg], centre [m] (3), principal axes (quaternion, 4) and principal inertia [kg m^2] (3) of
        the body with its payload, and the joint-space inertia at the reference position without armature (nv * nv).
        """
        if self.payload is None:
            return np.zeros(0)
        if payload not in self._loads:
            self._loads[payload] = combine(self.compile(constraint=False), self.payload, payload)
        return self._loads[payload]

    def put_load(self, model: mujoco.MjModel, load: Float[np.ndarray, "load"]) -> None:
        """Set the inertia of the payload body in a compiled model to this `load`; an empty load changes nothing."""
        if self.payload is not None and len(load):
            put_inertial(model, self.payload, load[:INERTIAL])

    def simpler(self) -> Iterator[tuple[str, "Bench"]]:
        """Yield the bench without one attribute or element of its MJCF, with a description of the removed part.

        Some of these benches do not compile. Bodies and identified joints are never removed. Positions and sizes come
        last: without them the motion may change so much that the cause of a problem has no effect.
        """
        for part, template in self._template.simpler():
            yield part, self._changed(_template=template)

    def check_interval(self, interval: float, whose: str) -> None:
        """Refuse a sample interval [s] that is not a whole number of simulation steps; see `refuse_interval`."""
        refuse_interval(interval, self.timestep, whose, self.source)
