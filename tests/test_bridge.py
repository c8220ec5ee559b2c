"""Values that cross between torch and JAX, and JAX functions as torch operations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from frictionzoo.core.errors import ConfigError, ModelError
from frictionzoo.models import NeuralFriction
from frictionzoo.simulation.bridge import as_torch_function, load_from_jax, to_jax


def decay(values: dict, state: dict, steps: np.ndarray) -> dict:
    """Ten explicit steps of a rubbing body: a rollout in miniature."""

    def step(qvel, ctrl):
        qvel = qvel + 0.1 * (ctrl - values["damping"] * qvel - jnp.tanh(values["dry"] * qvel))
        return qvel, qvel

    last, path = jax.lax.scan(step, state["qvel"], state["ctrl"])
    return {"path": path, "fast": jnp.abs(last) > 0.5, "steps": jnp.arange(steps.shape[0])}


def arguments(dtype: torch.dtype) -> tuple:
    generator = torch.Generator().manual_seed(0)
    values = {
        "damping": torch.tensor([0.3, 0.4], dtype=dtype, requires_grad=True),
        "dry": torch.tensor([2.0, 1.0], dtype=dtype, requires_grad=True),
    }
    ctrl = torch.randn(10, 4, dtype=dtype, generator=generator)
    qvel = torch.randn(2, dtype=dtype, generator=generator).requires_grad_()
    return values, {"qvel": qvel, "ctrl": ctrl[:, ::2]}, np.arange(10)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_state_crosses_and_comes_back(dtype):
    source, target = (NeuralFriction(nv=1, hidden=[3, 5], seed=seed) for seed in (0, 1))
    with jax.enable_x64(dtype == "float64"):
        arrays = to_jax(source, jnp.dtype(dtype))
        load_from_jax(target, arrays)
    assert {str(array.dtype) for array in arrays.values()} == {dtype}
    for name, tensor in source.state_dict().items():
        back = target.state_dict()[name]
        assert back.dtype == torch.float64
        assert torch.equal(back, tensor.to(getattr(torch, dtype)).double())


def test_torch_and_jax_share_no_memory():
    weight, module, array = torch.nn.Parameter(torch.ones(1000)), torch.nn.Linear(3, 2), jnp.ones((2, 3))
    crossed, own = to_jax({"weight": weight}, jnp.float32)["weight"], module.weight
    weight.grad = torch.ones_like(weight)
    torch.optim.SGD([weight], lr=1.0).step()
    assert weight.detach().max() == 0.0 and np.array_equal(np.asarray(crossed), np.ones(1000))
    load_from_jax(module, {"weight": array})
    assert module.weight is own and own.requires_grad and torch.equal(own.detach(), torch.ones(2, 3))
    with torch.no_grad():
        module.weight.mul_(5.0)
    assert np.array_equal(np.asarray(array), np.ones((2, 3)))


def test_any_layout_crosses():
    strided, expanded = torch.arange(12.0).reshape(3, 4)[:, ::2], torch.arange(3.0).expand(4, 3)
    for tensor in (strided, expanded, torch.tensor(2.0), torch.zeros(0, 3), torch.tensor([3], dtype=torch.int32)):
        array = np.asarray(to_jax({"x": tensor}, jnp.float32)["x"])
        assert np.array_equal(array, tensor.numpy()) and array.dtype == tensor.numpy().dtype


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"wieght": jnp.zeros((2, 2))}, "wieght: not in the state of Linear; did you mean weight?"),
        ({"bias": jnp.ones(2), "weight": jnp.ones((2, 3))}, r"weight: shape \(2, 3\), expected \(2, 2\)"),
    ],
    ids=["name", "shape"],
)
def test_what_does_not_fit_is_refused_and_nothing_written(arrays, message):
    module = torch.nn.Linear(2, 2)
    before = {name: tensor.clone() for name, tensor in module.state_dict().items()}
    with pytest.raises(ModelError, match=message):
        load_from_jax(module, arrays)
    assert all(torch.equal(before[name], tensor) for name, tensor in module.state_dict().items())


def test_float64_needs_x64():
    with jax.enable_x64(False), pytest.raises(ConfigError, match="dtype=float64: JAX computes in 32 bits"):
        to_jax({"x": torch.zeros(1)}, jnp.float64)


def test_torch_function_passes_gradcheck():
    values, state, steps = arguments(torch.float64)
    rollout = as_torch_function(decay)

    def path(damping, dry, qvel, ctrl):
        return rollout({"damping": damping, "dry": dry}, {"qvel": qvel, "ctrl": ctrl}, steps)["path"]

    inputs = (values["damping"], values["dry"], state["qvel"], state["ctrl"].detach().requires_grad_())
    assert not inputs[3].is_contiguous()
    assert torch.autograd.gradcheck(path, inputs, atol=1e-7)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-6), (torch.float64, 1e-14)])
def test_torch_function_equals_the_jax_function(dtype, tolerance):
    values, state, steps = arguments(dtype)
    outputs = as_torch_function(decay)(values, state, steps)
    outputs["path"].square().sum().backward()
    numpy_values = {name: value.detach().double().numpy() for name, value in values.items()}
    numpy_state = {name: value.detach().double().numpy() for name, value in state.items()}
    with jax.enable_x64(True):
        squares = jax.value_and_grad(lambda v: jnp.square(decay(v, numpy_state, steps)["path"]).sum())
        expected, gradient = squares({name: jnp.asarray(value) for name, value in numpy_values.items()})
    assert outputs["path"].dtype == dtype and values["damping"].grad.dtype == dtype
    # Rounding of ten steps in this precision.
    assert outputs["path"].detach().square().sum().item() == pytest.approx(float(expected), rel=10 * tolerance)
    for name, value in values.items():
        assert np.allclose(value.grad.numpy(), np.asarray(gradient[name]), rtol=10 * tolerance, atol=10 * tolerance)


def test_outputs_without_a_gradient():
    outputs = as_torch_function(decay)(*arguments(torch.float32))
    assert outputs["fast"].dtype == torch.bool and not outputs["fast"].requires_grad
    assert outputs["path"].requires_grad
    assert outputs["steps"].tolist() == list(range(10))
    with torch.no_grad():
        assert not as_torch_function(decay)(*arguments(torch.float32))["path"].requires_grad


def test_what_changes_between_forward_and_backward_does_not_change_the_gradient():
    weight = torch.nn.Parameter(torch.full((1000,), 3.0))
    same, square = as_torch_function(lambda x: (x, x * x))(weight)
    same.detach().zero_()
    with torch.no_grad():
        weight.zero_()
    square.sum().backward()
    assert torch.equal(weight.grad, torch.full((1000,), 6.0))
