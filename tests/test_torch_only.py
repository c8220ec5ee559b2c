"""Friction laws that exist only in torch: the same numbers as in JAX, whole runs, and what they are refused."""

import functools
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import Finished
from helpers.torch_laws import STRIBECK, TorchConstraint, TorchStribeck

from frictionzoo.api.identified import Identified
from frictionzoo.bench import Bench
from frictionzoo.core.described import remake
from frictionzoo.core.errors import ConfigError, ExportError, ModelError
from frictionzoo.core.segments import Sampling, Segments
from frictionzoo.core.state import DriveState, FrictionTerms, Signals
from frictionzoo.export.write import write_exports
from frictionzoo.fit import Adam, Known, Objective, Space, loop, run_fit
from frictionzoo.fit.chunk import search
from frictionzoo.fit.loggers import Csv
from frictionzoo.fit.loop import FitFiles
from frictionzoo.models import FrictionModel, TorchFriction, register_model
from frictionzoo.models.contract import check_model
from frictionzoo.models.registry import REGISTRY
from frictionzoo.result.curves import read_curves
from frictionzoo.simulation.drive import Drive

LOSS = {"position": 1.0, "velocity": 1.0, "robust": "none", "robust_scale": 1.0, "refine": False}


class Remembers(TorchConstraint):
    memory = 2


class NormalisesTheBatch(TorchConstraint):
    def forward(self, state: DriveState) -> FrictionTerms:
        return FrictionTerms(torque=state.qvel - state.qvel.mean(), frictionloss=self.dry)


class NotFiniteAtRest(TorchConstraint):
    def forward(self, state: DriveState) -> FrictionTerms:
        return FrictionTerms(torque=self.dry * state.qvel.abs().sqrt(), frictionloss=self.dry)


LAWS = {
    **{"torch_stribeck": TorchStribeck, "torch_constraint": TorchConstraint, "remembers": Remembers},
    **{"normalises": NormalisesTheBatch, "not_finite": NotFiniteAtRest},
}


