"""`comparison.html`: one page that compares runs, from the recommendation to the curves of each run."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from msgspec.structs import asdict
from msgspec.structs import replace as replace_fields

from frictionzoo import __version__
from frictionzoo.core.anonymous import list_paths_of, without_paths
from frictionzoo.core.output import RESULT
from frictionzoo.diagnostics.findings import Finding
from frictionzoo.report.colors import DARK
from frictionzoo.report.comparison_advice import check_order, list_next_steps, list_steps_to_use
from frictionzoo.report.comparison_plots import Look, choose_looks, plot_comparison
from frictionzoo.report.page import save_page
from frictionzoo.report.run_page import (
    METHODS,
    check_held_out,
    check_origin,
    check_result,
    correlate,
    list_timing,
    say_command,
)
from frictionzoo.report.run_plots import plot_history
from frictionzoo.report.text import count_runs, say_seeds
from frictionzoo.result.comparison.record import FEW
from frictionzoo.result.comparison.runs import Run
from frictionzoo.result.comparison.statistics import MATTERS
from frictionzoo.result.comparison.types import CommonRollouts, ComparedRun, Comparison, OptionDifference
from frictionzoo.result.names import name_some, pick_value, read_values
from frictionzoo.result.verdict import is_usable, judge

POINTS = 2000  # largest number of points per curve; a comparison has many curves
LONG = 4  # number of differing options above which the list is folded
FITTED = ("fit", "segments", "loss", "bench")  # sections whose options change the fit
FILES = {"comparison.json": "all numbers of this page, for programs", "table.tex": "the ranking as a LaTeX table"}
STOPPED = {
    "converged": "converged",
    "finished": "all iterations completed",
    "patience": "the loss stopped falling",
    "diverged": "diverged",
}
VERDICTS = {"better": "better", "noise": "within noise", "worse": "worse"}


def write_page(path: Path, comparison: Comparison, runs: Sequence[Run]) -> None:
    """Write the page of a comparison, with links to files in the same folder and to the runs' reports.

    Raises:
        OutputError: The file cannot be written.
    """
    comparison, ranked, places, commands = _anonymise(comparison, runs)
    looks = choose_looks((run.label for run in ranked), comparison.reference)
    rows = [_describe(i, run, comparison, looks[run.label], path.parent) for i, run in enumerate(ranked)]
    for row, command in zip(rows, commands, strict=True):
        row["command"] = command
    best = next((row for row in rows if row["recommended"]), None)
    order, *checks = check_comparison(comparison, ranked)
    # In page order; the parameters of each run under its index in the ranking.
    sections = {
        str(i): list(plot_history(run.result, run.curves, looks[run.label]["color"])) for i, run in enumerate(ranked)
    }
    sections |= {name: drawn for name, drawn in plot_comparison(comparison, ranked).items() if name != "parameters"}
    save_page(
        path,
        "report/comparison.html.jinja",
        sections,
        checks,
        POINTS,
        comparison=comparison,
        rows=rows,
        count=count_runs(comparison),
        seconds=sum(member.result.timing.total for run in runs for member in run.by_seed),
        joints=tuple(comparison.joints),
        errors=list_errors_by_joint(comparison),
        worst=int(np.argmax([row.test.position_mae or 0.0 for row in comparison.runs[0].by_joint])),
        matters=MATTERS,
        recommended=best,
        order=order,
        advice=None if best is None else _advise(comparison, ranked[best["index"]], places[best["index"]]),
        parameters=list(_list_parameters(comparison.runs)),
        folded=len(comparison.differences) > LONG,
        files=_list_files(path.parent),
        state={"labels": [*looks], "selected": best["index"] if best else 0},
        version=__version__,
    )


def _anonymise(
    comparison: Comparison, runs: Sequence[Run]
) -> tuple[Comparison, list[Run], list[str], list[str | None]]:
    """Remove absolute paths, which reveal home directories; return comparison, ranked runs, folders and commands."""
    by_label = {run.label: run for run in runs}
    ranked = [by_label[entry.label] for entry in comparison.runs]
    rows = [[run.label, run.result, str(run.folder.absolute()), say_command(run.folder)] for run in ranked]
    content: Any = [comparison, *rows]
    paths = {path for _, result, place, command in rows for path in (place, *list_paths_of(result, command))}
    comparison, *cleaned = without_paths(content, paths, ranked[0].result.joints, Path.cwd())
    anonymous = [
        replace(run, label=label, result=result) for run, (label, result, *_) in zip(ranked, cleaned, strict=True)
    ]
    return comparison, anonymous, [place for *_, place, _ in cleaned], [command for *_, command in cleaned]


def _advise(comparison: Comparison, chosen: Run, place: str) -> dict[str, Any]:
    return {
        "place": place if (chosen.folder / RESULT).exists() else None,
        "usable": is_usable(chosen.result),
        "uses": list_steps_to_use(chosen, place),
        "next": list_next_steps(comparison, chosen),
    }


def _describe(index: int, run: Run, comparison: Comparison, look: Look, folder: Path) -> dict[str, Any]:
    entry = comparison.runs[index]
    recommendation = comparison.recommendation
    pairs = {(pair.run, pair.other): pair for pair in comparison.pairs}
    pair = pairs.get((run.label, comparison.runs[0].label))
    report = (run.folder / "report.html").resolve()
    return {
        "index": index,
        "label": run.label,
        "entry": entry,
        "style": {
            "color": look["color"],
            "dark": DARK.get(look["color"], look["color"]),
            "strokes": " ".join(f"{1.7 * length:.3g}" for length in look["dash"]) or "none",
        },
        "recommended": bool(recommendation) and recommendation.run == run.label,
        "verdict": "" if recommendation is None else VERDICTS[pair.verdict] if pair else "best",
        "pair": pair,
        "seeds": say_seeds(entry.seeds),
        "errors": list(_list_errors(entry)),
        "correlations": correlate(run.result, run.result.joints[0]),  # shown for a single joint only
        "method": str(METHODS.get(entry.fit.method, entry.fit.method)).removeprefix("The "),
        "stopped": STOPPED.get(entry.fit.stopped, entry.fit.stopped),
        "timing": list_timing(entry.timing),
        "doubts": _doubt(run),
        "grade": judge(run.result).grade,
        # Quoted: a browser could read a folder name as a scheme, a query or a fragment.
        "report": quote(Path(os.path.relpath(report, folder.resolve())).as_posix()) if report.exists() else None,
    }


def _doubt(run: Run) -> list[Finding]:
    return [check for check in check_result(run.result) if check.doubtful]


def _list_errors(entry: ComparedRun) -> Iterator[dict[str, Any]]:
    for horizon in entry.by_horizon:
        yield {"on": "test", **asdict(horizon.test)}
        yield {"on": "train", **asdict(horizon.train)}
    yield {"on": "test, one long rollout", **asdict(entry.paper.a)}
    yield {"on": "test, random places", **asdict(entry.paper.b)}


def _list_parameters(entries: Sequence[ComparedRun]) -> Iterator[dict[str, Any]]:
    """Yield rows of the table of all parameters; parameters shared by most runs come first."""
    by_run = [{(p.owner, p.name, p.unit): p for p in entry.parameters} for entry in entries]
    keys = [key for parameters in by_run for key in parameters]
    for key in sorted(dict.fromkeys(keys), key=lambda key: -keys.count(key)):
        per_run = [parameters.get(key) for parameters in by_run]
        values = [p and replace_fields(p, value=float(np.nanmean(read_values(p)))) for p in per_run]
        joints = [
            {"name": row.joint, "values": [p and pick_value(p, row.joint) for p in per_run]}
            for row in entries[0].by_joint
        ]
        yield dict(zip(("owner", "name", "unit"), key, strict=True)) | {"values": values, "by_joint": joints}


def list_errors_by_joint(comparison: Comparison) -> list[dict[str, Any]]:
    """Return the test position errors of every joint in all runs, and the index of the lowest; None if all diverged."""
    joints = []
    for rows in zip(*(entry.by_joint for entry in comparison.runs), strict=True):
        errors = [row.test.position_mae for row in rows]
        finite = [error for error in errors if error is not None]
        best = errors.index(min(finite)) if finite else None
        joints.append({"name": rows[0].joint, "values": errors, "best": best})
    return joints


def _list_files(folder: Path) -> dict[str, str]:
    """Return files in the page's folder with a description; `comparison.json` is written after the page."""
    files = {name: text for name, text in FILES.items() if name == "comparison.json" or (folder / name).exists()}
    drawings = sorted((folder / "figures").glob("*.pdf"))
    return files | {f"figures/{drawing.name}": "for print" for drawing in drawings}


