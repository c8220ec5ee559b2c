"""Columns of recordings reach the joints that they name, whatever their order and spelling, or are refused."""

import contextlib
import itertools
import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from helpers.write_logs import (
    EPOCH,
    write_csv,
    write_mat,
    write_npz,
    write_parquet,
    write_robot_bag,
    write_robot_lerobot,
)
from hypothesis import given, settings
from hypothesis import strategies as st

import frictionzoo as fz
from frictionzoo.core.errors import BenchError, ConfigError, LogError
from frictionzoo.core.log import Columns
from frictionzoo.data.files import Files
from frictionzoo.data.pairing import arrange, arrange_recording, describe_columns, label, pair
from frictionzoo.data.propose import propose
from frictionzoo.data.recording import Table

GO2 = tuple(f"{leg}_{part}_joint" for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "thigh", "calf"))
SPELLINGS: dict[str, Callable[[str], str]] = {
    "as in the model": str,
    "without joint": lambda name: name.removesuffix("_joint"),
    "CamelCase": lambda name: "".join(part[:1].upper() + part[1:] for part in name.split("_")),
    "camel, short": lambda name: "".join(part[:1].upper() + part[1:] for part in name.split("_")[:2]),
    "capitals": str.upper,
    "small": lambda name: name.removesuffix("_joint").lower(),
    "dots": lambda name: name.replace("_", "."),
    "dashes": lambda name: name.removesuffix("_joint").replace("_", "-"),
    "slashes": lambda name: name.removesuffix("_joint").replace("_", "/"),
    "glued": lambda name: "".join(name.split("_")[:2]),
    "motors": lambda name: name.replace("joint", "motor"),
    "a robot's": lambda name: f"go2/{name}",
}
FORMS: dict[str, dict[str, str]] = {
    "q": {"qpos": "q_{}", "qvel": "dq_{}", "ctrl": "q_des_{}", "torque": "tau_{}"},
    "mujoco": {"qpos": "qpos_{}", "qvel": "qvel_{}", "ctrl": "ctrl_{}", "torque": "tau_est_{}"},
    "short": {"qpos": "{}_pos", "qvel": "{}_vel", "ctrl": "{}_cmd", "torque": "{}_torque"},
    "long": {"qpos": "{}_position", "qvel": "{}_velocity", "ctrl": "{}_target_position", "torque": "{}_effort"},
    "fields": {"qpos": "{}.pos", "qvel": "{}.vel", "ctrl": "cmd.{}.pos", "torque": "{}.tau"},
    "brackets": {"qpos": "position[{}]", "qvel": "velocity[{}]", "ctrl": "command[{}]", "torque": "effort[{}]"},
    "topics": {
        **{"qpos": "/js/{}/position", "qvel": "/js/{}/velocity", "ctrl": "/cmd/{}/position", "torque": "/js/{}/tau"},
    },
    "camel": {"qpos": "{}Position", "qvel": "{}Velocity", "ctrl": "{}PositionCommand", "torque": "{}Torque"},
    "unitree": {"qpos": "pos_{}", "qvel": "vel_{}", "ctrl": "posDes_{}", "torque": "torEst_{}"},
}
TIME = np.arange(12) / 50
IN_ORDER = {signal: list(range(12)) for signal in ("qpos", "qvel", "ctrl", "torque")}


def make_signal(signal: str, joint: int) -> np.ndarray:
    """Samples that no other joint and no other signal has: of a joint that follows its command."""
    size, rate = 0.1 + 0.01 * joint, 8.0 + joint
    size, ahead = {"qpos": (size, 0), "qvel": (size * rate, 0.5 * np.pi), "ctrl": (size, 0.1), "torque": (3, 0.3)}[
        signal
    ]
    return size * np.sin(rate * TIME + ahead)


def make_columns(form: Mapping[str, str], spell: Callable[[str], str], orders: Mapping[str, Sequence[int]]) -> dict:
    """A table with a column a signal and joint, those of each signal in an order of their own."""
    columns = {"time": TIME}
    for signal, header in form.items():
        columns |= {header.format(spell(GO2[joint])): make_signal(signal, joint) for joint in orders[signal]}
    return columns


def refuse_others(files: Files, joints: Sequence[str] = GO2) -> None:
    """Every column is with its joint."""
    (recording,) = files.for_joints(joints).recordings()
    assert {"qpos", "ctrl"} <= recording.signals.keys()
    for signal, values in recording.signals.items():
        expected = np.stack([make_signal(signal, GO2.index(joint)) for joint in joints], axis=1)
        np.testing.assert_allclose(values, expected, rtol=1e-6, atol=1e-7)
        assert recording.columns[signal].by == "name"


