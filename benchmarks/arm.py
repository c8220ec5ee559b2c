"""Inverse dynamics on a simulated arm of seven joints whose link masses differ from the model file.

    python benchmarks/arm.py

MuJoCo C simulates an arm of the size of a lightweight robot at 10 kHz under a 1 kHz controller, with slight encoder
noise. The links are 10 to 30 % heavier or lighter than the file states. The arm has armature, Coulomb and viscous
friction and delayed commands. `fit=inverse_dynamics fit.links=link.*` identifies all of these from positions, commanded
torques and the file with the wrong links. Errors are relative to the hidden values.
"""

import argparse
import contextlib
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
from jaxtyping import Float
from measure import make_parser, report

from frictionzoo.bench import Bench, Force
from frictionzoo.bench.inertia import LogCholesky, inertial_parameters, is_consistent, put_parameters
from frictionzoo.core.log import Log
from frictionzoo.fit import InverseDynamics, Space
from frictionzoo.fit.link_inertia import LinkInertia
from frictionzoo.fit.motion import Recordings
from frictionzoo.fit.torque_balance import FreeLinks, balance
from frictionzoo.fit.torque_equation import TorqueEquation
from frictionzoo.models import FrictionModel
from frictionzoo.models.registry import get_model

JOINTS = tuple(f"joint{number}" for number in range(1, 8))
AXES = ("0 0 1", "0 1 0", "0 0 1", "0 -1 0", "0 0 1", "0 1 0", "0 0 1")
LENGTHS = (0.16, 0.2, 0.2, 0.2, 0.19, 0.08, 0.1)  # m
MASSES = (2.7, 2.7, 2.7, 2.7, 1.7, 1.6, 0.3)  # kg, in the model file
TRUTH = {  # kg m^2, N m, N m s/rad, s
    "armature": np.array([0.5, 0.5, 0.3, 0.3, 0.15, 0.08, 0.05]),
    "frictionloss": np.array([7.0, 8.0, 5.0, 4.0, 2.0, 1.5, 0.8]),
    "damping": np.array([8.0, 9.0, 5.0, 4.0, 2.0, 1.2, 0.8]),
    "delay": np.full(7, 0.0043),
}
KP, KD = np.array([2000, 2000, 1200, 1200, 500, 250, 150.0]), np.array([100, 100, 60, 60, 25, 10, 6.0])
SAMPLE, STEP = 1e-3, 1e-4  # s
COLUMNS = {
    "bandwidth": "bandwidth [Hz]",
    "quantity": "quantity",
    "number": "numbers",
    "determined": "determined",
    "largest": "largest error [%]",
    "mean": "mean error [%]",
    "uncertainty": "largest standard error [%]",
    "wrong_links": "with the file's links [%]",
}


def main() -> None:
    """Simulate and identify the arm; report errors for each bandwidth."""
    options = parse()
    jax.config.update("jax_enable_x64", True)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.xml"
        path.write_text(write_arm())
        bench, rng = make_bench(path), np.random.default_rng(options.seed)
        links = hide(bench, rng)
        drive = make_drive(bench, links)
        logs = [record(drive, options.seconds, seed, rng) for seed in range(options.recordings)]
        recordings = Recordings(bench, make_law(), tuple(map(bench.accept, logs)))
        rows = [row for bandwidth in options.bandwidths for row in identify(recordings, links, bandwidth, options.sure)]
    settings = {name: value for name, value in vars(options).items() if name not in ("out", "bandwidths")}
    report(options.out, rows, COLUMNS, **settings)


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser("arm", __doc__)
    parser.add_argument("--bandwidths", nargs="+", type=float, default=[40.0, 20.0], metavar="HZ")
    parser.add_argument("--recordings", type=int, default=2, metavar="N")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each recording")
    parser.add_argument("--sure", type=float, default=0.01, help="relative standard error of what counts as determined")
    parser.add_argument("--seed", type=int, default=1)
    return parser.parse_args()


