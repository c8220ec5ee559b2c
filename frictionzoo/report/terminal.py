"""Summary of a run, a comparison, a drift or a designed command in plain text, for terminals and log files."""

import html
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from frictionzoo.core.telling import Rows, align, escape_all, say_percent
from frictionzoo.report.text import count_runs, escape_markdown, format_change, format_number, format_share, say_seeds
from frictionzoo.result.comparison.drift import Drift, say_change
from frictionzoo.result.comparison.types import Comparison
from frictionzoo.result.names import merge_known
from frictionzoo.result.section_types import Torque, WrittenModel
from frictionzoo.result.types import Data, Metrics, Result
from frictionzoo.result.verdict import FAR, say_finding, say_purposes

_format_change = partial(format_change, signs="-++")

ERRORS = {  # row of the table: key of the metric, key of its unit
    "position MAE": ("position_mae", "unit"),
    "sigma of the MAE": ("position_mae_std", "unit"),
    "position RMSE": ("position_rmse", "unit"),
    "velocity RMSE": ("velocity_rmse", "velocity_unit"),
}


def summarise(result: Result, folder: Path | None) -> str:
    """Summarise a run: parameters, test errors with and without friction, verdict, and the folder of its files."""
    return _arrange(result, folder, align)


def summarise_in_markdown(result: Result, folder: Path) -> str:
    """Return the same summary in Markdown, for loggers."""
    return _arrange(result, folder, _tabulate_in_markdown)


def summarise_in_html(result: Result, folder: Path | None) -> str:
    """Return the same summary in HTML, for notebooks."""
    return _arrange(result, folder, _tabulate_in_html, _say_in_html, _tell_in_html)


def tabulate_values(result: Result) -> str:
    """Return the table of parameters in Markdown."""
    return _tabulate_in_markdown(_list_parameters(result))


def tabulate_errors(result: Result) -> str:
    """Return test errors with and without friction in Markdown; for several joints also by joint."""
    metrics = result.metrics
    tables = [_list_errors(metrics.test, metrics.baseline, ("this drive", "no friction"))]
    tables += [_list_joints(result)] if len(result.joints) > 1 else []
    return "\n\n".join(map(_tabulate_in_markdown, tables))


def _say_in_html(text: str) -> str:
    return f"<p>{html.escape(text)}</p>"


def _tell_in_html(lines: Sequence[str]) -> str:
    return "".join(f"<pre>{html.escape(line)}</pre>" if line[:1] == " " else _say_in_html(line) for line in lines)


def _tabulate_in_html(rows: Rows) -> str:
    head, *body = [[html.escape(cell) for cell in row] for row in rows]
    lines = [f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in body]
    return f"<table><tr>{''.join(f'<th>{cell}</th>' for cell in head)}</tr>{''.join(lines)}</table>"


def _arrange(
    result: Result,
    folder: Path | str | None,
    tabulate: Callable[[Rows], str],
    say: Callable[[str], str] = lambda text: text,
    tell: Callable[[Sequence[str]], str] = "\n".join,
) -> str:
    result, folder = escape_all(result), escape_all(str(folder)) if folder else None
    metrics = result.metrics
    blocks = [
        say(f"{result.model} on {_say_data(result.data)}"),
        tabulate(_list_parameters(result)),
        tabulate(_list_errors(metrics.test, metrics.baseline, ("this model", "no friction"))),
        *([tabulate(_list_joints(result))] if len(result.joints) > 1 else []),
        *([tabulate(_list_torque(result.torque))] if result.torque else []),
        *([tabulate(_list_written(result)), tell(_list_limits(result))] if result.written else []),
        *([say(f"files: {folder}")] if folder else []),
        tell(_list_verdict(result)),
    ]
    return "\n\n".join(filter(None, blocks))


def summarise_comparison(comparison: Comparison, folder: Path | None) -> str:
    """Summarise a comparison: runs best first, failed jobs, recommendation, and the folder of its files."""
    return "\n\n".join(_arrange_comparison(comparison, folder, align))


def summarise_comparison_in_html(comparison: Comparison, folder: Path | None) -> str:
    """Return the same summary in HTML, for notebooks."""
    origin, table, *paragraphs = _arrange_comparison(comparison, folder, _tabulate_in_html)
    return "".join([_say_in_html(origin), table, *map(_say_in_html, paragraphs)])


