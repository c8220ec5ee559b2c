"""Bench from the MJCF or URDF that a robot's manufacturer publishes."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from frictionzoo.bench.actuators import Actuator
from frictionzoo.bench.actuators.force import Force
from frictionzoo.bench.actuators.joint_pd import JointPD
from frictionzoo.bench.actuators.saturation import LIMITS, POSITIONS
from frictionzoo.bench.base import DEFAULTS, Bench
from frictionzoo.bench.robot_file import RobotFile, read_robot
from frictionzoo.bench.robot_file.read import refuse_other
from frictionzoo.bench.robot_file.source import listed
from frictionzoo.bench.template import Joints, Template
from frictionzoo.core.errors import BenchError, MissingValueError
from frictionzoo.core.params import LARGEST, Param, refuse_negative

_OF_BRISTLES = {"stiffness", "rest_velocity"}  # parameters that only bristle models have
_RANGES = {"torque_limit": "ranges of torque", "torque_low": "ranges of torque"}
_RANGES |= dict.fromkeys(POSITIONS, "ranges of desired positions")
_GAINS = {"kp", "kd", "force_gain"}  # 0 in the file where a joint has no such actuator
_INSIDE = 1e-3  # distance of a fit's start from its bounds, as a share of their range in the optimiser's coordinate


class Robot(Bench):
    """Bench of a robot with a fixed base, from its model file.

    A parameter of armature, friction, damping or actuators whose `init` is None takes the file's value. Base and
    unselected joints are fixed. Contacts and limits are left out by default; meshes are always left out. The other
    arguments are those of `Bench`.

    Attributes:
        file: The robot's file as read.
        choices: The arguments `base`, `contacts`, `limits` and `others`.

    Args:
        mjcf: Path of the MJCF or URDF.
        joint: Names of joints, or regular expressions that match whole names; None for all with one degree of freedom.
        actuator: Actuator law; None for the file's: `JointPD` for position and velocity actuators, `Force` for motors.
            A joint that no actuator of the file moves has no torque.
        params: See `Bench`. By default, `init` of `armature` and `delay` is None and `high` of `armature` is 10.
        base: `fixed` welds a floating base to the world; `as_is` refuses it.
        contacts: `leave_out` or `keep`.
        limits: `leave_out` or `keep` the limits of joints and tendons.
        others: `fixed` holds unselected joints at their reference position; `as_is` refuses them.
        ranges: `keep` or `leave_out` `ctrlrange`, `forcerange` and `actuatorfrcrange` of the file; limits of the
            actuator law have precedence.
        timestep: Simulation step [s]; None for the file's.
        tie: See `Bench`; a group starts at the mean of the file's values.

    Raises:
        BenchError: The file cannot be read, or has a feature that can neither be simulated nor left out.
        ConfigError: A parameter's section is invalid, or neither the section nor the file has its value.
    """

    armature_high = 10.0

    def __init__(
        self,
        mjcf: str,
        joint: Joints = None,
        *,
        actuator: Actuator | None = None,
        params: Mapping[str, Any] | None = None,
        base: str = "fixed",
        contacts: str = "leave_out",
        limits: str = "leave_out",
        others: str = "fixed",
        ranges: str = "keep",
        solreffriction: Sequence[float] | str | None = None,
        payload: str | None = None,
        timestep: float | str | None = None,
        tie: Any = None,
        inertia: Mapping[str, Sequence[float | int]] | None = None,
        gravity: Sequence[float | int] | None = None,
        second_order: bool | str | None = None,
        integrator: str | None = None,
    ) -> None:
        keep = () if payload is None else (payload,)
        self.choices: Mapping[str, str] = {"base": base, "contacts": contacts, "limits": limits, "others": others}
        self.file: RobotFile = read_robot(mjcf, joint, **self.choices, keep=keep)
        sections = {**(params or {})}
        for name, defaults in {"armature": {"high": self.armature_high}, "delay": {}}.items():
            sections[name] = {"init": None, **defaults, **_section(sections.get(name, {}))}
        refuse_other("ranges", ranges, ("keep", "leave_out"))
        actuator = _read_actuator(mjcf, self.file) if actuator is None else actuator
        self._known = _list_known(self.file) | (_list_ranges(self.file) if ranges == "keep" else {})
        self._said: list[str] = []  # differences of initial values and ranges from the file
        actuator = self._with_ranges(actuator)
        if isinstance(actuator, JointPD) and actuator.params["kp"].init is None and 0 in self._known.get("kp", ()):
            actuator = actuator.with_soft_joints()
        options: dict[str, Any] = {"solreffriction": solreffriction, "payload": payload, "tie": tie, "inertia": inertia}
        options |= {"gravity": gravity, "second_order": second_order, "integrator": integrator, "timestep": timestep}
        super().__init__(mjcf, self.file.joints, actuator=actuator, params=sections, **options)
        if limits == "leave_out":
            self.unlimited = self.file.ranges
        self.passive = self._list_passive()
        self._say_drives()
        self.notes = (*self.file.notes, *dict.fromkeys(self._said))

    def _open(self, mjcf: str, joint: Joints) -> Template:
        return Template(mjcf, self.file.root, self.file.joints)

    def _fill(self, params: Mapping[str, Param]) -> dict[str, Param]:
        """Return the parameters with missing values from the file, without optional ones that the file lacks."""
        filled = dict[str, Param]()
        for name, param in params.items():
            if param.init is not None:
                filled[name] = param
            elif name == "delay" and not self._known[name].any():
                filled |= {name: replace(param, init=0.0)} if param.is_identified else {}
            elif name in self._known:
                filled[name] = self._begin(self._with_known(param), self._known[name])
                self._say_begun(filled[name])
            elif name not in self.actuator.optional or param.is_identified:
                option = f"bench.actuator.params.{name}.init"
                _refuse_shared(self.source, self.file, option)
                raise MissingValueError(f"{self.source}: no {name} in the file; give {option}")
        refuse_negative(f"{self.source}: ", filled)
        return filled

    def _with_known(self, param: Param) -> Param:
        """Return the parameter without a fit of gains and armature that a joint without a drive lacks."""
        values, passive = self._known[param.name], np.isin(self.joints, self.file.passive)
        if param.name == "armature":
            lacking = passive & (values == 0)
        elif param.name in _GAINS:
            lacking = (values == 0) & ((param.name != "kd") | (self._known.get("kp", values) == 0))
        else:
            return param
        if not param.is_identified or not lacking.any():
            return param
        free = replace(param, init=0.0, low=-np.inf, high=np.inf, scale=1.0).for_joints(self.joints)
        return replace(param, identify=tuple((free.each("identify", self.nv) & ~lacking).tolist()))

    def _list_passive(self) -> tuple[str, ...]:
        """Return the joints that no actuator of the file moves, if the law gives them no torque without commands."""
        if not self.file.passive:
            return ()
        rng, zeros = np.random.default_rng(0), np.zeros(self.nv)
        values, qpos, qvel = self.initial_values(), *rng.uniform(0.5, 1.0, (2, self.nv))
        law, inputs = self.actuator.affine(values), dict.fromkeys(self.actuator.inputs, zeros)
        ctrl = self.actuator.control(np, values, qpos, qvel, zeros, inputs)
        torque = law.gain * ctrl + law.bias0 + law.bias1 * qpos + law.bias2 * qvel
        return tuple(
            joint for joint, own in zip(self.joints, torque, strict=True) if own == 0 and joint in self.file.passive
        )

    def _say_drives(self) -> None:
        """Note the joints without an actuator, and those with a velocity servo."""
        if self.passive:
            without = "no torque but that of friction and springs; recordings need no command of them"
            self._said.append(f"joints without an actuator, {listed(self.passive)}: {without}")
        if isinstance(self.actuator, JointPD) and not self.actuator.all_stiff:
            values = self.initial_values()
            servos = (values["kp"] == 0) & (values["kd"] > 0)
            names = [joint for joint, is_servo in zip(self.joints, servos, strict=True) if is_servo]
            self._said += [f"velocity servos of joint {listed(names)}: ctrl is the desired velocity"] if names else []

    def _with_ranges(self, actuator: Actuator) -> Actuator:
        """Return the actuator law with the file's limits; limits in the law's parameters have precedence."""
        limits = [name for name in (*LIMITS, *POSITIONS) if name in self._known]
        torque_limit = actuator.params.get("torque_limit")
        if "torque_limit" in actuator.said and (torque_limit is None or torque_limit.init is not None):
            limits = [name for name in limits if name not in LIMITS]
        for name in limits:
            if name not in actuator.dimensions and not isinstance(actuator, Force):  # its commands are not positions
                note = f"{_RANGES[name]} of the file are left out: {type(actuator).__name__} has no such parameters"
                self._said.append(note)
        added = [name for name in limits if name in actuator.optional and name not in actuator.said]
        if not added:
            return actuator
        other, section = copy.copy(actuator), {"low": -LARGEST, "high": LARGEST, "scale": 1.0, "identify": False}
        of_velocity = not np.any(self._known.get("kp", 1))  # velocity servos alone
        dimensions = {**actuator.dimensions, **dict.fromkeys(POSITIONS if of_velocity else (), "velocity")}
        params = {name: Param(name, dimensions[name], None, **section) for name in added}
        other.params = {**actuator.params, **params}
        return other

    def _say_begun(self, param: Param) -> None:
        initial, in_file = param.each("init", self.nv), self._known[param.name]
        changed = param.each("identify", self.nv) & ~np.isclose(initial, in_file, rtol=1e-9, atol=0.0)
        moves: dict[str, list[str]] = {}
        for index in np.flatnonzero(changed):
            move = f"at {initial[index]:.4g}, where the file has {in_file[index]:.4g}"
            moves.setdefault(move, []).append(self.joints[index])
        for move, joints in moves.items():
            self._said.append(
                f"{param.name} of {', '.join(joints)} begins {move}: a fit begins within its bounds, and where joints "
                "share a value, at their mean"
            )

    def _begin(self, param: Param, values: Float[np.ndarray, "nv"]) -> Param:
        """Return a parameter with these initial values, averaged within groups and moved inside its bounds."""
        unbounded = replace(param, init=0.0, low=-np.inf, high=np.inf, scale=1.0).for_joints(self.joints)
        groups, members = np.array(self.groups(unbounded)), np.array(param.members(self.nv))
        free = unbounded.each("identify", self.nv)[members]
        if param.name == "armature":
            values = np.where((values > 0) | ~unbounded.each("identify", self.nv), values, DEFAULTS["armature"]["init"])
        shared = values[members].astype(np.float64)
        for group in set(groups[members][free]):  # known values do not change
            shared[groups[members] == group] = shared[groups[members] == group].mean()
        bounded = replace(param, init=param.low).for_joints(self.joints)
        low, high = (bounded.to_coordinate(bounded.each(side, self.nv)[members], np) for side in ("low", "high"))
        inside = _INSIDE * (high - low)
        nearest = (bounded.from_coordinate(end, np) for end in (low + inside, high - inside))
        return replace(bounded, init=tuple(np.where(free, np.clip(shared, *nearest), shared).tolist()))

    def initial_friction(self, params: Mapping[str, Param]) -> dict[str, Float[np.ndarray, "nv"]]:
        """See `Bench.initial_friction`: the file's frictionloss and damping, and the bristles of its DC motors."""
        initial = {}
        for name, param in params.items():
            values = self._say_friction(name, params)
            stated = values[param.members(self.nv)]
            # A fit never starts at 0. A known value is 0 if the file has none.
            if param.is_stated or np.isnan(stated).all() or (param.is_identified and not np.nan_to_num(stated).any()):
                continue
            values = np.where(np.isnan(values), param.each("init", self.nv), values)
            if name.rpartition(".")[2] == "frictionloss":  # at 0 MuJoCo locks the joint
                values = np.where(values == 0, param.each("low", self.nv), values)
            initial[name] = self._begin(param, values).each("init", self.nv)
        return initial

    def _say_friction(self, name: str, params: Mapping[str, Param]) -> Float[np.ndarray, "nv"]:
        """Return the file's values of a friction parameter, of shape (nv,); NaN without a value."""
        law, _, parameter = name.rpartition(".")  # each part of a sum of models has its prefix
        values = {key: self.file.values[key] for key in ("frictionloss", "damping")}
        if {f"{law}.{other}".lstrip(".") for other in _OF_BRISTLES} <= params.keys():
            bristles = self.file.bristles
            damping = np.where(np.isnan(bristles["stiffness"]), np.nan, self.file.values["damping"])
            values = {**bristles, "coulomb_torque": bristles["kinetic_torque"], "viscous_coefficient": damping}
        return values.get(parameter, np.full(self.nv, np.nan))


