"""Drives for domain randomisation: samples, MJCF files and events hold what the run allows, and no more."""

import copy
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from conftest import Finished, changed
from helpers.fitted import fit as fit_robot
from helpers.isaaclab import load_recorded
from helpers.robot_texts import LEG, save

import frictionzoo as fz
from frictionzoo.api.identified import Identified
from frictionzoo.cli.finished import export as main
from frictionzoo.core.errors import FrictionzooError
from frictionzoo.core.manifest import MANIFEST
from frictionzoo.export import nearest as refit
from frictionzoo.export.base import Written
from frictionzoo.export.module import load_module
from frictionzoo.export.nearest import Nearest
from frictionzoo.export.randomisation import ISAAC_LAB, MJLAB, write_events, write_files
from frictionzoo.export.variants import Quantity, Range, draw_variants

ROOT = Path(__file__).parent.parent
EXACT = 1e-9  # rad; rounding of some hundred steps stays far below
COUNT, WORLDS = 50, 400
IN_MJLAB = "FRICTIONZOO_MJLAB"


@pytest.fixture(scope="module")
def drive(finished_run: Callable[[str], tuple[Path, Finished]]) -> Identified:
    """A run of MuJoCo's own friction; its parameters count as determined if they have an interval."""
    loaded = fz.load(finished_run("mujoco_default")[0])
    assert all(np.isfinite(p.interval).all() for p in loaded.parameters.values() if p.identified)
    return declare(loaded, True)


def declare(drive: Identified, identifiable: bool, *names: str) -> Identified:
    """The same drive, of which data determine some parameters, or all, or do not."""
    result = copy.deepcopy(drive.result)
    for row in result.parameters:
        if row.identified and (not names or f"{row.owner}.{row.name}" in names):
            for entry in (row, *row.by_joint):
                entry.identifiable = identifiable
    return replace(drive, result=result)


@pytest.fixture(scope="module")
def written(drive: Identified, tmp_path_factory: pytest.TempPathFactory) -> Written:
    return drive.export("randomisation", tmp_path_factory.mktemp("written") / "drives", count=COUNT, files=3)


@pytest.fixture(scope="module")
def samples(written: Written) -> dict[str, np.ndarray]:
    return read(written)


def read(written: Written) -> dict[str, np.ndarray]:
    """What samples.npz holds, without pickle."""
    assert written.folder is not None
    with np.load(written.folder / "samples.npz", allow_pickle=False) as arrays:
        return dict(arrays)


def test_samples_are_the_runs_own_draws(drive: Identified, samples: dict[str, np.ndarray]) -> None:
    drawn = drive.sample(COUNT, seed=0)
    assert len(drawn) > 1
    for name, values in drawn.items():
        np.testing.assert_array_equal(samples[name], values)
    correlation, expected = (np.corrcoef(np.hstack([of[name] for name in drawn]).T) for of in (samples, drawn))
    np.testing.assert_array_equal(correlation, expected)
    names = samples["names"].tolist()
    assert samples["joints"].tolist() == list(drive.bench.joints)
    assert dict(zip(names, samples["units"], strict=True))["joint.armature"] == "kg m^2"
    for at, name in enumerate(names):
        if name in drawn:
            found = drive.parameters[name]
            np.testing.assert_array_equal(samples["nominal"][at], found.value)
            np.testing.assert_array_equal(samples["low"][at], found.interval[:, 0])
            np.testing.assert_array_equal(samples["high"][at], found.interval[:, 1])


def test_every_mjcf_has_the_numbers_of_its_draw(written: Written, samples: dict[str, np.ndarray]) -> None:
    assert written.folder is not None and written.export is not None
    files = sorted((written.folder / "samples").iterdir())
    assert [path.name for path in files] == ["000.xml", "001.xml", "002.xml"]
    for number, path in enumerate(files):
        model = mujoco.MjModel.from_xml_path(str(path))
        assert model.dof_armature == samples["bench.armature"][number]
        assert (
            model.dof_frictionloss == samples["friction.frictionloss"][number] == samples["joint.frictionloss"][number]
        )
        assert model.dof_damping == samples["joint.damping"][number]
    assert all(difference.largest < EXACT for difference in written.export.differences)
    assert any(re.search(r"3 drives in samples/ are \S+ rad apart", limit) for limit in written.export.limits)
    assert {*written.export.files} == {
        str(path.relative_to(written.folder)) for path in written.folder.rglob("*") if path.is_file()
    } - {"export.json", MANIFEST}


