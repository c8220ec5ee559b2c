"""Comparable runs, read from run folders."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from msgspec.structs import replace as replace_fields

from frictionzoo.core.anonymous import list_paths_of, without_paths
from frictionzoo.core.config import list_options
from frictionzoo.core.errors import RunError
from frictionzoo.core.jobs import Failure, find_runs, read_failure, refuse_links
from frictionzoo.core.output import RESULT
from frictionzoo.core.records import Record
from frictionzoo.result.curves import OWN, Curves
from frictionzoo.result.record import read_run
from frictionzoo.result.types import Result

MOST_NAMED = 2  # largest number of options in a label
# Sections whose differences a comparison lists. Options of the model belong to the model; data and evaluation must
# not differ.
AVERAGED: Final = "metrics", "by_joint", "by_horizon", "paper", "torque", "timing"  # sections averaged over seeds
NAMED = ("seed", "dtype", "engine", "segments", "loss", "fit", "bench", "teacher")


@dataclass(frozen=True, eq=False)
class Run:
    """Finished run, or runs that differ only in the seed, as one row of a comparison.

    Attributes:
        label: Unique name in the comparison.
        folder: Folder of the run; with several seeds, of the run with the lowest training error.
        result: Content of its `result.json`; with several seeds, its errors and times are means over the seeds.
        curves: Content of its `curves.safetensors`; with several seeds, its rollouts' errors are means over the seeds.
        members: The runs of several seeds, lowest training error first; empty for one seed.
    """

    label: str
    folder: Path
    result: Result
    curves: Curves
    members: tuple["Run", ...] = ()

    @property
    def by_seed(self) -> tuple["Run", ...]:
        """One run for each seed; the first one's parameters and details represent the others."""
        return self.members or (self,)

    @property
    def options(self) -> dict[str, Any]:
        """Settings of the run; with several seeds, `seed` is their list."""
        seeds = sorted(member.result.seed for member in self.members)
        return self.result.settings | ({"seed": seeds} if seeds else {})


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
    """Return runs, one for all seeds, labelled with model and differing options; RunError if not comparable."""
    for run in runs:
        if run.result["card"]:
            raise RunError(f"{run.folder}: a card without recordings, expected the folder of a run; name its run")
        _refuse_incomparable(run, runs[0])
    rows = _pool_seeds(runs)
    return [
        replace(row, label=_label_among(row, [other for other in rows if other.label == row.label])) for row in rows
    ]


def _pool_seeds(runs: Sequence[Run]) -> list[Run]:
    """Return one run for each set of runs with equal options and distinct seeds."""
    groups: list[list[Run]] = []
    for run in runs:
        alike = (group for group in groups if _differ_in_seed(run, group))
        if group := next(alike, None):
            group.append(run)
        else:
            groups.append([run])
    return [_average(group) if len(group) > 1 else group[0] for group in groups]


def _differ_in_seed(run: Run, group: Sequence[Run]) -> bool:
    first, seeds = group[0], {member.result.seed for member in group}
    if (run.result.model, run.result.engine) != (first.result.model, first.result.engine):
        return False
    sections = [*(run.result.settings | first.result.settings)]
    return run.result.seed not in seeds and not _differing_without_seed([run, first], sections)


def _differing_without_seed(runs: Sequence[Run], sections: Sequence[str]) -> dict[str, list[Any]]:
    """Return the options in which runs differ, without the seed and options that follow it.

    These are options such as `model.seed`, and those that the automatic settings chose in all runs.
    """
    seeds = [run.result.seed for run in runs]
    chosen = set.intersection(*({setting.option for setting in run.result.recipe} for run in runs))
    options = differing([run.result.settings for run in runs], sections)
    options = {name: values for name, values in options.items() if not (name.endswith("seed") and values == seeds)}
    return {name: values for name, values in options.items() if not any(f"{name}.".startswith(f"{o}.") for o in chosen)}


def _average(runs: Sequence[Run]) -> Run:
    """Return the run with the lowest training error, with the mean errors of all."""
    members = sorted(runs, key=lambda run: _rank_training(run.result))
    sections = {name: _mean([run.result[name] for run in runs]) for name in AVERAGED}
    rollouts = ("train_mae", "test_mae", "local_mae")
    errors = {name: np.mean([getattr(run.curves, name) for run in runs], axis=0) for name in rollouts}
    for part in ("train", "test"):
        sections["metrics"][part].diverged = int(np.isnan(errors[f"{part}_mae"]).sum())
    result = replace_fields(members[0].result, **sections)
    return replace(members[0], result=result, curves=replace(members[0].curves, **errors), members=tuple(members))


def _rank_training(result: Result) -> tuple[int, float]:
    train = result.metrics.train
    return train.diverged, np.inf if train.position_mae is None else train.position_mae


def _mean(values: Sequence[Any]) -> Any:
    """Return the mean of records of equal structure, without values that are None; counts are the largest ones."""
    present = [value for value in values if value is not None]
    first = present[0] if present else None
    if isinstance(first, Record):
        fields_ = first.__struct_fields__
        return replace_fields(first, **{name: _mean([value[name] for value in present]) for name in fields_})
    if isinstance(first, list):
        return [_mean(entries) for entries in zip(*present, strict=True)]
    if isinstance(first, float):
        return float(np.mean(present))
    return max(present) if isinstance(first, int) else first


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
            return f"{run.label}{descriptions[place]}"
    return f"{run.label} ({run.folder.name} {place})"


def _describe(same: Sequence[Run]) -> Iterator[list[str]]:
    """Yield texts that may distinguish runs of one model, one per run, the simplest first."""
    yield [f", fit {run.result.fit.method}" for run in same]
    options = _differing_without_seed(same, (*NAMED, "model"))
    seeded = {"seed": [run.options.get("seed") for run in same]} | options
    for shown in (each for each in (options, seeded) if len(each) <= MOST_NAMED):
        # Labels appear on shared pages and tables, which must not reveal paths of this machine.
        paths, joints = {path for run in same for path in list_paths_of(run.result)}, same[0].result.joints
        named = {name: without_paths(values, paths, joints) for name, values in shown.items()}
        words = {name: [_say(value) for value in values] for name, values in named.items()}
        yield ["".join(f", {name} {values[i]}" for name, values in words.items()) for i in range(len(same))]
    yield [f" ({run.folder.name})" for run in same]


def _say(value: Any) -> str:
    """Return the value of an option without the syntax of the configuration."""
    if isinstance(value, list | tuple):
        return " ".join(map(_say, value))
    return "none" if value is None else str(value).lower() if isinstance(value, bool) else str(value)