@st.composite
def headers_of_go2(draw: st.DrawFn) -> tuple[list[str], list[int]]:
    """Headers of one signal, and of which joints they are."""
    form, spell = draw(st.sampled_from([*FORMS.values()])), draw(st.sampled_from([*SPELLINGS.values()]))
    order = draw(st.permutations(range(12)))
    header = form[draw(st.sampled_from([*form]))]
    return [header.format(spell(GO2[joint])) for joint in order], order


@settings(max_examples=100, deadline=None)
@given(headers_of_go2(), st.integers(0, 11), st.integers(1, 12))
def test_headers_find_their_joints_or_some_of_them(drawn, first, count):
    headers, order = drawn
    joints = [GO2[(first + number) % 12] for number in range(count)]
    assert pair(headers, joints) == (tuple(order.index(GO2.index(joint)) for joint in joints), "name")


@settings(max_examples=100, deadline=None)
@given(headers_of_go2(), st.integers(0, 11), st.sampled_from(["lost", "twice", "renamed", "spelt twice"]))
def test_names_that_are_not_one_for_each_joint_are_refused(drawn, place, fault):
    headers, _ = drawn
    extra = {"lost": [], "twice": [headers[place]] * 2, "renamed": ["q_rear_wheel"], "spelt twice": [headers[place]]}
    changed = [*headers[:place], *extra[fault], *headers[place + 1 :]]
    changed += [f"({headers[place]})"] if fault == "spelt twice" else []
    with pytest.raises(LogError, match="expected one column for each joint"):
        pair(changed, GO2)


@settings(max_examples=100, deadline=None)
@given(st.permutations(range(12)), st.permutations(range(12)), st.data())
def test_any_spelling_is_right_or_refused(order, other, data):
    words = st.sampled_from(["q", "pos", "", "dq", "FL", "RR", "hip", "calf", "joint", "front", "1", "x"])
    before, after = (data.draw(st.lists(words, max_size=3)) for _ in range(2))
    glue = data.draw(st.sampled_from(["_", ".", "", "-"]))
    headers = [glue.join([*before, GO2[joint], *after]) for joint in order]
    try:
        found = pair(headers, GO2)
    except LogError:
        return
    assert [order[place] for place in found.order] == list(range(12))


LEAP = ("1", "0", "2", "3")
ARM = tuple(f"joint_{number}" for number in range(1, 8))
TEXT_ORDER = ["q_0", "q_1", "q_10", "q_11", *(f"q_{n}" for n in range(2, 10))]
NUMBERS = {
    "no names": ([f"q_{n}" for n in range(12)], GO2, tuple(range(12)), "place"),
    "sorted as text": (TEXT_ORDER, GO2, (0, 1, *range(4, 12), 2, 3), "place"),
    "from 0": ([f"q_{n}" for n in range(7)], ARM, tuple(range(7)), "place"),
    "the joints' numbers": ([f"q{n}" for n in (7, 6, 5, 4, 3, 2, 1)], ARM, (6, 5, 4, 3, 2, 1, 0), "name"),
    "digits as names": ([f"position_{n}" for n in range(4)], LEAP, (1, 0, 2, 3), "name"),
    "leading zeros": ([f"pos_joint_{n:02d}" for n in (2, 1)], ("joint_1", "joint_2"), (1, 0), "name"),
    "one": (["q"], ("knee",), (0,), "place"),
    "one that is named": (["angle_knee"], ("knee",), (0,), "name"),
    "without what all share": (["q_elbow", "q_shoulder"], ("left_shoulder", "left_elbow"), (1, 0), "name"),
    "longest": (["q_wrist_2", "q_wrist"], ("wrist", "wrist_2"), (1, 0), "name"),
    "signals' words": (["steering_angle_vel", "angle_vel"], ("angle", "steering_angle"), (1, 0), "name"),
}


@pytest.mark.parametrize(("headers", "joints", "order", "by"), NUMBERS.values(), ids=NUMBERS)
def test_numbers_and_short_names(headers, joints, order, by):
    assert pair(headers, joints) == (order, by)


