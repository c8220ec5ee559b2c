"""Command line: `python -m frictionzoo.run model=coulomb_stribeck`. Composes and calls; decides nothing."""

import contextlib
import itertools
import math
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NoReturn, cast

import hydra
import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Glob, Override, QuotedString, RangeSweep
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from frictionzoo.cli.sweep import SweepFolder, conclude_sweep, describe, objective_of, run_in_sweep
from frictionzoo.core.config import (
    CONF_DIR,
    check_overrides,
    compose_config,
    forget_plugin_schemas,
    list_choices,
    register_resolvers,
    suggest_option,
)
from frictionzoo.core.errors import ConfigError, FrictionzooError, OutputError, closest
from frictionzoo.core.output import RESULT, occupy, write_atomically
from frictionzoo.core.threads import limit_threads, threads_each

REFUSED = 2
"""Exit status of what a user has to mend."""
NOT_IDENTIFIED = 3
"""Exit status where a fit ended well and what it found is not the drive; of a sweep, where that is recommended."""

# What a resumed run takes over from its folder: an option of the job, not a flag or a way into Hydra's own settings.
_OVERRIDE = re.compile(r"(\+\+?|~)?\w[\w/.-]*(=|$)")
MOST_JOBS = 100_000  # of one range in a sweep
_FOLDERS = ("hydra.run.dir", "hydra.sweep.dir", "hydra.sweep.subdir")
_OPTIONAL_GROUPS = ("experiment", "variant")


class Stopped(BaseException):
    """Ctrl-C or SIGTERM. No Exception: that, a library may take for a failure of its own and go on."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


@hydra.main(version_base="1.3", config_path=str(CONF_DIR), config_name="config")
def _job(config: DictConfig) -> float:
    """One job of Hydra's; returns what a sweeper may minimise."""
    hydra_config = HydraConfig.get()
    model, folder = hydra_config.runtime.choices["model"], Path(hydra_config.runtime.output_dir)
    # A run's record does not tell whether it was interrupted; what this option says, Hydra has done.
    resumed, config.resume = config.resume, None
    if hydra_config.mode == RunMode.MULTIRUN:
        options = hydra_config.overrides.task
        finished = cast(dict[str, Any], OmegaConf.to_container(config, resolve=True)) if resumed else None
        # In processes of a launcher, nobody else answers.
        with _stoppable():
            return run_in_sweep(lambda: _identify(config, model, folder), folder, model, options, _explain, finished)
    # Ended inside, because Hydra adds a line of its own to an error that passes through it.
    with mistakes_in_one_line(lambda: _say_how_a_run_goes_on(folder)), occupy(folder, wait=False):
        result, complaint = _identify(config, model, folder)
    if complaint:
        _fail(complaint)
    if result["not_identified"]:
        sys.exit(NOT_IDENTIFIED)
    return objective_of(result)


def _identify(config: DictConfig, model: str, folder: Path) -> tuple[dict[str, Any], str | None]:
    hydra_config = HydraConfig.get()
    check_overrides(config, compose_config(*choices_of(hydra_config.runtime.choices)))
    alone = hydra_config.mode == RunMode.RUN or hydra_config.runtime.choices["hydra/launcher"] == "basic"
    limit_threads(config.threads if alone else threads_each(config.threads))
    # Imported here, so that --help and a typing error do not wait for torch and JAX, and that these meet the limit.
    from frictionzoo.cli.job import run_job
    from frictionzoo.show.terminal import summarise

    with _quiet_writers():
        result, complaint = run_job(config, model, folder)
    print(summarise(result, folder))
    return result, complaint


def main() -> None:
    """Entry point of `python -m frictionzoo.run` and of the console script `frictionzoo`.

    A user's mistake is one line on the standard error and exit status 2. In a sweep, it is one line for each job that
    failed, after the last one. A fit that did not identify the drive ends with status 3. Ctrl-C ends it with one line
    and status 130, SIGTERM with status 143.
    """
    register_resolvers()
    forget_plugin_schemas()
    # Hydra would print its own page; with this it raises, and the line below is printed instead.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    SweepFolder.latest = None
    with mistakes_in_one_line(_say_how_a_sweep_goes_on):
        sys.argv[1:] = _restore_overrides(sys.argv[1:])
        refuse_no_choice(sys.argv[1:])
        with _keep_record(_last_value("hydra.run.dir", sys.argv[1:])):
            complaint = _run_jobs()
        if SweepFolder.latest is not None:
            comparison, text, complaints = conclude_sweep(SweepFolder.latest)
            print(text)
            if complaint:
                complaints.append(complaint)
            if complaints:
                _fail(*complaints)
            if comparison and (comparison["recommendation"] or {}).get("not_identified"):
                sys.exit(NOT_IDENTIFIED)


