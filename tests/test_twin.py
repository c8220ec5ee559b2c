"""The simulated twin: physics against an independent integrator, hidden effects, determinism, cache, bad options."""

import copy
import math
from pathlib import Path

import hydra
import mujoco
import numpy as np
import pytest
import scipy.integrate
from omegaconf import OmegaConf

from frictionzoo.core.errors import ConfigError, LogError
from frictionzoo.core.segments import cut_segments
from frictionzoo.data import cache
from frictionzoo.data.twin import HiddenDrive, Twin

CONF = Path(__file__).parent.parent / "conf" / "data"
SIGNALS = ("time", "qpos", "qvel", "ctrl")

# Two seconds of a drive with every hidden effect, in shapes that are smooth enough for an adaptive integrator.
SHORT = {
    **{"name": "short", "seed": 3, "samples": 2001, "timestep": 1e-3, "substeps": 4, "mjcf": "knee_rod.xml"},
    "excitation": {
        **{"harmonics": 5, "amplitude": [0.5, 1.5], "frequency": [3.0, 12.0], "phase": [0.0, 6.28]},
        "velocity_limit": 4.0,
    },
    "controller": {"kp": 20.0, "kd": 1.0},
    "drive": {
        **{"armature": 0.05, "coulomb_torque": 0.2, "static_torque": 0.3, "stribeck_velocity": 0.5},
        **{"viscous_coefficient": 0.1, "smoothing_velocity": 0.3, "load_share": 0.2},
        **{"ripple_torque": 0.05, "ripple_periods": 12.0, "command_delay": 0.002},
    },
    "sensor": {"position_quantum": 0.0, "velocity_noise": 0.0},
    "split": {"test_share": 0.4, "gap": 0.1},
    "cache_dir": None,
}


def options(**changes):
    """SHORT with some of it changed: `drive__armature=0.1` reaches into a section."""
    given = copy.deepcopy(SHORT)
    for name, value in changes.items():
        *section, key = name.split("__")
        (given[section[0]] if section else given)[key] = value
    return given


def from_yaml(name, tmp_path) -> Twin:
    return hydra.utils.instantiate(OmegaConf.load(CONF / f"{name}.yaml"), cache_dir=str(tmp_path))


def same(first, second) -> bool:
    return all(np.array_equal(getattr(first, signal), getattr(second, signal)) for signal in SIGNALS)


def integrate(ctrl: np.ndarray, drive: dict) -> np.ndarray:
    """The same bench and drive written down again from the paper's numbers, by an adaptive Runge-Kutta method."""
    inertia = 0.0011 + 0.26 * 0.1127**2 + drive["armature"]
    weight = 0.26 * 9.81 * 0.1127

    def motion(_, state, command):
        q, v = state
        motor = 20.0 * (command - q) - 1.0 * v
        stribeck = (drive["static_torque"] - drive["coulomb_torque"]) * math.exp(
            -((v / drive["stribeck_velocity"]) ** 2)
        )
        dry = drive["coulomb_torque"] + stribeck + drive["load_share"] * abs(motor)
        dry += drive["ripple_torque"] * math.sin(drive["ripple_periods"] * q)
        friction = dry * math.tanh(v / drive["smoothing_velocity"]) + drive["viscous_coefficient"] * v
        return v, (motor - friction - weight * math.sin(q)) / inertia

    states = [np.array([ctrl[0], 0.0])]
    for sample in range(len(ctrl) - 1):
        command = ctrl[max(sample - 2, 0)]  # late by 2 ms, held over each millisecond
        step = scipy.integrate.solve_ivp(motion, (0, 1e-3), states[-1], args=(command,), rtol=1e-8, atol=1e-10)
        states.append(step.y[:, -1])
    return np.array(states)


def test_the_simulation_obeys_the_equation_of_motion():
    twin = Twin(**options(samples=801))
    ctrl = twin.load().train[0].ctrl[:, 0]
    errors = []
    for substeps in (10, 20):
        qpos, qvel = Twin(**options(samples=len(ctrl), substeps=substeps)).simulate(ctrl)
        reference = integrate(ctrl, SHORT["drive"])
        errors.append([np.abs(qpos[:, 0] - reference[:, 0]).max(), np.abs(qvel[:, 0] - reference[:, 1]).max()])
    # Semi-implicit Euler is of first order: the error is below step x change per second (0.1 ms x 4 rad/s, and
    # 0.1 ms x 30 rad/s^2), and half the step halves it, which a term that is missing or wrong would not do.
    assert errors[0][0] < 4e-4
    assert errors[0][1] < 3e-3
    np.testing.assert_allclose(np.divide(*errors), 2.0, rtol=0.1)


