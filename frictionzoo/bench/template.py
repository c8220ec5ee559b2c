"""MJCF template around a drive, which is read, checked, changed, and written with values."""

import copy
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NoReturn

import mujoco
import numpy as np

from frictionzoo.bench.compiled import NO_FRICTION_CONSTRAINT
from frictionzoo.bench.inertia import SYMBOLS, from_parameters, is_consistent, to_parameters
from frictionzoo.core.errors import BenchError, ConfigError, closest
from frictionzoo.core.params import AUTO
from frictionzoo.core.xml import write_comment, write_xml

INTEGRATORS = {mujoco.mjtIntegrator.mjINT_EULER: "Euler", mujoco.mjtIntegrator.mjINT_IMPLICITFAST: "implicitfast"}
_NAMING = {"name", "class", "childclass", "joint", "joint1", "joint2", "body", "body1", "body2", "type"}
_NO_ACTUATORS = {"default", "mesh", "texture", "material", "joint", "geom", "site", "camera", "light", "pair"}
_NO_ACTUATORS |= {"equality", "tendon"}
"""Elements of an MJCF's defaults that do not affect actuators."""
_GEOMETRY = {"axis", "pos", "quat", "euler", "axisangle", "xyaxes", "zaxis", "size", "fromto", "mass", "diaginertia"}
_KEPT = {"mujoco", "worldbody", "body", "compiler"}
Joints = str | int | Sequence[str | int] | None
"""Name or names of joints; None for all, or for a file's only one."""
DEFAULT_SOLREFFRICTION = (0.02, 1.0)
"""MuJoCo's default time constant [s] and damping ratio of the friction constraint."""


