"""Share of runs on hidden drives whose first finding, or repair of the log, names the fault of the log or the bench.

    python benchmarks/causes.py
    python benchmarks/causes.py --causes clipping gear exact --folder runs

Each log comes from a hidden drive of `newcomer.py`, simulated by `event_exact.py`, or by `_play` for backlash. Either
the log or its command line has one fault. The `exact` logs have no fault, and no finding may name a cause.
"""

import argparse
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from event_exact import Motion, round_to, simulate, write_mjcf
from jaxtyping import Float
from measure import make_parser, report
from newcomer import Hidden

SEED = 900  # seed of the first drive
CLIPPED = 0.985  # the motor's limit is this quantile of the commanded torque
LAGS = 0.006, 0.012  # s, delay of the velocity
EXACT = "coulomb", "late", "stribeck", "load", "sticking", "directional"
COLUMNS = {
    "cause": "cause",
    "drive": "drive",
    "named": "named",
    "grade": "grade",
    "findings": "findings and repairs",
    "status": "status",
    "error": "error [mrad]",
    "residual": "residual [% of friction]",
    "seconds": "run [s]",
    "first": "first finding",
}

Log = dict[str, Float[np.ndarray, "time"]]


@dataclass(frozen=True)
class Case:
    """Hidden drive with a fault in its log or its bench.

    Attributes:
        hidden: True drive.
        stated: Drive that the command line describes.
        pattern: Regular expression of a finding, of an identified parameter, or of a repair of the log that names the
            cause; empty without a fault.
        law: Fitted model; None for the drive's model.
        spoil: Function that puts the fault into the log's columns; None for no change.
        gap: Backlash of the gear [rad].
    """

    hidden: Hidden
    stated: Hidden
    pattern: str
    law: str | None = None
    spoil: Callable[[Log], Log] | None = None
    gap: float = 0.0


def make_case(cause: str, seed: int) -> Case:
    """Return a case of this cause; even and odd seeds differ in size."""
    kind = EXACT[(seed - SEED) % len(EXACT)] if cause == "exact" else "coulomb"
    plain, second = Hidden.draw("presliding" if cause == "presliding" else kind, seed), seed % 2
    drive, link = plain.drives[0], plain.links[0]
    if cause == "clipping":
        ctrl = _ctrl(plain)
        motion = simulate(plain.links, plain.drives, ctrl, 1 / plain.kind.rate)
        torque = np.abs(drive.kp * (ctrl - motion.qpos) - drive.kd * motion.qvel)
        limit = float(np.quantile(torque, CLIPPED))
        return Case(replace(plain, drives=[replace(drive, torque_limit=limit)]), plain, "torque_limit")
    if cause == "stiffness":
        return Case(plain, replace(plain, drives=[replace(drive, kp=(0.9, 1.1)[second] * drive.kp)]), r"\bkp\b")
    if cause == "lag":
        return Case(plain, plain, "qvel lags qpos by", spoil=lambda log: _delay(log, LAGS[second]))
    if cause == "scale":
        return Case(plain, plain, r"units? of time|units\.time", spoil=lambda log: _scale(log, (2.0, 0.5)[second]))
    if cause == "rounded":
        plain = replace(plain, kind=replace(plain.kind, rate=(300, 150)[second]))
        return Case(plain, plain, "times? .*rounded", spoil=lambda log: _round_time(log, (2e-3, 5e-3)[second]))
    if cause == "constant":
        return Case(replace(plain, drives=[replace(drive, torque_offset=(0.33, -0.2)[second])]), plain, "torque_offset")
    if cause == "payload":
        heavier = link.with_payload((0.3, 0.5)[second] * link.mass, (0.0, 0.0, 2 * link.centre[2]))
        return Case(replace(plain, links=[heavier]), plain, "payload|mass")
    if cause == "gear":
        return Case(replace(plain, drives=[replace(drive, gain=(1.2, 0.83)[second])]), plain, "gear|gain")
    if cause == "gear_friction":  # ripple and load-dependent friction, which the model lacks
        own = {"load": (0.15, 0.1)[second], "ripple": (0.3, 0.2)[second] * drive.forward, "periods": 12.0}
        return Case(replace(plain, drives=[replace(drive, **own)]), plain, "harmonic_drive|load on the gear")
    if cause == "presliding":
        return Case(plain, plain, r"\b(dahl|lugre|maxwell_slip)", law="mujoco_default")
    return Case(
        plain,
        plain,
        "backlash|play" if cause == "backlash" else "",
        gap=(0.03, 0.01)[second] if cause == "backlash" else 0.0,
    )


