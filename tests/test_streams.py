"""Commands whose output nobody reads, and processes that are forked too late."""

import json
import os
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import ROOT

CLOSED = {
    **{"from the start": ">&-", "errors too": ">&- 2>&-", "after a line": "| head -c 1 > /dev/null"},
    "all": "<&- >&-",
}


def run(command: str, folder: Path, **variables: str) -> tuple[int, str]:
    """The exit status of the first program of a shell's command, and the standard error."""
    script = f"set -o pipefail; {sys.executable} -m frictionzoo.{command}; echo $? > status"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **variables}
    found = subprocess.run(["bash", "-c", script], cwd=folder, env=environment, capture_output=True, text=True)
    return int((folder / "status").read_text()), found.stderr


@pytest.mark.parametrize("closed", CLOSED.values())
@pytest.mark.parametrize("arguments", ["run --help", "list models", "run --version"])
def test_a_command_whose_output_is_closed_ends_in_silence(tmp_path: Path, closed: str, arguments: str) -> None:
    assert run(f"{arguments} {closed}", tmp_path) == (0, "")


def test_output_that_the_disk_does_not_take_is_a_line(tmp_path: Path) -> None:
    status, err = run("run --help > /dev/full", tmp_path)
    assert status == 2 and err.startswith("frictionzoo: standard output: No space left") and err.count("\n") == 1


@pytest.mark.slow
def test_commands_whose_output_is_closed_write_all_their_files(tmp_path, tiny, compilation_cache):
    options = shlex.join([*tiny, "model=coulomb_smooth", "hydra.run.dir=run"])
    for command, written, allowed, closed in (
        (f"run {options}", "run/result.json", (0, 3), "after a line"),
        ("export run target=mjcf", "run/export", (0,), "from the start"),
        ("compare run run --output comparison", "comparison/comparison.json", (0, 3), "errors too"),
    ):
        status, told = run(f"{command} {CLOSED[closed]}", tmp_path, JAX_COMPILATION_CACHE_DIR=str(compilation_cache))
        assert status in allowed and "Traceback" not in told and "Error" not in told
        assert (tmp_path / written).exists()
    assert json.loads((tmp_path / "run/result.json").read_text())["metrics"]


FORK = """
import os, subprocess, sys, torch
import frictionzoo as fz
from frictionzoo.core.errors import ConfigError

bench, law = fz.Bench("knee_rod.xml", actuator=fz.PositionPD(kp=20, kd=1.0)), fz.law("coulomb_smooth")
state, ctrl = torch.ones(1, 1), torch.ones(1, 2, 1)

def in_a_fork(compute):
    if child := os.fork():
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    try:
        compute()
    except ConfigError as error:
        os._exit(7 if "forked" in str(error) else 8)
    except BaseException:
        os._exit(9)
    os._exit(0)

fz.rollout(bench, law, state, state, ctrl)
print(in_a_fork(lambda: fz.rollout(bench, law, state, state, ctrl)))
print(in_a_fork(lambda: fz.identify(bench, law, [])))
print(in_a_fork(lambda: fz.read({name: torch.arange(200).numpy() / 100 for name in ("time", "qpos", "ctrl")})))
started = "import frictionzoo.simulation.context as context; context.refuse_late_fork(); print('started')"
print(subprocess.run([sys.executable, "-c", started], preexec_fn=lambda: None, text=True, capture_output=True).stdout)
"""


@pytest.mark.slow
def test_a_process_that_was_forked_after_jax_had_begun_is_refused(start: Callable) -> None:
    out, err = start(program=("-c", FORK), PYTHONWARNINGS="ignore").communicate(timeout=200)
    assert out.split() == ["7", "7", "0", "started"], err
