"""Play between motor and load, joined by a stiff coupling: a drive of two inertias."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Values, register_model

_NEARLY_UNLOADED = 1e-3  # share of the rounding's torque below which a settled rotor floats, for a finite gradient


@register_model("backlash")
class Backlash(FrictionModel):
    """A rotor that turns the load through a coupling with play.

    J dw/dt = tau - F w / sqrt(w^2 + v_0^2) - b w - c,  dx/dt = w - v
    c = k dead(x) + d dead'(x) (w - v)
    torque = tau - c: of the motor's torque, c reaches the load

    dead(x) = 0  for |x| <= (1 - s) g / 2, where the rotor moves freely
    dead(x) = sign(x) (|x| - g / 2)  for |x| >= (1 + s) g / 2
    dead(x) = sign(x) (|x| - (1 - s) g / 2)^2 / (2 s g)  in between, for slopes everywhere

        v    velocity of the load, which is the bench's joint [rad/s or m/s]
        tau  torque of the actuator, which acts on the rotor [N m or N]
        x    angle of the rotor ahead of the load, w velocity of the rotor: the law's memory [rad or m, rad/s or m/s]
        c    torque of the coupling [N m or N]
        J    rotor_inertia [kg m^2 or kg], seen from the load
        g    gap [rad or m], the whole play from contact to contact
        k    stiffness [N m/rad or N/m] of the coupling
        d    coupling_damping [N m s/rad or N s/m], in contact only
        F    frictionloss [N m or N], dry friction of the rotor
        b    damping [N m s/rad or N s/m], viscous friction of the rotor
        v_0  smoothing_velocity [rad/s or m/s], over which dry friction changes its sign; known
        s    smoothing [1], share of the play over which contact sets in; known

    The measured position is the load's, behind the play. The bench's `armature` is then what moves with the load
    besides the bench's bodies; the motor's inertia is the rotor's. Through a stiff coupling without play, or in contact
    throughout, both move as one and no recording tells one from the other: they are then reported as indistinct. A
    recording in which the coupling's torque never changes its sign does not know the gap.

    A rollout begins in steady motion: the rotor as fast as the load, in contact on the side to which the motor pushes.
    A step is implicit in the coupling, for the rotor as for the load, which gets its part by way of MuJoCo's implicit
    damping: no stiffness makes it unstable. At constant velocity the law is F v / sqrt(v^2 + v_0^2) + b v.

    Of a drive that is just accelerating or crossing the gap that beginning is wrong by up to the gap, for some
    oscillations of the coupling: segments have to be much longer, or the gap is found too small, as in
    `data=two_inertia model=backlash fit=lm segments.length=1500 segments.count=40`. `recipe=auto` chooses 5 s, or a
    tenth of the recordings where that is less: record a minute or more. Of a drive that rattled, in a simulation whose
    damper never pulls, half the gap was found all the same, outside its interval. The loss has another minimum, with
    a gap near its lower bound and part of the load's inertia given to the rotor; intervals there are as narrow as
    elsewhere, for they speak of that minimum only. Start with `rotor_inertia`, `stiffness` and `armature` near what the
    data sheet says, vary `model.params.gap.init`, and take the lowest loss. Noise in the first states costs most in
    `stiffness` and `coupling_damping`, which takes up the rounding as well. `bench.timestep` makes the step smaller
    with which contacts begin and end.

    Cannot represent: sticking (the rotor's dry friction is 0 at w = 0, so a loaded rotor creeps), friction of the load,
    friction that depends on direction, load or position, a gap that depends on position, an impact that loses no
    energy. The damper may pull at the very end of a contact.

    Source: M. Nordin, P.-O. Gutman, "Controlling mechanical systems with backlash - a survey", Automatica 38(10), 2002,
    section 2, the dead-zone model; A. Lagerberg, B. Egardt, "Backlash estimation with application to automotive
    powertrains", IEEE Transactions on Control Systems Technology 15(3), 2007. Rounding and step are this package's.
    """

    dimensions = {
        "rotor_inertia": "inertia",
        "gap": "position",
        "stiffness": "stiffness",
        "coupling_damping": "damping",
        "frictionloss": "torque",
        "damping": "damping",
        "smoothing_velocity": "velocity",
        "smoothing": "1",
    }
    contains = {"mujoco_default": {"rotor_inertia": 0.0, "gap": 0.0, "stiffness": float("inf")}}
    valleys = {"gap": (0.1, 10.0), "rotor_inertia": (0.1, 10.0)}
    dissipative = True
    sees = ("speed", "reversal")
    memory = 3
    shortest_segment = 5.0

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """The rotor's friction, with rotor and load at one velocity."""
        return FrictionTerms(torque=_drag(xp, values, state.qvel) * state.qvel)

    def settle(self, xp: Any, values: Values, state: DriveState) -> Any:
        """Rotor ahead of the load, its velocity, and the motor's torque, in steady motion."""
        passed = state.motor_torque - _drag(xp, values, state.qvel) * state.qvel
        ahead = _invert_dead_zone(xp, values, passed / values["stiffness"])
        return xp.stack([ahead, state.qvel, state.motor_torque], -1)

    def advance(
        self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> tuple[FrictionTerms, Any]:
        """The coupling's torque at the end of the step, when the load has the velocity that the step gives it."""
        # The step before ends here: only now is the load's velocity known, and with it the rotor's.
        ahead, rotor, motor_torque = (memory[..., i] for i in range(3))
        push, rate, inertia, alone = _couple(xp, values, ahead, rotor, timestep)
        rotor = (inertia * rotor + motor_torque - push + rate * state.qvel) / (alone + rate)
        ahead = ahead + timestep * (rotor - state.qvel)

        push, rate, inertia, alone = _couple(xp, values, ahead, rotor, timestep)
        # Of push + rate (w - v) with the rotor's velocity w at the step's end, v is left to MuJoCo.
        coupled = (alone * push + rate * (inertia * rotor + state.motor_torque)) / (alone + rate)
        terms = FrictionTerms(torque=state.motor_torque - coupled, damping=rate * alone / (alone + rate))
        return terms, xp.stack([ahead, rotor, state.motor_torque], -1)


def _drag(xp: Any, values: Values, velocity: Any) -> Any:
    """The rotor's friction per velocity [N m s/rad or N s/m]."""
    speed = xp.sqrt(xp.square(velocity) + xp.square(values["smoothing_velocity"]))
    return values["damping"] + values["frictionloss"] / speed


def _couple(xp: Any, values: Values, ahead: Any, rotor: Any, timestep: float) -> tuple[Any, Any, Any, Any]:
    """What a step implicit in the velocities at its end, w of the rotor and v of the load, comes down to.

    The coupling passes on push + rate (w - v), and alone w + push + rate (w - v) = inertia rotor + motor torque, with
    push [N m or N]; rate, inertia and alone [N m s/rad or N s/m].
    """
    bend, contact = _dead_zone(xp, values, ahead)
    rate = contact * (values["stiffness"] * timestep + values["coupling_damping"])
    inertia = values["rotor_inertia"] / timestep
    return values["stiffness"] * bend, rate, inertia, inertia + _drag(xp, values, rotor)


def _dead_zone(xp: Any, values: Values, ahead: Any) -> tuple[Any, Any]:
    """By how much the coupling is bent [rad or m], and the slope of that, between 0 in the gap and 1 in contact."""
    edge = values["smoothing"] * values["gap"]
    depth = xp.abs(ahead) - (values["gap"] - edge) / 2
    depth = xp.where(depth > 0, depth, 0.0)
    rounded = xp.minimum(depth, edge)
    return xp.sign(ahead) * (xp.square(rounded) / (2 * edge) + depth - rounded), rounded / edge


def _invert_dead_zone(xp: Any, values: Values, bend: Any) -> Any:
    """Where the rotor is that bends the coupling by this much [rad or m]."""
    edge = values["smoothing"] * values["gap"]
    size, least = xp.abs(bend), _NEARLY_UNLOADED * edge / 2
    depth = xp.sqrt(2 * edge * xp.minimum(xp.maximum(size, least), edge / 2))
    ahead = (values["gap"] - edge) / 2 + depth + xp.maximum(size - edge / 2, 0 * size)
    return xp.where(size < least, bend / least, xp.sign(bend)) * ahead
