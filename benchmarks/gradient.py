"""Time of a loss with its gradient, the specialised engine against stock MJX: `python benchmarks/gradient.py`.

Four variants compute the same objective in float32. `specialised` and `mjx` are this package's engines in its
objective. `mjx.step` is a user's code without this package: `jax.grad` through vmapped `mjx.step`. `mjx.step-unfused`
is the same without XLA's fusion, which on CPUs can compute shared terms repeatedly. The cases are the paper's drive on
its twin's recording, and chains of hinges with Coulomb and viscous friction in every joint.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from measure import compile_time, make_parser, median_time, report
from omegaconf import OmegaConf

from frictionzoo.bench import Bench
from frictionzoo.core.build import build
from frictionzoo.core.config import compose_config
from frictionzoo.core.segments import Segments, cut_segments
from frictionzoo.core.state import DriveState, Signals
from frictionzoo.fit import Objective, Space
from frictionzoo.models import FrictionModel
from frictionzoo.simulation import Engine, MjxEngine, Values, friction_of
from frictionzoo.simulation.drive import Drive
from frictionzoo.simulation.rollout import make_rollout

COLUMNS = {
    "case": "case",
    "way": "way",
    "derivative": "derivative",
    "parameters": "parameters",
    "setup": "setup [s]",
    "compile": "compile [s]",
    "seconds": "gradient [s]",
    "calls": "calls",
    "ratio": "ratio",
    "difference": "difference",
}
DTYPE = "float32"
AXES = ("0 1 0", "1 0 0", "0 0 1")
JOINTS = (2, 4, 7)
WAYS = ("specialised", "mjx", "mjx.step", "mjx.step-unfused")  # the first is the reference
XLA_OPTIONS = {"mjx.step": {}, "mjx.step-unfused": {"xla_disable_hlo_passes": "fusion"}}
STEPS = 5
QUICK_DATA = ("data.samples=6000", "data.cache_dir=null", "segments.count=200")


@dataclass(frozen=True)
class Case:
    """Objective to differentiate.

    Attributes:
        name: Name in the table.
        bench: Bench with the drive.
        model: Friction model that returns only a torque.
        segments: Measured segments.
        loss: Options of the objective.
    """

    name: str
    bench: Bench
    model: FrictionModel
    segments: Segments
    loss: Mapping[str, Any]

    @property
    def space(self) -> Space:
        """Return the parameters of the gradient."""
        return Space(self.bench, self.model, DTYPE)


@dataclass(frozen=True)
class Prepared:
    """Loss with its gradient, ready to compile.

    Attributes:
        function: Function of a vector and the data.
        data: Last argument of the function.
        compiler: Function that compiles it.
    """

    function: Callable[[Array, Any], tuple[Array, Array]]
    data: Any
    compiler: Callable[..., Any]


class PlainMjx(Engine):
    """Stock `mjx.step`, with friction as an applied force.

    Args:
        case: Case to simulate.
    """

    name = "mjx.step"
    forward_limit = MjxEngine.forward_limit

    def __init__(self, case: Case) -> None:
        from mujoco import mjx  # after frictionzoo's import, which keeps it from printing

        self.compiler_options, self.forward_options, self.bench = {}, {}, case.bench
        self._law, self.friction = case.model, friction_of(case.model)
        self._mjx_step = mjx.step
        self._model = mjx.put_model(case.bench.compile(constraint=False))
        self._data = mjx.make_data(self._model)

    def step(
        self, values: Values, qpos: Array, qvel: Array, signals: Signals, load: Array, memory: Array
    ) -> tuple[Array, Array, Array]:
        """See `Engine.step`."""
        torque = self._law.terms(jnp, values["friction"], self.drive_state(values, qpos, qvel, signals, load)).torque
        model = self._model.replace(dof_armature=values["bench"]["armature"])
        data = self._data.replace(qpos=qpos, qvel=qvel, ctrl=signals.ctrl, qfrc_applied=-torque)
        data = self._mjx_step(model, data)
        return data.qpos, data.qvel, memory

    def drive_state(self, values: Values, qpos: Array, qvel: Array, ctrl: Array, load: Array) -> DriveState:
        """Return the state before a step, where torques are unknown."""
        return DriveState(qpos, qvel, ctrl, None, None)


def main() -> None:
    """Measure, print and write the results."""
    options = parse()
    rows: list[dict[str, Any]] = []
    reference: dict[str, np.ndarray] = {}
    for case, way, derivative in measurements(options):
        row, gradient = measure(case, way, derivative)
        specialised = reference.setdefault(case.name, gradient)  # each case begins with the specialised engine
        rows.append(row | {"ratio": ratio(row, rows), "difference": difference(gradient, specialised)})
        print(f"{case.name}, {way}, {derivative}: {row['seconds']:.3g} s", flush=True)
    print()
    report(options.out, rows, COLUMNS, quick=options.quick, dtype=DTYPE, steps=STEPS)


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser("gradient", __doc__)
    parser.add_argument("--joints", type=int, nargs="*", default=JOINTS, metavar="N", help="lengths of the chains")
    parser.add_argument("--ways", nargs="*", choices=WAYS, default=WAYS, metavar="WAY", help=", ".join(WAYS))
    parser.add_argument("--quick", action="store_true", help="few segments, and no stock MJX for more than two joints")
    return parser.parse_args()


def measurements(options: argparse.Namespace) -> Iterator[tuple[Case, str, str]]:
    """Yield each measurement as case, way and derivative, the specialised engine first in each case."""
    ways = [way for way in WAYS if way == WAYS[0] or way in options.ways]
    case = knee(options.quick)
    for way in ways:
        for derivative in ("reverse", "forward"):
            yield case, way, derivative
    for joints in options.joints:
        case = chain(joints, 50 if options.quick else 4000)
        for way in ways[:1] if options.quick and joints > 2 else ways:
            yield case, way, "reverse"


def knee(quick: bool) -> Case:
    """Return the paper's drive with segments of the twin's recording."""
    settings = compose("model=coulomb_stribeck", f"segments.length={STEPS}", *(QUICK_DATA if quick else ()))
    bench = build(settings["bench"])
    segments = cut_segments(build(settings["data"]).load().train, **settings["segments"])
    return Case("knee", bench, build(settings["model"], nv=bench.nv), segments, settings["loss"])


def chain(joints: int, count: int) -> Case:
    """Return a serial chain of hinges about changing axes, with random segments.

    The parameters are armature, Coulomb and viscous friction of every joint.
    """
    names = ",".join(f"j{index}" for index in range(joints))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "chain.xml"
        path.write_text(chain_mjcf(joints))
        settings = compose(
            *("model=coulomb_smooth", "model.params.smoothing.identify=false"),
            *(f"bench.mjcf={path}", f"bench.joint=[{names}]"),
        )
        bench = build(settings["bench"])
    model = build(settings["model"], nv=joints)
    return Case(f"chain of {joints}", bench, model, random_segments(joints, count), settings["loss"])


def chain_mjcf(joints: int) -> str:
    """Return the MJCF of a chain of hinges, `j0` first."""
    body = ""
    for index in reversed(range(joints)):
        body = (
            f'<body pos="0 0 -0.2"><joint name="j{index}" axis="{AXES[index % len(AXES)]}"/>'
            f'<inertial pos="0.01 0.02 -0.11" mass="0.26" diaginertia="0.0011 0.0012 0.0004"/>{body}</body>'
        )
    return f'<mujoco><option timestep="0.001"/><worldbody>{body}</worldbody></mujoco>'


def random_segments(joints: int, count: int) -> Segments:
    """Draw segments around random states; times do not depend on whether the drive can follow them."""
    rng = np.random.default_rng(joints)
    start = rng.normal(size=(2, count, 1, joints))
    qpos, qvel = start + 0.1 * rng.normal(size=(2, count, STEPS + 1, joints))
    ctrl = start[0] + 0.1 * rng.normal(size=(count, STEPS, joints))
    return Segments(qpos, qvel, Signals(ctrl), 0.001)


def compose(*overrides: str) -> dict[str, Any]:
    """Return the settings of a job with these overrides."""
    return cast(dict[str, Any], OmegaConf.to_container(compose_config(*overrides), resolve=True))


def measure(case: Case, way: str, derivative: str) -> tuple[dict[str, Any], Float[np.ndarray, "parameters"]]:
    """Measure one row without comparisons; return it with the gradient."""
    began = time.perf_counter()
    prepare = plain if way in XLA_OPTIONS else packaged
    prepared = prepare(case, way, derivative)
    setup = time.perf_counter() - began
    start = case.space.start
    compiled, compile_seconds = compile_time(prepared.compiler, prepared.function, start, prepared.data)
    timed = median_time(compiled, start, prepared.data)
    row = {
        "case": case.name,
        "way": way,
        "derivative": derivative,
        "segments": case.segments.count,
        "parameters": len(start),
        "setup": setup,
        "compile": compile_seconds,
        "seconds": timed.seconds,
        "calls": timed.calls,
    }
    return row, np.asarray(timed.answer[1], np.float64)


def packaged(case: Case, engine: str, derivative: str) -> Prepared:
    """Prepare the objective of this package's fits."""
    rollout = Drive.assemble(case.bench, case.model, engine).rollout
    objective = Objective(case.space, rollout, case.segments, **case.loss)
    return Prepared(objective.value_and_grad(derivative), objective.data, objective.compile)


