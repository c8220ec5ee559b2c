"""Commands of the program and their help pages, without importing Hydra or the numerical packages."""

import gc
import importlib
import os
import re
import signal
import sys
from collections.abc import Sequence

from frictionzoo import __version__
from frictionzoo.cli.mistakes import exit_beside_threads, fail, hand_over_output, outlive_readers
from frictionzoo.core.errors import closest
from frictionzoo.core.telling import tell, telling_again

COMMANDS = {
    "run": "identify a drive (the default command)",
    "compare": "compare runs on the same data: table, figures, a page",
    "inspect": "check recordings before a fit",
    "export": "export an identified drive to another program",
    "card": "publish an identified drive without its run",
    "distill": "fit a simpler model to an identified drive",
    "drift": "check with a new recording whether a drive has changed",
    "design": "design the command to record next, within limits",
    "list": "list models, methods, formats and other choices",
}
"""Summary of each command; a function of `finished` takes its arguments, or `main` of the module in `_MODULES`."""

HELP = """\
frictionzoo identifies a drive's armature and friction from its encoder log. It
fits a friction model until the MuJoCo simulation matches the recording.

usage: frictionzoo [run] [GROUP=FILE ...] [OPTION=VALUE ...]
       frictionzoo COMMAND ...

commands (frictionzoo COMMAND is python -m frictionzoo.COMMAND):
{commands}
  Each command has --help; this page is the help of run.

examples (RUN stands for a run's folder, outputs/DATE/TIME_DATA_MODEL):
  A first run, on simulated recordings
    frictionzoo data=twin_clean model=coulomb_stribeck
  Your recording: check it, then identify it on your test stand
    frictionzoo inspect a.csv
    frictionzoo data=files 'data.train=[a.csv]' bench.mjcf=stand.xml \\
      bench.joint=shaft bench.actuator.params.kp.init=15
  List the models; fit another one by Levenberg-Marquardt
    frictionzoo list models
    frictionzoo model=mujoco_default fit=lm segments.length=1000
  A real data set, from the folder FRICTIONZOO_DATA
    frictionzoo experiment=emps
  In double precision
    frictionzoo model=dahl dtype=float64
  Compare models, three seeds each
    frictionzoo -m model=coulomb_smooth,coulomb_stribeck seed=0,1,2
  All models, on all cores of this machine or on a Slurm cluster
    frictionzoo -m hydra/launcher=joblib 'model=glob(*)'
    frictionzoo -m hydra/launcher=submitit_slurm 'model=glob(*)' seed=0,1,2
  Compare finished runs
    frictionzoo compare RUN OTHER_RUN --output comparison
  Resume a stopped run
    frictionzoo resume=RUN
  Export the drive as MJCF; publish it as a card; fit a simpler model
    frictionzoo export RUN target=mjcf
    frictionzoo card RUN licence=cc-by-4.0
    frictionzoo distill RUN model=stribeck
  Check with a new recording whether the drive has changed
    frictionzoo drift RUN b.csv
  Design the next recording of an identified drive
    frictionzoo design RUN position=1.5 velocity=4 torque=2

options of a run:
  GROUP=FILE    a file of conf/: of bench, data, experiment, fit, logger; or a
                friction model: model=NAME
  OPTION=VALUE  an entry of these files: segments.length=20
  -m            one job for each combination of values with commas between them
  --cfg job     print all options with their values and exit; --resolve
                also resolves references between options
  --hydra-help  flags and settings of Hydra, which composes the options
  --version     print the version
  -sc           install=bash: install shell completion, see docs/
  Quote brackets, blanks and $ for the shell: 'data.train=[a.csv]'.
  Comments in conf/ explain each option; docs/ has the manual.

exit status: 0 done; 2 refused, or a job failed: one line says why; 3 done,
but the drive was not identified; 4 drift found a change; 130 and 143 stopped
by Ctrl-C and by SIGTERM.
"""
_INSPECT = """\
frictionzoo inspect checks recordings before a fit: clock, gaps, spikes, lag,
excitation. It prints a summary and writes inspect.html and inspect.json.

usage: frictionzoo inspect FILE ... [OPTION=VALUE ...]
       frictionzoo inspect data=NAME [OPTION=VALUE ...]

examples:
    frictionzoo inspect a.csv b.csv
    frictionzoo inspect a.csv data.units.qpos=deg
    frictionzoo inspect data=emps

Options: data options of a run, and hydra.run.dir=FOLDER for the output.
"""
_FLAGS = {"-h", "--help"}
_COMPLETED = "COMP_LINE"  # variable with the line that a shell completes
_SWEEP = {"-m", "--multirun"}
_MODULES = ("run", "inspect", "list")  # commands with a module of that name
_COMPOSING = ("run", "inspect")  # commands that wait for Hydra before their first output


def main(*command: str) -> None:
    """Run the console script, or `python -m frictionzoo.COMMAND`, which passes its name as `command`."""
    # Objects that torch and JAX create persist; collecting garbage among them takes a tenth of a short run.
    gc.set_threshold(50_000, 20, 10)
    # Ctrl-C ends the program without a traceback until a command handles it.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    outlive_readers()
    try:
        with telling_again():
            dispatch([*command, *sys.argv[1:]])
    except SystemExit as end:
        if isinstance(end.code, int) and end.code > 128:
            exit_beside_threads(end.code)
        raise
    finally:
        hand_over_output()
        gc.freeze()  # at exit Python would look for garbage among millions of objects, which takes about 2 s


def dispatch(arguments: Sequence[str]) -> None:
    """Run the command that the arguments name, by default `run`, or print its help."""
    name, rest = arguments[0] if arguments else "", arguments[1:]
    if name not in COMMANDS:
        if re.fullmatch(r"[\w./]+", name):  # neither a flag nor an override
            fail(f"{name}: no such command; {closest(name, COMMANDS)}; options of a run are OPTION=VALUE")
        name, rest = "run", arguments
    if name == "run" and _FLAGS & {*rest}:
        print(HELP.format(commands="\n".join(f"  {name:<8} {does}" for name, does in COMMANDS.items())), end="")
    elif name == "inspect" and _FLAGS & {*rest}:
        print(_INSPECT, end="")
    elif "query=bash" in rest or "query=fish" in rest:
        _complete(rest)
    elif "--version" in rest:
        print(f"frictionzoo {__version__}")
    else:
        if name in _COMPOSING and not any(argument.startswith("-") for argument in {*rest} - _SWEEP):
            tell(f"frictionzoo {name}: reading the options")
        module, function = (name, "main") if name in _MODULES else ("finished", name)
        getattr(importlib.import_module(f"frictionzoo.cli.{module}"), function)(rest)


def _complete(asked: Sequence[str]) -> None:
    """Print completions for a shell: names of commands, and options of `run` and `inspect` from Hydra."""
    program, *words = os.environ.get(_COMPLETED, "").split(" ")
    if len(words) == 1:
        print(*(name for name in COMMANDS if name.startswith(words[0])))
    elif words and words[0] in COMMANDS:
        if words[0] not in _COMPOSING:
            return  # the shell completes file names
        os.environ[_COMPLETED] = " ".join([program, *words[1:]])
    importlib.import_module("frictionzoo.cli.run").main(asked)