@contextlib.contextmanager
def _keep_record(folder: str | None) -> Iterator[None]:
    """Put a folder's record of how its run began back if today's command is refused: Hydra replaces it before that.

    Args:
        folder: The run's folder, if the command names one.
    """
    record = {} if folder is None else {path: path.read_bytes() for path in Path(folder, ".hydra").glob("*.yaml")}
    try:
        yield
    except BaseException as error:
        if not isinstance(error, SystemExit) or error.code == REFUSED:
            for path, content in record.items():
                write_atomically(path, content)
        raise


def _run_jobs() -> str | None:
    """All jobs; returns one line of complaint if a sweep ended early."""
    try:
        _job()
    except Exception as error:
        refused = isinstance(error, HydraException | OmegaConfBaseException) or _missing_plugin(error)
        if SweepFolder.latest is None or refused:
            raise
        return f"the sweep ended early ({describe(error)}); jobs that had not begun are not listed"
    return None


@contextlib.contextmanager
def mistakes_in_one_line(go_on: Callable[[], str] = lambda: "nothing is kept; run it again") -> Iterator[None]:
    """Turn an error that a user can cause into one line and exit status 2, a signal into one and 128 + its number.

    Args:
        go_on: Says, for a signal or a disk that takes no more, what is kept and how to go on.
    """
    with _stoppable():
        try:
            yield
        except Stopped as stop:
            _fail(f"stopped by {signal.Signals(stop.number).name}; {go_on()}", status=128 + stop.number)
        except Exception as error:
            line = _explain(error)
            if line is None:
                raise
            ended = isinstance(error, OSError | OutputError) and not isinstance(error, HydraException)  # one is both
            _fail(f"{line}; {go_on()}" if ended else line)


