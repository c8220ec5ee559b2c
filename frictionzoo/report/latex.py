"""Comparison as a LaTeX table, like Table 2 of the paper."""

import math

from frictionzoo.report.text import say_origin, say_seeds
from frictionzoo.result.comparison.statistics import MATTERS
from frictionzoo.result.comparison.types import ComparedRun, Comparison

SPECIAL = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "^": r"\textasciicircum{}",
        "~": r"\textasciitilde{}",
        "<": r"\textless{}",
        ">": r"\textgreater{}",
        "|": r"\textbar{}",
        '"': "''",
        "`": r"\textasciigrave{}",
        **{character: f"\\{character}" for character in "{}$&#%"},
        "_": r"\_\allowbreak{}",
        **{character: f"{{{character}}}" for character in "[]*-"},  # LaTeX reads them as arguments of \\, or as dashes
    }
)
WIDEST = 1e5  # from here on, numbers are written with a power of ten
RECOMMENDED, NOISE, NONE = r"$^{\ast}$", r"$^{\dagger}$", "--"


def tabulate_latex(comparison: Comparison) -> str:
    r"""Return a `table` of the runs' errors for `\input` in a document that loads `booktabs`."""
    # The exponent is a multiple of 3 that scales the lowest test error to between 1 and 1000.
    lowest = min((error for run in comparison.runs if (error := run.test.position_mae)), default=1.0)
    exponent = 3 * math.floor(math.log10(lowest) / 3)
    rows = [_tabulate_run(run, exponent, comparison) for run in comparison.runs]
    unit = rf"$10^{{{exponent}}}$ {comparison.unit}" if exponent else comparison.unit
    several = any(run.seeds for run in comparison.runs)
    lines = [
        r"% needs \usepackage{booktabs}",
        r"\begin{table}",
        r"  \centering",
        rf"  \caption{{{_describe(comparison)}}}",
        r"  \label{tab:frictionzoo}",
        rf"  \begin{{tabular}}{{@{{}}lrr{'rr' if several else 'r'}rr@{{}}}}",
        r"    \toprule",
        rf"     & identified & \multicolumn{{{2 + several}}}{{c}}{{position MAE [{unit}]}} & change & fit \\",
        rf"    \cmidrule(lr){{3-{4 + several}}}",
        rf"    model & values & train & test ($\sigma$){' & seeds' if several else ''} & [\%] & [s] \\",
        r"    \midrule",
        *(f"    {row}" for row in rows),
        r"    \bottomrule",
        r"  \end{tabular}",
        *(rf"  \par\smallskip\footnotesize {note}" for note in _notes(comparison)),
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def escape(text: str) -> str:
    """Escape a user's text for LaTeX and put it on one line."""
    line = " ".join(text.split())
    return "".join(filter(str.isprintable, line)).translate(SPECIAL)


def _tabulate_run(run: ComparedRun, exponent: int, comparison: Comparison) -> str:
    several = any(other.seeds for other in comparison.runs)
    train, test = (_scale(run[part].position_mae, exponent) for part in ("train", "test"))
    if test != NONE:
        test = f"{test} ({_scale(run.test.position_mae_std, exponent)})"
    chosen, change = comparison.recommendation, run.change.test
    cells = [
        escape(run.label) + _mark(run.label, comparison),
        str(run.identified),
        train,
        rf"\textbf{{{test}}}" if chosen and run.label == chosen.best else test,
        *([say_seeds(run.seeds, r"$\pm$", lambda std: _scale(std, exponent))] if several else []),
        NONE if change is None or run.label == comparison.reference else f"${100 * change:+.0f}$",
        f"{run.timing.fit:.1f}",
    ]
    return " & ".join(cells) + r" \\"


def _mark(label: str, comparison: Comparison) -> str:
    chosen = comparison.recommendation
    if chosen is None:
        return ""
    close = {(pair.run, pair.other) for pair in comparison.pairs if pair.verdict == "noise"}
    return (NOISE if (label, chosen.best) in close else "") + (RECOMMENDED if label == chosen.run else "")


def _scale(error: float | None, exponent: int) -> str:
    if error is None:
        return NONE
    scaled = error / 10.0**exponent
    if scaled < WIDEST:
        return f"{scaled:.2f}"
    mantissa, power = f"{scaled:.2e}".split("e")
    return rf"${mantissa}\times10^{{{int(power)}}}$"


def _describe(comparison: Comparison) -> str:
    data, evaluation, reference = comparison.data, comparison.evaluation, comparison.reference
    against = escape(reference) if reference else "the same drive identified without friction"
    seeds = "Seeds: errors are means over the seeds, $\\pm$ standard deviation of the test error over them. "
    seeded = any(run.seeds and not run.seeds.deterministic for run in comparison.runs)
    return (
        f"Friction models identified from {escape(data.name)} ({say_origin(data.origin)}): mean absolute error "
        f"(MAE) of the position in open-loop rollouts of {evaluation.horizon:g}~s from measured states "
        rf"({evaluation.rollouts} on test data); $\sigma$: standard deviation over the rollouts. "
        rf"{seeds * seeded}Change: test error against {against}. Fit: time without compilation. Bold: lowest test "
        rf"error; {NOISE}: within noise of it (the 95~\% interval of the paired difference contains~0, or the "
        rf"difference is below {100 * MATTERS:g}~\% of the error); {RECOMMENDED}: recommended (fewest values within "
        "noise; models whose parameters are all identifiable come first)."
    )


def _notes(comparison: Comparison) -> list[str]:
    diverged = [
        f"{escape(run.label)}, {run[part].diverged} of {run[part].rollouts} on {part} data"
        for run in comparison.runs
        for part in ("train", "test")
        if run[part].diverged
    ]
    failed = []
    for failure in comparison.failures:
        model = f" ({escape(failure.model)})" if failure.model else ""
        failed.append(f"{escape(failure.run)}{model}: {escape(failure.reason)}")
    doubted = [escape(comparison.reference_doubt)] if comparison.reference_doubt else []
    notes = {"Diverged rollouts, excluded": diverged, "No result": failed, "Change": doubted}
    return [f"{title}: {'; '.join(entries)}." for title, entries in notes.items() if entries]
