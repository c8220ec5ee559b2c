"""EMPS: the real files as published, the velocity estimate against known motions, and the line of each bad input."""

from pathlib import Path

import hydra
import mujoco
import numpy as np
import pytest
import scipy.io
from conftest import DATA, ROOT, needs_data
from omegaconf import OmegaConf

from frictionzoo.core.errors import ConfigError, LogError
from frictionzoo.data.emps import Emps
from frictionzoo.data.signals import estimate_velocity

OPTIONS = {"name": "emps", "train": "DATA_EMPS.mat", "test": "DATA_EMPS_PULSES.mat", "cutoff": 100.0, "order": 4}
TIME = np.arange(500) * 1e-3


def signals(**changes):
    """The variables of a small recording; a change to None leaves one out."""
    stored = {"t": TIME[:, None], "qm": np.sin(9 * TIME)[:, None], "vir": np.cos(9 * TIME)[:, None], "gtau": 35.15}
    return {name: values for name, values in {**stored, **changes}.items() if values is not None}


def folder_with(tmp_path: Path, train: dict, test: dict) -> Emps:
    """The source over two files with these variables."""
    (tmp_path / "emps").mkdir()
    scipy.io.savemat(tmp_path / "emps" / OPTIONS["train"], train)
    scipy.io.savemat(tmp_path / "emps" / OPTIONS["test"], test)
    return Emps(folder=str(tmp_path), **OPTIONS)


def test_the_configuration_selects_bench_and_rollouts_with_the_data(monkeypatch):
    monkeypatch.delenv("FRICTIONZOO_DATA", raising=False)
    config = OmegaConf.load(ROOT / "conf" / "data" / "emps.yaml")
    assert config.defaults == [{"override /bench": "emps"}]
    assert (config.segments.length, config.evaluation.placement) == (1000, "consecutive")
    source = hydra.utils.instantiate(config.data)
    assert {name: getattr(source, name) for name in OPTIONS} == OPTIONS
    assert source.folder is None
    monkeypatch.setenv("FRICTIONZOO_DATA", "/somewhere")
    assert hydra.utils.instantiate(config.data).folder == "/somewhere"


