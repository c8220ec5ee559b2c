"""A URDF made one that MuJoCo reads, with a line for everything in it that MuJoCo does not look at."""

import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator

from frictionzoo.core.errors import BenchError

_ONCE = {"origin", "parent", "child", "axis", "limit", "dynamics", "mimic", "inertial", "mass", "inertia", "geometry"}
"""What an element of a URDF has once: URDF's own reader takes the first of several, MuJoCo refuses the file."""
_READ = {"link", "joint", "material", "mujoco"}
_UNREAD_OF_JOINTS = {"safety_controller", "calibration"}


def clean(path: str, root: ET.Element) -> Iterator[str]:
    """Take out of a URDF, in place, what MuJoCo refuses or does not read.

    Yields:
        A line for each kind of it.

    Raises:
        BenchError: It is a macro file.
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
    """Of elements that may stand once, the first: as URDF's own reader (urdfdom) takes them."""
    for owner in root.iter():
        once = _ONCE & {"inertial"} if owner.tag == "link" else _ONCE  # a link may have several shapes
        seen = set()
        for child in list(owner):
            if child.tag in seen and child.tag in once:
                owner.remove(child)
                yield f"a second <{child.tag}> of <{owner.tag} {owner.get('name', '')}> is left out"
            seen.add(child.tag)
