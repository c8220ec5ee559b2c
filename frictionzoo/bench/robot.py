"""A robot's own model file, MJCF or URDF as its maker publishes it, as a bench."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from frictionzoo.bench.actuators import Actuator
from frictionzoo.bench.actuators.force import Force
from frictionzoo.bench.actuators.joint_pd import JointPD
from frictionzoo.bench.base import DEFAULTS, Bench
from frictionzoo.bench.robot_file import ReadActuator, RobotFile, read_robot
from frictionzoo.bench.template import Template
from frictionzoo.core.errors import BenchError, ConfigError
from frictionzoo.core.params import AUTO, Param

_OF_BRISTLES = {"stiffness", "rest_velocity"}  # parameters by which a law of bristles is told from others
_INSIDE = 1e-3  # share of the bounds' distance, in the optimiser's coordinate, by which a fit starts inside


class Robot(Bench):
    """A robot in the air or on a table, from its own file.

    What the file says of armature, friction, damping and actuators is where an identification begins, and what is
    known: a parameter whose `init` is None is taken from it. The base stands still, joints that are not chosen too;
    contacts, limits and meshes are left out unless they are asked for. `notes` has a line for all that the file has and
    the bench has not.

    Attributes:
        file: What was read.
        notes: What was left out or changed, a line each.

    Args:
        mjcf: Path of the MJCF or URDF.
        joint: Names of joints, or regular expressions that match whole names; None for all with one degree of freedom.
        actuator: The law that turns commands into torque; None for that of the file: a position controller for its
            position actuators, a torque command for its motors.
        params: As of `Bench`; `armature.init` of None for that of the file.
        base: `fixed`: a floating base is welded; `as_is`: it is refused.
        contacts: `leave_out` or `keep`.
        limits: `leave_out` or `keep`, of joints.
        others: `fixed`: joints that are not chosen stand at their reference position; `as_is`: they are refused.
        solreffriction: As of `Bench`.
        payload: As of `Bench`.
        timestep: Simulation step [s]; None for the file's.
        inertia: As of `Bench`.
        gravity: As of `Bench`.
        tie: As of `Bench`; of values that the file has different in joints of a group, the mean counts.

    Raises:
        BenchError: The file cannot be read, or has what can neither be simulated nor left out.
        ConfigError: A parameter's section makes no sense, or has no value and the file has none.
    """

    def __init__(
        self,
        mjcf: str,
        joint: str | int | Sequence[str | int] | None = None,
        *,
        actuator: Actuator | None = None,
        params: Mapping[str, Any] | None = None,
        base: str = "fixed",
        contacts: str = "leave_out",
        limits: str = "leave_out",
        others: str = "fixed",
        solreffriction: Sequence[float] = (0.02, 1.0),
        payload: str | None = None,
        timestep: float | str | None = None,
        tie: Any = None,
        inertia: Mapping[str, Sequence[float | int]] | None = None,
        gravity: Sequence[float | int] | None = None,
    ) -> None:
        keep = () if payload is None else (payload,)
        choices = {"base": base, "contacts": contacts, "limits": limits, "others": others}
        step = None if timestep is None or timestep == AUTO else float(timestep)
        self.file: RobotFile = read_robot(mjcf, joint, **choices, keep=keep, timestep=step)
        sections = {**(params or {})}
        sections["armature"] = {"init": None, **_section(sections.get("armature", {}))}
        actuator = _read_actuator(mjcf, self.file) if actuator is None else actuator
        more: dict[str, Any] = {"solreffriction": solreffriction, "payload": payload, "tie": tie, "inertia": inertia}
        more["gravity"] = gravity
        super().__init__(mjcf, self.file.joints, actuator=actuator, params=sections, **more)
        self.notes = tuple(self.file.notes)
        if limits == "leave_out":
            self.unlimited = self.file.ranges

    def _open(self, mjcf: str, joint: Any, timestep: float | None) -> Template:
        return Template.of(mjcf, self.file.root, self.file.joints)

    def _fill(self, params: Mapping[str, Param]) -> dict[str, Param]:
        """The parameters with what the file says of those that have no value; a limit that it lacks is left out."""
        known, filled = _list_known(self.file), dict[str, Param]()
        armature = self.file.values["armature"]
        known["armature"] = np.where(armature > 0, armature, DEFAULTS["armature"]["init"])
        for name, param in params.items():
            if param.init is not None:
                filled[name] = param
            elif name in known:
                filled[name] = self._begin(param, known[name])
            elif name not in self.actuator.optional:
                raise ConfigError(f"{self.source}: no {name} in the file; give bench.actuator.params.{name}.init")
        return filled

    def _begin(self, param: Param, values: Float[np.ndarray, "nv"]) -> Param:
        """A parameter that begins with these values, the mean of a group's, and inside its bounds."""
        bound = replace(param, init=0.0, low=-np.inf, high=np.inf, scale=1.0).for_joints(self.joints)
        groups, own = np.array(self.groups(bound)), np.array(param.members(self.nv))
        shared = np.array([values[own][groups[own] == group].mean() for group in groups[own]])
        limits = replace(param, init=param.low).for_joints(self.joints)
        low, high = (limits.to_coordinate(limits.each(side, self.nv)[own], np) for side in ("low", "high"))
        inside = _INSIDE * (high - low)
        nearest = (limits.from_coordinate(end, np) for end in (low + inside, high - inside))
        free = limits.each("identify", self.nv)[own]
        return replace(limits, init=tuple(np.where(free, np.clip(shared, *nearest), shared).tolist()))

    def initial_friction(self, params: Mapping[str, Param]) -> dict[str, Float[np.ndarray, "nv"]]:
        """See `Bench.initial_friction`: frictionloss and damping that the file has, and bristles of its DC motors."""
        begun = {}
        for name, param in params.items():
            own, values = param.members(self.nv), self._say_friction(name, params)
            if param.is_identified and np.nan_to_num(values[own]).any():
                values = np.where(np.isnan(values), param.each("init", self.nv), values)
                begun[name] = self._begin(param, values).each("init", self.nv)
        return begun

    def _say_friction(self, name: str, params: Mapping[str, Param]) -> Float[np.ndarray, "nv"]:
        """What the file says of a law's parameter; NaN where it says nothing."""
        law, _, what = name.rpartition(".")  # of several laws, each has its own
        said = {one: self.file.values[one] for one in ("frictionloss", "damping")}
        if {f"{law}.{other}".lstrip(".") for other in _OF_BRISTLES} <= params.keys():
            bristles = self.file.bristles
            damping = np.where(np.isnan(bristles["stiffness"]), np.nan, self.file.values["damping"])
            said = {**bristles, "coulomb_torque": bristles["kinetic_torque"], "viscous_coefficient": damping}
        return said.get(what, np.full(self.nv, np.nan))


