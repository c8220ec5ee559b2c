"""Accuracy for a new user: one command with only the files, on logs of hidden drives, compared with the truth.

    python benchmarks/newcomer.py
    python benchmarks/newcomer.py --drives 5 --first 20 --kinds late leg
    python benchmarks/newcomer.py --drives 3 --kinds arm slow_arm quadruped

Each drive has one of eight kinds, with different friction, armature, link, gains, encoder and delay. Robots run only on
request (`--kinds`). `event_exact.py` simulates the motion, without MuJoCo. The fitted model is the model of the drive.
"""

import argparse
import itertools
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from event_exact import Drive, Link, filter_velocity, round_to, simulate, write_mjcf
from jaxtyping import Float
from measure import make_parser, report

VELOCITY_NOISE = 0.02  # rad/s
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
PAYLOADS = (0.0, 0.3, 0.6)  # kg
COLUMNS = {
    "drive": "drive",
    "kind": "kind",
    "rate": "rate [Hz]",
    "bits": "encoder [bit]",
    "delay": "delay [ms]",
    "sticking": "sticks [%]",
    "armature": "armature [% off]",
    "friction": "dry friction [% off]",
    "damping": "damping [% off]",
    "held": "in its interval",
    "missed": "outside",
    "noise": "error [encoder noise]",
    "processor": "processor [s]",
}


@dataclass(frozen=True)
class Kind:
    """Kind of hidden drives.

    Attributes:
        law: Friction model of the drive and of the fit.
        rate: Sample rate [Hz].
        bits: Encoder bits per turn.
        velocity: Velocity in the log: `noisy`, `filtered` from positions, or `none`.
        speed: Speed of the excitation relative to the default.
        payloads: Whether several recordings carry different masses.
        axes: Joint axes of a chain, from its base.
        chains: Number of chains.
        mass: Smallest link mass [kg]; the largest is four times as much.
        seconds: Length of a recording [s]; with payloads, half of it.
    """

    law: str = "mujoco_default"
    rate: int = 500
    bits: int = 14
    velocity: str = "noisy"
    speed: float = 1.0
    payloads: bool = False
    axes: str = "y"
    chains: int = 1
    mass: float = 0.2
    seconds: float = 40.0

    def draw(self, rng: np.random.Generator, late: bool) -> Drive:
        """Draw the drive of one joint."""

        def spread(low: float, high: float) -> float:
            return float(np.exp(rng.uniform(np.log(low), np.log(high))))

        drive = Drive(
            armature=spread(0.01, 0.1),
            viscous=spread(0.05, 0.5),
            forward=spread(0.1, 0.5),
            kp=spread(15, 60),
            kd=spread(0.5, 2.0),
            delay=round(rng.uniform(0.004, 0.025), 4) if late else 0.0,
        )
        if self.law == "stribeck":
            return replace(drive, breakaway=rng.uniform(1.3, 1.8), stribeck=spread(0.08, 0.3))
        if self.law == "load_dependent":
            return replace(drive, load=rng.uniform(0.05, 0.2))
        if self.law == "asymmetric":
            return replace(drive, backward=drive.forward * rng.uniform(0.6, 1.4))
        return replace(drive, bristle=drive.forward / spread(1e-3, 1e-2)) if self.law == "dahl" else drive


KINDS: Mapping[str, Kind] = {
    "coulomb": Kind(rate=1000),
    "late": Kind(rate=200, bits=12, velocity="none"),
    "stribeck": Kind("stribeck", rate=1000, velocity="filtered"),
    "load": Kind("load_dependent", payloads=True),
    "sticking": Kind(speed=0.12),
    "directional": Kind("asymmetric"),
    "presliding": Kind("dahl", rate=1000, bits=16),
    "leg": Kind(bits=15, axes="yy"),
    "arm": Kind(bits=12, velocity="none", axes="zyyyxy", mass=0.05, seconds=24.0),
    "slow_arm": Kind(rate=50, bits=12, velocity="none", speed=0.5, axes="zyyyxy", mass=0.05, seconds=120.0),
    "quadruped": Kind(bits=15, axes="xyy", chains=4, seconds=24.0),
    "chain": Kind(bits=15, axes="zyyyxyz", mass=0.05, seconds=40.0),
}
ROBOTS = ("arm", "slow_arm", "quadruped", "chain")


