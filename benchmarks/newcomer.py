"""What a newcomer gets: logs of hidden drives, one command with nothing but the files, and the truth beside the result.

    python benchmarks/newcomer.py
    python benchmarks/newcomer.py --drives 5 --first 20 --recipes auto

Each drive has a friction of one of five kinds, an armature, a rod, an encoder, a rate, a delay and a length of its own.
MuJoCo C moves it in steps of 0.05 ms; the log has position and command, and of half of them a noisy velocity.
"""

import argparse
import json
import math
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float
from measure import make_parser, report

KINDS = ("viscous", "coulomb", "stribeck", "sticking", "tustin")
RATES = (50, 100, 200, 500, 1000)  # Hz
STEP = 5e-5  # s, of the simulation
KP, KD = 20.0, 1.0  # N m/rad, N m s/rad: the gains of bench=knee
SMOOTHING = 0.01  # rad/s, over which dry friction changes its sign
VELOCITY_NOISE = 0.02  # rad/s
STAND = """<mujoco model="stand">
  <compiler angle="radian"/>
  <option timestep="{step}"/>
  <worldbody>
    <body name="rod">
      <joint name="motor" type="hinge" axis="0 1 0"/>
      <inertial pos="0 0 {centre}" mass="{mass}" diaginertia="{inertia} {inertia} 0.00001"/>
    </body>
  </worldbody>
</mujoco>
"""
COLUMNS = {
    "drive": "drive",
    "kind": "friction",
    "rate": "rate [Hz]",
    "bits": "encoder [bit]",
    "delay": "delay [ms]",
    "velocity": "velocity",
    "recipe": "recipe",
    "armature_error": "armature [% off]",
    "armature_covered": "in its interval",
    "friction_error": "friction [% off]",
    "delay_error": "delay [ms off]",
    "seconds": "time [s]",
    "processor": "processor [s]",
}


