"""`fz.read`, `fz.identify`, `fz.compare` and `fz.load`, as a notebook uses them, and as one with the command line."""

import ast
import inspect
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import nbformat
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache as jax_cache
from nbclient import NotebookClient
from omegaconf import OmegaConf

import frictionzoo as fz
from frictionzoo.api import library
from frictionzoo.core.build import build
from frictionzoo.core.config import compose_config
from frictionzoo.core.errors import ConfigError, LogError, RunError
from frictionzoo.core.manifest import MANIFEST
from frictionzoo.data.logs import Logs
from frictionzoo.fit import Adam
from frictionzoo.identification.choices import OPTIONAL, is_open

ARMATURE = 0.02  # kg m^2, of the recorded drive
STAND = """<mujoco model="stand">
  <option timestep="0.001"/>
  <worldbody>
    <body name="arm">
      <joint name="shaft" axis="0 1 0"/>
      <geom type="capsule" size="0.01" fromto="0 0 0 0 0 -0.2" mass="0.3" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>
"""
BLOCK = """\
import frictionzoo as fz

logs = fz.read("a.csv", "b.csv")                                   # every format; what was repaired is said and kept
bench = fz.Bench("stand.xml", joint="shaft", actuator=fz.PositionPD(kp=15, kd=0.5))
fit = fz.identify(bench, "coulomb_stribeck", logs, test=0.2, method="lm")
fit                                                                # a table in a notebook, text on a terminal
fit.plot(); fit.parameters; fit.metrics; fit.save("run"); fit.export("mjcf", "drive.xml")
fz.compare(bench, ["baseline", "mujoco_default", "directional"], logs)   # ranking, paired differences, recommendation
fz.load("run")                                                     # the same object again

law = fz.law("neural_friction", nv=1)                               # a torch.nn.Module
qpos, qvel = fz.rollout(bench, law, qpos0, qvel0, ctrl)              # torch in, torch out, MJX between: autograd through it,
(qpos - measured).square().mean().backward()                         # to the law, the bench's parameters and the commands
"""  # noqa: E501 - as the pages have it
GIVEN = """\
import torch
first = next(iter(logs))
qpos0, qvel0 = (torch.tensor(signal[:500:100]) for signal in (first.qpos, first.qvel))
ctrl = torch.tensor(first.ctrl[:500].reshape(5, 100, 1))
measured = torch.tensor(first.qpos[1:501].reshape(5, 100, 1))
"""
HOLDS = """\
import numpy as np
from frictionzoo.report.terminal import summarise

again = fz.load("run")
assert "files: run\\n\\n" in repr(again) and "difference in MuJoCo" in repr(again)
again.result.written = []  # only a run in a folder has files
assert summarise(again.result, None) == repr(fit)
assert {*again.parameters} == {*fit.parameters} and again.metrics == fit.metrics
for name, parameter in fit.parameters.items():
    for one, other in zip(parameter, again.parameters[name]):
        np.testing.assert_array_equal(one, other)
for one, other in zip(fit.rollout(), again.rollout()):
    np.testing.assert_array_equal(one, other)
assert all(bool(p.grad.isfinite().all()) and p.grad.abs().max() > 0 for p in law.parameters())
assert qpos.shape == measured.shape and fit.folder is None
"""


def cells() -> list[str]:
    """The block and what it is given, line by line, a statement that takes several as one."""
    lines, found = BLOCK.splitlines(), []
    for statement in ast.parse(BLOCK).body:
        text = "\n".join(lines[statement.lineno - 1 : statement.end_lineno])
        if text not in found:  # several statements stand in one line
            found.append(text)
    place = next(i for i, text in enumerate(found) if text.startswith("law ="))
    return [*found[:place], GIVEN, *found[place:], HOLDS]


