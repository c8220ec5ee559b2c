"""The benchmarks run and measure something; how fast is theirs to say."""

import json
import runpy
import shlex
import subprocess
import sys

import pytest
from conftest import ROOT, job_settings, needs_data
from helpers.benchmarks import QUICKEST

BENCHMARKS = ROOT / "benchmarks"
ON_RECORDINGS = ("robot", "branches")
# Errors, shares, and what needs no compiling; everything else is a time, a size or a count.
MAY_BE_ZERO = {
    *("difference", "status", "armature_error", "compile", "errors", "warnings", "curve", "asked", "delay"),
    *("change", "changed", "unchanged", "cannot_tell", "found"),
}
OF_THIS_PROCESS = {
    *("causes", "checkup", "coverage", "drift", "excitation", "newcomer", "recipe", "reports", "whole_robot"),
}
"""Scripts that change no setting of JAX and measure no process, and need none to themselves."""


@pytest.mark.slow
@pytest.mark.usefixtures("in_haste")
@pytest.mark.parametrize("script", [pytest.param(s, marks=needs_data) if s in ON_RECORDINGS else s for s in QUICKEST])
def test_a_benchmark_measures(script, tmp_path, compilation_cache, monkeypatch):
    arguments, rows = QUICKEST[script]
    out = tmp_path / "results" / "measured.json"
    program = [str(BENCHMARKS / f"{script}.py"), "--out", str(out), *shlex.split(arguments)]
    monkeypatch.chdir(tmp_path)
    if script in OF_THIS_PROCESS:
        monkeypatch.syspath_prepend(BENCHMARKS)
        monkeypatch.setattr(sys, "argv", program)
        with job_settings(compilation_cache):
            runpy.run_path(program[0], run_name="__main__")
    else:
        monkeypatch.setenv("PYTHONPATH", str(ROOT))
        subprocess.run([sys.executable, *program], check=True)
    content = json.loads(out.read_text())
    assert content["machine"]["cpu_count"] > 0 and len(content["rows"]) == rows
    for row in content["rows"]:
        numbers = {name: value for name, value in row.items() if not isinstance(value, str)}
        assert len(numbers) >= 5
        assert not [name for name, value in numbers.items() if not value > 0 and name not in MAY_BE_ZERO], row


def test_the_page_names_every_benchmark() -> None:
    text = (BENCHMARKS / "README.md").read_text()
    assert all(f"## `{name}.py`" in text and f"python benchmarks/{name}.py" in text for name in QUICKEST)
