"""Laws of their own for groups of joints: as MuJoCo C, as the plain law, found again, read back, refused."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from helpers.two_joints import identify, record

import frictionzoo as fz
from frictionzoo.bench import Bench
from frictionzoo.core.errors import FrictionzooError
from frictionzoo.core.log import Log
from frictionzoo.core.state import DriveState, Signals
from frictionzoo.fit import Space
from frictionzoo.simulation.drive import Drive, looks_at_one_joint
from frictionzoo.simulation.proof import Recorded, initial_values, prove

pytestmark = pytest.mark.usefixtures("x64", "in_haste")

MIXED = {"tail.*": "coulomb_smooth", ".*_hip": "lugre", ".*": "mujoco_default"}
SEVERAL = ["mujoco_default", "lugre", "baseline", {"law": "odd_network", "hidden": [4]}, "temperature_linear"]
SIDES = ("left", "right")
TRUTH = {
    "mujoco_default": {"frictionloss": 0.1, "damping": 0.05},
    "stribeck": {"frictionloss": 0.2, "damping": 0.1, "stribeck_torque": 0.3, "stribeck_velocity": 0.3},
}
KNOWN = {"stribeck_exponent": {"init": 2.0}}
HIP_AND_KNEE = {"knee": {"law": "stribeck", "params": KNOWN}, ".*": "mujoco_default"}


def by_joint(laws: Any, nv: int) -> Any:
    return fz.law("by_joint", nv=nv, laws=laws)


def test_parameters_are_those_of_the_joints_of_a_law(robot: Callable[..., Bench]) -> None:
    bench, law = robot(), by_joint(MIXED, 5)
    law.bind(bench.joints)
    assert law.members == ((2,), (0, 3), (1, 4)) and law.memory == 1
    assert law.constrained == (False, True, False, False, True)
    space = Space(bench, law, "float64")
    assert [label for label in space.labels if "viscous" in label or "damping" in label] == [
        "friction.coulomb_smooth.viscous_coefficient",
        *(f"friction.lugre.{name}/{j}_hip" for name in ("micro_damping", "viscous_coefficient") for j in SIDES),
        *(f"friction.mujoco_default.damping/{side}_knee" for side in SIDES),
    ]
    before, after = (space.values(vector)["friction"] for vector in (space.start, space.start + np.log(2)))
    name = "mujoco_default.damping"
    np.testing.assert_allclose(after[name] / before[name], [2, 2])
    whole = np.asarray(space.identified(space.start)[f"friction.{name}"])
    assert np.isnan(whole).tolist() == [True, False, True, True, False]
    tied = by_joint({".*_hip": {"law": "mujoco_default", "params": {"damping": {"tie": True}}}, ".*": "baseline"}, 5)
    tied.bind(bench.joints)
    labels = Space(robot(tie={"hip": "(left|right)_hip"}), tied, "float64").labels
    of_hips = ["friction.mujoco_default.frictionloss/hip", "friction.mujoco_default.frictionloss/tail_hip"]
    assert labels[-3:] == [*of_hips, "friction.mujoco_default.damping"]


@pytest.mark.parametrize("engine", ["specialised", pytest.param("mjx", marks=pytest.mark.slow)])
def test_it_is_simulated_as_mujoco_does(robot: Callable[..., Bench], engine: str) -> None:
    """With and without constraint in one leg, without any in the tail; with memory, network and temperature."""
    law, rng = by_joint(SEVERAL, 5).double(), np.random.default_rng(1)
    bench = robot().observing(law.inputs)
    qpos, qvel, ctrl = rng.normal(size=(3, 40, 5))
    signals = Signals(ctrl, {}, {"temperature": 25 + 10 * rng.normal(size=(40, 5))})
    assert looks_at_one_joint(law)
    assert Drive.assemble(bench, law, engine).rollout.branches == (0, 0, 1, 2, 2)
    recorded = Recorded(qpos, qvel, signals, np.zeros((40, 0)))
    assert prove(bench, law, engine, initial_values(bench, law), recorded).rollout < 1e-11


def test_each_joint_has_the_terms_and_the_memory_of_its_law() -> None:
    law, rng = by_joint(SEVERAL, 5).double(), np.random.default_rng(0)
    samples = DriveState(*rng.normal(size=(6, 30, 5)))
    law.prepare(samples)
    state = samples.map(torch.from_numpy)
    values = dict(law.state_dict())
    memory = law.settle(torch, values, state)
    terms, after = law.advance(torch, values, state, memory, 0.001)
    for joint, alone in enumerate(law.laws[index] for index in range(5)):
        own = state.map(lambda signal, joint=joint: signal[:, joint : joint + 1])
        held = alone.settle(torch, dict(alone.state_dict()), own)
        expected, held = alone.advance(torch, dict(alone.state_dict()), own, held, 0.001)
        torch.testing.assert_close(after[:, joint : joint + 1, : alone.memory], held, check_dtype=False)
        assert (after[:, joint, alone.memory :] == 0).all()
        for came, term in zip(terms, expected, strict=True):
            wanted = torch.zeros((30, 1), dtype=torch.float64) if term is None else term.expand(30, 1)
            torch.testing.assert_close(came[:, joint : joint + 1], wanted, rtol=0, atol=0)
    scale = [float(network.torque_scale) for network in law.laws if hasattr(network, "torque_scale")]
    assert scale == pytest.approx([samples.motor_torque[:, 3].std()])  # of its joint alone


def test_it_keeps_the_contract_of_all_laws() -> None:
    fz.check_model(by_joint(SEVERAL, 5))


def test_each_law_begins_with_what_a_robots_file_says(dog: Callable[..., fz.Robot]) -> None:
    bench, law = dog(), by_joint({".*_calf_joint": "stribeck", "left.*": "lugre", ".*": "mujoco_default"}, 4)
    law.bind(bench.joints)
    law.begin(bench.initial_friction(law.params))
    begun = {name: value.tolist() for name, value in law.state_dict().items() if "loss" in name or "damping" in name}
    assert begun["stribeck.frictionloss"] == [0.2, 0.2] and begun["stribeck.damping"] == [0.1, 0.1]
    assert (begun["mujoco_default.frictionloss"], begun["mujoco_default.damping"]) == ([0.2], [0.1])
    assert begun["lugre.micro_damping"] != [0.1]


def test_networks_of_two_patterns_have_weights_of_their_own() -> None:
    network = {"law": "odd_network", "hidden": [4]}
    law = by_joint({".*_hip": network, ".*_knee": network}, 4)
    law.bind(["left_hip", "left_knee", "right_hip", "right_knee"])
    assert law.labels == ("odd_network_1", "odd_network_2")
    shared = by_joint([network] * 4, 4)
    assert shared.labels == ("odd_network",) and shared.members == ((0, 1, 2, 3),)
    own, place, prefix = law.of_joint(3)
    assert own is law.laws[1] and (place, prefix) == (1, "odd_network_2.")
    names = [name for name, _ in law.named_parameters()]
    assert len(names) == 2 * len([*shared.parameters()]) and "odd_network_2.layers.0.weight" in names


@pytest.fixture(scope="module")
def recorded(leg: Callable[..., Bench]) -> Log:
    """Hip and knee with laws of their own, simulated."""
    truth = {label: {name: {"init": value} for name, value in known.items()} for label, known in TRUTH.items()}
    laws = {"knee": {"law": "stribeck", "params": truth["stribeck"] | KNOWN}}
    law = by_joint(laws | {"hip": {"law": "mujoco_default", "params": truth["mujoco_default"]}}, 2)
    bench = leg(params={"armature": [0.02, 0.03]})
    law.bind(bench.joints)
    return record(bench, law)


@pytest.fixture(scope="module")
def found(leg: Callable[..., Bench], recorded: Log) -> fz.Identified:
    return identify(leg(), recorded, HIP_AND_KNEE)


def test_each_law_is_found_in_its_joint(found: fz.Identified) -> None:
    np.testing.assert_allclose(found.parameters["bench.armature"].value, [0.02, 0.03], rtol=1e-4)
    for label, joint in (("mujoco_default", 0), ("stribeck", 1)):
        for name, truth in TRUTH[label].items():
            parameter = found.parameters[f"friction.{label}.{name}"]
            assert parameter.value[joint] == pytest.approx(truth, rel=1e-3)
            assert np.isnan(parameter.value[1 - joint]) and np.isnan(parameter.interval[1 - joint]).all()
            (row,) = parameter.by_joint
            assert row["name"] == found.bench.joints[joint] and row["joints"] == [row["name"]] and row["identifiable"]
    shown = str(found)
    assert found.result["model"] == "by_joint" and "friction.stribeck.damping" in shown
    assert "null" not in shown and "nan" not in shown


@pytest.mark.usefixtures("unrendered")
def test_a_run_is_written_and_read_back(found: fz.Identified, tmp_path: Path) -> None:
    found.save(tmp_path / "run")
    page = (tmp_path / "run" / "report.html").read_text()
    assert "stribeck.stribeck_velocity" in page and "mujoco_default.damping" in page
    loaded = fz.load(tmp_path / "run")
    rows = {row["name"]: row for row in loaded.result["parameters"]}
    assert rows["stribeck.damping"]["value"][0] is None and rows["stribeck.damping"]["interval"][0] is None
    for one, other in zip(loaded.rollout(), found.rollout(), strict=True):
        np.testing.assert_array_equal(one, other)


def test_with_one_law_for_all_joints_it_is_that_law(leg: Callable[..., Bench], recorded: Log) -> None:
    """Bit for bit, in rollouts and their gradient; split into two laws of one kind, to rounding."""
    bench, (qpos, qvel, ctrl) = leg(), (torch.from_numpy(x[:50]) for x in (recorded.qpos, recorded.qvel, recorded.ctrl))
    found = []
    for laws in (None, "mujoco_default", {"knee": "mujoco_default", "hip": "mujoco_default"}):
        law = fz.law("mujoco_default", nv=2) if laws is None else by_joint(laws, 2)
        law.bind(bench.joints)
        rolled = fz.rollout(bench, law, qpos[:1], qvel[:1], ctrl[None])
        rolled[0].square().sum().backward()
        slopes = [value.grad for name, value in law.named_parameters() if name.endswith("damping")]
        found.append([*(part.detach() for part in rolled), torch.cat(slopes[::-1])])
    for plain, same, split in zip(*found, strict=True):
        assert torch.equal(plain, same)
        torch.testing.assert_close(split, plain, rtol=1e-11, atol=1e-13)


@pytest.mark.slow
def test_a_fit_with_one_law_for_all_joints_is_that_of_the_law(leg: Callable[..., Bench], recorded: Log) -> None:
    plain, ours = (identify(leg(), recorded, law) for law in ("mujoco_default", "by_joint"))
    for name in ("frictionloss", "damping"):
        one, other = ours.parameters[f"friction.mujoco_default.{name}"], plain.parameters[f"friction.{name}"]
        np.testing.assert_array_equal(one.value, other.value)
        np.testing.assert_array_equal(one.interval, other.interval)
    assert ours.metrics == plain.metrics


@pytest.mark.slow
def test_inverse_dynamics_takes_each_joints_law(leg: Callable[..., Bench], recorded: Log) -> None:
    start = identify(leg(), recorded, by_joint(HIP_AND_KNEE, 2), method="inverse_dynamics")
    hip, knee = (start.parameters[f"friction.{label}.damping"].value for label in TRUTH)
    assert hip[0] == pytest.approx(0.05, rel=0.2) and knee[1] == pytest.approx(0.1, rel=0.2)


def read_joints(path: Path) -> dict[str, dict[str, float]]:
    model = mujoco.MjModel.from_xml_path(str(path))
    names = ("dof_armature", "dof_frictionloss", "dof_damping")
    return {j: {name: float(getattr(model, name)[model.joint(j).dofadr[0]]) for name in names} for j in ("hip", "knee")}


@pytest.mark.slow
def test_what_mujoco_has_is_exported_as_it_is_and_the_rest_is_the_nearest(found: fz.Identified, tmp_path: Path) -> None:
    written = found.export("mjcf", tmp_path / "mjcf").export
    assert written is not None
    joints, (said, *_) = read_joints(tmp_path / "mjcf" / "bench.xml"), written.limits
    assert said.startswith(
        "Frictionloss and damping cannot represent stribeck (of knee): they were refitted, with the armature,"
    )
    assert said.endswith("The other joints have the values of their model.")
    known = {name: parameter.value for name, parameter in found.parameters.items()}
    assert joints["hip"] == {
        "dof_armature": known["bench.armature"][0],
        "dof_frictionloss": known["friction.mujoco_default.frictionloss"][0],
        "dof_damping": known["friction.mujoco_default.damping"][0],
    }
    low, more = (known[f"friction.stribeck.{name}"][1] for name in ("frictionloss", "stribeck_torque"))
    assert low < joints["knee"]["dof_frictionloss"] < low + more
    assert joints["knee"]["dof_armature"] != known["bench.armature"][1]
    # The friction of none is exactly none.
    bare = by_joint(["baseline", "stribeck"], 2).double()
    values = {**found.values, "friction": {name: value.detach().numpy() for name, value in bare.state_dict().items()}}
    replace(found, model=bare, values=values).export("mjcf", tmp_path / "bare")
    hip, knee = read_joints(tmp_path / "bare" / "bench.xml").values()
    assert hip["dof_frictionloss"] == hip["dof_damping"] == 0 < knee["dof_frictionloss"]


TARGETS = ["mujoco", "mjx", "torchscript", "mjlab", "isaaclab"]


@pytest.mark.slow
@pytest.mark.parametrize("target", TARGETS)
def test_it_is_written_for_other_programs(found: fz.Identified, tmp_path: Path, target: str) -> None:
    written = found.export(target, tmp_path / target).export
    assert written is not None
    exact = not target.endswith("lab")
    assert all(difference.largest < 1e-9 for difference in written.differences) == exact


@pytest.mark.slow
def test_laws_that_remember_are_written_side_by_side(found: fz.Identified, tmp_path: Path) -> None:
    remembering = {"law": "history_network", "hidden": [4], "memory": 3}
    law, rng = by_joint(["lugre", remembering], 2).double(), np.random.default_rng(0)
    law.prepare(DriveState(*rng.normal(size=(6, 30, 2))))
    values = {**found.values, "friction": {name: value.detach().numpy() for name, value in law.state_dict().items()}}
    written = replace(found, model=law, values=values).export("mujoco", tmp_path / "drive").export
    assert written is not None and written.differences[0].largest < 1e-9
    with pytest.raises(FrictionzooError, match="target=onnx: by_joint has memory"):
        replace(found, model=law, values=values).export("onnx", tmp_path / "onnx")


@pytest.mark.parametrize(
    ("laws", "message"),
    [
        (["stribeck"], "laws: 1 laws, expected 2, one a joint; or go by patterns of names"),
        ({"hip": "stribeck"}, "laws: no pattern of hip fits knee; add one, such as '.*', last"),
        (
            {".*": "dahl", "hip": "lugre"},
            "laws: hip: no joint for it; hip matches an earlier pattern; put this one first, or",
        ),
        ({".*": "dahl", "ankle": "lugre"}, "laws: ankle: no joint for it; expected one of hip, knee, or leave it out"),
        ({"(": "dahl", ".*": "lugre"}, "laws: (: no pattern (missing ), unterminated subpattern at position 0)"),
        ({"hip": "stribek", ".*": "lugre"}, "laws: hip: stribek: no such friction model; did you mean stribeck?"),
        (["dahl", {"law": "stribeck", "hiden": 3}], "laws: [1]: hiden: unknown option"),
        ({".*": {"law": "stribeck", "params": {"dampin": {}}}}, "laws: .*: Stribeck: unknown parameter dampin"),
        ({".*": {"params": {}}}, "laws: .*: {'params': {}}, expected the name of a law, or a section {law: NAME}"),
        (["by_joint", "dahl"], "laws: [0]: by_joint has laws of its own, expected a formula for some of the joints"),
        (
            ["temperature_linear", {"law": "temperature_arrhenius", "reference": 30.0}],
            "laws: temperature is 25 to one law and 30 to temperature_arrhenius where recordings lack it",
        ),
        (7, "laws=7; expected"),
    ],
)
def test_what_is_wrong_is_one_line(two_joints: Bench, laws: Any, message: str) -> None:
    with pytest.raises(FrictionzooError) as caught:
        by_joint(laws, 2).bind(two_joints.joints)
    said = str(caught.value).replace("model.laws", "laws")
    assert said.startswith(message) and "\n" not in said


def test_a_law_that_does_not_know_the_joints_names_says_so(two_joints: Bench) -> None:
    law, state = by_joint(HIP_AND_KNEE, 2), torch.zeros((1, 2), dtype=torch.float64)
    with pytest.raises(FrictionzooError, match=r"call bind\(bench.joints\)"):
        fz.rollout(two_joints, law, state, state, state[:, None])
