"""Every friction law of this package, with the values of its class for a bench."""

import math
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from conftest import ROOT, check_each, compose_once
from helpers.laws import friction
from omegaconf import OmegaConf

from frictionzoo.bench.base import DEFAULTS
from frictionzoo.core.build import build
from frictionzoo.core.config import compose_config, list_choices
from frictionzoo.core.declared import section_of
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.core.units import UNITS
from frictionzoo.models import FrictionModel, NeuralFriction, get_model, model_names
from frictionzoo.models.base import sliding_torque
from frictionzoo.models.by_name import complete_laws
from frictionzoo.models.contract import check_model
from frictionzoo.models.network import NetworkModel

CONF = ROOT / "conf"
OURS = [name for name in model_names() if get_model(name).__module__.startswith("frictionzoo.")]
NETWORKS = [name for name in OURS if issubclass(get_model(name), NetworkModel)]
ANALYTIC = [name for name in OURS if get_model(name).dimensions and name not in NETWORKS]
BENCHES = sorted(path.stem for path in (CONF / "bench").glob("*.yaml"))


@cache
def resolved(name: str, bench: str) -> Any:
    """A law's section for a bench; it follows from the bench's scale and the seed alone."""
    law, config = OmegaConf.to_container(compose_once(f"model={name}").model), compose_once(f"bench={bench}")
    whole = OmegaConf.create({"scale": config.scale, "seed": config.seed, "model": law})
    return complete_laws(OmegaConf.to_container(whole.model, resolve=True), {"scale": config.scale})


def make_law(name: str, nv: int = 1, bench: str = "knee") -> FrictionModel:
    """Builds a law as a configuration does."""
    return build(resolved(name, bench), nv=nv)


def random_state(*shape: int, seed: int = 0) -> DriveState:
    return DriveState(*np.random.default_rng(seed).standard_normal((len(DriveState._fields), *shape)))


def in_torch(state: DriveState) -> DriveState:
    return state.map(torch.tensor)


def anywhere_in_bounds(model: FrictionModel, seed: int) -> dict[str, torch.Tensor]:
    """The model's values, the bounded ones drawn between their bounds."""
    generator = np.random.default_rng(seed)
    values = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    for name, param in model.params.items():
        low, high = (param.to_coordinate(bound, np) for bound in (param.low, param.high))
        values[name] = torch.tensor(param.from_coordinate(generator.uniform(low, high, len(values[name])), np))
    return values


def total(terms: FrictionTerms):
    """One number that depends on every entry of every term."""
    return sum(((1 + index) * term).sin().sum() for index, term in enumerate(terms) if term is not None)


def test_every_choice_is_a_law_whose_options_are_those_of_its_class():
    """The command line reads them from the class's file."""
    assert {*list_choices("model")} == {*OURS, "mujoco_grid_search"}
    for name in [name for name in OURS if name != "by_joint"]:  # whose file has its option
        read = OmegaConf.to_container(compose_once(f"model={name}").model, resolve=False)
        declared = OmegaConf.to_container(OmegaConf.create(section_of(get_model(name))))
        assert read | {"_target_": ""} == declared | {"_target_": ""}, name


@pytest.mark.parametrize("name", OURS)
def test_law_keeps_the_contract(name):
    law = make_law(name, nv=2)
    assert type(law) is get_model(name)
    check_model(law)


@pytest.mark.parametrize("name", OURS)
def test_law_suits_the_scale_of_a_bench(name):
    check_each(check_scale, [(name, bench) for bench in BENCHES])


def check_scale(name, bench):
    model, config = make_law(name, bench=bench), compose_once(f"bench={bench}")
    assert set(model.params) == set(get_model(name).dimensions) or name == "by_joint"  # whose are its laws'
    for param in model.params.values():
        assert param.low < param.init < param.high
        # A share and what changes with the temperature may have either sign.
        assert param.low > 0 or param.dimension in ("1", "temperature", "1/temperature")
        assert all(param.unit(joint_type) in UNITS[joint_type].values() for joint_type in ("hinge", "slide"))
    motion, scale = random_state(200, 1), config.scale
    model.prepare(motion._replace(qvel=scale.velocity * motion.qvel, motor_torque=scale.torque * motion.motor_torque))
    rest = DriveState(*(torch.zeros(1, dtype=torch.float64, requires_grad=True) for _ in DriveState._fields))
    torque = model(rest).torque
    if torque is not None and torque.requires_grad:
        (slope,) = torch.autograd.grad(torque, rest.qvel, materialize_grads=True)
        # An explicit torque of this slope chatters in semi-implicit Euler once the share reaches 2.
        share = slope.item() * 0.001 / (config.bench.params.armature.init or DEFAULTS["armature"]["init"])
        assert share < 1.0 or model.memory  # a factor 2 in hand, at 1 ms; a law with a memory is implicit


