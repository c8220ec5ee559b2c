"""A bench: the MJCF around the drive, the joints that are identified, and the actuator that drives them."""

import copy
import logging
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.bench.actuators import Actuator, Affine
from frictionzoo.core.errors import BenchError, ConfigError, closest
from frictionzoo.core.log import Dataset, Log, Payload
from frictionzoo.core.params import Param, read_params
from frictionzoo.core.segments import Sampling
from frictionzoo.core.state import DriveState
from frictionzoo.logs.clean import EXTRAS

_log = logging.getLogger(__name__)

_JOINT_TYPES = {mujoco.mjtJoint.mjJNT_HINGE: "hinge", mujoco.mjtJoint.mjJNT_SLIDE: "slide"}
_INTEGRATORS = {mujoco.mjtIntegrator.mjINT_EULER: "Euler", mujoco.mjtIntegrator.mjINT_IMPLICITFAST: "implicitfast"}
NO_PAYLOAD = Payload(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
_TIMESTEP_TOLERANCE = 0.01  # share by which the log's interval may differ from a whole number of simulation steps
_MOST_SUBSTEPS = 10_000  # simulation steps from sample to sample
_MOST_HISTORY = 10_000  # samples by which commands may act late
_PARAMS = {"armature": "inertia", "delay": "time", "position_offset": "position"}
_OPTIONAL = ("delay", "position_offset")
DEFAULTS: dict[str, dict[str, Any]] = {
    "armature": {"init": 0.01, "low": 1e-5, "high": 1.0, "scale": "log", "identify": True}
}
"""What a bench's parameter is where nothing else is said: the armature of a servo's joint [kg m^2]."""
NO_FRICTION_CONSTRAINT = mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
"""Flags of an MJCF that leave no friction constraint."""
INERTIAL = 11
"""Numbers of a load that describe the body; the others are the joint-space inertia."""
_NAMING = {"name", "class", "childclass", "joint", "joint1", "joint2", "body", "body1", "body2", "type"}
_NO_ACTUATORS = {
    "default",
    "mesh",
    "texture",
    "material",
    "joint",
    "geom",
    "site",
    "camera",
    "light",
    "pair",
    "equality",
}
_NO_ACTUATORS |= {"tendon"}
"""What of an MJCF's defaults does not act on actuators."""
_GEOMETRY = {"axis", "pos", "quat", "euler", "axisangle", "xyaxes", "zaxis", "size", "fromto", "mass", "diaginertia"}
_KEPT = {"mujoco", "worldbody", "body", "compiler"}
_HEAVIER = 100.0  # times a fitted armature, or a part of it, within which it may move where a bench starts again


class Channels(NamedTuple):
    """What drives a simulation, by its parts, each of shape (..., nv).

    Attributes:
        command: Of each joint's actuator.
        inputs: Each other input of the actuator law, by name.
        observed: What the friction law looks at, by name.
    """

    command: Any
    inputs: dict[str, Any]
    observed: dict[str, Any]


class Bench:
    """The simulated test stand of one drive.

    The MJCF is a template without friction, armature or actuator at the identified joints; `mjcf` writes these in. The
    model that is fitted and the model that is exported are therefore one text with different numbers.

    Attributes:
        joints: Names of the identified joints, in MuJoCo's order.
        joint_type: `hinge` or `slide`.
        params: The armature, the delay and the position offset where there are any, and the actuator's parameters.
        timestep: Simulation step [s].
        own_damping: The template's own damping of each joint [N m s/rad or N s/m].
        payload: Index of the body that carries payloads, or None.
        observed: What the friction law looks at besides the state, a name among `Log.extras` each, and what it is where
            recordings lack it; see `observing`.

    Args:
        mjcf: Path of the template, or the name of one that the package ships (`knee_rod.xml`, `emps.xml`).
        joint: Name or names of the identified joints; None where the template has one joint only.
        actuator: The law that turns a command into torque.
        params: Sections of `armature`, and where wanted of `delay`, by which commands act late [s], and of
            `position_offset`, which the measured position lacks [rad or m]; a number stands for a known value. What a
            section does not say is that of `DEFAULTS`. Known to be 0, the two are left out.
        solreffriction: Time constant [s] and damping ratio of MuJoCo's friction constraint. MuJoCo's default is
            (0.02, 1); a shorter time constant makes sticking stiffer.
        payload: Name of the body that carries the payloads of recordings; None for recordings without.
        timestep: Simulation step [s]; None for the template's.

    Raises:
        BenchError: The template cannot be read or compiled, or does not have these joints.
        ConfigError: A parameter's section makes no sense.
    """

    def __init__(
        self,
        mjcf: str,
        joint: str | Sequence[str] | None = None,
        *,
        actuator: Actuator,
        params: Mapping[str, Any] | None = None,
        solreffriction: Sequence[float] = (0.02, 1.0),
        payload: str | None = None,
        timestep: float | None = None,
    ) -> None:
        self.source = mjcf
        self.actuator = actuator
        self.params: dict[str, Param] = {
            **read_params("bench", _PARAMS, params or {}, _OPTIONAL, DEFAULTS),
            **actuator.params,
        }
        if "delay" in self.params and self.params["delay"].low < 0:
            raise ConfigError(f"bench.params.delay.low={self.params['delay'].low:g}; expected 0 s or more")
        self._start: dict[str, np.ndarray] = {}  # initial values that are not those of `params`
        low, high = (min(solreffriction, default=0.0), max(solreffriction, default=0.0))
        if len(solreffriction) != 2 or not (low > 0 or high < 0):
            raise ConfigError(
                f"bench.solreffriction={list(solreffriction)}; expected two numbers above 0, time constant in s and "
                "damping ratio, or two below 0, as MuJoCo reads them"
            )
        self._solreffriction = [float(number) for number in solreffriction]
        self._template = _read_template(mjcf)
        if timestep is not None:
            if not timestep > 0:
                raise ConfigError(f"bench.timestep={timestep}; expected a positive number of seconds, or null")
            _section(self._template, "option")
            for option in self._template.findall("option"):  # of several, the last has the last word
                option.set("timestep", _number(timestep))
        self.joints = self._choose_joints(joint)
        self._refuse_clashes()
        model = self.compile(constraint=False)
        self._refuse_idle_drive(model)
        self._refuse_other_references(model)
        self._refuse_own_friction(model)
        self.joint_type = self._read_joint_type(model)
        self.timestep = float(model.opt.timestep)
        self.own_damping = model.dof_damping.copy()
        self.payload = None if payload is None else self._find_body(model, payload)
        self.observed: dict[str, float] = {}
        self._loads: dict[Payload, np.ndarray] = {}  # many recordings have the same

    @property
    def nv(self) -> int:
        """Number of identified joints."""
        return len(self.joints)

    def sampling(self, interval: float) -> Sampling:
        """How samples of this interval [s] relate to simulation steps and to late commands.

        Raises:
            ConfigError: A command may act so late that it is none of this drive.
        """
        delay = self.params.get("delay")
        latest = 0.0 if delay is None else delay.high if delay.identify else delay.init
        history = int(np.ceil(latest / interval - 1e-9))
        if history > _MOST_HISTORY:
            raise ConfigError(
                f"bench.params.delay: up to {latest:g} s, which are {history} samples, expected at most "
                f"{_MOST_HISTORY}; lower its init or high"
            )
        return Sampling(interval, self._substeps(interval), history)

    def initial_values(self) -> dict[str, np.ndarray]:
        """Initial value of each parameter, of shape (nv,)."""
        return {name: np.full(self.nv, param.init) for name, param in self.params.items()} | self._start

    def restarted(self, values: Mapping[str, Float[np.ndarray, "nv"]]) -> "Bench":
        """The same test stand for another law in place of one that was fitted: the armature alone is free.

        What else was identified stays: another law's rollouts would move it to make up for what the law cannot.

        Args:
            values: Fitted value of each of `params`, with which it starts.
        """
        armature = np.asarray(values["armature"])
        bounds = {"low": float(armature.min()) / _HEAVIER, "high": float(armature.max()) * _HEAVIER}
        free = Param("armature", "inertia", float(armature[0]), **bounds, scale="log", identify=True)
        other = copy.copy(self)
        other.params = {name: replace(param, identify=False) for name, param in self.params.items()} | {
            "armature": free
        }
        other._start = {name: np.array(value) for name, value in values.items()}
        return other

    def observing(self, inputs: Mapping[str, float]) -> "Bench":
        """The same test stand, for a friction law that looks at more of a recording than the state.

        Args:
            inputs: The law's `inputs`.

        Raises:
            ConfigError: `DriveState` has no such signal.
        """
        recorded = tuple(DriveState._field_defaults)
        for name in inputs:
            if name not in recorded:
                raise ConfigError(f"the friction law's input {name}: unknown; {closest(name, recorded)}")
        other = copy.copy(self)
        other.observed = dict(inputs)
        return other

    @property
    def inputs(self) -> tuple[str, ...]:
        """What both laws need in each sample besides the command, in the order of the channels."""
        return (*self.actuator.inputs, *self.observed)

    def split(self, channels: Any) -> Channels:
        """The parts of what drives a simulation.

        Args:
            channels: An array of shape (..., channels), as `Log.channels` has it.
        """
        parts = [channels[..., at * self.nv : (at + 1) * self.nv] for at in range(1 + len(self.inputs))]
        named = dict(zip(self.inputs, parts[1:], strict=True))
        return Channels(
            parts[0],
            {name: named[name] for name in self.actuator.inputs},
            {name: named[name] for name in self.observed},
        )

    def mjcf(
        self,
        values: Mapping[str, np.ndarray],
        frictionloss: np.ndarray | None = None,
        damping: np.ndarray | None = None,
        comments: Sequence[str] = (),
    ) -> str:
        """The complete MJCF with these values, every number at full precision.

        Args:
            values: Value of each of `params`, of shape (nv,).
            frictionloss: Dry-friction limit of each joint [N m or N], of shape (nv,); None for no friction constraint.
            damping: Damping of each joint [N m s/rad or N s/m], of shape (nv,).
            comments: Lines for the top of the file.
        """
        root = ET.fromstring(ET.tostring(self._template))
        affine = self.actuator.affine(values)
        actuators = _section(root, "actuator")
        joints = {element.get("name"): element for element in root.findall("./worldbody//joint")}
        for index, name in enumerate(self.joints):
            joint = joints[name]
            joint.set("armature", _number(values["armature"][index]))
            if "position_offset" in values:
                joint.set("ref", _number(-values["position_offset"][index] / self._angle_unit()))
            joint.set("solreffriction", " ".join(map(_number, self._solreffriction)))
            if frictionloss is not None:
                joint.set("frictionloss", _number(frictionloss[index]))
            if damping is not None:  # on top of the template's own, as in the simulation
                joint.set("damping", _number(damping[index] + self.own_damping[index]))
            actuators.append(_affine_actuator(name, index, affine, self._delayed(values, index)))
        for position, comment in enumerate(comments):
            root.insert(position, ET.Comment(f" {comment.replace('--', '- -')} "))
        ET.indent(root)
        return ET.tostring(root, encoding="unicode") + "\n"

    def compile(self, constraint: bool) -> mujoco.MjModel:
        """The compiled model with initial values.

        Args:
            constraint: Whether the joints get a row of MuJoCo's friction constraint. MJX fixes the rows when it takes
                the model over, so the limit is compiled as positive and set to its value later.

        Raises:
            BenchError: MuJoCo refuses the template, or an option of it is not supported.
        """
        frictionloss = np.ones(self.nv) if constraint else None
        # Rollouts delay the command themselves, and the engine sets the reference position.
        values = {name: value for name, value in self.initial_values().items() if name not in _OPTIONAL}
        try:
            model = mujoco.MjModel.from_xml_string(self.mjcf(values, frictionloss))
        except (ValueError, RuntimeError) as error:  # MuJoCo has both for files that it does not take
            reason = " ".join(str(error).split())
            raise BenchError(f"{self.source}: MuJoCo does not compile it ({reason}); mend the MJCF") from None
        if model.nv != self.nv:
            raise BenchError(
                f"{self.source}: {model.nv} degrees of freedom, but {self.nv} identified joints "
                f"({', '.join(self.joints)}); name every joint in bench.joint or fix the others"
            )
        if constraint and model.opt.disableflags & NO_FRICTION_CONSTRAINT:
            raise BenchError(
                f"{self.source}: the MJCF disables friction constraints, which this friction model needs; remove the "
                "flag"
            )
        if model.opt.integrator not in _INTEGRATORS:
            name = mujoco.mjtIntegrator(model.opt.integrator).name.removeprefix("mjINT_")
            raise BenchError(
                f"{self.source}: integrator {name}, expected {' or '.join(_INTEGRATORS.values())}; change it"
            )
        return model

    def accept(self, log: Log) -> Log:
        """The same log with what its payload changes in the model, and what both laws need to know of it.

        Raises:
            BenchError: This bench cannot have produced it: it has another number of joints or actuators, another time
                step, a payload that no body carries, lacks an input of the actuator law, or has one of a wrong shape.
        """
        self._check_log(log)
        log = replace(log, inputs=self._pick_inputs(log), observed=self._pick_observed(log))
        if self.payload is None and log.payload is not None:
            raise BenchError(
                f"{log.name}: a payload of {log.payload.mass:g} kg, but bench.payload=null; name the body of "
                f"{self.source} that carries it"
            )
        return log if self.payload is None else replace(log, load=self.load(log.payload or NO_PAYLOAD))

    def accept_all(self, dataset: Dataset) -> Dataset:
        """The same data set with each log accepted.

        What the friction law looks at has to be in all of its recordings or in none. In none, the law acts as at the
        value of `observed`, and what it says of other values is not identifiable.

        Raises:
            BenchError: A log is not accepted, or some have what the friction law looks at and others do not.
        """
        for name, value in self.observed.items():
            having = [log.name for log in dataset.logs if name in log.extras]
            lacking = [log.name for log in dataset.logs if name not in log.extras]
            if having and lacking:
                raise BenchError(
                    f"{lacking[0]}: no {name}, which {having[0]} has and the friction law looks at; map a column "
                    f"(data.columns.{name}), leave out one of them, or take another model"
                )
            if lacking:
                _log.info("%s: no %s in it; the friction law acts as at %g throughout", dataset.name, name, value)
        train, test = (tuple(map(self.accept, logs)) for logs in (dataset.train, dataset.test))
        return Dataset(dataset.name, train, test)

    def load(self, payload: Payload) -> Float[np.ndarray, "load"]:
        """What a payload changes in the model; empty for a bench that carries none.

        Args:
            payload: The body that is fixed to the bench's.

        Returns:
            Of the body together with its payload: mass [kg], centre of mass [m] (3), orientation of the principal axes
            (quaternion, 4), principal inertia [kg m^2] (3); then the joint-space inertia at the reference position
            without armature (nv * nv).
        """
        if self.payload is None:
            return np.zeros(0)
        if payload not in self._loads:
            self._loads[payload] = self._combine_with(self.payload, payload)
        return self._loads[payload]

    def put_load(self, model: mujoco.MjModel, load: Float[np.ndarray, "load"]) -> None:
        """Let the body that carries payloads be what a recording's payload makes of it.

        Args:
            model: A compiled model of this bench.
            load: As `load` gives it; empty to change nothing.
        """
        if self.payload is not None and len(load):
            _put_inertial(model, self.payload, load[:INERTIAL])

    def _combine_with(self, body: int, payload: Payload) -> Float[np.ndarray, "load"]:
        model = self.compile(constraint=False)
        inertial = _combine(model, body, payload)
        _put_inertial(model, body, inertial)
        return np.concatenate([inertial, rigid_inertia(model).ravel()])

    def simpler(self) -> Iterator[tuple[str, "Bench"]]:
        """What the MJCF could lack, one attribute or element at a time, in words, and the same test stand without it.

        Not each of them compiles. Bodies and the identified joints stay. Where things are, and how large, comes last:
        without it the test stand may move so differently that what is at fault does not act.
        """
        elements = _elements(self._template.iter())
        attributes = [(element, name) for element in elements for name in element.attrib if name not in _NAMING]
        parts = [element for element in elements if element.tag not in _KEPT and element.get("name") not in self.joints]
        leaving_out = [
            *((element, name) for element, name in attributes if name not in _GEOMETRY),
            *((element, None) for element in parts),
            *((element, name) for element, name in attributes if name in _GEOMETRY),
        ]
        for element, name in leaving_out:
            what = _describe(element) if name is None else f'{name}="{element.get(name)}" of {_describe(element)}'
            yield what, self._without(element, name)

    def _without(self, element: ET.Element, attribute: str | None = None) -> "Bench":
        place = list(self._template.iter()).index(element)
        other = copy.copy(self)
        other._template, other._loads = copy.deepcopy(self._template), {}
        found = list(other._template.iter())[place]
        if attribute is not None:
            del found.attrib[attribute]
        else:
            next(parent for parent in other._template.iter() if found in list(parent)).remove(found)
        return other

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

        Args:
            interval: Of the samples [s].
            whose: What is sampled, for the message.

        Raises:
            BenchError: They are not, or too many steps.
        """
        if self._substeps(interval) > _MOST_SUBSTEPS:
            raise BenchError(
                f"{whose}: {interval:.6g} s per sample are {self._substeps(interval)} simulation steps of "
                f"{self.timestep:.6g} s, expected at most {_MOST_SUBSTEPS}; set a longer bench.timestep"
            )
        if abs(interval / (self._substeps(interval) * self.timestep) - 1) > _TIMESTEP_TOLERANCE:
            raise BenchError(
                f"{whose}: {interval:.6g} s per sample, expected {self.timestep:.6g} s as in {self.source}, or "
                "a whole number of them; set bench.timestep to the log's interval or a part of it, or resample the log"
            )

    def _substeps(self, interval: float) -> int:
        return max(1, round(interval / self.timestep))

    def _pick_inputs(self, log: Log) -> Float[np.ndarray, "time inputs"] | None:
        if not self.actuator.inputs:
            return None
        columns = []
        for name in self.actuator.inputs:
            if name not in log.extras:
                column = f"map a column (data.columns.{name}), or " if name in EXTRAS else ""
                raise BenchError(
                    f"{log.name}: no {name}, which {type(self.actuator).__name__} needs; {column}give a field or a "
                    f"number ('data.inputs={{{name}: VALUE}}')"
                )
            columns.append(self._for_each_joint(log, name))
        return np.concatenate(columns, axis=1)

    def _pick_observed(self, log: Log) -> Float[np.ndarray, "time observed"] | None:
        columns = [
            self._for_each_joint(log, name) if name in log.extras else np.full(log.qpos.shape, value)
            for name, value in self.observed.items()
        ]
        return np.concatenate(columns, axis=1) if columns else None

    def _for_each_joint(self, log: Log, name: str) -> Float[np.ndarray, "time nv"]:
        signal = log.extras[name]
        if signal.shape[1] not in (1, self.nv):
            raise BenchError(
                f"{log.name}: {name} has {signal.shape[1]} columns, expected 1 for all joints or {self.nv}, one a "
                f"joint; choose other columns (data.columns.{name})"
            )
        if not np.isfinite(signal).all():
            raise BenchError(
                f"{log.name}: {name} is NaN or infinite in {(~np.isfinite(signal)).any(axis=1).sum()} of {len(signal)} "
                "samples, expected finite values; cut or repair the log"
            )
        return np.broadcast_to(signal, log.qpos.shape)

    def _angle_unit(self) -> float:
        """What the template's joint positions are in [rad or m]: MuJoCo's default for hinges is degrees."""
        units = [compiler.get("angle") for compiler in self._template.findall("compiler") if compiler.get("angle")]
        radian = units[-1:] == ["radian"]
        return np.pi / 180 if self.joint_type == "hinge" and not radian else 1.0

    def _delayed(self, values: Mapping[str, np.ndarray], index: int) -> dict[str, str]:
        """Attributes of MuJoCo's actuator that make it act late.

        None for an actuator law with a controller of its own: late commands meet the present state in it, and MuJoCo's
        actuator must not delay what comes out.
        """
        if "delay" not in values or type(self.actuator).control is not Actuator.control:
            return {}
        delay = float(values["delay"][index])
        # Between two steps MuJoCo interpolates: of a command that is held, that is the mean over the step.
        samples = str(int(np.ceil(delay / self.timestep)) + 2)
        return {"delay": _number(delay), "nsample": samples, "interp": "linear"} if delay else {}

    def _choose_joints(self, joint: str | Sequence[str] | None) -> tuple[str, ...]:
        found = [element.get("name", "") for element in self._template.findall("./worldbody//joint")]
        if joint is None:
            if len(found) != 1 or not found[0]:
                listed = ", ".join(name or "(unnamed)" for name in found) or "none"
                raise BenchError(f"{self.source}: joints {listed}, expected one named joint; set bench.joint")
            return (found[0],)
        wanted = [joint] if isinstance(joint, str) else list(joint)
        for name in wanted:
            if name not in found:
                raise BenchError(
                    f"{self.source}: no joint {name}; {closest(name, filter(None, found))}; set bench.joint"
                )
        ordered = [name for name in found if name in wanted]
        if wanted != ordered:
            # The recording's columns follow bench.joint: another order would swap the joints without a word.
            raise BenchError(
                f"bench.joint=[{', '.join(wanted)}]: expected each joint once in the order of {self.source}, "
                f"[{', '.join(ordered)}]; change it, and data.columns with it"
            )
        return tuple(ordered)

    def _find_body(self, model: mujoco.MjModel, name: str) -> int:
        bodies = [model.body(index).name for index in range(1, model.nbody)]
        if name not in bodies:
            raise BenchError(f"{self.source}: no body {name}; {closest(name, filter(None, bodies))}; set bench.payload")
        index = bodies.index(name) + 1
        if model.body_weldid[index] == 0:
            raise BenchError(
                f"{self.source}: no joint moves body {name}, expected one that carries the payload; set bench.payload"
            )
        return index

    def _refuse_clashes(self) -> None:
        if self._template.find(".//include") is not None:
            raise BenchError(f"{self.source}: it has an <include>, expected one self-contained MJCF; flatten it first")
        for element in _elements(self._template.findall("./actuator/*")):
            if element.get("joint") in self.joints:
                raise BenchError(
                    f"{self.source}: joint {element.get('joint')} has an actuator in the MJCF, expected none because "
                    "bench.actuator describes it; remove it from the MJCF"
                )
            raise BenchError(
                f"{self.source}: an actuator {_describe(element)} in the MJCF, whose commands no recording has; remove "
                "it from the MJCF"
            )
        for element in _elements(self._template.findall("./default/*")):
            if element.tag not in _NO_ACTUATORS:
                raise BenchError(
                    f"{self.source}: defaults for {_describe(element)} in the MJCF would act on the drive that "
                    "bench.actuator describes, expected none outside of classes of their own; remove them"
                )

    def _refuse_idle_drive(self, model: mujoco.MjModel) -> None:
        if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_ACTUATION or model.opt.disableactuator & 1:
            raise BenchError(
                f"{self.source}: the MJCF disables actuators (flag actuation or actuatorgroupdisable), and with them "
                "the drive; remove that"
            )

    def _refuse_other_references(self, model: mujoco.MjModel) -> None:
        """What is given in joint positions and would not move along with a position offset."""
        if "position_offset" not in self.params:
            return
        given = {"ref": model.qpos0 != 0, "range": model.jnt_limited > 0, "stiffness": _springs(model) > 0}
        for name, having in given.items():
            if having.any() or (name == "stiffness" and model.ntendon):
                what = f"joint {self.joints[int(np.argmax(having))]} has {name}" if having.any() else "it has tendons"
                raise BenchError(
                    f"{self.source}: {what}, which bench.params.position_offset would not move along; remove it from "
                    "the MJCF, or set bench.params.position_offset to identify: false and init: 0"
                )

    def _refuse_own_friction(self, model: mujoco.MjModel) -> None:
        if (model.dof_frictionloss > 0).any():
            joint = self.joints[int(np.argmax(model.dof_frictionloss > 0))]
            raise BenchError(
                f"{self.source}: joint {joint} has frictionloss in the MJCF, expected none because the friction model "
                "brings it; remove it, also from defaults"
            )

    def _read_joint_type(self, model: mujoco.MjModel) -> str:
        types = {int(kind) for kind in model.jnt_type}
        if len(types) != 1 or not types <= set(map(int, _JOINT_TYPES)):
            raise BenchError(f"{self.source}: joints of several or unsupported types, expected all hinge or all slide")
        return _JOINT_TYPES[mujoco.mjtJoint(types.pop())]


def _read_template(source: str) -> ET.Element:
    shipped = files("frictionzoo.bench") / "assets" / source
    try:
        text = Path(source).read_text() if Path(source).exists() else shipped.read_text()
        return ET.fromstring(text, ET.XMLParser(target=ET.TreeBuilder(insert_comments=True)))
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise BenchError(f"{source}: cannot be read ({reason}); set bench.mjcf to an MJCF file") from None
    except ET.ParseError as error:
        raise BenchError(f"{source}: not XML ({error}); set bench.mjcf to an MJCF file") from None


def rigid_inertia(model: mujoco.MjModel) -> Float[np.ndarray, "nv nv"]:
    """Joint-space inertia at the reference position without the armature [kg m^2 or kg], the same bits for any."""
    model, data = copy.copy(model), mujoco.MjData(model)
    model.dof_armature[:] = 0  # taken off afterwards, its rounding would stay
    data.qpos[:] = model.qpos0
    # Not mj_forward, which divides by the inertia: without its armature a joint may have none.
    for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_tendon, mujoco.mj_makeM):
        stage(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    return inertia


def can_collide(model: mujoco.MjModel) -> bool:
    """Whether there are geoms between which MuJoCo looks for contacts.

    Not between those of one body or of bodies welded together, nor, unless that is disabled, between a moving body and
    its parent. Pairs that the MJCF excludes count as if it did not.

    Source: MuJoCo documentation, "Computation", "Collision detection", selection.

    Args:
        model: The compiled bench.
    """
    wanted = (model.geom_contype[:, None] & model.geom_conaffinity[None, :]) != 0
    body = model.body_weldid[model.geom_bodyid]
    parent = model.body_weldid[model.body_parentid[body]]
    child = (parent[:, None] == body[None, :]) & (body[None, :] != 0)  # of one that stands still, all may touch it
    filtered = (child | child.T) & (not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT)
    return bool(((wanted | wanted.T) & (body[:, None] != body[None, :]) & ~filtered).any())


def _combine(model: mujoco.MjModel, body: int, payload: Payload) -> Float[np.ndarray, "11"]:
    """Mass, centre, principal axes and inertia of a body and its payload, by the parallel-axis theorem."""
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.body_iquat[body])
    axes = axes.reshape(3, 3)
    masses = np.array([model.body_mass[body], payload.mass])
    centres = np.stack([model.body_ipos[body], payload.position])
    inertias = [axes * model.body_inertia[body] @ axes.T, np.diag(payload.inertia)]
    # A frame without mass may carry the payload, and carry none.
    centre = masses @ centres / masses.sum() if masses.sum() > 0 else centres[0]
    total = np.zeros((3, 3))
    for mass, inertia, offset in zip(masses, inertias, centres - centre, strict=True):
        total += inertia + mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    principal, frame = np.linalg.eigh(total)
    frame[:, 0] *= np.linalg.det(frame)  # a rotation, not a reflection
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, frame.ravel())
    return np.concatenate([[masses.sum()], centre, quaternion, principal])


def _springs(model: mujoco.MjModel) -> Float[np.ndarray, "nv"]:
    """Stiffness of each joint's spring, the largest coefficient of one that is no straight line."""
    return np.abs(np.column_stack([model.jnt_stiffness, model.jnt_stiffnesspoly])).max(axis=1)


def _put_inertial(model: mujoco.MjModel, body: int, inertial: Float[np.ndarray, "11"]) -> None:
    model.body_mass[body], model.body_ipos[body] = inertial[0], inertial[1:4]
    model.body_iquat[body], model.body_inertia[body] = inertial[4:8], inertial[8:]
    # Shortcuts that MuJoCo's compiler allowed itself for the body without the payload.
    model.body_sameframe[body] = model.body_simple[body] = 0
    model.dof_simplenum[:] = 0
    mujoco.mj_setConst(model, mujoco.MjData(model))  # the mass of subtrees, where the origin of inertias lies


def _elements(nodes: Iterable[ET.Element]) -> list[ET.Element]:
    """Those that are no comments."""
    return [node for node in nodes if isinstance(node.tag, str)]


def _describe(element: ET.Element) -> str:
    name = element.get("name") or element.get("class")
    return f"<{element.tag}{f' {name}' if name else ''}>"


def _section(root: ET.Element, tag: str) -> ET.Element:
    found = root.find(tag)
    return ET.SubElement(root, tag) if found is None else found


def _affine_actuator(joint: str, index: int, affine: Affine, delayed: Mapping[str, str]) -> ET.Element:
    gain, *bias = (_number(coefficient[index]) for coefficient in affine)
    attributes = {"name": joint, "joint": joint, "gainprm": gain, "biastype": "affine", "biasprm": " ".join(bias)}
    return ET.Element("general", {**attributes, **delayed})


def _number(value: float | np.floating) -> str:
    return repr(float(value))
