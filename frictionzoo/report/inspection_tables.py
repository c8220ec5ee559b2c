"""Tables and verdict on the recordings of a data set, for the terminal and the page."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from frictionzoo.diagnostics.survey_findings import SEVERITY, split_title

CHECKS = {
    "Spikes": ("spikes", "spikes", 1.0),
    "Resolution": ("step [{small}]", "position_quantum.median", 1e3),
    "Wrap": ("period", "wrap.median", 1.0),
    "Units": ("units", None, 1.0),
    "Velocity": ("lag [ms]", "velocity_lag.median", 1e3),
    "Command": ("delay [ms]", "delay.seconds", 1e3),
    "Excitation": ("slow [%]", "slow.share", 100.0),
    "Rest": ("rest [%]", "rest.median", 100.0),
    "Direction": ("reverse [%]", "rarer", 100.0),
    "Saturation": ("limit [%]", "saturated.median", 100.0),
}
"""Checks of a joint and its command: heading, key of the value in the joint's entry, and factor of its unit."""

Row = tuple[str, str, str, str, str]


class Cell(NamedTuple):
    """Result of one check of one joint: the worst state of its findings, the value, and the findings' texts."""

    state: str
    value: str
    text: str


class Column(NamedTuple):
    """Results of one check, one cell per joint."""

    heading: str
    cells: list[Cell]

    @property
    def differs(self) -> bool:
        """Whether a joint has a finding other than a passed check, and joints differ; else one sentence says it all."""
        return len({*self.cells}) > 1 and any(cell.state != "good" for cell in self.cells)


def judge(survey: Mapping[str, Any]) -> str:
    """Return a verdict on the recordings: the checks that found a problem, and those that no option solves."""
    checks, problems, unsolved = (dict[str, None]() for _ in range(3))
    for finding in survey["findings"]:
        check = split_title(finding["title"])[0]
        checks[check] = None
        if finding["state"] in ("caution", "bad"):
            (problems if finding["option"] else unsolved)[check] = None
    if not problems | unsolved:
        return "No problems found: use these recordings without changes."
    text = f"{len(problems | unsolved)} of {len(checks)} checks found a problem."
    text += f" Solved by the options below: {', '.join(problems)}." if problems else ""
    return text + (f" Not solved by an option: {', '.join(unsolved)}." if unsolved else "")


def tabulate_checks(survey: Mapping[str, Any]) -> list[Column]:
    """Return the results of the checks of single joints that have a finding, one column per check."""
    findings: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for finding in survey["findings"]:
        findings.setdefault(split_title(finding["title"]), []).append(finding)
    commands = {command["name"]: command for command in survey["commands"]}
    joints = [{"saturated": None} | commands.get(joint["name"], {}) | joint for joint in survey["joints"]]
    columns = list[Column]()
    for check, (heading, key, factor) in CHECKS.items():
        found = [findings.get((check, joint["name"]), []) for joint in joints]
        if any(found):
            values = [_read(joint | {"rarer": min(joint["forward"], joint["backward"])}, key) for joint in joints]
            cells = [_judge_cell(*pair, factor) for pair in zip(found, values, strict=True)]
            columns.append(Column(heading.format(small=_say_small_unit(survey)), cells))
    return columns


def _judge_cell(findings: Sequence[Mapping[str, Any]], value: float | int | None, factor: float) -> Cell:
    state = min((finding["state"] for finding in findings), key=SEVERITY.index, default="good")
    return Cell(state, format_short(value, factor), " ".join(finding["text"] for finding in findings))


def _read(entry: Any, key: str | None) -> Any:
    for part in key.split(".") if key else ():
        entry = entry and entry[part]
    return entry if key else None


def format_short(value: float | int | None, factor: float = 1.0) -> str:
    """Format a multiple of a value with two digits, or all digits of its whole part; empty for None."""
    if value is None:
        return ""
    return f"{factor * value:.0f}" if abs(factor * value) >= 99.5 else f"{factor * value:.2g}"


def list_quantities(survey: Mapping[str, Any], joint: str | None = None) -> Iterator[Row]:
    """Yield rows of the table of quantities: name, lowest, median and highest over the recordings, unit.

    They describe a joint and its command; for None, the clock, the supply, and commands without a joint.
    """
    if joint is None:
        yield from _row("sample interval", survey["timing"]["interval"], "ms", 1e3)
        yield from _row("intervals off by more than 5 %", survey["timing"]["jitter"], "%", 100.0)
    for entry in survey["joints"]:
        if entry["name"] == joint:
            yield from _list_joint(entry, survey)
    names = {entry["name"] for entry in survey["joints"]}
    for command in survey["commands"]:
        if command["name"] == joint or (joint is None and command["name"] not in names):
            suffix = "" if joint else f" {command['name']}"
            yield _bounds(f"command{suffix}", command["range"], "")
            yield from _row(f"command at a limit{suffix}", command["saturated"], "%", 100.0)
    if joint is None and survey["supply"]:
        yield from _row("supply, measured", survey["supply"]["measured"], "V", 1.0)


def _list_joint(joint: Mapping[str, Any], survey: Mapping[str, Any]) -> Iterator[Row]:
    units = survey["units"]
    yield _bounds("position", joint["position"], units["position"])
    yield _bounds("velocity", joint["velocity"], units["velocity"])
    yield from _row("position quantum", joint["position_quantum"], _say_small_unit(survey), 1e3)
    yield from _row("velocity lag", joint["velocity_lag"], "ms", 1e3)
    yield from _row("at rest", joint["rest"], "%", 100.0)
    if delay := joint["delay"]:
        values = {"low": delay["low"], "median": delay["seconds"], "high": delay["high"]}
        yield from _row("command delay, quartiles", values, "ms", 1e3)


def _say_small_unit(survey: Mapping[str, Any]) -> str:
    return " or ".join(f"m{unit}" for unit in survey["units"]["position"].split(" or "))


def _row(name: str, spread: Mapping[str, float] | None, unit: str, factor: float) -> Iterator[Row]:
    if spread is not None:
        low, median, high = (f"{factor * spread[key]:.4g}" for key in ("low", "median", "high"))
        yield name, low, median, high, unit


def _bounds(name: str, bounds: Sequence[float], unit: str) -> Row:
    return name, f"{bounds[0]:.4g}", "", f"{bounds[1]:.4g}", unit