@contextlib.contextmanager
def _stoppable() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM raise `Stopped`, once: another one does not disturb what is cleaned up then.

    Whoever answers them already, or ignores them, goes on to.
    """

    def stop(number: int, frame: Any) -> None:
        if not stopped:
            stopped.append(number)
            raise Stopped(number)

    def try_again(lost: Any) -> None:
        # Python drops what is raised in a callback of its garbage collection, and JAX has one.
        if not isinstance(lost.exc_value, Stopped):
            return hook(lost)
        stopped.clear()
        threading.Timer(0.05, os.kill, [os.getpid(), lost.exc_value.number]).start()

    stopped: list[int] = []
    before, hook = {}, sys.unraisablehook
    for number in (signal.SIGINT, signal.SIGTERM):
        answered = signal.getsignal(number) not in (signal.SIG_DFL, signal.default_int_handler)
        if not answered and threading.current_thread() is threading.main_thread():
            before[number] = signal.signal(number, stop)
    if before:
        sys.unraisablehook = try_again
    try:
        yield
    finally:
        sys.unraisablehook = hook
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def _quiet_writers() -> Iterator[None]:
    """Print nothing about a thread that a full disk ended: TensorBoard hands its error to whoever writes next."""
    hook = threading.excepthook
    threading.excepthook = lambda thread: None if isinstance(thread.exc_value, OSError) else hook(thread)
    try:
        yield
    finally:
        threading.excepthook = hook


def _say_how_a_run_goes_on(folder: Path) -> str:
    """What an unfinished run keeps, and how it goes on."""
    try:
        _read_overrides(folder)
    except ConfigError:  # it had not come so far
        return "nothing is kept; run it again"
    kept = "the fit up to its last checkpoint" if (folder / "checkpoints" / "last.ckpt").exists() else "its options"
    return f"{folder} keeps {kept}; go on with resume={folder}"


def _say_how_a_sweep_goes_on() -> str:
    """The same for a sweep; before anything has begun, nothing is kept."""
    folder = SweepFolder.latest
    if folder is None or not _holds_jobs(folder):
        return "nothing is kept; run it again"
    done = len(list(folder.rglob(RESULT)))
    return f"{folder} keeps {done} finished jobs; go on with the same command and hydra.sweep.dir={folder} resume=true"


def _fail(*lines: str, status: int = REFUSED) -> NoReturn:
    for line in lines:
        print(f"frictionzoo: {line}", file=sys.stderr)
    sys.exit(status)


def _restore_overrides(arguments: list[str]) -> list[str]:
    """For `resume=FOLDER`, the overrides with which that run began, before those of today."""
    named = _last_value("resume", arguments)
    if named in (None, "null"):
        return arguments
    if not named:
        raise ConfigError("resume=: expected the folder of a run; name one, or leave it out")
    if named.lower() == "true" or {"-m", "--multirun"} & set(arguments):
        _refuse_no_sweep(named, arguments)
        return arguments
    # Hydra would replace the folder's record of how the run began by today's command, which may be a mistaken one.
    return [*_read_overrides(Path(named)), *arguments, "hydra.output_subdir=null"]


def _read_overrides(folder: Path) -> list[str]:
    """The overrides with which the run in a folder began."""
    saved = folder / ".hydra" / "overrides.yaml"
    try:
        overrides = OmegaConf.to_container(OmegaConf.load(saved))
    except (OSError, OmegaConfBaseException, ValueError, yaml.YAMLError):
        hint = f"; a sweep goes on with -m hydra.sweep.dir={folder} resume=true" if _holds_jobs(folder) else ""
        raise ConfigError(
            f"resume={folder}: no {saved} that can be read, expected a run folder; name one{hint}"
        ) from None
    if not isinstance(overrides, list) or not all(isinstance(item, str) for item in overrides):
        raise ConfigError(f"{saved}: expected a list of overrides; name a run folder that this program made")
    kept = [item for item in overrides if not re.match(r"[+~]*(resume|hydra)\b", item)]
    for item in kept:
        if not _OVERRIDE.match(item):
            raise ConfigError(f"{saved}: {item}; expected an override; name a run folder that this program made")
    return kept


def _last_value(option: str, arguments: list[str]) -> str | None:
    values = [argument.partition("=")[2] for argument in arguments if argument.startswith(f"{option}=")]
    return values[-1].strip("'\"") if values else None


def _refuse_no_sweep(resume: str, arguments: list[str]) -> None:
    """Refuse to go on with a sweep that is not there."""
    if resume.lower() != "true":
        raise ConfigError(
            f"resume={resume}: expected true, as a run goes on without -m; name a sweep's folder in hydra.sweep.dir"
        )
    folder = _last_value("hydra.sweep.dir", arguments)
    if not {"-m", "--multirun"} & set(arguments) or folder is None:
        raise ConfigError(
            "resume=true: expected the command of a sweep, -m and hydra.sweep.dir=FOLDER; or name the folder of a run"
        )
    if not _holds_jobs(Path(folder)):
        raise ConfigError(f"hydra.sweep.dir={folder}: no job in it, expected a sweep's folder; leave resume=true out")


def _holds_jobs(sweep: Path) -> bool:
    return any(sweep.rglob(".hydra"))


def refuse_no_choice(arguments: list[str]) -> None:
    """Refuse what is no override, and what does not choose one file of a group.

    Args:
        arguments: Those of the command line.

    Raises:
        ConfigError: One cannot be read, or chooses none, several, or something that is no name.
    """
    for override in _read_arguments(arguments):
        group = override.key_or_group
        _refuse_no_setting(override)
        if not ("/" in group or _is_group(group)):
            continue
        names = _choices(override)
        known = all(isinstance(name, str) for name in names)
        if group in _OPTIONAL_GROUPS and (override.is_delete() or (known and set(names) <= set(list_choices(group)))):
            continue
        if override.is_delete() or not known or group == "variant":
            asked = str(override.input_line)
            needed = (
                "expected one name, or to leave it out" if group in _OPTIONAL_GROUPS else f"a job needs one {group}"
            )
            raise ConfigError(f"{asked}: {needed}; {closest(asked.partition('=')[2], list_choices(group))}")


def _refuse_no_setting(override: Override) -> None:
    """ConfigError for a setting of Hydra's that it would take for the working directory, or fail over."""
    name, value = override.key_or_group, override.value()
    if name in _FOLDERS and value in (None, ""):
        raise ConfigError(f"{override.input_line}: expected a folder; name one, or leave it out")
    if name == "hydra.verbose" and not isinstance(value, bool | str | list):
        raise ConfigError(f"{override.input_line}: expected true, false, or names of loggers")
    # Hydra would write them all down before the first one begins.
    if isinstance(value, RangeSweep) and not 0 < _count(value) <= MOST_JOBS:
        raise ConfigError(
            f"{override.input_line}: {_count(value):.3g} jobs, expected 1 to {MOST_JOBS}; range(start,stop,step) ends "
            "before stop"
        )


def _count(values: RangeSweep) -> float:
    """How many values a range has; below 0 or infinite where it leads nowhere."""
    start, stop, step = (float(number or 0) for number in (values.start, values.stop, values.step))
    steps = (stop - start) / step if step else math.inf
    return float(math.ceil(steps)) if math.isfinite(steps) else math.inf


