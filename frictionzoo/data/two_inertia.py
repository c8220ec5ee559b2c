"""Simulated drive with backlash: separate motor and load joints, coupled through a known gap."""

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from frictionzoo.core.errors import ConfigError
from frictionzoo.data.signals import Signal
from frictionzoo.data.source import register_source
from frictionzoo.data.twin import States, Twin

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
        for name in ("rotor_inertia", "stiffness", "smoothing_velocity"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"data.drive.{name}={getattr(self, name):g}: expected a positive number")
        for name in ("armature", "gap", "coupling_damping", "frictionloss", "damping"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"data.drive.{name}={getattr(self, name):g}: expected 0 or more")

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

    def simulate(self, ctrl: Signal) -> tuple[States, States]:
        """Simulate true position [rad] and velocity [rad/s] of the load, see `Twin.simulate`."""
        model = self._spec().compile()
        data = mujoco.MjData(model)
        load, rotor = (model.joint(name).dofadr[0] for name in (model.joint(0).name, "rotor"))
        data.qpos[:] = ctrl[0]
        states = np.empty((self.samples, 2))
        for sample, command in enumerate(ctrl.tolist()):
            states[sample] = data.qpos[load], data.qvel[load]
            for _ in range(self.substeps):
                qpos, qvel = data.qpos.tolist(), data.qvel.tolist()
                motor_torque = self.controller.kp * (command - qpos[load]) - self.controller.kd * qvel[load]
                coupling_torque = self.drive.coupling(qpos[rotor] - qpos[load], qvel[rotor] - qvel[load])
                rotor_torque = motor_torque - coupling_torque - self.drive.friction(qvel[rotor])
                limiting_torque = abs(rotor_torque) * max(1.0, LIGHT / self.drive.rotor_inertia)
                self._refuse_divergence(max(abs(coupling_torque), limiting_torque), sample)
                data.qfrc_applied[load], data.qfrc_applied[rotor] = coupling_torque, rotor_torque
                mujoco.mj_step(model, data)
        return states[:, :1], states[:, 1:]

    def _spec(self) -> mujoco.MjSpec:
        """Return the bench with an added balanced rotor, which gravity does not turn."""
        spec = super()._spec()
        axis = spec.joints[0].axis.copy()
        rotor = spec.worldbody.add_body(name="rotor", mass=1.0, inertia=3 * [self.drive.rotor_inertia])
        rotor.explicitinertial = True
        rotor.add_joint(name="rotor", type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis)
        return spec