CAUSES = "clipping", "stiffness", "lag", "scale", "rounded", "constant", "payload", "gear", "presliding", "backlash"
CAUSES += ("gear_friction",)


def _ctrl(hidden: Hidden) -> Float[np.ndarray, "time nv"]:
    """Return the command that `Hidden.record` gives this drive."""
    with tempfile.TemporaryDirectory() as scratch:
        hidden.record(Path(scratch) / "log")
        return _read(Path(scratch) / "log" / "log0.csv")["ctrl"][:, None]


def _read(path: Path) -> Log:
    with path.open() as file:
        names = file.readline().strip().split(",")
    return dict(zip(names, np.loadtxt(path, delimiter=",", skiprows=1).T, strict=True))


def _write(path: Path, log: Log) -> None:
    np.savetxt(path, np.stack(list(log.values()), axis=1), "%.9g", ",", header=",".join(log), comments="")


def _delay(log: Log, lag: float) -> Log:
    return {**log, "qvel": np.interp(log["time"] - lag, log["time"], log["qvel"])}


def _scale(log: Log, factor: float) -> Log:
    return {**log, "time": factor * log["time"]}


def _round_time(log: Log, quantum: float) -> Log:
    return {**log, "time": np.round(log["time"] / quantum) * quantum}


def _play(hidden: Hidden, ctrl: Float[np.ndarray, "time nv"], gap: float) -> Motion:
    """Return the motion of a link behind a gear with backlash, whose rotor has armature and friction.

    The coupling has 4000 N m/rad in contact. Semi-implicit Euler in steps of 10 us; dry friction clips to its limits.
    """
    import jax
    import jax.numpy as jnp

    drive, link = hidden.drives[0], hidden.links[0]
    step, each = 1e-5, round(1e5 / hidden.kind.rate)
    weight = 9.81 * link.mass * -link.centre[2]
    inertia = link.inertia[1] + link.mass * link.centre[2] ** 2

    def advance(state: Any, command: Any) -> Any:
        def one(_: int, state: Any) -> Any:
            qpos, qvel, ahead, rotor = state
            motor = drive.kp * (command - qpos) - drive.kd * qvel
            bend = ahead - jnp.clip(ahead, -gap / 2, gap / 2)
            passed = 4000.0 * bend + 5.0 * (rotor - qvel) * (bend != 0)
            driven = rotor + step / drive.armature * (motor - passed - drive.viscous * rotor)
            most = step / drive.armature * drive.forward
            rotor = driven - jnp.clip(driven, -most, most)
            qvel = qvel + step / inertia * (passed - weight * jnp.sin(qpos))
            return qpos + step * qvel, qvel, ahead + step * (rotor - qvel), rotor

        return jax.lax.fori_loop(0, each, one, state), state[:2]

    with jax.enable_x64(True):
        zero = jnp.zeros(())
        _, (qpos, qvel) = jax.lax.scan(advance, (zero + ctrl[0, 0], zero, zero, zero), jnp.asarray(ctrl[:, 0]))
        return Motion(np.asarray(qpos)[:, None], np.asarray(qvel)[:, None], 0.0)