def test_a_stated_range_is_filled_evenly_and_in_the_order_of_the_draws(drive: Identified) -> None:
    ranges = {"bench.armature": Range(0.5, 2.0), "bench.kp": Range(18.0, 22.0, absolute=True)}
    vague = declare(drive, False, "friction.damping")
    ranges["friction.damping"] = Range(0.5, 1.5)
    found = draw_variants(vague, COUNT, 0, ranges)
    armature, kp, _, damping = (one.values[:, 0] for one in found)
    value = {name: float(p.value[0]) for name, p in drive.parameters.items()}
    even = (np.arange(COUNT) + 0.5) / COUNT
    np.testing.assert_allclose(np.sort(armature), value["bench.armature"] * (0.5 + 1.5 * even))
    np.testing.assert_array_equal(np.argsort(armature), np.argsort(drive.sample(COUNT)["bench.armature"][:, 0]))
    np.testing.assert_allclose(np.sort(kp), 18 + 4 * even)  # known, and yet it varies
    np.testing.assert_allclose(np.sort(damping), value["friction.damping"] * (0.5 + even))
    assert abs(np.corrcoef(kp, armature)[0, 1]) < 0.5
    whys = [one.why[0] for one in found]
    assert whys[:2] == ["stated range of bench.armature", "stated range of bench.kp"]
    again = draw_variants(vague, COUNT, 0, ranges)
    np.testing.assert_array_equal(again[-1].values[:, 0], damping)


@pytest.mark.parametrize(
    ("option", "named"),
    [
        ("count=256", r"friction\.damping: not identifiable .*'ranges=\{.*frictionzoo\.design"),
        *(
            ("ranges={bench.armatur: [1, 2]}", r"did you mean bench\.arm"),
            ("ranges={bench.armature/hip: [1, 2]}", "/hip"),
        ),
        *((f"ranges={text}", "ranges=") for text in ("wide", "{a: [")),
        *((f"ranges={{bench.armature: {ends}}}", r"ranges: bench\.armature: ") for ends in ("2", "[2, 1]", "[a, 1]")),
        *((f"ranges={{bench.armature: {{{ends}}}}}", "in its unit$") for ends in ("low: 2", "low: -.inf, high: 1")),
        ("ranges={friction.damping: [1, 1e6]}", r"ranges: friction\.damping: .* within 0\.0001 to 10"),
        *(("operation=scal", "did you mean scale"), ("count=1.5", r"count=1\.5"), ("files=257", "files=257")),
        ("seed=x", "seed=x"),
    ],
)
def test_what_cannot_be_drawn_is_refused_in_a_line(drive: Identified, option: str, named: str, tmp_path: Path) -> None:
    name, _, value = option.partition("=")
    with pytest.raises(FrictionzooError, match=named) as caught:
        declare(drive, False, "friction.damping").export("randomisation", tmp_path / "drives", **{name: value})
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_a_drive_without_intervals_or_parameters_is_refused(drive: Identified) -> None:
    bare = declare(drive, False)
    bare = replace(bare, result=changed(bare.result, no_intervals="there is one segment only", covariance=None))
    with pytest.raises(FrictionzooError, match="there is one segment only"):
        draw_variants(bare, COUNT, 0, {})
    stated = {name: Range(0.9, 1.1) for name, p in drive.parameters.items() if p.identified}
    assert len(draw_variants(bare, COUNT, 0, stated)) == len(stated)
    known = copy.deepcopy(bare.result)
    for entry in (entry for row in known.parameters for entry in row.by_joint):
        entry.identified = False
    with pytest.raises(FrictionzooError, match="nothing was identified"):
        draw_variants(replace(bare, result=known), COUNT, 0, {})


def test_the_command_takes_ranges(finished_run, tmp_path, capsys):
    ranges = "ranges={bench.armature: [0.8, 1.2], friction.frictionloss: {low: 0.1, high: 1}, friction.damping: [1, 3]}"
    run = str(finished_run("mujoco_default")[0])
    main([run, "target=randomisation", ranges, "count=5", "files=1", f"output={tmp_path / 'drives'}"])
    assert "1 draws of them, each against itself" in capsys.readouterr().out
    with np.load(tmp_path / "drives" / "samples.npz") as found:
        assert np.ptp(found["friction.damping"]) == pytest.approx(2 * 0.8 * found["nominal"][-1], rel=1e-9)


