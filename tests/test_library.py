"""What `import frictionzoo as fz` offers: laws by name, benches, and rollouts for torch."""

import importlib.resources
import inspect
import itertools
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from conftest import check_each
from helpers.torch_laws import TorchConstraint, TorchStribeck
from helpers.tutorials import code_of

import frictionzoo as fz
from frictionzoo.bench.actuators import REGISTRY as ACTUATORS
from frictionzoo.bench.base import DEFAULTS
from frictionzoo.core.errors import BenchError, ConfigError, ModelError, RunError, UnknownModelError
from frictionzoo.core.registry import KINDS
from frictionzoo.core.segments import Sampling
from frictionzoo.core.state import FrictionTerms, Signals
from frictionzoo.models import TorchFriction, register_model
from frictionzoo.models.registry import REGISTRY
from frictionzoo.result.curves import read_curves
from frictionzoo.simulation.drive import Drive

BATCH, TIME = 3, 40
UNCHECKED = inspect.unwrap(fz.rollout)  # as users have it: tests check types at run time
STEP = 1e-5  # of central differences, as a share


def signals(dtype: torch.dtype, nv: int = 1) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Initial states, and commands, of several drives."""
    draw = torch.Generator().manual_seed(0)
    sizes = (BATCH, nv), (BATCH, nv), (BATCH, TIME, nv)
    return tuple(torch.randn(size, generator=draw, dtype=torch.float64).to(dtype) for size in sizes)  # type: ignore


@pytest.fixture(scope="module")
def bench() -> fz.Bench:
    return fz.Bench("knee_rod.xml", actuator=fz.PositionPD(kp=20, kd=1.0))


def test_it_offers_its_names_and_imports_nothing_heavy() -> None:
    code = "import sys, frictionzoo as fz; print(*{'torch', 'jax', 'mujoco', 'numpy'} & {*sys.modules}, *dir(fz))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert {*found} == {*fz.__all__, "__version__"} and len(found) <= 40
    for name in fz.__all__:
        assert callable(getattr(fz, name))
    with pytest.raises(AttributeError, match="no attribute 'friction'"):
        fz.friction  # noqa: B018


def test_constructors_name_their_arguments() -> None:
    for name in KINDS["actuators"].own():
        law = ACTUATORS.get(name)
        assert [*inspect.signature(law).parameters] == ["params", *law.dimensions]
        assert law is getattr(fz, law.__name__)
    assert {"mjcf", "joint", "actuator", "gravity"} <= {*inspect.signature(fz.Bench).parameters}
    assert {"mjcf", "joint", "actuator", "contacts"} <= {*inspect.signature(fz.Robot).parameters}


def test_a_free_value_is_identified_and_a_tied_one_is_shared() -> None:
    gain = fz.PositionPD(kp=fz.free(15, low=5, high=50), kd=0.5).params["kp"]
    assert (gain.init, gain.low, gain.high, gain.scale, gain.identify) == (15, 5, 50, "log", True)
    params = {"delay": fz.free(0.003, low=0, high=0.02), "armature": fz.tied(0.1, low=0.01, high=1)}
    bench = fz.Bench("knee_rod.xml", actuator=fz.PositionPD(kp=15, kd=0.5), params=params)
    assert bench.params["delay"].is_identified and bench.params["delay"].scale == 0.02
    assert bench.params["armature"].tie is True
    tied = fz.tied([0.1, 0.2], low=[-1, -2], high=1, joints={"hips": ".*_hip"})
    assert tied["tie"] == {"hips": ".*_hip"} and tied["scale"] == 2
    assert {"mujoco_default", "neural_friction"} <= {*fz.list_models()} and fz.law(fz.list_models()[0])


def test_logs_are_plotted_by_joint(leg: Callable[..., fz.Bench]) -> None:
    time = 0.01 * np.arange(200)
    hip, knee = np.sin(3 * time), np.cos(5 * time)
    logs = fz.read({"time": time, "q_knee": knee, "q_hip": hip, "cmd_hip": 2 * hip, "cmd_knee": 2 * knee})
    for figure, order, unit in ((logs.plot(), (knee, hip), "rad or m"), (logs.plot(0, leg()), (hip, knee), "rad")):
        labels = [axes.get_ylabel() for axes in figure.axes[::2]]
        velocity = unit.replace("rad", "rad/s").replace("m", "m/s")
        assert labels == [f"position [{unit}]", f"velocity [{velocity}]", "command [unit of ctrl]"]
        for joint, expected in enumerate(order):
            position, speed, command = (axes.lines[0].get_ydata() for axes in figure.axes[joint::2])
            np.testing.assert_allclose(position, expected)
            np.testing.assert_allclose(command, 2 * expected)
            assert np.corrcoef(speed, np.gradient(expected))[0, 1] > 0.99
    assert [axes.get_title(loc="left") for axes in logs.plot(0, leg()).axes[:2]] == ["hip", "knee"]
    with pytest.raises(ConfigError, match=r"^number=1: expected 0 to 0"):
        fz.Logs.of(next(iter(logs))).plot(1)
    with pytest.raises(BenchError, match="qpos has 1 columns, expected 2 for the joints hip, knee"):
        fz.read({"time": time, "qpos": hip, "ctrl": hip}).plot(0, leg())


def test_benches_laws_and_logs_show_their_values() -> None:
    actuator = fz.PositionPD(kp=20, kd=1.5)
    assert repr(actuator) == "PositionPD(kp=20, kd=1.5)"
    bench = fz.Bench("knee_rod.xml", actuator=actuator)
    assert repr(bench).splitlines() == [
        "Bench of knee_rod.xml, knee, PositionPD",
        "  armature: 0.01 kg m^2, identified within 1e-05 to 1",
        "  kp: 20 N m/rad",
        "  kd: 1.5 N m s/rad",
    ]
    law = fz.law("mujoco_default", 2)
    law.begin({"damping": np.array([0.25, 0.5])})
    assert repr(law).splitlines()[-1] == "  damping: 0.25, 0.5 N m s/rad, identified within 0.0001 to 10"
    assert repr(fz.law("neural_friction")).endswith(" weights")
    signals = {name: np.zeros((100, 1)) for name in ("qpos", "qvel", "ctrl")}
    log = fz.Log("a\x1b.csv", 0.01 * np.arange(100), **signals, sha256="", simulated=None)
    assert repr(log) == "a\\x1b.csv: 1 s, 100 samples every 0.01 s"


def test_what_a_bench_has_if_nothing_is_said_is_what_the_configuration_has(compose: Callable) -> None:
    assert compose("bench=knee").bench.params.armature == DEFAULTS["armature"]


@pytest.mark.parametrize("name", ["coulomb_stribeck", "lugre", "neural_friction", "mujoco_default"])
def test_gradients_are_those_of_central_differences(bench: fz.Bench, name: str) -> None:
    law = fz.law(name, **({"hidden": [4]} if name == "neural_friction" else {})).double()
    states = [signal.requires_grad_() for signal in signals(torch.float64)]
    parameters = {"armature": torch.tensor([0.03], dtype=torch.float64), "kp": torch.tensor(18.0, dtype=torch.float64)}
    moving = [*states, *(value.requires_grad_() for value in parameters.values()), *law.parameters()]
    moving = [tensor for tensor in moving if tensor.requires_grad]
    draw = torch.Generator().manual_seed(1)
    weights = torch.randn(2, BATCH, TIME, 1, dtype=torch.float64, generator=draw)

    def loss() -> torch.Tensor:
        found = fz.rollout(bench, law, *states, parameters=parameters)
        return sum((weight * part).sum() for weight, part in zip(weights, found, strict=True))

    directions = [
        tensor.detach().abs().mean() * torch.randn(tensor.shape, dtype=torch.float64, generator=draw)
        for tensor in moving
    ]
    gradients = torch.autograd.grad(loss(), moving)
    for tensor, direction, gradient in zip(moving, directions, gradients, strict=True):
        sides = []
        for sign in (1, -1):
            with torch.no_grad():
                tensor += sign * STEP * direction
                sides.append(loss())
                tensor -= sign * STEP * direction
        expected = (sides[0] - sides[1]) / (2 * STEP)
        assert (gradient * direction).sum().item() == pytest.approx(expected.item(), rel=1e-6, abs=3e-8)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_a_rollout_is_that_of_a_fit(bench: fz.Bench, make: Callable, dtype: torch.dtype) -> None:
    law = fz.law("dahl")
    with torch.no_grad():
        found = fz.rollout(bench, law, *signals(dtype), interval=0.002)
    assert {part.dtype for part in found} == {dtype} and {part.shape for part in found} == {(BATCH, TIME, 1)}
    known = make("bench", "bench.actuator.params.kp.init=20", "bench.actuator.params.kd.init=1")
    rollout = Drive.assemble(known, make("model", "model=dahl", nv=1), "auto", Sampling(0.002, 2, 0)).rollout
    values = {"bench": known.initial_values(), "friction": {k: v.detach().numpy() for k, v in law.state_dict().items()}}
    with jax.enable_x64(dtype == torch.float64):
        qpos, qvel, ctrl = (jnp.asarray(signal.numpy()) for signal in signals(dtype))
        expected = rollout.compiled(values, qpos, qvel, Signals(ctrl))
    for part, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(part.numpy(), other, rtol=1e-4 if dtype == torch.float32 else 1e-12, atol=1e-6)


def test_a_law_in_torch_alone_moves_as_its_formula(bench: fz.Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(REGISTRY, "entries", dict(REGISTRY.entries))
    register_model("torch_stribeck")(type("OwnStribeck", (TorchStribeck,), {}))
    formula = fz.law("coulomb_stribeck")
    sections = {name: {**vars(param)} for name, param in formula.params.items()}
    known = {n: {k: s[k] for k in ("init", "low", "high", "scale", "identify")} for n, s in sections.items()}
    own = fz.law("torch_stribeck", params=known)
    states = signals(torch.float64)
    results = []
    for law in (formula, own):
        found, _ = fz.rollout(bench, law, *states)
        results.append((found.detach(), *torch.autograd.grad(found.square().sum(), [law.static_torque])))
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_a_law_in_torch_alone_keeps_to_the_type(bench: fz.Bench, dtype: torch.dtype) -> None:
    law = TorchConstraint()  # which has a whole number among its values
    found, _ = fz.rollout(bench, law, *signals(dtype))
    assert found.dtype == dtype and bool(found.isfinite().all())
    (gradient,) = torch.autograd.grad(found.square().sum(), [law.dry])
    assert gradient.dtype == torch.float64 and gradient.item() != 0


def test_a_late_command_acts_as_if_the_first_had_lasted() -> None:
    delayed = fz.Bench("knee_rod.xml", actuator=fz.PositionPD(kp=20, kd=1.0), params={"delay": 0.003})
    at_once = fz.Bench("knee_rod.xml", actuator=fz.PositionPD(kp=20, kd=1.0))
    law, (qpos, qvel, ctrl) = fz.law("coulomb_smooth"), signals(torch.float64)
    late = torch.cat([ctrl[:, :1].expand(-1, 3, -1), ctrl[:, :-3]], dim=1)
    with torch.no_grad():
        found, _ = fz.rollout(delayed, law, qpos, qvel, ctrl)
        expected, _ = fz.rollout(at_once, law, qpos, qvel, late)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)


def test_what_else_was_recorded_is_given_by_name() -> None:
    gains = {"kt_over_r": 0.4, "kt2_over_r": 0.4, "duty_gain": 0.16, "duty_limit": 1.0}
    servo = fz.Bench("knee_rod.xml", actuator=fz.VoltageServo(**gains))
    law, states = fz.law("temperature_linear", params={"damping_slope": {"init": 0.01}}), signals(torch.float64)
    level = torch.ones(BATCH, TIME, 1, dtype=torch.float64)
    recorded = {"gain": 16 * level, "supply": 12 * level, "enable": level}
    with torch.no_grad():
        cold, _ = fz.rollout(servo, law, *states, signals=recorded)
        same, _ = fz.rollout(servo, law, *states, signals=recorded | {"temperature": law.inputs["temperature"] * level})
        warm, _ = fz.rollout(servo, law, *states, signals=recorded | {"temperature": 60 * level})
    assert torch.equal(cold, same) and not torch.equal(cold, warm)
    with pytest.raises(BenchError, match=r"^signals\.supply: missing, and the bench's actuator needs it"):
        fz.rollout(servo, law, *states, signals={"gain": level, "enable": level})


@pytest.mark.parametrize(
    ("changed", "error", "complaint"),
    [
        ({"parameters": {"mass": torch.ones(1)}}, ConfigError, r"^parameters\.mass: no such parameter of the bench; "),
        ({"parameters": {"kp": torch.ones(2)}}, BenchError, r"^parameters\.kp: shape \(2,\), expected \(1,\)"),
        ({"signals": {"supply": torch.ones(1)}}, BenchError, r"^signals\.supply: no model uses it"),
        ({"ctrl": torch.ones(BATCH, TIME, 2)}, BenchError, r"^ctrl has shape \(3, 40, 2\), expected \(3, 40, 1\)"),
        ({"qpos": torch.ones(BATCH)}, BenchError, r"^qpos of shape \(3,\) and ctrl of "),
        ({"law": 2}, BenchError, r"^a law of 2 joints on knee_rod\.xml with 1, expected as many"),
        ({"interval": 0.0015}, BenchError, r"^interval: 0\.0015 s per sample, expected 0\.001 s as in knee_rod\.xml"),
        *(({"interval": interval}, BenchError, "^interval") for interval in (np.nan, 0, -0.001, 1e300, True, "fast")),
        ({"engine": "fast"}, ConfigError, r"^engine=fast: no such engine"),
        ({"engine": ["mjx"]}, ConfigError, "^engine"),
        ({"payload": 2.0}, ConfigError, "^payload"),
        ({"parameters": [0.1]}, ConfigError, "^parameters: list"),
        ({"signals": torch.ones(1)}, ConfigError, "^signals: Tensor"),
        *(({"parameters": {"kp": value}}, ConfigError, r"^parameters\.kp") for value in ("stiff", None, True, [1.0])),
    ],
)
def test_what_does_not_fit_is_refused(bench: fz.Bench, changed: dict[str, Any], error: type, complaint: str) -> None:
    qpos, qvel, ctrl = signals(torch.float64)
    law = fz.law("coulomb_smooth", nv=changed.pop("law", 1))
    qpos, ctrl = changed.pop("qpos", qpos), changed.pop("ctrl", ctrl)
    with pytest.raises(error, match=complaint):
        UNCHECKED(bench, law, qpos, qvel, ctrl, **changed)


TYPES: dict[str, Callable[[torch.Tensor], Any]] = {
    **{
        str(dtype): lambda signal, dtype=dtype: signal.to(dtype)
        for dtype in (torch.float32, torch.bfloat16, torch.int32)
    },
    **{f"numpy {kind}": lambda signal, kind=kind: signal.numpy().astype(kind) for kind in ("f2", "f8", ">f8", "i2")},
    "numpy turned round": lambda signal: signal.numpy()[::-1].copy()[::-1],
    "numpy that cannot be written": lambda signal: np.broadcast_to(signal.numpy(), signal.shape),
    "tensor in other strides": lambda signal: signal.T.contiguous().T if signal.ndim == 2 else signal.mT.mT,
    "jax": lambda signal: jnp.asarray(signal.numpy()),
    "tensor with a gradient": lambda signal: signal.clone().requires_grad_(),
}
NO_NUMBERS: tuple[Callable[[torch.Tensor], Any], ...] = (
    lambda signal: signal > 0,
    lambda signal: signal.to(torch.complex64),
    lambda signal: signal.to_sparse(),
    lambda signal: signal.tolist(),
    lambda signal: signal.numpy().astype(object),
    lambda signal: "qpos",
)
"""Of signals, what is none."""


def whole(length: int = 5) -> list[torch.Tensor]:
    """States and commands of two drives, in whole numbers, which all types hold."""
    commands = torch.arange(2.0 * length, dtype=torch.float64).reshape(2, length, 1)
    return [*torch.tensor([[[1.0], [2.0]], [[0.0], [3.0]]], dtype=torch.float64), commands]


def test_states_and_commands_of_any_type_are_computed_in_the_finest(bench: fz.Bench) -> None:
    law = fz.law("coulomb_smooth")

    def check(name: str, place: int) -> None:
        arrays = [part.float() for part in whole()]
        arrays[place] = TYPES[name](whole()[place])
        finest = torch.float64 if str(arrays[place].dtype) in ("float64", ">f8", "torch.float64") else torch.float32
        found, expected = UNCHECKED(bench, law, *arrays), UNCHECKED(bench, law, *(part.to(finest) for part in whole()))
        for part, other in zip(found, expected, strict=True):
            assert part.dtype == other.dtype and torch.equal(part, other)

    with torch.no_grad():
        check_each(check, itertools.product(TYPES, range(3)))


@pytest.mark.parametrize("place", ["qpos", "qvel", "ctrl"])
@pytest.mark.parametrize("spoil", NO_NUMBERS)
def test_a_state_that_holds_no_numbers_is_refused_by_name(bench, place, spoil):
    arrays: dict[str, Any] = dict(zip(("qpos", "qvel", "ctrl"), whole(), strict=True))
    arrays[place] = spoil(arrays[place])
    with pytest.raises(ConfigError, match=f"^{place}: "):
        UNCHECKED(bench, fz.law("coulomb_smooth"), **arrays)


@pytest.mark.parametrize("batch", [0, 2])
@pytest.mark.parametrize("length", [0, 5])
def test_rollouts_of_no_samples_have_none(bench: fz.Bench, batch: int, length: int) -> None:
    arrays = [part[:batch].requires_grad_() for part in whole(length)]
    found = UNCHECKED(bench, fz.law("coulomb_smooth"), *arrays)
    assert [part.shape for part in found] == [(batch, length, 1)] * 2 and found[0].requires_grad


class Plain(torch.nn.Module):
    def forward(self, state: torch.Tensor) -> torch.Tensor:
        return 0.1 * state


class OfTensors(TorchFriction):
    """A law in torch whose answer is what it is given."""

    def __init__(self, answer: Any) -> None:
        super().__init__(1)
        self.answer = answer

    def forward(self, state: Any) -> Any:
        return self.answer

    def terms(self, xp: Any, values: Any, state: Any) -> Any:
        return self.forward(state)


@pytest.mark.parametrize("law", [Plain, "stribeck", None], ids=str)
def test_a_law_that_is_no_module_is_refused(bench: fz.Bench, law: Any) -> None:
    with pytest.raises(ConfigError, match=r"^law: .*FrictionModel.*torch module"):
        UNCHECKED(bench, law, *whole())
    with pytest.raises(ConfigError, match=r"^bench: "):
        UNCHECKED(law, fz.law("coulomb_smooth"), *whole())


@pytest.mark.parametrize("module", [Plain(), torch.nn.Linear(1, 1)], ids=str)
def test_a_module_of_other_shapes_is_refused(bench: fz.Bench, module: torch.nn.Module) -> None:
    with pytest.raises(ModelError, match=rf"^{type(module).__name__}: .*expected a? ?t\w+ of shape \(2, 1\)"):
        fz.rollout(bench, module, *whole())


class Cubic(TorchFriction):
    """What `Module` computes, as a friction model."""

    name = "cubic"

    def __init__(self) -> None:
        super().__init__(1)
        self.layer = torch.nn.Linear(2, 1)

    def forward(self, state: Any) -> FrictionTerms:
        return FrictionTerms(torque=torch.tanh(self.layer(torch.stack([state.qpos[:, 0], state.qvel[:, 0]], dim=1))))


def test_any_torch_module_is_a_friction_model(bench: fz.Bench) -> None:
    law = Cubic()
    module = torch.nn.Sequential(law.layer, torch.nn.Tanh())
    gradients = []
    for model in (law, module):
        for _ in range(2):  # the second time as compiled
            found = fz.rollout(bench, model, *(part.double() for part in whole()))
        (gradient,) = torch.autograd.grad(found[0].square().sum(), [law.layer.weight])
        gradients.append((*found, gradient))
    for own, other in zip(*gradients, strict=True):
        torch.testing.assert_close(own, other, rtol=1e-12, atol=0)
    assert law.layer.weight.dtype == gradients[0][2].dtype == torch.float32  # a module of the caller's stays as it is
    assert gradients[0][0].dtype == torch.float64


@pytest.mark.parametrize(
    "answer",
    [torch.ones(2, 1), None, 0.1, FrictionTerms(torque=0.1), FrictionTerms(torque=torch.ones(3, 1)), {"torque": 1.0}],
    ids=str,
)
def test_an_answer_of_a_law_in_torch_that_is_none_is_refused(bench: fz.Bench, answer: Any) -> None:
    with pytest.raises(ModelError, match=r"^OfTensors: "):
        UNCHECKED(bench, OfTensors(answer), *whole())


def test_a_law_that_is_none_and_an_option_that_it_lacks_are_refused() -> None:
    with pytest.raises(UnknownModelError, match=r"^lugr: no such friction model; did you mean lugre\?"):
        fz.law("lugr")
    with pytest.raises(ConfigError, match=r"^hidden: unknown option; expected one of params in model$"):
        fz.law("lugre", hidden=[3])
    with pytest.raises(ConfigError, match=r"^lugre: unknown option _target_, which would select another law; "):
        fz.law("lugre", _target_="frictionzoo.models.Baseline")
    for joints in (0, -1):
        with pytest.raises(ConfigError, match=rf"^nv={joints}; expected the number of joints, a whole one from 1 on$"):
            fz.law("coulomb_stribeck", nv=joints)
    with pytest.raises(ConfigError, match="kp is given twice"):
        fz.PositionPD({"kp": {}}, kp=1, kd=1)


def test_a_run_finds_its_model_file_from_any_folder(
    call: Callable, tiny: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped = importlib.resources.files("frictionzoo.bench") / "assets" / "knee_rod.xml"
    (tmp_path / "stand.xml").write_text(shipped.read_text())
    done = call("model=mujoco_default", "fit=lm", "bench.mjcf=stand.xml", *tiny, "hydra.run.dir=run")
    assert done.status == 0, done.err
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path / "other")
    fit = fz.load("../run")
    assert fit.rollout()[0].shape == fit.curves.qpos.shape
    (tmp_path / "stand.xml").unlink()
    with pytest.raises(BenchError, match=r"^stand.xml: cannot be read"):
        fz.load("../run")


def test_parameters_are_a_table_with_a_row_per_joint(finished_run: Callable) -> None:
    fit = fz.load(finished_run("mujoco_default")[0])
    table = fit.to_frame()
    assert [*table.columns] == ["name", "joint", "value", "low", "high", "unit", "identified"]
    assert [*table["name"]] == [*fit.parameters] and {*table["joint"]} == {*fit.bench.joints}
    for row in table.itertuples(index=False):
        expected = fit.parameters[row.name]
        assert (row.value, row.unit, row.identified) == (expected.value[0], expected.unit, expected.identified)
        np.testing.assert_equal([row.low, row.high], expected.interval[0])
    assert table["identified"].any() and table["low"].notna().any()


def test_a_table_without_pandas_is_refused(finished_run: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    fit = fz.load(finished_run("mujoco_default")[0])
    monkeypatch.setattr(sys, "path", [])
    monkeypatch.delitem(sys.modules, "pandas", raising=False)
    with pytest.raises(ConfigError, match=r"^to_frame: pandas not found, .* pip install pandas$"):
        fit.to_frame()


def test_the_page_s_loop_finds_its_drive(capsys: pytest.CaptureFixture[str]) -> None:
    before = torch.get_default_dtype()
    try:
        exec(*code_of("pytorch.md", "python"), {})
    finally:
        torch.set_default_dtype(before)
    np.testing.assert_allclose([float(word) for word in capsys.readouterr().out.split()], [0.04, 0.2, 0.1], rtol=0.01)


def test_the_page_reads_a_run_back(finished_run, tmp_path, monkeypatch, capsys):
    folder, finished = finished_run("mujoco_default")
    (tmp_path / "run").symlink_to(folder)
    monkeypatch.chdir(tmp_path)
    exec(code_of("python.md", "python")[0], {})
    *summary, armature, errors = capsys.readouterr().out.strip().splitlines()
    told = [
        [line for line in lines if not line.startswith("files: ")] for lines in (summary, finished.out.splitlines())
    ]
    assert told[0] == told[1]
    result = json.loads((folder / "result.json").read_text())
    (row,) = [row for row in result["parameters"] if row["name"] == "armature"]
    value, ends = armature.split(" kg m^2 ")
    assert float(value.strip("[]")) == pytest.approx(row["value"], rel=1e-6)
    assert [float(end) for end in ends.strip("[]").split()] == pytest.approx(row["interval"], rel=1e-6)
    assert [float(error) for error in errors.split()] == [
        result["metrics"][part]["position_mae"] for part in ("test", "baseline")
    ]
    same = (tmp_path / "drive.xml").read_text() == (folder / "identified.xml").read_text()
    assert same, "another drive than the run's own file holds"
    assert (tmp_path / "rollout.png").read_bytes().startswith(b"\x89PNG")


def test_a_run_that_was_read_back_is_shown_and_exported(finished_run: Callable, tmp_path: Path) -> None:
    fit = fz.load(finished_run("mujoco_default")[0])
    curves = read_curves(fit.folder)
    figure = fit.plot()
    assert figure._repr_png_().startswith(b"\x89PNG")  # a notebook displays it
    drawn = [line.get_ydata() for line in figure.axes[0].lines]
    for states in (curves.measured_qpos[0, :, 0], curves.qpos[0, :, 0], curves.baseline_qpos[0, :, 0]):
        assert any(len(line) >= len(states) and np.array_equal(line[-len(states) :], states) for line in drawn)
    page = fit._repr_html_()
    assert page.count("<table>") == page.count("</table>") == 3 and "<td>bench.armature</td>" in page
    known = fit.parameters["bench.kp"]
    assert not known.identified and np.isnan(known.interval).all() and known.unit == "N m/rad"
    assert fit.metrics["test"].rollouts == fit.result["metrics"]["test"]["rollouts"]
    written = fit.export("torchscript", tmp_path / "all")
    assert written.export and {*written.export.files} <= {path.name for path in (tmp_path / "all").iterdir()}
    for target, path, expected in (
        ("mjfc", "drive.xml", "no such target; did you mean mjcf"),
        ("mjcf", "drive.onnx", "writes bench.xml; expected a folder, or one's ending"),
        ("all", "drive.xml", "expected one target"),
    ):
        with pytest.raises(ConfigError, match=expected):
            fit.export(target, tmp_path / path)
    assert not (tmp_path / path).exists()
    with pytest.raises(RunError, match="expected the folder of a finished run"):
        fz.load(tmp_path)
