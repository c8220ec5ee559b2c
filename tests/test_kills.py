"""Jobs that end at a random moment, by a signal or on a full disk, go on to the same bytes.

`FRICTIONZOO_KILLS=30 pytest -m slow tests/test_kills.py` tries thirty moments, over all kinds of jobs and of ends.
"""

import contextlib
import json
import os
import random
import resource
import signal
import subprocess
import time
from pathlib import Path

import pytest
from conftest import ROOT
from helpers.torch_laws import STRIBECK, TorchStribeck

from frictionzoo.cli.run import NOT_IDENTIFIED
from frictionzoo.core.manifest import MANIFEST
from frictionzoo.models import register_model
from frictionzoo.models.registry import REGISTRY

HERE = "hydra.run.dir=run"
JOBS = {
    "adam": (HERE, "model=coulomb_smooth", "fit.iterations=40"),
    "lm": (HERE, "model=coulomb_stribeck", "fit=lm", "loop.chunk=1"),
    "grid": (HERE, "model=coulomb_smooth", "fit=grid", "fit.points=3"),
    "network": (HERE, "model=neural_friction", "model.hidden=[4,4]", "segments.length=3", "fit.iterations=20"),
    "torch": (HERE, "model=coulomb_stribeck", f"model._target_={STRIBECK}", "segments.length=3", "fit.iterations=20"),
    "sweep": ("-m", "hydra.sweep.dir=run", "model=baseline,coulomb_smooth", "fit.iterations=10"),
}
DONE = {0, NOT_IDENTIFIED}
STATUS = {  # of a program that was ended so after it had begun, and before it had
    "SIGKILL": {-signal.SIGKILL},
    "SIGTERM": {128 + signal.SIGTERM, -signal.SIGTERM},
    "SIGINT": {128 + signal.SIGINT, -signal.SIGINT},
    "full disk": {2},
}
# What a job's folder comes to hold, in this order; the moment is up to `LATEST` seconds after one of them.
STAGES = ("", ".hydra/overrides.yaml", "checkpoints/last.ckpt", "figures", "friction.safetensors", "report.html")
LATEST = 1.5
PATIENCE = 300.0  # s after which a process that has not ended is a failure
# The program with a law of its own.
WITH_LAW = """
from frictionzoo.cli.commands import main
from frictionzoo.models import register_model
from helpers.torch_laws import TorchStribeck
register_model("torch_stribeck")(TorchStribeck)
main("run")
"""

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("in_haste", "interruptible")]


def draw(count: int) -> list[tuple[str, str, str, float]]:
    """So many cases, of which 24 have every pair of a job and an end, at random moments."""
    chance, jobs, ends = random.Random(0), list(JOBS), list(STATUS)
    return [
        (jobs[i % len(jobs)], ends[(i + i // len(jobs)) % len(ends)], chance.choice(STAGES), chance.uniform(0, LATEST))
        for i in range(count)
    ]


@pytest.fixture(autouse=True)
def prepared(monkeypatch: pytest.MonkeyPatch, unrendered: None) -> None:
    """The law is known here too; no figures are rendered, most of a comparison's time."""
    monkeypatch.setattr(REGISTRY, "entries", dict(REGISTRY.entries))
    register_model("torch_stribeck")(TorchStribeck)


def results(folder: Path) -> dict[str, bytes]:
    """What has to come out again, by file; of `result.json` and `comparison.json`, all but the times."""
    found = {}
    for name in ("result.json", "comparison/comparison.json", "friction.safetensors", "identified.xml"):
        for path in folder.rglob(name):
            content = path.read_bytes()
            if path.suffix == ".json":
                parsed = json.loads(content)
                for part in (parsed, *parsed.get("runs", [])):
                    part.pop("timing", None)
                content = json.dumps(parsed).encode()
            found[str(path.relative_to(folder))] = content
    return found


def end(process: subprocess.Popen, how: str, stage: Path, delay: float) -> str:
    """End a process so after it has come to a stage; returns its standard error."""
    deadline = time.monotonic() + PATIENCE
    while process.poll() is None and not stage.exists():
        assert time.monotonic() < deadline
        time.sleep(0.002)
    time.sleep(delay)
    if process.poll() is None and how == "full disk":
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (0, 0))
    elif process.poll() is None:
        process.send_signal(signal.Signals[how])
    _, err = process.communicate(timeout=PATIENCE)
    assert process.returncode in {*DONE, *STATUS[how]}, err  # it may have been done before
    return err


@pytest.mark.parametrize(
    ("job", "how", "stage", "delay"), draw(int(os.environ.get("FRICTIONZOO_KILLS", len(JOBS)))), ids=str
)
def test_what_ends_at_a_random_moment_goes_on_to_the_same_bytes(start, call, tiny, tmp_path, job, how, stage, delay):
    folder, command, undisturbed = tmp_path / "run", (*JOBS[job], *tiny), tmp_path / "undisturbed"
    undisturbed.mkdir()
    with contextlib.chdir(undisturbed):
        assert call(*command).status in DONE
    place = folder / "1_coulomb_smooth" if job == "sweep" and stage else folder
    # Compiled functions are read and not written: JAX leaves half a file where it is ended.
    variables = {"PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "1e9"}
    process = start(*command, program=("-c", WITH_LAW) if job == "torch" else ("-m", "frictionzoo.run"), **variables)
    err = end(process, how, place / stage, delay)
    if process.returncode > 0 and process.returncode not in DONE:
        assert_says_how_to_go_on(err, how, folder)
    # Without its settings it had not come so far, and nothing is kept.
    if any(path.stat().st_size for path in folder.rglob(".hydra/settings.json")):
        command = (*command, "resume=true") if job == "sweep" else ("resume=run",)
    done = {path: path.stat().st_mtime_ns for path in folder.glob("*/result.json")}
    finished = call(*command)
    assert finished.status in DONE, finished.err
    assert results(folder) == results(undisturbed / "run")
    assert done == {path: path.stat().st_mtime_ns for path in done}
    assert not [path for path in folder.rglob(".*") if path.name not in (".hydra", MANIFEST)]


def assert_says_how_to_go_on(err: str, how: str, folder: Path) -> None:
    """One line says it, and no temporary file is left."""
    (line,) = [line for line in err.splitlines() if line.startswith("frictionzoo: ")]
    assert "Traceback" not in err and "Error" not in err, err
    assert how == "full disk" or f"stopped by {how}; " in line
    kept = [path for path in folder.rglob(".hydra/settings.json") if path.stat().st_size]
    assert line.endswith((f"resume={folder}", "resume=true") if kept else "; nothing is kept; run it again")
    assert not list(folder.rglob("*.part"))
