"""MJCF template around a drive, which is read, checked, changed, and written with values."""

import copy
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NoReturn

import mujoco
import numpy as np

from frictionzoo.bench.compiled import NO_FRICTION_CONSTRAINT
from frictionzoo.bench.inertia import SYMBOLS, from_parameters, is_consistent, to_parameters
from frictionzoo.core.errors import BenchError, ConfigError, closest
from frictionzoo.core.params import AUTO, fits
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
    """MJCF without friction, armature or actuators at the identified joints.

    Args:
        source: Its file, for messages.
        root: The MJCF.
        joints: Names of the identified joints.
    """

    def __init__(self, source: str, root: ET.Element, joints: Sequence[str]) -> None:
        self.source: str = source
        self._root = root
        self.joints: tuple[str, ...] = tuple(joints)

    @classmethod
    def read(cls, source: str, joint: Joints) -> "Template":
        """Read a template; for the arguments, see `Bench`.

        Raises:
            BenchError: The MJCF cannot be read, lacks these joints, or has an actuator.
        """
        template = cls(source, _read(source), ())
        template.joints = template._choose_joints(joint)
        template._refuse_clashes()
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

    def with_options(self, options: Mapping[str, str]) -> "Template":
        """Return the template with other attributes of `<option>`, from `read_options`."""
        if not options:
            return self
        other = self._copied()
        _section(other._root, "option")
        for option in other._root.findall("option"):  # the last of several takes effect
            option.attrib.update(options)
        return other

    def _copied(self) -> "Template":
        return Template(self.source, copy.deepcopy(self._root), self.joints)

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
        features, reason = (
            {"frictionloss": model.dof_frictionloss},
            "expected none because the friction model brings it",
        )
        if moved:
            stiffness = np.abs(np.column_stack([model.jnt_stiffness, model.jnt_stiffnesspoly])).max(axis=1)
            stiffness = np.maximum(stiffness, bool(model.ntendon))
            features |= {"ref": model.qpos0, "range": model.jnt_limited, "stiffness": stiffness}
            reason += "; bench.params.position_offset shifts no ref, range, stiffness or tendon"
        for name, values in features.items():
            if np.any(values):
                joint = self.joints[int(np.argmax(values != 0))]
                self._fail(f"joint {joint} has {name} in the MJCF, {reason}; remove it, also from defaults")

    def _fail(self, message: str) -> NoReturn:
        raise BenchError(f"{self.source}: {message}") from None

    def joint_type(self, model: mujoco.MjModel) -> str:
        """Return the type of the joints, `hinge` or `slide`.

        Raises:
            BenchError: The joints have different types, or an unsupported type.
        """
        types = [joint_type(kind) for kind in model.jnt_type]
        if len({*types}) != 1 or not {*types} <= {"hinge", "slide"}:
            listed = ", ".join(f"{model.joint(index).name} ({kind})" for index, kind in enumerate(types))
            self._fail(
                f"joints of several or unsupported types, {listed}; expected all hinge or all slide; choose joints of "
                "one type (bench.joint), and bench=robot fixes the others"
            )
        return types[0]

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
        elements = list(enumerate(self._root.iter()))
        attributes = [(place, name) for place, element in elements for name in element.attrib if name not in _NAMING]
        parts = [place for place, part in elements if part.tag not in _KEPT and part.get("name") not in self.joints]
        removals = [
            *((place, name) for place, name in attributes if name not in _GEOMETRY),
            *((place, None) for place in parts),
            *((place, name) for place, name in attributes if name in _GEOMETRY),
        ]
        for place, name in removals:
            other = self._copied()
            element = list(other._root.iter())[place]
            if name is None:
                next(parent for parent in other._root.iter() if element in list(parent)).remove(element)
                yield _describe(element), other
            else:
                yield f'{name}="{element.attrib.pop(name)}" of {_describe(element)}', other

    def _choose_joints(self, joint: Joints) -> tuple[str, ...]:
        names = [element.get("name", "") for element in self._root.findall("./worldbody//joint")]
        if joint is None:
            if len(names) != 1 or not names[0]:
                listed = ", ".join(name or "(unnamed)" for name in names) or "none"
                self._fail(f"joints {listed}, expected one named joint; set bench.joint")
            return (names[0],)
        return tuple(choose_joints(self.source, joint, names))

    def _refuse_clashes(self) -> None:
        if self._root.find(".//include") is not None:
            self._fail("it has an <include>, expected one self-contained MJCF; flatten it first")
        for element in self._root.findall("./actuator/*"):
            self._fail(
                f"an actuator {_describe(element)} in the MJCF, expected none because bench.actuator describes the "
                "drive; remove it, or take bench=robot, which reads it"
            )
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


