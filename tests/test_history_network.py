"""The neural friction that remembers: its equation, its step, and a friction that no network without memory learns."""

import itertools
import math

import numpy as np
import pytest
import torch

from frictionzoo.core.errors import ConfigError
from frictionzoo.core.state import DriveState
from frictionzoo.models import ActuatorLSTM, Dahl, FrictionModel, HistoryNetwork, NeuralFriction

STEP = 1e-3  # s
TIMES = (0.002, 2.0)
SIZES = {"stiffness": 50.0, "coulomb_torque": 1.0, "viscous_coefficient": 0.1, "rest_velocity": 0.01}
YIELDS = {
    name: {"init": size, "low": 1e-6, "high": 1e6, "scale": "log", "identify": True} for name, size in SIZES.items()
}


def make_trace(count: int, steps: int, seed: int, timestep: float = STEP) -> list[DriveState]:
    """Joints that swing with random frequencies of 2 to 12 Hz at up to 4 rad/s, one state a step."""
    rng = np.random.default_rng(seed)
    size, rate, phase = (rng.uniform(low, high, (4, count, 1)) for low, high in ((0.2, 1), (2, 12), (0, 2 * np.pi)))
    time = timestep * np.arange(steps)[:, None, None, None]
    turns = 2 * np.pi * rate * time + phase
    qvel = (size * np.sin(turns)).sum(1)
    qpos = (size / (2 * np.pi * rate) * (np.cos(phase) - np.cos(turns))).sum(1)
    none = np.zeros_like(qvel)
    signals = (qpos, qvel, none, none, none)
    return [DriveState(*(torch.tensor(signal[k]) for signal in signals)) for k in range(steps)]


def stack(trace: list[DriveState]) -> DriveState:
    return DriveState(
        *(torch.stack(signals) for signals in zip(*(state.given().values() for state in trace), strict=True))
    )


def along(law: FrictionModel, trace: list[DriveState], timestep: float = STEP) -> torch.Tensor:
    """Friction in each state of a trace, the memory carried from one to the next."""
    values, found = law.state_dict(keep_vars=True), []
    memory = law.settle(torch, values, trace[0])
    for state in trace:
        terms, memory = law.advance(torch, values, state, memory, timestep)
        found.append(terms.torque + (0.0 if terms.damping is None else terms.damping * state.qvel))
    return torch.stack(found)


def make_linear(candidate: list[float], gate: float) -> HistoryNetwork:
    """One unit, no hidden layer: N_0 = 3 q, N_1 of these weights, N_2 = gate; s = 10."""
    law = HistoryNetwork(1, [], 1, TIMES, 0)
    with torch.no_grad():
        law.layers[0].weight.copy_(torch.tensor([[3.0, 0.0, 0.0, 0.0], candidate, 4 * [0.0]]))
        law.layers[0].bias.copy_(torch.tensor([0.0, 0.0, gate]))
        law.torque_scale.fill_(10.0)
    return law


def make_wild(seed: int = 0) -> HistoryNetwork:
    """A network whose last layer is as large as a fit leaves it."""
    law = HistoryNetwork(1, [16], 4, TIMES, seed)
    with torch.no_grad():
        law.layers[-1].weight.mul_(100.0)
    return law


@pytest.mark.parametrize("timestep", [1e-4, 1e-3, 1e-2])
@pytest.mark.parametrize(("gate", "time"), [(0.0, math.sqrt(0.002 * 2.0)), (800.0, 0.002), (-800.0, 2.0)])
def test_the_memory_follows_a_leap_as_a_first_order_lag(gate, time, timestep):
    """h = N_1 (1 - exp(-t / t_1)), whatever the step; t_1 is the geometric mean of its bounds in the middle of them."""
    law, one = make_linear([0.0, 0.5, 0.0, 0.0], gate), torch.ones(1, dtype=torch.float64)
    at_rest = DriveState(*(5 * [0 * one]))
    moving = at_rest._replace(qpos=0.1 * one, qvel=2 * one)
    torque = along(law, [at_rest, *(10 * [moving])], timestep)[:, 0]
    passed = timestep * torch.arange(11, dtype=torch.float64)
    expected = 10 * (0.3 * (passed > 0).double() + 2 * 0.5 * (1 - torch.exp(-passed / time)))
    torch.testing.assert_close(torque, expected, rtol=1e-12, atol=1e-12)
    assert law(moving).torque.item() == pytest.approx(10 * (0.3 + 1.0))


