"""Messages of any type, decoded by the definitions in the recording, and presets of common ones."""

import sqlite3
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.write_logs import EPOCH, joint_states, write_messages, write_ros1
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from frictionzoo.core.errors import LogError
from frictionzoo.data.files import Files
from frictionzoo.data.formats import read_tables
from frictionzoo.data.presets import MOTORS, name_motors
from frictionzoo.data.recording import Recording, Table

MOTOR_STATE = "uint8 mode\nfloat32 q\nfloat32 dq\nfloat32 ddq\nfloat32 tau_est\n"
GO_STATE = "float32 q_raw\nfloat32 dq_raw\nfloat32 ddq_raw\nint8 temperature\nuint32 lost\nuint32[2] reserve"
HG_STATE = "int16[2] temperature\nfloat32 vol\nuint32[2] sensor\nuint32 motorstate\nuint32[4] reserve"
MOTOR_CMD = "uint8 mode\nfloat32 q\nfloat32 dq\nfloat32 tau\nfloat32 kp\nfloat32 kd\n"
IMU = "float32[4] quaternion\nfloat32[3] gyroscope\nfloat32[3] accelerometer\nfloat32[3] rpy\n"
DEFINITIONS = {
    "unitree_go/msg/IMUState": f"{IMU}int8 temperature",
    "unitree_go/msg/MotorState": MOTOR_STATE + GO_STATE,
    "unitree_go/msg/MotorCmd": f"{MOTOR_CMD}uint32[3] reserve",
    "unitree_go/msg/LowState": "uint8[2] head\nuint32[2] sn\nuint16 bandwidth\nIMUState imu_state\n"
    "MotorState[20] motor_state\nint16[4] foot_force\nuint32 tick\nfloat32 power_v\nuint32 crc",
    "unitree_go/msg/LowCmd": "uint8[2] head\nMotorCmd[20] motor_cmd\nuint8[12] led\nuint8 gpio\nuint32 crc",
    "unitree_hg/msg/IMUState": f"{IMU}int16 temperature",
    "unitree_hg/msg/MotorState": MOTOR_STATE + HG_STATE,
    "unitree_hg/msg/MotorCmd": f"{MOTOR_CMD}uint32 reserve",
    "unitree_hg/msg/LowState": "uint32[2] version\nuint8 mode_pr\nuint8 mode_machine\nuint32 tick\nIMUState imu_state\n"
    "MotorState[35] motor_state\nuint8[40] wireless_remote\nuint32[4] reserve\nuint32 crc",
    "unitree_hg/msg/LowCmd": "uint8 mode_pr\nuint8 mode_machine\nMotorCmd[35] motor_cmd\nuint32[4] reserve\nuint32 crc",
    "control_msgs/msg/InterfaceValue": "string[] interface_names\nfloat64[] values",
    "control_msgs/msg/DynamicJointState": "std_msgs/Header header\nstring[] joint_names\n"
    "InterfaceValue[] interface_values",
    "control_msgs/msg/JointTrajectoryControllerState": "std_msgs/Header header\nstring[] joint_names\n"
    + "\n".join(
        f"trajectory_msgs/JointTrajectoryPoint {name}" for name in ("reference", "feedback", "error", "output")
    ),
    "odd_msgs/msg/Leaf": "bool flag\nfloat64 value\nint8 small",
    "odd_msgs/msg/Empty": "",
    "odd_msgs/msg/Branch": "uint8 LIMIT=3\nstring name\nLeaf[] leaves\nfloat32[3] vector\nLeaf leaf\nstring<=20 label",
    "odd_msgs/msg/Tree": "uint8 kind\nBranch[2] pair\nEmpty nothing\nint64 exact\nBranch[] branches\nfloat64[<=4] few\n"
    "uint16[] many\nstring text\nint16 last",
}
JOINTS = ("hip", "knee", "ankle")


def define(kind: Stores = Stores.LATEST) -> Typestore:
    store = get_typestore(kind)
    for name, text in DEFINITIONS.items():
        if kind == Stores.LATEST or name.startswith("odd"):
            store.register(get_types_from_msg(text, name))
    return store


STORE = define()


def make(kind: str, /, **values: Any) -> Any:
    return STORE.types[kind](**values)


def header(stamp: int) -> Any:
    time = make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
    return make("std_msgs/msg/Header", stamp=time, frame_id="base")