REFUSED = {
    "another leg": ([f"q_FR_{part}" for part in ("hip", "thigh", "calf")], GO2[:3]),
    "another arm": (["q_right_elbow", "q_right_shoulder"], ("left_shoulder", "left_elbow")),
    "names of nothing": (["q_a", "q_b"], ("hip", "knee")),
    "several legs, bare names": ([f"q_{name}" for name in GO2], ("hip", "thigh", "calf")),
    "digits shifted": ([f"position_{n}" for n in range(1, 5)], LEAP),
    "names shifted": ([f"joint_{n}_pos" for n in range(7)], ARM),
    "numbers that do not increase": ([f"q_{n}" for n in range(3)], ("m_3", "m_2", "m_4")),
}


@pytest.mark.parametrize(("headers", "joints"), REFUSED.values(), ids=REFUSED)
def test_what_leaves_doubt_is_refused(headers, joints):
    with pytest.raises(LogError, match="expected"):
        pair(headers, joints)


def test_commands_without_names_beside_states_in_another_order_are_refused():
    commands = tuple(f"data[{n}]" for n in range(12))
    columns = {"qpos": Columns(tuple(f"q_{name}" for name in GO2)), "ctrl": Columns(commands)}
    assert arrange("a.csv", columns, GO2)["ctrl"].by == "place"
    columns["qpos"] = Columns(columns["qpos"].headers[::-1])
    with pytest.raises(LogError, match=r"data\.columns\.ctrl"):
        arrange("a.csv", columns, GO2)
    columns["ctrl"] = Columns(commands, listed=True)
    assert arrange("a.csv", columns, GO2)["ctrl"] == (tuple(range(12)), "listed")


def test_headers_give_names_where_no_bench_does():
    assert label(("qpos_FL_hip", "qpos_FR_hip")) == ("FL_hip", "FR_hip")
    assert label(("observation.state[knee.pos]", "observation.state[hip.pos]")) == ("knee", "hip")
    assert label(("q_0", "q_1")) == ("1", "2") and label(("position",)) == ("1",)


WRITERS: dict[str, tuple[str, Callable[[Path, dict], Path]]] = {
    **{"csv": ("log.csv", write_csv), "parquet": ("log.parquet", write_parquet), "npz": ("log.npz", write_npz)},
    "mat": ("log.mat", write_mat),
}


def draw_cases(count: int) -> list[tuple[str, str, dict[str, list[int]]]]:
    """A form, a spelling, and an order of the joints for each signal, as many as asked for."""
    rng, forms, spellings = np.random.default_rng(0), [*FORMS], [*SPELLINGS]
    orders = [{signal: rng.permutation(12).tolist() for signal in IN_ORDER} for _ in range(count)]
    return [(forms[n % len(forms)], spellings[n % len(spellings)], order) for n, order in enumerate(orders)]


SEVERAL = pytest.mark.parametrize("count", [4, pytest.param(50, marks=pytest.mark.slow)])


@SEVERAL
@pytest.mark.parametrize("name", WRITERS)
def test_tables_reach_their_joints(tmp_path, name, count):
    for number, (form, spelling, orders) in enumerate(draw_cases(count)):
        columns = make_columns(FORMS[form], SPELLINGS[spelling], orders)
        if name == "mat":  # MATLAB's names have letters, digits and underscores only
            columns = {
                "".join(c if c.isalnum() else "_" for c in header).strip("_"): v for header, v in columns.items()
            }
        file, write = WRITERS[name]
        path = write(tmp_path / f"{number}_{file}", columns)
        refuse_others(Files(train=[str(path)]), GO2[number % 4 * 3 :][: 1 + number % 12])


@SEVERAL
@pytest.mark.parametrize("storage", ["mcap", "ros2bag"])
def test_bags_reach_their_joints(tmp_path, storage, count):
    for number, (_, spelling, orders) in enumerate(draw_cases(count)):
        names = {joint: SPELLINGS[spelling](GO2[joint]) for joint in range(12)}
        # The order in the messages changes from one to the next.
        rng = np.random.default_rng(number)
        states = [rng.permutation(12).tolist() if number % 2 else orders["qpos"] for _ in TIME]

        def entries(signal, order, sample, names=names):
            return {names[joint]: make_signal(signal, joint)[sample] for joint in order}

        messages = [
            (
                EPOCH + round(1e9 * time),
                {s: entries(s, states[i], i) for s in ("qpos", "qvel", "torque")},
                entries("ctrl", orders["ctrl"], i),
            )
            for i, time in enumerate(TIME)
        ]
        path = write_robot_bag(tmp_path / str(number), messages, storage)
        refuse_others(Files(train=[str(path)]), GO2[number % 4 * 3 :][: 1 + number % 12])


