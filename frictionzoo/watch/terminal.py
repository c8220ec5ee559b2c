"""Text display of jobs: one block per job on a terminal, or one line per change."""

from collections.abc import Iterator, Sequence
from itertools import groupby

from frictionzoo.core.telling import escape_controls
from frictionzoo.show.terminal import format_interval
from frictionzoo.show.text import format_number
from frictionzoo.watch.jobs import AT_WORK, Job

_NOTHING = "no run in it yet"


def draw(jobs: Sequence[Job], columns: int, rows: int) -> list[str]:
    """Return the lines for a terminal of this size: number of jobs, and each job with its parameters.

    If the terminal is too small, ended jobs are omitted first.
    """
    head = _count(jobs)
    blocks = [[say(job), *(f"  {line}" for line in list_parameters(job))] for job in jobs]
    left = 0
    # Active jobs matter most, then the most recent ones.
    for index in sorted(range(len(jobs)), key=lambda i: (jobs[i].state in AT_WORK, i)):
        if 1 + sum(map(len, blocks)) + 1 < rows:
            break
        blocks[index] = []
        left += 1
    lines = [head, *(escape_controls(line) for block in blocks for line in block)]
    if left:
        lines.append(f"and {left} more, for which this terminal is too small")
    return [line if len(line) < columns else f"{line[: columns - 2]}…" for line in lines]


def _count(jobs: Sequence[Job]) -> str:
    if not jobs:
        return _NOTHING
    states = sorted(job.state for job in jobs)
    told = [f"{len(list(same))} {state}" for state, same in groupby(states)]
    return f"{len(jobs)} job{'s' * (len(jobs) != 1)}: {', '.join(told)}"


def say(job: Job) -> str:
    """Return a job on one line, without its parameters."""
    if job.result:
        fit, test = job.result["fit"], job.result["metrics"]["test"]
        without = job.result["metrics"]["baseline"]["position_mae"]
        error = test["position_mae"]
        parts = [f"{fit['iterations']} iterations", f"loss {format_number(fit['loss'])}"]
        parts += ["test rollouts diverged" if error is None else f"test MAE {error:.3g} {test['unit']}"]
        parts += [f"{100 * (error / without - 1):+.0f} % against no friction"] if error is not None and without else []
        parts += [job.result["verdict"]["grade"]]
    else:
        limit = f" of {job.total}" if job.total else ""
        parts = [f"iteration {job.point.iterations}{limit}"] if job.point.iterations else []
        parts += [f"loss {job.point.loss:.3e}"] if job.point.loss is not None else []
    return ": ".join([f"{job.name}: {job.state}", *filter(None, [", ".join(parts), job.reason])])


def list_parameters(job: Job) -> list[str]:
    """Return parameters with current values; for a finished job also with interval and unit."""
    if not job.result:
        values = "  ".join(f"{name} {value:.4g}" for name, value in job.point.parameters.items())
        return [values] if values else []
    return list(_list_results(job))


def _list_results(job: Job) -> Iterator[str]:
    for parameter in job.result["parameters"]:
        for row in parameter["by_joint"]:
            if not row["identified"]:
                continue
            joint = f"/{row['name']}" if len(parameter["by_joint"]) > 1 else ""
            interval = f" ({format_interval(row['interval'])})" if row["interval"] else ""
            doubt = ", not identifiable" if row["identifiable"] is False else ""
            bound = ", at a bound" if row["at_bound"] else ""
            name = f"{parameter['owner']}.{parameter['name']}{joint}"
            yield f"{name} {format_number(row['value'])}{interval} {parameter['unit']}{doubt}{bound}"


def tell_changes(before: Sequence[Job] | None, now: Sequence[Job]) -> list[str]:
    """Return one line with parameters for each changed job; `before` is None at the first call."""
    if before is None and not now:
        return [_NOTHING]
    known = {job.name: job for job in before or ()}
    changed = [job for job in now if known.get(job.name) != job]
    return [escape_controls(" | ".join([say(job), *list_parameters(job)])) for job in changed]
