"""Tests of the Makkar model: frictionzoo's contract, and values of its source."""

import functools
from collections.abc import Mapping

import numpy as np
import pytest
import torch
from frictionzoo_makkar.law import Makkar
from omegaconf import OmegaConf
from scipy.optimize import least_squares

from frictionzoo.core.build import build
from frictionzoo.core.config import compose_config
from frictionzoo.core.state import DriveState
from frictionzoo.models.contract import check_model

BENCHES = ("knee", "emps")  # a hinge and a slide


@functools.cache
def make(bench: str = "knee", nv: int = 1) -> Makkar:
    config = OmegaConf.to_container(compose_config("model=makkar", f"bench={bench}"), resolve=True)
    return build(config["model"], nv=nv)


def torque(values: Mapping[str, float], qvel: list[float] | np.ndarray) -> np.ndarray:
    given = {name: torch.tensor([value], dtype=torch.float64) for name, value in values.items()}
    velocity = torch.tensor(qvel, dtype=torch.float64)[:, None]
    zero = torch.zeros_like(velocity)
    return make().terms(torch, given, DriveState(zero, velocity, zero, zero, zero)).torque.flatten().numpy()


@pytest.mark.parametrize("bench", BENCHES)
@pytest.mark.parametrize("nv", [1, 3])
def test_the_law_keeps_the_contract(bench, nv):
    model = make(bench, nv)
    assert type(model) is Makkar
    check_model(model)


def test_known_values():
    values = {"stribeck_torque": 0.25, "stribeck_rise": 100.0, "stribeck_decay": 10.0}
    values |= {"coulomb_torque": 0.5, "coulomb_rise": 200.0, "viscous_coefficient": 0.01}
    # tanh(1) = 0.76159415595576489, tanh(0.1) = 0.099667994624955817, tanh(2) = 0.96402758007581688;
    # at 3 rad/s every tanh is 1 to the last digit: only Coulomb and viscous friction remain.
    slow = 0.25 * (0.76159415595576489 - 0.099667994624955817) + 0.5 * 0.96402758007581688 + 1e-4
    assert torque(values, [0.0, 0.01, -0.01, 3.0]).tolist() == pytest.approx([0.0, slow, -slow, 0.53], abs=1e-12)


def test_friction_falls_after_the_onset_of_motion():
    values = {name: param.init for name, param in make().params.items()} | {"viscous_coefficient": 0.0}
    slow, fast = torque(values, [0.03, 1.0])
    assert slow > 1.3 * fast
    assert fast == pytest.approx(values["coulomb_torque"], rel=1e-6)  # tanh(10) is 1 within 4e-9


@pytest.mark.parametrize("seed", range(5))
def test_friction_opposes_motion_anywhere_in_bounds(seed):
    random, params = np.random.default_rng(seed), make().params
    values = {name: np.exp(random.uniform(np.log(param.low), np.log(param.high))) for name, param in params.items()}
    velocity = np.geomspace(1e-4, 30.0, 200)
    assert (torque(values, velocity) > 0).all()
    assert (torque(values, -velocity) < 0).all()


def test_torques_tell_the_parameters():
    """Recover the parameters identified by default from their initial values, without noise."""
    params = make().params
    start = {name: param.init for name, param in params.items() if param.identify}
    known = {name: param.init for name, param in params.items() if not param.identify}
    truth = {"stribeck_torque": 0.2, "stribeck_decay": 4.0, "coulomb_torque": 0.3, "viscous_coefficient": 0.1}
    velocity = np.linspace(-2.0, 2.0, 201)
    measured = torque(known | truth, velocity)

    def residual(logarithms: np.ndarray) -> np.ndarray:
        return torque(known | dict(zip(start, np.exp(logarithms), strict=True)), velocity) - measured

    found = np.exp(least_squares(residual, np.log(list(start.values())), xtol=1e-12, ftol=1e-12, gtol=1e-12).x)
    assert dict(zip(start, found, strict=True)) == pytest.approx(truth, rel=1e-4)  # differences, not exact slopes
