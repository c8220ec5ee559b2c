"""One more plug-in of each kind, by as many files as CONTRIBUTING.md says: found, listed, documented and used."""

import importlib
import re
import runpy
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from helpers.pages import ROOT
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import OmegaConf

from frictionzoo.cli.list import main
from frictionzoo.core import config, registry
from frictionzoo.core.build import build
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.registry import KINDS
from frictionzoo.fit import run_fit
from frictionzoo.identification import Problem
from frictionzoo.models import get_model
from frictionzoo.models.contract import check_model
from frictionzoo.simulation.context import computing

TABLE = re.findall(r"^\| (\w+) \| (\d) \|", (ROOT / "CONTRIBUTING.md").read_text(), re.M)
FILES = {kind: int(count) for kind, count in TABLE}

LAW = '''
from frictionzoo.core.state import FrictionTerms
from frictionzoo.models import FrictionModel, Parameter, register_model

@register_model("round_coulomb")
class RoundCoulomb(FrictionModel):
    """Coulomb friction with a hyperbolic sign, and viscous friction.

    torque = f v / sqrt(v^2 + v_0^2) + d v

        f    coulomb_torque [N m or N]
        v_0  smoothing_velocity [rad/s or m/s]
        d    viscous_coefficient [N m s/rad or N s/m]

    Cannot represent: sticking.

    Source: any text on smooth signs.
    """

    physical_parameters = {
        "coulomb_torque": Parameter("torque", init=0.05, low=1e-4, high=2.0),
        "smoothing_velocity": Parameter("velocity", 0.01, 0.002, 0.1, identify=False),
        "viscous_coefficient": Parameter("damping", 0.03, 1e-4, 10.0),
    }
    dissipative = True

    def __init__(self, nv, power=1, params=None):
        super().__init__(nv, params)

    def terms(self, xp, values, state):
        v, v_0 = state.qvel, values["smoothing_velocity"]
        dry = values["coulomb_torque"] * v / xp.sqrt(xp.square(v) + v_0 * v_0)
        return FrictionTerms(torque=dry + values["viscous_coefficient"] * v)
'''
ACTUATOR = '''
from frictionzoo.bench.actuators import Actuator, Affine, register_actuator

@register_actuator("geared_pd")
class GearedPD(Actuator):
    """Position controller whose command is an angle of the motor: torque = kp (ctrl / ratio - qpos) - kd qvel."""

    dimensions = {"kp": "stiffness", "kd": "damping", "ratio": "1"}

    def affine(self, values):
        return Affine(values["kp"] / values["ratio"], 0 * values["kp"], -values["kp"], -values["kd"])
'''
SOURCE = '''
import numpy as np

from frictionzoo.core.log import Dataset, Log
from frictionzoo.data.source import Source, register_source

@register_source("still")
class Still(Source):
    """A drive that stands still."""

    def __init__(self, name, samples):
        self.name, self.samples = name, samples

    def load(self):
        zero = np.zeros((self.samples, 1))
        logs = [Log(part, 1e-3 * np.arange(self.samples), zero, zero, zero, "", True) for part in ("train", "test")]
        return Dataset(self.name, (logs[0],), (logs[1],))
'''
FORMAT = '''
from frictionzoo.data.formats import Format, register_format
from frictionzoo.data.formats.csv import Csv

@register_format("semicolons")
class Semicolons(Csv):
    """Semicolons between numbers."""

    suffixes = (".ssv",)

    def parse(self, name, content):
        return super().parse(name, content.replace(b";", b","))
'''
METHOD = '''
import jax

from frictionzoo.fit.base import Search, register_method

@register_method("random_search")
class RandomSearch(Search):
    """Vectors drawn evenly between the bounds."""

    def __init__(self, tries):
        self._tries = tries

    def total(self, objective):
        return self._tries

    def candidate(self, objective, iteration):
        low, high = objective.space.low, objective.space.high
        return jax.random.uniform(jax.random.fold_in(jax.random.key(0), iteration), low.shape, low.dtype, low, high)
'''
TARGET = '''
from frictionzoo.export.base import Export, Target, register_target

@register_target("sheet")
class Sheet(Target):
    """Names and values of all parameters, separated by commas."""

    options = {"digits": "how many"}

    def write(self, fitted, folder, options):
        digits = int(options.get("digits", 6))
        values = {**fitted.values["bench"], **fitted.values["friction"]}
        lines = [f"{name},{value[0]:.{digits}g}" for name, value in values.items()]
        (folder / "sheet.csv").write_text("\\n".join(lines))
        return Export(("sheet.csv",), ())
'''