def _arrange_comparison(comparison: Comparison, folder: Path | None, tabulate: Callable[[Rows], str]) -> list[str]:
    comparison = escape_all(comparison)
    count, doubt, recommendation = count_runs(comparison), comparison.reference_doubt, comparison.recommendation
    failed = "\n".join(f"failed: {failure.run}: {failure.reason}" for failure in comparison.failures)
    advice = "No recommendation: all test rollouts of all runs diverged."
    if recommendation:
        advice = f"recommended: {recommendation.run}. {recommendation.reason}"
    remarks = (failed, f"warning: {doubt}" if doubt else "", advice, f"files: {folder}" if folder else "")
    return [
        f"{count} run{'s' * (count != 1)} on {_say_data(comparison.data)}",
        tabulate(_list_runs(comparison)),
        *filter(None, remarks),
    ]


def summarise_drift(drift: Drift, folder: Path | None) -> str:
    """Summarise `drift.json`: each parameter then and now, remarks, and the verdict in the last line."""
    drift, several = escape_all(drift), len(drift.runs) > 1
    rows = [("parameter", "joint", "then", *(["spread"] if several else []), "now", "unit", "change", "")]
    for row in drift.parameters:
        spread = ["" if row.spread is None else f"{row.spread:.2g}"] if several else []
        numbers = format_number(row.then), *spread, "" if row.now is None else format_number(row.now)
        rows.append((row.name, row.joint, *numbers, row.unit, say_change(row), row.verdict))
    remarks = [f"warning: {line}" for line in drift.warnings]
    if not several:
        remarks.append("one run: changes between repetitions are not included; give more runs of the unchanged drive")
    chance = f"joint confidence level of the intervals {say_percent(1 - drift.alarm)}"
    counts = f"changes below {say_percent(drift.smallest)} do not count"
    source = f"{drift.model}, {len(drift.runs)} run{'s' * several}; {chance}; {counts}"
    files = f"files: {folder}" if folder else ""
    return "\n\n".join(filter(None, [source, align(rows), "\n".join(remarks), files, f"verdict: {drift.summary}"]))


def summarise_excitation(note: Mapping[str, Any], folder: Path) -> str:
    """Summarise `excitation.json`: accuracy of each parameter, use of the limits, and the folder of the files."""
    note = escape_all(note)
    command, noise = note["command"], note["noise"]
    several = len(note["joints"]) > 1
    rows = [("parameter", "value", "known to", "unit", "")]
    for row in note["parameters"]:
        identifiable = row["identifiable"]
        # Missing: NaN, or null in the file.
        share = "" if row["share"] is None or row["share"] != row["share"] else say_percent(row["share"])
        width = f"+- {row['half_width']:.2g}" if identifiable else ""
        rows.append(
            (row["name"], f"{row['value']:.4g}", width, row["unit"], share if identifiable else "not identifiable")
        )
    used: list[tuple[str, ...]] = [
        ("in MuJoCo C", *(["joint"] if several else []), "from", "to", "allowed", "unit", "of the limit")
    ]
    for row in note["limits"]:
        low, high = row["allowed"]
        joint = [row["joint"]] if several else []
        reached = [f"{end:.4g}" for end in row["reached"]]
        share = f"{100 * row['share']:.0f} %"
        used.append((row["quantity"], *joint, *reached, f"{low:.4g} to {high:.4g}", row["unit"], share))
    return "\n\n".join(
        [
            f"{command['seconds']:g} s at {command['rate']:g} samples/s, soft start and stop of {command['ramp']:g} s."
            f"\nPrediction for a fit with segments of {note['fit']['length']} samples, an encoder step of "
            f"{noise['quantum']:.3g},\nposition noise of {noise['position_noise']:.3g} and velocity noise of "
            f"{noise['velocity_noise']:.3g}:",
            align(rows),
            align(used),
            f"files: {folder}",
        ]
    )


def _list_runs(comparison: Comparison) -> Rows:
    evaluation, unit = comparison.evaluation, comparison.unit
    best = comparison.runs[0].label
    verdicts = {pair.run: pair.verdict for pair in comparison.pairs if pair.other == best}
    judged = f"test, {evaluation.rollouts} x {evaluation.horizon:g} s [{unit}]"
    several = any(run.seeds for run in comparison.runs)
    columns = (*(["seeds"] if several else []), "sigma", "change", "against best", "diverged", "fit [s]")
    rows: list[tuple[str, ...]] = [("model", "identified", f"train MAE [{unit}]", judged, *columns)]
    for run in comparison.runs:
        label, train, test, change = run.label, run.train, run.test, run.change.test
        rows.append(
            (
                *(label, str(run.identified), format_number(train.position_mae)),
                format_number(test.position_mae),
                *([say_seeds(run.seeds, "+-")] if several else []),
                format_number(test.position_mae_std),
                "" if change is None else f"{round(100 * change):+d} %",
                "best" if label == best else verdicts[label],
                *(str(test.diverged), f"{run.timing.fit:.1f}"),
            )
        )
    return rows


