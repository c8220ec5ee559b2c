"""`comparison.html`: runs side by side on one page, from the one to take down to the curves of each."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from frictionzoo import __version__
from frictionzoo.comparison.record import FEW
from frictionzoo.comparison.runs import Run
from frictionzoo.comparison.statistics import MATTERS
from frictionzoo.comparison.types import Comparison, DifferenceRow, RolloutsRow, RunRow
from frictionzoo.core.anonymous import list_paths_of, without_paths
from frictionzoo.core.output import RESULT, write_atomically
from frictionzoo.result.names import pick_value, read_values
from frictionzoo.result.verdict import is_usable, judge
from frictionzoo.show.colors import DARK
from frictionzoo.show.comparison_advice import check_order, list_next_steps, list_steps_to_use, name_runs
from frictionzoo.show.comparison_plots import Look, choose_looks, plot_comparison
from frictionzoo.show.page import Check, render_page
from frictionzoo.show.run_page import (
    METHODS,
    check_held_out,
    check_origin,
    check_result,
    correlate,
    list_timing,
    say_command,
)
from frictionzoo.show.run_plots import plot_history

POINTS = 2000  # of a curve; a comparison has many of them
LONG = 4  # differing options above which they are folded away
FITTED = ("fit", "segments", "loss", "bench")  # options that make fits unlike each other
FILES = {"comparison.json": "every number of this page, for programs", "table.tex": "the ranking as a LaTeX table"}
LINKS = {
    "verdict": "Which to take",
    "ranking": "How good is each",
    "trust": "What speaks for it",
    "runs": "Run by run",
    "errors": "How large, how sure",
    "rollout": "A rollout",
    "where": "Where the error is",
    "friction": "The laws",
    "parameters": "Parameters",
    "data": "Data",
    "files": "Files",
}
"""Sections by their id."""
STOPPED = {
    "converged": "converged",
    "finished": "all iterations made",
    "patience": "the loss fell no more",
    "diverged": "diverged",
}
VERDICTS = {"better": "better", "noise": "within noise", "worse": "worse"}


def write_page(path: Path, comparison: Comparison, runs: Sequence[Run]) -> None:
    """Write the page of a comparison into this file; it links to what lies beside it and to the runs' reports.

    Raises:
        OutputError: It cannot be written.
    """
    comparison, ranked, places, commands = _anonymise(comparison, runs)
    looks = choose_looks((run.label for run in ranked), comparison["reference"])
    rows = [_describe(i, run, comparison, looks[run.label], path.parent) for i, run in enumerate(ranked)]
    for row, command in zip(rows, commands, strict=True):
        row["command"] = command
    best = next((row for row in rows if row["recommended"]), None)
    order, *checks = check_comparison(comparison, ranked)
    # In the order of the page; the parameters of each run by themselves, under its place in the ranking.
    sections = {
        str(i): list(plot_history(run.result, run.curves, looks[run.label]["color"])) for i, run in enumerate(ranked)
    }
    sections |= {name: drawn for name, drawn in plot_comparison(comparison, ranked).items() if name != "parameters"}
    page = render_page(
        "show/comparison.html.jinja",
        sections,
        checks,
        POINTS,
        comparison=comparison,
        rows=rows,
        joints=tuple(comparison["joints"]),
        errors=list_errors_by_joint(comparison),
        worst=_find_worst(comparison["runs"][0]),
        matters=MATTERS,
        recommended=best,
        order=order,
        advice=None if best is None else _advise(comparison, ranked[best["index"]], places[best["index"]]),
        links=LINKS,
        parameters=list(_list_parameters(comparison["runs"])),
        folded=len(comparison["differences"]) > LONG,
        files=_list_files(path.parent),
        state={"labels": [*looks], "selected": best["index"] if best else 0},
        version=__version__,
    )
    write_atomically(path, page)


def _anonymise(
    comparison: Comparison, runs: Sequence[Run]
) -> tuple[Comparison, list[Run], list[str], list[str | None]]:
    """The same without absolute paths, the runs best first, their folders as somebody here may type them, and commands.

    A page that is handed on tells nobody where somebody's home is.
    """
    named = {run.label: run for run in runs}
    ranked = [named[entry["label"]] for entry in comparison["runs"]]
    of_runs = [[run.label, run.result, str(run.folder.absolute()), say_command(run.folder)] for run in ranked]
    spoken: Any = [comparison, *of_runs]
    known = {path for _, result, place, command in of_runs for path in (place, *list_paths_of(result, command))}
    comparison, *described = without_paths(spoken, known, ranked[0].result["joints"], Path.cwd())
    bare = [
        replace(run, label=label, result=result) for run, (label, result, *_) in zip(ranked, described, strict=True)
    ]
    return comparison, bare, [place for *_, place, _ in described], [command for *_, command in described]


def _advise(comparison: Comparison, chosen: Run, place: str) -> dict[str, Any]:
    """How the run to take is used, and what to do next."""
    return {
        "place": place if (chosen.folder / RESULT).exists() else None,
        "usable": is_usable(chosen.result),
        "uses": list_steps_to_use(chosen, place),
        "next": list_next_steps(comparison, chosen),
    }


def _describe(index: int, run: Run, comparison: Comparison, look: Look, folder: Path) -> dict[str, Any]:
    """What the page says about one run: its row in the ranking and its panel."""
    entry = comparison["runs"][index]
    recommendation = comparison["recommendation"]
    pairs = {(pair["run"], pair["other"]): pair for pair in comparison["pairs"]}
    pair = pairs.get((run.label, comparison["runs"][0]["label"]))
    report = (run.folder / "report.html").resolve()
    return {
        "index": index,
        "label": run.label,
        "entry": entry,
        "result": run.result,
        "style": {
            "color": look["color"],
            "dark": DARK.get(look["color"], look["color"]),
            "strokes": " ".join(f"{1.7 * length:.3g}" for length in look["dash"]) or "none",
        },
        "recommended": bool(recommendation) and recommendation["run"] == run.label,
        "verdict": "" if recommendation is None else VERDICTS[pair["verdict"]] if pair else "best",
        "pair": pair,
        "errors": list(_list_errors(entry)),
        "correlations": correlate(run.result, run.result["joints"][0]),  # said where there is but one
        "method": str(METHODS.get(entry["fit"]["method"], entry["fit"]["method"])).removeprefix("The "),
        "stopped": STOPPED.get(entry["fit"]["stopped"], entry["fit"]["stopped"]),
        "timing": list_timing(entry["timing"]),
        "doubts": _doubt(run),
        "grade": judge(run.result)["grade"],
        # Quoted, so that no name of a folder is read as a scheme, a query or a fragment.
        "report": quote(Path(os.path.relpath(report, folder.resolve())).as_posix()) if report.exists() else None,
    }


def _doubt(run: Run) -> list[Check]:
    return [check for check in check_result(run.result) if check.doubtful]


def _list_errors(entry: RunRow) -> Iterator[dict[str, Any]]:
    """Every metric of a run: the rollouts of each horizon on train and test, and the long one."""
    for horizon in entry["by_horizon"]:
        yield {"on": "test", **horizon["test"]}
        yield {"on": "train", **horizon["train"]}
    yield {"on": "one long test", **entry["paper"]["a"]}
    yield {"on": "random places", **entry["paper"]["b"]}


def _list_parameters(entries: Sequence[RunRow]) -> Iterator[dict[str, Any]]:
    """Rows of the table of all parameters, those of most runs first."""
    held = [{(p["owner"], p["name"], p["unit"]): p for p in entry["parameters"]} for entry in entries]
    keys = [key for parameters in held for key in parameters]
    for key in sorted(dict.fromkeys(keys), key=lambda key: -keys.count(key)):
        found = [parameters.get(key) for parameters in held]
        values = [p and {**p, "value": float(np.nanmean(read_values(p)))} for p in found]
        joints = [
            {"name": row["joint"], "values": [p and pick_value(p, row["joint"]) for p in found]}
            for row in entries[0]["by_joint"]
        ]
        yield dict(zip(("owner", "name", "unit"), key, strict=True)) | {"values": values, "by_joint": joints}


def list_errors_by_joint(comparison: Comparison) -> list[dict[str, Any]]:
    """Each joint with its position error on test data in all runs, and the place of the lowest; None where none has."""
    found = []
    for rows in zip(*(entry["by_joint"] for entry in comparison["runs"]), strict=True):
        errors = [row["test"]["position_mae"] for row in rows]
        known = [error for error in errors if error is not None]
        best = errors.index(min(known)) if known else None
        found.append({"name": rows[0]["joint"], "values": errors, "best": best})
    return found


def _find_worst(entry: RunRow) -> int:
    """Place of the joint with the largest error on test data."""
    return int(np.argmax([row["test"]["position_mae"] or 0.0 for row in entry["by_joint"]]))


def _list_files(folder: Path) -> dict[str, str]:
    """What lies beside the page, with what it is; `comparison.json` is written last."""
    found = {name: text for name, text in FILES.items() if name == "comparison.json" or (folder / name).exists()}
    drawings = sorted((folder / "figures").glob("*.pdf"))
    return found | {f"figures/{drawing.name}": "for print" for drawing in drawings}


def check_comparison(comparison: Comparison, runs: Sequence[Run]) -> Iterator[Check]:
    """How sure the order is, and what else speaks for it and against; `runs` are the same, best first."""
    yield check_order(comparison)
    if failed := len(comparison["failures"]):
        text = f"{failed} of {failed + len(comparison['runs'])} jobs left no result; their reasons are named."
        yield Check("bad", "Failed jobs", text)
    yield _check_rollouts(comparison["evaluation"])
    yield check_held_out(comparison["data"])
    yield _check_divergence(comparison)
    yield _check_bounds(comparison["runs"])
    if doubt := comparison["reference_doubt"]:
        yield Check("caution", "Reference", f"{doubt[0].upper()}{doubt[1:]}.")
    yield _check_fits(runs)
    yield _check_differences(comparison["differences"])
    yield check_origin(comparison["data"])


def _check_rollouts(evaluation: RolloutsRow) -> Check:
    text = f"All runs were judged on the same {evaluation['rollouts']} test rollouts of {evaluation['horizon']:g} s"
    if evaluation["rollouts"] < FEW:
        return Check("caution", "Few rollouts", f"{text}: too few for a sure order. Raise evaluation.rollouts.")
    return Check("good", "Same rollouts", f"{text}.")


def _check_divergence(comparison: Comparison) -> Check:
    lost = {}
    for entry in comparison["runs"]:
        counts = [f"{entry[part]['diverged']} of {entry[part]['rollouts']} on {part}" for part in ("test", "train")]
        if entry["test"]["diverged"] or entry["train"]["diverged"]:
            lost[entry["label"]] = f"{entry['label']} ({', '.join(counts)})"
    if not lost:
        return Check("good", "Stability", "All train and test rollouts of all runs stayed finite and count.")
    chosen = (comparison["recommendation"] or {}).get("run")
    text = f"Rollouts diverged, and are left out of the errors, of {name_runs([*lost.values()])}."
    return Check("bad" if chosen is None or chosen in lost else "caution", "Stability", text)


def _check_bounds(entries: Sequence[RunRow]) -> Check:
    ended = [
        f"{entry['label']} ({', '.join(names)})"
        for entry in entries
        if (names := [parameter["name"] for parameter in entry["parameters"] if parameter["at_bound"]])
    ]
    if ended:
        text = f"Parameters ended at a bound in {name_runs(ended)}. Widen it or doubt the model."
        return Check("caution", "Bounds", text)
    return Check("good", "Bounds", "No identified parameter of any run ended at a bound.")


def _check_fits(runs: Sequence[Run]) -> Check:
    doubtful = [run.label for run in runs if any(check.title == "Fit" for check in _doubt(run))]
    if doubtful:
        text = f"The fit of {name_runs(doubtful)} may not have reached its optimum: select the run to read why."
        return Check("caution", "Fits", text)
    return Check("good", "Fits", "Every fit came to rest or tried all of its combinations.")


def _check_differences(differences: Sequence[DifferenceRow]) -> Check:
    options = [difference["option"] for difference in differences]
    sections = list(dict.fromkeys(option.partition(".")[0] for option in options))
    unlike = [section for section in sections if section in FITTED]
    if unlike:
        text = f"Runs differ in more than their law: in options of {name_runs(unlike)}, listed on this page"
        return Check("caution", "Fitted alike?", f"{text}. Part of a difference may come from there.")
    if options:
        return Check("note", "Fitted alike", f"Besides the law, runs differ in {name_runs(options)} alone.")
    return Check("good", "Fitted alike", "Runs differ in their law alone; all other options are the same.")