def _section(given: Any) -> dict[str, Any]:
    return dict(given) if isinstance(given, Mapping) else {"init": given, "identify": False}


def _list_known(file: RobotFile) -> dict[str, Float[np.ndarray, "nv"]]:
    """Return the file's values of bench and actuator parameters that it states for every joint."""
    known: dict[str, np.ndarray] = {"armature": file.values["armature"], "delay": file.delays}
    kinds = _kinds(file)
    if kinds and kinds <= {"position", "velocity"}:
        known |= {
            "kp": np.array([0.0 if a is None else 0.0 - a.bias1 for a in file.actuators]),
            "kd": np.array([0.0 if a is None else 0.0 - a.bias2 for a in file.actuators]),
        }
    if kinds == {"motor"}:
        known["force_gain"] = np.array([0.0 if actuator is None else actuator.gain for actuator in file.actuators])
    return known


def _kinds(file: RobotFile) -> set[str | None]:
    """Return the kinds of the joints' actuators, without passive joints; None for one that is not supported."""
    pairs = zip(file.joints, file.actuators, strict=True)
    return {None if read is None else read.kind for joint, read in pairs if joint not in file.passive}


def _refuse_shared(source: str, file: RobotFile, option: str) -> None:
    """Refuse an actuator that moves joints by a tendon or another transmission, whose gains are asked for."""
    for name in dict.fromkeys(name for movers in file.movers for name in movers):
        rows = zip(file.joints, file.actuators, file.movers, strict=True)
        moved = [joint for joint, read, movers in rows if read is None and name in movers]
        if len(moved) > 1:
            raise BenchError(
                f"{source}: actuator {name} moves {len(moved)} joints, {listed(moved)}, by a tendon or another "
                f"transmission, which a bench does not simulate; choose other joints (bench.joint), or give each joint "
                f"a separate value ({option})"
            )


