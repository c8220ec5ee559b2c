"""Every friction law of this package, with the values of its class for a bench."""

import math
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from conftest import ROOT, check_each
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

compose_once = cache(compose_config)


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


def test_baseline_has_no_friction():
    assert friction(make_law("baseline"), [1.0, -2.0]) == FrictionTerms(None, None, None)


def test_mujoco_default_hands_its_values_to_the_constraint():
    terms = friction(make_law("mujoco_default"), [1.0], frictionloss=0.3, damping=0.07)
    assert (terms.torque, terms.frictionloss.item(), terms.damping.item()) == (None, 0.3, 0.07)


def test_coulomb_smooth_known_values():
    terms = friction(
        make_law("coulomb_smooth"), [0.0, 0.1, -2.0], static_torque=0.4, smoothing=0.5, viscous_coefficient=0.2
    )
    # tanh(10 * 0.5 * 0.1) = tanh(0.5) = 0.46211715726000975; tanh(10) is 1 but for 4e-9
    assert terms.torque.flatten().tolist() == pytest.approx([0.0, 0.4 * 0.46211715726000975 + 0.02, -0.8], abs=1e-8)


def test_coulomb_stribeck_known_values():
    values = {"static_torque": 0.5, "kinetic_torque": 0.3, "stribeck_velocity": 0.1, "smoothing_velocity": 0.01}
    terms = friction(make_law("coulomb_stribeck"), [0.0, 0.1, -0.2, 3.0, 0.01], viscous_coefficient=0.2, **values)
    # exp(-1) = 0.36787944117144233, exp(-4) = 0.018315638888734179, exp(-0.01) = 0.99004983374916811,
    # tanh(1) = 0.76159415595576489; tanh(10) is 1 but for 4e-9
    expected = [
        0.0,
        0.3 + 0.2 * 0.36787944117144233 + 0.02,
        -(0.3 + 0.2 * 0.018315638888734179 + 0.04),
        0.3 + 0.6,
        (0.3 + 0.2 * 0.99004983374916811) * 0.76159415595576489 + 0.002,
    ]
    assert terms.torque.flatten().tolist() == pytest.approx(expected, abs=1e-8)


FALLS = {"frictionloss": 0.3, "damping": 0.07, "stribeck_torque": 0.2, "stribeck_velocity": 0.1}
SIDES = {
    **{"load_friction_motor": 0.1, "load_friction_external": 0.3},
    **{"stribeck_load_friction_motor": 0.05, "stribeck_load_friction_external": 0.02},
}
SQUARES = {"quadratic_load_friction_motor": 0.07, "quadratic_load_friction_external": 0.11}
SHARES = [1.0, 0.36787944117144233, 0.059105746561956225, 0.0]  # exp(-|v / 0.1|^1.5) at v of SPEEDS
SPEEDS = [0.0, 0.1, -0.2, 3.0]


@pytest.mark.parametrize("motor, external", [(2.0, -0.5), (0.0, 0.0)], ids=["loaded", "free"])
def test_stribeck_known_values(motor, external):
    terms = friction(make_law("stribeck"), SPEEDS, motor, external, **FALLS, stribeck_exponent=1.5)
    assert terms.torque is None and terms.damping.item() == 0.07
    # The share at rest is exp(-1e-9) with this exponent.
    assert terms.frictionloss.flatten().tolist() == pytest.approx([0.3 + 0.2 * s for s in SHARES], abs=1e-9)


def test_a_stribeck_law_stays_finite_at_any_speed():
    """Also in float32, where (v / v_s)^10 overflows."""
    model = make_law("stribeck").float()
    zero, qvel = torch.zeros(3, 1), torch.tensor([[1e3], [-1e5], [1e-20]], requires_grad=True)
    with torch.no_grad():
        model.stribeck_exponent.fill_(10.0)
    model(DriveState(zero, qvel, zero, zero, zero)).frictionloss.sum().backward()
    assert torch.isfinite(qvel.grad).all()
    assert all(torch.isfinite(value.grad).all() for value in model.parameters() if value.grad is not None)


@pytest.mark.parametrize(
    "motor, external, load", [(2.0, -2.0, 4.0), (2.0, 2.0, 0.0), (0.0, -3.0, 3.0), (-1.0, 0.5, 1.5)]
)
def test_load_dependent_known_values(motor, external, load):
    """Holding a weight loads the gear; a weight that pulls with the motor does not."""
    values = {"frictionloss": 0.3, "damping": 0.07, "load_friction": 0.1}
    terms = friction(make_law("load_dependent"), [0.0, 5.0], motor, external, **values)
    assert terms.frictionloss.flatten().tolist() == pytest.approx(2 * [0.3 + 0.1 * load], abs=1e-15)
    assert terms.torque is None and terms.damping.item() == 0.07


def test_stribeck_load_dependent_known_values():
    values = FALLS | {"stribeck_exponent": 1.5, "load_friction": 0.1, "stribeck_load_friction": 0.05}
    limit = friction(make_law("stribeck_load_dependent"), SPEEDS, 2.0, -1.0, **values).frictionloss
    # The load is 3.
    assert limit.flatten().tolist() == pytest.approx([0.3 + 0.3 + (0.2 + 0.15) * s for s in SHARES], abs=1e-9)


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
    "motor, external, always, at_rest, squared",
    [
        (2.0, -1.0, 0.2 + 0.3, 0.1 + 0.02, 0.11 * 1.0),  # the motor drives
        (-1.0, 2.0, 0.1 + 0.6, 0.05 + 0.04, 0.07 * 1.0),  # it is driven
        (3.0, 1.0, 0.3 - 0.3, 0.15 - 0.02, 0.0),  # both push the same way
        (-1.0, -3.0, 0.9 - 0.1, 0.06 - 0.05, 0.0),
    ],
)
def test_directional_and_quadratic_known_values(motor, external, always, at_rest, squared):
    values = FALLS | SIDES | {"stribeck_exponent": 1.5}
    for name, more, add in (("directional", {}, 0.0), ("quadratic", SQUARES, squared)):
        limit = friction(make_law(name), SPEEDS, motor, external, **values, **more).frictionloss
        expected = [0.3 + always + (0.2 + at_rest + add) * share for share in SHARES]
        assert limit.flatten().tolist() == pytest.approx(expected, abs=1e-9)


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
