"""Results of several joints: which one is at a bound, vague or worse, in the record, on a terminal and on a page."""

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from helpers.browser import read_data
from helpers.results import FIT, PROOF, SETTINGS, TIMESTEP, TIMING, curves_of, make_rollout
from msgspec.structs import replace as replace_fields

from frictionzoo.bench import Bench, PositionPD
from frictionzoo.bench.base_parameters import BaseParameters
from frictionzoo.bench.inertia import SYMBOLS
from frictionzoo.core.log import Dataset, Log
from frictionzoo.core.output import to_json
from frictionzoo.fit.link_inertia import LinkInertia
from frictionzoo.fit.tilt import Tilt
from frictionzoo.fit.uncertainty import Covariance, Uncertainty
from frictionzoo.models.mujoco_default import MujocoDefault
from frictionzoo.report.run_page import check_result, write_report
from frictionzoo.report.terminal import summarise
from frictionzoo.result.draws import draw_parameters
from frictionzoo.result.evaluate import Evaluator
from frictionzoo.result.names import label_values, merge_known, name_some
from frictionzoo.result.record import build_result, pick_metrics, read_schema
from frictionzoo.result.section_types import JointTorque, Torque, TorqueErrors, TorqueParts
from frictionzoo.result.types import EvaluationRollouts
from frictionzoo.result.verdict import doubt_joints, explain_failure

SECTION: dict[str, Any] = {"init": 0.1, "low": 0.01, "high": 1.0, "scale": "log", "identify": True}
JOINTS = ("FL_hip", "FL_knee", "FR_hip", "FR_knee")
MJCF = """<mujoco><option timestep="0.001"/><worldbody><body name="base">{}</body></worldbody></mujoco>"""
LIMB = """<body><joint name="{0}_hip" axis="0 1 0"/><inertial pos="0 0 -.1" mass="1" diaginertia=".01 .01 .01"/>
<body pos="0 0 -.2"><joint name="{0}_knee" axis="0 1 0"/><inertial pos="0 0 -.1" mass="1" diaginertia=".01 .01 .01"/>
</body></body>"""
ENDS = [[0.05, 0.2], [np.nan, np.nan], [0.05, 0.2], [0.01, 1.0]]


def follow(values: Any, qpos: Any, qvel: Any, signals: Any, load: Any) -> tuple[np.ndarray, np.ndarray]:
    """A drive that follows its command, each joint with an offset of its own."""
    return signals.ctrl + values["bench"]["offset"], np.zeros_like(signals.ctrl)


def torque_row() -> Torque:
    """What is left of torque: more of each joint than of the one before."""
    rows = [TorqueErrors(residual=0.1 * number, torque=2.0) for number in range(1, 5)]
    mean = TorqueErrors(residual=0.25, torque=2.0)
    by_joint = [JointTorque(joint, row, row) for joint, row in zip(JOINTS, rows, strict=True)]
    return Torque("torque", "N m", bandwidth=20.0, held=False, mean=TorqueParts(mean, mean), by_joint=by_joint)


def links_found() -> LinkInertia:
    """One link, of which the data determine the mass, and nothing of two of its moments."""
    maker = np.array([[1.0, 0, 0, -0.1, 0.02, 0.02, 0.01, 0, 0, 0]])
    names = tuple(f"{symbol} FL_thigh" for symbol in SYMBOLS)
    matrix = np.zeros((2, 10))
    matrix[0, [0, 3, *range(6, 10)]], matrix[1, [1, 2]] = 1.0, 1.0
    base, prior = BaseParameters(names, (0, 1), matrix), np.array([0.1, 0.02])
    found = np.array([[1.2, 0.01, 0, -0.12, 0.03, 0.03, 0.01, 0, 0, 0]])
    values, errors = base.matrix @ found[0], np.array([0.02, np.inf])
    tilt = replace(Tilt.upright(np.array([0.0, 0.0, -9.81])), leaning=np.array([0.0, 0.02]), errors=np.full(2, 0.001))
    return LinkInertia(("FL_thigh",), maker, found, base, values, errors, prior, np.ones(4), tilt)


