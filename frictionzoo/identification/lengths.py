"""Lengths of evaluation rollouts and segments that the recordings allow, found before any fit."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from frictionzoo.core.errors import LogError
from frictionzoo.core.log import Dataset, Log
from frictionzoo.core.params import AUTO
from frictionzoo.core.segments import cut_segments, longest_window
from frictionzoo.identification.choices import Choice
from frictionzoo.result.evaluate import Evaluator

FEWEST = 10  # samples of a segment, and of an evaluation rollout
_log = logging.getLogger(__name__)


def fit_lengths(settings: Mapping[str, Any], dataset: Dataset, kind: str) -> tuple[dict[str, Any], tuple[Choice, ...]]:
    """Shorten evaluation rollouts to the recordings, and check that segments and rollouts can be cut.

    `kind` is the type of the joints, `hinge` or `slide`.

    Returns:
        Settings with the new lengths, and one choice for each.

    Raises:
        LogError: The recordings are too short for an evaluation, or for segments of a length that was set.
        ConfigError: An option of the evaluation is impossible.
    """
    for part, logs in (("test", dataset.test), ("train", dataset.train)):
        if (longest := max(logs, key=lambda log: log.samples)).samples <= FEWEST:
            raise LogError(
                f"{longest.name}: {longest.samples} samples to {part}, expected more than {FEWEST}; use a longer log, "
                "or change data.split"
            )
    evaluation = dict(settings["evaluation"])
    choices = tuple(_shorten(evaluation, dataset))
    evaluation |= {choice.option.partition(".")[2]: choice.value for choice in choices}
    for choice in choices:
        _log.info("%s", choice)
    Evaluator(dataset, kind, **evaluation)  # refuses impossible options before the work
    length = settings["segments"]["length"]
    if length != AUTO:
        cut_segments(dataset.train, 1, length)
    return {**settings, "evaluation": evaluation}, choices


def _shorten(evaluation: Mapping[str, Any], dataset: Dataset) -> Iterator[Choice]:
    """Yield the lengths of rollouts that the recordings do not allow: longer than they are, or below a sample."""
    test, train = _longest(dataset.test), _longest(dataset.train)
    interval = float(f"{dataset.test[0].timestep:.6g}")

    def limit(seconds: float, longest: float) -> float:
        return min(max(seconds, interval), longest) if seconds > 0 else seconds

    horizons = [limit(horizon, min(test, train)) for horizon in evaluation["horizons"]]
    lengths = {option: limit(evaluation[option], test) for option in ("trajectory", "local")}
    lengths["window"] = limit(evaluation["window"], lengths["trajectory"])
    reason = f"rollouts of {{}} s, with a sample every {interval:g} s; test recordings last {test:g} s"
    for option, value in {"horizons": list(dict.fromkeys(horizons)), **lengths}.items():
        if value != (before := evaluation[option]) and (option != "horizons" or horizons != list(before)):
            shown = ", ".join(f"{seconds:g}" for seconds in before) if option == "horizons" else f"{before:g}"
            yield Choice(f"evaluation.{option}", value, reason.format(shown))


def _longest(logs: Sequence[Log]) -> float:
    """Return the longest rollout that recordings with most of the samples allow [s]."""
    return float(f"{longest_window(logs) * logs[0].timestep:.6g}")
