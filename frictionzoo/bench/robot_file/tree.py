"""MJCF bodies of a robot with some joints fixed; bodies that move together are fused into rigid links."""

import xml.etree.ElementTree as ET
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.bench.compiled import add_up, principal_axes, rotation
from frictionzoo.bench.robot_file.source import Source
from frictionzoo.bench.template import in_full, joint_type

_SOLIMP = np.array([0.9, 0.95, 0.001, 0.5, 2.0])  # MuJoCo's default, which the MJCF omits
_LEAST = 1e-14
"""Mass [kg] and inertia [kg m^2] of a moving link without any: MuJoCo requires some, and these have no effect."""
_UNPHYSICAL = 1e-9  # violation of the triangle inequality that counts as rounding, relative to the largest inertia


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

    Bodies named in `kept`, or all if `apart`, are not fused with their parents.
    """

    def __init__(self, source: Source, joints: Sequence[int], kept: Collection[str], apart: bool) -> None:
        self._source, self._joints = source, list(joints)
        model = source.model
        self._jointed = {int(model.jnt_bodyid[joint]) for joint in joints}
        self._moves = np.zeros(model.nbody, bool)
        self._owner, self._place = np.zeros(model.nbody, int), [HERE] * model.nbody
        for body in range(1, model.nbody):
            parent = int(model.body_parentid[body])
            self._moves[body] = self._moves[parent] or body in self._jointed
            is_lifted = self._moves[body] and source.mass[body] > 0
            is_lifted &= model.body_gravcomp[body] != model.body_gravcomp[self._owner[parent]]
            is_owner = body in self._jointed or apart or model.body(body).name in kept or is_lifted
            self._owner[body] = body if is_owner else self._owner[parent]
            if not is_owner:
                self._place[body] = self._place[parent].of(self._own_place(body))
        for body, file in source.absent.items():
            if self._moves[body]:
                source.fail(
                    f"the inertia of body {source.name('body', body)} would come from the mesh {file}, which is not "
                    "there or no STL or OBJ; give the body an <inertial>, or put the mesh where the file says"
                )

    def moves(self, body: int) -> bool:
        """Return whether a selected joint moves a body."""
        return bool(self._moves[body])

    def together(self, body: int, other: int) -> bool:
        """Return whether no selected joint is between two bodies."""
        return self._anchor(body) == self._anchor(other)

    def _anchor(self, body: int) -> int:
        while body and body not in self._jointed:
            body = int(self._source.model.body_parentid[body])
        return body

    def _own_place(self, body: int) -> Place:
        return Place(self._source.model.body_pos[body].copy(), self._source.model.body_quat[body].copy())

    def write(self, limits: bool) -> ET.Element:
        """Return the `<worldbody>`, without geoms."""
        elements, massless, model = {0: ET.Element("worldbody")}, [], self._source.model
        for body in (body for body in range(1, model.nbody) if self._owner[body] == body):
            parent, name = int(model.body_parentid[body]), model.body(body).name
            place = self._place[parent].of(self._own_place(body))
            attributes = {"pos": in_full(place.position), "quat": in_full(place.quaternion)}
            if model.body_gravcomp[body]:
                attributes["gravcomp"] = in_full(model.body_gravcomp[body])
            element = elements[body] = ET.Element("body", ({"name": name} if name else {}) | attributes)
            element.extend(self._joint(joint, limits) for joint in self._joints if model.jnt_bodyid[joint] == body)
            mass, centre, inertia = self._fuse(body)
            if mass > 0 or inertia.any() or body in self._jointed:
                element.append(self._inertial(body, mass, centre, inertia))
            if body in self._jointed and (mass < _LEAST or np.linalg.norm(inertia) < _LEAST):
                massless.append(name)
            elements[int(self._owner[parent])].append(element)
        self._source.note(
            f"{{n}} moving links have no mass or no inertia ({{}}): they get {_LEAST:g} kg and kg m^2, which MuJoCo "
            "requires",
            massless,
        )
        return elements[0]

    def _members(self, body: int) -> list[int]:
        return [member for member in range(1, len(self._owner)) if self._owner[member] == body]

    def _fuse(self, body: int) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
        """Return mass, centre and inertia of all bodies fused with this one, in its frame; they may be unphysical."""
        source = self._source
        weighing = [member for member in self._members(body) if source.mass[member] or source.inertia[member].any()]
        centres = np.array([self._place[member].point(source.centre[member]) for member in weighing]).reshape(-1, 3)
        inertias = np.array([self._place[member].turned(source.inertia[member]) for member in weighing])
        return add_up(source.mass[weighing], centres, inertias.reshape(-1, 3, 3))

    def _inertial(
        self, body: int, mass: float, centre: Float[np.ndarray, "3"], inertia: Float[np.ndarray, "3 3"]
    ) -> ET.Element:
        model = self._source.model
        weighing = [member for member in self._members(body) if self._source.mass[member]]
        if weighing == [body] and self._source.compiled[body]:  # bit-identical to the compiled file
            mass, centre = model.body_mass[body], model.body_ipos[body]
            principal, quaternion = model.body_inertia[body], model.body_iquat[body]
        else:
            mass, principal, quaternion, changed = _physical(mass, inertia)
            if changed:
                moments = ", ".join(f"{moment:.3g}" for moment in np.linalg.eigvalsh(inertia))
                self._source.note(
                    f"the inertia of link {model.body(body).name} is not physical (principal moments {moments} "
                    f"kg m^2), which MuJoCo refuses: taken as {', '.join(f'{m:.3g}' for m in np.sort(principal))}"
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
