"""The view of rollouts in space: places against MuJoCo C, what is drawn, and how a real browser shows it."""

import json
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from conftest import changed
from helpers.browser import needs_browser, open_page, read_data
from helpers.results import curves_of, make_rollout, of_joints

from frictionzoo.bench import Bench, PositionPD, Robot
from frictionzoo.core.log import Payload
from frictionzoo.report import replay
from frictionzoo.report.replay import FINEST, record_replay
from frictionzoo.report.run_page import write_report
from frictionzoo.result.evaluate import Prediction

OFFSET = np.array([0.1, -0.05, 0.02])
INERTIAL = '<inertial pos="0.01 0 -0.1" mass="1" diaginertia="0.01 0.01 0.01"/>'
ARM = f"""<mujoco><compiler angle="radian"/><option timestep="0.001"><flag contact="disable"/></option><worldbody>
<geom name="/home/somebody/table" type="plane" size="0 0 1"/>
<body name="upper" pos="0.1 0.2 0.3" quat="0.9 0.1 0.3 -0.2">
<joint name="a" type="KIND" axis="0 1 0" pos="0.05 0 0.02"/>
<joint name="b" type="KIND" axis="0.6 0 0.8" pos="0 0.03 -0.1"/>
<geom name="hidden" type="sphere" size="0.3" group="3"/>
<geom type="capsule" fromto="0 0 0 0.05 0 -0.2" size="0.02"/>{INERTIAL}
<body name="still" pos="0 0 -0.1"><geom type="cylinder" size="0.03 0.01" quat="1 1 0 0"/>
<body name="lower" pos="0.02 0 -0.1" euler="0.3 0.2 0.1"><joint name="c" type="KIND" axis="1 0 0" pos="0 0 0.01"/>
<geom type="ellipsoid" size="0.01 0.02 0.1" group="4"/>{INERTIAL}</body></body></body></worldbody></mujoco>"""


FIRST = "const stage = document.getElementById('stage'); await until(() => stage.bodies); await allDrawn();"
PIXELS = """const seen = () => {
  stage.bodies(0);
  const copy = document.createElement("canvas"), own = stage.querySelector("canvas");
  Object.assign(copy, { width: own.width, height: own.height });
  copy.getContext("2d").drawImage(own, 0, 0);
  return copy.getContext("2d").getImageData(0, 0, copy.width, copy.height).data;
};
const count = () => seen().reduce((sum, each, at) => sum + (at % 4 === 3 && each > 0), 0);"""
CURSORS = """const cursors = () => [...document.querySelectorAll(".cursor")].filter(line => !line.hidden);"""


def stand(tmp_path, text, joints, of=Bench, **more):
    (tmp_path / "stand.xml").write_text(text)
    options = {"actuator": PositionPD(kp=20, kd=1), "timestep": 0.001, **more}
    return of(str(tmp_path / "stand.xml"), joints, **options)


def three_joints(tmp_path, kind):
    params = {"position_offset": {"init": 0.0, "low": -0.2, "high": 0.2, "identify": True}}
    return stand(tmp_path, ARM.replace("KIND", kind), ["a", "b", "c"], params=params)


def move(nv=3, rollouts=1):
    """Rollouts of joints that move differently."""
    segments, fitted, baseline = make_rollout(nv=nv, length=400)
    scale = (np.arange(nv) - 0.8) * np.arange(1, rollouts + 1)[:, None, None]
    own = replace(segments, qpos=segments.qpos * scale, qvel=segments.qvel * scale)
    return own, *(Prediction(each.qpos * scale, each.qvel * scale) for each in (fitted, baseline))


def values_of(own, **values):
    return own.initial_values() | values


def show(tmp_path, result, own, values, rollout):
    """The page of a run with this replay, in a browser."""
    courses = {name: np.ones((3, own.nv)) for name in ("bench.armature", "friction.static_torque")}
    finished = changed(result, fit={"stopped": "finished", "moving": []})
    curves = curves_of(rollout, **courses)
    recorded = record_replay(own, values, curves, 0.001)
    write_report(tmp_path / "report.html", of_joints(finished, *own.joints), curves, recorded)
    return open_page(tmp_path / "report.html"), recorded


