"""Whatever MuJoCo's XML schema has, a bench with it is simulated as MuJoCo C does the file, or refused in one line.

`FRICTIONZOO_SCHEMA=all pytest -s -m slow tests/test_schema.py` goes through all of the schema and prints the counts; a
number in place of `all` is how many places of it are drawn, for one joint and for two.
"""

import collections
import contextlib
import copy
import functools
import hashlib
import itertools
import os
import random
import re
import traceback
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np
import pytest
import torch
from helpers.schema import Variant, all_places, variants, write_files
from omegaconf import OmegaConf

from frictionzoo.bench import Bench
from frictionzoo.core.build import build
from frictionzoo.core.config import compose_config
from frictionzoo.core.errors import FrictionzooError
from frictionzoo.core.state import DriveState, Signals
from frictionzoo.models import FrictionModel
from frictionzoo.simulation import Engine, Values, proof
from frictionzoo.simulation.choose import naming_what_mjx_lacks
from frictionzoo.simulation.drive import Drive
from frictionzoo.simulation.proof import TOLERANCE, Cases, Recorded, initial_values, prove
from frictionzoo.simulation.rollout import make_rollout

ENGINES = ("specialised", "mjx")
LAWS = {  # of each kind: none, a constraint, an explicit torque, a memory, a network
    **{"baseline": (), "mujoco_default": (), "coulomb_stribeck": (), "dahl": ()},
    "neural_friction": ("model.hidden=[4,4]",),
}
JOINTS = {1: "j", 2: "[j,k]"}
# What no step looks at: names, appearance, what sensors measure, what users add.
UNSEEN = re.compile(
    "(name|names|cam|light|mat|tex|skin|text|tuple|numeric|key|sensor|bvh|oct)_.*|.*(_user|_rgba|_matid|texcoord.*)|"
    "(?!actuator).*_group|.*(path|names_map).*|names|paths|bvh.*|vis|n[a-zA-Z].*|signature"
)
OVERFLOW = 1e6
COMPARED = 4  # rollouts of each file, of which all that differs in a step is compared with an engine's sixteen


SPECIFIC = r"""(?<==)"[^"]*"|\d[\d.e+-]*|'[^']*'|(?<!\[)<[^>]*>|one of .*?;"""
"""What reasons of one kind differ in."""


class Verdict(NamedTuple):
    """What became of a variant in an engine: `equal`, `refused`, `differing` or `traceback`, and why."""

    kind: str
    why: str = ""


Place = tuple[str, str | None, int]
Judged = list[tuple[Variant, dict[str, Verdict]]]


class DifferingError(Exception):
    """MuJoCo C moves the file itself otherwise."""


