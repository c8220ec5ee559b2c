"""What a comparison advises: how sure its order is, how the run to take is used, and what to do next."""

import shlex
from collections.abc import Sequence
from typing import NamedTuple

from frictionzoo.comparison.runs import Run
from frictionzoo.comparison.statistics import MATTERS
from frictionzoo.comparison.types import Comparison, PairRow
from frictionzoo.core.output import RESULT
from frictionzoo.core.telling import say_percent
from frictionzoo.result.verdict import is_usable
from frictionzoo.show.page import Check
from frictionzoo.show.run_page import list_uses

NAMED = 4  # runs that a sentence names, the others are counted
MORE = 4  # times as many rollouts halve an interval
_RUN = ["python", "-m", "frictionzoo.run"]


class Step(NamedTuple):
    """What may be done next.

    Attributes:
        purpose: What for.
        command: For a shell, or a call for Python.
    """

    purpose: str
    command: str


def name_runs(labels: Sequence[str]) -> str:
    """Names in a sentence."""
    return ", ".join(labels[:NAMED]) + (f" and {len(labels) - NAMED} more" if len(labels) > NAMED else "")


def check_order(comparison: Comparison) -> Check:
    """How sure it is which run is the best."""
    first, *others = (entry["label"] for entry in comparison["runs"])
    if comparison["recommendation"] is None:
        return Check("bad", "Order", "There is no order: every test rollout of every run diverged.")
    if not others:
        return Check("note", "Order", "There is one run: nothing to compare it with.")
    pairs = _pairs_with_best(comparison)
    close = [label for label in others if pairs[label]["verdict"] == "noise"]
    if close:
        text = (
            f"Within noise of the best, {first}: {name_runs(close)}. These data do not tell them apart by what matters"
        )
        return Check("note", "Order", f"{text}; the simplest is recommended.")
    return Check(
        "good", "Order", f"{first} is better than each of the others by more than noise. {_say_next(comparison)}"
    )


def _pairs_with_best(comparison: Comparison) -> dict[str, PairRow]:
    first = comparison["runs"][0]["label"]
    return {pair["run"]: pair for pair in comparison["pairs"] if pair["other"] == first}


def _say_next(comparison: Comparison) -> str:
    """How far the second is from the best."""
    best, second = comparison["runs"][:2]
    pair, error = _pairs_with_best(comparison)[second["label"]], best["test"]["position_mae"]
    if not error or pair["mean"] is None or pair["low"] is None or pair["high"] is None:
        return f"The next, {second['label']}, lost more test rollouts."
    more = [each / error for each in (pair["mean"], pair["low"], pair["high"])]
    if more[0] < 1:
        mean, low, high = map(say_percent, more)
        return f"The error of the next, {second['label']}, is {mean} larger (95 % interval {low} to {high})."
    mean, low, high = (f"{1 + each:.2g}" for each in more)
    return f"The error of the next, {second['label']}, is {mean} times as large (95 % interval {low} to {high})."


def list_steps_to_use(run: Run, place: str) -> list[str]:
    """How the run to take is used, by its folder, or as the object that `fz.compare` gave where it was not saved."""
    usable = is_usable(run.result)
    if (run.folder / RESULT).exists():
        return list_uses(place, usable)
    return [
        "drive = compared.recommended  # of what fz.compare gave",
        "drive.parameters, drive.rollout()",
        *(['drive.export("mjcf", "export")'] if usable else []),
        f'drive.save("{run.result["model"]}")',
    ]


def list_next_steps(comparison: Comparison, chosen: Run) -> list[Step]:
    """What to do after the comparison: tell apart what it could not, try what it has not, record, go on."""
    commands = {row["kind"]: row["command"] for row in reversed(chosen.result["verdict"]["commands"])}
    law, steps = commands.get("law", ""), list[Step]()
    if repair := commands.get("repair"):
        steps.append(Step("The repair of what its run found", repair))
    if again := _judge_again(comparison, law):
        steps.append(Step("To tell apart what these rollouts do not: more of them", again))
    tried = {entry["model"] for entry in comparison["runs"]}
    if law and not any(_names_law(law, model) for model in tried):
        steps.append(Step("A law that has what this one lacks, or does with less, and that is not among these", law))
    if recording := commands.get("recording"):
        steps.append(Step("The recording to make", recording))
    elif inspect := commands.get("inspect"):
        steps.append(Step("A look at the recordings", inspect))
    return steps


def _names_law(command: str, model: str) -> bool:
    return f" model={model} " in f"{command} " or f"bench, {model!r}" in command


def _judge_again(comparison: Comparison, command: str) -> str:
    """The sweep of the runs that are within noise of the best, on more rollouts; empty where that would change nothing.

    Args:
        comparison: The comparison.
        command: One of a single run, whose options it has.
    """
    best = comparison["runs"][0]
    matters = MATTERS * (best["test"]["position_mae"] or 0.0)
    close = [label for label, pair in _pairs_with_best(comparison).items() if _is_open(pair, matters)]
    models = {entry["label"]: entry["model"] for entry in comparison["runs"]}
    words = shlex.split(command)
    # What tells runs of one law apart is not among the options of a command.
    if not close or words[:3] != _RUN or any(models[label] != label for label in (best["label"], *close)):
        return ""
    options = [each for each in words[3:] if not each.startswith(("model=", "model.", "evaluation.rollouts="))]
    more = f"evaluation.rollouts={MORE * comparison['evaluation']['rollouts']}"
    return shlex.join([*_RUN, "-m", *options, f"model={','.join([best['label'], *close])}", more])


def _is_open(pair: PairRow, matters: float) -> bool:
    """Whether more rollouts might tell two runs apart by what matters."""
    ends = [abs(end) for end in (pair["low"], pair["high"]) if end is not None]
    return pair["verdict"] == "noise" and max(ends, default=0.0) > matters