def choose_joints(source: str, joint: str | int | Sequence[str | int], names: Sequence[str]) -> list[str]:
    """Return the joints in `bench.joint`, names or regular expressions of whole names, in the order of `names`.

    Columns of recordings follow `bench.joint`: names in another order than in the file would silently swap joints.

    Raises:
        BenchError: There is no such joint, a name occurs twice, or the order differs from the file `source`.
        ConfigError: A regular expression is invalid.
    """
    # The command line parses a name such as 0 as a number.
    wanted = [str(name) for name in ([joint] if isinstance(joint, str | int) else joint)]
    listed = [name for name in wanted if name in names]
    chosen = set(listed)
    for pattern in [name for name in wanted if name not in names]:
        matching = {name for name in names if name and fits(pattern, name, "bench.joint")}
        if not matching:
            choices = closest(pattern, filter(None, names))
            raise BenchError(f"{source}: no joint {pattern}; {choices}; set bench.joint")
        chosen |= matching
    ordered = [name for name in names if name in listed]
    if listed != ordered:
        raise BenchError(
            f"bench.joint=[{', '.join(wanted)}]: expected each joint once in the order of {source}, "
            f"[{', '.join(ordered)}]; change it, and data.columns with it"
        )
    return [name for name in names if name in chosen]


def read_options(
    timestep: float | str | None = None,
    gravity: Sequence[float | int] | None = None,
    integrator: str | None = None,
) -> dict[str, str]:
    """Return attributes of `<option>` for these arguments of a bench, without those that are None or `auto`.

    Raises:
        ConfigError: The step is not positive, gravity is not three finite numbers, or the integrator is not supported.
    """
    options: dict[str, str] = {}
    if timestep is not None and timestep != AUTO:
        options["timestep"] = in_full(float(timestep))
        if not float(timestep) > 0:
            raise ConfigError(f"bench.timestep={float(timestep)}; expected a positive number of seconds, or null")
    if gravity is not None:
        options["gravity"] = in_full(np.array(gravity, np.float64))
        if np.shape(gravity) != (3,) or not np.isfinite(np.array(gravity, np.float64)).all():
            raise ConfigError(f"bench.gravity={list(gravity)}: expected three numbers in m/s^2, or null for the file's")
    if integrator is not None:
        names = {name.casefold(): name for name in INTEGRATORS.values()}
        if str(integrator).casefold() not in names:
            raise ConfigError(f"bench.integrator={integrator}: {closest(str(integrator), names.values())}")
        options["integrator"] = names[str(integrator).casefold()]
    return options


def read_solreffriction(given: Sequence[float] | str | None) -> list[float]:
    """Return the two numbers of `bench.solreffriction`; MuJoCo's default for None and `auto`.

    Raises:
        ConfigError: They are not two numbers of the same sign.
    """
    numbers = DEFAULT_SOLREFFRICTION if given is None or (isinstance(given, str) and given == AUTO) else given
    if isinstance(numbers, str) or len(numbers) != 2 or not (min(numbers) > 0 or max(numbers) < 0):
        raise ConfigError(
            f"bench.solreffriction={given}; expected two numbers above 0, time constant in s and damping ratio, or two "
            "below 0, as MuJoCo reads them"
        )
    return [float(number) for number in numbers]


def in_full(values: Any) -> str:
    """Return a number, or an array of numbers, as MJCF text at full precision."""
    return " ".join(repr(float(value)) for value in np.ravel(values))