class Sweep:
    """Judges variants; those that differ in nothing that a step looks at are proven once.

    The laws are taken in turn, one for all that differ in numbers only: MJX is compiled once for these, its model being
    an argument. What fails so is proven again as jobs do.
    """

    def __init__(self, folder: Path, engines: Sequence[str] = ENGINES) -> None:
        self.folder = folder
        self.engines = engines
        self.laws: dict[bytes, str] = {}
        self.programs: dict[Any, Any] = {}
        self.known: dict[tuple[str, bytes], Verdict] = {}
        write_files(folder)

    def judge(self, variant: Variant) -> dict[str, Verdict]:
        """What becomes of a variant in each engine; the working directory is the folder."""
        (self.folder / "variant.xml").write_text(variant.text)
        try:
            bench = build(options(variant.joints, "baseline")["bench"])
            compiled = bench.compile(constraint=False)
            key = digest(compiled)
            law = self.laws.setdefault(digest(compiled, False), list(LAWS)[len(self.laws) % len(LAWS)])
            model = build(options(variant.joints, law)["model"], nv=bench.nv)
            compare_file(variant.text, bench, model)
        except Exception as error:
            return dict.fromkeys(self.engines, verdict_of(error))
        return {engine: self._simulate(variant, bench, model, engine, key) for engine in self.engines}

    def _simulate(self, variant: Variant, bench: Bench, model: FrictionModel, engine: str, key: bytes) -> Verdict:
        try:
            Drive.assemble(bench, model, "mjx")  # which takes over more than what a step looks at, for both engines
        except Exception as error:
            return verdict_of(error)
        if (engine, key) not in self.known:
            try:
                self._prove(variant.text, bench, model, engine)
                self.known[engine, key] = Verdict("equal")
            except Exception as error:
                self.known[engine, key] = verdict_of(error)
        return self.known[engine, key]

    def _prove(self, text: str, bench: Bench, model: FrictionModel, engine: str) -> None:
        if engine == "mjx":
            with contextlib.suppress(Exception):
                prove_file(text, bench, model, engine, self._in_mjx)
                return
        prove_file(text, bench, model, engine, proof._in_engine)

    def _in_mjx(self, bench: Bench, model: FrictionModel, name: str, values: Any, cases: Cases) -> np.ndarray:
        """As `proof._in_engine`, with one compiled function for all models of one structure."""
        with jax.enable_x64(True), naming_what_mjx_lacks(bench):
            engine = Drive.assemble(bench, copy.deepcopy(model), name).engine
            arrays = {key: getattr(engine, key) for key in ARRAYS}
            other = bench.nv, model.name, engine._timestep, engine._constraint
            if other not in self.programs:
                self.programs[other] = jax.jit(
                    functools.partial(roll, engine), compiler_options={**engine.forward_options, **proof._ONCE}
                )
            simulate = self.programs[other]
            known = [jax.tree.map(lambda value: np.asarray(value, np.float64), each) for each in values]
            return np.stack([[np.asarray(part) for part in simulate(arrays, each, cases)] for each in known])


ARRAYS = ("_model", "_data", "_rigid_inertia", "_body_jacobian", "_tendon_jacobian", "_ignores_armature")


def roll(engine: Engine, arrays: dict[str, Any], values: Values, cases: Cases) -> Any:
    """A rollout of an engine with a model of the same structure in place of its own."""
    other = copy.copy(engine)
    vars(other).update(arrays)
    return make_rollout(other)(values, *cases)


def verdict_of(error: Exception) -> Verdict:
    if isinstance(error, FrictionzooError) and "\n" not in str(error):
        return Verdict("refused", str(error))
    kind = "differing" if isinstance(error, DifferingError) else "traceback"
    return Verdict(kind, "".join(traceback.format_exception(error)) if kind == "traceback" else str(error))


@functools.cache
def options(joints: int, law: str) -> dict[str, Any]:
    """A job's options."""
    overrides = ("bench.mjcf=variant.xml", f"bench.joint={JOINTS[joints]}", f"model={law}", *LAWS[law])
    return OmegaConf.to_container(compose_config(*overrides), resolve=True)  # pyright: ignore[reportReturnType]


def digest(model: mujoco.MjModel, floats: bool = True) -> bytes:
    """Of all numbers in a model that a step may look at; without floats, of its structure."""
    found = hashlib.sha256()
    for part in (model, model.opt):
        for name in sorted(dir(part)):
            if name.startswith("_") or UNSEEN.fullmatch(name):
                continue
            value = getattr(part, name)
            if isinstance(value, (int, float, np.ndarray)):
                content = np.asarray(value).tobytes() if floats or np.asarray(value).dtype.kind != "f" else b""
                found.update(f"{name} {np.shape(value)} ".encode() + content)
    return found.digest()


def recorded(joints: int) -> Recorded:
    time = np.linspace(0, 8, 400)[:, None] + 0.3 * np.arange(joints)
    return Recorded(0.6 * np.sin(time), 0.6 * np.cos(time), Signals(0.6 * np.sin(time + 0.1)), np.zeros((400, 0)))


def compare_file(text: str, bench: Bench, model: FrictionModel) -> None:
    """See that MuJoCo C moves what the bench writes as it moves the file that it was read from."""
    values = initial_values(bench, model)
    cases: Cases = jax.tree.map(lambda signal: signal[:COMPARED], proof._draw(recorded(bench.nv)))
    written = bench.mjcf(values["bench"], np.ones(bench.nv) if model.constraint else None)
    exported = simulate(mujoco.MjModel.from_xml_string(written), bench, model, values, cases, True)
    refuse_difference(exported, simulate_file(text, bench, model, values, cases), "what the bench writes")


