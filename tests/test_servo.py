"""The bench of a real servo: actuator laws with a controller, late commands, offsets, steps within a sample."""

import operator
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers.servo import INTERVAL, PAYLOAD, record, wander

from frictionzoo.bench import Bench, DcMotorPD
from frictionzoo.core.errors import BenchError, ConfigError
from frictionzoo.core.log import Log
from frictionzoo.core.segments import Sampling, cut_segments
from frictionzoo.core.state import Signals
from frictionzoo.result.evaluate import predict
from frictionzoo.simulation import friction_of, make_engine
from frictionzoo.simulation.rollout import applied, make_rollout

pytestmark = pytest.mark.usefixtures("x64")


def held(command: np.ndarray, start: float, stop: float) -> float:
    """Mean of a held command between two times in samples; before the first sample it is the first."""
    edges = np.unique(np.concatenate([[start, stop], np.arange(np.ceil(start), stop)]))
    middles = (edges[1:] + edges[:-1]) / 2
    return float(command[np.maximum(np.floor(middles), 0).astype(int)] @ np.diff(edges) / (stop - start))


@pytest.mark.parametrize("substeps", [1, 5])
def test_a_late_command_is_the_mean_of_what_was_held(substeps: int) -> None:
    command, history = wander(40, 0), 3
    before = np.concatenate([np.full(history, command[0]), command])
    column = jnp.arange(len(before), dtype=before.dtype)[None, :, None]
    late_input = jnp.asarray(3 * before)[None, :, None]
    inputs = {"supply": column, "kp": late_input}
    signals = Signals(jnp.asarray(before)[None, :, None], inputs, {"temperature": column})
    sampling = Sampling(INTERVAL, substeps, history, ("kp",))
    delays = np.array([0.0, 0.3, 0.8, 1.0, 2.0, 2.73, 3.0])  # in samples
    act = jax.jit(jax.vmap(lambda late: applied({"bench": {"delay": late[None]}}, signals, sampling)))
    acting = act(delays * INTERVAL)
    for index, late in enumerate(delays):
        got = acting.map(operator.itemgetter(index))
        assert {signal.shape for signal in got.named().values()} == {(1, 40, substeps, 1)}
        starts = np.arange(40 * substeps) / substeps - late
        expected = [held(command, start, start + 1 / substeps) for start in starts]
        np.testing.assert_allclose(got.ctrl.ravel(), expected, rtol=0, atol=1e-12, err_msg=f"{late}")
        np.testing.assert_allclose(got.inputs["kp"], 3 * got.ctrl, rtol=1e-14, atol=1e-14)
        # What is not a command is not late.
        for signal in (got.inputs["supply"], got.observed["temperature"]):
            np.testing.assert_array_equal(signal[0, :, 0, 0], np.arange(history, history + 40))


def test_every_delay_has_a_slope() -> None:
    """Also one of a whole number of steps, where a fit would otherwise stop."""
    ctrl = jnp.asarray(wander(40, 1))[None, :, None]
    weights = jnp.asarray(np.random.default_rng(2).normal(size=(1, 37, 5, 1)))

    @jax.jit
    @jax.vmap
    @jax.value_and_grad
    def acts(delay: Any) -> Any:
        values, sampling = {"bench": {"delay": delay[None]}}, Sampling(INTERVAL, 5, 3)
        return jnp.sum(weights * applied(values, Signals(ctrl), sampling).ctrl)

    delays = np.array([0.0113, 0.02, 0.022])
    slopes = acts(delays)[1]
    below, here, above = (acts(delays + change)[0] for change in (-1e-6, 0, 1e-6))
    for slope, ahead, behind in zip(slopes, (above - here) / 1e-6, (here - below) / 1e-6, strict=True):
        assert min(abs(slope - ahead), abs(slope - behind)) < 1e-5 * abs(slope)


@pytest.fixture
def servo(make: Callable[..., Any]) -> Callable[..., Bench]:
    """The bench of an STS3215 with options."""
    return lambda *options: make("bench", "bench=sts3215", *options)


NO_DELAY = ("bench.params.delay.init=0", "bench.params.delay.identify=false")