@needs_browser
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["hinge", "slide"])
def test_bodies_are_where_mujoco_has_them(tmp_path, result, kind):
    """Also with an encoder's offset, with several joints of one body, and joints away from the body's origin."""
    own, rollout = three_joints(tmp_path, kind), move()
    values = values_of(own, position_offset=OFFSET)
    browser, recorded = show(tmp_path, result, own, values, rollout)
    frame, tolerance = 7, 10 * FINEST[kind]  # errors are drawn up to ten times as large
    places = browser.run(
        f"""await until(() => document.getElementById("stage").bodies);
        const seek = document.getElementById("seek");
        seek.value = {frame * recorded["step"]};
        seek.dispatchEvent(new Event("input"));
        const bodies = () => [0, 1, 2].map(motion => document.getElementById("stage").bodies(motion));
        const places = bodies(), gain = document.getElementById("gain");
        gain.value = 10;
        return [...places, ...bodies()];"""
    )
    oracle = mujoco.MjModel.from_xml_string(own.mjcf(values))
    data = mujoco.MjData(oracle)
    sample = round(frame * recorded["step"] / 0.001)
    motions = rollout[1].qpos[0, sample - 1], rollout[0].qpos[0, sample], rollout[2].qpos[0, sample - 1]
    farther = [motions[1] + 10 * (own - motions[1]) for own in motions]
    for place, data.qpos[:] in zip(np.array(places), [*motions, *farther], strict=True):
        mujoco.mj_kinematics(oracle, data)
        np.testing.assert_allclose(place[:, :3], data.xpos, atol=tolerance)
        turned = place[:, 3:] * np.sign((place[:, 3:] * data.xquat).sum(axis=1, keepdims=True))
        np.testing.assert_allclose(turned, data.xquat, atol=tolerance)
    assert np.abs(OFFSET).max() > 100 * FINEST[kind]  # which would be seen


def test_shapes_are_those_that_a_viewer_shows(tmp_path):
    own = three_joints(tmp_path, "hinge")
    recorded = record_replay(own, values_of(own), curves_of(move()), 0.001)
    drawn = [(shape["body"], shape["shape"], shape["moves"]) for shape in recorded["shapes"]]
    # Of the last body everything is hidden: then it is better seen than not.
    assert drawn == [(0, "box", False), (1, "capsule", True), (2, "cylinder", True), (3, "ellipsoid", True)]
    assert not recorded["inertia"] and [body["parent"] for body in recorded["bodies"]] == [0, 0, 1, 2]
    assert "somebody" not in json.dumps(recorded) and "upper" not in json.dumps(recorded)


def test_without_shapes_a_box_has_the_inertia(tmp_path):
    """A box of uniform density is its own box of inertia."""
    size, mass = np.array([0.02, 0.05, 0.1]), 0.7
    inertia = mass / 3 * ((size**2).sum() - size**2)
    inertial = f'<inertial pos="0 0 -0.1" mass="{mass}" diaginertia="{" ".join(map(str, inertia))}"/>'
    text = f'<mujoco><worldbody><body><joint name="a" axis="0 1 0"/>{inertial}</body></worldbody></mujoco>'
    recorded = record_replay(own := stand(tmp_path, text, "a"), values_of(own), curves_of(move(1)), 0.001)
    box, *lines = recorded["shapes"]
    assert recorded["inertia"] and box["shape"] == "box" and box["pos"] == [0, 0, -0.1]
    np.testing.assert_allclose(box["size"], size, rtol=1e-5)
    assert [line["shape"] for line in lines] == ["capsule", "capsule"]  # to the centre of mass, and the shaft
    np.testing.assert_allclose(lines[0]["pos"], [0, 0, -0.05])