def test_what_has_settled_is_the_law_itself():
    law, trace = make_wild(), make_trace(8, 2, 0)
    constant = along(law, 5 * [trace[0]])
    torch.testing.assert_close(constant, law(trace[0]).torque.expand_as(constant), rtol=1e-12, atol=1e-12)
    assert (along(law, trace)[1] - law(trace[1]).torque).abs().max() > 1e-3  # in motion it is another


def test_the_step_matters_little_and_less_the_shorter_it_is():
    law = make_wild()
    torque = [along(law, make_trace(8, 100 * parts, 0, STEP / parts), STEP / parts)[::parts] for parts in (1, 2, 4)]
    halved, again = ((long - short).abs().max().item() for long, short in itertools.pairwise(torque))
    assert halved < 0.05 * torque[0].std().item()
    assert 0 < again < 0.6 * halved  # an error of the first order halves


def test_far_outside_the_training_data_it_is_constant():
    law, one = make_wild(), torch.ones(1, 1, dtype=torch.float64)
    far, farther = (DriveState(*(5 * [size * one])) for size in (1e3, 1e9))
    assert torch.equal(law(far).torque, law(farther).torque) and law(far).torque != 0


def test_it_starts_near_zero_with_time_constants_over_the_whole_range():
    law, state = HistoryNetwork(1, [16], 4, TIMES, 0), DriveState(*np.random.default_rng(1).normal(size=(5, 200, 1)))
    law.prepare(state)
    trace = [state.map(torch.tensor)]
    torque = along(law, trace)
    assert 0 < torque.abs().max() < 0.05 * law.torque_scale  # five outputs, each near zero
    torque.square().sum().backward()
    assert all(layer.weight.grad.abs().max() > 0 for layer in law.layers)
    gates = law.layers[-1].bias.detach()[-4:]
    times = TIMES[1] * (TIMES[0] / TIMES[1]) ** torch.sigmoid(gates)
    assert times.tolist() == pytest.approx([2 * 1e-3**share for share in (0.125, 0.375, 0.625, 0.875)])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"memory": 0}, r"model\.memory=0: expected 1 to 4096"),
        ({"time_constants": [2.0, 0.002]}, r"model\.time_constants=\[2\.0, 0\.002\]; expected two above 0 s"),
        ({"time_constants": [0.0, 1.0]}, r"model\.time_constants=.*; expected two above 0 s"),
        ({"time_constants": [1.0]}, r"model\.time_constants=.*; expected two above 0 s"),
    ],
)
def test_a_memory_that_is_none_is_refused(options, message):
    with pytest.raises(ConfigError, match=message):
        HistoryNetwork(1, [4], **{"memory": 2, "time_constants": TIMES, "seed": 0, **options})


@pytest.mark.parametrize(
    "recurrent",
    [
        HistoryNetwork(1, [16], 2, TIMES, 0),
        ActuatorLSTM(1, [16], 3.0, 4, 0, {"frictionloss": 1e-9, "damping": YIELDS["viscous_coefficient"]}),
    ],
    ids=lambda law: law.name,
)
def test_it_learns_hysteresis_that_no_network_without_memory_does(recurrent):
    """Dahl's spring along traces of 50 ms, by descent through the memory; the judge are traces that it never saw."""
    truth, trace, unseen = Dahl(1, YIELDS), make_trace(48, 50, 0), make_trace(48, 50, 1)
    with torch.no_grad():
        target, expected = along(truth, trace), along(truth, unseen)
    samples = stack(trace).map(lambda signal: signal.reshape(-1, 1).numpy())
    errors = []
    for law in (recurrent, NeuralFriction(1, [16], 0)):
        law.prepare(samples._replace(motor_torque=target.reshape(-1, 1).numpy()))
        optimiser = torch.optim.Adam(law.parameters(), lr=0.03)
        for _ in range(120):
            optimiser.zero_grad()
            # Without a memory all steps are one call.
            torque = along(law, trace) if law.memory else law(stack(trace)).torque
            (torque - target).square().mean().backward()
            optimiser.step()
        with torch.no_grad():
            error = (along(law, unseen) - expected).square().mean().sqrt() / expected.square().mean().sqrt()
        errors.append(error.item())
    remembers, forgets = errors
    assert remembers < 0.3  # few descents of a small network, yet most of it
    assert remembers < 0.6 * forgets
