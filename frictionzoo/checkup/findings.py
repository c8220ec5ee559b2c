"""What a check-up finds: of which kind, how sure, in words; and what becomes of it."""

from collections.abc import Iterable
from typing import NamedTuple

from frictionzoo.core.errors import ConfigError, LogError, closest

CHECKUPS = ("strict", "warn")
"""What becomes of what is certainly wrong: it is refused, or told as all that is only likely is."""


class Finding(NamedTuple):
    """Something that speaks against a recording, or against the bench that it is to be simulated on.

    Attributes:
        kind: What it is, the same in all recordings.
        certain: Whether it cannot be right; else it is only likely to be wrong.
        text: A sentence: what came, what was expected, and the option that mends it.
        log: Name of the recording; empty where it is in all of them together.
        joint: Name of the joint; empty where it is of none in particular.
    """

    kind: str
    certain: bool
    text: str
    log: str = ""
    joint: str = ""


def say_sign(joint: int, count: int) -> str:
    """The value of an option of `data.sign` that turns all of so many joints, and in brackets that of one alone."""
    alone = ",".join("-1" if number == joint else "1" for number in range(count))
    return "-1" if count == 1 else f"-1 (of this joint alone: [{alone}])"


def settle(findings: Iterable[Finding], checkup: str, count: int) -> list[str]:
    """Refuse what is certain, and tell the rest, each kind once.

    Args:
        findings: In the order in which they matter.
        checkup: One of `CHECKUPS`.
        count: Of recordings.

    Raises:
        LogError: `strict`, and something is certainly wrong.
        ConfigError: There is no such way.
    """
    if checkup not in CHECKUPS:
        raise ConfigError(f"checkup={checkup}: unknown; {closest(str(checkup), CHECKUPS)}")
    told: dict[tuple[str, str], tuple[Finding, set[str]]] = {}
    for finding in findings:
        if finding.certain and checkup == "strict":
            raise LogError(f"{_say(finding)}; if it is right all the same, set checkup=warn")
        told.setdefault((finding.kind, finding.joint), (finding, set()))[1].add(finding.log)
    return [
        _say(first) + (f" ({len(logs)} of {count} logs)" if count > 1 and first.log else "")
        for first, logs in told.values()
    ]


def _say(finding: Finding) -> str:
    return f"{finding.log}: {finding.text}" if finding.log else finding.text
