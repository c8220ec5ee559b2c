"""Findings of the diagnostics, their repairs, and their conversion to warnings or errors; checks of pages."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

from frictionzoo.core.errors import ConfigError, LogError, closest

CHECKUPS = ("strict", "warn")
"""Treatment of certain faults: `strict` refuses them, `warn` reports them like likely ones."""


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


class Doubt(NamedTuple):
    """A warning about a likely fault; all its repairs are needed, and there are none if the user has to decide."""

    text: str
    repairs: tuple[Repair, ...] = ()


class Finding(NamedTuple):
    """A fault of a recording, or of its bench.

    Attributes:
        kind: Kind of fault, the same in all recordings.
        certain: Whether the fault is certain; else it is likely.
        text: A sentence: value, expected value, and the option that repairs it.
        log: Name of the recording; empty for all recordings together.
        joint: Name of the joint; empty for no joint in particular.
        repairs: Options that are all needed; empty if `text` leaves a choice.
    """

    kind: str
    certain: bool
    text: str
    log: str = ""
    joint: str = ""
    repairs: tuple[Repair, ...] = ()


@dataclass(frozen=True)
class Check:
    """Outcome of one check of a result or of data, as pages and `inspect.json` list it.

    Attributes:
        state: `good`, `note`, `caution` or `bad`.
        text: Outcome in plain sentences.
        option: Option to add to the command line; None for none.
    """

    state: str
    title: str
    text: str
    option: str | None = None

    @property
    def doubtful(self) -> bool:
        """Whether the check found a problem."""
        return self.state in ("caution", "bad")


def say_sign(joint: int, count: int) -> str:
    """Return the value of a `data.sign` option that reverses all joints and, in brackets, one that reverses a joint."""
    alone = ",".join("-1" if number == joint else "1" for number in range(count))
    return "-1" if count == 1 else f"-1 (for this joint only: [{alone}])"


def turn(joint: int, *signals: str) -> tuple[Repair, ...]:
    """Return the options that reverse the sign of these signals of a joint."""
    return tuple(Repair(f"data.sign.{signal}", -1, joint, is_factor=True) for signal in signals)


def settle(findings: Iterable[Finding], checkup: str, count: int) -> list[Doubt]:
    """Refuse certain findings if `strict`, and return the others, each kind once per joint.

    `findings` begin with the most important one; `count` is the number of recordings.

    Raises:
        LogError: A finding is certain, and `checkup` is `strict`.
        ConfigError: `checkup` is not in `CHECKUPS`.
    """
    if checkup not in CHECKUPS:
        raise ConfigError(f"checkup={checkup}: unknown; {closest(str(checkup), CHECKUPS)}")
    groups: dict[tuple[str, str], tuple[Finding, set[str]]] = {}
    for finding in findings:
        if finding.certain and checkup == "strict":
            raise LogError(f"{_say(finding)}; if the recording is correct, set checkup=warn")
        groups.setdefault((finding.kind, finding.joint), (finding, set()))[1].add(finding.log)
    return [
        Doubt(_say(first) + (f" ({len(logs)} of {count} logs)" if count > 1 and first.log else ""), first.repairs)
        for first, logs in groups.values()
    ]


def _say(finding: Finding) -> str:
    return f"{finding.log}: {finding.text}" if finding.log else finding.text