def check_comparison(comparison: Comparison, runs: Sequence[Run]) -> Iterator[Finding]:
    """Yield the checks of a comparison, certainty of the ranking first; `runs` are ordered best first."""
    yield check_order(comparison)
    if failed := len(comparison.failures):
        text = (
            f"{failed} of {failed + sum(len(run.by_seed) for run in runs)} jobs failed; the reasons are under Ranking."
        )
        yield Finding("bad", "Failed jobs", text)
    yield _check_rollouts(comparison.evaluation)
    yield check_held_out(comparison.data)
    yield _check_divergence(comparison)
    yield _check_bounds(comparison.runs)
    if doubt := comparison.reference_doubt:
        yield Finding("caution", "Reference", f"{doubt[0].upper()}{doubt[1:]}.")
    yield _check_fits(runs)
    yield _check_differences(comparison.differences)
    yield check_origin(comparison.data)


def _check_rollouts(evaluation: CommonRollouts) -> Finding:
    text = f"All runs were evaluated on the same {evaluation.rollouts} test rollouts of {evaluation.horizon:g} s"
    if evaluation.rollouts < FEW:
        return Finding("caution", "Few rollouts", f"{text}: too few for a reliable ranking. Raise evaluation.rollouts.")
    return Finding("good", "Same rollouts", f"{text}.")


