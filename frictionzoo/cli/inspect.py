"""Command line: `python -m frictionzoo.inspect FILE` or `data=...` checks recordings before a fit."""

import contextlib
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import hydra
import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from frictionzoo.cli.mistakes import mistakes_in_one_line
from frictionzoo.cli.overrides import choices_of, given_to_hydra, quote_values, refuse_no_choice
from frictionzoo.core.build import build
from frictionzoo.core.config import CONF_DIR, check_overrides, compose_config, prepare_hydra, resolve
from frictionzoo.core.errors import ConfigError, FrictionzooError
from frictionzoo.core.output import claim
from frictionzoo.core.telling import say, tell
from frictionzoo.data.source import Source

FOLDER = "outputs/${now:%Y-%m-%d}/${now:%H-%M-%S}_inspect_${hydra:runtime.choices.data}"


@hydra.main(version_base="1.3", config_path=str(CONF_DIR), config_name="config")
def _inspect(config: DictConfig) -> None:
    # Errors end here, because Hydra adds a line to an error that passes through it.
    with mistakes_in_one_line():
        hydra_config = HydraConfig.get()
        if hydra_config.mode == RunMode.MULTIRUN:
            raise ConfigError("--multirun: one data set at a time; leave it out")
        tell("reading bench and recordings")
        check_overrides(config, compose_config(*choices_of(hydra_config.runtime.choices)))
        choices = hydra_config.runtime.choices
        has_bench = choices["data"] != "files" or any(text.startswith("bench") for text in hydra_config.overrides.task)
        bench = _build_bench(config) if has_bench else None
        say(inspect_data(config, Path(hydra_config.runtime.output_dir), bench, hydra_config.overrides.task))


def inspect_data(config: DictConfig, folder: Path, bench: Any = None, options: Sequence[str] = ()) -> str:
    """Check the data set of a job's configuration, write `inspect.html` and `inspect.json`, and return a summary.

    `bench` is the recordings' test stand, None if unknown; `options` are the user's, for the command to run next.

    Raises:
        FrictionzooError: The input is at fault, or a file cannot be written.
    """
    # Imported late: neither --help nor a mistake waits for it.
    from frictionzoo.api.inspected import FILES, Inspected
    from frictionzoo.diagnostics.survey import list_recordings
    from frictionzoo.report.inspection_terminal import summarise

    data = resolve(config.data)
    source, joints, joint_type = build(data, Source), (), None
    if bench is not None:
        source, joints, joint_type = source.for_joints(bench.joints, bench.passive), bench.joints, bench.joint_type
    tell("checking the recordings")
    with claim(folder, "inspection", FILES):  # an unusable output folder raises before the work
        inspected = Inspected.of(str(data.get("name", "data")), list_recordings(source), joints, joint_type)
        survey = inspected.survey
        survey["findings"] = [_settle(finding, config) for finding in survey["findings"]]
        doubtful = [finding for finding in survey["findings"] if finding["state"] in ("caution", "bad")]
        options_to_set = [finding["option"] for finding in doubtful if finding["option"]]
        suggested = dict.fromkeys(option for option in options_to_set if not option.endswith("=..."))
        command = shlex.join(["python", "-m", "frictionzoo.run", *options, *suggested])
        inspected.save(folder, command)
    return summarise(survey, folder, command)


def _settle(finding: Mapping[str, Any], config: DictConfig) -> Mapping[str, Any]:
    """Return a finding as a note if its option is set already, or another sample interval, or spikes are dropped."""
    name, _, value = (finding["option"] or "").partition("=")
    present = OmegaConf.select(config, name) if name else None
    drops = finding["title"].startswith("Spikes") and present == "drop"
    if present is None or not (present == yaml.safe_load(value) or name == "data.clean.step" or drops):
        return finding
    text = f"{finding['text']} Set already: {name}={str(present).lower()}."
    return {**finding, "state": "note", "text": text, "option": None}


def _build_bench(config: DictConfig) -> Any:
    """Return the bench; None if it cannot be built, since the recordings can be checked without it."""
    with contextlib.suppress(FrictionzooError):
        from frictionzoo.bench.given import build_open

        return build_open(resolve(config.bench))[0]
    return None


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command like `run`; files and folders may precede the overrides."""
    prepare_hydra()
    # The last override of an option, the user's, wins.
    overrides = [
        f"hydra.run.dir={FOLDER}",
        *quote_values(_name_files(sys.argv[1:] if arguments is None else arguments)),
    ]
    with mistakes_in_one_line(overrides=overrides):
        refuse_no_choice(overrides)
        with given_to_hydra(overrides):
            _inspect()


def _name_files(arguments: Sequence[str]) -> list[str]:
    """Replace leading file names by `data=files` and `data.train`."""
    count = next((i for i, argument in enumerate(arguments) if "=" in argument or argument[:1] in "-~"), len(arguments))
    files = [f'"{name}"' for name in arguments[:count]]
    return [*(["data=files", f"data.train=[{','.join(files)}]"] if files else []), *arguments[count:]]
