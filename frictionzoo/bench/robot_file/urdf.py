"""Conversion of a URDF for MuJoCo, with a note for each kind of ignored element."""

import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator

from frictionzoo.core.errors import BenchError

_ONCE = {"origin", "parent", "child", "axis", "limit", "dynamics", "mimic", "inertial", "mass", "inertia", "geometry"}
"""URDF elements that may occur once per parent; urdfdom reads the first of several, MuJoCo refuses the file."""
_READ = {"link", "joint", "material", "mujoco"}
_UNREAD_OF_JOINTS = {"safety_controller", "calibration"}


def clean(path: str, root: ET.Element) -> Iterator[str]:
    """Remove from a URDF, in place, elements that MuJoCo refuses or ignores; yield a note for each ignored kind.

    Raises:
        BenchError: The file has xacro macros.
    """
    if any("xacro" in element.tag for element in root.iter() if isinstance(element.tag, str)):
        raise BenchError(
            f"{path}: it has xacro macros, expected a plain URDF; expand it first (xacro FILE > robot.urdf)"
        )
    yield from _take_first(root)
    unread = [element for element in root if element.tag not in _READ]
    if unread:
        counts = Counter(element.tag for element in unread)
        listed = ", ".join(f"{number} <{tag}>" for tag, number in counts.items())
        yield f"left out, because MuJoCo does not read them in a URDF: {listed}"
    for element in unread:
        root.remove(element)
    joints = root.findall("joint")
    speeds = [joint for joint in joints for limit in joint.findall("limit") if limit.get("velocity")]
    if speeds:
        yield f"velocity limits of {len(speeds)} joints: MuJoCo has none"
    others = Counter(child.tag for joint in joints for child in joint if child.tag in _UNREAD_OF_JOINTS)
    for tag, number in others.items():
        yield f"left out, because MuJoCo does not read them in a URDF: {number} <{tag}> of joints"


def _take_first(root: ET.Element) -> Iterator[str]:
    """Keep the first of several elements that may occur once, as URDF's reference reader (urdfdom) does."""
    for owner in root.iter():
        once = _ONCE & {"inertial"} if owner.tag == "link" else _ONCE  # a link may have several shapes
        tags = set()
        for child in list(owner):
            if child.tag in tags and child.tag in once:
                owner.remove(child)
                yield f"a second <{child.tag}> of <{owner.tag} {owner.get('name', '')}> is left out"
            tags.add(child.tag)
