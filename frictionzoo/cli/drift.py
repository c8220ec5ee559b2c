"""Check of a drive with new recordings, read like those of its run."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from frictionzoo.api.drift import ALARM, FILE, SMALLEST, drift
from frictionzoo.api.identified import Identified
from frictionzoo.cli.mistakes import CHANGED, NOT_IDENTIFIED
from frictionzoo.core import config as conf
from frictionzoo.core.build import build
from frictionzoo.core.errors import ConfigError, read_number
from frictionzoo.core.output import RUN_FILES, claim, refuse_existing
from frictionzoo.core.telling import say, tell
from frictionzoo.data.files import Files
from frictionzoo.report.terminal import summarise_drift

STATUS = {"unchanged": 0, "changed": CHANGED, "cannot tell": NOT_IDENTIFIED}
_NUMBERS = {"alarm": ALARM, "smallest": SMALLEST}
# Choices of files of a run, which new files do not share.
_OF_RUN = ("train", "test", "folder", "source", "where", "exclude")


def report_drift(runs: Sequence[Path], recordings: Sequence[str], options: Mapping[str, str]) -> int:
    """Compare a drive with its runs, print and save the comparison, and return the exit status.

    The options are `data.*`, `alarm`, `smallest` and `output`.

    Raises:
        FrictionzooError: A run or recording cannot be read, or an option is invalid. No files remain.
    """
    folder = Path(options.get("output", time.strftime("outputs/%Y-%m-%d/%H-%M-%S_drift")))
    refuse_existing(folder)  # before the fit
    numbers = {name: read_number(name, options.get(name, default)) for name, default in _NUMBERS.items()}
    drives = [Identified.load(run) for run in runs]
    own = {option: value for option, value in options.items() if option not in (*_NUMBERS, "output")}
    section = compose_data(drives[0].result.settings, recordings, own)
    bench = drives[0].bench
    logs = build(section, Files).for_joints(bench.joints, bench.passive).read()
    tell("identifying the drive again")
    with claim(folder, "run", (*RUN_FILES, FILE), undone=True):
        found = drift(drives, logs, **numbers)
        found.save(folder)
    say(summarise_drift(found.record, folder))
    return STATUS[found.verdict]


def compose_data(settings: Mapping[str, Any], recordings: Sequence[str], options: Mapping[str, str]) -> dict[str, Any]:
    """Return the section `data` that reads recordings as a run read its files, with other options by dotted name.

    A run whose recordings were not files leaves the reader's defaults.

    Raises:
        ConfigError: An option is unknown, invalid or not of `data`.
    """
    for option in options:
        if not option.startswith("data."):
            expected = "expected data.*, alarm, smallest or output; all other settings are the run's"
            raise ConfigError(f"{option}: {expected}; leave it out")
    plain = conf.resolve(conf.compose_config("data=files").data)
    saved = conf.keep_caches_at_home(settings).get("data", {})
    were_files = str(saved.get("_target_", "")).endswith(".Files")
    kept = {key: value for key, value in saved.items() if key in plain} if were_files else {}
    section = {**plain, **kept, **{key: plain[key] for key in _OF_RUN}, "train": list(recordings)}
    if section["split"].get("by") != "time":
        section["split"] = plain["split"]
    return conf.resolve(conf.override(conf.create_literal({"data": section}), options).data)
