"""MJCF bodies of a robot with some joints fixed; bodies that move together are fused into rigid links."""

import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.bench.compiled import add_up, principal_axes, rotation
from frictionzoo.bench.robot_file.source import Source, listed
from frictionzoo.bench.template import in_full, joint_type

_SOLIMP = np.array([0.9, 0.95, 0.001, 0.5, 2.0])  # MuJoCo's default, which the MJCF omits
_LEAST = 1e-14
"""Mass [kg] and inertia [kg m^2] of a moving link without any: MuJoCo requires some, and these have no effect."""
_UNPHYSICAL = 1e-9  # violation of the triangle inequality that counts as rounding, relative to the largest inertia


@dataclass(frozen=True)
class Link:
    """Rigid group of the file's bodies `fused`, in the frame of the first, whose name may be empty.

    Mass [kg], centre [m] and inertia about it in the body's axes [kg m^2] come from the file and may be unphysical.
    """

    name: str
    fused: tuple[str, ...]
    mass: float
    centre: Float[np.ndarray, "3"]
    inertia: Float[np.ndarray, "3 3"]


@dataclass(frozen=True)
class Place:
    """Position and orientation of a frame in another frame."""

    position: Float[np.ndarray, "3"]
    quaternion: Float[np.ndarray, "4"]

    def of(self, inner: "Place") -> "Place":
        """Return the place of a frame that has the place `inner` in this frame."""
        quaternion = np.zeros(4)
        mujoco.mju_mulQuat(quaternion, self.quaternion, inner.quaternion)
        return Place(self.point(inner.position), quaternion)

    def point(self, inside: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """Return the coordinates in the outer frame of a point given in this frame."""
        return self.position + rotation(self.quaternion) @ inside

    def turned(self, inertia: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
        """Return an inertia, given in this frame's axes, in the outer frame's axes."""
        axes = rotation(self.quaternion)
        return axes @ inertia @ axes.T


HERE = Place(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
"""Identity: place of a frame in itself."""


class Tree:
    """Tree of fused bodies for moving `joints`; the other joints stay at their reference position.

    Bodies named in `kept`, or all if `apart`, are not fused with their parents. `links` has the moving links and these
    bodies, in MuJoCo's order.
    """

    def __init__(self, source: Source, joints: Sequence[int], kept: Collection[str], apart: bool) -> None:
        self._source, self._joints = source, list(joints)
        model = source.model
        jointed = {int(model.jnt_bodyid[joint]) for joint in joints}
        self._moves = np.zeros(model.nbody, bool)
        self._owner, self._place = np.zeros(model.nbody, int), [HERE] * model.nbody
        for body in range(1, model.nbody):
            parent = int(model.body_parentid[body])
            self._moves[body] = self._moves[parent] or body in jointed
            is_owner = body in jointed or apart or model.body(body).name in kept or self._lifted(body, parent)
            self._owner[body] = body if is_owner else self._owner[parent]
            if not is_owner:
                self._place[body] = self._place[parent].of(self._own_place(body))
        self._jointed = jointed
        self._refuse_unknown()
        self.links: tuple[Link, ...] = tuple(self._link(body) for body in self._bodies())

    def moves(self, body: int) -> bool:
        """Return whether a selected joint moves a body."""
        return bool(self._moves[body])

    def together(self, body: int, other: int) -> bool:
        """Return whether no selected joint is between two bodies."""
        return self._anchor(body) == self._anchor(other)

    def write(self, limits: bool) -> ET.Element:
        """Return the `<worldbody>`, without geoms."""
        elements = {0: ET.Element("worldbody")}
        for body, link in zip(self._bodies(), self.links, strict=True):
            parent = int(self._source.model.body_parentid[body])
            elements[body] = self._body(body, link, self._place[parent].of(self._own_place(body)), limits)
            elements[int(self._owner[parent])].append(elements[body])
        self._source.notes += self._say_massless()
        return elements[0]

    def _body(self, body: int, link: Link, place: Place, limits: bool) -> ET.Element:
        model = self._source.model
        attributes = {"pos": in_full(place.position), "quat": in_full(place.quaternion)}
        if model.body_gravcomp[body]:
            attributes["gravcomp"] = in_full(model.body_gravcomp[body])
        element = ET.Element("body", ({"name": link.name} if link.name else {}) | attributes)
        element.extend(self._joint(joint, limits) for joint in self._joints if model.jnt_bodyid[joint] == body)
        if link.mass > 0 or link.inertia.any() or body in self._jointed:
            element.append(self._inertial(body, link))
        return element

    def _say_massless(self) -> Iterator[str]:
        jointed = [link for body, link in zip(self._bodies(), self.links, strict=True) if body in self._jointed]
        massless = [link.name for link in jointed if link.mass < _LEAST or np.linalg.norm(link.inertia) < _LEAST]
        if massless:
            yield (
                f"{len(massless)} moving links have no mass or no inertia ({listed(massless)}): they get {_LEAST:g} kg "
                "and kg m^2, which MuJoCo requires"
            )

    def _bodies(self) -> list[int]:
        return [body for body in range(1, len(self._owner)) if self._owner[body] == body]

    def _members(self, body: int) -> list[int]:
        return [member for member in range(1, len(self._owner)) if self._owner[member] == body]

    def _anchor(self, body: int) -> int:
        while body and body not in self._jointed:
            body = int(self._source.model.body_parentid[body])
        return body

    def _own_place(self, body: int) -> Place:
        return Place(self._source.model.body_pos[body].copy(), self._source.model.body_quat[body].copy())

    def _lifted(self, body: int, parent: int) -> bool:
        lift, owner = self._source.model.body_gravcomp, self._owner[parent]
        return bool(self._moves[body] and self._source.mass[body] > 0 and lift[body] != lift[owner])

    def _refuse_unknown(self) -> None:
        for body, file in self._source.absent.items():
            if self._moves[body]:
                self._source.fail(
                    f"the inertia of body {self._source.name(body)} would come from the mesh {file}, which is not "
                    "there or no STL or OBJ; give the body an <inertial>, or put the mesh where the file says"
                )

    def _link(self, body: int) -> Link:
        source, members = self._source, self._members(body)
        weighing = [member for member in members if source.mass[member] or source.inertia[member].any()]
        centres = np.array([self._place[member].point(source.centre[member]) for member in weighing]).reshape(-1, 3)
        inertias = np.array([self._place[member].turned(source.inertia[member]) for member in weighing])
        mass, centre, inertia = add_up(source.mass[weighing], centres, inertias.reshape(-1, 3, 3))
        names = tuple(source.model.body(member).name for member in members)
        return Link(names[0], names, mass, centre, inertia)

    def _inertial(self, body: int, link: Link) -> ET.Element:
        model = self._source.model
        weighing = [member for member in self._members(body) if self._source.mass[member]]
        if weighing == [body] and self._source.compiled[body]:  # bit-identical to the compiled file
            mass, centre = model.body_mass[body], model.body_ipos[body]
            principal, quaternion = model.body_inertia[body], model.body_iquat[body]
        else:
            centre = link.centre
            mass, principal, quaternion, changed = _physical(link.mass, link.inertia)
            if changed:
                moments = ", ".join(f"{moment:.3g}" for moment in np.linalg.eigvalsh(link.inertia))
                self._source.notes.append(
                    f"the inertia of link {link.name} is not physical (principal moments {moments} kg m^2), "
                    f"which MuJoCo refuses: taken as {', '.join(f'{moment:.3g}' for moment in np.sort(principal))}"
                )
        inertial = {"pos": centre, "quat": quaternion, "mass": mass, "diaginertia": principal}
        return ET.Element("inertial", {name: in_full(value) for name, value in inertial.items()})

    def _joint(self, joint: int, limits: bool) -> ET.Element:
        model, dof = self._source.model, self._source.dof(joint)
        address = int(model.jnt_qposadr[joint])
        values = {"pos": model.jnt_pos[joint], "axis": model.jnt_axis[joint]}
        if model.qpos0[address]:
            values["ref"] = model.qpos0[address]
        if model.jnt_stiffness[joint]:
            values |= {"stiffness": model.jnt_stiffness[joint], "springref": model.qpos_spring[address]}
        if (model.dof_solimp[dof] != _SOLIMP).any():
            values["solimpfriction"] = model.dof_solimp[dof]
        if limits and model.jnt_limited[joint]:
            values |= {"range": model.jnt_range[joint], "margin": model.jnt_margin[joint]}
            values |= {"solreflimit": model.jnt_solref[joint], "solimplimit": model.jnt_solimp[joint]}
        attributes = {"name": model.joint(joint).name, "type": joint_type(model.jnt_type[joint])}
        attributes |= {name: in_full(value) for name, value in values.items()}
        if limits and model.jnt_limited[joint]:
            attributes["limited"] = "true"
        if model.jnt_actgravcomp[joint]:
            attributes["actuatorgravcomp"] = "true"
        return ET.Element("joint", attributes)


def _physical(
    mass: float, inertia: Float[np.ndarray, "3 3"]
) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "4"], bool]:
    """Return mass [kg], principal inertia [kg m^2] and quaternion of a physical body, and whether they were corrected.

    The second moments of mass along the principal axes must be positive; others are raised to nearly 0.
    """
    principal, quaternion = principal_axes((inertia + inertia.T) / 2)
    moments = principal.sum() / 2 - principal
    changed = bool(mass < 0 or moments.min() < -max(_UNPHYSICAL * abs(principal).max(), _LEAST))
    first, second, third = np.maximum(moments, _LEAST / 2)
    # With these sums, the largest is at most the sum of the others in floating point too.
    return max(mass, _LEAST), np.array([second + third, first + third, first + second]), quaternion, changed
