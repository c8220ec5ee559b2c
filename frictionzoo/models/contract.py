"""The contract of all friction models, as one call for tests of a model."""

import copy
import textwrap
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NoReturn

import jax
import jax.numpy as jnp
import numpy as np
import safetensors.torch
import torch

from frictionzoo.core.errors import ModelError, closest
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.core.units import UNITS
from frictionzoo.models.base import FrictionModel, TorchFriction, Values, sliding_torque
from frictionzoo.models.contained import check_contained
from frictionzoo.models.formula import (
    Formula,
    as_numpy,
    draw_values,
    jax_slopes,
    numpy_terms,
    torch_slopes,
    torch_state,
    torch_values,
)
from frictionzoo.models.registry import REGISTRY
from frictionzoo.models.sees import SEES, is_curved, observe

TOLERANCE = 1e-12  # torch against JAX in float64: relative to the largest entry of an array, absolute below 1
SAMPLES = 64
TIMESTEP = 1e-3  # s
INPUT_SPREAD = 20.0  # of drawn inputs about their default; degC for a temperature
NOWHERE = "where all is 0"
SETTLED = 1e-6  # largest relative change of a settled memory in a step


def check_model(model: FrictionModel, samples: DriveState | None = None) -> None:
    """Check that a friction model keeps the contract of `FrictionModel`, without changing the model.

    The clauses, in this order:

    1. The model is registered under its name, its dimensions have units, its inputs are signals of `DriveState`, and
       its values are within bounds.
    2. `terms` returns terms of the right type and shape. It is pure, deterministic, reads `values` only, works under
       `jax.jit`, and keeps the floating-point type.
    3. Torch and JAX agree in value and gradient. Gradients are finite, also at standstill.
    4. A model with memory keeps the memory's shape, agrees in torch and JAX over a step, has finite gradients, and its
       memory settles.
    5. A saved state is complete.
    6. A `dissipative` model adds no energy to the drive, with its values and with others between their bounds: the sum
       of its terms opposes the motion, at standstill its torque is within its frictionloss, and no damping is negative.
    7. Its sliding friction equals each nested model's, with the values in `contains`.
    8. If `sees` is not empty, it is complete and correct.

    A torch-only model keeps the same contract in torch. It has no memory, and its terms in one state do not depend on
    the other states of a batch.

    Args:
        model: An instance of the model.
        samples: States to check, numpy arrays of shape (samples, nv); by default drawn with a fixed seed, of order 1
            with some at standstill. They also are the training data for `prepare`.

    Raises:
        ModelError: A clause is broken; the message names it.
    """
    if not isinstance(model, FrictionModel):
        kind = type(model).__name__
        raise ModelError(f"{kind}: not a FrictionModel; derive it from frictionzoo.models.FrictionModel")
    _check_declared(model)
    _check_bounds(model)
    samples = _draw_samples(model) if samples is None else samples
    prepared = copy.deepcopy(model)
    prepared.prepare(samples)
    _check_bounds(prepared)
    with jax.enable_x64(True):
        _check_terms(prepared, samples)
        _check_purity(prepared, samples)
        _check_types(prepared, samples)
        _check_agreement(prepared, samples)
        _check_memory(prepared, samples)
    _check_rows(prepared, samples)
    _check_saved_state(model, prepared, samples)
    _check_dissipation(prepared, samples)
    check_contained(prepared, samples)
    _check_sees(prepared, samples)


def _fail(model: FrictionModel, clause: str, message: str, cause: Exception | None = None) -> NoReturn:
    raise ModelError(f"{getattr(type(model), 'name', type(model).__name__)}: {clause}: {message}") from cause


def _check_declared(model: FrictionModel) -> None:
    cls = type(model)
    if REGISTRY.entries.get(vars(cls).get("name", "")) is not cls:
        _fail(model, "name", f"class {cls.__qualname__} is not registered; decorate it @register_model(NAME)")
    for name, dimension in model.dimensions.items():
        for joint, units in UNITS.items():
            if dimension not in units:
                _fail(model, "units", f"{name} has dimension {dimension} on a {joint}; {closest(dimension, units)}")
    recorded = tuple(DriveState._field_defaults)
    for name, value in model.inputs.items():
        if name not in recorded:
            _fail(model, "inputs", f"{name} is not a recorded signal of DriveState; {closest(name, recorded)}")
        if not np.isfinite(value):
            _fail(model, "inputs", f"{name} is {value} where recordings lack it; give a finite number")