def test_each_rollout_shows_its_payload(make):
    own = make("bench", "bench=sts3215")
    curves = curves_of(move(1, rollouts=2))
    weights = [Payload(mass, (0, 0, -length), (1e-3, 1e-3, 1e-4)) for mass, length in ((0.2, 0.1), (0.4, 0.15))]
    load = np.stack([own.load(weight) for weight in weights])
    recorded = record_replay(own, values_of(own), replace(curves, load=load), 0.001)
    for rollout in recorded["rollouts"]:
        carried, *lines = rollout["shapes"]
        assert [line["moves"] for line in lines] == [True, False]  # the arm, and the shaft that holds it
        np.testing.assert_allclose(carried["pos"], weights[rollout["rollout"]].position, atol=1e-6)


def test_meshes_are_coarser_where_they_are_large():
    """No vertex moves by more than a cell, and triangles that fell together are one."""
    rows, columns = 120, 120
    x, y = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows))
    vertices = np.stack([x.ravel(), y.ravel(), 0.1 * np.sin(9 * x * y).ravel()], axis=1)
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    halves = [[0, 1, columns], [1, columns + 1, columns]]
    faces = np.concatenate([corner[:, None] + np.array(half) for half in halves])
    coarse = replay._coarsen(vertices, faces, 40)
    grid = np.reshape(coarse["vertices"], (-1, 3)) * coarse["cell"] + coarse["low"]
    nearest = np.abs(vertices[::50, None] - grid).max(axis=2).min(axis=1)
    assert nearest.max() <= coarse["cell"] / 2 + 1e-9
    kept = np.reshape(coarse["faces"], (-1, 3))
    assert 40 * 40 <= len(kept) < 4 * 40 * 40 and kept.max() < len(grid)
    assert len({tuple(sorted(face)) for face in kept.tolist()}) == len(kept)


MESH = """<mujoco><asset><mesh name="link" file="link.obj"/><mesh name="gone" file="gone.obj"/></asset><worldbody>
<body name="base"><freejoint/><geom type="box" size="0.1 0.1 0.1"/><body name="leg" pos="0 0 -0.1">
<joint name="knee" axis="0 1 0"/><inertial pos="0 0 -0.1" mass="1" diaginertia="0.01 0.01 0.01"/>
<geom type="mesh" mesh="link"/><geom type="mesh" mesh="gone"/><geom type="sphere" size="0.02" group="3"/>
</body></body></worldbody></mujoco>"""


def write_mesh(folder):
    """A cube of 0.2 m that hangs by the middle of a face."""
    corners = [f"v {x} {y} {z}" for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.2, 0)]
    faces = [
        *("f 1 2 3", "f 2 4 3", "f 5 7 6", "f 6 7 8", "f 1 5 2", "f 2 5 6", "f 3 4 7", "f 4 8 7", "f 1 3 5"),
        "f 3 7 5",
    ]
    (folder / "link.obj").write_text("\n".join([*corners, *faces, "f 2 6 4", "f 4 6 8"]))


def test_a_robot_is_drawn_with_the_shapes_of_its_file(tmp_path):
    """Its meshes too, of those that are there; the bench that is simulated has none of them."""
    write_mesh(tmp_path)
    own = stand(tmp_path, MESH, "knee", Robot)
    recorded = record_replay(own, values_of(own), curves_of(move(1)), 0.001)
    assert own.compile(constraint=False).ngeom == 0
    assert [(shape["shape"], shape["moves"]) for shape in recorded["shapes"]] == [("box", False), ("mesh", True)]
    (mesh,) = recorded["meshes"]
    assert len(mesh["faces"]) == 3 * 12 and "link" not in json.dumps(recorded)
    (tmp_path / "stand.xml").unlink()  # who draws it later has what was simulated
    assert record_replay(own, values_of(own), curves_of(move(1)), 0.001)["inertia"]


@needs_browser
@pytest.mark.slow
def test_a_mesh_is_seen(tmp_path, result):
    write_mesh(tmp_path)
    own = stand(tmp_path, MESH.replace('type="box" size="0.1 0.1 0.1"', 'type="sphere" size="0.001"'), "knee", Robot)
    browser, _ = show(tmp_path, result, own, values_of(own), move(1))
    whole, without = browser.run(
        f"""{FIRST}{PIXELS} const whole = count();
        for (const box of document.querySelectorAll("[data-motion]")) box.click();
        return [whole, count()];"""
    )
    assert whole > 10_000 and without < 100


