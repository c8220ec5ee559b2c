"""Limits that are suggested for hardware: never above the recorded motion, the identified torque or stall torque."""

from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from frictionzoo.bench import Bench, DcMotorPD, Force, JointPD, PositionPD, RecordedPD, VoltageServo
from frictionzoo.bench.limits import Limits
from frictionzoo.bench.torque import stall_torque
from frictionzoo.core.log import Log
from frictionzoo.identification.commands import recorded_limits, round_down

PENDULUM = """<mujoco><option timestep="0.002"/><worldbody><body><joint name="shaft" axis="0 1 0"/>
<inertial pos="0 0 -0.1" mass="0.2" diaginertia="0.001 0.001 0.001"/></body></worldbody></mujoco>"""
BEGINS = {  # initial gains, far above those that are identified
    "position_pd": lambda: PositionPD(kp=60.0, kd=3.0),
    "limited": lambda: JointPD(kp=60.0, kd=3.0, torque_limit=9.0),
    "saturated": lambda: JointPD(kp=60.0, kd=3.0, torque_saturation=9.0),
    "dc_motor": lambda: DcMotorPD(kp=60.0, kd=3.0, stall_torque=9.0, torque_limit=9.0, no_load_velocity=9.0),
    "recorded": lambda: RecordedPD(torque_gain=1.0, torque_limit=9.0),
    "voltage": lambda: VoltageServo(kt_over_r=1.0, kt2_over_r=1.0, duty_gain=0.2, duty_limit=1.0),
    "force": lambda: Force(force_gain=5.0, torque_limit=9.0),
}


@pytest.fixture(scope="module")
def benches(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Bench]:
    path = tmp_path_factory.mktemp("limits") / "pendulum.xml"
    path.write_text(PENDULUM)
    late = {"delay": {"init": 0.0, "low": 0.0, "high": 0.05, "scale": 0.01, "identify": True}}
    more = {"limited": {"torque_offset": 0.1}}
    return {name: Bench(str(path), actuator=law(), params=late | more.get(name, {})) for name, law in BEGINS.items()}


def torque_of(law: str, v: dict[str, float], ctrl: Any, qpos: Any, qvel: Any, supply: float) -> np.ndarray:
    """Return the torque by its formula in the literature, written here once more."""
    if law == "voltage":
        duty = np.clip(32 * v["duty_gain"] * (ctrl - qpos), -v["duty_limit"], v["duty_limit"])
        return v["kt_over_r"] * duty * supply - v["kt2_over_r"] * qvel
    if law == "force":
        return np.clip(v["force_gain"] * ctrl + v["force_offset"], -v["torque_limit"], v["torque_limit"])
    kp, kd = (6.0, 0.2) if law == "recorded" else (v["kp"], v["kd"])
    asked = kp * (ctrl - qpos) - kd * qvel
    if law == "dc_motor":
        up, down = (v["stall_torque"] * (1 - sign * qvel / v["no_load_velocity"]) for sign in (1, -1))
        return np.clip(asked, -np.clip(down, 0, v["torque_limit"]), np.clip(up, 0, v["torque_limit"]))
    if law == "saturated":
        return v["torque_gain"] * v["torque_saturation"] * np.tanh(asked / v["torque_saturation"])
    if law in ("limited", "recorded"):
        return v["torque_gain"] * np.clip(asked, -v["torque_limit"], v["torque_limit"]) + v.get("torque_offset", 0.0)
    return asked


