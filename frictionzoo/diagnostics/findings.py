"""Findings of checks of data and results, their repairs, and their conversion to warnings or errors."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from frictionzoo.core.errors import ConfigError, FaultError, closest

CHECKUPS = ("strict", "warn")
"""Treatment of definite faults: `strict` refuses them, `warn` reports them like likely ones."""


class Repair(NamedTuple):
    """An option that repairs a finding.

    Attributes:
        value: Its new value, or a factor on the current one if `is_factor`.
        joint: Index of the joint whose entry changes; None for all joints.
    """

    option: str
    value: Any
    joint: int | None = None
    is_factor: bool = False


@dataclass(frozen=True)
class Finding:
    """Outcome of one check of recordings, of their bench or of a result.

    Attributes:
        state: `good`; `note`; `caution` for a problem or a likely fault; `bad` for a severe problem or definite fault.
        title: What was checked, the same in all recordings.
        text: Outcome; of a fault the value, the expected value, and the option that repairs it.
        option: Option to add to the command line; None for none.
        log: Name of the recording; empty for all recordings together.
        joint: Name of the joint; empty for no joint in particular.
        repairs: Options that are all needed; empty if `text` leaves a choice.
    """

    state: str
    title: str
    text: str
    option: str | None = None
    log: str = ""
    joint: str = ""
    repairs: tuple[Repair, ...] = ()

    @property
    def doubtful(self) -> bool:
        """Whether the check found a problem."""
        return self.state in ("caution", "bad")

    @property
    def certain(self) -> bool:
        """Whether a fault is certain; else it is likely."""
        return self.state == "bad"


def of_joint(joints: Sequence[str], joint: int) -> str:
    """Return ` of NAME` for messages; empty on a bench with one joint."""
    return f" of {joints[joint]}" if len(joints) > 1 else ""


def say_sign(joint: int, count: int) -> str:
    """Return the value of a `data.sign` option that reverses all joints and, in brackets, one that reverses a joint."""
    alone = ",".join("-1" if number == joint else "1" for number in range(count))
    return "-1" if count == 1 else f"-1 (for this joint only: [{alone}])"


def turn(joint: int, *signals: str) -> tuple[Repair, ...]:
    """Return the options that reverse the sign of these signals of a joint."""
    return tuple(Repair(f"data.sign.{signal}", -1, joint, is_factor=True) for signal in signals)


def settle(findings: Iterable[Finding], checkup: str, count: int) -> list[Finding]:
    """Refuse definite faults if `strict`, and return the others, each kind once per joint.

    `findings` begin with the most important one; `count` is the number of recordings.

    Raises:
        FaultError: A fault is certain, and `checkup` is `strict`.
        ConfigError: `checkup` is not in `CHECKUPS`.
    """
    if checkup not in CHECKUPS:
        raise ConfigError(f"checkup={checkup}: unknown; {closest(str(checkup), CHECKUPS)}")
    groups: dict[tuple[str, str], tuple[Finding, set[str]]] = {}
    for finding in findings:
        text = f"{finding.log}: {finding.text}" if finding.log else finding.text
        if finding.certain and checkup == "strict":
            raise FaultError(f"{text}; if the recording is correct, set checkup=warn")
        groups.setdefault((finding.title, finding.joint), (replace(finding, text=text), set()))[1].add(finding.log)
    return [
        replace(first, text=f"{first.text} ({len(logs)} of {count} logs)") if count > 1 and first.log else first
        for first, logs in groups.values()
    ]