@pytest.mark.parametrize("name", [name for name in OURS if name != "baseline"])
def test_gradient_equals_central_differences(name):
    for seed in (0, 1):
        model, state = make_law(name, 2), random_state(3, 2, seed=seed)
        model.prepare(state)
        values = anywhere_in_bounds(model, seed)
        names = [key for key, _ in model.named_parameters()]

        def law(*inputs, model=model, values=values, names=names):
            given = {**values, **dict(zip(names, inputs, strict=False))}
            drive = DriveState(*inputs[len(names) :])
            if not model.memory or name == "backlash":  # whose corners are sharper than a difference; see its own tests
                return total(model.terms(torch, given, drive))
            memory = model.settle(torch, given, drive)
            turned = drive._replace(qvel=0.1 - drive.qvel, motor_torque=-0.5 * drive.motor_torque)
            terms, memory = model.advance(torch, given, turned, memory, 1e-3)
            return total(model.terms(torch, given, drive)) + total(terms) + memory.sin().sum()

        inputs = [values[key].detach().clone().requires_grad_() for key in names]
        inputs += [signal.requires_grad_() for signal in in_torch(state)]
        # The smooth sign is steepest here; a ReLU may have a kink here, and the damping of a direction jumps.
        if name in ANALYTIC and name != "asymmetric":
            inputs[len(names) + 1].data[0] = 0.0
        # fast_mode compares along one random direction, of the thousands that a network has.
        assert torch.autograd.gradcheck(law, inputs, eps=1e-7, rtol=1e-4, fast_mode=name not in ANALYTIC)


@pytest.mark.parametrize("name", [name for name in OURS if get_model(name).dissipative and name != "baseline"])
def test_friction_opposes_motion_anywhere_in_bounds(name):
    check_each(check_opposes, [(name, bench) for bench in BENCHES])


def check_opposes(name, bench):
    """Strictly; each of the joints has other values."""
    model, state = make_law(name, 200, bench), random_state(20, 200)
    values, drive = anywhere_in_bounds(model, 0), in_torch(state)
    terms = model.terms(torch, values, drive)
    assert (sliding_torque(torch, terms, drive.qvel) * drive.qvel > 0).all()
    for term in (terms.frictionloss, terms.damping):
        assert term is None or (term > 0).all()
    rest = model.terms(torch, values, drive._replace(qvel=torch.zeros_like(drive.qvel)))
    if rest.torque is not None:
        assert (rest.torque.abs() <= (0.0 if rest.frictionloss is None else rest.frictionloss)).all()


BELL, TANH, LATE = 0.36787944117144233, 0.46211715726000975, 0.76159415595576489  # exp(-1), tanh(0.5), tanh(1)
FALLS = {"frictionloss": 0.3, "damping": 0.07, "stribeck_torque": 0.2, "stribeck_velocity": 0.1}
SIDES = {
    **{"load_friction_motor": 0.1, "load_friction_external": 0.3},
    **{"stribeck_load_friction_motor": 0.05, "stribeck_load_friction_external": 0.02},
}
SQUARES = {"quadratic_load_friction_motor": 0.07, "quadratic_load_friction_external": 0.11}
SHARES = [1.0, 0.36787944117144233, 0.059105746561956225, 0.0]  # exp(-|v / 0.1|^1.5) at v of SPEEDS
SPEEDS = [0.0, 0.1, -0.2, 3.0]
FALLS_15 = FALLS | {"stribeck_exponent": 1.5}
LOADED = {"load_friction": 0.1}


