"""The benchmarks run and measure something; how fast is theirs to say."""

import json
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT, job_settings, needs_data

BENCHMARKS = ROOT / "benchmarks"
ON_RECORDINGS = ("robot", "branches")
QUICKEST = {  # script: its arguments, and the rows that it has to give
    "gradient": ("--quick --joints 1 --ways mjx.step-unfused", 6),
    "start": ("--repeats 1 --commands help 'no such recording'", 2),
    "sysid": ("--samples 2000 --repeats 1", 4),
    "reports": ("--samples 30000 --sequences 1 --repeats 1", 2),
    "end_to_end": ("--models baseline --iterations 2 -- data.samples=30000", 1),
    "grid": ("--points 2 --sample 1 --models mujoco_default -- data.samples=30000", 4),
    "torch_loop": ("--laws coulomb_stribeck neural_friction --iterations 2 -- data.samples=30000 segments.count=20", 6),
    "torch_only": ("--quick --engines specialised", 3),
    "robot": ("--variants torque --parts legs --segments 4 --length 10 --iterations 2 --seconds 0.5", 3),
    "whole_robot": (f"{ROOT}/frictionzoo/bench/assets/knee_rod.xml --recordings 2 --seconds 2 --segments 5", 1),
    "arm": ("--bandwidths 40 --recordings 1 --seconds 3 --sure 0.1", 5),
    "branches": ("--segments 4 --length 10 --dtypes float64", 2),
    "newcomer": ("--drives 1 --kinds sticking --more recipe=given loop.progress=false", 1),
    "causes": ("--causes lag --drives 1 --more recipe=given loop.progress=false", 1),
    "coverage": ("--cases rounded load --logs 2", 2),
    "recipe": ("--cases twin -- data.samples=30000 segments.count=20 segments.length=50 fit.iterations=2", 1),
    "checkup": ("--data twin_clean --good twin_clean --most 1", 22),
    "excitation": ("--starts 1 --iterations 2 --period 2 -- data.samples=24000", 5),
    "growth": ("--samples 1e4 --lengths 50 --widths 16 --segments 200", 3),
}
# Errors, shares, and what needs no compiling; everything else is a time, a size or a count.
MAY_BE_ZERO = {"difference", "status", "armature_error", "compile", "errors", "warnings", "curve", "asked", "delay"}
OF_THIS_PROCESS = {"causes", "checkup", "coverage", "excitation", "newcomer", "recipe", "reports", "whole_robot"}
"""Scripts that change no setting of JAX and measure no process, and need none to themselves."""


@pytest.mark.slow
@pytest.mark.usefixtures("in_haste")
@pytest.mark.parametrize("script", [pytest.param(s, marks=needs_data) if s in ON_RECORDINGS else s for s in QUICKEST])
def test_a_benchmark_measures(
    script: str, tmp_path: Path, compilation_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