def _check_divergence(comparison: Comparison) -> Finding:
    diverged = {}
    for entry in comparison.runs:
        counts = [f"{entry[part].diverged} of {entry[part].rollouts} on {part}" for part in ("test", "train")]
        if entry.test.diverged or entry.train.diverged:
            diverged[entry.label] = f"{entry.label} ({', '.join(counts)})"
    if not diverged:
        return Finding("good", "Stability", "All training and test rollouts of all runs stayed finite.")
    chosen = comparison.recommendation and comparison.recommendation.run
    text = f"Diverged rollouts, excluded from the errors: {name_some([*diverged.values()])}."
    return Finding("bad" if chosen is None or chosen in diverged else "caution", "Stability", text)


def _check_bounds(entries: Sequence[ComparedRun]) -> Finding:
    ended = [
        f"{entry.label} ({', '.join(names)})"
        for entry in entries
        if (names := [parameter.name for parameter in entry.parameters if parameter.at_bound])
    ]
    if ended:
        text = f"Parameters ended at a bound: {name_some(ended)}. Widen the bounds or try another model."
        return Finding("caution", "Bounds", text)
    return Finding("good", "Bounds", "No identified parameter of any run ended at a bound.")


def _check_fits(runs: Sequence[Run]) -> Finding:
    doubtful = [run.label for run in runs if any(check.title == "Fit" for check in _doubt(run))]
    if doubtful:
        text = f"Fits that may not have reached their optimum: {name_some(doubtful)}. Select a run for details."
        return Finding("caution", "Fits", text)
    return Finding("good", "Fits", "No problems found in the fits.")


def _check_differences(differences: Sequence[OptionDifference]) -> Finding:
    options = [difference.option for difference in differences]
    sections = list(dict.fromkeys(option.partition(".")[0] for option in options))
    unlike = [section for section in sections if section in FITTED]
    if unlike:
        text = f"Apart from the model, runs differ in options of {name_some(unlike)}, listed on this page"
        return Finding("caution", "Different fit options", f"{text}. These may explain part of the differences.")
    if options:
        return Finding("note", "Same fit options", f"Apart from the model, runs differ only in {name_some(options)}.")
    return Finding("good", "Same fit options", "Runs differ only in the model.")
