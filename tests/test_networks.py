"""What the laws with a network promise whatever their weights, looked at over a million states of every magnitude."""

from collections.abc import Callable
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from frictionzoo.core.errors import ConfigError
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import DissipativeNetwork, FrictionModel, NeuralFriction, OddNetwork, ResidualNetwork
from frictionzoo.models.dissipative_network import softplus
from frictionzoo.models.network import reverse
from frictionzoo.simulation.bridge import to_jax

pytestmark = pytest.mark.usefixtures("x64")

STATES = 125_000  # times 8 seeds of weights make a million
SIZES = [0.1, 1.0, 10.0, 100.0]  # of the weights: of a fresh network, and of one that a fit has driven far
LIMIT = 0.2
V_0 = 0.01
SMOOTHING = {"smoothing_velocity": {"init": V_0, "low": 0.002, "high": 0.1, "scale": "log", "identify": False}}
PHYSICAL = {
    name: {"init": 0.03, "low": 1e-4, "high": 10.0, "scale": "log", "identify": True}
    for name in ("frictionloss", "damping")
}
LAWS: dict[str, Callable[[int], FrictionModel]] = {
    "dissipative_network": lambda seed: DissipativeNetwork(1, [8, 8], seed, SMOOTHING),
    "odd_network": lambda seed: OddNetwork(1, [8, 8], seed),
    "residual_network": lambda seed: ResidualNetwork(1, [8, 8], LIMIT, seed, PHYSICAL),
}


@cache
def states(dtype: str) -> DriveState:
    """Standstill, ordinary states, and states of both signs from the smallest numbers to the largest ones."""
    rng, info = np.random.default_rng(0), np.finfo(dtype)
    low, high = np.log10(float(info.smallest_subnormal)), np.log10(float(info.max)) - 5
    signals = rng.choice([-1.0, 1.0], (5, STATES, 1)) * 10.0 ** rng.uniform(low, high, (5, STATES, 1))
    signals[:, ::2] = rng.normal(size=(5, len(range(0, STATES, 2)), 1))
    state = DriveState(*signals.astype(dtype))
    state.qvel[::10] = 0.0
    assert np.isfinite(signals).all() and (np.abs(state.qvel[state.qvel != 0]).min() < info.tiny)
    return state


def fitted(name: str, seed: int) -> FrictionModel:
    """The law with weights and biases as wild as a fit could leave them, on data of other sizes in each seed."""
    law, rng = LAWS[name](seed), np.random.default_rng(seed)
    law.prepare(DriveState(*(10.0 ** rng.uniform(-3, 3) * (signal + 0.5) for signal in rng.normal(size=(5, 200, 1)))))
    with torch.no_grad():
        for key, weights in law.named_parameters():
            if key.startswith("layers."):
                weights.copy_(torch.tensor(SIZES[seed % len(SIZES)] * rng.normal(size=weights.shape)))
    return law


@cache  # one compilation serves all weights
def over_jax(cls: type[FrictionModel]) -> Callable[..., FrictionTerms]:
    """The law as a compiled rollout calls it."""
    law = LAWS[cls.name](0)
    return jax.jit(lambda values, state: law.terms(jnp, values, state))


def answer(law: FrictionModel, namespace: str, state: DriveState) -> FrictionTerms:
    """The law's terms as numpy arrays, in the floating-point type of the state."""
    dtype = state.qvel.dtype.name
    if namespace == "jax":
        terms = over_jax(type(law))(to_jax(law, dtype), state)
    else:
        values = {key: value.to(getattr(torch, dtype)) for key, value in law.state_dict().items()}
        terms = law.terms(torch, values, state.map(torch.from_numpy))
    return FrictionTerms(*(None if term is None else np.asarray(term) for term in terms))


everywhere = pytest.mark.parametrize("dtype", ["float64", "float32"])
compiled = pytest.mark.parametrize("namespace", ["torch", "jax"])