def _check_bounds(model: FrictionModel) -> None:
    for name, tensor in model.state_dict().items():
        if not torch.isfinite(tensor).all():
            _fail(model, "values", f"{name} is NaN or infinite; give finite values in the constructor and in prepare")
    parameters = dict(model.named_parameters())
    for name, param in model.params.items():
        members = param.members(model.nv)
        if name not in parameters or tuple(parameters[name].shape) != (len(members),):
            shape = f"({len(members)},)"
            _fail(model, "values", f"{name} is not a parameter of shape {shape}; leave it to FrictionModel.__init__")
        value = parameters[name].detach()
        low, high = (torch.tensor(param.each(side, model.nv)[members]) for side in ("low", "high"))
        if not ((value >= low) & (value <= high)).all():
            bounds = f"[{float(low.min()):g}, {float(high.max()):g}]"
            _fail(model, "bounds", f"{name}={value.tolist()} outside {bounds}; start inside")


def _check_terms(model: FrictionModel, samples: DriveState) -> None:
    for batch in ((), (3,), (2, 3), samples.qvel.shape[:-1]):
        state = samples.map(lambda signal, shape=(*batch, model.nv): np.resize(signal, shape))
        terms = _torch_terms(model, state)
        _check_kinds(model, terms, "torch", torch.Tensor, batch)
        if terms.frictionloss is not None:
            limits = terms.frictionloss.broadcast_to(*batch, model.nv)[..., list(model.constrained)]
            if not bool((limits > 0).all()):
                message = "is 0 or negative somewhere, where MuJoCo locks the joint; keep it above 0"
                _fail(model, "frictionloss", message)
        if not isinstance(model, TorchFriction):
            _check_kinds(model, _jax_terms(model, state), "jax.numpy", jax.ShapeDtypeStruct, batch)


def _check_kinds(model: FrictionModel, terms: Any, namespace: str, kind: type, batch: tuple[int, ...]) -> None:
    if not isinstance(terms, FrictionTerms):
        _fail(model, "terms", f"gives {type(terms).__name__} over {namespace}; return FrictionTerms")
    if model.constraint and terms.frictionloss is None:
        _fail(model, "constraint", "is declared and frictionloss is None; return it or set constraint = False")
    if not model.constraint and terms.frictionloss is not None:
        _fail(model, "constraint", "is not declared and frictionloss is given; set constraint = True")
    for name, term in terms.given().items():
        if not isinstance(term, kind):
            _fail(model, "terms", f"{name} is a {type(term).__name__} over {namespace}; compute it with xp from values")
        _check_shape(model, f"{name} over {namespace}", tuple(term.shape), (*batch, model.nv))


def _check_shape(model: FrictionModel, what: str, shape: tuple[int, ...], expected: tuple[int, ...]) -> None:
    try:
        fits = np.broadcast_shapes(shape, expected) == expected
    except ValueError:
        fits = False
    if not fits:
        _fail(model, "shape", f"{what} is {shape}, expected {expected} or what broadcasts to it; keep (..., nv)")


def _check_purity(model: FrictionModel, samples: DriveState) -> None:
    """Check that equal inputs give equal bits, nothing is written, and numbers come from `values`."""
    values, state = torch_values(model), torch_state(samples)
    kept_values, kept_state = copy.deepcopy((values, state))
    terms = model.terms(torch, values, state).given()
    if not _equal(terms, model.terms(torch, values, state).given()):
        _fail(model, "deterministic", "two calls with the same inputs differ; use no random numbers in terms")
    unwritten = _equal(kept_values, values) and _equal(kept_state.given(), state.given())
    if not unwritten or not _equal(kept_values, torch_values(model)):
        _fail(model, "pure", "terms writes into values, state or the module; return new arrays instead")
    if not _equal(terms, _changed(model).terms(torch, values, state).given()):
        _fail(model, "pure", "terms reads a parameter or buffer from the module; read it from values")


def _check_types(model: FrictionModel, samples: DriveState) -> None:
    """Check float32 out for float32 in: a constant of another type would break a compiled rollout."""
    answers = {"torch": model.terms(torch, torch_values(model, torch.float32), torch_state(samples, torch.float32))}
    if not isinstance(model, TorchFriction):
        answers["jax.numpy"] = _jax_terms(model, samples, jnp.float32)
    for namespace, terms in answers.items():
        for name, term in terms.given().items():
            if not str(term.dtype).endswith("float32"):
                _fail(model, "type", f"{name} is {term.dtype} of float32 inputs over {namespace}; use Python constants")


def _check_agreement(model: FrictionModel, samples: DriveState) -> None:
    """Check that torch equals JAX in value and gradient, and gradients are finite, also at standstill."""

    def terms(xp: Any, values: Values, drive: DriveState) -> dict[str, Any]:
        return model.terms(xp, values, drive).given()

    for where, ours, theirs in _check_formula(model, samples, terms, "value", ("gradient", "")):
        if theirs and where != NOWHERE:  # torch and JAX differ in the slope of |x| there
            _compare(model, f"gradient {where}", ours, theirs)