class Template:
    """MJCF without friction, armature or actuators at the identified joints; for the arguments, see `Bench`.

    Raises:
        BenchError: The MJCF cannot be read, lacks these joints, or has an actuator.
        ConfigError: The step is not positive.
    """

    def __init__(self, source: str, joint: Joints, timestep: float | str | None) -> None:
        self.source: str = source
        self._root = _read(source)
        step = read_timestep(timestep)
        if step is not None:
            self._set_option("timestep", in_full(step))
        self.joints: tuple[str, ...] = self._choose_joints(joint)
        self._refuse_clashes()

    @classmethod
    def of(cls, source: str, root: ET.Element, joints: Sequence[str]) -> "Template":
        """Return a template of the MJCF `root`, already converted from the file `source`, with these joints."""
        template = object.__new__(cls)
        template.source, template._root, template.joints = source, root, tuple(joints)
        return template

    @property
    def has_radians(self) -> bool:
        """Whether hinge positions are in radians instead of MuJoCo's default, degrees."""
        units = [compiler.get("angle") for compiler in self._root.findall("compiler") if compiler.get("angle")]
        return units[-1:] == ["radian"]

    def with_inertia(self, inertia: Mapping[str, Sequence[float | int]]) -> "Template":
        """Return the template with other link inertias: ten parameters of each body by name, as in `bench.inertia`.

        Raises:
            BenchError: A body does not exist, or its parameters are not ten or not physically consistent.
        """
        other = self._copied()
        if inertia and any(compiler.get("inertiafromgeom") == "true" for compiler in other._root.findall("compiler")):
            self._fail('inertiafromgeom="true", but bench.inertia gives inertias; remove it from the MJCF')
        bodies = {body.get("name"): body for body in other._root.findall("./worldbody//body")}
        for name, parameters in inertia.items():
            if name not in bodies:
                self._fail(f"no body {name}; {closest(name, filter(None, bodies))}; set bench.inertia")
            for inertial in bodies[name].findall("inertial"):
                bodies[name].remove(inertial)
            bodies[name].insert(0, ET.Element("inertial", _inertial(name, parameters)))
        return other

    def with_gravity(self, gravity: Sequence[float | int] | None) -> "Template":
        """Return the template with another gravity in the world frame [m/s^2]; None changes nothing.

        Raises:
            ConfigError: The gravity is not three finite numbers.
        """
        if gravity is None:
            return self
        numbers = np.array(gravity, np.float64)
        if numbers.shape != (3,) or not np.isfinite(numbers).all():
            raise ConfigError(f"bench.gravity={list(gravity)}: expected three numbers in m/s^2, or null for the file's")
        return self._copied()._set_option("gravity", in_full(numbers))

    def with_integrator(self, integrator: str | None) -> "Template":
        """Return the template with another integrator, in upper or lower case; None changes nothing.

        Raises:
            ConfigError: The integrator is not supported.
        """
        if integrator is None:
            return self
        names = {name.casefold(): name for name in INTEGRATORS.values()}
        if str(integrator).casefold() not in names:
            raise ConfigError(f"bench.integrator={integrator}: {closest(str(integrator), INTEGRATORS.values())}")
        return self._copied()._set_option("integrator", names[integrator.casefold()])

    def _copied(self) -> "Template":
        other = copy.copy(self)
        other._root = copy.deepcopy(self._root)
        return other

    def _set_option(self, name: str, value: str) -> "Template":
        _section(self._root, "option")
        for option in self._root.findall("option"):  # the last of several takes effect
            option.set(name, value)
        return self

    def write(
        self, joints: Sequence[Mapping[str, str]], actuators: Sequence[Mapping[str, str]], comments: Sequence[str] = ()
    ) -> str:
        """Return the MJCF with comments at the top and the attributes of each identified joint and its actuator."""
        root = copy.deepcopy(self._root)
        elements = {element.get("name"): element for element in root.findall("./worldbody//joint")}
        for name, attributes in zip(self.joints, joints, strict=True):
            elements[name].attrib.update(attributes)
        _section(root, "actuator").extend(ET.Element("general", dict(attributes)) for attributes in actuators)
        for position, comment in enumerate(comments):
            root.insert(position, write_comment(comment))
        return write_xml(root)

    def compile(self, text: str, constraint: bool) -> mujoco.MjModel:
        """Return the compiled model of the text from `write`.

        Raises:
            BenchError: MuJoCo refuses the MJCF, or one of its options is not supported.
        """
        try:
            model = mujoco.MjModel.from_xml_string(text)
        except (ValueError, RuntimeError) as error:  # MuJoCo raises both for invalid files
            self._fail(f"MuJoCo does not compile it ({' '.join(str(error).split())}); correct the MJCF")
        if model.nv != len(self.joints):
            self._fail(
                f"{model.nv} degrees of freedom, but {len(self.joints)} identified joints ({', '.join(self.joints)}); "
                "name every joint in bench.joint or fix the others"
            )
        if constraint and model.opt.disableflags & NO_FRICTION_CONSTRAINT:
            self._fail("the MJCF disables friction constraints, which this friction model needs; remove the flag")
        if model.opt.integrator not in INTEGRATORS:
            name = mujoco.mjtIntegrator(model.opt.integrator).name.removeprefix("mjINT_")
            self._fail(f"integrator {name}, expected {' or '.join(INTEGRATORS.values())}; change it")
        return model

    def refuse_unfit(self, model: mujoco.MjModel, moved: bool) -> None:
        """Refuse disabled actuators, dry friction and, with a position offset, features that it would not shift.

        Raises:
            BenchError: The compiled model has such a feature.
        """
        if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_ACTUATION or model.opt.disableactuator & 1:
            flags = "flag actuation or actuatorgroupdisable"
            self._fail(f"the MJCF disables actuators ({flags}), and with them the drive; remove that")
        if moved:
            self._refuse_other_references(model)
        if (model.dof_frictionloss > 0).any():
            self._fail(
                f"joint {self._first(model.dof_frictionloss > 0)} has frictionloss in the MJCF, expected none because "
                "the friction model brings it; remove it, also from defaults"
            )

    def _refuse_other_references(self, model: mujoco.MjModel) -> None:
        # For a nonlinear spring, the largest coefficient.
        springs = np.abs(np.column_stack([model.jnt_stiffness, model.jnt_stiffnesspoly])).max(axis=1)
        features = {"ref": model.qpos0 != 0, "range": model.jnt_limited > 0, "stiffness": springs > 0}
        for name, having in features.items():
            if having.any() or (name == "stiffness" and model.ntendon):
                feature = f"joint {self._first(having)} has {name}" if having.any() else "it has tendons"
                self._fail(
                    f"{feature}, which bench.params.position_offset does not shift; remove it from the MJCF, or set "
                    "bench.params.position_offset to identify: false and init: 0"
                )

    def _first(self, having: np.ndarray) -> str:
        return self.joints[int(np.argmax(having))]

    def _fail(self, message: str) -> NoReturn:
        raise BenchError(f"{self.source}: {message}") from None

    def joint_type(self, model: mujoco.MjModel) -> str:
        """Return the type of the joints, `hinge` or `slide`.

        Raises:
            BenchError: The joints have different types, or an unsupported type.
        """
        types = set(map(joint_type, model.jnt_type))
        if len(types) != 1 or not types <= {"hinge", "slide"}:
            self._fail("joints of several or unsupported types, expected all hinge or all slide")
        return types.pop()

    def find_body(self, model: mujoco.MjModel, name: str) -> int:
        """Return the index of the body that carries payloads.

        Raises:
            BenchError: The body does not exist, or no joint moves it.
        """
        bodies = [model.body(index).name for index in range(1, model.nbody)]
        if name not in bodies:
            self._fail(f"no body {name}; {closest(name, filter(None, bodies))}; set bench.payload")
        index = bodies.index(name) + 1
        if model.body_weldid[index] == 0:
            self._fail(f"no joint moves body {name}, expected one that carries the payload; set bench.payload")
        return index

    def only(self, joints: Sequence[str]) -> "Template":
        """Return the template without the bodies that other joints move."""
        other = self._copied()
        other.joints = tuple(joints)
        for parent in list(other._root.iter()):
            for body in parent.findall("body"):
                names = [joint.get("name") for joint in body.findall("joint")]
                if names and not set(names) & set(joints):
                    parent.remove(body)
        return other

    def simpler(self) -> Iterator[tuple[str, "Template"]]:
        """Yield the template without one attribute or element, with a description of it; see `Bench.simpler`."""
        elements = list(self._root.iter())
        attributes = [(element, name) for element in elements for name in element.attrib if name not in _NAMING]
        parts = [element for element in elements if element.tag not in _KEPT and element.get("name") not in self.joints]
        removals = [
            *((element, name) for element, name in attributes if name not in _GEOMETRY),
            *((element, None) for element in parts),
            *((element, name) for element, name in attributes if name in _GEOMETRY),
        ]
        for element, name in removals:
            part = _describe(element) if name is None else f'{name}="{element.get(name)}" of {_describe(element)}'
            yield part, self._without(element, name)

    def _without(self, element: ET.Element, attribute: str | None) -> "Template":
        index = list(self._root.iter()).index(element)
        other = self._copied()
        copied = list(other._root.iter())[index]
        if attribute is not None:
            del copied.attrib[attribute]
        else:
            next(parent for parent in other._root.iter() if copied in list(parent)).remove(copied)
        return other

    def _choose_joints(self, joint: Joints) -> tuple[str, ...]:
        names = [element.get("name", "") for element in self._root.findall("./worldbody//joint")]
        if joint is None:
            if len(names) != 1 or not names[0]:
                listed = ", ".join(name or "(unnamed)" for name in names) or "none"
                self._fail(f"joints {listed}, expected one named joint; set bench.joint")
            return (names[0],)
        wanted = read_joints(joint)
        for name in wanted:
            if name not in names:
                self._fail(f"no joint {name}; {closest(name, filter(None, names))}; set bench.joint")
        refuse_other_order(self.source, wanted, names)
        return tuple(wanted)

    def _refuse_clashes(self) -> None:
        if self._root.find(".//include") is not None:
            self._fail("it has an <include>, expected one self-contained MJCF; flatten it first")
        for element in self._root.findall("./actuator/*"):
            if element.get("joint") in self.joints:
                self._fail(
                    f"joint {element.get('joint')} has an actuator in the MJCF, expected none because bench.actuator "
                    "describes it; remove it from the MJCF, or take bench=robot, which reads it"
                )
            actuator = _describe(element)
            self._fail(f"an actuator {actuator} in the MJCF, whose commands no recording has; remove it from the MJCF")
        for element in self._root.findall("./default/*"):
            if element.tag not in _NO_ACTUATORS:
                self._fail(
                    f"defaults for {_describe(element)} in the MJCF would act on the drive that bench.actuator "
                    "describes, expected none outside of other classes; remove them"
                )