@everywhere
@compiled
def test_a_dissipative_network_never_drives_the_joint(namespace, dtype):
    state = states(dtype)
    direction = np.sign(state.qvel)
    for seed in range(8):
        torque = answer(fitted("dissipative_network", seed), namespace, state).torque
        assert torque.dtype == dtype and not np.isnan(torque).any()
        assert np.isin(np.sign(torque) * direction, [0, 1]).all() and (torque[direction == 0] == 0).all()
        assert (torque != 0).sum() > 0.1 * STATES  # or there would be nothing to see


@everywhere
@compiled
def test_an_odd_network_mirrors_to_the_last_bit(namespace, dtype):
    state = states(dtype)
    for seed in range(8):
        law = fitted("odd_network", seed)
        there, back = (answer(law, namespace, side).torque for side in (state, reverse(state)))
        assert there.dtype == dtype and np.isfinite(there).all()
        np.testing.assert_array_equal(there, -back)
        assert (there != 0)[::2].mean() > 0.9  # of ordinary states; the smallest motions drown beside the position


@everywhere
@compiled
def test_a_residual_network_stays_within_its_limit(namespace, dtype):
    state, reached = states(dtype), []
    for seed in range(8):
        law = fitted("residual_network", seed)
        limit = np.array(LIMIT, dtype) * law.torque_scale.numpy().astype(dtype)
        terms = answer(law, namespace, state)
        assert terms.torque.dtype == dtype and (np.abs(terms.torque) <= limit).all()
        assert terms.frictionloss.item() == terms.damping.item() == np.array(0.03, dtype)
        reached.append(np.abs(terms.torque).max() == limit)
    assert sum(reached) >= 4  # the limit is what holds them there


def test_the_promises_are_the_new_laws_own():
    """The same look at the paper's network finds what it may do: the tests above can fail."""
    law, state = NeuralFriction(1, [8, 8], 0), states("float64")
    there, back = (answer(law, "torch", side).torque for side in (state, reverse(state)))
    assert (there * np.sign(state.qvel) < 0).mean() > 0.1 and (there != -back).mean() > 0.9
    assert np.abs(there).max() > 1e3


@pytest.mark.parametrize("name", LAWS)
def test_far_outside_the_training_data_the_network_is_constant(name):
    law = fitted(name, 1)
    edge = DriveState(*(5 * [np.full((1, 1), 1e6)]))
    beyond = edge._replace(qpos=1e3 * edge.qpos, ctrl=1e9 * edge.ctrl, external_torque=1e200 * edge.external_torque)
    faster = beyond._replace(qvel=3.0 * edge.qvel)
    torques = [answer(law, "torch", state).torque.item() for state in (edge, beyond, faster)]
    assert torques[0] == torques[1] != 0
    assert torques[1] <= torques[2] <= 3 * torques[1] if name == "dissipative_network" else torques[1] == torques[2]


@pytest.mark.parametrize("name", LAWS)
def test_friction_starts_small(name):
    """At most this share of the torque, as much again at the usual speed; yet each layer has a gradient."""
    share = 0.06 if name == "dissipative_network" else 0.02
    law, state = LAWS[name](0), DriveState(*np.random.default_rng(1).normal(size=(5, 200, 1)))
    law.prepare(state)
    torque = law(state.map(torch.from_numpy)).torque
    assert (torque.abs() < share * law.torque_scale * (1 + torch.tensor(np.abs(state.qvel)))).all()
    torque.square().sum().backward()
    assert all(layer.weight.grad.abs().max() > 0 for layer in law.layers)


def test_softplus_is_smooth_and_never_negative():
    x = torch.tensor([-800.0, -1.0, 0.0, 1.0, 800.0], dtype=torch.float64, requires_grad=True)
    value = softplus(torch, x)
    (slope,) = torch.autograd.grad(value.sum(), x)
    assert value.tolist() == pytest.approx([0.0, np.log1p(np.exp(-1)), np.log(2), np.log1p(np.e), 800.0], rel=1e-15)
    assert slope.tolist() == pytest.approx([0.0, 1 / (1 + np.e), 0.5, 1 / (1 + np.exp(-1)), 1.0], rel=1e-15)
    assert jax.grad(lambda x: softplus(jnp, x))(0.0) == 0.5