def test_positions_are_those_of_the_rollouts(tmp_path):
    own, rollout = three_joints(tmp_path, "hinge"), move(rollouts=4)
    recorded = record_replay(own, values_of(own), curves_of(rollout), 0.001)
    assert recorded["count"] == len(recorded["rollouts"]) == 4 and recorded["duration"] == pytest.approx(0.4)
    assert 1 / 31 <= recorded["step"] <= 1 / 25
    every = round(recorded["step"] / 0.001)
    labels, errors = zip(*(each["label"].split(": ") for each in recorded["rollouts"]), strict=True)
    assert labels == ("best, 1 of 4", "median, 2 of 4", "worst, 4 of 4", "3 of 4")
    away = np.abs(rollout[1].qpos - rollout[0].qpos[:, 1:]).mean(axis=(1, 2))
    assert errors == tuple(f"{away[each['rollout']]:.4g} rad" for each in recorded["rollouts"])
    for each in recorded["rollouts"]:
        fitted, measured, _ = (np.array(own).T * recorded["finest"] for own in each["positions"])
        np.testing.assert_allclose(measured, rollout[0].qpos[each["rollout"], ::every], atol=FINEST["hinge"])
        np.testing.assert_allclose(
            fitted[1:], rollout[1].qpos[each["rollout"], every - 1 :: every], atol=FINEST["hinge"]
        )


def test_a_motion_ends_where_it_diverges(tmp_path):
    own, (segments, fitted, baseline) = three_joints(tmp_path, "hinge"), move()
    baseline.qpos[:, 200:, 1] = np.inf
    (rollout,) = record_replay(own, values_of(own), curves_of((segments, fitted, baseline)), 0.001)["rollouts"]
    frames = [{len(joint) for joint in positions} for positions in rollout["positions"]]
    assert frames == [{12}, {12}, {6}]


def test_a_page_has_room_for_so_many_positions(tmp_path, monkeypatch):
    """Frames become fewer for the rollouts that the page speaks of; of the others as many as have room."""
    own, curves = three_joints(tmp_path, "hinge"), curves_of(move(rollouts=9))
    for room, rollouts, frames in ((600, 5, 13), (150, 3, 6)):
        monkeypatch.setattr(replay, "POSITIONS", room)
        recorded = record_replay(own, values_of(own), curves, 0.001)
        numbers = sum(len(joint) for r in recorded["rollouts"] for own in r["positions"] for joint in own)
        assert len(recorded["rollouts"]) == rollouts and numbers <= room
        assert len(recorded["rollouts"][0]["positions"][0][0]) <= frames


@needs_browser
@pytest.mark.slow
@pytest.mark.parametrize(("width", "scheme"), [(390, "dark"), (1440, "light")])
def test_the_replay_is_drawn_and_goes_along_the_curves(finished_run, width, scheme):
    path = finished_run("mujoco_default")[0] / "report.html"
    assert path.stat().st_size < 1_500_000
    browser = open_page(path, width=width, scheme=scheme)
    whole, apart, without = browser.run(
        f"""{FIRST}{PIXELS} const answers = [count()];
        for (const box of document.querySelectorAll("#apart")) box.click();
        answers.push(count());
        for (const box of document.querySelectorAll("[data-motion]")) box.click();
        return [...answers, count()];"""
    )
    assert apart > whole > 500 and without < whole / 2  # the shaft stands still and stays
    assert browser.run("return document.documentElement.scrollWidth") == width
    before, after, clock = browser.run(
        f"""{FIRST}{CURSORS} const at = () => cursors().map(line => line.getBoundingClientRect().left), before = at();
        const seek = document.getElementById("seek");
        seek.value = seek.max / 2;
        seek.dispatchEvent(new Event("input"));
        return [before, at(), document.getElementById("clock").textContent];"""
    )
    assert len(before) == 2 and clock == "0.05 s"  # trajectory and error
    assert all(late > early + 50 for early, late in zip(before, after, strict=True))
    time, moved = browser.run(
        """const canvas = document.querySelector("[data-rollout]"), { xaxis, _offset } = canvas._fullLayout;
        const { left, top } = canvas.getBoundingClientRect();
        canvas.scrollIntoView();
        const drag = canvas.querySelector(".nsewdrag"), box = drag.getBoundingClientRect();
        drag.dispatchEvent(new MouseEvent("mousemove", { bubbles: true, clientX: box.left + 0.75 * box.width,
          clientY: box.top + box.height / 2 }));
        await until(() => document.getElementById("clock").textContent !== "0.05 s");
        return [Number(document.getElementById("seek").value), document.getElementById("clock").textContent];"""
    )
    assert time == pytest.approx(0.075, abs=0.005) and moved in ("0.07 s", "0.08 s")


