"""Detected faults and false alarms of the pre-fit diagnostics (check-up): `python benchmarks/checkup.py`.

Good recordings of several data sets get one fault of a list at a time. A cell shows the answer: error (E), warning (W)
or nothing (-). A ! marks a message without the correcting option; a cell is empty if the data set cannot have the
fault. Then good recordings are checked one by one; every finding on them is a false alarm. Nothing is fitted.
"""

import argparse
import re
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, cast

import numpy as np
from measure import make_parser, print_table, write_json
from omegaconf import OmegaConf

from frictionzoo.bench import Bench
from frictionzoo.core.build import build
from frictionzoo.core.config import compose_config
from frictionzoo.core.log import Dataset, Log
from frictionzoo.data.signals import estimate_velocity
from frictionzoo.diagnostics.findings import Finding
from frictionzoo.diagnostics.recordings import find_all, takes_position

FAULTY = ("twin_clean", "emps", "sts3215", "go2", "tx40")
GOOD = ("go2", "sts3215", "xl330", "emps", "tx40", "kuka_lwr4", "twin", "twin_clean", "two_inertia")
SEEDS = (3, 4, 5)  # seeds of additional simulated recordings
LOGS = 4  # logs per data set that get a fault
GEAR = 30.0
COMMANDS = ("ctrl", "ctrl_velocity", "ctrl_torque")
OTHER_BENCH = {"hinge": "emps", "slide": "knee"}
DEGREES, SEED = 180 / np.pi, 0


@dataclass(frozen=True)
class Stand:
    """Good recordings with their bench.

    Attributes:
        bench: The test stand.
        logs: Logs that the bench accepted.
        estimated: Whether the velocity is estimated from the position.
    """

    bench: Bench
    logs: tuple[Log, ...]
    estimated: bool

    @property
    def to_position(self) -> bool:
        """Return whether commands are desired positions."""
        return takes_position(self.bench)


@cache
def load(name: str, *overrides: str) -> Stand:
    """Load a data set with its bench.

    Args:
        name: Name of the data set.
        overrides: Overrides of the configuration.
    """
    config = cast(dict[str, Any], OmegaConf.to_container(compose_config(f"data={name}", *overrides), resolve=True))
    bench, dataset = build(config["bench"]), build(config["data"]).load()
    # A part held out by time belongs to the same recording as its training part.
    logs = tuple(log for log in bench.accept_all(dataset).logs if not log.name.endswith("[test]"))
    estimated = any("estimated" in repair for log in logs for repair in log.repairs) or name == "emps"
    return Stand(bench, logs, estimated)