def test_dissipative_network_known_values():
    law = DissipativeNetwork(1, [], 0, SMOOTHING)
    law.load_state_dict(
        {
            "smoothing_velocity": torch.tensor([0.5]),
            # The four signals, sines of 1, 2, 4 and 8 times the position, then cosines.
            "layers.0.weight": torch.tensor([[0.0, 1.0, *10 * [0.0]], [1.0, 0, 0, 0, 0, 0, 0.5, 0, 0, 2.0, 0, 0]]),
            "layers.0.bias": torch.tensor([0.0, -1.0]),
            "input_mean": torch.zeros(4),
            "input_std": torch.tensor([1.0, 2.0, 1.0, 1.0]),
            "torque_scale": torch.tensor(10.0),
        }
    )
    one = torch.ones(1, dtype=torch.float64)
    torque = law(DriveState(one, -one, one, one, one)).torque.item()
    # N_1 = -1 / 2, N_2 = 1 - 1 + sin(4) / 2 + 2 cos(2)
    sizes = np.log1p(np.exp([-0.5, np.sin(4) / 2 + 2 * np.cos(2)]))
    assert torque == pytest.approx(-10 * (sizes[0] * np.tanh(2) + sizes[1] / 2))


def test_odd_network_takes_scales_and_no_mean_but_the_position():
    rng = np.random.default_rng(0)
    samples = DriveState(*rng.normal(3.0, 1.0, size=(5, 1000, 2)))._replace(external_torque=np.zeros((1000, 2)))
    law = OddNetwork(2, [4], 0)
    law.prepare(samples)
    assert law.input_mean.tolist() == pytest.approx([np.mean(samples.qpos), 0.0, 0.0, 0.0])
    root_mean_squares = [np.sqrt(np.mean(np.square(signal))) for signal in (samples.qvel, samples.motor_torque)]
    assert law.input_std.tolist() == pytest.approx([np.std(samples.qpos), *root_mean_squares, 1.0])
    assert law.torque_scale.item() == pytest.approx(np.std(samples.motor_torque))


@pytest.mark.parametrize("name", LAWS)
def test_a_law_that_has_its_normalisation_keeps_it(name):
    """Its weights belong to it: identified again on other recordings, the law begins as what it was."""
    law, rng = fitted(name, 0), np.random.default_rng(1)
    again = LAWS[name](1)
    again.load_state_dict(law.state_dict())
    for one in (law, again):
        one.prepare(DriveState(*rng.normal(5.0, 2.0, size=(5, 100, 1))))
    before, state = fitted(name, 0), states("float64").map(lambda signal: torch.tensor(signal[:100]))
    for one in (law, again):
        for term, expected in zip(one(state), before(state), strict=True):
            assert term is expected or torch.equal(term, expected)


@pytest.mark.parametrize("limit", [0.0, -0.1, np.nan, np.inf])
def test_a_limit_that_is_none_is_refused(limit):
    with pytest.raises(ConfigError, match=r"model\.residual_limit=.*; expected a positive share"):
        ResidualNetwork(1, [4], limit, 0, PHYSICAL)


def test_a_dissipative_network_can_be_coulomb_stribeck_viscous_and_load_dependent_friction():
    """Learned from its values alone, within a few per cent wherever the joint moves."""
    rng = np.random.default_rng(0)
    v, load = rng.normal(size=(2, 1000, 1))
    v[::4] *= 0.1  # the fall from static to kinetic friction happens below 0.2 here
    state = DriveState(*map(torch.tensor, (np.zeros_like(v), v, np.zeros_like(v), rng.normal(size=v.shape), load)))
    dry = 0.1 + 0.06 * torch.exp(-((state.qvel / 0.2) ** 2)) + 0.05 * state.external_torque.abs()
    truth = dry * torch.tanh(state.qvel / V_0) + 0.05 * state.qvel
    law = DissipativeNetwork(1, [32, 32], 0, SMOOTHING)
    law.prepare(state.map(torch.Tensor.numpy))
    optimiser = torch.optim.Adam(law.parameters(), lr=0.01)
    for _ in range(600):
        optimiser.zero_grad()
        (law(state).torque - truth).square().mean().backward()
        optimiser.step()
    error = (law(state).torque - truth).square().mean().sqrt() / truth.square().mean().sqrt()
    assert error < 0.05