def plain(case: Case, way: str, derivative: str) -> Prepared:
    """Prepare the same objective as an MJX user writes it: all segments at once."""
    space, rollout = case.space, make_rollout(PlainMjx(case))
    signals = (case.segments.qpos, case.segments.qvel, case.segments.signals)
    weights = case.loss["position"], case.loss["velocity"]

    def loss(vector: Array, data: tuple[Array, Array, Signals]) -> tuple[Array, Array]:
        qpos, qvel, driven = data
        predicted = rollout(space.values(vector), qpos[:, 0], qvel[:, 0], driven)
        errors = [jnp.mean(jnp.square(after - now[:, 1:])) for after, now in zip(predicted, (qpos, qvel), strict=True)]
        total = weights[0] * errors[0] + weights[1] * errors[1]
        return total, total

    differentiate = jax.grad if derivative == "reverse" else jax.jacfwd

    def value_and_grad(vector: Array, data: tuple[Array, Array, Signals]) -> tuple[Array, Array]:
        gradient, value = differentiate(loss, has_aux=True)(vector, data)
        return value, gradient

    data = jax.tree.map(partial(jnp.asarray, dtype=DTYPE), signals)
    return Prepared(value_and_grad, data, partial(jax.jit, compiler_options=XLA_OPTIONS[way]))


def ratio(row: Mapping[str, Any], before: Sequence[Mapping[str, Any]]) -> float:
    """Return the row's time over the specialised engine's time with the same derivative."""
    same = [other for other in (*before, row) if all(other[key] == row[key] for key in ("case", "derivative"))]
    return row["seconds"] / same[0]["seconds"]


def difference(gradient: Float[np.ndarray, "parameters"], specialised: Float[np.ndarray, "parameters"]) -> float:
    """Return the largest relative difference of two gradients, entry by entry."""
    return float(np.max(np.abs(gradient / specialised - 1)))


if __name__ == "__main__":
    main()