def test_the_rod_has_the_published_inertia_and_hangs_down():
    model = mujoco.MjModel.from_xml_string(Twin(**options()).mjcf)
    data = mujoco.MjData(model)
    data.qpos[0] = 0.3
    mujoco.mj_forward(model, data)
    inertia = np.zeros(1)
    mujoco.mj_mulM(model, data, inertia, np.ones(1))
    assert inertia[0] == pytest.approx(0.0011 + 0.26 * 0.1127**2, rel=1e-12)
    assert data.qfrc_bias[0] == pytest.approx(0.26 * 9.81 * 0.1127 * math.sin(0.3), rel=1e-12)
    assert (model.dof_armature[0], model.dof_damping[0], model.dof_frictionloss[0], model.nu) == (0.0, 0.0, 0.0, 0)


def test_a_frictionless_free_drive_keeps_its_energy():
    nothing = dict.fromkeys(SHORT["drive"], 0.0)
    nothing |= {"armature": 0.01, "stribeck_velocity": 1.0, "smoothing_velocity": 1.0}
    twin = Twin(**options(samples=1000, substeps=20, drive=nothing, controller={"kp": 0.0, "kd": 0.0}))
    qpos, qvel = twin.simulate(np.full(1000, 0.5))
    inertia = 0.0011 + 0.26 * 0.1127**2 + 0.01
    energy = inertia * qvel**2 / 2 - 0.26 * 9.81 * 0.1127 * np.cos(qpos)
    swing = 0.26 * 9.81 * 0.1127 * (1 - math.cos(0.5))
    assert qpos.min() == pytest.approx(-0.5, abs=1e-3)  # it swings to the other side
    assert np.ptp(energy) < 1e-3 * swing  # a symplectic step of 0.05 ms


def test_a_command_acts_late():
    ctrl = np.where(np.arange(100) < 10, 0.0, 0.1)
    for delay, first in ((0.0, 11), (0.002, 13), (0.00525, 16)):
        qpos, _ = Twin(**options(samples=100, drive__command_delay=delay)).simulate(ctrl)
        assert int(np.argmax(qpos[:, 0] != 0.0)) == first  # the first sample after the command has arrived


@pytest.fixture(scope="module")
def whole():
    return Twin(**options()).load()


def test_the_encoder_has_steps_and_the_velocity_noise(whole):
    exact = whole.train[0]
    measured = Twin(**options(sensor={"position_quantum": 1e-3, "velocity_noise": 0.02})).load().train[0]
    steps = measured.qpos / 1e-3
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert 0.4e-3 < np.abs(measured.qpos - exact.qpos).max() <= 0.5e-3 * (1 + 1e-9)
    noise = measured.qvel - exact.qvel
    assert np.std(noise) == pytest.approx(0.02, rel=0.1)  # 1101 samples: the estimate has a spread of 2 %
    assert abs(np.corrcoef(noise[1:, 0], noise[:-1, 0])[0, 1]) < 0.15  # white: five times the spread of 0.03
    np.testing.assert_array_equal(measured.ctrl, exact.ctrl)


@pytest.mark.parametrize("name", ["twin", "twin_clean"])
def test_the_hidden_friction_only_dissipates(name, tmp_path):
    drive = from_yaml(name, tmp_path).drive
    rng = np.random.default_rng(0)
    for qpos, qvel, torque in rng.uniform([-1, -4, -3], [1, 4, 3], (1000, 3)).tolist():
        assert drive.friction(qpos, qvel, torque) * qvel >= 0
    assert drive.friction(0.3, 0.0, 2.0) == 0.0


