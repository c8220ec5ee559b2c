"""A bench: the MJCF around the drive, the joints that are identified, and the actuator that drives them."""

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
from frictionzoo.bench.sections import put_options
from frictionzoo.bench.signals import pair_log, pick_inputs, pick_observed, say_lacking
from frictionzoo.bench.template import INTEGRATORS, Template, in_full
from frictionzoo.core.build import build
from frictionzoo.core.described import Described, describe
from frictionzoo.core.errors import BenchError, ConfigError, closest, refuse_unlike
from frictionzoo.core.log import Dataset, Log, Payload
from frictionzoo.core.params import AUTO, LARGEST, Param, group_joints, read_params, read_tie, refuse_negative
from frictionzoo.core.segments import Sampling
from frictionzoo.core.state import DriveState

_TIMESTEP_TOLERANCE = 0.01  # share by which the log's interval may differ from a whole number of simulation steps
_ENDLESS = 0.1 * LARGEST  # N m or N, beyond which both ends of a torque stand for none
_MOST_SUBSTEPS = 10_000  # simulation steps from sample to sample
_MOST_HISTORY = 10_000  # samples by which commands may act late
DEFAULT_SOLREFFRICTION = (0.02, 1.0)
"""MuJoCo's own: the time constant [s] and the damping ratio of the friction constraint."""
_PARAMS = {"armature": "inertia", "delay": "time", "position_offset": "position", "torque_offset": "torque"}
_IN_ROLLOUTS = ("delay", "position_offset")  # which a compiled model leaves to them
_OPTIONAL = (*_IN_ROLLOUTS, "torque_offset")
_OF_ASSEMBLY = re.compile(r"(.*\.)?(\w+_offset|(sine|cosine)_\d+)")  # a sensor's or a cable's offset, a gear's phase
DEFAULTS: dict[str, dict[str, Any]] = {
    "armature": {"init": 0.01, "low": 1e-5, "high": 1.0, "scale": "log", "identify": True},
    "delay": {"init": 0.0, "low": 0.0, "high": 0.1, "scale": 0.01, "identify": False},
    "position_offset": {"init": 0.0, "low": -0.2, "high": 0.2, "scale": 0.1, "identify": False},
    "torque_offset": {"init": 0.0, "low": -20.0, "high": 20.0, "scale": 1.0, "identify": False},
}
"""What a bench's parameter is where nothing else is said: the armature of a servo's joint [kg m^2], no delay [s], an
encoder whose zero is right [rad or m], and no constant torque [N m or N]."""
_HEAVIER = 100.0  # times a fitted armature, or a part of it, within which it may move where a bench starts again