@pytest.fixture(scope="module")
def findings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Four joints: armature is tied by motor, and frictionloss is at a bound in one joint and vague in another."""
    path = tmp_path_factory.mktemp("by_joint") / "legs.xml"
    path.write_text(MJCF.format(LIMB.format("FL") + LIMB.format("FR")))
    armature = {**SECTION, "tie": {"hips": ".*_hip", "knees": ".*_knee"}}
    gains = PositionPD(kp=[20, 40, 20, 40], kd=1)
    bench = Bench(str(path), JOINTS, actuator=gains, params={"armature": armature})
    bench.notes = ("contacts are left out",)
    law = MujocoDefault(4, {"frictionloss": SECTION, "damping": {**SECTION, "identify": {"FL_.*": True, ".*": False}}})
    law.bind(bench.joints)
    time = TIMESTEP * np.arange(400)
    wave = np.sin(3 * time)[:, None] * np.ones(4)
    log = Log("waves", time, wave, 3 * np.cos(3 * time)[:, None] * np.ones(4), wave, sha256=64 * "a", simulated=True)
    dataset = Dataset("waves", (log,), (log,))
    evaluation = Evaluator(dataset, "hinge", [0.1], 4, trajectory=0.3, window=0.02, places=3, local=0.05)
    values = {"bench": bench.initial_values(), "friction": {n: np.full(4, 0.1) for n in ("frictionloss", "damping")}}
    values["friction"]["frictionloss"][1] = 1.0

    def judge(*offset: float) -> Any:
        return evaluation.judge(follow, {"bench": {"offset": np.array(offset)}})

    determined = {"bench.armature": [True] * 4, "friction.frictionloss": [True, False, True, False]}
    found = Uncertainty(
        {"bench.armature": np.full((4, 2), [0.05, 0.2]), "friction.frictionloss": np.array(ENDS)},
        {name: np.array(joints) for name, joints in determined.items()},
        (("friction.frictionloss/FL_knee", "friction.frictionloss/FR_knee"),),
    )
    return dict(
        **{"model_name": "mujoco_default", "bench": bench, "model": law, "values": values, "dataset": dataset},
        **{
            "evaluation": EvaluationRollouts(evaluation.sha256, 0.02),
            "judgement": judge(0.01, 0.02, 0.03, 0.1),
            "baseline": judge(*[0.05] * 4),
        },
        **{"reference": bench.initial_values(), "fit": FIT, "timing": TIMING, "settings": SETTINGS, "engine": "mjx"},
        **{
            "torque": torque_row(),
            "links": links_found(),
            "proof": PROOF,
            "warnings": [],
            "device": "cpu",
            "uncertainty": found,
            "recipe": [],
            "residual": None,
        },
    )


@pytest.fixture
def result(findings: dict[str, Any]) -> Any:
    return build_result(**findings)


def of(result: Any, name: str) -> Any:
    return next(row for row in result["parameters"] if row["name"] == name)


def test_the_record_tells_which_joint(result: Any) -> None:
    jsonschema.Draft202012Validator(read_schema()).validate(to_json(result))
    loss = of(result, "frictionloss")
    assert (loss["at_bound"], loss["identifiable"]) == (True, False)
    assert [row["at_bound"] for row in loss["by_joint"]] == [False, True, False, False]
    assert [row["identifiable"] for row in loss["by_joint"]] == [True, False, True, False]
    assert [row["interval"] for row in loss["by_joint"]] == [[0.05, 0.2], None, [0.05, 0.2], [0.01, 1.0]]
    assert loss["interval"] == [[0.05, 0.2], None, [0.05, 0.2], [0.01, 1.0]]
    shared = {row["name"]: row["joints"] for row in of(result, "armature")["by_joint"]}
    assert shared == {"hips": ["FL_hip", "FR_hip"], "knees": ["FL_knee", "FR_knee"]}
    assert [row["identified"] for row in of(result, "damping")["by_joint"]] == [True, True, False, False]
    assert [row["name"] for row in of(result, "kd")["by_joint"]] == ["all joints"]
    assert [row["name"] for row in of(result, "kp")["by_joint"]] == list(JOINTS)
    assert result["notes"] == ["contacts are left out"]


def test_what_is_drawn_of_each_joint_stays_where_it_is_known_or_vague(findings: dict[str, Any]) -> None:
    labels = (
        "bench.armature/hips",
        "bench.armature/knees",
        *(f"friction.frictionloss/{joint}" for joint in JOINTS if joint != "FL_knee"),
    )
    spread = Covariance(labels, np.log([0.1] * 5), 0.01 * np.eye(5), 49.0)
    result = build_result(**findings | {"uncertainty": replace(findings["uncertainty"], covariance=spread)})
    jsonschema.Draft202012Validator(read_schema()).validate(to_json(result))
    found = draw_parameters("here", result, findings["bench"], findings["model"], 1000, seed=0)
    assert found.keys() == {"bench.armature", "friction.frictionloss"}  # of damping nothing is said
    armature, loss = found["bench.armature"], found["friction.frictionloss"]
    np.testing.assert_array_equal(armature[:, :2], armature[:, 2:])  # tied
    assert abs(np.corrcoef(armature[:, :2].T)[0, 1]) < 0.1
    # At a bound, without an interval, and not identifiable.
    np.testing.assert_array_equal(loss[:, [1, 3]], np.tile([1.0, 0.1], (1000, 1)))
    drawn = np.concatenate([armature[:, :2], loss[:, [0, 2]]], axis=1)
    assert np.log(drawn).std(axis=0) == pytest.approx(0.1, rel=0.1)


def test_the_errors_of_the_joints_have_the_mean_of_all(result: Any, findings: dict[str, Any]) -> None:
    assert [row["joint"] for row in result["by_joint"]] == list(JOINTS)
    for part, metrics in to_json(result.metrics).items():
        errors = [row[part] for row in result["by_joint"]]
        assert np.mean([e["position_mae"] for e in errors]) == pytest.approx(metrics["position_mae"], rel=1e-12)
        for key in ("position_rmse", "velocity_rmse"):
            assert np.sqrt(np.mean(np.square([e[key] for e in errors]))) == pytest.approx(metrics[key], rel=1e-12)
    # Between the command and the sample that it is compared with, the joint moves on by up to 3 mrad.
    found = [row["test"]["position_mae"] for row in result["by_joint"]]
    np.testing.assert_allclose(found, [0.01, 0.02, 0.03, 0.1], atol=0.003)


def test_the_record_tells_links_beside_their_makers(result: Any) -> None:
    (link,) = result["links"]["links"]
    assert (link["body"], link["found"]["mass"], link["maker"]["mass"]) == ("FL_thigh", 1.2, 1.0)
    np.testing.assert_allclose(link["maker"]["centre"], [0, 0, -0.1])
    # Steiner: about the centre, 0.1 m below the origin, Ixx and Iyy are less by m 0.1^2.
    np.testing.assert_allclose(link["maker"]["inertia"], [0.01, 0.01, 0.01, 0, 0, 0], atol=1e-12)
    assert link["prior_only"] == ["mx", "my", "Ixx", "Iyy"]
    gravity = result["links"]["gravity"]
    np.testing.assert_allclose(gravity["found"], [0, 0.1962, -9.808], atol=1e-3)
    assert (gravity["maker"], round(gravity["angle"], 5), gravity["error"]) == ([0, 0, -9.81], 0.02, 0.001)
    first, second = result["links"]["base"]
    assert first["determined"] and not second["determined"] and result["links"]["determined"] == 1
    assert to_json(second) == {
        **{"combination": "mx FL_thigh + my FL_thigh", "value": 0.01, "error": None, "determined": False},
    }


def test_labels_name_the_joint_or_the_joints_that_share(result: Any) -> None:
    assert [*label_values(of(result, "armature"))] == ["bench.armature/hips", "bench.armature/knees"]
    assert [*label_values(of(result, "kd"))] == ["bench.kd"]
    picked = {name for name in pick_metrics(result) if name.startswith("identified/friction.damping")}
    assert picked == {"identified/friction.damping/FL_hip", "identified/friction.damping/FL_knee"}
    gains = merge_known(of(result, "kp")["by_joint"])
    assert [(row["name"], row["value"]) for row in gains] == [("FL_hip, FR_hip", 20.0), ("FL_knee, FR_knee", 40.0)]
    assert name_some([*"abcdef"]) == "a, b, c, d and 2 more"


def test_the_terminal_has_a_row_a_joint(result: Any) -> None:
    text = summarise(result, None)
    table, _, joints, torque = (block.splitlines() for block in text.split("\n\n")[1:5])
    rows = [line.split() for line in table]
    assert rows[0] == ["parameter", "joint", "value", "95", "%", "interval", "unit"]
    assert rows[1][:3] == ["bench.armature", "hips", "0.1"] and rows[2][:2] == ["knees", "0.1"]
    assert [line for line in table if "FL_knee" in line and line.endswith("at a bound")]
    assert [line for line in table if "FR_knee" in line and line.endswith("not identifiable")]
    assert [line.split()[0] for line in joints] == ["position", *JOINTS]
    assert [line.split()[0] for line in torque[1:]] == [*JOINTS, "mean"]
    assert torque[4].split() == ["FR_knee", "0.4", "2", "N", "m", "20", "%"] and torque[5].split()[1] == "0.25"
    assert "friction.frictionloss (FL_knee) ended at a bound of [0.01, 1] N m" in text
    assert "not identifiable from these data: friction.frictionloss (FL_knee, FR_knee)" in text
    assert "do not distinguish friction.frictionloss/FL_knee and friction.frictionloss/FR_knee" in text
    assert "1 of 4 joints is no better than without friction: FR_knee (+" in text


def test_a_verdict_names_the_joints(result: Any) -> None:
    said = doubt_joints(result)
    assert said is not None and said.startswith(
        "on test data 1 of 4 joints is no better than without friction: FR_knee"
    )
    better = copy.deepcopy(result)
    better.by_joint[3].test.position_mae = 0.01
    assert doubt_joints(better) is None and doubt_joints(replace_fields(result, model="baseline")) is None
    alone = replace_fields(result, by_joint=result.by_joint[3:])  # one joint has its gain told already
    assert doubt_joints(alone) is None
    ended = copy.deepcopy(result)
    row = of(ended, "damping")
    row.at_bound = row.by_joint[0].at_bound = True
    for bound in (bound for name in ("frictionloss", "damping") for bound in of(ended, name).by_joint):
        bound.value = bound.high if bound.at_bound else bound.value  # a lower one: there is none of it
    why, *_ = explain_failure(ended) or [""]
    assert "friction.frictionloss (FL_knee) and friction.damping (FL_hip) ended at their bounds" in why
    checks = {check.title: check for check in check_result(result)}
    assert checks["Joints"].state == checks["Identifiability"].state == "caution"
    assert checks["Bounds"].state == "bad"  # its friction is cut off at the upper bound


def test_the_page_has_means_first_and_folds_the_joints(result: Any, tmp_path: Path) -> None:
    courses = {name: np.ones((3, 4)) for name in ("bench.armature", "friction.frictionloss", "friction.damping")}
    write_report(tmp_path / "report.html", result, curves_of(make_rollout(nv=4), **courses))
    page = (tmp_path / "report.html").read_text(encoding="utf-8").split('<script type="application/json"')[0]
    assert "mean over joints" in page and "1 of 4 at a bound, 1 of 4 not identifiable" in page
    opened = [part.split("</summary>")[0] for part in page.split("<details open>")[1:]]
    assert len(opened) == 1 and "FR_knee" in opened[0]  # the largest error
    assert page.count("shared by hips") == page.count("shared by knees") == 2
    left = page.split("Residual torque</h2>")[1].split("</section>")[0]
    assert "mean over 4 joints" in left and left.count("<tr>") == 5 and "20 %" in left and "recorded joint" in left
    told = page.split("Link inertia</h2>")[1].split("</section>")[0]
    assert "Gravity is 1.146°" in told and "(0, 0.1962, -9.808) m/s²" in told
    assert "1 of 2 combinations" in told and "FL_thigh" in told and "Ixx, Iyy" in told and "mx FL_thigh" in told
    assert page.count("The only long test rollout: ") == 4 and "contacts are left out" in page
    # A line for each value: two of armature, four of frictionloss, two of damping.
    drawn = (tmp_path / "report.html").read_text(encoding="utf-8")
    figures = read_data(drawn)["figures"]
    lines = [[t["name"] for t in figure["data"]] for figure in figures if len(figure["data"]) < 6]
    assert ["hips", "knees", "reported"] in lines and ["FL_hip", "FL_knee", "reported"] in lines