def stalls_at(law: str, v: dict[str, float], supply: float) -> float:
    return {
        "voltage": v.get("kt_over_r", 0) * v.get("duty_limit", 0) * supply,
        "dc_motor": min(v.get("stall_torque", 0), v.get("torque_limit", 0)),
        "saturated": v.get("torque_gain", 0) * v.get("torque_saturation", 0),
        "limited": v.get("torque_gain", 0) * v.get("torque_limit", 0) - abs(v.get("torque_offset", 0)),
        "recorded": v.get("torque_gain", 0) * v.get("torque_limit", 0),
        "force": v.get("torque_limit", 0),
    }.get(law, np.inf)


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(sorted(BEGINS)),
    st.floats(0.02, 1.0),
    st.floats(0.5, 12),
    st.integers(0, 20),
    st.floats(3, 15),
    st.integers(0, 10_000),
)
def test_limits_are_within_motion_torque_and_stall(benches, law, share, rate, late, supply, seed):
    bench, rng = benches[law], np.random.default_rng(seed)
    identified = {name: share * value for name, value in bench.initial_values().items()}
    identified["delay"] = np.array([late * 0.002])
    time = np.arange(500) * 0.002
    ctrl = rng.uniform(0.2, 1.5) * np.sin(rate * time + rng.uniform(0, 6))
    qpos = rng.uniform(0.2, 1.2) * np.sin(rate * time + rng.uniform(0, 6)) + rng.normal()
    qvel = np.gradient(qpos, 0.002)
    extras = {"supply": supply, "gain": 32.0, "enable": 1.0, "kp": 6.0, "kd": 0.2}
    columns = {name: np.full((500, 1), value) for name, value in extras.items()}
    columns |= {"ctrl_velocity": np.zeros((500, 1)), "ctrl_torque": np.zeros((500, 1))}
    log = bench.accept(Log("a", time, qpos[:, None], qvel[:, None], ctrl[:, None], "0" * 64, None, extras=columns))
    plain = {name: float(value[0]) for name, value in identified.items()}
    held = ctrl[np.maximum(np.arange(500) - late, 0)]
    reached = np.abs(torque_of(law, plain, held, qpos, qvel, supply)).max()
    stall = stalls_at(law, plain, supply)
    limits = recorded_limits(bench, identified, [log])
    assert limits["torque"] <= min(reached, stall) * (1 + 1e-9)
    assert limits["velocity"] <= np.abs(qvel).max()
    low, high = limits["position"]
    assert qpos.min() <= low <= high <= qpos.max()
    if stall > 0.01 and reached > 0.01:
        assert limits["torque"] > 0.5 * min(
            np.quantile(np.abs(torque_of(law, plain, held, qpos, qvel, supply)), 0.99), stall
        )
    inputs = {name: np.atleast_1d(value) for name, value in extras.items()}
    inputs |= {"ctrl_velocity": np.zeros(1), "ctrl_torque": np.zeros(1)}
    found = stall_torque(bench, identified, inputs, np.zeros(1))
    assert found[0] == pytest.approx(max(stall, 0) if np.isfinite(stall) else np.inf, rel=1e-6, abs=1e-6) or stall < 0


@given(st.floats(1e-6, 1e6), st.sampled_from([1, -1]))
def test_a_limit_is_rounded_towards_less(value: float, sign: int) -> None:
    rounded = round_down(sign * value)
    assert rounded <= sign * value and abs(rounded - sign * value) <= 0.011 * value
    assert rounded == float(f"{rounded:.3g}") or abs(rounded) >= 999 * 10 ** np.floor(np.log10(value) - 2)


def test_a_limit_that_does_not_hold_the_drive_is_no_limit(benches: dict[str, Bench]) -> None:
    """A drive that hangs and is hardly moved gets no torque that would lift it elsewhere."""
    bench = benches["position_pd"]
    model = bench.compile(constraint=False)
    assert isinstance(model, mujoco.MjModel)
    time = np.arange(500) * 0.002
    qpos = 1e-3 * np.sin(9 * time)[:, None]
    log = bench.accept(Log("a", time, qpos, np.gradient(qpos, 0.002, axis=0), qpos + 1e-4, "0" * 64, None))
    limits = recorded_limits(bench, bench.initial_values(), [log])
    read = Limits.read(1, **limits)
    assert read.torque[0] < 0.1 and np.abs([read.low, read.high]).max() <= 1e-3