def record(case: Case, folder: Path) -> list[str]:
    """Write the logs and the stand's MJCF; return the options of the run."""
    case.hidden.record(folder)
    (folder / "stand.xml").write_text(write_mjcf(case.stated.links, case.stated.names))
    path = folder / "log0.csv"
    log = _read(path)
    if case.gap:
        motion, noise = _play(case.hidden, log["ctrl"][:, None], case.gap), np.random.default_rng(case.hidden.seed)
        qpos = round_to(motion.qpos, case.hidden.kind.bits)[:, 0]
        log |= {"qpos": qpos, "qvel": motion.qvel[:, 0] + noise.normal(0.0, 0.02, len(qpos))}
        _write(path, log)
    if case.spoil:
        _write(path, case.spoil(log))
    options = case.stated.options(folder)
    return [f"model={case.law}" if case.law and each.startswith("model=") else each for each in options]


def run(cause: str, seed: int, folder: Path, more: list[str]) -> dict[str, Any]:
    """Run one command; check that the first finding names the cause or, for an exact log, that none names any."""
    case, out = make_case(cause, seed), folder / "run"
    command = [sys.executable, "-m", "frictionzoo.run", *record(case, folder), f"hydra.run.dir={out}", *more]
    finished = subprocess.run(command, capture_output=True, text=True)
    if finished.returncode not in (0, 3):
        said, row = finished.stderr.strip().splitlines()[-1], {"grade": "refused", "findings": 1}
        row |= {"error": 0.0, "residual": 0.0, "seconds": 0.0}
        named = bool(case.pattern and re.search(case.pattern, said))
    else:
        result = json.loads((out / "result.json").read_text())
        findings = result["verdict"]["findings"]
        causes = [finding for finding in findings if _names_a_cause(finding)]
        repairs = [line.strip() for line in finished.stderr.splitlines() if re.search("qvel lags|times are", line)]
        said = "; ".join(repairs) or (_say(findings[0]) if findings else "")
        found = " ".join(parameter["name"] for parameter in result["parameters"] if parameter["identified"])
        named = bool(re.search(case.pattern, said) or (not findings and re.search(case.pattern, found)))
        named = named if case.pattern else not causes
        row = {"grade": result["verdict"]["grade"], "seconds": result["timing"]["total"]}
        row["findings"] = len(findings) + len(repairs)
        row["error"] = 1e3 * (result["metrics"]["test"]["position_mae"] or np.nan)
        joints = (result["residual"] or {"by_joint": []})["by_joint"]
        row["residual"] = max((100 * joint["residual"] / joint["friction"] for joint in joints), default=0.0)
    about = {"cause": cause, "drive": str(seed), "named": str(named), "status": finished.returncode}
    return {**about, **row, "first": said}


def _say(finding: Mapping[str, Any]) -> str:
    return "; ".join(filter(None, (finding["text"], finding["mend"])))


def _names_a_cause(finding: Mapping[str, Any]) -> bool:
    return finding["kind"] in ("residual", "recordings", "identification", "bounds", "gain", "torque", "train")


def main() -> None:
    """Run each case and report a table."""
    options = parse()
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        for cause in options.causes:
            for number in range(options.exact if cause == "exact" else options.drives):
                seed = SEED + number if cause == "exact" else SEED + 10 * CAUSES.index(cause) + number
                folder = (options.folder or Path(scratch)) / f"{cause}{number}"
                rows.append(run(cause, seed, folder, options.more))
                print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    for label, exact in (("causes named first", False), ("exact logs for which no cause is named", True)):
        of = [row["named"] == "True" for row in rows if (row["cause"] == "exact") == exact]
        print(f"{label}: {sum(of)} of {len(of)}")
    report(options.out, rows, COLUMNS)


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser("causes", __doc__)
    parser.add_argument("--causes", nargs="+", choices=(*CAUSES, "exact"), default=[*CAUSES, "exact"])
    parser.add_argument("--drives", type=int, default=2, metavar="N", help="of each cause")
    parser.add_argument("--exact", type=int, default=6, metavar="N", help="logs with nothing wrong")
    parser.add_argument("--folder", type=Path, help="where logs and runs are kept")
    parser.add_argument("--more", nargs="*", default=[], metavar="OPTION", help="options of frictionzoo.run besides")
    return parser.parse_args()


if __name__ == "__main__":
    main()