@dataclass(frozen=True)
class Hidden:
    """A drive that nobody knows.

    Attributes:
        seed: Of what follows, and of excitation and noise.
        kind: Of friction, among `KINDS`.
        rate: Of samples [Hz].
        bits: Of the encoder, a turn.
        delay: Of commands [s].
        velocity: Whether it is in the log.
        armature: [kg m^2].
        viscous: [N m s/rad].
        coulomb: Dry friction at speed [N m].
        breakaway: Dry friction at standstill over that.
        stribeck: Speed over which the one goes over into the other [rad/s].
        mass: Of the rod [kg].
        length: Of the rod [m].
        seconds: Of the log.
    """

    seed: int
    kind: str
    rate: int
    bits: int
    delay: float
    velocity: bool
    armature: float
    viscous: float
    coulomb: float
    breakaway: float
    stribeck: float
    mass: float
    length: float
    seconds: float

    @classmethod
    def draw(cls, seed: int) -> "Hidden":
        """The drive of this seed."""
        rng = np.random.default_rng(1000 + seed)
        kind = KINDS[seed % len(KINDS)]

        def spread(low: float, high: float) -> float:
            return float(np.exp(rng.uniform(np.log(low), np.log(high))))

        return cls(
            seed=seed,
            kind=kind,
            rate=int(rng.choice(RATES)),
            bits=int(rng.integers(8, 21)),
            delay=float(rng.uniform(0.0, 0.04) * (rng.random() < 0.8)),
            velocity=bool(rng.random() < 0.5),
            armature=spread(0.01, 0.1),
            viscous=spread(0.03, 0.5),
            coulomb=spread(0.05, 0.5) * (kind != "viscous"),
            breakaway=float(rng.uniform(1.2, 1.8)) if kind in ("stribeck", "tustin") else 1.0,
            stribeck=float(rng.uniform(0.08, 0.4)),
            mass=float(rng.uniform(0.1, 0.6)),
            length=float(rng.uniform(0.1, 0.25)),
            seconds=float(rng.choice([40.0, 60.0, 120.0])),
        )

    def dry(self, speed: float) -> float:
        """Dry friction at this speed [N m]."""
        share = speed / self.stribeck
        return self.coulomb * (1 + (self.breakaway - 1) * math.exp(-share if self.kind == "tustin" else -share * share))

    def friction(self, velocity: Float[np.ndarray, "speeds"]) -> Float[np.ndarray, "speeds"]:
        """Steady friction torque [N m]."""
        dry = np.array([self.dry(abs(each)) for each in velocity])
        return dry * np.tanh(velocity / SMOOTHING) + self.viscous * velocity

    def stand(self, step: float) -> str:
        """The rod on its shaft, as MJCF."""
        inertia = self.mass * self.length**2 / 12
        return STAND.format(step=step, centre=-self.length / 2, mass=self.mass, inertia=inertia)

    def record(self, folder: Path) -> Float[np.ndarray, "2"]:
        """Write `stand.xml` and `log.csv`; returns the lowest and the highest speed that counts [rad/s]."""
        rng = np.random.default_rng(self.seed)
        time = np.arange(int(self.seconds * self.rate)) / self.rate
        ctrl = _excite(time, rng)
        qpos, qvel = self._simulate(ctrl)
        quantum = 2 * np.pi / 2**self.bits
        columns = {"time": time, "qpos": np.round(qpos / quantum) * quantum}
        columns |= {"qvel": qvel + rng.normal(0.0, VELOCITY_NOISE, len(qvel))} if self.velocity else {}
        columns |= {"ctrl": ctrl}
        folder.mkdir(parents=True)
        (folder / "stand.xml").write_text(self.stand(0.001))
        rows = np.stack(list(columns.values()), axis=1)
        np.savetxt(folder / "log.csv", rows, "%.9g", ",", header=",".join(columns), comments="")
        return np.quantile(np.abs(qvel), [0.05, 0.99])

    def _simulate(self, ctrl: Float[np.ndarray, "time"]) -> Float[np.ndarray, "2 time"]:
        spec = mujoco.MjSpec.from_string(self.stand(STEP))
        spec.joints[0].armature = self.armature
        sticks = self.kind == "sticking"
        if sticks:
            spec.joints[0].frictionloss = self.coulomb
            spec.joints[0].solref_friction = [5 * STEP, 1.0]
        model = spec.compile()
        data = mujoco.MjData(model)
        data.qpos[0] = ctrl[0]
        each, late, commands = round(1 / self.rate / STEP), round(self.delay / STEP), ctrl.tolist()
        states = np.empty((2, len(ctrl)))
        for sample in range(len(ctrl)):
            states[:, sample] = data.qpos[0], data.qvel[0]
            for step in range(sample * each, (sample + 1) * each):
                position, velocity = data.qpos.item(), data.qvel.item()
                torque = KP * (commands[max(step - late, 0) // each] - position) - (KD + self.viscous) * velocity
                torque -= 0.0 if sticks else self.dry(abs(velocity)) * math.tanh(velocity / SMOOTHING)
                data.qfrc_applied[0] = torque
                mujoco.mj_step(model, data)
        return states


def _excite(time: Float[np.ndarray, "time"], rng: np.random.Generator) -> Float[np.ndarray, "time"]:
    """Five harmonics of velocity, as in the paper, without drift."""
    amplitude, frequency, phase = rng.uniform(0.3, 1.5, 5), rng.uniform(0.5, 10, 5), rng.uniform(0, 2 * np.pi, 5)
    velocity = np.clip((amplitude * np.sin(time[:, None] * frequency + phase)).sum(axis=1), -4, 4)
    position = np.concatenate([[0.0], np.cumsum((velocity[1:] + velocity[:-1]) / 2 * np.diff(time))])
    return position - np.polyval(np.polyfit(time, position, 1), time)


def main() -> None:
    """Each drive with each recipe, and their table."""
    options = parse()
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        for seed in range(options.first, options.first + options.drives):
            hidden = Hidden.draw(seed)
            folder = Path(scratch) / str(seed)
            speeds = hidden.record(folder)
            for recipe in options.recipes:
                rows.append(run(hidden, folder, speeds, recipe))
                print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    for recipe in options.recipes:
        own = [row for row in rows if row["recipe"] == recipe]
        for what in ("armature_error", "friction_error", "seconds", "processor"):
            values = [row[what] for row in own]
            print(f"{recipe}: {what} median {np.median(values):.3g}, largest {max(values):.3g}")
    report(options.out, rows, COLUMNS, first=options.first)


def parse() -> argparse.Namespace:
    """The command line."""
    parser = make_parser("newcomer", __doc__)
    parser.add_argument("--drives", type=int, default=20, metavar="N", help="how many hidden drives")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="seed of the first")
    parser.add_argument("--recipes", nargs="+", choices=("auto", "given"), default=["auto", "given"])
    return parser.parse_args()


def run(hidden: Hidden, folder: Path, speeds: Float[np.ndarray, "2"], recipe: str) -> dict[str, Any]:
    """One command, from its start to its end, and how far its result is from the truth."""
    out = folder / recipe
    command = [sys.executable, "-m", "frictionzoo.run", "data=files", f"data.train=[{folder / 'log.csv'}]"]
    command += [f"bench.mjcf={folder / 'stand.xml'}", "bench=knee", "bench.joint=motor", f"hydra.run.dir={out}"]
    command += [] if recipe == "auto" else [f"recipe={recipe}"]
    command += [f"compilation_cache={out}-cache"]  # a newcomer's is empty
    began, before = time.perf_counter(), _processor()
    finished = subprocess.run(command, capture_output=True, text=True)
    seconds, processor = time.perf_counter() - began, _processor() - before
    if finished.returncode not in (0, 3):  # 3: the fit says that it did not identify the drive
        raise SystemExit(f"drive {hidden.seed}: {finished.stderr}")
    rows = {row["name"]: row for row in json.loads((out / "result.json").read_text())["parameters"]}
    found = {name: row["value"] for name, row in rows.items()}
    speed = np.linspace(*speeds, 200)
    velocity = np.concatenate([-speed[::-1], speed])
    share = velocity / found["stribeck_velocity"]
    excess = (found["static_torque"] - found["kinetic_torque"]) * np.exp(-np.square(share))
    dry = (found["kinetic_torque"] + excess) * np.tanh(velocity / found["smoothing_velocity"])
    error = np.abs(dry + found["viscous_coefficient"] * velocity - hidden.friction(velocity)).mean()
    return {
        "drive": str(hidden.seed),
        "kind": hidden.kind,
        "rate": hidden.rate,
        "bits": hidden.bits,
        "delay": 1e3 * hidden.delay,
        "velocity": "measured" if hidden.velocity else "none",
        "recipe": recipe,
        "armature_error": 100 * abs(found["armature"] / hidden.armature - 1),
        "armature_covered": _holds(rows["armature"]["interval"], hidden.armature),
        "friction_error": 100 * error / np.abs(hidden.friction(velocity)).mean(),
        "delay_error": 1e3 * abs(found.get("delay", 0.0) - hidden.delay),
        "seconds": seconds,
        "processor": processor,
    }


def _holds(interval: list[float] | None, truth: float) -> str:
    """Whether the truth is in a 95 % interval."""
    return "no interval" if interval is None else "yes" if interval[0] <= truth <= interval[1] else "no"


def _processor() -> float:
    """What finished commands have taken of processors [s], which others that run beside them do not change."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
