"""Comparable runs, read from run folders."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from frictionzoo.core.anonymous import list_paths_of, without_paths
from frictionzoo.core.config import list_options
from frictionzoo.core.errors import RunError
from frictionzoo.core.jobs import Failure, find_runs, read_failure, refuse_links
from frictionzoo.core.output import RESULT
from frictionzoo.result.curves import OWN, Curves
from frictionzoo.result.record import read_run
from frictionzoo.result.types import Result

MOST_NAMED = 2  # largest number of options in a label
# Sections whose differences a comparison lists. Options of the model belong to the model; data and evaluation must
# not differ.
NAMED = ("seed", "dtype", "engine", "segments", "loss", "fit", "bench", "teacher")


@dataclass(frozen=True, eq=False)
class Run:
    """Finished run: its unique name in a comparison, its folder, and the contents of its two files."""

    label: str
    folder: Path
    result: Result
    curves: Curves


def read_runs(folders: Sequence[Path]) -> tuple[list[Run], list[Failure]]:
    """Read the runs in these folders of runs or sweeps, and their failures.

    Raises:
        RunError: A folder holds no run, a run cannot be read, or two runs are not comparable.
    """
    for folder in folders:
        refuse_links(folder, files=False)
    run_folders = list(dict.fromkeys(run.resolve() for folder in folders for run in find_runs(folder)))
    failures = [failure for folder in run_folders if (failure := read_failure(folder))]
    read = [(folder, *read_run(folder)) for folder in run_folders if (folder / RESULT).exists()]
    return gather([Run(result.model, folder, result, curves) for folder, result, curves in read]), failures


def gather(runs: Sequence[Run]) -> list[Run]:
    """Return runs with unique labels: the model and, if needed, differing options; RunError if not comparable."""
    for run in runs:
        if run.result["card"]:
            raise RunError(f"{run.folder}: a card without recordings, expected the folder of a run; name its run")
        _refuse_incomparable(run, runs[0])
    return [replace(run, label=_label_among(run, [r for r in runs if r.label == run.label])) for run in runs]


def _refuse_incomparable(run: Run, first: Run) -> None:
    actual, expected = run.result, first.result
    if actual.data.sha256 != expected.data.sha256:
        names = [f"{data.name} (SHA-256 {data.sha256[:12]})" for data in (actual.data, expected.data)]
        text = f"data {names[0]}, expected {names[1]} as in {first.folder}"
        raise RunError(f"{run.folder}: {text}; compare runs on the same data")
    if actual.evaluation.sha256 != expected.evaluation.sha256:
        options = differing([actual.settings, expected.settings], ("evaluation", "data"))
        changes = [f"{name}={actual}, expected {expected}" for name, (actual, expected) in options.items()]
        text = f"{'; '.join(changes)} as in {first.folder}" if changes else f"its rollouts differ from {first.folder}"
        raise RunError(f"{run.folder}: {text}; compare runs evaluated on the same rollouts")
    for field in fields(Curves):
        actual, expected = (getattr(curves, field.name) for curves in (run.curves, first.curves))
        if field.name not in OWN and actual.shape != expected.shape:
            text = f"{field.name} of shape {actual.shape}, expected {expected.shape} as in {first.folder}"
            raise RunError(f"{run.folder}: {text}; run it again")


def differing(settings: Sequence[Mapping[str, Any]], sections: Sequence[str]) -> dict[str, list[Any]]:
    """Return the options of these sections in which runs differ: dotted name to each run's value, None if unset."""
    leaves = [dict(list_options({name: options.get(name) for name in sections})) for options in settings]
    names = dict.fromkeys(name for options in leaves for name in options)
    table = {name: [options.get(name) for options in leaves] for name in names}
    return {name: values for name, values in table.items() if any(value != values[0] for value in values)}


def _label_among(run: Run, same: Sequence[Run]) -> str:
    if len(same) == 1:
        return run.label
    place = same.index(run)
    for descriptions in _describe(same):
        if len(set(descriptions)) == len(same):
            return f"{run.label} {descriptions[place]}"
    return f"{run.label} ({run.folder.name} {place})"


def _describe(same: Sequence[Run]) -> Iterator[list[str]]:
    """Yield texts that may distinguish runs of one model, one per run, the simplest first."""
    yield [f"fit={run.result.fit.method}" for run in same]
    options = differing([run.result.settings for run in same], (*NAMED, "model"))
    if len(options) <= MOST_NAMED:
        # Labels appear on shared pages and tables, which must not reveal paths of this machine.
        paths, joints = {path for run in same for path in list_paths_of(run.result)}, same[0].result.joints
        named = {name: without_paths(values, paths, joints) for name, values in options.items()}
        yield [" ".join(f"{name}={values[i]}" for name, values in named.items()) for i in range(len(same))]
    yield [f"({run.folder.name})" for run in same]
