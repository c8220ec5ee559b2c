"""Vocabulary of column headers: words that name signals, words without meaning, and the split of headers into words.

Only this module knows the prefixes and suffixes of signals, such as `q_`, `dq_`, `tau_`, `_pos`, `_velocity`.
"""

import re
from collections.abc import Sequence

# Ordered by precedence: goal_position is a command, torque_enable is not a torque.
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
"""Words of joint names that do not distinguish joints."""
SILENT = GENERIC | frozenset(("states", "observation", "data", "value", "values", "robot", "raw", "rad", "deg", "nm"))
"""Words of headers that name neither a joint nor a signal."""
KNOWN = frozenset(word for _, words in SIGNAL_WORDS for word in words.split()) | MEASURED | ACCELERATION | SILENT
_JOINED = re.compile(r"(q|dq|qd|tau|tor|pos|vel)(cmd|des|ref|ff|est|meas)")  # two words in one, such as qcmd
_CAMEL = re.compile(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")


def split(text: str) -> list[str]:
    """Split a header or joint name into lower-case words and numbers: `qpos_FLHip[07]` gives four parts.

    Separators, numbers and the capitals of CamelCase end a word. Numbers lose leading zeros.
    """
    parts = [part for run in re.findall(r"[^\W\d_]+|\d+", text) for part in _CAMEL.split(run)]
    return [str(int(part)) if part.isdecimal() else part.casefold() for part in parts]


def list_words(parts: Sequence[str]) -> list[str]:
    """Return the words among the parts from `split`, with `qcmd` as two words and `d q` as one."""
    words: list[str] = []
    for part in parts:
        joined = _JOINED.fullmatch(part)
        if part == "q" and words[-1:] == ["d"]:
            words[-1] = "dq"
        elif not part.isdecimal():
            words += joined.groups() if joined else (part,)
    return words


def find_signal(words: Sequence[str]) -> tuple[str, int] | None:
    """Return the signal that words name, and a rank (lower is clearer); None if they name no signal.

    `effort` stands for a torque, force, current, voltage or PWM value, commanded or measured.
    """
    present = {*words}
    if present & ACCELERATION:
        return None
    for place, (signal, signal_words) in enumerate(SIGNAL_WORDS):
        if present.isdisjoint(signal_words.split()) or (signal in ("qpos", "kp", "kd") and present & TORQUE):
            continue  # state.tau_est is not a position, torKdEst not a gain
        name = _find_commanded(present) if signal_words is COMMANDED else signal
        # A header with a position word is preferred as the position command.
        vague = name == "ctrl" and present.isdisjoint(POSITION.split())
        return (name, 10 * place + len(words) + 5 * vague) if name else None
    return None


def _find_commanded(words: set[str]) -> str | None:
    """Return the signal of a command; None for a feed-forward term of unknown quantity."""
    if not words.isdisjoint(VELOCITY.split()):
        return "ctrl_velocity"
    if TORQUE & words:
        return "ctrl_torque"
    return None if words & {"ff", "feedforward"} else "ctrl"