def zeros(kind: str, /, **values: Any) -> Any:
    """A message of fixed size with the given values, and 0 elsewhere."""
    fields = {}
    for name, (node, detail) in STORE.fielddefs[kind][1]:
        if node == 2:
            fields[name] = zeros(detail)
        elif node == 3 and detail[0][0] == 2:
            fields[name] = [zeros(detail[0][1]) for _ in range(detail[1])]
        else:
            fields[name] = np.zeros(detail[1], detail[0][1][0]) if node == 3 else 0
    return make(kind, **(fields | values))


def leaf(rng: np.random.Generator) -> Any:
    small = int(rng.integers(-128, 128))
    return make("odd_msgs/msg/Leaf", flag=bool(rng.integers(2)), value=rng.normal(), small=small)


def branch(rng: np.random.Generator, name: str) -> Any:
    leaves = [leaf(rng) for _ in range(rng.integers(4))]
    vector, label = rng.normal(size=3).astype(np.float32), "x" * int(rng.integers(9))
    return make("odd_msgs/msg/Branch", name=name, leaves=leaves, vector=vector, leaf=leaf(rng), label=label)


def tree(rng: np.random.Generator) -> Any:
    return make(
        "odd_msgs/msg/Tree",
        kind=7,
        pair=[branch(rng, "left"), branch(rng, "right")],
        nothing=make("odd_msgs/msg/Empty", structure_needs_at_least_one_member=0),
        exact=2**53 + int(rng.integers(1, 9)),
        branches=[branch(rng, "") for _ in range(rng.integers(3))],
        few=rng.normal(size=rng.integers(5)),
        many=rng.integers(0, 2**16, int(rng.choice([0, 3, 300]))).astype(np.uint16),
        text="y" * int(rng.integers(9)),
        last=int(rng.integers(-(2**15), 2**15)),
    )


def list_numbers(message: Any, path: str = "") -> dict[str, float]:
    """The numbers of a message as rosbags reads it, by the header that they should have."""
    found: dict[str, float] = {}
    for name in filter(str.islower, message.__dataclass_fields__):
        value, place = getattr(message, name), f"{path}/{name}"
        if isinstance(value, int | float | np.number):
            found[place] = value
        elif isinstance(value, np.ndarray):
            found |= {f"{place}[{k}]": number for k, number in enumerate(value.tolist()) if len(value) <= 256}
        elif isinstance(value, list):
            names = [getattr(entry, "name", "") for entry in value]
            for number, entry in enumerate(value):
                label = names[number] if any(names) else number
                found |= list_numbers(entry, f"{place}[{label}]")
        elif not isinstance(value, str) and name != "nothing":
            found |= list_numbers(value, place)
    return found


@pytest.mark.parametrize("storage", ["mcap", "sqlite", "ros1", "BZ2", "LZ4"])
def test_messages_of_any_definition_are_read_as_rosbags_reads_them(tmp_path: Path, storage: str) -> None:
    rng = np.random.default_rng(3)
    messages = [tree(rng) for _ in range(12)]
    sent = [("/odd", message, EPOCH + number) for number, message in enumerate(messages)]
    if storage in ("mcap", "sqlite"):
        plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
        path = write_messages(tmp_path / "bag", sent, plugin, store=STORE)
    else:
        compression = "" if storage == "ros1" else storage
        path = write_ros1(tmp_path / "a.bag", sent, compression, define(Stores.ROS1_NOETIC))
    (table,) = read_tables(str(path), "auto")
    expected: dict[str, list[float]] = {}
    for message in messages:
        for place, value in list_numbers(message).items():
            expected.setdefault(f"/odd{place}", []).append(value)
    found = {name for name in table.columns if not name.endswith("/time") and "nothing" not in name}
    assert found == set(expected) and not table.refused
    for name, values in expected.items():
        assert table.columns[name].tolist() == values, name
        assert len(table.columns[table.times[name]]) == len(values)


def load(path: Path, joints: tuple[str, ...], **options: Any) -> Recording:
    (recording,) = Files(train=[str(path)], **options).for_joints(joints).recordings()
    return recording


ROBOTS = {
    "unitree_hg": ("left_shoulder_pitch_joint", "left_elbow_joint", "right_wrist_yaw_joint"),
    "unitree_go": ("FL_calf_joint", "FR_hip_joint", "RR_thigh_joint"),
}
PLACES = {"unitree_hg": (15, 18, 28), "unitree_go": (5, 0, 7)}