@pytest.fixture(autouse=True)
def own_registries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What a test adds ends with it."""
    importlib.import_module("frictionzoo.export.base")  # whose registry no test has asked for yet
    for each in registry._REGISTRIES:
        monkeypatch.setattr(each, "entries", dict(each.entries))
    yield
    for name, module in list(sys.modules.items()):
        if (getattr(module, "__file__", None) or "").startswith(str(tmp_path)):
            del sys.modules[name]


@pytest.fixture
def add(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Adds a plug-in to the package: its file beside the others of its kind, and its YAML beside theirs, if it has one.

    They lie in another folder that is made part of the package; the configuration is a copy with one file more.
    """

    def add(plural: str, name: str, source: str, group: str | None = None, yaml: str = "") -> None:
        home = KINDS[plural].home
        files = [tmp_path / "package" / plural / f"{name}.py"]
        package = importlib.import_module(home)
        monkeypatch.setattr(package, "__path__", [*package.__path__, str(files[0].parent)])
        if group:
            shutil.copytree(config.CONF_DIR, tmp_path / "conf")
            files.append(tmp_path / "conf" / group / f"{name}.yaml")
            monkeypatch.setattr(config, "CONF_DIR", tmp_path / "conf")
        for path, text in zip(files, (source, yaml), strict=False):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text.lstrip())
        assert len(files) == FILES[plural]

    return add


def listed(capsys: pytest.CaptureFixture[str], *kinds: str) -> dict[str, list[str]]:
    """Columns by name of what the command prints."""
    main(kinds)
    rows = (re.split(r" {2,}", line.strip(), maxsplit=3) for line in capsys.readouterr().out.splitlines())
    return {row[0]: row[1:] for row in rows if len(row) == 4}


def settings_of(*overrides: str) -> dict[str, Any]:
    return OmegaConf.to_container(config.compose_config(*overrides), resolve=True)


def identify(settings: dict[str, Any]) -> Any:
    """The fit of these settings, without what a job does besides."""
    with computing("float64", "cpu", None):
        problem = Problem.from_settings(settings)
        return run_fit(problem.fit, problem.objective, problem.drive.model, **settings["loop"])


def test_a_law_is_one_file(add, tiny, tmp_path, capsys, monkeypatch):
    add("models", "round_coulomb", LAW)
    line = "Coulomb friction with a hyperbolic sign, and viscous friction."
    assert listed(capsys, "models")["round_coulomb"] == ["frictionzoo", "model=round_coulomb", line]
    settings = settings_of("model=round_coulomb", *tiny, "fit=lm", "logger=csv", "scale.torque=4")
    assert settings["model"]["params"]["coulomb_torque"]["init"] == 0.2 and settings["model"]["power"] == 1
    check_model(build(settings["model"], nv=2))
    outcome = identify(settings)
    # The recording's drive has a hyperbolic tangent in place of this sign.
    truth = {"coulomb_torque": 0.1, "viscous_coefficient": 0.05}
    found = {name: outcome.values["friction"][name].item() for name in truth}
    assert found == pytest.approx(truth, rel=0.02)

    monkeypatch.syspath_prepend(ROOT / "docs")
    script = runpy.run_path(str(ROOT / "docs" / "write_plugins.py"))
    page = script["render_models"]((ROOT / "docs" / "models.md").read_text())
    row = f"| [`round_coulomb`](#round_coulomb) | {line[:-1]} | `coulomb_torque`, `smoothing_velocity`, `visc"
    assert row in page
    section = page[page.index("## `round_coulomb`") :]
    assert "| `model.params.coulomb_torque` | 0.05 torque | 0.0001 to 2 torque |  |\n" in section
    assert "```math\n\\text{torque} = \\frac{f\\,v}{\\sqrt{v^{2} + v_{0}^{2}}} + d\\,v\n```" in section
    assert "Cannot represent: sticking.\n\nSource: any text" in section


def test_an_actuator_is_one_file(add: Callable[..., None], capsys: pytest.CaptureFixture[str]) -> None:
    add("actuators", "geared_pd", ACTUATOR)
    target = "frictionzoo.bench.actuators.GearedPD"
    assert listed(capsys, "actuators")["geared_pd"][:2] == ["frictionzoo", f"bench.actuator._target_={target}"]

    def swing(target: str, ctrl: float, **more: Any) -> float:
        """Where MuJoCo C has the knee after 0.2 s."""
        section = settings_of()["bench"]
        section["actuator"] = {"_target_": target, "params": {**section["actuator"]["params"], **more}}
        bench = build(section)
        model = mujoco.MjModel.from_xml_string(
            bench.mjcf({name: np.array([param.init]) for name, param in bench.params.items()})
        )
        data = mujoco.MjData(model)
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data, nstep=200)
        return data.qpos.item()

    geared = swing(target, 3.0, ratio={"init": 10.0, "low": 1.0, "high": 100.0, "scale": "log", "identify": False})
    assert geared == pytest.approx(swing("frictionzoo.bench.PositionPD", 0.3), abs=1e-12) and geared > 0.1