@dataclass(frozen=True)
class Hidden:
    """Links and hidden drives of one stand."""

    name: str
    kind: Kind
    seed: int
    links: Sequence[Link]
    drives: Sequence[Drive]

    @classmethod
    def draw(cls, name: str, seed: int) -> "Hidden":
        """Draw links and drives of a kind from a seed."""
        rng, kind = np.random.default_rng(5000 + seed), KINDS[name]
        links: list[Link] = []
        for chain, (joint, axis) in itertools.product(range(kind.chains), enumerate(kind.axes)):
            mass, length = rng.uniform(kind.mass, 4 * kind.mass), rng.uniform(0.1, 0.25)
            round_it = mass * length**2 / 12
            parent = len(links) - 1 if joint else -1
            place = (0.0, 0.02, links[-1].centre[2] * 2) if joint else (0.3 * chain, 0.0, 0.0)
            inertia = round_it, round_it, 1e-5
            links.append(Link(parent, AXES[axis], place, mass, (0, 0, -length / 2), inertia))
        return cls(name, kind, seed, links, [kind.draw(rng, name == "late") for _ in links])

    @property
    def names(self) -> list[str]:
        """Return the joint names."""
        return ["motor"] if len(self.links) == 1 else [f"joint{number}" for number, _ in enumerate(self.links)]

    def record(self, folder: Path) -> float:
        """Write the stand's MJCF and the logs; return the share of time in which joints stick."""
        rng, interval = np.random.default_rng(self.seed), 1 / self.kind.rate
        folder.mkdir(parents=True)
        (folder / "stand.xml").write_text(write_mjcf(self.links, self.names))
        sticking = []
        for number, payload in enumerate(PAYLOADS if self.kind.payloads else (0.0,)):
            time = np.arange(round(self.kind.seconds / (2 if self.kind.payloads else 1) / interval)) * interval
            ctrl = np.stack([_excite(time, self.kind.speed, rng) for _ in self.links], axis=1)
            at = (0.0, 0.0, 2 * self.links[-1].centre[2])
            links = [*self.links[:-1], self.links[-1].with_payload(payload, at)]
            motion = simulate(links, self.drives, ctrl, interval)
            sticking.append(motion.sticking)
            columns = {"time": time[:, None], "qpos": round_to(motion.qpos, self.kind.bits)}
            if self.kind.velocity == "noisy":
                columns["qvel"] = motion.qvel + rng.normal(0.0, VELOCITY_NOISE, motion.qvel.shape)
            elif self.kind.velocity == "filtered":
                columns["qvel"] = filter_velocity(columns["qpos"], interval, 100.0)
            columns["ctrl"] = ctrl
            named = [
                name if name == "time" or len(self.links) == 1 else f"{name}_{joint}"
                for name, of in columns.items()
                for joint in (self.names if of.shape[1] > 1 else [""])
            ]
            rows = np.concatenate(list(columns.values()), axis=1)
            np.savetxt(folder / f"log{number}.csv", rows, "%.9g", ",", header=",".join(named), comments="")
        return float(np.mean(sticking))

    def options(self, folder: Path) -> list[str]:
        """Return the options of the command line: files, gains, model and payload."""
        logs = ",".join(str(path) for path in sorted(folder.glob("log*.csv")))
        one = len(self.drives) == 1
        options = ["data=files", f"data.train=[{logs}]", f"bench.mjcf={folder / 'stand.xml'}", f"model={self.kind.law}"]
        options.append("bench=knee" if one else "bench=robot")
        options.append(f"bench.joint={'motor' if one else '[' + ','.join(self.names) + ']'}")
        for gain in ("kp", "kd"):
            values = [getattr(drive, gain) for drive in self.drives]
            options.append(f"bench.actuator.params.{gain}.init={values[0] if one else values}".replace(" ", ""))
        if self.kind.payloads:
            far, link = self.links[-1].centre[2] * 2, "motor_link"
            each = ",".join(f"[{mass},0,0,{far},0,0,0]" for mass in PAYLOADS)
            options += [f"bench.payload={link}", f"data.payload=[{each}]"]
        return options

    def truths(self) -> dict[str, list[float]]:
        """Return the true values of the parameters of model and bench, by their names in the result."""

        def each(name: str) -> list[float]:
            return [getattr(drive, name) for drive in self.drives]

        loss, drives = each("forward"), self.drives
        truths = {"armature": each("armature"), "delay": each("delay"), "position_offset": [0.0] * len(drives)}
        own: dict[str, dict[str, list[float]]] = {
            "stribeck": {
                "stribeck_torque": [d.forward * (d.breakaway - 1) for d in drives],
                "stribeck_velocity": each("stribeck"),
            },
            "load_dependent": {"load_friction": each("load")},
            "asymmetric": {
                "frictionloss_forward": loss,
                "frictionloss_backward": [d.forward if d.backward is None else d.backward for d in drives],
                "damping_forward": each("viscous"),
                "damping_backward": each("viscous"),
            },
            "dahl": {"coulomb_torque": loss, "stiffness": each("bristle"), "viscous_coefficient": each("viscous")},
        }
        plain = {"frictionloss": loss, "damping": each("viscous")}
        return truths | plain | own.get(self.kind.law, {})