def spread(logs: tuple[Log, ...], count: int) -> tuple[Log, ...]:
    """Return at most `count` logs, evenly spread."""
    return tuple(logs[len(logs) * at // count] for at in range(count)) if len(logs) > count else logs


Maker = Callable[[Log, Stand], Log | None]
"""Function that returns a recording with a fault; None if it cannot have the fault."""


def scale(log: Log, qpos: float = 1.0, ctrl: float = 1.0) -> Log:
    """Change the units of position and velocity, and of the command."""
    return replace(log, qpos=qpos * log.qpos, qvel=qpos * log.qvel, ctrl=ctrl * log.ctrl)


def turn(log: Log, signs: Any) -> Log:
    """Multiply the commands by signs, one per joint or one for all."""
    inputs = {name: signs * values if name in COMMANDS else values for name, values in log.inputs.items()}
    return replace(log, ctrl=signs * log.ctrl, inputs=inputs)


def order(log: Log, whole: bool) -> Log | None:
    """Swap the first two joints' commands or, if `whole`, the joints; None for a single joint."""
    if log.qpos.shape[1] < 2:
        return None
    other = np.arange(log.qpos.shape[1])
    other[[0, 1]] = 1, 0
    inputs = {name: values[:, other] for name, values in log.inputs.items()}
    log = replace(log, ctrl=log.ctrl[:, other], inputs=inputs)
    return replace(log, qpos=log.qpos[:, other], qvel=log.qvel[:, other]) if whole else log


def late(values: np.ndarray, timestep: float, seconds: float) -> np.ndarray:
    """Delay a signal by `seconds`."""
    samples = round(seconds / timestep)
    return np.concatenate([np.repeat(values[:1], samples, axis=0), values[: len(values) - samples]])


def estimate(log: Log, qpos: np.ndarray) -> np.ndarray:
    """Estimate the velocity of other positions."""
    cutoff = min(20.0, 0.2 / log.timestep)
    return np.stack([estimate_velocity(column, log.timestep, cutoff, 2, log.name) for column in qpos.T], axis=1)


def turn_one(log: Log, stand: Stand) -> Log | None:
    """Reverse the direction of the second joint; None for a single joint."""
    if stand.bench.nv < 2:
        return None
    signs = np.where(np.arange(stand.bench.nv) == 1, -1.0, 1.0)
    return turn(replace(log, qpos=signs * log.qpos, qvel=signs * log.qvel), signs)


def forget_gear(log: Log, stand: Stand) -> Log:
    """Log the motor's positions instead of the joint's, or the motor's torque."""
    return scale(log, qpos=GEAR) if stand.to_position else scale(log, ctrl=1 / GEAR)


def milliseconds(log: Log, stand: Stand) -> Log:
    """Write times in milliseconds, which are read as seconds."""
    return replace(log, time=1e3 * log.time, qvel=log.qvel / 1e3 if stand.estimated else log.qvel)


def invent_velocity(log: Log, stand: Stand) -> Log:
    """Replace the velocity with another motion's velocity of the same size."""
    noise = np.random.default_rng(SEED).normal(size=log.qpos.shape)
    other = estimate(log, np.cumsum(noise, axis=0))
    return replace(log, qvel=other * log.qvel.std(axis=0) / other.std(axis=0))


def cut_off(log: Log, stand: Stand) -> Log:
    """Clip the command to its middle quartiles."""
    return replace(log, ctrl=np.clip(log.ctrl, *np.quantile(log.ctrl, [0.25, 0.75], axis=0)))


def stand_still(log: Log, stand: Stand) -> Log:
    """Stop the drive, as if it were off: only the encoder's last step flickers."""
    flicker = np.random.default_rng(SEED).integers(0, 2, log.qpos.shape)
    return replace(log, qpos=log.qpos[:1] + 1e-4 * flicker, qvel=0 * log.qvel)


def never_reverse(log: Log, stand: Stand) -> Log:
    """Turn all motion into one direction, with matching commands."""
    steps = np.diff(log.qpos, axis=0, prepend=log.qpos[:1])
    qpos = log.qpos[:1] + np.cumsum(np.abs(steps), axis=0)
    asked = (log.ctrl - log.qpos) * np.sign(log.qvel) + qpos if stand.to_position else log.ctrl * np.sign(log.qvel)
    return replace(log, qpos=qpos, qvel=np.abs(log.qvel), ctrl=asked)


def keep_speed(log: Log, stand: Stand) -> Log:
    """Move each joint along its path at constant speed, with the commands of each point."""
    signals = {"qpos": log.qpos.copy(), "ctrl": log.ctrl.copy()}
    for joint in range(log.qpos.shape[1]):
        smooth = np.cumsum(log.qvel[:, joint]) * log.timestep
        path = np.cumsum(np.abs(np.diff(smooth, prepend=smooth[0]))) + 1e-12 * np.arange(log.samples)
        even = np.linspace(path[0], path[-1], log.samples)
        signals["qpos"][:, joint] = np.interp(even, path, smooth)
        signals["ctrl"][:, joint] = np.interp(even, path, log.ctrl[:, joint])
    return replace(log, **signals, qvel=np.gradient(signals["qpos"], log.timestep, axis=0))


def alias(log: Log, stand: Stand) -> Log:
    """Keep so few samples, up to 0.5 s apart, that a tenth of the motion's power lies above half their rate."""
    moved = log.qvel - log.qvel.mean(axis=0)
    power = np.cumsum((np.abs(np.fft.rfft(moved, axis=0)) ** 2).sum(axis=1))
    middle = np.fft.rfftfreq(log.samples, log.timestep)[np.searchsorted(power, 0.9 * power[-1])]
    every = max(2, min(int(1 / (2 * middle * log.timestep)), int(0.5 / log.timestep)))
    few = {name: getattr(log, name)[::every] for name in ("time", "qpos", "qvel", "ctrl")}
    rest = {part: {name: v[::every] for name, v in getattr(log, part).items()} for part in ("extras", "inputs")}
    return replace(log, **few, **rest)


def drift(log: Log, stand: Stand) -> Log:
    """Let the clock of the commands drift to 0.4 s ahead at the end."""
    duration = log.time[-1] - log.time[0]
    read = log.time[0] + (log.time - log.time[0]) * (1 - 0.4 / duration)
    inputs = {name: move(log, values, read) if name in COMMANDS else values for name, values in log.inputs.items()}
    return replace(log, ctrl=move(log, log.ctrl, read), inputs=inputs)


def move(log: Log, values: np.ndarray, read: np.ndarray) -> np.ndarray:
    """Interpolate signals at other times."""
    return np.stack([np.interp(read, log.time, column) for column in values.T], axis=1)


FAULTS: Mapping[str, tuple[Maker, str]] = {
    "command of the other sign": (lambda log, stand: turn(log, -1.0), r"data\.sign\.ctrl=-1"),
    "degrees": (
        lambda log, stand: scale(log, DEGREES, DEGREES if stand.to_position else 1.0) if hinged(stand) else None,
        r"data\.units\.qpos=deg",
    ),
    "degrees, but not in the command": (
        lambda log, stand: scale(log, DEGREES) if hinged(stand) and stand.to_position else None,
        r"data\.units\.qpos=deg",
    ),
    "millimetres": (lambda log, stand: None if hinged(stand) else scale(log, 1e3), r"data\.units\.qpos=mm"),
    "milliseconds": (milliseconds, r"data\.units\.time=ms"),
    "gear ratio forgotten": (forget_gear, r"gear.*data\.units\.(qpos=0\.0|ctrl)"),
    "commands of two joints swapped": (lambda log, stand: order(log, whole=False), r"swapped.*data\.columns\.ctrl"),
    "two joints swapped": (lambda log, stand: order(log, whole=True), r"swapped.*bench\.joint or data\.columns"),
    "commands 0.2 s late": (
        lambda log, stand: replace(log, ctrl=late(log.ctrl, log.timestep, 0.2)),
        r"data\.clean\.command_lag",
    ),
    "motion 0.4 s late": (
        lambda log, stand: replace(log, qpos=late(log.qpos, log.timestep, 0.4), qvel=late(log.qvel, log.timestep, 0.4)),
        r"bench\.params\.delay",
    ),
    "velocity 0.03 s late": (
        lambda log, stand: replace(log, qvel=late(log.qvel, log.timestep, 0.03)),
        r"data\.clean\.velocity_lag=auto or data\.clean\.velocity=estimated",
    ),
    "velocity of something else": (invent_velocity, r"data\.clean\.velocity=estimated"),
    "command cut off": (cut_off, r"clipped; record the command that the drive received"),
    "command constant": (lambda log, stand: replace(log, ctrl=0 * log.ctrl + 1), r"constant.*data\.columns\.ctrl"),
    "drive never moves": (stand_still, r"whether it was on.*data\.columns\.qpos"),
    "drive never reverses": (never_reverse, r"record both directions"),
    "one speed only": (keep_speed, r"record slower and faster motion"),
    "aliasing": (alias, r"data\.clean\.step"),
    "clock drift": (drift, r"data\.columns\.time"),
    "one joint turns the other way": (turn_one, r"is reversed: set data\.sign\.qpos[^;]*=\[1,-1,1"),
    "another bench, units said": (lambda log, stand: log if stand.bench.nv == 1 else None, r"bench=NAME"),
    "another bench, units not said": (
        lambda log, stand: replace(log, units={}) if stand.bench.nv == 1 else None,
        r"bench\.actuator|bench\.params|data\.units",
    ),
}
"""Function that makes each fault, and pattern of the right correction in a finding."""


def hinged(stand: Stand) -> bool:
    """Return whether the joints are hinges."""
    return stand.bench.joint_type == "hinge"


def find(logs: tuple[Log, ...], bench: Bench) -> list[Finding]:
    """Return the findings of the diagnostics on these logs."""
    return list(find_all(Dataset("checked", logs, logs[:1]), bench))


def judge(fault: str, stand: Stand) -> tuple[str, str] | None:
    """Return the mark and the findings' text for a fault on a data set; None if it cannot have the fault."""
    make, mend = FAULTS[fault]
    spoilt = tuple(log for log in (make(log, stand) for log in spread(stand.logs, LOGS)) if log is not None)
    if not spoilt:
        return None
    spoilt = spoilt[:1] if fault == "one speed only" else spoilt  # the speed differs between recordings
    bench = stand.bench
    if fault.startswith("another bench"):
        config = OmegaConf.to_container(compose_config(f"bench={OTHER_BENCH[bench.joint_type]}"), resolve=True)
        bench = build(cast(dict[str, Any], config)["bench"])
        spoilt = tuple(replace(log, inputs={}, load=np.zeros(0)) for log in spoilt)
    found = find(spoilt, bench)
    # A user sees the first error, or else all warnings.
    certain = [finding for finding in found if finding.certain][:1]
    said = [finding.text for finding in certain or found]
    right = any(re.search(mend, text) for text in said)
    return ("E" if certain else "W" if found else "-") + ("" if right or not found else "!"), "; ".join(said)


def measure_faults(names: list[str]) -> Iterator[dict[str, Any]]:
    """Yield a row for each fault."""
    for fault in FAULTS:
        began = time.perf_counter()
        cells = {name: judge(fault, load(name)) for name in names}
        judged = {name: cell for name, cell in cells.items() if cell is not None}
        if judged:
            marks = [mark for mark, _ in judged.values()]
            yield {
                "fault": fault,
                **{name: "" if cell is None else cell[0] for name, cell in cells.items()},
                "sets": len(judged),
                "logs": sum(len(spread(load(name).logs, LOGS)) for name in judged),
                "caught": sum(mark != "-" for mark in marks),
                "right": sum(mark in ("E", "W") for mark in marks),
                "seconds": time.perf_counter() - began,
                "said": {name: text for name, (_, text) in judged.items()},
            }


def measure_good(names: list[str], most: int) -> Iterator[dict[str, Any]]:
    """Yield a row for each data set of good recordings, which are checked one by one."""
    stands = [(name, load(name)) for name in names]
    for name in ("twin_clean",) if "twin_clean" in names else ():
        stands += [(f"{name} seed={seed}", load(name, f"data.seed={seed}")) for seed in SEEDS]
    for name, stand in stands:
        began, logs = time.perf_counter(), spread(stand.logs, most)
        found = [find((log,), stand.bench) for log in logs]
        yield {
            "data": name,
            "logs": len(logs),
            "samples": sum(log.samples for log in logs),
            "joints": stand.bench.nv,
            "errors": sum(any(one.certain for one in of) for of in found),
            "warnings": sum(bool(of) for of in found),
            "seconds": time.perf_counter() - began,
            "said": sorted({one.text for of in found for one in of}),
        }


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser("checkup", __doc__)
    parser.add_argument("--data", nargs="*", default=FAULTY, help="data sets on whose recordings faults are made")
    parser.add_argument("--good", nargs="*", default=GOOD, help="data sets whose recordings are checked as they are")
    parser.add_argument("--most", type=int, default=6, help="good recordings of each data set, spread evenly")
    parser.add_argument("--texts", action="store_true", help="print what was said, too")
    return parser.parse_args()


def main() -> None:
    """Check, print and write the results."""
    options = parse()
    faults = list(measure_faults(list(options.data)))
    names = {name: name for name in options.data}
    print_table(faults, {"fault": "fault", **names, "caught": "caught", "right": "mend named", "seconds": "seconds"})
    print()
    good = list(measure_good(list(options.good), options.most))
    columns = ("data", "logs", "joints", "errors", "warnings", "seconds")
    print_table(good, {column: column for column in columns})
    logs, errors, warnings = (sum(row[key] for row in good) for key in ("logs", "errors", "warnings"))
    print(f"\n{logs} good recordings: {errors} false errors, {warnings} with a false warning")
    if options.texts:
        for row in faults:
            print(f"\n{row['fault']}", *(f"  {name}: {text}" for name, text in row["said"].items()), sep="\n")
        print("\ngood recordings", *(f"  {row['data']}: {text}" for row in good for text in row["said"]), sep="\n")
    rows = [{key: str(v) if key == "said" else v for key, v in row.items()} for row in [*faults, *good]]
    write_json(options.out, {"settings": {"most": options.most, "gear": GEAR}, "rows": rows})


if __name__ == "__main__":
    main()