def _check_memory(model: FrictionModel, samples: DriveState) -> None:
    """Check a step of a model with memory from the settled memory; settled in motion, it must not change."""
    if not model.memory:
        return
    if isinstance(model, TorchFriction):
        _fail(model, "memory", "a law that exists only in torch has none; derive it from FrictionModel")
    shape = (*samples.qvel.shape, model.memory)

    def step(method: str, xp: Any, values: Values, drive: DriveState) -> dict[str, Any]:
        memory = model.settle(xp, values, drive)
        terms, after = getattr(model, method)(xp, values, drive, memory, TIMESTEP)
        for name, array in (("settled memory", memory), ("memory", after)):
            _check_shape(model, name, tuple(array.shape), shape)
        return {**terms.given(), "settled memory": memory, "memory": after}

    overridden = type(model).advance_midway is not FrictionModel.advance_midway
    for method in ("advance", *["advance_midway"] * overridden):
        _check_formula(model, samples, partial(step, method), "a step", ("memory", "gradient "))
    fast = torch_state(samples._replace(qvel=np.sign(samples.qvel) + (samples.qvel == 0)))
    settled = model.settle(torch, torch_values(model), fast)
    after = model.advance(torch, torch_values(model), fast, settled, TIMESTEP)[1]
    change = float((after - settled).abs().max() / settled.abs().max())
    if not change <= SETTLED:
        _fail(model, "memory", f"in steady motion it still changes by {change:.3g} of its value in a step; see settle")


def _check_formula(
    model: FrictionModel, samples: DriveState, formula: Formula, what: str, gradient: tuple[str, str]
) -> list[tuple[str, dict[str, np.ndarray], dict[str, np.ndarray]]]:
    """Check values and gradients; return the gradients of torch, and of JAX (empty for a torch-only model)."""
    standstill = samples._replace(qvel=np.zeros_like(samples.qvel))
    places = {"on the samples": samples, "at qvel = 0": standstill, NOWHERE: samples.map(np.zeros_like)}
    random, shape = np.random.default_rng(0), samples.qvel.shape
    weights = {name: random.standard_normal(shape) for name in FrictionTerms._fields}
    weights |= {name: random.standard_normal((*shape, model.memory)) for name in ("settled memory", "memory")}
    torch_only, gradients = isinstance(model, TorchFriction), []
    in_jax = None if torch_only else jax_slopes(model, list(places.values()), formula, weights)
    for place, (where, state) in enumerate(places.items()):
        values, ours = torch_slopes(model, state, formula, weights)
        theirs = {}
        if in_jax is not None:
            their_values, theirs = ({name: part[place] for name, part in parts.items()} for parts in in_jax)
            _compare(model, f"{what} {where}", values, their_values)
        for name, slope in (*ours.items(), *theirs.items()):
            if not np.isfinite(slope).all():
                clause, start = gradient
                _fail(model, clause, f"{start}with respect to {name} is not finite {where}; smooth the law there")
        gradients.append((where, ours, theirs))
    return gradients


def _check_rows(model: FrictionModel, samples: DriveState) -> None:
    """Check that a torch model, called with all segments at once, treats each alone; in JAX `vmap` does."""
    if not isinstance(model, TorchFriction):
        return
    together = as_numpy(_torch_terms(model, samples).given())
    for row in (0, len(samples.qvel) - 1):
        alone = _torch_terms(model, samples.map(lambda signal, row=row: signal[row])).given()
        for name, term in as_numpy(alone).items():
            error = np.abs(term - np.broadcast_to(together[name], samples.qvel.shape)[row]).max()
            if not error <= TOLERANCE * max(1.0, np.abs(term).max()):
                _fail(model, "batch", f"{name} of one state changes by {error:.3g} with the others; compute it alone")


def _check_saved_state(fresh: FrictionModel, prepared: FrictionModel, samples: DriveState) -> None:
    loaded = _changed(fresh)
    try:
        state = safetensors.torch.load(safetensors.torch.save(prepared.state_dict()))
        loaded.load_state_dict(state)
    except (RuntimeError, ValueError) as error:
        message = f"does not go through safetensors and back ({_in_short(error)}); keep names and shapes fixed"
        _fail(fresh, "state_dict", message, error)
    if not _equal(_torch_terms(prepared, samples).given(), _torch_terms(loaded, samples).given()):
        _fail(fresh, "state_dict", "is not complete: loaded into a new instance it gives other terms; use buffers")