def _excite(time: Float[np.ndarray, "time"], speed: float, rng: np.random.Generator) -> Float[np.ndarray, "time"]:
    """Return positions of five velocity harmonics, as in the paper, without drift."""
    amplitude, frequency, phase = rng.uniform(0.3, 1.5, 5), rng.uniform(0.5, 10, 5), rng.uniform(0, 2 * np.pi, 5)
    position = -(speed * amplitude / frequency * np.cos(time[:, None] * frequency + phase)).sum(axis=1)
    return position - position.mean()


def main() -> None:
    """Run each drive and report a table."""
    options = parse()
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        for number in range(options.first, options.first + options.drives):
            hidden = Hidden.draw(options.kinds[number % len(options.kinds)], number)
            rows.append(run(hidden, Path(scratch) / str(number), options.more))
            print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    for what in ("armature", "friction", "damping", "noise", "processor"):
        values = [row[what] for row in rows]
        print(f"{what}: median {np.median(values):.3g}, largest {max(values):.3g}")
    held, missed = (sum(len(row[what].split()) for row in rows) for what in ("held", "missed"))
    print(f"in their intervals: {held} of {held + missed} parameters")
    report(options.out, rows, COLUMNS, first=options.first)


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser("newcomer", __doc__)
    parser.add_argument("--drives", type=int, default=24, metavar="N", help="how many hidden drives")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="seed of the first")
    parser.add_argument(
        "--kinds", nargs="+", choices=tuple(KINDS), default=[each for each in KINDS if each not in ROBOTS]
    )
    parser.add_argument("--more", nargs="*", default=[], metavar="OPTION", help="options of frictionzoo.run besides")
    return parser.parse_args()


def run(hidden: Hidden, folder: Path, more: Sequence[str] = ()) -> dict[str, Any]:
    """Run one command and return a row with the errors of its result."""
    sticking, out = hidden.record(folder), folder / "run"
    command = [sys.executable, "-m", "frictionzoo.run", *hidden.options(folder), f"hydra.run.dir={out}", *more]
    command += [f"compilation_cache={out}-cache"]  # a new user's cache is empty
    began, before = time.perf_counter(), _processor()
    finished = subprocess.run(command, capture_output=True, text=True)
    seconds, processor = time.perf_counter() - began, _processor() - before
    if finished.returncode not in (0, 3):  # 3: the fit did not identify the drive
        raise SystemExit(f"drive {hidden.seed}: {finished.stderr}")
    result, truths = json.loads((out / "result.json").read_text()), hidden.truths()
    held, missed, errors = [], [], dict[str, list[float]]()
    for parameter in result["parameters"]:
        name = parameter["name"]
        for row, truth in zip(parameter["by_joint"], truths.get(name, []), strict=False):
            if not row["identified"]:
                continue
            errors.setdefault(name, []).append(100 * (row["value"] / truth - 1) if truth else row["value"])
            if row["interval"] is not None:
                inside = row["interval"][0] <= truth <= row["interval"][1]
                (held if inside else missed).append(name)
    return {
        "drive": str(hidden.seed),
        "kind": hidden.name,
        "rate": hidden.kind.rate,
        "bits": hidden.kind.bits,
        "delay": 1e3 * hidden.drives[0].delay,
        "sticking": 100 * sticking,
        "armature": _worst(errors, "armature"),
        "friction": _worst(errors, "frictionloss", "frictionloss_forward", "coulomb_torque"),
        "damping": _worst(errors, "damping", "damping_forward", "viscous_coefficient"),
        "held": " ".join(held),
        "missed": " ".join(missed),
        "noise": result["metrics"]["test"]["position_mae"] / (2 * np.pi / 2**hidden.kind.bits / 4),
        "seconds": seconds,
        "processor": processor,
    }


def _worst(errors: Mapping[str, Sequence[float]], *names: str) -> float:
    """Return the largest error over joints and over those of these parameters that the model has."""
    return max(abs(value) for name in names for value in errors.get(name, []))


def _processor() -> float:
    """Return the processor time of finished commands [s], which other processes hardly affect."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
