"""Advice from a comparison: certainty of the ranking, use of the recommended run, next steps."""

import shlex
from typing import NamedTuple

from frictionzoo.core.output import RESULT
from frictionzoo.core.telling import say_percent
from frictionzoo.diagnostics.findings import Finding
from frictionzoo.report.run_page import find_target, list_uses
from frictionzoo.result.comparison.runs import Run
from frictionzoo.result.comparison.statistics import MATTERS
from frictionzoo.result.comparison.types import Comparison, Pair
from frictionzoo.result.names import name_some

MORE = 4  # factor on the number of rollouts; halves an interval
_RUN = ["python", "-m", "frictionzoo.run"]


class Step(NamedTuple):
    """Suggested next step: its purpose, and a shell command or Python call."""

    purpose: str
    command: str


def check_order(comparison: Comparison) -> Finding:
    """Finding whether the best run is better than the others by more than noise."""
    best, *others = (entry.label for entry in comparison.runs)
    if comparison.recommendation is None:
        return Finding("bad", "Ranking", "No ranking: every test rollout of every run diverged.")
    if not others:
        return Finding("note", "Ranking", "Only one run: nothing to compare.")
    pairs = _pairs_with_best(comparison)
    close = [label for label in others if pairs[label].verdict == "noise"]
    if close:
        text = f"Within noise of the best run, {best}: {name_some(close)}. These data show no relevant difference; "
        text += "the recommended run is the simplest, identifiable ones first."
        return Finding("note", "Ranking", text)
    text = f"{best} is better than every other run by more than noise. {_say_next(comparison)}"
    return Finding("good", "Ranking", text)


def _pairs_with_best(comparison: Comparison) -> dict[str, Pair]:
    best = comparison.runs[0].label
    return {pair.run: pair for pair in comparison.pairs if pair.other == best}


def _say_next(comparison: Comparison) -> str:
    best, second = comparison.runs[:2]
    pair, error = _pairs_with_best(comparison)[second.label], best.test.position_mae
    if not error or pair.mean is None or pair.low is None or pair.high is None:
        return f"More test rollouts of the second, {second.label}, diverged."
    ratios = [ratio / error for ratio in (pair.mean, pair.low, pair.high)]
    if ratios[0] < 1:
        mean, low, high = map(say_percent, ratios)
        return f"The error of the second, {second.label}, is {mean} larger (95 % interval {low} to {high})."
    mean, low, high = (f"{1 + ratio:.2g}" for ratio in ratios)
    return f"The error of the second, {second.label}, is {mean} times as large (95 % interval {low} to {high})."


def list_steps_to_use(run: Run, place: str) -> list[str]:
    """Return lines that use the recommended run: from its folder or, if not saved, from the result of `fz.compare`."""
    target = find_target(run.result)
    if (run.folder / RESULT).exists():
        return list_uses(place, target)
    return [
        "drive = compared.recommended  # compared = fz.compare(...)",
        "drive.parameters, drive.rollout()",
        *([f'drive.export("{target}", "export")'] if target else []),
        f'drive.save("{run.result.model}")',
    ]


def list_next_steps(comparison: Comparison, chosen: Run) -> list[Step]:
    """Return next steps: repair, compare with more rollouts, try another model, record again, inspect the data."""
    commands = {row.kind: row.command for row in reversed(chosen.result.verdict.commands)}
    command, steps = commands.get("law", ""), list[Step]()
    if repair := commands.get("repair"):
        steps.append(Step("Fix the problem found in its run", repair))
    if sweep := _judge_again(comparison, command):
        steps.append(Step("Compare the runs within noise on more rollouts", sweep))
    models = {entry.model for entry in comparison.runs}
    if command and not any(f" model={model} " in f"{command} " or f"bench, {model!r}" in command for model in models):
        steps.append(Step("Try another model", command))
    if recording := commands.get("recording"):
        steps.append(Step("Make another recording", recording))
    elif inspect := commands.get("inspect"):
        steps.append(Step("Inspect the recordings", inspect))
    return steps


def _judge_again(comparison: Comparison, command: str) -> str:
    """Return a sweep, with options of `command`, of runs within noise on more rollouts; empty if it cannot help."""
    best = comparison.runs[0]
    matters = MATTERS * (best.test.position_mae or 0.0)
    close = [label for label, pair in _pairs_with_best(comparison).items() if _is_open(pair, matters)]
    models = {entry.label: entry.model for entry in comparison.runs}
    words = shlex.split(command)
    # Two runs of one model differ in options that this command does not contain.
    if not close or words[:3] != _RUN or any(models[label] != label for label in (best.label, *close)):
        return ""
    options = [option for option in words[3:] if not option.startswith(("model=", "model.", "evaluation.rollouts="))]
    more = f"evaluation.rollouts={MORE * comparison.evaluation.rollouts}"
    return shlex.join([*_RUN, "-m", *options, f"model={','.join([best.label, *close])}", more])


def _is_open(pair: Pair, matters: float) -> bool:
    """Return whether more rollouts might reveal a relevant difference between two runs."""
    ends = [abs(end) for end in (pair.low, pair.high) if end is not None]
    return pair.verdict == "noise" and max(ends, default=0.0) > matters