def _check_dissipation(model: FrictionModel, samples: DriveState) -> None:
    for values in draw_values(model) if model.dissipative else ():
        terms = numpy_terms(model, values, samples)
        power = sliding_torque(np, terms, samples.qvel) * samples.qvel
        if (power < 0).any():
            speed, advice = samples.qvel[power < 0][0], "oppose qvel, or remove dissipative"
            _fail(model, "dissipative", f"friction drives the joint at qvel={speed:.3g}; {advice}")
        torque, frictionloss, damping = (np.zeros(()) if term is None else term for term in terms)
        if ((np.abs(torque) > frictionloss) & (samples.qvel == 0)).any():
            advice = "keep it within frictionloss there, or remove dissipative"
            _fail(model, "dissipative", f"torque moves a joint at rest; {advice}")
        if (damping < 0).any():
            _fail(model, "dissipative", "damping is negative; keep it at 0 or above, or remove dissipative")


def _check_sees(model: FrictionModel, samples: DriveState) -> None:
    """Check that `sees`, if not empty, lists exactly the quantities on which the friction depends."""
    declared = {*model.sees}
    for name in declared - {*SEES}:
        _fail(model, "sees", f"{name} is not a known quantity; {closest(name, SEES)}")
    if not declared:
        return
    observed = observe(model, samples) | ({"fast"} if "fast" in declared and is_curved(model, samples) else set())
    if declared != observed:
        declared_names, observed_names = (", ".join(sorted(names)) or "nothing" for names in (declared, observed))
        _fail(model, "sees", f"it declares {declared_names}, but friction depends on {observed_names}; declare these")


def _draw_samples(model: FrictionModel) -> DriveState:
    """Draw states of order 1, of both signs and many magnitudes, some at standstill; other inputs vary widely."""
    random, shape = np.random.default_rng(0), (SAMPLES, model.nv)
    count = len(DriveState._fields) - len(DriveState._field_defaults)
    signals = random.standard_normal((count, *shape)) * random.choice([1e-3, 0.1, 1.0], SAMPLES)[:, None]
    others = {name: value + INPUT_SPREAD * random.standard_normal(shape) for name, value in model.inputs.items()}
    state = DriveState(*signals, **others)
    state.qvel[: SAMPLES // 8] = 0.0
    return state


def _equal(ours: Mapping[str, torch.Tensor], theirs: Mapping[str, torch.Tensor]) -> bool:
    return ours.keys() == theirs.keys() and all(torch.equal(ours[name], theirs[name]) for name in ours)


def _changed(model: FrictionModel) -> FrictionModel:
    """Return a copy in which every number differs."""
    changed = copy.deepcopy(model)
    for tensor in changed.state_dict().values():
        tensor.copy_(tensor * 2 + 1)
    return changed


def _torch_terms(model: FrictionModel, state: DriveState) -> Any:
    return _called(model, "torch", lambda: model.terms(torch, torch_values(model), torch_state(state)))


def _jax_terms(model: FrictionModel, state: DriveState, dtype: Any = jnp.float64) -> Any:
    """Return shape and type of the terms in a compiled rollout, without compiling."""

    def traced(array: np.ndarray) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(array.shape, dtype if np.issubdtype(array.dtype, np.floating) else array.dtype)

    values, drive = jax.tree.map(traced, (as_numpy(torch_values(model)), state))
    return _called(model, "jax.numpy", lambda: jax.eval_shape(partial(model.terms, jnp), values, drive))


def _called(model: FrictionModel, namespace: str, call: Callable[[], Any]) -> Any:
    """Return the result of a call, or fail with advice if the model raises."""
    try:
        return call()
    except jax.errors.ConcretizationTypeError as error:
        _fail(model, "pure", f"jax.jit cannot compile terms ({_in_short(error)}); use xp.where, not if", error)
    except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
        advice = "use values, declared inputs and what torch and jax.numpy share"
        _fail(model, "terms", f"fails over {namespace} ({_in_short(error)}); {advice}", error)


def _in_short(error: Exception) -> str:
    return textwrap.shorten(str(error), 160)


def _compare(model: FrictionModel, what: str, ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> None:
    if ours.keys() != theirs.keys():
        message = f"terms {sorted(ours)} in torch and {sorted(theirs)} in JAX; write one formula"
        _fail(model, "torch equals JAX", message)
    for name, array in ours.items():
        error = float(np.abs(array - theirs[name]).max(initial=0.0))
        if not error <= TOLERANCE * max(1.0, float(np.abs(array).max(initial=0.0))):
            _fail(model, "torch equals JAX", f"{what} of {name} differs by {error:.3g}; write one formula over xp")