def limits(always: float, at_rest: float = 0.2) -> list[float]:
    return [always + at_rest * share for share in SHARES]


STRIBECK = [0.0, 0.3 + 0.2 * BELL + 0.02, -(0.3 + 0.2 * 0.018315638888734179 + 0.04), 0.3 + 0.6]
STRIBECK.append((0.3 + 0.2 * 0.99004983374916811) * LATE + 0.002)
# Law, speeds, torque of the motor and from outside, values; torque, frictionloss and damping.
KNOWN_VALUES = [
    ("baseline", [1.0, -2.0], (0, 0), {}, (None, None, None)),
    ("mujoco_default", [1.0], (0, 0), {"frictionloss": 0.3, "damping": 0.07}, (None, [0.3], 0.07)),
    (  # tanh(10 v smoothing); tanh(10) is 1 but for 4e-9
        *("coulomb_smooth", [0.0, 0.1, -2.0], (0, 0)),
        {"static_torque": 0.4, "smoothing": 0.5, "viscous_coefficient": 0.2},
        ([0.0, 0.4 * TANH + 0.02, -0.8], None, None),
    ),
    (
        *("coulomb_stribeck", [0.0, 0.1, -0.2, 3.0, 0.01], (0, 0)),
        {"static_torque": 0.5, "kinetic_torque": 0.3, "stribeck_velocity": 0.1, "smoothing_velocity": 0.01}
        | {"viscous_coefficient": 0.2},  # exp(-4) = 0.018315638888734179, exp(-0.01) = 0.99004983374916811
        (STRIBECK, None, None),
    ),
    # The share at rest is exp(-1e-9) with this exponent.
    *(("stribeck", SPEEDS, torques, FALLS_15, (None, limits(0.3), 0.07)) for torques in ((2.0, -0.5), (0, 0))),
    # Holding a weight loads the gear; a weight that pulls with the motor does not.
    *(
        ("load_dependent", [0.0, 5.0], torques, FALLS_15 | LOADED, (None, [0.3 + 0.1 * load] * 2, 0.07))
        for torques, load in (((2.0, -2.0), 4.0), ((2.0, 2.0), 0.0), ((0.0, -3.0), 3.0), ((-1.0, 0.5), 1.5))
    ),
    (  # The load is 3.
        *("stribeck_load_dependent", SPEEDS, (2.0, -1.0), FALLS_15 | LOADED | {"stribeck_load_friction": 0.05}),
        (None, limits(0.3 + 0.3, 0.2 + 0.15), 0.07),
    ),
    *(
        (law, SPEEDS, torques, FALLS_15 | SIDES | more, (None, limits(0.3 + always, 0.2 + at_rest + add), 0.07))
        for torques, always, at_rest, squared in (
            ((2.0, -1.0), 0.2 + 0.3, 0.1 + 0.02, 0.11 * 1.0),  # the motor drives
            ((-1.0, 2.0), 0.1 + 0.6, 0.05 + 0.04, 0.07 * 1.0),  # it is driven
            ((3.0, 1.0), 0.3 - 0.3, 0.15 - 0.02, 0.0),  # both push the same way
            ((-1.0, -3.0), 0.9 - 0.1, 0.06 - 0.05, 0.0),
        )
        for law, more, add in (("directional", {}, 0.0), ("quadratic", SQUARES, squared))
    ),
]


def test_known_values() -> None:
    def check(name: str, speeds: list[float], torques: tuple, values: dict, expected: tuple) -> None:
        for term, wanted in zip(friction(make_law(name), speeds, *torques, **values), expected, strict=True):
            assert (term is None) == (wanted is None)
            if term is not None:
                np.testing.assert_allclose(term.flatten(), wanted, atol=1e-8 if "coulomb" in name else 1e-9, rtol=0)

    check_each(check, KNOWN_VALUES)


def test_a_stribeck_law_stays_finite_at_any_speed():
    """Also in float32, where (v / v_s)^10 overflows."""
    model = make_law("stribeck").float()
    zero, qvel = torch.zeros(3, 1), torch.tensor([[1e3], [-1e5], [1e-20]], requires_grad=True)
    with torch.no_grad():
        model.stribeck_exponent.fill_(10.0)
    model(DriveState(zero, qvel, zero, zero, zero)).frictionloss.sum().backward()
    assert torch.isfinite(qvel.grad).all()
    assert all(torch.isfinite(value.grad).all() for value in model.parameters() if value.grad is not None)


