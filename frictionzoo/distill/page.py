"""`report.html` of a student: the page of its run, with a comparison to the teacher."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from frictionzoo.comparison.record import FEW, count_identified
from frictionzoo.comparison.runs import Run
from frictionzoo.core.output import write_atomically
from frictionzoo.result.identified import Identified
from frictionzoo.result.types import Result
from frictionzoo.show.page import Check
from frictionzoo.show.replay import record_replay
from frictionzoo.show.run_page import FILES, LINKS, render_run
from frictionzoo.show.text import format_change, format_number

_GRADES = {
    "better": "Yes, better than its teacher",
    "noise": "Yes, as good as its teacher within noise",
    "worse": "Worse than its teacher by more than noise",
}


def write_page(path: Path, student: Identified, teacher: Run, note: Mapping[str, Any]) -> None:
    """Write the page of a student.

    Args:
        path: Path of the page, in the student's folder.
        student: The drive with the simpler model.
        teacher: The run of the teacher.
        note: Content of `distillation.json`.

    Raises:
        OutputError: The page cannot be written.
    """
    replay = record_replay(student.bench, student.values["bench"], student.curves, student.segments.timestep)
    page = render_run(
        path.parent,
        student.result,
        student.curves,
        replay,
        teacher,
        template="distill/distillation.html.jinja",
        links={**LINKS, "verdict": "Good enough?", "trust": "Limits"},
        headline=_say_headline(student.result, teacher.result),
        grade=_grade(student.result, note),
        answers=list(check_student(student.result, teacher, note)),
        inherited=[_say_inherited(teacher.result)],
        differences=note["differences"],
        files=_list_files(path.parent),
    )
    write_atomically(path, page)


def _list_files(folder: Path) -> dict[str, str]:
    files = {"distillation.json": "how far student and teacher are apart, for programs", **FILES}
    return {name: text for name, text in files.items() if (folder / name).exists()}


def _say_headline(student: Result, teacher: Result) -> str:
    """Describe the student's error, and its change from the teacher's error and from the error without friction."""
    own, baseline = student["metrics"]["test"], student["metrics"]["baseline"]
    if own["position_mae"] is None:
        return f"All {own['rollouts']} test rollouts of {own['horizon']:g} s diverged: there is no error to report."
    text = (
        f"Mean position error {format_number(own['position_mae'])} {own['unit']} over {own['rollouts']} open-loop "
        f"rollouts of {own['horizon']:g} s on held-out recordings"
    )
    others = {teacher["model"]: teacher["metrics"]["test"], "no friction": baseline}
    said = [
        f"{change} to {name} ({format_number(other['position_mae'])} {own['unit']})"
        for name, other in others.items()
        if (change := format_change(own["position_mae"], other["position_mae"]))
    ]
    return f"{text}: {', '.join(said)}." if said else f"{text}."


def _grade(student: Result, note: Mapping[str, Any]) -> str:
    own, baseline = (student["metrics"][part]["position_mae"] for part in ("test", "baseline"))
    if own is None or (baseline and own >= baseline):
        return "No, no better than no friction"
    return _GRADES[note["error"]["verdict"]]


def check_student(student: Result, teacher: Run, note: Mapping[str, Any]) -> Iterator[Check]:
    """Yield the checks whether a student is good enough.

    Args:
        student: Content of its `result.json`.
        teacher: The run of the teacher.
        note: Content of `distillation.json`.
    """
    yield _check_teacher(student, teacher.result, note["error"])
    yield _check_gain(student, teacher.result)
    numbers = [count_identified(each) for each in (student, teacher.result)]
    said = f"{numbers[0]} identified value{'s' * (numbers[0] != 1)} in place of {numbers[1]}."
    yield Check("good" if numbers[0] <= numbers[1] else "caution", "Simpler", " ".join([said, *note["notes"]]))


def _check_teacher(student: Result, teacher: Result, error: Mapping[str, Any]) -> Check:
    """Compare the student's error with the teacher's, with a confidence interval."""
    title, taught = "Beside its teacher", teacher["metrics"]["test"]["position_mae"]
    unit, rollouts = student["metrics"]["test"]["unit"], student["metrics"]["test"]["rollouts"]
    if not taught or None in (error["mean"], error["low"], error["high"]):
        return Check("caution", title, "Their test errors cannot be compared: one has none.")
    mean, low, high = (f"{100 * error[end] / taught:+.2g}".replace("-", "−") for end in ("mean", "low", "high"))
    text = (
        f"Its test error differs by {error['mean']:+.2g} {unit}, {mean} % of the teacher's (95 % interval "
        f"{low} to {high} %, paired over {rollouts} rollouts): "
    )
    text += {
        "better": "it is better by more than noise.",
        "noise": "that is within noise, or less than would matter.",
        "worse": "it is worse by more than noise. Whether that is too much, your simulator's use decides.",
    }[error["verdict"]]
    few = f" {rollouts} rollouts are few to tell." if rollouts < FEW else ""
    return Check("caution" if error["verdict"] == "worse" else "good", title, text + few)


def _check_gain(student: Result, teacher: Result) -> Check:
    """Compute the share of the teacher's gain over no friction that the student keeps."""
    title, baseline = "Beside no friction", student["metrics"]["baseline"]["position_mae"]
    own, taught = (run["metrics"]["test"]["position_mae"] for run in (student, teacher))
    if own is None or not baseline:
        return Check("bad" if own is None else "note", title, "There are no test errors to compare.")
    if own >= baseline:
        return Check("bad", title, "Its test error is no smaller than without friction.")
    text = f"Its test error is {baseline / own:.3g} times smaller than without friction"
    if taught is None or taught >= baseline:
        return Check("good", title, f"{text}.")
    kept = 100 * (baseline - own) / (baseline - taught)
    return Check("good", title, f"{text}: it keeps {kept:.3g} % of what its teacher gains.")


def _say_inherited(teacher: Result) -> Check:
    """Repeat the verdict on the teacher, since the student inherits its errors."""
    verdict = teacher["verdict"]
    count = len(verdict["findings"])
    text = "It follows the motion of its teacher, not the recordings: what its teacher lacks, it lacks too. "
    text += f"Of the teacher's run it is said: {verdict['grade']}"
    text += f", {count} finding{'s' * (count > 1)}." if count else "."
    return Check("caution" if count else "note", "Its teacher", text)
