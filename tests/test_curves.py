"""What a run keeps for figures: arrays that come back as they were, and a law's torque over velocity."""

from dataclasses import replace

import numpy as np
import pytest
import safetensors.numpy
import torch
from helpers.curves import HARD, make_curves
from helpers.results import PARAMS

from frictionzoo.core.state import DriveState, Signals
from frictionzoo.models.baseline import Baseline
from frictionzoo.models.coulomb_stribeck import CoulombStribeck
from frictionzoo.models.mujoco_default import MujocoDefault
from frictionzoo.models.neural_friction import NeuralFriction
from frictionzoo.result.curves import LATER, read_curves, write_curves
from frictionzoo.result.portrait import AROUND, Portrait, sample_friction

OWN = {"init": 0.3, "low": 1e-3, "high": 1.0, "scale": "log", "identify": True}


@pytest.fixture
def samples():
    rng = np.random.default_rng(0)
    return DriveState(*rng.normal(size=(5, 1000, 1)))


def test_arrays_come_back_as_they_were(tmp_path):
    curves = make_curves(HARD, nv=2)
    driven = Signals(curves.signals.ctrl, {"gain": 2 * curves.qpos}, {"temperature": 3 * curves.qpos})
    portrait = Portrait(*np.random.default_rng(1).normal(size=(8, 5, 2)))
    curves = replace(curves, signals=driven, portraits={"velocity": portrait, "load": portrait})
    write_curves(tmp_path, curves)
    first = (tmp_path / "curves.safetensors").read_bytes()
    again = read_curves(tmp_path)
    for name, values in vars(curves).items():
        if name != "signals":
            read = getattr(again, name)
            pairs = [(read[key], values[key]) for key in values] if isinstance(values, dict) else [(read, values)]
            for other, value in pairs:
                np.testing.assert_array_equal(other, value)
    assert again.portraits.keys() == curves.portraits.keys()
    assert again.signals.named().keys() == driven.named().keys()
    for name, signal in driven.named().items():
        np.testing.assert_array_equal(again.signals.named()[name], signal)
    write_curves(tmp_path, again)
    assert (tmp_path / "curves.safetensors").read_bytes() == first
    arrays = safetensors.numpy.load(first)
    for name in LATER:  # an older run
        del arrays[name]
    safetensors.numpy.save_file(arrays, tmp_path / "curves.safetensors")
    assert read_curves(tmp_path).begins.size == 0


def test_a_law_of_the_velocity_is_drawn_as_its_formula(samples):
    model = CoulombStribeck(1, PARAMS)
    velocity, torque, low, high = sample_friction(model, samples)
    assert velocity[0] == -velocity[-1] == -np.abs(samples.qvel).max() and 0.0 in velocity
    still = torch.zeros(len(velocity), 1, dtype=torch.float64)
    expected = model(DriveState(still, torch.from_numpy(velocity)[:, None], still, still, still)).torque
    for curve in (torque, low, high):
        np.testing.assert_allclose(curve, expected.detach().numpy(), rtol=1e-12)


def test_dry_friction_of_mujoco_is_drawn_at_its_limit(samples):
    velocity, torque, *_ = sample_friction(MujocoDefault(1, {"frictionloss": OWN, "damping": OWN}), samples)
    np.testing.assert_allclose(torque[:, 0], 0.3 * np.sign(velocity) + 0.3 * velocity, rtol=1e-12)


def test_no_friction_is_zero_for_every_joint():
    samples = DriveState(*np.random.default_rng(0).normal(size=(5, 50, 3)))
    assert AROUND > 50  # fewer states than are looked at
    for curve in sample_friction(Baseline(3), samples)[1:]:
        np.testing.assert_array_equal(curve, np.zeros((81, 3)))


def test_a_law_of_more_than_the_velocity_has_a_spread(samples):
    model = NeuralFriction(1, hidden=[8], seed=0)
    model.prepare(samples)
    _, torque, low, high = sample_friction(model, samples)
    assert (low <= torque).all() and (torque <= high).all() and (high - low).min() > 0