@SEVERAL
def test_lerobot_sets_reach_their_joints(tmp_path, count):
    for number, (_, spelling, orders) in enumerate(draw_cases(count)):
        names = [SPELLINGS[spelling](name) for name in GO2]
        features = {
            feature: {f"{names[joint]}.pos": make_signal(signal, joint) for joint in orders[signal]}
            for feature, signal in (("observation.state", "qpos"), ("action", "ctrl"))
        }
        path = write_robot_lerobot(tmp_path / str(number), TIME, features, nested=bool(number % 2))
        refuse_others(Files(train=[str(path)]), GO2[number % 4 * 3 :][: 1 + number % 12])


LEG = """<mujoco><compiler angle="radian"/><worldbody><body><joint name="{}" axis="0 1 0"/><geom size=".03" mass="1"/>
  <body pos="0 0 -.2"><joint name="{}" axis="0 1 0"/><geom size=".02" mass=".3"/></body></body></worldbody></mujoco>"""


@pytest.mark.parametrize("measured", [True, False])
def test_a_bench_brings_logs_into_the_order_of_its_joints(tmp_path, measured):
    (tmp_path / "leg.xml").write_text(LEG.format("hip_joint", "knee_joint"))
    bench = fz.Robot(str(tmp_path / "leg.xml"), actuator=fz.JointPD(kp=20, kd=1), timestep=0.02)
    time = np.arange(100) / 50
    knee, hip = np.sin(3 * time), 0.3 * np.sin(7 * time)
    columns = {"time": time, "q_knee": knee, "q_hip": hip, "q_des_knee": knee, "q_des_hip": hip}
    columns |= {"dq_hip": 2.1 * np.cos(7 * time), "dq_knee": 3 * np.cos(3 * time)} if measured else {}
    (log,) = fz.read(columns | {"tau_est_knee": 3 * knee, "tau_est_hip": 3 * hip})
    for accepted in (bench.accept(log), bench.accept(bench.accept(log))):
        np.testing.assert_array_equal(accepted.qpos, np.stack([hip, knee], axis=1))
        np.testing.assert_array_equal(accepted.ctrl, accepted.qpos)
        np.testing.assert_allclose(np.abs(accepted.qvel).max(axis=0), [2.1, 3], rtol=0.1)
        np.testing.assert_array_equal(accepted.extras["torque"], 3 * accepted.qpos)
    assert accepted.velocity_estimated is not measured
    (row,) = describe_columns([accepted], bench.joints)
    assert row["joints"][0]["columns"]["qpos"] == "q_hip" and row["by"]["ctrl"] == "name"


def test_joints_that_are_called_by_numbers(tmp_path):
    (tmp_path / "leap.xml").write_text(LEG.format("1", "0"))
    assert fz.Robot(str(tmp_path / "leap.xml"), [1, 0], actuator=fz.JointPD(kp=20, kd=1)).joints == ("1", "0")
    with pytest.raises(BenchError, match=r"bench\.joint"):
        fz.Robot(str(tmp_path / "leap.xml"), [0, 1], actuator=fz.JointPD(kp=20, kd=1))


def test_each_recording_is_matched_on_its_own(tmp_path):
    orders = [dict.fromkeys(IN_ORDER, order) for order in (list(range(12)), list(range(11, -1, -1)))]
    for name, form, order in (("a", "q", orders[0]), ("b", "short", orders[1]), ("c", "q", orders[1])):
        write_csv(tmp_path / f"{name}.csv", make_columns(FORMS[form], str, order))
    for recording in Files(train=[str(tmp_path)]).for_joints(GO2).recordings():
        np.testing.assert_array_equal(recording.signals["qpos"][:, 4], make_signal("qpos", 4))


def test_a_listed_order_counts_where_its_names_do_not_decide(tmp_path, caplog):
    columns = make_columns(FORMS["q"], str, IN_ORDER)
    columns |= {f"m{joint}": make_signal("ctrl", joint) for joint in range(12)}
    path = str(write_csv(tmp_path / "a.csv", columns))
    listed = {"qpos": [f"q_{name}" for name in GO2[::-1]], "ctrl": [f"m{joint}" for joint in range(11, -1, -1)]}
    with caplog.at_level(logging.INFO):
        (recording,) = Files(train=[path], columns=listed).for_joints(GO2).recordings()
    np.testing.assert_array_equal(recording.signals["qpos"][:, 0], make_signal("qpos", 0))
    np.testing.assert_array_equal(recording.signals["ctrl"][:, 0], make_signal("ctrl", 11))
    assert {signal: of.by for signal, of in recording.columns.items()} == {
        **{"qpos": "name", "qvel": "name", "torque": "name", "ctrl": "listed"}
    }
    assert "qpos" in caplog.text and "data.columns" in caplog.text


