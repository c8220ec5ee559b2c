"""Joints that share a motor's values: offsets stay per joint, for mirrored assemblies have them with opposite signs."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

import frictionzoo as fz
from frictionzoo.bench import Bench, Force, JointPD
from frictionzoo.core.log import Log
from frictionzoo.core.params import Param

HIPS = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>{}</worldbody></mujoco>"""
HIP = """<body pos="0 {0} 0"><joint name="{1}_hip" axis="{2} 0 0"/>
<inertial pos="0.05 {3} -0.1" mass="1.2" diaginertia="0.01 0.01 0.01"/></body>"""
KP, KD, FINER = 20.0, 0.5, 20
ARMATURE, FRICTIONLOSS, DAMPING = 0.02, 0.15, 0.2
OFFSETS = (0.6, -0.6)  # N m, of a cable that pulls both hips outwards


@pytest.fixture(scope="module")
def hips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A left hip and its mirror image."""
    path = tmp_path_factory.mktemp("hips") / "hips.xml"
    path.write_text(HIPS.format(HIP.format(0.1, "left", 1, 0.05) + HIP.format(-0.1, "right", -1, -0.05)))
    return path


def record(path: Path) -> Log:
    """The hips in MuJoCo C with steps of 0.1 ms, their offsets applied as external torques."""
    spec = mujoco.MjSpec.from_file(str(path))
    for joint in spec.joints:
        joint.armature, joint.frictionloss, joint.damping = ARMATURE, FRICTIONLOSS, [DAMPING, 0, 0]
        actuator = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=KP, kv=KD)
    model = spec.compile()
    interval = model.opt.timestep
    model.opt.timestep /= FINER
    data, time = mujoco.MjData(model), np.arange(0, 8, interval)
    rates, phases = np.array([[0.5, 0.7], [1.3, 1.1], [2.9, 2.5]]), np.array([[0, 1.0], [0.5, 2], [1, 0]])
    ctrl = (0.35 * np.sin(2 * np.pi * rates * time[:, None, None] + phases)).sum(axis=1)
    states = np.empty((len(time), 2, 2))
    data.qfrc_applied[:] = OFFSETS
    data.qpos[:] = ctrl[0]
    for state, data.ctrl[:] in zip(states, ctrl, strict=True):
        state[:] = data.qpos, data.qvel
        mujoco.mj_step(model, data, nstep=FINER)
    return Log("hips", time, states[:, 0], states[:, 1], ctrl, "0" * 64, simulated=True)


@pytest.mark.slow
@pytest.mark.usefixtures("in_haste")
def test_mirrored_hips_that_share_a_motor_keep_offsets_of_their_own(hips: Path) -> None:
    offset = {"init": 0.0, "low": -5.0, "high": 5.0, "scale": 1.0, "identify": True}
    known = {"kp": {"init": KP}, "kd": {"init": KD}}
    about = {"params": {"torque_offset": offset}, "tie": {"hip": ".*_hip"}, "timestep": 0.0005}
    bench = Bench(str(hips), ["left_hip", "right_hip"], actuator=JointPD(params=known), **about)
    how = {"recipe": "given", "test": 0.3, "method": "lm", "dtype": "float64", "checkup": "warn"}
    evaluation = {"horizons": [0.2], "trajectory": 0.5}
    segments = {"length": 20, "count": 120}
    found = fz.identify(bench, "mujoco_default", record(hips), evaluation=evaluation, segments=segments, **how)  # pyright: ignore
    np.testing.assert_allclose(found.parameters["bench.torque_offset"].value, OFFSETS, rtol=0.05)
    damping = found.parameters["friction.damping"].value
    assert damping[0] == damping[1] == pytest.approx(DAMPING, rel=0.05)
    assert found.parameters["friction.frictionloss"].value == pytest.approx(FRICTIONLOSS, rel=0.05)


@pytest.mark.parametrize(
    ("name", "tied"),
    [
        *(("armature", True), ("kp", True), ("damping", True), ("mujoco_default.frictionloss", True)),
        *(("offset_torque", True), ("position_offset", False), ("torque_offset", False), ("force_offset", False)),
        *(("sine_1", False), ("ripple.cosine_2", False)),
    ],
)
def test_what_belongs_to_the_assembly_is_tied_by_name_alone(hips: Path, name: str, tied: bool) -> None:
    bench = Bench(str(hips), ["left_hip", "right_hip"], actuator=Force(), tie={"hip": ".*_hip"})
    param = Param(name, "1", 0.5, 0.1, 1.0, 1.0, True)
    assert len(set(bench.groups(param))) == (1 if tied else 2)
    assert len(set(bench.groups(Param(name, "1", 0.5, 0.1, 1.0, 1.0, True, tie=True)))) == 1
