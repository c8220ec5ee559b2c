"""Next steps after a design, as shell commands: a command for the test recording, and the analysis of recordings."""

import json
import shlex
from collections.abc import Iterator, Mapping
from typing import Any

from frictionzoo.bench import Bench
from frictionzoo.core.config import compose_config, list_choices, list_options, resolve
from frictionzoo.models import FrictionModel
from frictionzoo.models.by_joint import ByJoint

_RECORDED = "'data.train=[a.csv]' 'data.test=[b.csv]'"


def list_steps(
    options: Mapping[str, str],
    run: str | None,
    settings: Mapping[str, Any],
    bench: Bench,
    model: FrictionModel,
    length: int,
) -> list[dict[str, str]]:
    """List purpose and shell command of each step, in order.

    `options` are those of the design, as text; `run` is the folder of the drive's run; `settings` are those of a run,
    with bench and friction model; `length` counts the sample intervals in a segment of the fit.
    """
    test_options = {**options, "seed": str(int(options.get("seed", "0")) + 1), "output": "excitation_test"}
    arguments = [*([run] if run else []), *(f"{name}={value}" for name, value in test_options.items())]
    fit = shlex.join(
        [*_list_drive_options(settings), *_choose_law(bench, model), "fit=lm", f"segments.length={length}"]
    )
    steps = {
        "Another command, to test on": shlex.join(["python", "-m", "frictionzoo.design", *arguments]),
        "Look at the recordings": "frictionzoo inspect a.csv b.csv",
        "Fit them, with the segments of the design": f"python -m frictionzoo.run data=files {_RECORDED} {fit}",
    }
    return [{"purpose": purpose, "command": command} for purpose, command in steps.items()]


def _choose_law(bench: Bench, model: FrictionModel) -> list[str]:
    if not isinstance(model, ByJoint):
        return [f"model={model.name}"]
    laws = {name: model.of_joint(index)[0].name for index, name in enumerate(bench.joints)}
    return ["model=by_joint", f"model.laws={{{', '.join(f'{name}: {law}' for name, law in laws.items())}}}"]


def _list_drive_options(settings: Mapping[str, Any]) -> list[str]:
    """List the fewest options that turn the bench of data=files into the bench of the design."""
    wanted = dict(_list_leaves(settings))
    return min((_differ(wanted, choice) for choice in ("", *list_choices("bench"))), key=len)


def _differ(wanted: Mapping[str, Any], bench: str) -> list[str]:
    """List the options that this bench file needs; options chosen by a recipe stay open."""
    chosen = [f"bench={bench}"] if bench else []
    present = dict(_list_leaves(resolve(compose_config("data=files", "recipe=given", *chosen))))
    return chosen + [
        f"{'' if name in present else '+'}{name}={_write(value)}"
        for name, value in wanted.items()
        if name not in present or present[name] != value
    ]


def _list_leaves(settings: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    return list_options({name: settings[name] for name in ("bench", "scale")})


def _write(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))
