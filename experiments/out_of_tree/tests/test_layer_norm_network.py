"""Tests of the torch-only model: frictionzoo's contract, and the formula of its docstring."""

import pytest
import torch
from frictionzoo_makkar.torch_law import LayerNormNetwork
from omegaconf import OmegaConf

from frictionzoo.core.build import build
from frictionzoo.core.config import compose_config
from frictionzoo.core.state import DriveState
from frictionzoo.models.contract import check_model


def make(*overrides: str, nv: int = 1) -> LayerNormNetwork:
    config = OmegaConf.to_container(compose_config("model=layer_norm_network", *overrides), resolve=True)
    return build(config["model"], nv=nv)


@pytest.mark.parametrize("bench", ["knee", "emps"])  # a hinge and a slide
@pytest.mark.parametrize("nv", [1, 3])
def test_the_law_keeps_the_contract(bench, nv):
    check_model(make(f"bench={bench}", nv=nv))


def test_without_its_network_it_is_viscous():
    model = make().double()
    torch.nn.init.zeros_(model.network[-1].weight)
    state = DriveState(*torch.randn(5, 7, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0)))
    expected = model.params["viscous_coefficient"].init * state.qvel
    assert torch.allclose(model(state).torque, expected, rtol=1e-12, atol=0.0)


def test_the_seed_tells_the_weights_and_nothing_else_is_drawn():
    torch.manual_seed(3)
    expected = torch.rand(1)
    torch.manual_seed(3)
    one, same, other = make("seed=1"), make("seed=1"), make("seed=2")
    assert torch.equal(torch.rand(1), expected)
    assert torch.equal(one.network[0].weight, same.network[0].weight)
    assert not torch.equal(one.network[0].weight, other.network[0].weight)
