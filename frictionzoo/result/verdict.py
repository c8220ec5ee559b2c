"""What speaks against a result: all that a good reviewer would ask about, in one place.

The terminal, the page and `result.json` show these findings; none of them has doubts of its own.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import cast

import numpy as np
from jaxtyping import Float

from frictionzoo.core.params import UNITS, Param
from frictionzoo.core.telling import say_percent
from frictionzoo.result.names import name_some, name_unidentifiable, name_where, say_bounds
from frictionzoo.result.residual_types import JointResidualRow, PlaceRow, ResidualRow
from frictionzoo.result.run_types import FitRow
from frictionzoo.result.types import MetricsRow, ParameterRow, PartsRow, ReferenceRow, Result
from frictionzoo.result.verdict_types import CommandRow, FindingRow, VerdictRow

DO_NOT_USE = "do not use it"
"""Grade of a result of which no value is to be used."""
PURPOSES = {
    "repair": "the repair",
    "inspect": "the recordings to look at",
    "law": "the law to try",
    "recording": "the recording to make",
    "export": "the export",
}
"""What a suggested command does, by its kind."""
BOUNDS = 2  # identified parameters at bounds from which on that is doubted
LITTLE = 1 / 3  # of the test error without friction; a law that identifies a drive leaves less
NOTHING = 2 / 3  # of that error; a law that leaves more explains next to nothing
FAR = 20.0  # times from where it began, at which an identified value of the bench is told
_SIZES = {UNITS[joint][of] for joint in UNITS for of in ("torque", "damping")}
LATE = 0.1  # share of the iterations, the last ones, in which a parameter may not move
MOVING = 1 / 3  # of half its interval, by which it moves then
MOVING_BLINDLY = 0.01  # of its value, where it has no interval
FALLING = 0.01  # share of the loss that the last tenth of the iterations may still take off
OVERFIT = 1.5  # ratio of test to train error that is told
UNEXPLAINED = 0.05  # share of the friction that may be left without being noise
OUT_OF_NOISE = 3.0  # times what noise makes, from which on more is left than noise
ALIKE = 0.5  # correlation of neighbours from which on what is left is no noise
PLACES = {
    "speed": "the speed",
    "slow": "low speeds, as where friction falls while the drive sets out",
    "fast": "high speeds, as where friction grows faster than the speed",
    "direction": "the direction",
    "load": "the load on the gear",
    "position": "the position",
    "pull": "the position, alike in both directions",
    "temperature": "the temperature",
    "reversal": "the time since the motion turned round, as where friction builds up over a displacement",
}
"""What torque that is left changes with, in words."""
_MORE = "raise fit.iterations"


def judge(result: Result, commands: Sequence[CommandRow] = ()) -> VerdictRow:
    """Return the verdict on a result by what else it holds, with those of these commands that it allows.

    Args:
        result: The record; its `verdict` is not looked at.
        commands: As `VerdictRow` has them, before the verdict.
    """
    findings = sorted(find_doubts(result), key=lambda finding: not finding["severe"])
    worst = [finding["severe"] for finding in findings[:1]]
    grade = DO_NOT_USE if True in worst else "use it with care" if worst else "nothing speaks against it"
    allowed = _allow(commands, grade, identified=not result["not_identified"])
    return cast(VerdictRow, {"grade": grade, "findings": findings, "commands": allowed})


def _allow(commands: Sequence[CommandRow], grade: str, identified: bool) -> list[CommandRow]:
    """Return the commands that are safe to suggest: values that are wrong belong neither on hardware nor in exports."""
    kinds = {row["kind"] for row in commands}
    left_out: set[str] = {"recording"} if "repair" in kinds else set()
    if grade == DO_NOT_USE:
        left_out |= {"recording", "export"} | ({"law"} if "repair" in kinds or not identified else set())
    elif "repair" in kinds or "recording" in kinds:
        left_out |= {"inspect"}
    return [row for row in commands if row["kind"] not in left_out]


def is_usable(result: Result) -> bool:
    """Return whether the verdict on a result lets it be exported or used to design a recording."""
    return result["verdict"]["grade"] != DO_NOT_USE


def say_purposes(commands: Sequence[CommandRow]) -> str:
    """Return what suggested commands do, in their order."""
    return ", ".join(PURPOSES[row["kind"]] for row in commands)


def say_finding(finding: FindingRow) -> str:
    """A finding in one sentence, with what mends it."""
    return finding["text"] + (f"; {finding['mend']}" if finding["mend"] else "")


def find_doubts(result: Result) -> Iterator[FindingRow]:
    """All that speaks against a result, in the order in which it is looked at."""
    if result["not_identified"]:
        why, *reasons = result["not_identified"]
        yield _find("identification", f"this did not identify the drive: {why}", f"likely: {'; '.join(reasons)}", True)
    for sentence in result["warnings"]:
        yield _find("recordings", sentence)
    yield from _doubt_errors(result)
    if doubt := doubt_joints(result):
        yield _find("joints", doubt)
    if doubt := doubt_reference(result["reference"]):
        yield _find("reference", doubt)
    yield from _doubt_train(result["metrics"])
    yield from _doubt_fit(result["fit"])
    for p in result["parameters"]:
        if p["at_bound"]:
            unit = "" if p["unit"] == "1" else f" {p['unit']}"
            ended = f"{name_where(p, at_bound=True)} ended at a bound of {say_bounds(p)}{unit}"
            yield _find("bounds", ended, "widen the bounds or doubt the model")
    yield from _doubt_parameters(result)
    yield from _doubt_stability(result)
    if result["residual"]:
        yield from _doubt_residual(result["residual"])


def _find(kind: str, text: str, mend: str | None = None, severe: bool = False, law: str | None = None) -> FindingRow:
    return cast(FindingRow, {"kind": kind, "severe": severe, "text": text, "mend": mend, "law": law})


def _doubt_errors(result: Result) -> Iterator[FindingRow]:
    test, baseline = (result["metrics"][part]["position_mae"] for part in ("test", "baseline"))
    if test is None:
        yield _find("gain", "there is no test error: every test rollout diverged", severe=True)
    elif result["model"] != "baseline" and baseline and test >= baseline:
        text = "on test data the model is no better than a drive without friction"
        yield _find("gain", text, "do not use its friction", severe=True)
    elif doubt := doubt_gain(result):
        yield _find("gain", doubt)


def _doubt_train(metrics: PartsRow) -> Iterator[FindingRow]:
    train, test = (metrics[part]["position_mae"] for part in ("train", "test"))
    if train is None or test is None or train == 0:
        yield _find("train", "test and training error cannot be compared: one is missing")
    elif test > OVERFIT * train:
        text = f"the test error is {test / train:.2g} times that on the training data"
        yield _find("train", text, "the fit may have learnt its own data by heart, or the test data ask for more")


def _doubt_fit(fit: FitRow) -> Iterator[FindingRow]:
    if fit["stopped"] == "diverged":
        text = f"the fit diverged after {fit['iterations']} iterations"
        yield _find("fit", text, "lower its step or start from other values", severe=True)
    if fit["stopped"] == "finished" and fit["method"] == "lm":
        yield _find("fit", f"the fit made all of its {fit['iterations']} iterations without converging", _MORE)
    if fit["falling"] > FALLING:
        yield _find(
            "fit", f"the last tenth of the iterations still took {100 * fit['falling']:.2g} % off the loss", _MORE
        )
    if fit["moving"]:
        yield _find("fit", f"still moving when the fit ended: {', '.join(fit['moving'])}", _MORE)


def _doubt_parameters(result: Result) -> Iterator[FindingRow]:
    """What the data do not determine."""
    if doubtful := name_unidentifiable(result["parameters"]):
        text = f"not identifiable on these data: {', '.join(doubtful)}"
        yield _find("identifiability", text, "do not read a property of the drive into such values")
    for group in result["indistinct"]:
        text = f"the data cannot tell apart {' and '.join(group)}"
        yield _find("identifiability", text, "make all but one of them known, or record others")
    if result["no_intervals"] is not None and any(p["identified"] for p in result["parameters"]):
        yield _find("identifiability", f"no parameter has an interval: {result['no_intervals']}")


def list_rollouts(result: Result) -> list[tuple[str, MetricsRow]]:
    """All rollouts that judge, by what they are of."""
    names = {"test": "test", "train": "training", "model": "test", "baseline": "frictionless test"}
    judged = [(names[part], entry[part]) for entry in result["by_horizon"] for part in ("test", "train", "baseline")]
    return judged + [(names[part], result["paper"]["a"][part]) for part in ("model", "baseline")]


def _doubt_stability(result: Result) -> Iterator[FindingRow]:
    lost = [(name, metrics) for name, metrics in list_rollouts(result) if metrics["diverged"]]
    if lost:
        counts = [f"{m['diverged']} of {m['rollouts']} {name} rollouts of {m['horizon']:g} s" for name, m in lost]
        severe = any(not name.startswith("frictionless") for name, _ in lost)
        yield _find("stability", f"diverged, and left out of the errors: {'; '.join(counts)}", severe=severe)


def _doubt_residual(residual: ResidualRow) -> Iterator[FindingRow]:
    """Where the error is, if it is not noise."""
    rows, unit = residual["by_joint"], residual["unit"]
    told: dict[tuple[str, str | None], list[tuple[JointResidualRow, PlaceRow]]] = {}
    for row in rows:
        for place in row["places"]:
            told.setdefault((place["place"], place["law"]), []).append((row, place))
    for (place, law), found in told.items():
        yield _find("residual", _say_place(place, found, unit, len(rows)), _say_law(found[0][1]), law=law)
    for row in rows:
        rest = row["residual"] > max(OUT_OF_NOISE * row["noise"], UNEXPLAINED * row["friction"])
        if rest and row["correlation"] > ALIKE and not row["places"]:
            of = f" of {row['joint']}" if len(rows) > 1 else ""
            yield _find(
                "residual",
                f"the torque that is left{of}, {say_percent(row['residual'] / row['friction'])} of the friction, is no "
                f"noise (neighbours in time correlate by {row['correlation']:.2f}), and goes with nothing that was "
                "looked for",
                "look at what is taken as known: gains, inertia, delay, elasticity between motor and joint",
            )


def _say_place(place: str, found: Sequence[tuple[JointResidualRow, PlaceRow]], unit: str, joints: int) -> str:
    """What goes with a place, of the joint in which it is most."""
    row, most = max(found, key=lambda pair: pair[1]["torque"] / pair[0]["friction"])
    of = f" of {name_some([*dict.fromkeys(row['joint'] for row, _ in found)])}" if joints > 1 else ""
    ripple = "" if most["periods"] is None else f", {_say_periods(most['periods'], unit)}"
    size = f"{most['torque']:.2g} {unit}, {say_percent(most['torque'] / row['friction'])} of the friction"
    upto = "up to " if len(found) > 1 else ""
    return (
        f"the error{of} is not noise: {upto}{100 * most['share']:.0f} % of the torque that is left goes with "
        f"{PLACES[place]}{ripple} ({size})"
    )


def _say_periods(periods: float, unit: str) -> str:
    """Those of a ripple, of a hinge or a slide by the unit of its torque."""
    return f"{periods:.4g} periods in a turn" if unit == "N m" else f"with a period of {2 * np.pi / periods:.3g} m"


def _say_law(place: PlaceRow) -> str:
    """Which law has such a term."""
    if place["place"] == "pull":
        return "no friction does that: look at gravity, payload and springs of the bench, or a motor that cogs"
    if place["law"] is None:
        return "the law has a term for it; its form, or its bounds, do not fit" if place["known"] else "no law has that"
    other = "another form of that term" if place["known"] else "that term"
    return f"{place['law']} has {other}" + ("" if place["whole"] else ", but not all of this law's")


def explain_failure(result: Result) -> list[str] | None:
    """Why a fit did not identify the drive, and the likely reasons, the likeliest first; None where it may have.

    It did not if several parameters ended at a bound and the test error is still more than a third of that without
    friction: then the law makes up for something else with values that no drive has. What ended at the lower bound of a
    friction's size is simply not there: a drive without dry friction is a drive.
    """
    ended = [name_where(p, at_bound=True) for p in result["parameters"] if p["at_bound"] and not _is_absent(p)]
    error, without = (result["metrics"][part]["position_mae"] for part in ("test", "baseline"))
    gained_little = error is None or (without is not None and error > LITTLE * without)
    if len(ended) < BOUNDS or not gained_little:
        return None
    share = "cannot be told" if error is None or not without else f"is {100 * error / without:.0f} % of no friction's"
    return [
        f"{' and '.join(ended)} ended at their bounds, and the test error {share}",
        *result["warnings"],
        "what is taken as known is not so: the actuator's gains, the MJCF's inertia and gravity, the recordings' units",
        "commands act late, which bench.params.delay would find",
        "the recordings do not excite the drive, or the bounds are not those of this drive",
    ]


def _is_absent(parameter: ParameterRow) -> bool:
    """Whether it is the size of a part of the friction, a torque or a damping, and the fit found that there is none."""
    if parameter["owner"] != "friction" or parameter["unit"] not in _SIZES:
        return False
    ended = [row for row in parameter["by_joint"] if row["at_bound"]]
    return all(row["value"] - row["low"] < row["high"] - row["value"] for row in ended)


def doubt_gain(result: Result) -> str | None:
    """That a law explains next to nothing of what a drive without friction leaves; None where it explains more."""
    error, without = (result["metrics"][part]["position_mae"] for part in ("test", "baseline"))
    if result["model"] == "baseline" or error is None or not without or error <= NOTHING * without:
        return None
    return (
        f"on test data the position error is {100 * error / without:.0f} % of that without friction: the law explains "
        "next to nothing, or the recordings or the bench are not what they are taken for"
    )


def doubt_joints(result: Result) -> str | None:
    """Which joints of several the law does not improve on test data; None where it improves all of them."""
    joints = result["by_joint"]
    if result["model"] == "baseline" or len(joints) == 1:
        return None
    worse = []
    for joint in joints:
        error, without = (joint[part]["position_mae"] for part in ("test", "baseline"))
        if error is not None and without and error >= without:
            worse.append(f"{joint['joint']} (+{100 * (error / without - 1):.0f} %)")
    if not worse:
        return None
    return (
        f"on test data {len(worse)} of {len(joints)} joints {'is' if len(worse) == 1 else 'are'} no better than "
        f"without friction: {name_some(worse)}"
    )


def doubt_sizes(
    params: Mapping[str, Param], values: Mapping[str, Float[np.ndarray, "nv"]], joints: Sequence[str], unit: str
) -> list[str]:
    """Identified values of a bench, on a `hinge` or `slide`, of another size than a user expected, a sentence each."""
    doubts = []
    for name, param in params.items():
        if not param.is_identified or param.scale != "log":
            continue
        found = np.ravel(values[name])
        began = param.each("init", len(found))
        times = np.exp(np.abs(np.log(found / began)))
        joint = int(times.argmax())
        if times[joint] > FAR:
            of = f" of {joints[joint]}" if len(found) > 1 else ""
            moved = f"from {began[joint]:g} to {found[joint]:.4g} {param.unit(unit)}, {times[joint]:.2g} times"
            doubts.append(
                f"bench.{name}{of} went {moved}: look at the units of time, qpos and ctrl (data.units) and at the "
                f"bench's gains, or begin elsewhere (bench.params.{name}.init)"
            )
    return doubts


def list_moving(
    history: Mapping[str, Float[np.ndarray, "iterations"]], intervals: Mapping[str, Float[np.ndarray, "2"]]
) -> list[str]:
    """Names of the parameters that still moved when the fit ended.

    The means over the two halves of the last tenth of the iterations differ by more than a third of the half width of
    the parameter's 95 % interval, or by 1 % of its value where it has none.

    Args:
        history: Its values by the parameter's label, `bench.armature`, of several joints `bench.armature/knee`.
        intervals: By label.
    """
    moving = []
    for name, values in history.items():
        half = int(LATE * len(values)) // 2
        if not half:
            continue
        before, last = values[-2 * half : -half].mean(), values[-half:].mean()
        width = MOVING * np.ptp(intervals.get(name, np.full(2, np.nan))) / 2
        if abs(last - before) > (width if np.isfinite(width) else MOVING_BLINDLY * abs(last)):
            moving.append(name)
    return moving


def still_falling(loss: Float[np.ndarray, "iterations"]) -> float:
    """Share of the lowest loss before them that the last tenth of the iterations took off."""
    finite = np.where(np.isfinite(loss), loss, np.inf).astype(np.float64)
    before = finite[: len(finite) - len(finite) // 10].min(initial=np.inf)
    return max(0.0, 1 - float(finite.min() / before)) if np.isfinite(before) and before > 0 else 0.0


def doubt_reference(parameters: Sequence[ParameterRow | ReferenceRow]) -> str | None:
    """That the drive without friction, by which others are judged, is none by its parameters; None where it may be."""
    ended = [
        f"{name_where(p, at_bound=True)} at its bound of {say_bounds(p)} {p['unit']}"
        for p in parameters
        if p["at_bound"]
    ]
    if not ended:
        return None
    return f"the drive without friction ended with {' and '.join(ended)}: a change against its error says little"