@pytest.mark.parametrize("speed", [0.05, -0.1, 0.4])
def test_laws_that_remember_slide_at_their_limit_under_load(speed):
    """At constant velocity, under a motor's torque of 2 against 1 from outside."""
    bell, sign = math.exp(-((speed / 0.1) ** 2)), math.copysign(1, speed)
    share = 0.3 if speed > 0 else 0.1
    limits = {
        "dahl_load_dependent": 0.3 + 0.1 * 3,
        "lugre_load_dependent": 0.3 + 0.1 * 3 + (0.2 + 0.05 * 3) * bell,
        "torque_proportional": 0.3 + share * 2,
    }
    values = {
        **{"coulomb_torque": 0.3, "kinetic_torque": 0.3, "static_torque": 0.5, "stribeck_velocity": 0.1},
        **{"load_friction": 0.1, "stribeck_load_friction": 0.05},
        **{"load_friction_driving": 0.3, "load_friction_braking": 0.1},
        **{"viscous_coefficient": 0.07, "rest_velocity": 1e-3},
    }
    for name, limit in limits.items():
        terms = friction(make_law(name), [speed], 2.0, -1.0, **values)
        slid = terms.torque.item() + terms.damping.item() * speed
        assert slid == pytest.approx(sign * limit + 0.07 * speed, rel=1e-12)


@pytest.mark.parametrize(
    ("larger", "smaller", "values"),
    [
        ("stribeck", "mujoco_default", {"stribeck_torque": 0.0}),
        ("load_dependent", "mujoco_default", {"load_friction": 0.0}),
        ("stribeck_load_dependent", "stribeck", {"load_friction": 0.0, "stribeck_load_friction": 0.0}),
        ("stribeck_load_dependent", "load_dependent", {"stribeck_torque": 0.0, "stribeck_load_friction": 0.0}),
        (
            "directional",
            "stribeck_load_dependent",
            {
                **{"load_friction_motor": 0.1, "load_friction_external": 0.1},
                **{"stribeck_load_friction_motor": 0.05, "stribeck_load_friction_external": 0.05},
            },
        ),
        ("quadratic", "directional", dict.fromkeys(SQUARES, 0.0)),
    ],
)
def test_a_larger_law_holds_the_smaller(larger, smaller, values):
    general, special, state = make_law(larger), make_law(smaller), random_state(200, 1)
    common = {"load_friction": 0.1, "stribeck_load_friction": 0.05}
    terms = []
    for model, own in ((special, {}), (general, values)):
        chosen = {name: param.init for name, param in model.params.items()} | common | own
        given = {name: torch.tensor([value], dtype=torch.float64) for name, value in chosen.items()}
        terms.append(model.terms(torch, given, in_torch(state)))
    ours, theirs = (torch.broadcast_to(term.frictionloss, (200, 1)) for term in terms)
    # Rounding: the larger law adds more terms.
    torch.testing.assert_close(ours, theirs, rtol=1e-14, atol=0.0)
    assert torch.equal(terms[0].damping, terms[1].damping)


def test_neural_friction_known_values():
    model = NeuralFriction(nv=1, hidden=[2], seed=0)
    model.load_state_dict(
        {
            "layers.0.weight": torch.tensor([[1.0, 0.0, 2.0, 0.0], [0.0, -1.0, 0.0, 1.0]]),
            "layers.0.bias": torch.tensor([0.5, 0.0]),
            "layers.1.weight": torch.tensor([[2.0, 3.0]]),
            "layers.1.bias": torch.tensor([-1.0]),
            "input_mean": torch.tensor([1.0, 0.0, 0.0, 2.0]),
            "input_std": torch.tensor([2.0, 1.0, 0.5, 4.0]),
            "torque_scale": torch.tensor(10.0),
        }
    )
    signals = {"qpos": 2.0, "qvel": 1.0, "ctrl": 0.25, "motor_torque": 99.0, "external_torque": 4.0}
    state = DriveState(**{name: torch.tensor([value], dtype=torch.float64) for name, value in signals.items()})
    # x = (0.5, 1, 0.5, 0.5); layer 0 = (0.5 + 1 + 0.5, relu(-1 + 0.5)) = (2, 0); layer 1 = 4 - 1
    assert model(state).torque.item() == pytest.approx(30.0)