def _section(given: Any) -> dict[str, Any]:
    """A parameter's section, of a value that is known too."""
    return dict(given) if isinstance(given, Mapping) else {"init": given, "identify": False}


def _list_known(file: RobotFile) -> dict[str, Float[np.ndarray, "nv"]]:
    """What the file says of parameters of actuator laws, where it says it of every joint."""
    known: dict[str, np.ndarray] = {}
    read = [actuator for actuator in file.actuators if actuator is not None]
    if len(read) == len(file.joints):
        if all(actuator.kind == "position" for actuator in read):
            known |= {"kp": np.array([a.gain for a in read]), "kd": np.array([-a.bias2 for a in read])}
        if all(actuator.kind == "motor" for actuator in read):
            known["force_gain"] = np.array([actuator.gain for actuator in read])
    limits = np.abs(file.forceranges).min(axis=1)
    if np.isfinite(limits).all():
        known["torque_limit"] = limits
    return known


def _read_actuator(source: str, file: RobotFile) -> Actuator:
    """The law of the file's own actuators.

    Raises:
        BenchError: They have none, or several, or a joint has no actuator.
    """
    kinds = {None if actuator is None else actuator.kind for actuator in file.actuators}
    if kinds == {"position"}:
        return JointPD(params={"kp": {"init": None}, "kd": {"init": None}})
    if kinds == {"motor"}:
        return Force(params={"force_gain": {"init": None}})
    said = ", ".join(f"{name}: {_say(read)}" for name, read in zip(file.joints, file.actuators, strict=True))
    raise BenchError(
        f"{source}: its joints have no one law of actuators ({said[:200]}); say what turns the recorded commands into "
        "torque: bench.actuator, such as JointPD with kp and kd, or Force for torques"
    )


def _say(read: ReadActuator | None) -> str:
    return "none" if read is None else read.kind