def _list_ranges(file: RobotFile) -> dict[str, Float[np.ndarray, "nv"]]:
    """Return the file's limits of torques and desired positions; a joint without a limit gets a distant one."""
    limits: dict[str, np.ndarray] = {}
    for ranges, low, high in ((file.forceranges, "torque_low", "torque_limit"), (file.ctrlranges, *POSITIONS)):
        if not np.isnan(ranges).all():
            filled = np.where(np.isnan(ranges), [-LARGEST, LARGEST], ranges)
            limits |= {low: filled[:, 0], high: filled[:, 1]}
    if "torque_low" in limits and np.array_equal(limits["torque_low"], -limits["torque_limit"]):
        del limits["torque_low"]
    return limits


def _read_actuator(source: str, file: RobotFile) -> Actuator:
    kinds = _kinds(file)
    if kinds and kinds <= {"position", "velocity"}:
        return JointPD(params={"kp": {"init": None}, "kd": {"init": None}})
    if kinds == {"motor"}:
        return Force(params={"force_gain": {"init": None}})
    _refuse_shared(source, file, "bench.actuator")
    pairs = zip(file.joints, file.actuators, strict=True)
    listing = ", ".join(f"{name}: {'none' if read is None else read.kind}" for name, read in pairs)
    raise BenchError(
        f"{source}: its joints do not share one actuator ({listing[:200]}); set bench.actuator, which "
        "turns the recorded commands into torque, such as JointPD with kp and kd, or Force for torques"
    )