def _say_data(data: Data) -> str:
    kinds = {"simulated": "The data are simulated.", "hardware": "Recorded on hardware, according to data.origin."}
    return f"{data.name}. {kinds.get(data.origin or '', 'Your recordings.')}"


def _list_parameters(result: Result) -> Rows:
    """Return one row per parameter; for several joints, one row per joint or group of joints that share the value."""
    several = len(result.joints) > 1
    rows = [("parameter", *(["joint"] if several else []), "value", "95 % interval", "unit", "")]
    for parameter in result.parameters:
        name = f"{parameter.owner}.{parameter.name}"
        for row in merge_known(parameter.by_joint) if several else parameter.by_joint:
            joint = [row.name] if several else []
            status = "not identifiable" if row.identifiable is False else "identified"
            status = "at a bound" if several and row.at_bound else status if row.identified else "known"
            interval = "" if row.interval is None else "{:.4g} to {:.4g}".format(*row.interval)
            rows.append((name, *joint, format_number(row.value), interval, parameter.unit, status))
            name = ""  # only in the first row of a parameter
    if result.network:
        joint = [""] if several else []  # the model determines which joints it covers
        rows.append(("friction network", *joint, str(result.network.weights), "", "weights", "identified"))
    return rows


def _list_joints(result: Result) -> Rows:
    unit = result.metrics.test.unit
    rows = [("position MAE by joint", "this model", "no friction", "unit", "change")]
    for row in result.by_joint:
        error, without = (row[part].position_mae for part in ("test", "baseline"))
        change = _format_change(error, without)
        rows.append((row.joint, format_number(error), format_number(without), unit, change))
    return rows


def _list_torque(torque: Torque) -> Rows:
    rows = [("residual torque, test, RMS", "residual", "torque", "unit", "share")]
    tests = [(row.joint, row.test) for row in torque.by_joint]
    for name, test in [*tests, ("mean", torque.mean.test)][: len(tests) + (len(tests) > 1)]:
        values = format_number(test.residual), format_number(test.torque)
        rows.append((name, *values, torque.unit, format_share(test.residual, test.torque)))
    return rows


def _list_written(result: Result) -> Rows:
    rows = [("difference in MuJoCo", "mean", "largest", "unit", "of the test error")]
    for row in result.written:
        share = "" if row.share is None else say_percent(row.share)
        rows.append((row.file, format_number(row.mean), format_number(row.largest), row.unit, share))
    return rows


def _list_limits(result: Result) -> list[str]:
    limits = [(row.file, limit) for row in result.written for limit in _list_reasons(row)]
    files: dict[str, list[str]] = {}
    for file, limit in limits:
        files.setdefault(limit, []).append(file)
    return [f"{', '.join(names)}: {limit}" for limit, names in files.items()]


def _list_reasons(row: WrittenModel) -> list[str]:
    if row.exact:
        return ["the identified drive, represented exactly", *row.limits]
    far = row.share is not None and row.share > FAR
    reason = row.reason or ("no known reason: do not use it" if far else "")
    return [*([f"far from the identified drive: {reason}"] if far else [reason] if reason else []), *row.limits]


def _list_errors(test: Metrics, reference: Metrics, names: tuple[str, str]) -> Rows:
    rows = [(f"test, {test.rollouts} x {test.horizon:g} s", *names, "unit", "change")]
    for row, (key, unit) in ERRORS.items():
        change = _format_change(test[key], reference[key])
        rows.append((row, format_number(test[key]), format_number(reference[key]), test[unit], change))
    rows.append(("diverged", str(test.diverged), str(reference.diverged), "rollouts", ""))
    return rows


def _list_verdict(result: Result) -> list[str]:
    verdict = result.verdict
    count = len(verdict.findings)
    lines = [f"verdict: {verdict.grade}" + (f", {count} finding{'s' * (count > 1)}" if count else "")]
    for finding in verdict.findings:
        if finding.kind != "identification":
            lines.append(f"warning: {say_finding(finding)}")
    if result.not_identified:
        why, *reasons = result.not_identified
        lines.append(f"the drive was not identified: {why}. Likely reasons, the likeliest first:")
        lines += [f"  {number}. {reason}" for number, reason in enumerate(reasons, 1)]
    if verdict.commands:
        lines += [f"next: {say_purposes(verdict.commands)}"]
        lines += [f"  {row.command}" for row in verdict.commands]
    return lines


def _tabulate_in_markdown(rows: Rows) -> str:
    # An underscore within a word is not emphasis in Markdown and needs no escape.
    cells = ([re.sub(r"(?<=\w)\\_(?=\w)", "_", escape_markdown(cell)) for cell in row] for row in rows)
    head, *body = (f"| {' | '.join(row)} |" for row in cells)
    return "\n".join([head, "|---" * len(rows[0]) + "|", *body])
