"""Words of headers: which of them speak of a signal, which say nothing, and how a header splits into them.

This is the one place that knows the prefixes and suffixes of signals, such as `q_`, `dq_`, `tau_`, `_pos`, `_velocity`.
"""

import re
from collections.abc import Sequence

# The most telling first: a goal_position is a command, and torque_enable no torque.
COMMANDED = "goal cmd target ctrl command commands commanded reference ref setpoint desired des action u ff feedforward"
VELOCITY = "dq qd qvel vel velocity velocities speed omega qdot dot"
POSITION = "q qpos pos position positions angle angles theta state qm"
EFFORT = "torque torques tau tor trq effort efforts current voltage pwm duty vir force"
SIGNAL_WORDS = (
    ("kp", "kp"),
    ("kd", "kd"),
    ("enable", "enable enabled"),
    ("temperature", "temp temperature"),
    ("supply", "volts vin vbus supply battery"),
    ("ctrl", COMMANDED),
    ("time", "t time timestamp timestamps stamp clock seconds"),
    ("qvel", VELOCITY),
    ("qpos", POSITION),
    ("effort", EFFORT),
)
TORQUE = frozenset(("torque", "torques", "tau", "tor", "trq", "effort", "efforts"))
MEASURED = frozenset(("est", "estimated", "meas", "measured", "actual", "act", "sensor"))
ACCELERATION = frozenset(("acc", "accel", "acceleration", "accelerations", "ddq", "qdd", "qacc", "ddot", "qddot"))
GENERIC = frozenset(("joint", "joints", "jnt", "motor", "motors", "actuator", "actuators", "servo"))
"""Words of joints' names that tell no joint from another."""
SILENT = GENERIC | frozenset(("states", "observation", "data", "value", "values", "robot", "raw", "rad", "deg", "nm"))
"""Words of headers that tell no joint and no signal."""
KNOWN = frozenset(word for _, words in SIGNAL_WORDS for word in words.split()) | MEASURED | ACCELERATION | SILENT
_JOINED = re.compile(r"(q|dq|qd|tau|tor|pos|vel)(cmd|des|ref|ff|est|meas)")  # a word of two: qcmd
_CAMEL = re.compile(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")


def split(text: str) -> list[str]:
    """Return the words and numbers of a header or a joint's name in lower case: `qpos_FLHip[07]` has four.

    Words end where a separator, a number, or a capital of CamelCase follows. Numbers have no leading zeros.
    """
    parts = [part for run in re.findall(r"[^\W\d_]+|\d+", text) for part in _CAMEL.split(run)]
    return [str(int(part)) if part.isdecimal() else part.casefold() for part in parts]


def list_words(parts: Sequence[str]) -> list[str]:
    """Return the words among what `split` gives, with `qcmd` as two and `d q` as one."""
    words: list[str] = []
    for part in parts:
        joined = _JOINED.fullmatch(part)
        if part == "q" and words[-1:] == ["d"]:
            words[-1] = "dq"
        elif not part.isdecimal():
            words += joined.groups() if joined else (part,)
    return words


def find_signal(words: Sequence[str]) -> tuple[str, int] | None:
    """Return the signal of which words speak and how plainly, the lower the number, the plainer; None for none.

    `effort` is a torque or what stands for one, which is a command or a measurement.
    """
    said = {*words}
    if said & ACCELERATION:
        return None
    for place, (signal, telling) in enumerate(SIGNAL_WORDS):
        if said.isdisjoint(telling.split()) or (signal in ("qpos", "kp", "kd") and said & TORQUE):
            continue  # state.tau_est is no position, torKdEst no gain
        found = _find_commanded(said) if telling is COMMANDED else signal
        # Of several commands, one that speaks of a position is the desired position.
        vague = found == "ctrl" and said.isdisjoint(POSITION.split())
        return (found, 10 * place + len(words) + 5 * vague) if found else None
    return None


def _find_commanded(words: set[str]) -> str | None:
    """Return what a command is a command of; None where it is fed forward and does not say what it is."""
    if not words.isdisjoint(VELOCITY.split()):
        return "ctrl_velocity"
    if TORQUE & words:
        return "ctrl_torque"
    return None if words & {"ff", "feedforward"} else "ctrl"