@pytest.fixture(scope="module")
def another_law(finished_run: Callable[[str], tuple[Path, Finished]]) -> Identified:
    return fz.load(finished_run("coulomb_stribeck")[0])


EVERYTHING = {
    **{"bench.armature": [0.9, 1.1], "friction.static_torque": [0.9, 1.2], "friction.kinetic_torque": [0.5, 1.0]},
    **{"friction.stribeck_velocity": [0.8, 1.2], "friction.viscous_coefficient": [0.7, 1.3]},
}


def test_a_law_that_mujoco_lacks_is_refitted_draw_by_draw(another_law: Identified, tmp_path: Path) -> None:
    written = another_law.export(
        "randomisation", tmp_path / "drives", ranges=EVERYTHING, count=8, files=8, operation="scale"
    )
    assert written.export is not None
    # It slides all along the run's only rollout, where the law is Coulomb's and viscous friction. MuJoCo's damping is
    # implicit, as if there were that much more inertia.
    assert all(difference.largest < EXACT for difference in written.export.differences)
    found, step = read(written), another_law.timestep
    np.testing.assert_allclose(found["joint.damping"], found["friction.viscous_coefficient"], rtol=1e-5)
    np.testing.assert_allclose(found["joint.frictionloss"], found["friction.kinetic_torque"], rtol=1e-5)
    inertia = found["joint.armature"] + step * found["joint.damping"]
    np.testing.assert_allclose(inertia, found["bench.armature"], rtol=1e-6)
    for number, path in enumerate(sorted((tmp_path / "drives" / "samples").iterdir())):
        model = mujoco.MjModel.from_xml_path(str(path))
        assert model.dof_frictionloss == found["joint.frictionloss"][number]
        assert model.dof_armature == found["joint.armature"][number]
        assert "refitted, with the armature, to the drawn drive's own" in path.read_text()
    np.testing.assert_array_equal(
        found["joint.static_friction"], np.maximum(found["friction.static_torque"], found["joint.frictionloss"])
    )