def write_arm() -> str:
    """Return the model file: links with inertia, without armature, friction or actuators."""
    body = ""
    for index in reversed(range(len(JOINTS))):
        mass, length = MASSES[index], LENGTHS[index]
        size = mass * (length**2 / 12 + 0.003)
        body = (
            f'<body name="link{index + 1}" pos="0 0 {LENGTHS[index - 1] if index else 0.11}">'
            f'<joint name="{JOINTS[index]}" axis="{AXES[index]}"/><inertial pos="0.003 {0.02 * (-1) ** index} '
            f'{length / 2}" mass="{mass}" diaginertia="{size:.6f} {size:.6f} {0.003 * mass:.6f}"/>{body}</body>'
        )
    return f'<mujoco><option timestep="{SAMPLE}"/><worldbody>{body}</worldbody></mujoco>'


def make_bench(path: Path) -> Bench:
    """Return the arm as in its file, with armatures and one common delay to identify."""
    delay = {"init": 0.003, "low": 0.0, "high": 0.02, "scale": 0.01, "identify": True, "tie": True}
    return Bench(str(path), JOINTS, actuator=Force(), params={"armature": section(0.05), "delay": delay})


def make_law() -> FrictionModel:
    """Return Coulomb and viscous friction to identify."""
    return get_model("mujoco_default")(len(JOINTS), {name: section(1.0) for name in ("frictionloss", "damping")})


def section(init: float) -> dict[str, Any]:
    """Return the settings of a parameter with wide bounds."""
    return {"init": init, "low": 1e-4, "high": 100.0, "scale": "log", "identify": True}


def hide(bench: Bench, rng: np.random.Generator) -> Float[np.ndarray, "7 10"]:
    """Draw inertial parameters of links 10 to 30 % heavier or lighter than in the file."""
    maker, off = inertial_parameters(bench.compile(constraint=False), range(1, 8)), np.zeros((7, 10))
    off[:, 0] = np.log1p(rng.choice([-1, 1], 7) * rng.uniform(0.1, 0.3, 7))
    return LogCholesky.around(maker, JOINTS).parameters(off)


def make_drive(bench: Bench, links: Float[np.ndarray, "7 10"]) -> mujoco.MjModel:
    """Compile the hidden arm."""
    values = {**bench.initial_values(), "armature": TRUTH["armature"], "delay": np.zeros(7)}
    model = mujoco.MjModel.from_xml_string(bench.mjcf(values, TRUTH["frictionloss"], TRUTH["damping"]))
    for body, own in enumerate(links, 1):
        put_parameters(model, body, own)
    model.opt.timestep = STEP
    model.dof_solref[:] = [0.002, 1.0]  # sticking joints creep less than with MuJoCo's default
    return model


def record(model: mujoco.MjModel, seconds: float, seed: int, rng: np.random.Generator) -> Log:
    """Record sums of sines in each joint, under a controller with delayed torques."""
    phases = np.random.default_rng(seed).uniform(0, 2 * np.pi, (5, 7))
    rates = 2 * np.pi * np.array([0.1, 0.23, 0.41, 0.67, 1.1])[:, None]
    sizes = (
        np.random.default_rng(seed + 100).uniform(0.5, 1.0, (5, 7)) * np.array([0.6, 0.3, 0.22, 0.14, 0.09])[:, None]
    )
    times = SAMPLE * np.arange(round(seconds / SAMPLE))
    data, states, torques = mujoco.MjData(model), np.empty((len(times), 7)), np.empty((len(times), 7))
    substeps, queue = round(SAMPLE / STEP), [np.zeros(7)] * round(TRUTH["delay"][0] / STEP)
    data.qpos[:] = (sizes * np.sin(phases)).sum(axis=0)
    data.qvel[:] = (sizes * rates * np.cos(phases)).sum(axis=0)
    for at, now in enumerate(times):
        wanted = (sizes * np.sin(rates * now + phases)).sum(axis=0)
        moving = (sizes * rates * np.cos(rates * now + phases)).sum(axis=0)
        states[at], torques[at] = data.qpos, KP * (wanted - data.qpos) + KD * (moving - data.qvel)
        for _ in range(substeps):
            queue.append(torques[at])
            data.ctrl[:] = queue.pop(0)
            mujoco.mj_step(model, data)
    states += 2e-6 * rng.normal(size=states.shape)
    return Log(
        f"arm {seed}", times, states, np.asarray(np.gradient(states, SAMPLE, axis=0)), torques, "", simulated=True
    )


