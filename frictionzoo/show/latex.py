"""The paper's Table 2 of a comparison, as LaTeX."""

import math

from frictionzoo.comparison.statistics import MATTERS
from frictionzoo.comparison.types import Comparison, RunRow
from frictionzoo.show.text import say_origin

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
        **{character: f"{{{character}}}" for character in "[]*-"},  # else arguments of \\, and dashes
    }
)
WIDEST = 1e5  # a number that would need more columns is written with a power of ten
RECOMMENDED, NOISE, NONE = r"$^{\ast}$", r"$^{\dagger}$", "--"


def tabulate_latex(comparison: Comparison) -> str:
    r"""Table of the runs' errors: a `table` to be read by `\input`, for a document that loads `booktabs`."""
    # A power of ten, a multiple of 3, that leaves the lowest test error between 1 and 1000.
    lowest = min((error for run in comparison["runs"] if (error := run["test"]["position_mae"])), default=1.0)
    exponent = 3 * math.floor(math.log10(lowest) / 3)
    rows = [_tabulate_run(run, exponent, comparison) for run in comparison["runs"]]
    unit = rf"$10^{{{exponent}}}$ {comparison['unit']}" if exponent else comparison["unit"]
    lines = [
        r"% needs \usepackage{booktabs}",
        r"\begin{table}",
        r"  \centering",
        rf"  \caption{{{_describe(comparison)}}}",
        r"  \label{tab:frictionzoo}",
        r"  \begin{tabular}{@{}lrrrrr@{}}",
        r"    \toprule",
        r"     & identified & \multicolumn{2}{c}{position MAE [UNIT]} & change & fit \\".replace("UNIT", unit),
        r"    \cmidrule(lr){3-4}",
        r"    model & values & train & test ($\sigma$) & [\%] & [s] \\",
        r"    \midrule",
        *(f"    {row}" for row in rows),
        r"    \bottomrule",
        r"  \end{tabular}",
        *(rf"  \par\smallskip\footnotesize {note}" for note in _notes(comparison)),
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def escape(text: str) -> str:
    """A user's text as LaTeX sets it: no character has another meaning, and all is on one line."""
    line = " ".join(text.split())
    return "".join(filter(str.isprintable, line)).translate(SPECIAL)


def _tabulate_run(run: RunRow, exponent: int, comparison: Comparison) -> str:
    train, test = (_scale(run[part]["position_mae"], exponent) for part in ("train", "test"))
    if test != NONE:
        test = f"{test} ({_scale(run['test']['position_mae_std'], exponent)})"
    chosen, change = comparison["recommendation"], run["change"]["test"]
    cells = [
        escape(run["label"]) + _mark(run["label"], comparison),
        str(run["identified"]),
        train,
        rf"\textbf{{{test}}}" if chosen and run["label"] == chosen["best"] else test,
        NONE if change is None or run["label"] == comparison["reference"] else f"${100 * change:+.0f}$",
        f"{run['timing']['fit']:.1f}",
    ]
    return " & ".join(cells) + r" \\"


def _mark(label: str, comparison: Comparison) -> str:
    """What stands behind a run's name."""
    chosen = comparison["recommendation"]
    if chosen is None:
        return ""
    close = {(pair["run"], pair["other"]) for pair in comparison["pairs"] if pair["verdict"] == "noise"}
    return (NOISE if (label, chosen["best"]) in close else "") + (RECOMMENDED if label == chosen["run"] else "")


def _scale(error: float | None, exponent: int) -> str:
    if error is None:
        return NONE
    scaled = error / 10.0**exponent
    if scaled < WIDEST:
        return f"{scaled:.2f}"
    mantissa, power = f"{scaled:.2e}".split("e")
    return rf"${mantissa}\times10^{{{int(power)}}}$"


def _describe(comparison: Comparison) -> str:
    """The caption: what was measured on what, and what the signs mean."""
    data, evaluation, reference = comparison["data"], comparison["evaluation"], comparison["reference"]
    against = escape(reference) if reference else "the same drive identified without friction"
    return (
        f"Friction models identified from {escape(data['name'])} ({say_origin(data['origin'])}): mean absolute error "
        f"(MAE) of the position in open-loop rollouts of {evaluation['horizon']:g}~s from measured states, "
        rf"{evaluation['rollouts']} of them on test data; $\sigma$: its standard deviation over them. Change: of the "
        "test error against "
        rf"{against}. Fit: without compiling. Bold: the lowest test error; {NOISE}: within noise of it, as the 95~\% "
        rf"interval of the paired difference holds~0 or the difference is below {100 * MATTERS:g}~\% of the error; "
        rf"{RECOMMENDED}: recommended, the fewest values within noise."
    )


def _notes(comparison: Comparison) -> list[str]:
    """Lines below the table: what diverged, and what has no result."""
    lost = [
        f"{escape(run['label'])}, {run[part]['diverged']} of {run[part]['rollouts']} on {part} data"
        for run in comparison["runs"]
        for part in ("train", "test")
        if run[part]["diverged"]
    ]
    failed = []
    for failure in comparison["failures"]:
        law = f" ({escape(failure['model'])})" if failure["model"] else ""
        failed.append(f"{escape(failure['run'])}{law}: {escape(failure['reason'])}")
    doubted = [escape(comparison["reference_doubt"])] if comparison["reference_doubt"] else []
    notes = {"Rollouts that diverged, and are left out": lost, "No result": failed, "Change": doubted}
    return [f"{title}: {'; '.join(entries)}." for title, entries in notes.items() if entries]
