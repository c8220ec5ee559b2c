"""Backlash: motor and load as two inertias, connected by a stiff coupling with play."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Parameter, Values, register_model

_NEARLY_UNLOADED = 1e-3  # fraction of the smoothing's torque below which a settled rotor floats, for a finite gradient


@register_model("backlash")
class Backlash(FrictionModel):
    """Rotor and load as two inertias, connected by a stiff coupling with play.

    Use it for gears with play whose position is measured at the load, behind the play.

    Cannot represent: sticking (the rotor's dry friction is 0 at w = 0, so a loaded rotor creeps), friction of the load,
    friction that depends on direction, load or position, a gap that depends on position, impacts without energy loss.
    The damper may pull at the very end of a contact.

    J dw/dt = tau - F w / sqrt(w^2 + v_0^2) - b w - c,  dx/dt = w - v
    c = k dead(x) + d dead'(x) (w - v)
    torque = tau - c: only c reaches the load

    dead(x) = 0  for |x| <= (1 - s) g / 2, where the rotor moves freely
    dead(x) = sign(x) (|x| - g / 2)  for |x| >= (1 + s) g / 2
    dead(x) = sign(x) (|x| - (1 - s) g / 2)^2 / (2 s g)  in between, for slopes everywhere

        v    velocity of the load, which is the bench's joint [rad/s or m/s]
        tau  actuator torque, which acts on the rotor [N m or N]
        x    angle of the rotor relative to the load; with w, the model's memory [rad or m]
        w    velocity of the rotor [rad/s or m/s]
        c    torque of the coupling [N m or N]
        J    rotor_inertia [kg m^2 or kg], reflected to the load
        g    gap [rad or m], total play from contact to contact
        k    stiffness [N m/rad or N/m] of the coupling
        d    coupling_damping [N m s/rad or N s/m], in contact only
        F    frictionloss [N m or N], dry friction of the rotor
        b    damping [N m s/rad or N s/m], viscous friction of the rotor
        v_0  smoothing_velocity [rad/s or m/s], over which dry friction changes sign; known
        s    smoothing [1], fraction of the play over which contact sets in; known

    The bench's `armature` is the inertia that moves with the load in addition to the bench's bodies. The motor's
    inertia is part of `rotor_inertia`. If the coupling is stiff without play, or always in contact, both inertias move
    as one and the data cannot separate them; the run then reports them as indistinct. The gap is not identifiable if
    the torque of the coupling never changes sign.

    A rollout starts in steady motion: rotor and load have the same velocity and touch on the side to which the motor
    pushes. Each step is implicit in the coupling, for the load through MuJoCo's implicit damping, so it is stable at
    any stiffness. At constant velocity the friction is F v / sqrt(v^2 + v_0^2) + b v.

    If the drive accelerates or crosses the gap at that moment, this initial state is wrong by up to the gap, for some
    oscillations of the coupling. Segments must be much longer, otherwise the fit underestimates the gap. Example:
    `data=two_inertia model=backlash fit=lm segments.length=1500 segments.count=40`. `recipe=auto` chooses 5 s, or a
    tenth of the recordings if that is less: record a minute or more. For a simulated drive that
    rattled, without pull of the damper, the fit still found half the gap; its interval excluded the true value.

    The loss has another minimum, with a gap near its lower bound and a part of the load's inertia in the rotor.
    Intervals there are as narrow as elsewhere, because they describe that minimum only. Start with `rotor_inertia`,
    `stiffness` and `armature` near the data sheet's values, vary `model.params.gap.init`, and take the lowest loss.
    Noise in the initial states affects `stiffness` and `coupling_damping` most; `coupling_damping` also absorbs the
    effect of the smoothing. A smaller `bench.timestep` resolves the start and end of contacts more finely.

    Source: M. Nordin, P.-O. Gutman, "Controlling mechanical systems with backlash - a survey", Automatica 38(10), 2002,
    section 2, the dead-zone model; A. Lagerberg, B. Egardt, "Backlash estimation with application to automotive
    powertrains", IEEE Transactions on Control Systems Technology 15(3), 2007. The smoothing and the integration step
    are this package's.
    """

    physical_parameters = {
        "rotor_inertia": Parameter("inertia", 0.01, 1e-5, 1),
        "gap": Parameter("position", 0.01, 1e-4, 0.3),
        "stiffness": Parameter("stiffness", 100, 1, 100_000),
        "coupling_damping": Parameter("damping", 0.3, 1e-3, 100),
        "frictionloss": Parameter("torque", 0.03, 1e-4, 2, from_robot=True),
        "damping": Parameter("damping", 0.03, 1e-4, 10, from_robot=True),
        "smoothing_velocity": Parameter("velocity", 0.01, 0.001, 0.1, identify=False),  # a setting of the simulation
        "smoothing": Parameter("1", 0.1, 0.001, 0.9, identify=False),  # a setting of the simulation
    }
    contains = {"mujoco_default": {"rotor_inertia": 0.0, "gap": 0.0, "stiffness": float("inf")}}
    valleys = {"gap": (0.1, 10.0), "rotor_inertia": (0.1, 10.0)}
    dissipative = True
    sees = ("speed", "reversal")
    memory = 3
    shortest_segment = 5.0

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the rotor's friction, with rotor and load at the same velocity."""
        return FrictionTerms(torque=_drag(xp, values, state.qvel) * state.qvel)

    def settle(self, xp: Any, values: Values, state: DriveState) -> Any:
        """Return the rotor's angle relative to the load, its velocity, and the motor's torque, in steady motion."""
        passed = state.motor_torque - _drag(xp, values, state.qvel) * state.qvel
        ahead = _invert_dead_zone(xp, values, passed / values["stiffness"])
        return xp.stack([ahead, state.qvel, state.motor_torque], -1)

    def advance(
        self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> tuple[FrictionTerms, Any]:
        """Return the torque of the coupling at the end of the step, as a function of the load's velocity there."""
        # Complete the previous step: the rotor's final velocity depends on the load's, which is only known now.
        ahead, rotor, motor_torque = (memory[..., i] for i in range(3))
        push, rate, inertia, alone = _couple(xp, values, ahead, rotor, timestep)
        rotor = (inertia * rotor + motor_torque - push + rate * state.qvel) / (alone + rate)
        ahead = ahead + timestep * (rotor - state.qvel)

        push, rate, inertia, alone = _couple(xp, values, ahead, rotor, timestep)
        # Eliminate the rotor's final velocity w from push + rate (w - v); MuJoCo solves for v.
        coupled = (alone * push + rate * (inertia * rotor + state.motor_torque)) / (alone + rate)
        terms = FrictionTerms(torque=state.motor_torque - coupled, damping=rate * alone / (alone + rate))
        return terms, xp.stack([ahead, rotor, state.motor_torque], -1)


def _drag(xp: Any, values: Values, velocity: Any) -> Any:
    """Return the rotor's friction divided by its velocity [N m s/rad or N s/m]."""
    speed = xp.sqrt(xp.square(velocity) + xp.square(values["smoothing_velocity"]))
    return values["damping"] + values["frictionloss"] / speed


def _couple(xp: Any, values: Values, ahead: Any, rotor: Any, timestep: float) -> tuple[Any, Any, Any, Any]:
    """Return the coefficients of a step that is implicit in the final velocities w of the rotor and v of the load.

    The coupling torque is push + rate (w - v), and alone w + push + rate (w - v) = inertia rotor + motor torque, with
    push in [N m or N], and rate, inertia and alone in [N m s/rad or N s/m].
    """
    bend, contact = _dead_zone(xp, values, ahead)
    rate = contact * (values["stiffness"] * timestep + values["coupling_damping"])
    inertia = values["rotor_inertia"] / timestep
    return values["stiffness"] * bend, rate, inertia, inertia + _drag(xp, values, rotor)


def _dead_zone(xp: Any, values: Values, ahead: Any) -> tuple[Any, Any]:
    """Return the deflection of the coupling [rad or m] and its slope, from 0 in the gap to 1 in contact."""
    edge = values["smoothing"] * values["gap"]
    depth = xp.abs(ahead) - (values["gap"] - edge) / 2
    depth = xp.where(depth > 0, depth, 0.0)
    rounded = xp.minimum(depth, edge)
    return xp.sign(ahead) * (xp.square(rounded) / (2 * edge) + depth - rounded), rounded / edge


def _invert_dead_zone(xp: Any, values: Values, bend: Any) -> Any:
    """Return the angle of the rotor for a given deflection of the coupling [rad or m]."""
    edge = values["smoothing"] * values["gap"]
    size, least = xp.abs(bend), _NEARLY_UNLOADED * edge / 2
    depth = xp.sqrt(2 * edge * xp.minimum(xp.maximum(size, least), edge / 2))
    ahead = (values["gap"] - edge) / 2 + depth + xp.maximum(size - edge / 2, 0 * size)
    return xp.where(size < least, bend / least, xp.sign(bend)) * ahead