def identify(
    recordings: Recordings, links: Float[np.ndarray, "7 10"], bandwidth: float, sure: float
) -> list[dict[str, Any]]:
    """Identify with this bandwidth; return one row per quantity."""
    fit, began = InverseDynamics(bandwidth=bandwidth, links="link.*"), time.perf_counter()
    with watched() as seen:
        found = fit.revise(recordings)
    assert found is not None
    bench = recordings.bench.with_inertia(found.inertia)
    given, errors = solve(fit, recordings._replace(bench=bench))
    wrong, _ = solve(fit, recordings)
    seconds = time.perf_counter() - began
    rows = [row_of(name, true, given[name], errors[name], wrong[name], sure) for name, true in TRUTH.items()]
    rows.append(base_row(found, recordings, links, sure))
    say(found, seen, bandwidth, seconds)
    return [{"bandwidth": bandwidth, **row, "seconds": seconds} for row in rows]


def solve(
    fit: InverseDynamics, recordings: Recordings
) -> tuple[dict[str, Float[np.ndarray, "7"]], dict[str, Float[np.ndarray, "7"]]]:
    """Identify the drives with these links; return values and relative standard errors by name."""
    space = Space(recordings.bench, recordings.model, "float64")
    equation = TorqueEquation(space, recordings, fit.filtering, fit.held)
    found = balance(equation)
    names = {name: name.partition(".")[2] for name in space.params}
    values = {names[name]: value for name, value in space.physical(found.vector).items()}
    wide = space.physical(found.vector + found.errors)
    return values, {names[name]: np.abs(value / values[names[name]] - 1) for name, value in wide.items()}


def row_of(
    name: str,
    true: Float[np.ndarray, "n"],
    came: Float[np.ndarray, "n"],
    errors: Float[np.ndarray, "n"],
    wrong: Float[np.ndarray, "n"],
    sure: float,
) -> dict[str, Any]:
    """Return the errors of the determined values, in per cent."""
    told = errors < sure
    off = 100 * np.abs(came / true - 1)[told]
    return {
        "quantity": name,
        "number": len(true),
        "determined": int(told.sum()),
        "largest": float(off.max(initial=0.0)),
        "mean": float(off.mean()) if told.any() else 0.0,
        "uncertainty": 100 * float(errors[told].max(initial=0.0)),
        "wrong_links": 100 * float(np.abs(wrong / true - 1)[told].max(initial=0.0)),
    }


def base_row(
    found: LinkInertia, recordings: Recordings, links: Float[np.ndarray, "7 10"], sure: float
) -> dict[str, Any]:
    """Return the row of the base parameters: combinations of link inertia, armature, friction and delay."""
    space = Space(recordings.bench, recordings.model, "float64")
    told = (label.partition("/") for label in space.labels)
    drives = [TRUTH[name.partition(".")[2]][JOINTS.index(joint) if joint else 0] for name, _, joint in told]
    true, wrong = (found.base.matrix @ np.concatenate([drives, own.ravel()]) for own in (links, found.maker))
    tiny = np.abs(true) < 1e-12  # zero because links are symmetric
    relative = np.where(tiny, np.inf, found.errors / np.maximum(np.abs(found.values), 1e-12))
    return row_of("base parameters", np.where(tiny, 1.0, true), found.values, relative, wrong, sure)


def say(found: LinkInertia, seen: list[bool], bandwidth: float, seconds: float) -> None:
    """Print results that the table omits."""
    steps = f"a body of matter at {sum(seen)} of {len(seen)} steps"
    print(f"{bandwidth:g} Hz: {seconds:.0f} s; each link {steps}")
    rows = zip(found.base.describe(), found.determined, strict=True)
    print("not determined by the data:", "; ".join(text for text, told in rows if not told) or "none")
    print("only the prior:", ", ".join(found.prior_only) or "none")


@contextlib.contextmanager
def watched() -> Iterator[list[bool]]:
    """Yield a list that records at each fit step whether all link inertias are physically consistent."""
    seen, look = list[bool](), FreeLinks.prior

    def watch(links: FreeLinks, parameters: Float[np.ndarray, "bodies 10"]) -> Any:
        seen.append(bool(is_consistent(parameters).all()))
        return look(links, parameters)

    FreeLinks.prior = watch
    try:
        yield seen
    finally:
        FreeLinks.prior = look


if __name__ == "__main__":
    main()
