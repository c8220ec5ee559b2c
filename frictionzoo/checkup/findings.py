"""What a check-up finds: of which kind, how sure, in words; and what becomes of it."""

from collections.abc import Iterable
from typing import Any, NamedTuple

from frictionzoo.core.errors import ConfigError, LogError, closest

CHECKUPS = ("strict", "warn")
"""What becomes of what is certainly wrong: it is refused, or told as all that is only likely is."""


class Repair(NamedTuple):
    """An option that mends what a finding says.

    Attributes:
        option: Its name.
        value: Its new value, or the factor of the present one.
        joint: Index of the joint whose entry it is; None for all joints.
        is_factor: Whether `value` is a factor of the present value.
    """

    option: str
    value: Any
    joint: int | None = None
    is_factor: bool = False


Said = tuple[str, bool, str] | tuple[str, bool, str, tuple[Repair, ...]]
"""Kind, certainty, text and repairs of a finding, of whichever recording and joint."""


class Doubt(NamedTuple):
    """A sentence on what is likely to be wrong, with the options that mend it.

    Attributes:
        text: The sentence.
        repairs: All of them are needed; empty where nobody but the user can tell.
    """

    text: str
    repairs: tuple[Repair, ...] = ()


class Finding(NamedTuple):
    """Something that speaks against a recording, or against the bench that it is to be simulated on.

    Attributes:
        kind: What it is, the same in all recordings.
        certain: Whether it cannot be right; else it is only likely to be wrong.
        text: A sentence: what came, what was expected, and the option that mends it.
        log: Name of the recording; empty where it is in all of them together.
        joint: Name of the joint; empty where it is of none in particular.
        repairs: Options that mend it, all of them; empty where `text` leaves a choice.
    """

    kind: str
    certain: bool
    text: str
    log: str = ""
    joint: str = ""
    repairs: tuple[Repair, ...] = ()

    @classmethod
    def of(cls, said: Said, log: str, joint: str = "") -> "Finding":
        """Return what was said of a recording's joint, of one or of no joint in particular."""
        return cls(*said[:3], log, joint, said[3] if len(said) > 3 else ())


def say_sign(joint: int, count: int) -> str:
    """The value of an option of `data.sign` that turns all of so many joints, and in brackets that of one alone."""
    alone = ",".join("-1" if number == joint else "1" for number in range(count))
    return "-1" if count == 1 else f"-1 (for this joint only: [{alone}])"


def turn(joint: int, *signals: str) -> tuple[Repair, ...]:
    """Return the options that turn these signals of a joint round."""
    return tuple(Repair(f"data.sign.{signal}", -1, joint, is_factor=True) for signal in signals)


def identify_delay(lag: float) -> tuple[Repair, ...]:
    """Return the options that let a delay of up to one and a half times this lag [s] be identified."""
    return Repair("bench.params.delay.identify", True), Repair("bench.params.delay.high", float(f"{1.5 * lag:.2g}"))


def settle(findings: Iterable[Finding], checkup: str, count: int) -> list[Doubt]:
    """Refuse what is certain, and return the rest, each kind once a joint.

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
            raise LogError(f"{_say(finding)}; if the recording is correct, set checkup=warn")
        told.setdefault((finding.kind, finding.joint), (finding, set()))[1].add(finding.log)
    return [
        Doubt(_say(first) + (f" ({len(logs)} of {count} logs)" if count > 1 and first.log else ""), first.repairs)
        for first, logs in told.values()
    ]


def _say(finding: Finding) -> str:
    return f"{finding.log}: {finding.text}" if finding.log else finding.text