def record(path: Path, pace: float, samples: int = 4100) -> None:
    """A recording by MuJoCo C, every 5 ms, of a drive with Coulomb, Stribeck and viscous friction.

    It has an encoder's noise: without, the recipe finds each step of the simulation too long.
    """
    spec = mujoco.MjSpec.from_string(STAND)
    spec.joint("shaft").armature = ARMATURE
    spec.option.timestep = 1e-4  # s: the recipe finds steps that are too long, were the recording's among them
    model = spec.compile()
    data = mujoco.MjData(model)
    rows = []
    for _ in range(samples):
        command = 0.7 * np.sin(pace * data.time) + 0.4 * np.sin(2.3 * pace * data.time + 1)
        rows.append((data.time, data.qpos[0], data.qvel[0], command))
        for _ in range(50):
            (qpos,), (qvel,) = data.qpos, data.qvel
            friction = np.tanh(qvel / 0.01) * (0.15 + 0.1 * np.exp(-((qvel / 0.1) ** 2))) + 0.05 * qvel
            data.qfrc_applied[0] = 15 * (command - qpos) - 0.5 * qvel - friction
            mujoco.mj_step(model, data)
    noise = np.random.default_rng(int(pace)).normal(size=(samples, 4)) * (0, 1e-3, 3e-2, 0)
    np.savetxt(path, rows + noise, fmt="%.9g", delimiter=",", header="time,qpos,qvel,ctrl", comments="")


@pytest.fixture(scope="module")
def stand(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with stand.xml, a.csv and b.csv."""
    folder = tmp_path_factory.mktemp("stand")
    (folder / "stand.xml").write_text(STAND)
    record(folder / "a.csv", 3.0)
    record(folder / "b.csv", 5.0)
    return folder


def names_in(folder: Path) -> set[str]:
    """What a run leaves, but for its logger's record, its checkpoints, how it began and its list of files."""
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    return {name for name in names if name.partition("/")[0] not in ("tensorboard", "checkpoints", ".hydra", MANIFEST)}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning:jupyter_core")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.usefixtures("in_haste")
def test_the_block_runs_in_a_notebook(stand, tmp_path, compilation_cache, finished_run, monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(compilation_cache))
    shutil.copytree(stand, tmp_path, dirs_exist_ok=True)
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(text) for text in cells()])
    NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = {
        cell.source.split(" ")[0].partition("(")[0]: output.data["text/html"]
        for cell in notebook.cells
        for output in cell.outputs
        if "text/html" in output.get("data", {})
    }
    assert {*shown} == {"fit", "fz.compare", "fz.load"}
    assert all("<table>" in page for page in shown.values())
    played = r"<table><tr><th>difference in MuJoCo.*?</table>\s*(?:<p>identified\.xml: [^<]*</p>)*\s*"
    loaded = re.sub(rf"<p>files: [^<]*</p>\s*|{played}", "", shown["fz.load"])  # of files, which only a folder has
    assert loaded != shown["fz.load"] and loaded == shown["fit"]
    run = tmp_path / "run"
    values = {row["name"]: row["value"] for row in json.loads((run / "result.json").read_text())["parameters"]}
    assert values["armature"] == pytest.approx(ARMATURE, rel=0.01)
    assert values["kinetic_torque"] == pytest.approx(0.15, rel=0.02)
    assert names_in(run) == names_in(finished_run("coulomb_stribeck")[0])
    same = (tmp_path / "drive.xml").read_text() == (run / "identified.xml").read_text()
    assert same, "another drive than the run's own file holds"


EVALUATION = {"horizons": [0.1], "rollouts": 1, "places": 1, "trajectory": 0.1, "window": 0.02}  # those of `tiny`
QUICK: dict[str, Any] = {
    "recipe": "given",
    "discretisation": False,
    "test": fz.Split(gap=0.05),
    "evaluation": EVALUATION,
    "loop": {"chunk": 2, "progress": False},
    "segments": {"count": 20},
}


def knee() -> fz.Bench:
    """The bench of conf/ in words of Python."""
    return fz.Bench("knee_rod.xml", "knee", actuator=fz.PositionPD(kp=20, kd=1.0))