def test_signs_in_a_list_need_columns_in_a_list(tmp_path):
    path = str(write_csv(tmp_path / "a.csv", make_columns(FORMS["q"], str, IN_ORDER)))
    signs = {"qpos": [1] * 11 + [-1]}
    with pytest.raises(ConfigError, match=r"data\.columns\.qpos"):
        Files(train=[path], sign=signs).for_joints(GO2).recordings()
    listed = {"qpos": [f"q_{name}" for name in GO2[::-1]]}
    (recording,) = Files(train=[path], sign=signs, columns=listed).for_joints(GO2).recordings()
    np.testing.assert_array_equal(recording.signals["qpos"][:, 0], -make_signal("qpos", 0))  # the last of the list


@pytest.mark.parametrize("signal", ["qvel", "torque", "ctrl"])
def test_a_signal_of_some_joints_is_refused_by_its_option(tmp_path, signal):
    orders = IN_ORDER | {signal: [0, 3, 5]}
    path = str(write_csv(tmp_path / "a.csv", make_columns(FORMS["q"], str, orders)))
    with pytest.raises(LogError, match=rf"3 of 12 joints.*data\.columns\.{signal}"):
        Files(train=[path]).for_joints(GO2).recordings()
    if signal != "ctrl":
        (recording,) = Files(train=[path], columns={signal: []}).for_joints(GO2).recordings()
        assert signal not in recording.signals


@pytest.mark.parametrize("seed", range(6))
def test_commands_may_lack_passive_joints(tmp_path, seed):
    """Joints without an actuator have no command columns: those of the others are found by name or by list."""
    rng = np.random.default_rng(seed)
    driven = sorted(rng.choice(12, size=int(rng.integers(1, 12)), replace=False).tolist())
    passive = [name for joint, name in enumerate(GO2) if joint not in driven]
    shuffled = rng.permutation(driven).tolist()
    columns = make_columns(FORMS["q"], str, IN_ORDER | {"ctrl": shuffled, "torque": shuffled})
    unnamed = {f"u{number}": make_signal("ctrl", joint) for number, joint in enumerate(driven)}
    state = {header: values for header, values in columns.items() if not header.startswith("q_des_")}
    for number, (table, listed) in enumerate(((columns, {}), (state | unnamed, {"ctrl": [*unnamed]}))):
        path = str(write_csv(tmp_path / f"{number}.csv", table))
        (recording,) = Files(train=[path], columns=listed).for_joints(GO2, passive).recordings()
        for joint, name in enumerate(GO2):
            expected = 0 * make_signal("ctrl", joint) if name in passive else make_signal("ctrl", joint)
            np.testing.assert_array_equal(recording.signals["ctrl"][:, joint], expected)
            np.testing.assert_array_equal(recording.signals["qpos"][:, joint], make_signal("qpos", joint))
        again, _ = arrange_recording(recording, GO2, passive)
        np.testing.assert_array_equal(again.signals["ctrl"], recording.signals["ctrl"])
        (row,) = describe_columns([recording], GO2)
        assert ["ctrl" in joint["columns"] for joint in row["joints"]] == [joint in driven for joint in range(12)]
    with pytest.raises(LogError, match=r"data\.columns\.ctrl"):
        Files(train=[str(tmp_path / "0.csv")]).for_joints(GO2, passive[1:]).recordings()


HEADERS = ("qpos_{}", "position_{}", "hip_position", "effort_{}", "effort", "velocity_command", "velocity_command_{}")
HEADERS += ("torque_command", "torque_command_{}", "tau_1", "tau_2", "command", "ctrl_{}", "kp_{}", "kd")


@settings(max_examples=300, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(HEADERS), st.booleans()), min_size=1, max_size=8))
def test_whatever_headers_name_joints_are_paired_or_refused(chosen: list[tuple[str, bool]]) -> None:
    joints, rng = ("hip", "knee"), np.random.default_rng(0)
    headers = dict.fromkeys(text.format(joint) for text, both in chosen for joint in (joints if both else joints[:1]))
    columns = {"time": 0.01 * np.arange(20), **{header: rng.normal(size=20) for header in headers}}
    with contextlib.suppress(LogError):
        found = propose(Table("a", columns, sha256="0" * 64), joints).columns
        assert {*itertools.chain(*found.values())} <= {*columns}
