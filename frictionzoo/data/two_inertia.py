"""Simulated drive with backlash: separate motor and load joints, coupled through a known gap."""

import math
from dataclasses import dataclass

import mujoco

from frictionzoo.data.source import register_source
from frictionzoo.data.twin import Twin, refuse_low

LIGHT = 1e-3  # kg m^2; the divergence check of lighter rotors limits acceleration, at which MuJoCo resets the state


@dataclass(frozen=True)
class HiddenCoupling:
    """Rotor and coupling that drive the bench's joint, unknown to the identification.

    Coupling torque = stiffness (x - gap / 2) + coupling_damping dx/dt for x > gap / 2, stiffness (x + gap / 2)
    + coupling_damping dx/dt for x < -gap / 2, otherwise 0; x is the rotor's angle ahead of the load. Friction torque
    of the rotor = frictionloss w / sqrt(w^2 + smoothing_velocity^2) + damping w; w is the rotor's velocity.

    Attributes:
        armature: Inertia of the load in addition to the bench's bodies [kg m^2].
        rotor_inertia: Inertia of the rotor, reflected to the load [kg m^2].
        gap: Angle from contact to contact [rad].
        stiffness: Stiffness of the coupling [N m/rad].
        coupling_damping: Damping of the coupling [N m s/rad].
        frictionloss: Dry friction of the rotor [N m].
        damping: Viscous friction coefficient of the rotor [N m s/rad].
        smoothing_velocity: Speed scale of the sign change of dry friction [rad/s].
    """

    armature: float
    rotor_inertia: float
    gap: float
    stiffness: float
    coupling_damping: float
    frictionloss: float
    damping: float
    smoothing_velocity: float

    def __post_init__(self) -> None:
        positive, others = ("rotor_inertia", "stiffness", "smoothing_velocity"), ("coupling_damping", "frictionloss")
        refuse_low("drive", self, positive, ("armature", "gap", *others, "damping"))

    def coupling(self, ahead: float, faster: float) -> float:
        """Return the torque on the load [N m] from the rotor's lead [rad] and its relative velocity [rad/s]."""
        bend = ahead - math.copysign(min(abs(ahead), self.gap / 2), ahead)
        return self.stiffness * bend + self.coupling_damping * faster if bend else 0.0

    def friction(self, rotor_velocity: float) -> float:
        """Return the friction torque of the rotor [N m], positive at positive velocity [rad/s]."""
        dry = self.frictionloss * rotor_velocity / math.hypot(rotor_velocity, self.smoothing_velocity)
        return dry + self.damping * rotor_velocity


@register_source("two_inertia")
class TwoInertia(Twin):
    """The paper's bench, driven by a rotor through a coupling with backlash, simulated in MuJoCo C; sensor at the load.

    Source: bench, controller and excitation as `Twin`; coupling: dead-zone model of M. Nordin, P.-O. Gutman,
    "Controlling mechanical systems with backlash - a survey", Automatica 38(10), 2002.

    Arguments as `Twin`; the section `drive` has the attributes of `HiddenCoupling`.
    """

    hidden = HiddenCoupling
    drive: HiddenCoupling

    def _drive(self, qpos: list[float], qvel: list[float], command: float) -> tuple[list[float], float]:
        """Return the torque on load and rotor, and the magnitude that shows divergence [N m]."""
        motor_torque = self.controller.kp * (command - qpos[0]) - self.controller.kd * qvel[0]
        coupling_torque = self.drive.coupling(qpos[1] - qpos[0], qvel[1] - qvel[0])
        rotor_torque = motor_torque - coupling_torque - self.drive.friction(qvel[1])
        limiting_torque = abs(rotor_torque) * max(1.0, LIGHT / self.drive.rotor_inertia)
        return [coupling_torque, rotor_torque], max(abs(coupling_torque), limiting_torque)

    def _spec(self) -> mujoco.MjSpec:
        """Return the bench with an added balanced rotor, which gravity does not turn."""
        spec = super()._spec()
        axis = spec.joints[0].axis.copy()
        rotor = spec.worldbody.add_body(name="rotor", mass=1.0, inertia=3 * [self.drive.rotor_inertia])
        rotor.explicitinertial = True
        rotor.add_joint(name="rotor", type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis)
        return spec