def write_unitree(path: Path, package: str, plugin: StoragePlugin) -> dict[str, np.ndarray]:
    """States at 200 samples/s and commands at 50, whose motors all move; return what three of them do."""
    rng, count = np.random.default_rng(5), 35 if package == "unitree_hg" else 20
    motors = {"unitree_hg": 29, "unitree_go": 12}[package]
    states = {name: rng.normal(size=(60, motors)).astype(np.float32) for name in ("q", "dq", "tau_est")}
    commands = {name: rng.normal(size=(15, motors)).astype(np.float32) for name in ("q", "dq", "tau", "kp", "kd")}

    def entries(kind: str, values: Mapping[str, np.ndarray], row: int) -> list[Any]:
        rows = [{name: float(numbers[row, k]) for name, numbers in values.items()} for k in range(motors)]
        return [zeros(kind, mode=1, **(rows[k] if k < motors else {})) for k in range(count)]

    sent = [
        (
            "/lowstate",
            zeros(f"{package}/msg/LowState", motor_state=entries(f"{package}/msg/MotorState", states, row)),
            row,
        )
        for row in range(60)
    ] + [
        (
            "/lowcmd",
            zeros(f"{package}/msg/LowCmd", motor_cmd=entries(f"{package}/msg/MotorCmd", commands, row)),
            4 * row,
        )
        for row in range(15)
    ]
    timed = [(topic, message, EPOCH + 5_000_000 * at) for topic, message, at in sorted(sent, key=lambda each: each[2])]
    write_messages(path, timed, plugin, store=STORE)
    columns = list(PLACES[package])
    held = {f"cmd_{name}": np.repeat(values, 4, axis=0)[:, columns] for name, values in commands.items()}
    return {name: values[:, columns] for name, values in states.items()} | held


@pytest.mark.parametrize("package", ROBOTS)
def test_the_state_and_command_of_a_unitree_need_no_option(tmp_path: Path, package: str) -> None:
    expected = write_unitree(tmp_path / "bag", package, StoragePlugin.MCAP)
    recording = load(tmp_path / "bag", ROBOTS[package])
    np.testing.assert_allclose(recording.time, np.arange(60) / 200, atol=1e-9)
    signals = {"qpos": "q", "qvel": "dq", "torque": "tau_est", "ctrl": "cmd_q", "ctrl_velocity": "cmd_dq"}
    signals |= {"ctrl_torque": "cmd_tau", "kp": "cmd_kp", "kd": "cmd_kd"}
    assert set(recording.signals) == set(signals)
    for signal, name in signals.items():
        np.testing.assert_array_equal(recording.signals[signal], expected[name], err_msg=signal)
    # A user may give the numbers of the motors.
    listed = [f"/lowstate/motor_state[{place}]/q" for place in PLACES[package][::-1]]
    commands = [name.replace("lowstate/motor_state", "lowcmd/motor_cmd") for name in listed]
    none: dict[str, list[str]] = {name: [] for name in ("qvel", "torque", "ctrl_velocity", "ctrl_torque", "kp", "kd")}
    recording = load(tmp_path / "bag", ROBOTS[package], columns={"qpos": listed, "ctrl": commands, **none})
    np.testing.assert_array_equal(recording.signals["qpos"], expected["q"][:, ::-1])


def test_motors_are_named_only_without_doubt() -> None:
    def table(moving: int) -> Table:
        columns = {f"/s/motor_state[{k}]/q": np.full(3, float(k < moving)) for k in range(35)}
        return Table("bag", columns, motors=dict.fromkeys(columns, "unitree_hg"))

    arm = ("left_shoulder_pitch_joint", "left_elbow_joint")
    assert "/s/motor_state[left_elbow]/q" in name_motors(table(29), arm)[0].columns
    for moving, joints in ((27, arm), (29, ("neck_joint",))):
        same, sentence = name_motors(table(moving), joints)
        assert set(same.columns) == set(table(moving).columns) and "data.columns" in sentence
    assert name_motors(table(27), ("left_knee_joint",))[1].startswith("motors named")  # the same number on both
    for robots in MOTORS.values():
        for order in robots.values():
            assert len({*order}) == len(order)