def prove_file(text: str, bench: Bench, model: FrictionModel, engine: str, simulated: Callable) -> None:
    """The proof, and that the engine moves the bench as MuJoCo C moves the file."""
    compared: list[tuple[Any, Any, Any]] = []

    def in_engine(bench: Bench, model: FrictionModel, engine: str, values: Any, cases: Cases) -> np.ndarray:
        found = simulated(bench, model, engine, values, cases)
        compared.append((values, cases, found))
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(proof, "_in_engine", in_engine)
        prove(bench, model, engine, initial_values(bench, model), recorded(bench.nv))
    for values, found in zip(compared[0][0], compared[0][2], strict=True):
        refuse_difference(found, simulate_file(text, bench, model, values, compared[0][1]), f"engine={engine}")


def refuse_difference(found: np.ndarray, expected: np.ndarray, what: str) -> None:
    with np.errstate(invalid="ignore"):
        sound = np.logical_and.accumulate((np.abs(expected) < OVERFLOW).all(axis=(0, 3)), axis=1)[..., None]
        difference = np.where(sound, np.abs(found - expected) / np.maximum(1, np.abs(expected)), 0)
    if not difference.max() <= TOLERANCE:
        raise DifferingError(f"{what}: {difference.max():.2g} from the file")


def simulate_file(text: str, bench: Bench, model: FrictionModel, values: Values, cases: Cases) -> np.ndarray:
    """The file as MuJoCo reads it, with the armature and a friction constraint; the actuator's torque is applied."""
    spec = mujoco.MjSpec.from_string(text)
    for name, armature in zip(bench.joints, values["bench"]["armature"], strict=True):
        joint = spec.joint(name)
        joint.armature, joint.solref_friction = armature, (0.02, 1.0)
        if model.constraint:
            joint.frictionloss = 1.0
    return simulate(spec.compile(), bench, model, values, cases, False)


def simulate(
    compiled: mujoco.MjModel, bench: Bench, model: FrictionModel, values: Values, cases: Cases, by_actuator: bool
) -> np.ndarray:
    """qpos and qvel after plain steps of MuJoCo C, of shape (2, cases, steps, nv); NaN from an overflow on."""
    own = compiled.dof_damping.copy()
    friction = {name: torch.tensor(np.asarray(value, np.float64)) for name, value in values["friction"].items()}
    found = np.full((2, *cases.signals.ctrl.shape), np.nan)
    for case, (qpos, qvel, commands) in enumerate(zip(cases.qpos, cases.qvel, cases.signals.ctrl, strict=True)):
        data, memory = mujoco.MjData(compiled), None
        data.qpos[:], data.qvel[:] = qpos, qvel
        for step, command in enumerate(commands):
            compiled.dof_damping[:], data.qfrc_applied[:] = own, 0
            applied, damped = drive(bench, values, data, command, by_actuator)
            for stage in (mujoco.mj_fwdPosition, mujoco.mj_fwdVelocity, mujoco.mj_fwdActuation):
                stage(compiled, data)
            limit = np.where(compiled.jnt_actfrclimited[:, None], compiled.jnt_actfrcrange, [-np.inf, np.inf])
            if not by_actuator:  # MuJoCo has the actuators, where there are any, compensate gravity
                applied = applied + np.where(compiled.jnt_actgravcomp, data.qfrc_gravcomp, 0)
            applied = np.clip(applied, *limit.T)
            seen = (data.qpos, data.qvel, command, data.qfrc_actuator + applied, data.qfrc_passive - data.qfrc_bias)
            state = DriveState(*(torch.tensor(np.array(signal)) for signal in seen))
            with torch.no_grad():
                memory = model.settle(torch, friction, state) if memory is None else memory
                terms, memory = model.advance(torch, friction, state, memory, compiled.opt.timestep)
            torque, frictionloss, damping = (0 if term is None else np.asarray(term) for term in terms)
            implicit = compiled.opt.integrator != mujoco.mjtIntegrator.mjINT_EULER
            # Implicit integrators know the slope of an actuator's force over velocity, and not of an applied one.
            slope = damped if implicit else 0
            compiled.dof_damping[:] = own + damping + slope
            data.qfrc_applied[:] = applied + slope * data.qvel - torque
            if model.constraint:
                compiled.dof_frictionloss[:] = frictionloss
            mujoco.mj_forward(compiled, data)
            if not np.abs(data.qacc).max() < OVERFLOW / compiled.opt.timestep:
                break
            mujoco.mj_step(compiled, data)
            found[:, case, step] = data.qpos, data.qvel
    return found