def test_a_law_takes_values_that_are_known_as_plain_numbers():
    law = get_model("coulomb_smooth")(1, {"static_torque": 0.5, "smoothing": 10, "viscous_coefficient": 0})
    assert [float(value) for value in law.parameters()] == [0.5, 10.0, 0.0]
    assert not any(param.identify for param in law.params.values())


def test_neural_friction_depends_on_its_seed_alone():
    torch.manual_seed(1)
    before = torch.get_rng_state()
    first = NeuralFriction(nv=1, hidden=[8], seed=3)
    assert torch.equal(before, torch.get_rng_state())
    torch.manual_seed(2)
    again, other = NeuralFriction(nv=1, hidden=[8], seed=3), NeuralFriction(nv=1, hidden=[8], seed=4)
    for name, weights in first.named_parameters():
        assert torch.equal(weights, again.get_parameter(name))
        assert not torch.equal(weights, other.get_parameter(name))


def test_neural_friction_takes_its_normalisation_from_the_data():
    state = random_state(1000, 2)
    state = state._replace(
        qpos=5.0 + 3.0 * state.qpos, external_torque=np.full((1000, 2), 0.7), motor_torque=7 * state.qpos
    )
    model = NeuralFriction(nv=2, hidden=[4], seed=0)
    model.prepare(state)
    expected = [np.mean(signal) for signal in (state.qpos, state.qvel, state.ctrl, state.external_torque)]
    assert model.input_mean.tolist() == pytest.approx(expected)
    assert model.input_std[0].item() == pytest.approx(np.std(state.qpos))
    assert model.input_std[3].item() == 1.0  # a constant input, whose deviation is nothing but rounding
    assert model.torque_scale.item() == pytest.approx(np.std(state.motor_torque))


def test_neural_friction_without_actuation_stays_finite():
    model = NeuralFriction(nv=1, hidden=[4], seed=0)
    model.prepare(DriveState(*np.zeros((5, 10, 1))))
    assert torch.isfinite(model(in_torch(random_state(10, 1))).torque).all()


def test_neural_friction_shares_its_weights_over_joints():
    model, state = NeuralFriction(nv=3, hidden=[4], seed=0), random_state(10, 3)
    swapped = state.map(lambda signal: signal[:, ::-1].copy())
    assert torch.equal(model(in_torch(state)).torque.flip(-1), model(in_torch(swapped)).torque)


def test_neural_friction_lets_nan_through():
    model = NeuralFriction(nv=1, hidden=[4], seed=0)
    state = in_torch(random_state(1))
    assert torch.isnan(model(state._replace(qvel=torch.full((1,), torch.nan, dtype=torch.float64))).torque).all()


@pytest.mark.parametrize("bench", BENCHES)
def test_grid_search_is_the_default_law_with_the_papers_bounds(bench):
    config = compose_config("model=mujoco_grid_search", f"bench={bench}")
    params = {**config.model.params, "armature": config.bench.params.armature}
    scales = {"frictionloss": config.scale.torque, "damping": config.scale.damping, "armature": config.scale.inertia}
    for name, scale in scales.items():
        assert (params[name].low, params[name].high) == pytest.approx((0.001 * scale, 0.3 * scale))
        assert params[name].identify and params[name].scale == pytest.approx(scale)
    assert config.fit._target_ == "frictionzoo.fit.Grid"
    assert config.model._target_ == compose_once("model=mujoco_default").model._target_


def test_grid_search_can_be_overridden():
    config = compose_config("model=mujoco_grid_search", "fit=adam", "model.params.damping.high=0.5")
    assert (config.fit._target_, config.model.params.damping.high) == ("frictionzoo.fit.Adam", 0.5)


def test_a_network_without_width_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"model\.hidden=\[4, 0\]; expected widths of at least 1"):
        NeuralFriction(1, [4, 0], 0)