@needs_browser
def test_a_rollout_without_figures_of_its_own_gets_some_when_it_is_chosen(tmp_path, result):
    own, rollout = three_joints(tmp_path, "hinge"), move(rollouts=4)
    browser, recorded = show(tmp_path, result, own, values_of(own), rollout)
    before, shown, title, error, again = browser.run(
        f"""{FIRST} const others = document.getElementById("others"), which = document.getElementById("which");
        const choose = at => {{ which.value = at; which.dispatchEvent(new Event("change")); }};
        const before = others.hidden;
        choose(3);
        const canvas = others.querySelector(".canvas");
        await until(() => canvas.data);
        const answer = [before, others.hidden, others.querySelector("h3").innerText,
          canvas.data.find(({{ name }}) => name === "this model").y];
        choose(0);
        return [...answer, others.hidden];"""
    )
    assert before and again and not shown and title == f"Rollout {recorded['rollouts'][3]['label']}"
    every, number = round(recorded["step"] / 0.001), recorded["rollouts"][3]["rollout"]
    away = np.abs(rollout[1].qpos[number] - rollout[0].qpos[number, 1:]).mean(axis=1)[every - 1 :: every]
    np.testing.assert_allclose(error[1:], away, atol=2 * FINEST["hinge"])


@needs_browser
@pytest.mark.slow
def test_play_runs_to_the_end_and_turns_by_keys(finished_run):
    browser = open_page(finished_run("mujoco_default")[0] / "report.html")
    assert (
        browser.run(f"{FIRST} return document.getElementById('clock').textContent") == "0.00 s"
    )  # nothing moves by itself
    clock, text, turned = browser.run(
        f"""{FIRST}{PIXELS} const play = document.getElementById("play"), clock = document.getElementById("clock");
        play.click();
        await until(() => clock.textContent === "0.10 s" && play.textContent === "Play");
        const before = seen();
        stage.dispatchEvent(new KeyboardEvent("keydown", {{ key: "ArrowLeft" }}));
        const after = seen();
        return [clock.textContent, play.textContent, after.some((each, at) => each !== before[at])];"""
    )
    assert (clock, text, turned) == ("0.10 s", "Play", True)


@needs_browser
@pytest.mark.slow
def test_without_webgl_a_line_says_so_and_the_page_is_whole(finished_run, tmp_path):
    source = (finished_run("mujoco_default")[0] / "report.html").read_text()
    without = "HTMLCanvasElement.prototype.getContext = () => null;"
    (tmp_path / "report.html").write_text(source.replace('"use strict";', f'"use strict"; {without}', 1))
    browser = open_page(tmp_path / "report.html")
    drawn, said, shown = browser.run(
        """await allDrawn();
        await until(() => !document.getElementById("flat").hidden);
        return [shown().every(isDrawn), document.getElementById("flat").innerText,
          document.getElementById("play").clientWidth];"""
    )
    assert drawn and "WebGL" in said and shown == 0


def test_the_page_of_a_run_has_its_replay(finished_run):
    source = (finished_run("mujoco_default")[0] / "report.html").read_text()
    recorded = read_data(source)["state"]["replay"]
    assert recorded["rollouts"][0]["label"].startswith("1 of 1: ") and 'href="#replay"' in source