def _read_arguments(arguments: list[str]) -> Iterator[Override]:
    """The arguments that are overrides; ConfigError for one that Hydra cannot read, with which it would not name it."""
    parser = OverridesParser.create()
    for argument in arguments:
        if argument.startswith("-") or not ("=" in argument or argument.startswith("~")):
            continue
        if argument.startswith("="):
            raise ConfigError(f"{argument}: expected KEY=VALUE")
        try:
            yield parser.parse_override(argument)
        except HydraException as error:
            reason = " ".join(str(error).partition("\nSee ")[0].split())
            raise ConfigError(
                f"{argument}: cannot be read ({reason}); expected KEY=VALUE, quoted for the shell"
            ) from None


def _choices(override: Override) -> list[Any]:
    """What an override chooses of a group: names, one for each job of a sweep, or whatever stands in their place."""
    value = override.value()
    if isinstance(value, Glob):
        return value.filter(list_choices(override.key_or_group))
    chosen = value.list if isinstance(value, ChoiceSweep) else [value]
    return [name.text if isinstance(name, QuotedString) else name for name in chosen]


def choices_of(chosen: Mapping[str, str | None]) -> Iterator[str]:
    """Overrides that choose the same files of the configuration groups, and nothing else.

    Args:
        chosen: File by group, as Hydra tells it.
    """
    for group, name in chosen.items():
        if name is not None and group != "experiment" and not group.startswith("hydra/"):
            yield f"{group}={name}"


def _is_group(name: str) -> bool:
    return bool(name) and (CONF_DIR / name).is_dir()


def _explain(error: Exception) -> str | None:
    """One line for an error that a user can cause, None for any other."""
    if isinstance(error, FrictionzooError):
        return str(error)
    if isinstance(error, HydraException | OmegaConfBaseException):
        return _explain_refusal(str(error))
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or 'the disk'}: {error.strerror}; free space or set hydra.run.dir to another folder"
    if isinstance(error, MemoryError):
        return f"out of memory ({' '.join(str(error).split()) or 'nothing is free'}); lower the sizes that were set"
    return _missing_plugin(error)


def _missing_plugin(error: Exception) -> str | None:
    """One line for a launcher or sweeper whose package is not installed."""
    missing = re.search(r"Unknown plugin class : 'hydra_plugins\.hydra_(\w+?)_(launcher|sweeper)\.", str(error))
    if not missing:
        return None
    name, kind = missing.groups()
    return f"the {kind} {name} is not installed, expected hydra-{name}-{kind}; pip install 'frictionzoo[{name}]'"


def _explain_refusal(text: str) -> str:
    """One line for what Hydra or OmegaConf refuses, with the closest name."""
    missing = re.search(r"Could not find '([\w/]+)/([^'/]*)'", text)
    if missing:
        group, name = missing.groups()
        return f"{group}={name}: no such {group}; {closest(name, list_choices(group))}"
    unknown = re.search(r"Could not override '([^']+)'", text)
    if unknown and not unknown[1].startswith("hydra."):
        return _explain_unknown(unknown[1])
    unfit = re.fullmatch(r"Error merging override (.*)", text.strip())
    if unfit:
        return f"{unfit[1]}: expected a value, or a section, of the kind that it replaces; compare with --cfg all"
    return " ".join(text.split())


def _explain_unknown(option: str) -> str:
    """One line for an option that does not exist, in a sweep for the first job that lacks it."""
    chosen = [override for override in _read_arguments(sys.argv[1:]) if _is_group(override.key_or_group)]
    chosen = [override for override in chosen if override.key_or_group != option]
    for names in itertools.product(*map(_choices, chosen)):
        choices = [f"{override.key_or_group}={name}" for override, name in zip(chosen, names, strict=True)]
        try:
            config = compose_config(*choices)
        except HydraException as error:
            return _explain_refusal(str(error))
        if not _has(OmegaConf.to_container(config), option):
            swept = [choice for choice, override in zip(choices, chosen, strict=True) if override.is_sweep_override()]
            job = f" with {' '.join(swept)}" if swept else ""
            return f"{option}: unknown option{job}; {suggest_option(option, config)}"
    # Hydra looks at a sweep as a whole first, with the default of each group that is swept.
    group = option.partition(".")[0]
    return f"{option}: each job of this sweep has it, the default {group} has not; write ++{option}=VALUE"


def _has(section: Any, option: str) -> bool:
    name, _, rest = option.partition(".")
    return isinstance(section, dict) and name in section and (not rest or _has(section[name], rest))