@pytest.mark.usefixtures("unrendered")
@pytest.mark.parametrize("name", ["coulomb_stribeck", "neural_friction"])
def test_it_finds_what_the_command_line_finds(recording, tmp_path, finished_run, name):
    network = name == "neural_friction"
    law = fz.law(name, hidden=[4, 4]) if network else name
    more = {"method": Adam(iterations=3), "segments": {"count": 20, "length": 3}} if network else {"method": "lm"}
    fit = fz.identify(knee(), law, fz.read(recording), dtype="float64", **{**QUICK, **more})
    fit.save(tmp_path / "run")
    folder, _ = finished_run(name)
    same = [(path / "friction.safetensors").read_bytes() for path in (folder, tmp_path / "run")]
    assert same[0] == same[1], "other values than those of the command line"
    ran, found = (json.loads((path / "result.json").read_text()) for path in (folder, tmp_path / "run"))
    rows = [row for result in (ran, found) for part in ("parameters", "reference") for row in result[part]]
    for row in [row for row in rows if not row["identified"]]:
        for known in (row, *row["by_joint"]):
            del known["low"], known["high"]  # a number that is known has no bounds of its own
    for result in (ran, found):
        del result["verdict"]["commands"]  # a program has none
    differing = {key for key in ran.keys() | found.keys() if ran.get(key) != found.get(key)}
    assert differing <= {"timing", "settings"}
    left, kept = ran["settings"], found["settings"]
    assert {key for key in left.keys() | kept.keys() if left.get(key) != kept.get(key)} <= {"bench", "data", "logger"}


def test_options_are_those_of_the_configuration() -> None:
    config, signature = compose_config(), inspect.signature(fz.identify)
    options = {name: p.default for name, p in signature.parameters.items() if p.kind is p.KEYWORD_ONLY}
    for name in ("seed", "engine", "device", "compilation_cache"):
        assert options[name] == config[name]
    assert options["recipe"] == compose_config("data=files").recipe == "auto"


SAID: dict[str, tuple[dict[str, Any], dict[str, Any], tuple[str, ...]]] = {
    "nothing": ({}, {}, ()),
    "much": (
        {"timestep": 5e-4, "params": {"delay": 0.003}},
        {
            "method": Adam(iterations=3),
            "segments": {"length": 20, "count": None},
            "loss": {"velocity": 0.0, "robust": "huber", "refine": False},
            "dtype": "float32",
        },
        (
            *("bench.timestep=0.0005", "bench.params.delay.init=0.003", "bench.params.delay.identify=false"),
            *("fit=adam", "fit.iterations=3", "segments.length=20", "segments.count=null", "dtype=float32"),
            *("loss.velocity=0.0", "loss.robust=huber", "loss.refine=false"),
        ),
    ),
    "given": ({}, {"recipe": "given"}, ("recipe=given",)),
}
"""Of the bench and of the call, what Python says, and the command line."""


@pytest.mark.parametrize("name", SAID)
def test_it_leaves_open_what_the_command_line_does(monkeypatch: pytest.MonkeyPatch, recording: Path, name: str) -> None:
    bench, how, options = SAID[name]
    posed: dict[str, Any] = {}

    def settle(settings: dict[str, Any], *_: Any) -> None:
        posed.update(settings)
        raise RunError("as far as this")

    monkeypatch.setattr(library.Parts, "settle", settle)
    with pytest.raises(RunError, match="as far as this"):
        stand = fz.Bench("knee_rod.xml", "knee", actuator=fz.PositionPD(kp=20, kd=1.0), **bench)
        fz.identify(stand, "mujoco_default", fz.read(recording), **how)
    told: Any = OmegaConf.to_container(compose_config("data=files", *options), resolve=True)
    for section in ("recipe", "dtype", "segments", "loss"):
        assert posed[section] == told[section]
    for optional in OPTIONAL:
        assert is_open(posed["bench"]["params"] or {}, optional) == is_open(told["bench"]["params"], optional)
    if name != "given":  # where a configuration names a bench's step and a method, and Python has them of its own
        assert posed["fit"] == told["fit"] and posed["bench"]["timestep"] == told["bench"]["timestep"]


def test_what_was_read_twice_is_compared_under_two_labels(finished_run: Callable) -> None:
    once, again = (fz.load(finished_run("mujoco_default")[0]) for _ in range(2))
    compared = fz.Compared.of([once, again])
    assert len(compared.drives) == 2 and {*compared.drives.values()} == {once, again}
    assert [pair["mean"] for pair in compared.differences.values()] == [0.0]