def test_a_controllers_state_and_the_state_of_its_interfaces(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    values = {name: rng.normal(size=(30, 3)) for name in ("reference", "feedback", "velocity", "other")}
    empty, later = np.zeros(0), make("builtin_interfaces/msg/Duration", sec=0, nanosec=0)

    def point(positions: np.ndarray, velocities: np.ndarray = empty) -> Any:
        kind = "trajectory_msgs/msg/JointTrajectoryPoint"
        names = {"positions": positions, "velocities": velocities, "accelerations": empty, "effort": empty}
        return make(kind, **names, time_from_start=later)

    def controller(row: int) -> Any:
        order = rng.permutation(3)  # of the joints, which names state
        rows = {name: each[row][order] for name, each in values.items()}
        points = {
            "reference": point(rows["reference"]),
            "feedback": point(rows["feedback"], rows["velocity"]),
            **{name: point(rows["other"]) for name in ("error", "output")},
        }
        kind, names = "control_msgs/msg/JointTrajectoryControllerState", [JOINTS[k] for k in order]
        return make(kind, header=header(EPOCH + row * 10**7), joint_names=names, **points)

    def interfaces(row: int) -> Any:
        names = ["position", "velocity", "effort"]
        entries = [
            make("control_msgs/msg/InterfaceValue", interface_names=names, values=np.array([k, 10.0 * k, row]))
            for k in range(3)
        ]
        kind = "control_msgs/msg/DynamicJointState"
        return make(kind, header=header(EPOCH + row * 10**7), joint_names=[*JOINTS], interface_values=entries)

    sent = [
        message
        for row in range(30)
        for message in (("/jtc", controller(row), EPOCH + row), ("/dynamic", interfaces(row), EPOCH + row))
    ]
    path = write_messages(tmp_path / "bag", sent, StoragePlugin.MCAP, store=STORE)
    (table,) = read_tables(str(path), "auto")
    assert table.columns["/dynamic/interface_values[knee]/values[velocity]"].tolist() == [10.0] * 30
    recording = load(path, JOINTS)
    for signal, name in {"qpos": "feedback", "qvel": "velocity", "ctrl": "reference"}.items():
        np.testing.assert_array_equal(recording.signals[signal], values[name])


def test_a_recording_without_definitions_names_the_type(tmp_path: Path) -> None:
    states = [("/js", joint_states(0, {"knee": 1.0}, {}, {}), EPOCH)]
    folder = write_messages(tmp_path / "bag", states, StoragePlugin.SQLITE3)
    with sqlite3.connect(folder / "bag.db3") as database:
        database.execute("DELETE FROM message_definitions")
        assert read_tables(str(folder), "auto")[0].columns["/js/position[knee]"].tolist() == [1.0]
        database.execute("UPDATE topics SET type = 'my_msgs/msg/State'")
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("sensor_msgs/msg/JointState", "my_msgs/msg/State"))
    (table,) = read_tables(str(folder), "auto")
    assert not table.columns and "/js is of type my_msgs/msg/State" in table.refused["/js"]


def test_a_definition_that_is_none_costs_only_its_topic(tmp_path: Path) -> None:
    store = get_typestore(Stores.LATEST)
    store.register(get_types_from_msg("float64 value", "bad_msgs/msg/State"))
    sent = [
        ("/s", store.types["bad_msgs/msg/State"](value=2.0), EPOCH),
        ("/js", joint_states(0, {"a": 1.0}, {}, {}), EPOCH),
    ]
    folder = write_messages(tmp_path / "bag", sent, StoragePlugin.MCAP, store=store)
    file = folder / "bag.mcap"
    file.write_bytes(file.read_bytes().replace(b"float64 value", b"import os;  #"))
    (table,) = read_tables(str(folder), "auto")
    assert "bad_msgs/msg/State" in table.refused["/s"] and "/js/position[a]" in table.columns


def test_times_of_a_ros_1_bag_that_run_backwards(tmp_path: Path) -> None:
    store = define(Stores.ROS1_NOETIC)
    kind = store.types["std_msgs/msg/Float64"]
    sent = [("/u", kind(data=float(at)), EPOCH + at) for at in (0, 10, 20, 5, 15)]
    with pytest.raises(LogError, match=rf"{EPOCH + 5} ns.*{EPOCH + 20}"):
        read_tables(str(write_ros1(tmp_path / "a.bag", sent, "", store)), "auto")