class Bench(Described):
    """The simulated test stand of one drive.

    The MJCF is a template without friction, armature or actuator at the identified joints; `mjcf` writes these in. The
    model that is fitted and the model that is exported are therefore one text with different numbers.

    Attributes:
        armature_high: Upper bound of the armature where none is stated [kg m^2 or kg].
        joints: Names of the identified joints, in MuJoCo's order.
        joint_type: `hinge` or `slide`.
        params: The armature, the delay and the offsets where there are any, and the actuator's parameters.
        timestep: Simulation step [s].
        solreffriction: As the argument, without `auto`.
        second_order: Likewise.
        integrator: Name of MuJoCo's.
        own_damping: The template's own damping of each joint [N m s/rad or N s/m].
        payload: Index of the body that carries payloads, or None.
        inertia: Ten parameters of each body whose inertia is not the template's, by name.
        gravity: Where it is not the template's [m/s^2]; None where it is.
        notes: What a robot's file has and the bench has not, a line each.
        unlimited: Limits of the joints' positions that a robot's file has and the bench has not [rad or m], of shape
            (nv, 2); NaN where there are none.
        observed: What the friction law looks at besides the state, a name among `Log.extras` each, and what it is where
            recordings lack it; see `observing`.

    Args:
        mjcf: Path of the template, or the name of one that the package ships (`knee_rod.xml`, `emps.xml`).
        joint: Name or names of the identified joints; None where the template has one joint only.
        actuator: The law that turns a command into torque.
        params: Sections of `armature`, and where wanted of `delay`, by which commands act late [s], of
            `position_offset`, which the measured position lacks [rad or m], and of `torque_offset`, a constant torque
            besides the actuator's, of a cable or of a link that is heavier than the model's [N m or N]; a number stands
            for a known value. What a section does not say is that of `DEFAULTS`. Known to be 0, these three are left
            out. Values, bounds and whether they are identified may be lists, one entry a joint, or go by patterns of
            joints' names.
        solreffriction: Time constant [s] and damping ratio of MuJoCo's friction constraint. MuJoCo's default is
            (0.02, 1), with which dry friction is viscous at low speed; a shorter time constant makes sticking stiffer.
            None is the default, `auto` likewise until a recipe has chosen.
        second_order: Whether rollouts are of second order in the simulation step, so that the parameters are those of
            the drive in continuous time; else they move as MuJoCo does in steps of this length. Dry friction is then
            Coulomb's, which holds without creep, where `solreffriction` is as stiff as MuJoCo's steps allow, two of
            them. None is false, `auto` likewise until a recipe has chosen.
        integrator: `Euler` or `implicitfast`; None for the template's.
        payload: Name of the body that carries the payloads of recordings; None for recordings without.
        timestep: Simulation step [s]; None for the template's, `auto` likewise until a recipe has found one.
        inertia: Ten parameters of bodies by name, as `frictionzoo.bench.inertia` has them, in place of those of the
            template: what `fit=inverse_dynamics` found with `fit.links`, or another's identification.
        gravity: In the frame of the world [m/s^2], of a base that stands askew; None for the template's.
        tie: Joints that share the values of every parameter that belongs to the motor and gear: pattern of their names
            by the group's name, or true for all. Offsets (`position_offset`, `torque_offset`, `force_offset`) and the
            phase of a ripple depend on how each joint was assembled and stay per joint. A parameter's own `tie` comes
            first.

    Raises:
        BenchError: The template cannot be read or compiled, or does not have these joints.
        ConfigError: A parameter's section makes no sense.
    """

    armature_high: ClassVar[float] = DEFAULTS["armature"]["high"]

    def __init__(
        self,
        mjcf: str,
        joint: str | int | Sequence[str | int] | None = None,
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
        self._start: dict[str, np.ndarray] = {}  # initial values that are not those of `params`
        if isinstance(solreffriction, str) and solreffriction != AUTO:
            raise ConfigError(f"bench.solreffriction={solreffriction}; expected two numbers")
        solreffriction = DEFAULT_SOLREFFRICTION if solreffriction in (None, AUTO) else solreffriction
        low, high = (min(solreffriction, default=0.0), max(solreffriction, default=0.0))
        if len(solreffriction) != 2 or not (low > 0 or high < 0):
            raise ConfigError(
                f"bench.solreffriction={list(solreffriction)}; expected two numbers above 0, time constant in s and "
                "damping ratio, or two below 0, as MuJoCo reads them"
            )
        if second_order not in (True, False, None, AUTO):
            raise ConfigError(f"bench.second_order={second_order}; expected true or false")
        self.second_order: bool = second_order is True
        self.solreffriction: list[float] = [float(number) for number in solreffriction]
        self.notes: tuple[str, ...] = ()
        self.inertia: Mapping[str, Sequence[float | int]] = inertia or {}
        self.gravity: Sequence[float | int] | None = gravity
        step = None if timestep is None or timestep == AUTO else float(timestep)
        self._template = self._open(mjcf, joint, step).with_inertia(self.inertia).with_gravity(gravity)
        self._template = self._template.with_integrator(integrator)
        self.joints: tuple[str, ...] = self._template.joints
        self.unlimited: np.ndarray = np.full((self.nv, 2), np.nan)
        self._tie = read_tie("bench.tie", tie)
        group_joints("bench.tie", self._tie, self.joints)  # refuses what fits no joint
        given = self._fill({**read_params("bench", _PARAMS, params or {}, _OPTIONAL, DEFAULTS), **actuator.params})
        self.params: dict[str, Param] = {name: param.for_joints(self.joints) for name, param in given.items()}
        refuse_negative("bench.params.", {name: param for name, param in self.params.items() if name in _PARAMS})
        model = self.compile(constraint=False)
        self._template.refuse_unfit(model, moved="position_offset" in self.params)
        self.joint_type: str = self._template.joint_type(model)
        self.integrator: str = INTEGRATORS[mujoco.mjtIntegrator(model.opt.integrator)]
        self.timestep: float = float(model.opt.timestep)
        self.own_damping: np.ndarray = model.dof_damping.copy()
        self._limited: np.ndarray = model.jnt_limited.astype(bool)
        self.payload: int | None = None if payload is None else self._template.find_body(model, payload)
        self.observed: dict[str, float] = {}
        self._loads: dict[Payload, np.ndarray] = {}  # many recordings have the same

    def _open(self, mjcf: str, joint: str | int | Sequence[str | int] | None, timestep: float | None) -> Template:
        return Template(mjcf, joint, timestep)

    def _fill(self, params: Mapping[str, Param]) -> Mapping[str, Param]:
        """What a bench knows of parameters without a value; a test stand knows nothing."""
        return params

    def initial_friction(self, params: Mapping[str, Param]) -> dict[str, Float[np.ndarray, "nv"]]:
        """Where the fit of a law of these parameters begins, by name, of those that the bench's file speaks of."""
        return {}

    @property
    def nv(self) -> int:
        """Number of identified joints."""
        return len(self.joints)

    def sampling(self, interval: float) -> Sampling:
        """How samples of this interval [s] relate to simulation steps and to late commands.

        Raises:
            ConfigError: A command may act so late that it is none of this drive.
        """
        latest = 0.0
        if (delay := self.params.get("delay")) is not None:
            init, high, free = (delay.each(what, self.nv) for what in ("init", "high", "identify"))
            latest = float(np.where(free, high, init).max())
        history = int(np.ceil(latest / interval - 1e-9))
        if history > _MOST_HISTORY:
            raise ConfigError(
                f"bench.params.delay: up to {latest:g} s, which are {history} samples, expected at most "
                f"{_MOST_HISTORY}; lower its init or high"
            )
        return Sampling(interval, self._substeps(interval), history, self.actuator.commands, self.second_order)

    def initial_values(self) -> dict[str, np.ndarray]:
        """Initial value of each parameter, of shape (nv,)."""
        return {name: np.array(param.each("init", self.nv)) for name, param in self.params.items()} | self._start

    def groups(self, param: Param) -> list[str]:
        """Return each joint's group for a parameter; a joint that shares its value with none has its own name.

        Raises:
            ConfigError: A joint belongs to two groups, or a pattern fits none.
        """
        if param.tie is not None:
            return group_joints(f"{param.name}.tie", param.tie, self.joints)
        return group_joints("bench.tie", None if _OF_ASSEMBLY.fullmatch(param.name) else self._tie, self.joints)

    @property
    def is_stiff(self) -> bool:
        """Whether dry friction creeps no more than MuJoCo's steps ask for, which take no time constant below two."""
        return 0 < self.solreffriction[0] <= 2 * self.timestep * (1 + 1e-9)

    @cached_property
    def branches(self) -> tuple[int, ...]:
        """Number of the branch of each joint, from 0: joints of different ones do not move each other."""
        return number_branches(self.compile(constraint=False))

    def only(self, joints: Sequence[int]) -> "Bench":
        """The branches of the joints of these indices alone.

        Raises:
            BenchError: Without the others, MuJoCo does not compile the MJCF.
        """
        other = copy.copy(self)
        other.joints = tuple(self.joints[joint] for joint in joints)
        other._template, other._loads, other._tie = self._template.only(other.joints), {}, None
        other.params = {name: param.only(joints) for name, param in self.params.items()}
        other._start = {name: value[list(joints)] for name, value in self._start.items()}
        other.own_damping = self.own_damping[list(joints)]
        return other

    def with_inertia(self, inertia: Mapping[str, Sequence[float | int]]) -> "Bench":
        """The same test stand with other link inertias, by the names of bodies, as the argument `inertia` has them."""
        other = copy.copy(self)
        other._template, other._loads = self._template.with_inertia(inertia), {}
        other.inertia = {**self.inertia, **{name: list(map(float, own)) for name, own in inertia.items()}}
        return other._telling(inertia=other.inertia)

    def with_gravity(self, gravity: Sequence[float | int]) -> "Bench":
        """The same test stand with another gravity, as the argument has it."""
        other = copy.copy(self)
        other._template, other.gravity, other._loads = self._template.with_gravity(gravity), list(gravity), {}
        return other._telling(gravity=other.gravity)

    def _telling(self, **given: Any) -> "Bench":
        args, kwargs = getattr(self, "_given")  # noqa: B009 - of `Described`, so that a record tells it
        object.__setattr__(self, "_given", (args, kwargs | given))
        return self

    def with_options(self, options: Mapping[str, Any]) -> "Bench":
        """Return the same test stand with other options.

        Args:
            options: By name, as the command line has them after `bench.`: `{"actuator.params.kp.init": 15.0}`.

        Raises:
            FrictionzooError: There is no such option, or it cannot have this value.
        """
        return build(put_options(describe(self), options))

    def restarted(self, values: Mapping[str, Float[np.ndarray, "nv"]]) -> "Bench":
        """The same test stand for another law in place of one that was fitted: the armature alone is free.

        What else was identified stays: another law's rollouts would move it to make up for what the law cannot.
        """
        armature = np.asarray(values["armature"])
        low, high = float(armature.min()) / _HEAVIER, float(armature.max()) * _HEAVIER
        free = Param("armature", "inertia", float(armature[0]), low, high, scale="log", identify=True)
        other = copy.copy(self)
        other.params = {name: replace(param, identify=False) for name, param in self.params.items()} | {
            "armature": free
        }
        other._tie = None
        other._start = {name: np.array(value) for name, value in values.items()}
        return other

    def observing(self, inputs: Mapping[str, float]) -> "Bench":
        """The same test stand, for a friction law with these `inputs`: it looks at more of a recording than the state.

        Raises:
            ConfigError: `DriveState` has no such signal.
        """
        recorded = tuple(DriveState._field_defaults)
        for name in inputs:
            if name not in recorded:
                raise ConfigError(f"the friction model's input {name}: unknown; {closest(name, recorded)}")
        other = copy.copy(self)
        other.observed = dict(inputs)
        return other

    @property
    def inputs(self) -> tuple[str, ...]:
        """What both laws need in each sample besides the command."""
        return (*self.actuator.inputs, *self.observed)

    def mjcf(
        self,
        values: Mapping[str, np.ndarray],
        frictionloss: np.ndarray | None = None,
        damping: np.ndarray | None = None,
        comments: Sequence[str] = (),
        limited: bool = False,
    ) -> str:
        """The complete MJCF with these values, every number at full precision.

        Args:
            values: Value of each of `params`, of shape (nv,).
            frictionloss: Dry-friction limit of each joint [N m or N], of shape (nv,); None for no friction constraint.
            damping: Damping of each joint [N m s/rad or N s/m], of shape (nv,).
            comments: Lines for the top of the file.
            limited: Whether MuJoCo's actuators cut the torque themselves, where they can, for a `ctrl` that is what
                `Actuator.combine` gives.
        """
        affine = self.actuator.affine(values)
        joints, actuators = [], []
        for index, name in enumerate(self.joints):
            joint = {"armature": in_full(values["armature"][index])}
            if "position_offset" in values:
                unit = np.pi / 180 if self.joint_type == "hinge" and not self._template.has_radians else 1.0
                joint["ref"] = in_full(-values["position_offset"][index] / unit)
            joint["solreffriction"] = " ".join(map(in_full, self.solreffriction))
            if frictionloss is not None:
                joint["frictionloss"] = in_full(frictionloss[index])
                if not self._limited[index]:  # nothing to MuJoCo; Genesis softens dry friction by it
                    joint["solreflimit"] = joint["solreffriction"]
            if damping is not None:  # on top of the template's own, as in the simulation
                joint["damping"] = in_full(damping[index] + self.own_damping[index])
            joints.append(joint)
            gain, *bias = (in_full(coefficient[index]) for coefficient in affine)
            law = {"gainprm": gain, "biastype": "affine", "biasprm": " ".join(bias)}
            law |= self._limited_actuator(values, index) if limited else {}
            actuators.append({"name": name, "joint": name, **law, **self._delayed(values, index)})
        return self._template.write(joints, actuators, comments)

    def template(self) -> str:
        """The MJCF without friction, armature and actuator of the joints, with link inertias, gravity and step."""
        return self._template.write(self.nv * [{}], [])

    def compile(self, constraint: bool | Sequence[bool]) -> mujoco.MjModel:
        """The compiled model with initial values.

        Args:
            constraint: Whether the joints get a row of MuJoCo's friction constraint, or which of them do. MJX fixes the
                rows when it takes the model over, so the limit is compiled as positive and set to its value later.

        Raises:
            BenchError: MuJoCo refuses the template, or an option of it is not supported.
        """
        rows = np.broadcast_to(constraint, self.nv)
        # Rollouts delay the command themselves, and the engine sets the reference position.
        values = {name: value for name, value in self.initial_values().items() if name not in _IN_ROLLOUTS}
        return self._template.compile(self.mjcf(values, rows.astype(float) if rows.any() else None), bool(rows.any()))

    def accept(self, log: Log) -> Log:
        """The same log with its columns in the order of the joints, what its payload changes, and what both laws need.

        Raises:
            LogError: Headers of its columns name some of the joints and not all, one twice, or others.
            BenchError: This bench cannot have produced it: it has another number of joints or actuators, another time
                step, a payload that no body carries, lacks an input of the actuator law, or has one of a wrong shape.
        """
        log = pair_log(log, self.joints)
        self._check_log(log)
        inputs, observed = pick_inputs(log, self.actuator, self.nv), pick_observed(log, self.observed, self.nv)
        log = replace(log, inputs=inputs, observed=observed)
        if self.payload is None and log.payload is not None:
            raise BenchError(
                f"{log.name}: a payload of {log.payload.mass:g} kg, but bench.payload=null; name the body of "
                f"{self.source} that carries it"
            )
        return log if self.payload is None else replace(log, load=self.load(log.payload or NO_PAYLOAD))

    def accept_all(self, dataset: Dataset) -> Dataset:
        """The same data set with each log accepted.

        What the friction law looks at has to be in all of its recordings or in none. In none, the law acts as at the
        value of `observed`, and what it says of other values is not identifiable. So it is with what the actuator law
        can do without.

        Raises:
            BenchError: A log is not accepted, or some have what a law looks at and others do not.
        """
        say_lacking(dataset, self.observed, "friction model", ", or take another model")
        say_lacking(dataset, self.actuator.optional_inputs, "actuator")
        train, test = (tuple(map(self.accept, logs)) for logs in (dataset.train, dataset.test))
        return Dataset(dataset.name, train, test)

    def load(self, payload: Payload) -> Float[np.ndarray, "load"]:
        """What a payload changes in the model; empty for a bench that carries none.

        Returns:
            Of the body together with its payload: mass [kg], centre of mass [m] (3), orientation of the principal axes
            (quaternion, 4), principal inertia [kg m^2] (3); then the joint-space inertia at the reference position
            without armature (nv * nv).
        """
        if self.payload is None:
            return np.zeros(0)
        if payload not in self._loads:
            self._loads[payload] = combine(self.compile(constraint=False), self.payload, payload)
        return self._loads[payload]

    def put_load(self, model: mujoco.MjModel, load: Float[np.ndarray, "load"]) -> None:
        """Let the body that carries payloads be what this `load` makes of it; where that is empty, as it is."""
        if self.payload is not None and len(load):
            put_inertial(model, self.payload, load[:INERTIAL])

    def simpler(self) -> Iterator[tuple[str, "Bench"]]:
        """What the MJCF could lack, one attribute or element at a time, in words, and the same test stand without it.

        Not each of them compiles. Bodies and the identified joints stay. Where things are, and how large, comes last:
        without it the test stand may move so differently that what is at fault does not act.
        """
        for what, template in self._template.simpler():
            other = copy.copy(self)
            other._template, other._loads = template, {}
            yield what, other

    def _check_log(self, log: Log) -> None:
        for signal in ("qpos", "ctrl"):
            columns = getattr(log, signal).shape[1]
            if columns != self.nv:
                raise BenchError(
                    f"{log.name}: {signal} has {columns} columns, expected {self.nv} for the joints "
                    f"{', '.join(self.joints)} of {self.source}; choose other columns or another bench.joint"
                )
        self.check_interval(log.timestep, log.name)

    def check_interval(self, interval: float, whose: str) -> None:
        """Refuse samples that are no whole number of simulation steps apart.

        Raises:
            BenchError: They are not, or too many steps.
        """
        if self._substeps(interval) > _MOST_SUBSTEPS:
            raise BenchError(
                f"{whose}: {interval:.6g} s per sample are {self._substeps(interval)} simulation steps of "
                f"{self.timestep:.6g} s, expected at most {_MOST_SUBSTEPS}; set a longer bench.timestep"
            )
        if not self.fits(interval):
            raise BenchError(
                f"{whose}: {interval:.6g} s per sample, expected {self.timestep:.6g} s as in {self.source}, or "
                "a whole number of them; set bench.timestep to the log's interval or a part of it, or resample the log"
            )

    def fits(self, interval: float) -> bool:
        """Whether a whole number of simulation steps lasts an interval [s]."""
        return abs(interval / (self._substeps(interval) * self.timestep) - 1) <= _TIMESTEP_TOLERANCE

    def _substeps(self, interval: float) -> int:
        return max(1, round(interval / self.timestep))

    def _limited_actuator(self, values: Mapping[str, np.ndarray], index: int) -> dict[str, str]:
        """Attributes of MuJoCo's actuator that cut its torque."""
        ends = self.actuator.force_range(values)
        if ends is None or np.abs(ends[index]).min() > _ENDLESS:
            return {}
        return {"forcelimited": "true", "forcerange": " ".join(map(in_full, ends[index]))}

    def _delayed(self, values: Mapping[str, np.ndarray], index: int) -> dict[str, str]:
        """Attributes of MuJoCo's actuator that make it act late.

        None for an actuator law with a controller that needs the state: late commands meet the present state in it, and
        MuJoCo's actuator must not delay what comes out.
        """
        if "delay" not in values or self.actuator.needs_state:
            return {}
        return write_delay(float(values["delay"][index]), self.timestep)