def test_recordings_that_were_in_memory_cannot_be_read_again_and_say_so(stand: Path) -> None:
    samples = {"time": np.arange(200) / 100, "qpos": np.sin(np.arange(200)), "ctrl": np.zeros(200)}
    held = fz.read(stand / "a.csv", samples)
    for logs, name in ((held, "recording 1 in memory"), (Logs.of([*held]), str(stand / "a.csv"))):
        section = logs.dividing(fz.Split(gap=0.1)).section
        with pytest.raises(LogError, match=rf"^{name}: the run had it in memory, .*save its arrays as CSV"):
            build(json.loads(json.dumps(section))).load()


FAULTS = {
    "fz.identify(bench, 'coulom', logs)": r"coulom: no such friction model; did you mean coulomb_smooth\?",
    "fz.identify(bench, Unnamed(1), logs)": r'Unnamed: no name, .*; decorate it @register_model\("unnamed"\)',
    "fz.identify(bench, fz.law('coulomb_smooth', nv=2), logs)": r"a law of 2 joints on .*, expected as many",
    "fz.identify('stand.xml', 'coulomb_smooth', logs)": r"bench: str, expected a Bench, as in Bench\('stand\.xml', ",
    "fz.identify(bench, 'coulomb_smooth', logs, method='lbfgs')": "lbfgs: no such fit method; expected one of adam, ",
    "fz.identify(bench, 'coulomb_smooth', logs, test=1.5)": r"test=1\.5; expected a share between 0 and 1, or a Split",
    "fz.identify(bench, 'coulomb_smooth', held, test=0.2)": r"test=0\.2: expected None, because 1 of ",
    "fz.identify(bench, 'coulomb_smooth', logs, segments={'lenght': 5})": r"segments\.lenght: .*did you mean length\?",
    "fz.identify(bench, 'coulomb_smooth', logs, evaluation={'horizons': 1.0})": r"evaluation\.horizons=1\.0; expected ",
    "fz.identify(bench, 'coulomb_smooth', logs, dtype='float16')": "dtype=float16; expected float32 or float64",
    "fz.identify(bench, 'coulomb_smooth', 'a.csv')": r"logs: str, expected a Log, or the result of read\('a\.csv'\)",
    "fz.compare(bench, [], logs)": r"laws=\[\]; expected several, as in \['baseline', 'coulomb_smooth'\]",
    "fz.compare(bench, ['baseline', 'dahl'], logs, dtype='float16')": r"no law has a result to compare: [^;]+; [^;]*$",
    "fz.read()": r"read: no recording, expected paths, tables or mappings; name one, as in read\('a\.csv'\)",
    "fz.read(Frame({'time': [0.0, 1.0], 'qpos': ['a', 'b']}))": r"recording 1 in memory: qpos of shape \(2,\) and type",
    "fz.read('unmoved.csv')": r"unmoved\.csv: columns\.ctrl is missing; perhaps columns\.time=time columns\.qpos=\[",
    "fz.read('data.train.csv')": r"data\.train\.csv: no such file",
    "fz.read('a.csv', clean={'step': 0.1})": r"clean: dict, expected a Cleaning, as in Cleaning\(step=0\.002\)",
    "fz.read('a.csv', columns={'pos': 'qpos'})": r"columns\.pos: unknown signal; did you mean qpos\?",
    "fz.identify(bench, 'coulomb_smooth', logs, test=0.999)": r".*4100 samples with test=0\.999 and gap=1 s, .* test$",
    "fz.Bench('stand.xml', joint='knee', actuator=fz.PositionPD(kp=15, kd=0.5))": r"stand\.xml: no joint knee; expect",
    "fz.PositionPD(kp=15)": "PositionPD: no parameter kd; give its value",
    "fz.load('gone')": "gone: .*expected the folder of a finished run",
    "saved.save('a.csv')": r"a\.csv: not a folder, expected one to write into; name another",
}
FAULTY = """\
import json, sys
import frictionzoo as fz
from frictionzoo.core.errors import FrictionzooError

class Frame(dict):
    columns = property(list)

class Unnamed(fz.FrictionModel):
    def terms(self, xp, values, state):
        return fz.FrictionTerms(0 * state.qvel)

logs, held = fz.read("a.csv"), fz.read("a.csv", test="b.csv")
bench = fz.Bench("stand.xml", joint="shaft", actuator=fz.PositionPD(kp=15, kd=0.5))
saved = fz.load(sys.argv[1])
found = {}
for text in json.load(sys.stdin):
    try:
        found[text] = f"no error: {eval(text)}"
    except FrictionzooError as error:
        found[text] = str(error)
    except Exception as error:
        found[text] = f"a traceback: {error!r}"
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def faults(stand: Path, tmp_path_factory: pytest.TempPathFactory, finished_run: Callable) -> dict[str, str]:
    """What each of `FAULTS` says; in a process whose types nobody checks as they are called."""
    folder = tmp_path_factory.mktemp("faults")
    shutil.copytree(stand, folder, dirs_exist_ok=True)
    (folder / "unmoved.csv").write_text("time,qpos\n" + "".join(f"{i / 100},{i}\n" for i in range(50)))
    command = [sys.executable, "-c", FAULTY, str(finished_run("mujoco_default")[0])]
    told = subprocess.run(command, cwd=folder, input=json.dumps([*FAULTS]), capture_output=True, text=True)
    assert told.returncode == 0, told.stderr
    return json.loads(told.stdout.splitlines()[-1])


@pytest.mark.parametrize("text", FAULTS)
def test_a_mistake_is_told_in_one_line(faults: dict[str, str], text: str) -> None:
    assert re.match(FAULTS[text], faults[text])
    assert "\n" not in faults[text] and "hydra" not in faults[text] and "--" not in faults[text]


def of_jax() -> tuple[Any, ...]:
    """What JAX is set to, and how it then computes."""
    array = jnp.zeros(1)
    return dict(jax.config.values), array.dtype, array.devices(), jax.config.jax_compilation_cache_dir


@pytest.fixture
def without_cache() -> Any:
    """JAX as it is where nobody has named a folder for what it compiles."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    jax_cache.reset_cache()
    yield
    jax.config.update("jax_compilation_cache_dir", before)
    jax_cache.reset_cache()