def test_the_bench_lumps_everything_into_the_armature():
    model = mujoco.MjModel.from_xml_path(str(ROOT / "frictionzoo" / "bench" / "assets" / "emps.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert model.joint("carriage").type == mujoco.mjtJoint.mjJNT_SLIDE
    assert data.qfrc_bias[0] == 0.0  # no gravity along the axis
    assert float(model.body_mass.sum()) == pytest.approx(1e-3, rel=1e-12)
    assert (model.dof_armature[0], model.dof_damping[0], model.dof_frictionloss[0], model.nu) == (0.0, 0.0, 0.0, 0)


@needs_data
def test_the_real_files_are_what_was_published_and_obey_its_parameters():
    dataset = Emps(folder=DATA, **OPTIONS).load()
    assert [log.name for log in dataset.logs] == ["DATA_EMPS.mat", "DATA_EMPS_PULSES.mat"]
    for log in dataset.logs:
        assert log.samples == 24841
        assert log.timestep == pytest.approx(1e-3, rel=1e-6)  # the published rate, 1 kHz
        assert not log.simulated
        assert np.abs(log.ctrl).max() <= 10.0  # the published limit of the voltage [V]
        assert "Janot" in log.metadata["citation"]
    assert dataset.train[0].sha256 != dataset.test[0].sha256
    log = dataset.train[0]
    qvel, force = log.qvel[:, 0], 35.1507 * log.ctrl[:, 0]
    moving = np.abs(qvel) > 0.01
    moving &= np.arange(log.samples) > 50  # the filter's start
    columns = np.stack([np.gradient(qvel, log.timestep), qvel, np.sign(qvel), np.ones_like(qvel)], axis=1)
    mass, viscous, coulomb, offset = np.linalg.lstsq(columns[moving], force[moving], rcond=None)[0]
    # Published (IDIM-LS on filtered and decimated signals): 95.109 kg, 203.503 N s/m, 20.394 N, -3.165 N. Plain least
    # squares over the moving samples weighs them differently.
    assert mass == pytest.approx(95.109, rel=0.02)
    assert viscous == pytest.approx(203.503, rel=0.05)
    assert coulomb == pytest.approx(20.394, rel=0.10)
    assert offset == pytest.approx(-3.165, rel=0.20)
    published = OmegaConf.load(ROOT / "conf" / "experiment" / "emps_published.yaml").bench.actuator.params
    assert published.force_offset.init == 3.165  # on the side of the force, where ours stands


def test_position_and_voltage_stay_as_measured(tmp_path):
    dataset = folder_with(tmp_path, signals(), signals(vir=2 * TIME)).load()
    np.testing.assert_array_equal(dataset.train[0].qpos[:, 0], np.sin(9 * TIME))
    np.testing.assert_array_equal(dataset.train[0].ctrl[:, 0], np.cos(9 * TIME))
    np.testing.assert_array_equal(dataset.test[0].ctrl[:, 0], 2 * TIME)
    # Away from the ends, a motion of 1.4 Hz passes a 100 Hz filter; central differences err by (9 rad/s * 1 ms)^2 / 6.
    np.testing.assert_allclose(dataset.train[0].qvel[50:-50, 0], 9 * np.cos(9 * TIME[50:-50]), atol=9 * 2e-5)


def test_the_velocity_has_no_phase_lag_and_less_noise():
    time = np.arange(20_000) * 1e-3
    noise = 1e-4 * np.random.default_rng(0).standard_normal(len(time))
    true = np.cos(2 * np.pi * 5 * time)
    position = np.sin(2 * np.pi * 5 * time) / (2 * np.pi * 5)
    velocity = estimate_velocity(position + noise, 1e-3, 100.0, 4, "log")
    lags = [np.sum(true[100:-100] * np.roll(velocity, lag)[100:-100]) for lag in range(-3, 4)]
    assert int(np.argmax(lags)) == 3  # no shift fits best
    plain = np.std(np.gradient(position + noise, 1e-3) - true)
    assert np.std(velocity - true) < 0.6 * plain  # 100 Hz of the 500 Hz band, weighted with frequency


def test_the_filter_halves_a_motion_at_its_cutoff():
    position = np.sin(2 * np.pi * 100 * np.arange(4000) * 1e-4)
    velocity = estimate_velocity(position, 1e-4, 100.0, 4, "log")
    amplitude = np.abs(velocity[1000:3000]).max() / (2 * np.pi * 100)
    assert amplitude == pytest.approx(0.5, rel=0.01)  # central differences take another 0.07 % off


def test_files_that_are_not_there_get_a_line_on_where_to_obtain_them(tmp_path):
    for folder, cause in ((None, r"data\.folder=null"), (str(tmp_path), r"emps/DATA_EMPS\.mat: no such file")):
        with pytest.raises(LogError, match=rf"{cause}.*FRICTIONZOO_DATA or data\.folder.*nonlinearbenchmark\.org"):
            Emps(folder=folder, **OPTIONS).load()


@pytest.mark.parametrize("damage", ["text", "empty", "truncated", "flipped"])
def test_an_unreadable_file_gets_one_line(tmp_path, damage):
    source = folder_with(tmp_path, signals(), signals())
    path = tmp_path / "emps" / OPTIONS["train"]
    whole = path.read_bytes()
    flipped = whole[:128] + bytes(255 - byte for byte in whole[128:])
    path.write_bytes(
        {"text": b"time,qpos\n0,1\n", "empty": b"", "truncated": whole[: len(whole) // 2], "flipped": flipped}[damage]
    )
    with pytest.raises(LogError, match=r"DATA_EMPS\.mat: ") as caught:
        source.load()
    assert "\n" not in str(caught.value)


NAN = np.where(np.arange(500) == 7, np.nan, 0.5)
BAD = {
    "missing": (signals(vir=None, virr=TIME), r"no column vir; did you mean virr"),
    "length": (signals(qm=TIME[:-1]), r"qm has 499 samples and t 500"),
    "matrix": (signals(qm=np.ones((500, 2))), r"no column qm"),
    "text": (signals(vir="volt"), r"no column vir"),
    "complex": (signals(vir=TIME + 1j), r"vir is of type complex128"),
    "nan": (signals(qm=NAN), r"qpos is NaN or infinite in 1 of 500 samples, first at sample 7"),
    "backwards": (signals(t=TIME[::-1]), r"time runs backwards at sample 1"),
    "short": ({"t": TIME[:9], "qm": TIME[:9], "vir": TIME[:9]}, r"9 samples"),
}


@pytest.mark.parametrize(("stored", "line"), BAD.values(), ids=BAD)
def test_wrong_contents_get_one_line(tmp_path, stored, line):
    with pytest.raises(LogError, match=line):
        folder_with(tmp_path, stored, signals()).load()


@pytest.mark.parametrize("changes", [{"cutoff": 500.0}, {"cutoff": 0.0}, {"order": 0}])
def test_a_filter_that_makes_no_sense(tmp_path, changes):
    folder_with(tmp_path, signals(), signals())
    with pytest.raises(ConfigError, match=rf"data\.{next(iter(changes))}="):
        Emps(folder=str(tmp_path), **{**OPTIONS, **changes}).load()