def _read(source: str) -> ET.Element:
    shipped = files("frictionzoo.bench") / "assets" / source
    try:
        return ET.fromstring(Path(source).read_text() if Path(source).exists() else shipped.read_text())
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise BenchError(f"{source}: cannot be read ({reason}); set bench.mjcf to an MJCF file") from None
    except ET.ParseError as error:
        raise BenchError(f"{source}: not XML ({error}); set bench.mjcf to an MJCF file") from None


def _describe(element: ET.Element) -> str:
    name = element.get("name") or element.get("class")
    return f"<{element.tag}{f' {name}' if name else ''}>"


def _inertial(name: str, parameters: Sequence[float | int]) -> dict[str, str]:
    numbers = np.array(parameters, np.float64)
    if numbers.shape != (10,) or not is_consistent(numbers):
        raise BenchError(
            f"bench.inertia.{name}={list(parameters)}: expected {', '.join(SYMBOLS)} of a body of matter, the inertia "
            "about its frame's origin; correct it"
        )
    mass, centre, inertia = from_parameters(numbers)
    full_inertia = to_parameters(mass, np.zeros(3), inertia)[4:]
    return {"pos": in_full(centre), "mass": in_full(mass), "fullinertia": in_full(full_inertia)}


def _section(root: ET.Element, tag: str) -> ET.Element:
    section = root.find(tag)
    return ET.SubElement(root, tag) if section is None else section