def test_too_many_refits_are_refused(another_law: Identified, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for most, hint in ((4e4, r"draw at most \d+, or take"), (1.0, "too long; take a law")):
        monkeypatch.setattr(refit, "MOST_STEPS", most)
        with pytest.raises(FrictionzooError, match=rf"coulomb_stribeck: MuJoCo's joints.*{hint}.*frictionzoo\.distill"):
            another_law.export("randomisation", tmp_path / "drives", ranges=EVERYTHING)


def test_of_a_robot_each_draw_is_its_own_file(tmp_path: Path) -> None:
    fitted = fit_robot(save(tmp_path, LEG))
    bench, friction = dict(fitted.values["bench"]), fitted.values["friction"]
    terms = friction["frictionloss"], friction["damping"]
    drives = [(fitted, Nearest(bench | {"armature": k * bench["armature"]}, *terms)) for k in (1.0, 0.9, 1.2)]
    folder = tmp_path / "export"
    folder.mkdir()
    names, said = write_files(folder, drives)
    assert names == ["nominal.xml", "samples/000.xml", "samples/001.xml"]
    assert any("meshes" in sentence for sentence in said)
    for name, (_, of) in zip(names, drives, strict=True):
        text = (folder / name).read_text()
        assert text.endswith(LEG[-20:]) and all(repr(float(number)) in text for number in of.bench["armature"])


# A drive of two joints, of which the events are written: the hip's gains are known.
TWO = [
    ("joint.armature", "kg m^2", [0.02, 0.03], [(0.01, 0.03), (0.02, 0.05)]),
    ("joint.frictionloss", "N m", [0.2, 0.1], [(0.1, 0.3), (0.1, 0.1)]),
    ("joint.damping", "N m s/rad", [0.05, 0.06], [(0.05, 0.05), (0.02, 0.1)]),
    ("actuator.stiffness", "N m/rad", [20.0, 40.0], [(20.0, 20.0), (30.0, 50.0)]),
    ("actuator.damping", "N m s/rad", [1.0, 2.0], [(1.0, 1.0), (2.0, 2.0)]),
]
JOINTS = ("hip", "knee")


def quantities() -> list[Quantity]:
    rng, found = np.random.default_rng(0), []
    for name, unit, nominal, ends in TWO:
        low, high = np.array(ends).T
        why = tuple("95 % interval of x" if a < b else "" for a, b in ends)
        values = low + (high - low) * rng.random((COUNT, 2))
        found.append(Quantity(name, unit, values, np.array(nominal), np.array(ends), why))
    return found


def load_events(program: Any, folder: Path, operation: str, modules: dict[str, ModuleType]) -> Any:
    """The file of the drive of two joints, imported where the program is these modules."""
    found = quantities()
    np.savez(folder / "samples.npz", **{one.name: one.values for one in found})  # pyright: ignore[reportArgumentType]
    fitted = fit_robot(save(folder, LEG), [*JOINTS])
    fitted = replace(fitted, folder=Path("run 7"), result=changed(fitted.result, data={"name": "bars"}))
    text = write_events(program, fitted, found, {"knee": (2, 4)}, operation)
    (folder / program.file).write_text(text)
    with pytest.MonkeyPatch.context() as patch:
        for name, module in modules.items():
            patch.setitem(sys.modules, name, module)
        return load_module(folder / program.file)


def modules(**contents: dict[str, Any]) -> dict[str, ModuleType]:
    """Modules by their dotted names, with `__` for the dot, and what is in them."""
    made = {name.replace("__", "."): ModuleType(name.replace("__", ".")) for name in contents}
    for module, content in zip(made.values(), contents.values(), strict=True):
        module.__dict__.update(content)
    return made


class Term(SimpleNamespace):
    """An event's configuration."""

    params: dict[str, Any] = {}


class Entity(SimpleNamespace):
    """Which joints of an entity."""

    def __init__(self, name: str, joint_names: Any = None) -> None:
        super().__init__(name=name, joint_names=joint_names, joint_ids=slice(None))

    def resolve(self, scene: Any) -> None:
        (pattern,) = self.joint_names
        self.joint_ids = find_joints(pattern)[0]


def find_joints(pattern: str) -> tuple[list[int], list[str]]:
    names = ["other", *JOINTS]
    found = [at for at, name in enumerate(names) if re.fullmatch(pattern, name)]
    return found, [names[at] for at in found]


def assert_rows(*columns: tuple[str, torch.Tensor]) -> None:
    """In each world, the numbers of one draw."""
    drawn = {one.name: one.values for one in quantities()}
    together = np.concatenate([drawn[name] for name, _ in columns], axis=1).astype(np.float32)
    found = np.concatenate([values.numpy() for _, values in columns], axis=1)
    assert found.shape == (WORLDS, 2 * len(columns))
    rows = [np.flatnonzero((together == row).all(axis=1)) for row in found]
    assert all(len(row) == 1 for row in rows)
    assert len({int(row[0]) for row in rows}) > 0.9 * COUNT


def mjlab(fields: dict[str, torch.Tensor]) -> dict[str, ModuleType]:
    """What the file uses of mjlab 1.6, on a model of these fields."""

    def randomise(field: str) -> Callable[..., None]:
        def change(env, env_ids, ranges, asset_cfg, distribution="uniform", operation="abs") -> None:
            assert operation == "abs" and ranges == (0.0, 0.0)
            shape = len(env_ids), len(asset_cfg.joint_ids)
            fields[field][env_ids[:, None], asset_cfg.joint_ids] = distribution.sample(0.0, 0.0, shape, "cpu")

        return change

    def pd_gains(env, env_ids, kp_range, kd_range, asset_cfg, distribution="uniform", operation="scale") -> None:
        for name in ("kp", "kd"):
            (at,) = asset_cfg.actuator_ids
            fields[name][env_ids, 1 + at] = distribution.sample(0.0, 0.0, (len(env_ids), 1), "cpu")[:, 0]

    dr = SimpleNamespace(
        joint_armature=randomise("armature"),
        joint_friction=randomise("frictionloss"),
        joint_damping=randomise("damping"),
        pd_gains=pd_gains,
        Distribution=lambda name, sample: SimpleNamespace(name=name, sample=sample),
    )
    decorate = lambda *fields, recompute=None: lambda f: f  # noqa: E731
    levels = SimpleNamespace(none=0, set_const_0=2)
    manager = {"EventTermCfg": Term, "RecomputeLevel": levels, "requires_model_fields": decorate}
    return modules(
        mjlab__envs__mdp={"dr": dr},
        mjlab__managers__event_manager=manager,
        mjlab__managers__scene_entity_config={"SceneEntityCfg": Entity},
    )


def test_events_of_mjlab_give_each_world_one_draw(tmp_path: Path) -> None:
    fields = {name: torch.zeros(WORLDS, 3) for name in ("armature", "frictionloss", "damping", "kp", "kd")}
    events = load_events(MJLAB, tmp_path, "abs", mjlab(fields))
    actuators = [SimpleNamespace(target_names=(name,)) for name in JOINTS]
    env: Any = SimpleNamespace(num_envs=WORLDS, device="cpu", scene={"robot": SimpleNamespace(actuators=actuators)})
    (term,) = events.DRAWS.values()
    term.func(env, None, **term.params)
    assert all((field[:, 0] == 0).all() for field in fields.values())
    named = zip((name for name, *_ in TWO), fields.values(), strict=True)
    assert_rows(*((name, field[:, 1:]) for name, field in named))
    before = {name: field.clone() for name, field in fields.items()}
    term.func(env, torch.tensor([3, 5]))
    changed = {int(at) for name, field in fields.items() for at in torch.nonzero(field != before[name])[:, 0]}
    assert changed <= {3, 5}
    assert events.DELAYS == {"knee": {"delay_min_lag": 2, "delay_max_lag": 4}}
    said = "dof_armature [kg m^2] of hip: 0.01 to 0.03, 95 % interval of x in run 7"
    assert said in events.CHANGES
    armature = events.RANGES["joint_armature"].params
    assert armature["ranges"] == {"^hip$": (0.01, 0.03), "^knee$": (0.02, 0.05)}
    assert events.RANGES["joint_friction"].params["ranges"] == {"^hip$": (0.1, 0.3)}
    gains = events.RANGES["gains_knee"].params
    assert (gains["kp_range"], gains["kd_range"], gains["operation"]) == ((30, 50), (2, 2), "abs")
    env.scene["robot"].actuators[0].target_names = JOINTS
    with pytest.raises(ValueError, match="expected actuators of these joints alone"):
        term.func(env, None)


class Wrapped:
    """An array of Isaac Lab 3."""

    def __init__(self, values: torch.Tensor) -> None:
        self.torch = values


class Actuator(SimpleNamespace):
    """What the file uses of an actuator of Isaac Lab."""


class Articulation(SimpleNamespace):
    """What the file uses of an articulation of Isaac Lab 2, or of 3 with PhysX or Newton, with the real signatures."""

    def __init__(self, kind: str) -> None:
        zero = {name: torch.zeros(WORLDS, 3) for name in ("armature", "static", "dynamic", "viscous", "kp", "kd")}
        implicit = Actuator(stiffness=zero["kp"], damping=zero["kd"])
        of = {"friction": 0.3, "dynamic_friction": 0.2, "viscous_friction": 0.1}
        if kind == "newton":
            del of["dynamic_friction"]
        made = {f"joint_{name}_coeff": torch.full((WORLDS, 3), value) for name, value in of.items()}
        data = {name: values if kind == "2" else Wrapped(values) for name, values in made.items()}
        cfg = SimpleNamespace(actuators={"all": SimpleNamespace(joint_names_expr=[".*"])})
        more = {"cfg": cfg, "actuators": {"all": implicit}, "data": SimpleNamespace(**data)}
        super().__init__(num_joints=3, device="cpu", written=zero, **more)
        for name, arguments in ISAAC_LABS[kind].items():
            setattr(self, name, partial(self.write, arguments))

    def find_joints(self, patterns: Any) -> tuple[list[int], list[str]]:
        return find_joints("|".join([patterns] if isinstance(patterns, str) else patterns))

    def write(self, names: list[str], *, joint_ids: torch.Tensor, env_ids: torch.Tensor, **given: Any) -> None:
        assert {*given, "joint_ids", "env_ids"} <= {*names}
        for name, values in given.items():
            if values is not None:
                assert values.shape == (len(env_ids), len(joint_ids)) and values.is_contiguous()
                self.written[WRITTEN[name]][env_ids[:, None], joint_ids] = values


WRITTEN = {
    **{"armature": "armature", "joint_friction_coeff": "static", "joint_dynamic_friction_coeff": "dynamic"},
    **{"joint_viscous_friction_coeff": "viscous", "stiffness": "kp", "damping": "kd"},
}
RECORDED = load_recorded()
ISAAC_LABS = {"2": RECORDED["2"]["writers"]["physx"], **RECORDED["3"]["writers"]}


def isaac_lab() -> dict[str, ModuleType]:
    mdp = SimpleNamespace(**{name: name for name in RECORDED["3"]["events"]})
    base = type("ManagerTermBase", (), {"__init__": lambda self, cfg, env: None})
    return modules(
        isaaclab__envs={"mdp": mdp},
        isaaclab__actuators={"ActuatorBase": Actuator, "ImplicitActuator": type("ImplicitActuator", (Actuator,), {})},
        isaaclab__managers={"EventTermCfg": Term, "ManagerTermBase": base, "SceneEntityCfg": Entity},
    )


@pytest.mark.parametrize("kind", ISAAC_LABS)
def test_events_of_isaac_lab_give_each_world_one_draw(tmp_path: Path, kind: str) -> None:
    events = load_events(ISAAC_LAB, tmp_path, "scale", isaac_lab())
    asset = Articulation(kind)
    env: Any = SimpleNamespace(scene=type("Scene", (dict,), {"num_envs": WORLDS})(robot=asset))
    moving = "static" if kind == "newton" else "dynamic"
    friction = events.RANGES["friction_hip"]
    drawn = friction.func(friction, env)  # the managers make the terms that are classes
    (term,) = events.DRAWS.values()
    term.func(env, None, **term.params)
    named = zip((name for name, *_ in TWO), ("armature", moving, "viscous", "kp", "kd"), strict=True)
    assert_rows(*((name, asset.written[quantity][:, 1:]) for name, quantity in named))
    if kind == "newton":  # one dry friction
        assert not asset.written["dynamic"].any()
    else:
        np.testing.assert_array_equal(asset.written["static"], asset.written["dynamic"])
    friction.params["asset_cfg"].joint_ids = [1]
    drawn(env, slice(None), **friction.params)  # shares of what the articulation was made with
    low, high = asset.written[moving][:, 1].min(), asset.written[moving][:, 1].max()
    share = 1.5 if kind == "newton" else 1.0  # 0.3 in place of 0.2
    assert 0.1 * share <= low < 0.11 * share and 0.29 * share < high <= 0.3 * share
    np.testing.assert_allclose(asset.written["viscous"][:, 1], 0.1, rtol=1e-6)
    assert events.RANGES["armature_knee"].params["armature_distribution_params"] == (0.666667, 1.66667)
    gains = events.RANGES["gains_knee"].params
    assert (gains["stiffness_distribution_params"], gains["damping_distribution_params"]) == ((0.75, 1.25), (1, 1))
    for term in events.RANGES.values():
        if isinstance(term.func, str):  # Isaac Lab's own
            assert all({*term.params} <= {*of["events"][term.func]} for of in RECORDED.values())
    assert events.DELAYS == {"knee": {"min_delay": 2, "max_delay": 4}}


@pytest.mark.slow
@pytest.mark.skipif(IN_MJLAB not in os.environ, reason=f"{IN_MJLAB} names no Python with mjlab")
def test_events_change_worlds_of_mjlab(drive: Identified, tmp_path: Path) -> None:
    written = drive.export("randomisation", tmp_path / "drives", ranges={"bench.kp": [0.9, 1.1]}, count=64, files=1)
    out = tmp_path / "in_mjlab.json"
    script = [ROOT / "benchmarks" / "in_mjlab.py", written.folder, "--out", out, "--worlds", "256", "--steps", "100"]
    finished = subprocess.run([os.environ[IN_MJLAB], *map(str, script)], capture_output=True, text=True, cwd=tmp_path)
    assert finished.returncode == 0, finished.stderr
    found = json.loads(out.read_text())
    fields = {row["field"] for row in found["rows"]}
    assert fields == {"dof_armature", "dof_frictionloss", "dof_damping", "actuator_gainprm"}
    for row in found["rows"]:
        wide = row["high"] - row["low"]
        assert row["most"] - row["least"] > 0.8 * wide
        if row["events"] == "DRAWS":
            assert row["apart"] < 1e-5  # float32
        else:
            assert row["low"] - 1e-5 * wide <= row["least"] and row["most"] <= row["high"] + 1e-5 * wide
    for row in found["motions"]:
        assert row["from MuJoCo C"] < 1e-5 < row["between worlds"]