def test_a_source_is_two_files(add: Callable[..., None], capsys: pytest.CaptureFixture[str]) -> None:
    add("sources", "still", SOURCE, "data", "_target_: frictionzoo.data.still.Still\nname: still\nsamples: 7\n")
    assert listed(capsys, "sources")["still"] == ["frictionzoo", "data=still", "A drive that stands still."]
    dataset = build(settings_of("data=still")["data"]).load()
    assert dataset.name == "still" and [len(log.time) for log in dataset.logs] == [7, 7]


def test_a_format_is_one_file(add: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    add("formats", "semicolons", FORMAT)
    assert listed(capsys, "formats")["semicolons"][1] == "data.format=semicolons"
    from frictionzoo.data.formats import read_tables

    (tmp_path / "a.ssv").write_text("time;qpos\n0;1\n1;2\n")
    for asked in ("auto", "semicolons"):
        (table,) = read_tables(str(tmp_path / "a.ssv"), asked)
        assert table.columns["qpos"].tolist() == [1, 2]


def test_a_fit_method_is_two_files(add, tiny, tmp_path, capsys):
    add("methods", "random_search", METHOD, "fit", "_target_: frictionzoo.fit.RandomSearch\ntries: 30\n")
    assert listed(capsys, "methods")["random_search"][1] == "fit=random_search"
    bounds = (
        f"bench.params.armature.{name}={value}" for name, value in {"init": 0.1, "low": 0.02, "high": 0.2}.items()
    )
    outcome = identify(settings_of("fit=random_search", "model=baseline", "logger=csv", *bounds, *tiny))
    assert outcome.method == "random_search" and len(outcome.history["loss"]) == 30
    tried = outcome.history["bench.armature"]
    assert outcome.values["bench"]["armature"] == tried[np.argmin(outcome.history["loss"])]
    assert len(np.unique(tried)) == 30 and 0.02 < tried.min() < 0.04 and 0.1 < tried.max() < 0.2


def test_an_export_target_is_one_file(add, finished_run, tmp_path, capsys):
    from frictionzoo.export.write import write_exports

    add("targets", "sheet", TARGET)
    assert listed(capsys, "targets")["sheet"][1] == "target=sheet"
    folder, _ = finished_run("mujoco_default")
    (written,) = write_exports(folder, {"target": "sheet", "digits": "3", "output": str(tmp_path / "out")})
    assert written.export.files == ("sheet.csv",)
    sheet = dict(line.split(",") for line in (tmp_path / "out" / "sheet.csv").read_text().splitlines())
    assert set(sheet) == {"armature", "kp", "kd", "frictionloss", "damping"}
    assert sheet["kp"] == "20"


def test_all_kinds_have_a_test_and_a_number_of_files() -> None:
    assert list(FILES) == list(KINDS)


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package with one plug-in of each kind, installed beside frictionzoo, and one entry point that leads nowhere."""
    brought = {"models": LAW, "actuators": ACTUATOR, "sources": SOURCE, "formats": FORMAT}
    brought |= {"methods": METHOD, "targets": TARGET}
    site = tmp_path / "site"
    info = site / "zoo_extras-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: zoo_extras\nVersion: 1.0\n")
    (site / "zoo_extras").mkdir()
    (site / "zoo_extras" / "__init__.py").write_text("")
    points = "[frictionzoo.targets]\nnowhere = zoo_missing.target\n"
    for plural, source in brought.items():
        (site / "zoo_extras" / f"{plural}.py").write_text(source)
        name = re.search(r'@register_\w+\("(\w+)"\)', source)[1]
        header = "" if plural == "targets" else f"[frictionzoo.{plural}]\n"
        line = f"{name} = zoo_extras.{plural}\n"
        points = points + line if plural == "targets" else f"{header}{line}{points}"
    (info / "entry_points.txt").write_text(points)
    monkeypatch.syspath_prepend(site)
    return site


def test_another_package_brings_one_of_each_kind(package: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = listed(capsys)
    names = ("round_coulomb", "geared_pd", "still", "semicolons", "random_search", "sheet")
    assert {name: rows[name][0] for name in names} == dict.fromkeys(names, "zoo_extras")
    assert rows["round_coulomb"][2].startswith("Coulomb friction with a hyperbolic sign")
    assert rows["geared_pd"][1] == "bench.actuator._target_=zoo_extras.actuators.GearedPD"
    assert rows["nowhere"][2] == "does not load: No module named 'zoo_missing'"
    assert not {module for module in sys.modules if module.startswith("zoo_extras.")}  # looked at, not imported
    for each in registry._REGISTRIES:
        name = next(name for name in names if name in each.names())
        assert each.get(name).__module__ == f"zoo_extras.{each.kind.plural}"
    assert build({"_target_": "zoo_extras.sources.Still", "name": "still", "samples": 5}).load().name == "still"


def test_a_law_of_another_package_has_options_from_its_class(package: Path) -> None:
    assert "round_coulomb" in config.list_choices("model")
    section = settings_of("model=round_coulomb", "scale.torque=3", "model.params.coulomb_torque.low=0.1")["model"]
    assert section["_target_"] == "zoo_extras.models.RoundCoulomb" and section["power"] == 1
    assert section["params"]["coulomb_torque"] == {
        **{"init": pytest.approx(0.15), "low": 0.1, "high": 6, "scale": "log", "identify": True}
    }
    check_model(build(section, nv=2))
    with pytest.raises(HydraException, match="coulomb_torqe"):
        settings_of("model=round_coulomb", "model.params.coulomb_torqe.low=0.1")


def test_a_file_of_another_package_has_precedence_over_its_class(package, monkeypatch):
    (package / "conf" / "model").mkdir(parents=True)
    text = "_target_: zoo_extras.models.RoundCoulomb\nparams: {coulomb_torque: {init: 7.0}}\n"
    (package / "conf" / "model" / "round_coulomb.yaml").write_text(text)

    class Brought(SearchPathPlugin):
        def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
            search_path.append("zoo_extras", f"file://{package / 'conf'}")

    plugins = Plugins.instance().plugin_type_to_subclass_list
    monkeypatch.setitem(plugins, SearchPathPlugin, [Brought, *plugins[SearchPathPlugin]])
    assert settings_of("model=round_coulomb")["model"]["params"] == {"coulomb_torque": {"init": 7.0}}


def test_only_packages_with_plug_ins_are_built_from(package: Path) -> None:
    (package / "zoo_stranger.py").write_text("class Still: pass\n")
    with pytest.raises(ConfigError, match=r"_target_=zoo_stranger\.Still; expected a class of .*zoo_extras"):
        build({"_target_": "zoo_stranger.Still"})
    assert "zoo_stranger" not in sys.modules


def test_two_files_of_one_name_are_refused(add: Callable[..., None], capsys: pytest.CaptureFixture[str]) -> None:
    add("formats", "semicolons", FORMAT.replace('"semicolons"', '"csv"'))
    with pytest.raises(SystemExit, match="2"):
        main(["formats"])
    home = "frictionzoo.data.formats"
    line = f"frictionzoo: csv: registered by {home}.csv.Csv and {home}.semicolons.Semicolons; "
    assert capsys.readouterr().err == f"{line}rename one\n"


def test_a_kind_that_does_not_exist_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["model"])
    came = capsys.readouterr()
    assert came.out == "" and came.err.count("\n") == 1
    assert came.err.startswith(
        "frictionzoo: model: no such kind of plug-ins; did you mean models? (expected one of act"
    )


def test_listing_imports_no_plug_in() -> None:
    code = """
    import sys
    from frictionzoo.cli.list import main
    main([])
    assert not {"torch", "jax", "mujoco", "numpy", "frictionzoo.models"} & set(sys.modules)
    """
    shown = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, cwd=ROOT)
    assert shown.returncode == 0, shown.stderr
    assert "coulomb_stribeck" in shown.stdout


def test_a_class_is_reached_by_its_name_in_its_package_and_nothing_else_is() -> None:
    for kind in KINDS.values():
        for found in kind.own().values():
            home, _, cls = found.target.rpartition(".")
            assert found.summary, found.target
            assert getattr(importlib.import_module(home), cls).name == found.name
    with pytest.raises(ImportError, match=r"cannot import name 'Newton' from 'frictionzoo\.fit'"):
        from frictionzoo.fit import Newton  # noqa: F401


def test_every_law_says_what_it_cannot_represent_and_where_it_comes_from() -> None:
    for name in KINDS["models"].own():
        text = get_model(name).__doc__ or ""
        assert "\n    Cannot represent: " in text and "\n    Source: " in text, name