def test_the_default_twin_has_every_hidden_effect_and_the_clean_one_none(tmp_path):
    twin, drive = from_yaml("twin", tmp_path), from_yaml("twin_clean", tmp_path).drive
    assert all(value > 0 for value in (twin.drive.load_share, twin.drive.ripple_torque, twin.drive.command_delay))
    assert twin.sensor.position_quantum > 0 and twin.sensor.velocity_noise > 0 and twin.substeps > 1
    assert twin.drive.ripple_torque < twin.drive.coulomb_torque  # or friction would drive the joint somewhere
    assert (drive.load_share, drive.ripple_torque, drive.command_delay) == (0.0, 0.0, 0.0)
    for qvel in (-2.0, -0.05, 0.003, 0.5):
        stribeck = (drive.static_torque - drive.coulomb_torque) * math.exp(-((qvel / drive.stribeck_velocity) ** 2))
        law = (drive.coulomb_torque + stribeck) * math.tanh(qvel / 0.01) + drive.viscous_coefficient * qvel
        # The law is the same expression, so only rounding separates them.
        assert drive.friction(0.7, qvel, 5.0) == pytest.approx(law, rel=1e-14)


@pytest.mark.parametrize("name", ["twin", "twin_clean"])
def test_the_shipped_recordings_follow_the_protocol(name, tmp_path, monkeypatch):
    """As commanded for all of their two minutes, of which the first seconds are simulated."""
    twin = from_yaml(name, tmp_path)
    simulate, simulated = twin.simulate, 5000

    def follow(ctrl):
        assert len(ctrl) == twin.samples == 119_981
        twin.samples = simulated
        start, rest = simulate(ctrl[:simulated]), ctrl[simulated:, None]
        assert np.abs(start[0]).max() < 2.0  # less than a third of a turn to each side: it does not drift away
        assert np.abs(start[0] - ctrl[:simulated, None]).max() < 0.5
        return np.concatenate([start[0], rest]), np.concatenate([start[1], 0 * rest])

    monkeypatch.setattr(twin, "simulate", follow)
    dataset = twin.load()
    (train,), (test,) = dataset.train, dataset.test
    assert twin.timestep == 1e-3
    assert (twin.controller.kp, twin.controller.kd, twin.excitation.harmonics) == (20.0, 1.0, 5)
    assert dataset.name == twin.name
    assert (train.name, test.name) == (f"{twin.name}[train]", f"{twin.name}[test]")
    assert train.simulated and test.simulated
    assert cut_segments([train], 20_000, 5).count == 20_000
    assert test.time[-1] - test.time[0] == pytest.approx(18.0, abs=0.1)
    assert test.time[0] - train.time[-1] >= twin.split["gap"]
    for log in (train, test):
        speed = np.abs(np.diff(log.ctrl[:, 0]) / 1e-3)
        assert speed.max() < 4.0 + 0.05  # clipped at 4 rad/s, plus the straight line that was removed
        assert speed.max() > 2.0
        assert np.abs(log.ctrl).max() < 2.0


def test_the_clip_limits_the_commanded_speed():
    twin = Twin(**options(samples=20_000, excitation__amplitude=[2.0, 3.0]))
    time = np.arange(20_000) * 1e-3
    speed = np.diff(twin.excitation.command(time, np.random.default_rng(0))) / 1e-3
    assert np.abs(speed).max() == pytest.approx(4.0, abs=0.2)  # the removed line has a slope below that
    assert np.mean(np.abs(speed) > 3.7) > 0.1


def test_the_same_seed_gives_the_same_recording_and_another_another():
    noisy = options(samples=401, sensor__velocity_noise=0.02)
    first, again, other = (Twin(**noisy | {"seed": seed}).load().train[0] for seed in (1, 1, 2))
    assert same(first, again) and first.sha256 == again.sha256
    assert not same(first, other) and first.sha256 != other.sha256


def test_the_cache_is_read_and_its_hash_is_that_of_the_whole_recording(tmp_path):
    twin = Twin(**options(samples=401, cache_dir=str(tmp_path)))
    made = twin.load()
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".jsonl", ".npz"]
    assert same(made.train[0], twin.load().train[0])
    with np.load(twin.cache_file(), allow_pickle=False) as stored:
        marked = {signal: stored[signal] for signal in SIGNALS}
    assert made.train[0].sha256 == made.test[0].sha256 == cache.digest(marked)
    marked["qpos"] = marked["qpos"] + 1.0  # intact, and recognisable
    assert cache.digest(marked) != made.train[0].sha256
    np.savez(twin.cache_file(), sha256=np.array(cache.digest(marked)), **marked)
    np.testing.assert_array_equal(twin.load().train[0].qpos, made.train[0].qpos + 1.0)