@pytest.fixture(autouse=True, scope="module")
def registered() -> Iterator[None]:
    """The laws above, for the tests of this file alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(REGISTRY, "entries", dict(REGISTRY.entries))
        for name, law in LAWS.items():
            register_model(name)(law)
        yield


@pytest.fixture(scope="module")
def segments() -> Segments:
    """Random states, commands with a sample of history, of a drive that carries nothing."""
    rng = np.random.default_rng(0)
    qpos, qvel = rng.normal(size=(2, 40, 4, 1))
    return Segments(qpos, qvel, Signals(qpos[:, :1] + rng.normal(scale=0.1, size=(40, 4, 1))), 0.002)


def pose(bench: Bench, law: FrictionModel, segments: Segments, engine: str, dtype: str = "float64") -> Objective:
    drive = Drive.assemble(bench, law, engine, Sampling(segments.timestep, 2, segments.history))
    return Objective(Space(bench, law, dtype), drive.rollout, segments, **LOSS)


@pytest.fixture(scope="module")
def pair(make: Callable[..., Any], segments: Segments) -> Callable[..., tuple[Objective, Objective]]:
    """The same objective of `coulomb_stribeck` in torch and in JAX, of a drive whose commands act late."""

    @functools.cache
    def pair(engine: str) -> tuple[Objective, Objective]:
        delay = {"init": 3e-4, "low": 0.0, "high": 1e-3, "scale": 1e-3, "identify": True}
        bench = make("bench", *(f"bench.params.delay.{key}={value}" for key, value in delay.items()))
        laws = make("model", nv=1), make("model", f"model._target_={STRIBECK}", nv=1)
        assert isinstance(laws[1], TorchStribeck)
        jaxed, torched = (pose(bench, law, segments, engine) for law in laws)
        return torched, jaxed

    return pair


@pytest.mark.usefixtures("x64")
def test_loss_and_gradient_are_those_of_the_law_in_jax(pair: Callable[..., tuple[Objective, Objective]]) -> None:
    torched, jaxed = pair("specialised")
    assert torched.space.labels == jaxed.space.labels
    assert "bench.delay" in torched.space.labels
    vector = jaxed.space.start + np.random.default_rng(1).normal(scale=0.1, size=len(jaxed.space.start))
    expected, slope = jax.jit(jaxed.value_and_grad("reverse"))(vector, jaxed.data)
    loss, gradient = torched.value_and_grad("auto")(vector, torched.data)
    assert float(loss) == pytest.approx(float(expected), rel=1e-10)
    # The two differ in the order of their sums.
    np.testing.assert_allclose(gradient, slope, rtol=1e-10, atol=1e-10 * float(jnp.abs(slope).max()))
    assert float(torched.loss(vector, torched.data)) == pytest.approx(float(expected), rel=1e-10)


@pytest.mark.slow
@pytest.mark.usefixtures("in_haste", "x64")
def test_the_loss_is_that_of_any_engine(pair: Callable[..., tuple[Objective, Objective]]) -> None:
    ours, theirs = (pair(engine)[0] for engine in ("specialised", "mjx"))
    start = ours.space.start
    assert float(theirs.loss(start, theirs.data)) == pytest.approx(float(ours.loss(start, ours.data)), rel=1e-10)


@pytest.mark.usefixtures("x64")
def test_a_fit_takes_the_same_way_also_after_an_interruption(pair, make, tmp_path, monkeypatch):
    torched, jaxed = pair("specialised")
    fit, law = Adam(5, 0.05, 0.9, "auto"), make("model", f"model._target_={STRIBECK}", nv=1).double()
    whole = run_fit(fit, torched, law, chunk=2, progress=False)
    _, trace = search(fit, jaxed)
    assert whole.iterations == 5
    assert (np.diff(whole.history["loss"]) < 0).all()
    for name, values in {"loss": trace.loss, **trace.params}.items():
        np.testing.assert_allclose(whole.history[name], values, rtol=1e-10, err_msg=name)
    assert {name: getattr(law, name).item() for name in law.dimensions} == whole.values["friction"]

    saved = loop._Saver.on_train_epoch_end

    def save_and_fall(saver: Any, trainer: Any, module: Any) -> None:
        saved(saver, trainer, module)
        if module.iteration == 4:
            raise RuntimeError("the power is gone")

    with monkeypatch.context() as patch:
        patch.setattr(loop._Saver, "on_train_epoch_end", save_and_fall)
        with pytest.raises(RuntimeError, match="the power is gone"):
            run_fit(fit, torched, law, FitFiles(tmp_path, Csv()), chunk=2, progress=False)
    resumed = run_fit(fit, torched, law, FitFiles(tmp_path, Csv()), chunk=2, progress=False)
    np.testing.assert_equal((resumed.vector, resumed.history), (whole.vector, whole.history))


@pytest.mark.usefixtures("x64")
def test_the_gradient_reaches_weights(knee: Bench, segments: Segments) -> None:
    law = TorchConstraint()
    objective = pose(knee, law, segments, "specialised")
    assert objective.space.weights == [f"friction.{name}" for name, _ in law.named_parameters() if name != "dry"]
    value_and_grad, vector = objective.value_and_grad("reverse"), objective.space.start
    gradient = value_and_grad(vector, objective.data)[1]
    assert (jnp.abs(gradient) > 0).all()
    rng = np.random.default_rng(2)
    for direction in (rng.normal(size=len(vector)) for _ in range(2)):
        ahead, behind = (float(objective.loss(vector + step * direction, objective.data)) for step in (1e-5, -1e-5))
        # A central difference errs by the square of its step and by rounding over it, both below this.
        assert float(gradient @ direction) == pytest.approx((ahead - behind) / 2e-5, rel=1e-6)


def test_given_values_are_judged(make: Callable[..., Any], segments: Segments) -> None:
    known = [f"model.params.{name}.identify=false" for name in TorchStribeck.dimensions]
    choices = (f"model._target_={STRIBECK}", "bench.params.armature.identify=false", *known)
    objective = pose(make("bench", *choices), make("model", *choices, nv=1), segments, "specialised", "float32")
    fit = Known()
    progress, trace = search(fit, objective)
    assert float(progress.best_loss) == trace.loss[0] == float(objective.loss(objective.space.start, objective.data))


@pytest.mark.parametrize("law", [TorchConstraint, TorchStribeck])
@pytest.mark.parametrize("nv", [1, 3])
def test_they_keep_the_contract(make: Callable[..., Any], law: type[TorchFriction], nv: int) -> None:
    model = TorchConstraint(nv) if law is TorchConstraint else make("model", f"model._target_={STRIBECK}", nv=nv)
    check_model(model.double())


@pytest.mark.parametrize(
    ("law", "message"),
    [
        (Remembers, "remembers: memory: a law that exists only in torch has none"),
        (NormalisesTheBatch, "normalises: batch: torque of one state changes by .* with the others"),
        (NotFiniteAtRest, "not_finite: gradient: with respect to qvel is not finite"),
    ],
)
def test_a_broken_law_is_named(law: type[TorchConstraint], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        check_model(law())


def test_a_memory_is_refused_before_a_rollout(knee: Bench) -> None:
    with pytest.raises(ModelError, match="remembers: a memory of 2 in a law that exists only in torch, expected 0"):
        Drive.assemble(knee, Remembers(), "specialised")


def test_second_order_is_refused_where_rollouts_are_of_first(knee: Bench) -> None:
    bench = remake(knee, second_order=True)
    with pytest.raises(ConfigError, match=r"^bench\.second_order=true: .* exists only in torch"):
        Drive.assemble(bench, TorchConstraint(), "specialised", bench.sampling(bench.timestep))


def test_there_is_no_formula_over_other_namespaces() -> None:
    state = DriveState(*(np.zeros((5, 2, 1))))
    with pytest.raises(ModelError, match=r"torch_constraint: it exists only in torch, not in jax\.numpy"):
        TorchConstraint().terms(jnp, {}, state)


def test_what_needs_more_than_a_gradient_is_refused_in_one_line(make, knee, segments):
    law = TorchConstraint()
    objective = pose(knee, law, segments, "specialised", "float32")
    for name in ("lm", "grid"):
        with pytest.raises(ConfigError, match=rf"fit={name}: torch_constraint exists only in torch, .*; use fit=adam"):
            make("fit", f"fit={name}").total(objective)
    assert make("fit", "fit=auto").choose(objective).name == "adam"
    with pytest.raises(ConfigError, match=r"fit\.derivative=forward: torch_constraint exists only in torch"):
        objective.value_and_grad("forward")
    rollout = Drive.assemble(knee, law, "specialised").rollout
    for option, loss in (("refine", LOSS), ("impulse", LOSS | {"position": 0.0})):
        with pytest.raises(ConfigError, match=rf"loss\.{option}=true: torch_constraint exists only in torch"):
            Objective(objective.space, rollout, segments, **(loss | {option: True}))


@pytest.fixture
def whole(unrendered: None, call: Callable[..., Finished], tiny: tuple[str, ...], tmp_path: Path) -> Path:
    own = ("model=coulomb_stribeck", f"model._target_={STRIBECK}", "segments.length=3", "dtype=float32")
    finished = call(*tiny, *own, "fit.iterations=3", f"hydra.run.dir={tmp_path / 'whole'}")
    assert finished.status == 0, finished.err
    return tmp_path / "whole"


def test_a_run_leaves_what_every_run_leaves_and_is_exported_where_torch_goes(whole: Path, tmp_path: Path) -> None:
    result = json.loads((whole / "result.json").read_text())
    assert result["fit"]["iterations"] == 3
    assert result["metrics"]["test"]["diverged"] == 0
    assert result["no_intervals"] == "torch_stribeck exists only in torch, where no Jacobian is taken"
    assert (whole / "report.html").exists()
    fitted = Identified.load(whole)
    # The run computed in float32, the fitted drive does in float64: some hundred steps of a tenth of a radian.
    np.testing.assert_allclose(fitted.rollout()[0], read_curves(whole).qpos, atol=1e-5)
    (written,) = write_exports(whole, {"target": "torchscript", "output": str(tmp_path / "torchscript")})
    assert written.export is not None
    assert written.export.differences[0].largest < 1e-12  # rounding of a torque of a tenth of a newton metre
    for target in ("mujoco", "mjx"):
        with pytest.raises(ExportError, match=r"torch_stribeck: it exists only in torch, .* take target=torchscript"):
            write_exports(whole, {"target": target, "output": str(tmp_path / target)})


@pytest.mark.slow
@pytest.mark.usefixtures("in_haste")
def test_every_other_target_holds_it_or_says_why_not(whole: Path, tmp_path: Path) -> None:
    written = write_exports(whole, {"target": "all", "output": str(tmp_path)})
    assert {entry.target for entry in written if entry.export} >= {"mjcf", "onnx", "torchscript"}
    assert all("\n" not in entry.reason for entry in written)