@pytest.mark.slow
@pytest.mark.usefixtures("in_haste", "without_cache")
def test_settings_of_jax_stay_and_what_was_before_does_not_matter(recording, tmp_path, start):
    logs, before = fz.read(recording), of_jax()
    options = {**QUICK, "method": "lm", "compilation_cache": str(tmp_path / "cache")}
    double = fz.identify(knee(), "mujoco_default", logs, dtype="float64", **options)
    assert of_jax() == before and any((tmp_path / "cache" / "xla").iterdir())
    with pytest.raises(LogError):
        fz.identify(knee(), "mujoco_default", logs, **{**options, "segments": {"length": 10**6}})
    with pytest.raises(ConfigError):
        fz.identify(knee(), "mujoco_default", logs, dtype="float16", **options)
    assert of_jax() == before
    single = fz.identify(knee(), "mujoco_default", logs, dtype="float32", **options)
    assert of_jax() == before
    assert double.result["dtype"] == "float64" and single.result["dtype"] == "float32"
    single.save(tmp_path / "run")
    code = (
        "import frictionzoo as fz, sys\n"
        "bench = fz.Bench('knee_rod.xml', 'knee', actuator=fz.PositionPD(kp=20, kd=1.0))\n"
        f"options = { ({**options, 'test': None, 'compilation_cache': None})!r} | {{'test': fz.Split(gap=0.05)}}\n"
        f"fz.identify(bench, 'mujoco_default', fz.read({str(recording)!r}), **options).save('fresh')\n"
    )
    fresh = start(program=["-c", code])
    _, err = fresh.communicate(timeout=900)
    assert fresh.returncode == 0, err
    same = [(tmp_path / folder / "friction.safetensors").read_bytes() for folder in ("run", "fresh")]
    assert same[0] == same[1], "another result than in a fresh process"
    ran, found = (json.loads((tmp_path / folder / "result.json").read_text()) for folder in ("run", "fresh"))
    assert ran["parameters"] == found["parameters"] and ran["metrics"] == found["metrics"]