def test_another_setting_has_another_cache_file_but_another_split_the_same(tmp_path):
    changes = {"seed": 4, "samples": 1999, "substeps": 5, "drive__armature": 0.051, "sensor__velocity_noise": 0.01}
    changes |= {"controller__kp": 21.0, "excitation__velocity_limit": 3.9}
    folder = {"cache_dir": str(tmp_path)}
    files = {Twin(**options(**folder, **{name: value})).cache_file() for name, value in changes.items()}
    whole = Twin(**options(**folder)).cache_file()
    assert len(files | {whole}) == 1 + len(changes)
    assert Twin(**options(split__gap=0.2, **folder)).cache_file() == whole


@pytest.mark.parametrize("damage", ["garbage", "empty", "truncated", "no-array", "wrong-hash", "objects"])
def test_a_damaged_cache_is_made_anew(damage, tmp_path, caplog):
    twin = Twin(**options(samples=401, cache_dir=str(tmp_path)))
    made, path = twin.load().train[0], twin.cache_file()
    whole = path.read_bytes()
    with np.load(path, allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    changed = {
        "no-array": {name: values for name, values in arrays.items() if name != "qvel"},
        "wrong-hash": arrays | {"qvel": arrays["qvel"] + 1.0},
        "objects": arrays | {"qvel": np.array([print], dtype=object)},
    }
    if damage in changed:
        np.savez(path, **changed[damage])
    else:
        path.write_bytes({"garbage": b"not an archive", "empty": b"", "truncated": whole[: len(whole) // 2]}[damage])
    damaged = path.read_bytes()
    assert same(made, twin.load().train[0])
    # The file does not belong to the cache any more.
    assert "rebuilt" in caplog.text and "changed since it was written" in caplog.text and path.read_bytes() == damaged
    path.unlink()
    assert same(made, twin.load().train[0])
    caplog.clear()
    assert same(made, twin.load().train[0]) and not caplog.text


def test_a_cache_that_cannot_be_written_costs_only_time(tmp_path, caplog, whole):
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    assert same(Twin(**options(cache_dir=str(blocked / "cache"))).load().train[0], whole.train[0])
    assert "cannot be written" in caplog.text


def test_the_users_cache_folder_is_the_operating_systems(tmp_path):
    assert cache.cache_folder(None) is None and cache.cache_folder(str(tmp_path)) == tmp_path
    assert "frictionzoo" in str(cache.cache_folder("user"))


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"mjcf": "knee_rot.xml"}, r"data\.mjcf=knee_rot\.xml: .*did you mean knee_rod\.xml"),
        ({"drive__armatur": 1.0}, r"data\.drive\.armatur: .*did you mean armature"),
        ({"controller": {"kp": 20.0}}, r"data\.controller\.kd: missing"),
        ({"drive__armature": "much"}, r"data\.drive\.armature=much"),
        ({"excitation__phase": [0.0]}, r"data\.excitation\.phase=\[0\.0\]"),
        ({"excitation__velocity_limit": 0.0}, r"data\.excitation\.velocity_limit=0"),
        ({"samples": 0}, r"data\.samples=0"),
        ({"substeps": 0}, r"data\.substeps=0"),
        ({"seed": -1}, r"data\.seed=-1"),
        ({"drive__smoothing_velocity": 0.0}, r"data\.drive\.smoothing_velocity=0"),
        ({"drive__command_delay": -0.001}, r"data\.drive\.command_delay=-0\.001"),
        ({"sensor__velocity_noise": -1.0}, r"data\.sensor\.velocity_noise=-1"),
        ({"timestep": 0.0}, r"data\.timestep=0\.0"),
    ],
)
def test_options_that_make_no_sense(changes, line):
    with pytest.raises(ConfigError, match=line):
        Twin(**options(**changes))


def test_a_split_that_leaves_a_part_empty():
    with pytest.raises(LogError, match=r"short: the test part has 0 of 401 samples .* change data\.split"):
        Twin(**options(samples=401, split__test_share=0.0)).load()


def test_a_drive_that_runs_away_is_refused_as_a_log():
    # An explicit step cannot hold this much damping: the state overflows and MuJoCo resets it, over and over.
    drive = HiddenDrive(**(SHORT["drive"] | {"viscous_coefficient": 1e6}))
    with pytest.raises(LogError, match=r"short: the simulation diverged at sample \d+"):
        Twin(**options(drive=vars(drive))).load()