def joint_type(kind: int | np.integer) -> str:
    """Return the MJCF's name of a compiled joint's type: `free`, `ball`, `slide` or `hinge`."""
    return mujoco.mjtJoint(int(kind)).name.removeprefix("mjJNT_").lower()


def read_joints(joint: str | int | Sequence[str | int]) -> list[str]:
    """Return the names in `bench.joint`; the command line parses a name such as 0 as a number."""
    return [str(name) for name in ([joint] if isinstance(joint, str | int) else joint)]


def refuse_other_order(source: str, wanted: Sequence[str], names: Iterable[str]) -> None:
    """Refuse joints whose order differs from `names` in the file `source`.

    The recording's columns follow `bench.joint`: another order would silently swap the joints.

    Raises:
        BenchError: The order differs, or a joint occurs twice.
    """
    ordered = [name for name in names if name in wanted]
    if wanted != ordered:
        raise BenchError(
            f"bench.joint=[{', '.join(wanted)}]: expected each joint once in the order of {source}, "
            f"[{', '.join(ordered)}]; change it, and data.columns with it"
        )


def read_timestep(timestep: float | str | None) -> float | None:
    """Return the simulation step [s]; None for None and `auto`.

    Raises:
        ConfigError: The step is not positive.
    """
    step = None if timestep is None or timestep == AUTO else float(timestep)
    if step is not None and not step > 0:
        raise ConfigError(f"bench.timestep={step}; expected a positive number of seconds, or null")
    return step


def read_solreffriction(given: Sequence[float] | str | None) -> list[float]:
    """Return the two numbers of `bench.solreffriction`; MuJoCo's default for None and `auto`.

    Raises:
        ConfigError: They are not two numbers of the same sign.
    """
    if isinstance(given, str) and given != AUTO:
        raise ConfigError(f"bench.solreffriction={given}; expected two numbers")
    numbers = DEFAULT_SOLREFFRICTION if given is None or isinstance(given, str) else given
    if len(numbers) != 2 or not (min(numbers) > 0 or max(numbers) < 0):
        raise ConfigError(
            f"bench.solreffriction={list(numbers)}; expected two numbers above 0, time constant in s and "
            "damping ratio, or two below 0, as MuJoCo reads them"
        )
    return [float(number) for number in numbers]


def in_full(values: Any) -> str:
    """Return a number, or an array of numbers, as MJCF text at full precision."""
    return " ".join(repr(float(value)) for value in np.ravel(values))