def drive(
    bench: Bench, values: Values, data: mujoco.MjData, command: np.ndarray, by_actuator: bool
) -> tuple[np.ndarray, np.ndarray]:
    """The torque that the actuator law has to be given by hand, and how much it falls with the velocity."""
    if by_actuator:
        data.ctrl[:] = command
        return np.zeros(bench.nv), np.zeros(bench.nv)
    gain, bias0, bias1, bias2 = bench.actuator.affine(values["bench"])
    return gain * command + bias0 + bias1 * data.qpos + bias2 * data.qvel, -bias2


def draw(seed: int, count: int | None, joints: Iterable[int] = JOINTS) -> list[Place]:
    """Places of the schema with each of these numbers of joints; all of them where no count is given."""
    places = [(place, attribute, number) for number in joints for place, attribute in all_places()]
    return places if count is None else random.Random(seed).sample(places, count)


def sweep(folder: Path, places: Sequence[Place], engines: Sequence[str] = ENGINES) -> Judged:
    judge = Sweep(folder, engines).judge
    return [(variant, judge(variant)) for place in places for variant in variants(*place)]


def describe(places: Sequence[Place], judged: Judged) -> str:
    """The counts, then the reasons for refusals with theirs and an example, then whatever is wrong."""
    lines = [f"{len(places)} places of the schema, {len(judged)} models that MuJoCo compiles"]
    reasons: dict[tuple[str, str], list[str]] = collections.defaultdict(list)
    for joints, engine in itertools.product(JOINTS, ENGINES):
        found = [(variant, verdicts[engine]) for variant, verdicts in judged if variant.joints == joints]
        kinds = collections.Counter(verdict.kind for _, verdict in found)
        counts = ", ".join(f"{kinds[kind]} {kind}" for kind in ("equal", "refused", "differing", "traceback"))
        lines.append(f"joints {joints}, {engine}: {len(found)} models, {counts}")
        for variant, verdict in found:
            if verdict.kind == "refused":
                reasons[engine, re.sub(SPECIFIC, "*", verdict.why)].append(variant.name)
    for (engine, why), names in sorted(reasons.items(), key=lambda item: -len(item[1])):
        lines.append(f"{len(names)} {engine}: {why} [{names[0]}]")
    return "\n".join([*lines, *wrong(judged)])


def wrong(judged: Judged) -> list[str]:
    return [
        f"joints {variant.joints}, {engine}, {variant.name}: {kind}: {why}"
        for variant, verdicts in judged
        for engine, (kind, why) in verdicts.items()
        if kind not in ("equal", "refused")
    ]


@pytest.fixture
def in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_haste: None) -> Path:
    """The working directory, in which MuJoCo looks for files."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(proof, "_TRIALS", 1)  # of finding the element at fault
    return tmp_path


def test_a_few_places_of_the_schema(in_folder: Path) -> None:
    assert not wrong(sweep(in_folder, draw(0, 8, [1]), ["specialised"]))


@pytest.mark.slow
def test_the_schema(in_folder: Path) -> None:
    count = os.environ.get("FRICTIONZOO_SCHEMA", "30")
    places = draw(1, None if count == "all" else int(count))
    judged = sweep(in_folder, places)
    print(describe(places, judged))
    assert not wrong(judged)