@pytest.mark.parametrize("engine", ["mjx", "specialised"])
def test_a_servo_moves_as_in_mujoco_c(servo: Callable[..., Bench], make: Callable[..., Any], engine: str) -> None:
    """The controller's voltage, the payload, the offset and steps within a sample, against `mj_step`."""
    bench = servo(*NO_DELAY, "bench.params.position_offset.init=0.1")
    law = make("model", "bench=sts3215", "model=mujoco_default", nv=1)
    log = bench.accept(record(wander(60, 3), gain=32.0))
    values = {"bench": bench.initial_values(), "friction": {name: np.array([0.05]) for name in law.params}}
    step = jax.jit(make_engine(engine, bench, friction_of(law), True).step)  # a rollout of MJX compiles longer

    model = mujoco.MjModel.from_xml_string(bench.mjcf(values["bench"], np.array([0.05]), np.array([0.05])))
    body = model.body("arm").id
    model.body_mass[body], model.body_ipos[body] = PAYLOAD.mass, PAYLOAD.position
    model.body_inertia[body] = PAYLOAD.inertia
    model.body_sameframe[body] = model.body_simple[body] = 0
    mujoco.mj_setConst(model, mujoco.MjData(model))
    data = mujoco.MjData(model)
    data.qpos[:] = 0
    fixed = {name: float(value[0]) for name, value in values["bench"].items()}
    qpos, qvel, memory, positions = np.zeros(1), np.zeros(1), np.zeros((1, 0)), []
    for sample in range(59):
        signals = log.signals.map(operator.itemgetter(sample))
        for _ in range(10):
            duty = np.clip(32.0 * fixed["duty_gain"] * (signals.ctrl[0] - data.qpos[0]), -1, 1)
            data.ctrl[0] = 12.0 * duty
            mujoco.mj_step(model, data)
            qpos, qvel, memory = step(values, qpos, qvel, signals, log.load, memory)
        # The microgram of the bench's own arm, which MuJoCo refuses to do without, is left out above.
        assert float(qpos[0]) == pytest.approx(data.qpos[0], abs=1e-7)
        positions.append(data.qpos[0])
    assert np.abs(positions).max() > 0.3


def test_a_motor_that_is_not_enabled_has_no_torque(servo: Callable[..., Bench], make: Callable[..., Any]) -> None:
    bench = servo(*NO_DELAY, "bench.params.position_offset.init=0.1")  # as above, so that it is known already
    law = make("model", "bench=sts3215", "model=mujoco_default", nv=1)
    engine = make_engine("specialised", bench, friction_of(law), True)
    values, load = {"bench": bench.initial_values(), "friction": {}}, bench.load(PAYLOAD)
    see = jax.jit(engine.drive_state)
    for enable, torque in ((0.0, 0.0), (1.0, 0.4 * 12.0 * min(1, 16 * 0.16489 * 0.2) - 0.4 * 3.0)):
        inputs = {name: np.array([value]) for name, value in (("gain", 16.0), ("supply", 12.0), ("enable", enable))}
        seen = see(values, np.array([0.3]), np.array([3.0]), Signals(np.array([0.5]), inputs), load)
        assert seen.motor_torque[0] == pytest.approx(torque, abs=1e-12)
        assert seen.ctrl[0] == 0.5


def test_a_dc_motor_has_less_torque_the_faster_it_turns() -> None:
    sizes = {"kp": 50.0, "kd": 0.5, "stall_torque": 4.0, "torque_limit": 3.0, "no_load_velocity": 10.0}
    law = DcMotorPD(**sizes)
    cases = [(0.0, 1, 3.0), (5.0, 1, 2.0), (12.0, 1, 0.0), (5.0, -1, -3.0), (-5.0, -1, -2.0), (-5.0, 1, 3.0)]
    for velocity, direction, expected in cases:
        torque = law.control(np, sizes, np.array([0.0]), np.array([velocity]), np.array([10.0 * direction]), {})
        assert torque[0] == pytest.approx(expected)
    assert law.control(np, sizes, 0.0, 1.0, 0.02, {}) == pytest.approx(50 * 0.02 - 0.5)


def test_impossible_options_are_refused(servo: Callable[..., Bench]) -> None:
    with pytest.raises(ConfigError, match=r"bench\.params\.delay\.low=-0\.01; expected 0 or more"):
        servo("bench.params.delay.low=-0.01")
    with pytest.raises(ConfigError, match=r"bench\.timestep=0\.0; expected a positive number"):
        servo("bench.timestep=0.0")
    with pytest.raises(BenchError, match=r"0\.01 s per sample, expected 0\.004 s .* a whole number of them"):
        servo("bench.timestep=0.004").accept(record(wander(10, 0)))


def test_an_exported_delay_and_offset_are_mujocos_own(make: Callable[..., Any]) -> None:
    """MuJoCo C delays the command by itself, in steps within a sample, as the rollout does."""
    options = ("bench.params.delay.init=0.0073", "bench.params.position_offset.init=0.1")
    bench = make("bench", "bench=knee", *options)
    log = record(np.concatenate([np.zeros(5), wander(55, 4)]))
    log = Log("knee", log.time, log.qpos - 0.1, log.qvel, log.ctrl, "", True)
    sampling = bench.sampling(INTERVAL)
    assert sampling == Sampling(INTERVAL, 10, 1)
    segments = cut_segments([bench.accept(log)], count=None, length=59, history=sampling.history)
    law = make("model", "model=baseline", nv=1)
    values = {"bench": bench.initial_values(), "friction": {}}
    engine = make_engine("specialised", bench, friction_of(law), False)
    simulated = predict(make_rollout(engine, sampling).compiled, values, segments)

    model = mujoco.MjModel.from_xml_string(bench.mjcf(values["bench"]))
    data = mujoco.MjData(model)
    data.qpos[:] = -0.1
    for i, command in enumerate(log.ctrl[:59, 0]):
        for _ in range(10):
            data.ctrl[0] = command
            mujoco.mj_step(model, data)
        assert simulated.qpos[0, i, 0] == pytest.approx(data.qpos[0], abs=1e-11)
    assert np.ptp(simulated.qpos) > 0.3
