"""Verdict on a result: findings, causes first, a grade and next commands, for terminal, page and `result.json`."""

from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np

from frictionzoo.core.telling import say_percent
from frictionzoo.core.units import UNITS
from frictionzoo.result import section_types as types
from frictionzoo.result.names import name_some, name_unidentifiable, name_where, say_bounds
from frictionzoo.result.types import Metrics, ParameterRecord, ReferenceParameter, Result

DO_NOT_USE: Final = "do not use it"
"""Grade of a result that must not be used."""
CLEAN: Final = "no problems found"
"""Grade of a result without findings, whose first suggestion is the export."""
PURPOSES = {
    "repair": "the corrected run",
    "inspect": "the recordings to inspect",
    "law": "the model to try",
    "recording": "the recording to make",
    "export": "the export",
}
"""Purpose of a suggested command, by its kind."""
BOUNDS = 2  # identified parameters at bounds from which on a fit may have failed
LITTLE = 1 / 3  # of the test error without friction; a good model leaves less
NOTHING = 2 / 3  # of the same error; a model that leaves more explains almost nothing
_SIZES = {UNITS[joint][of] for joint in UNITS for of in ("torque", "damping")}
FALLING = 0.01  # largest relative decrease of the loss in the last tenth of the iterations
OVERFIT = 1.5  # ratio of test to train error above which it is reported
ENOUGH = 100  # samples per parameter that prevent overfitting
UNEXPLAINED = 0.05  # largest residual torque beyond noise, as a share of the friction
CONTRADICTED = 0.5  # largest residual of a usable result, as a share of friction or recorded torque
DOUBTED = 0.2  # share of recorded torque above which the residual is reported
FAR = 0.1  # share of the drive's error; larger differences of a model file are marked
ALIKE = 0.5  # correlation of neighbours above which the residual is not noise
PLACES = {
    "constant": "a constant torque",
    "scale": "a scale error of the torque",
    "limit": "commanded torque beyond a limit",
    "late": "a delay of the torque",
    "speed": "speed",
    "slow": "low speed (as with the Stribeck effect)",
    "fast": "high speed (as with friction that grows faster than speed)",
    "direction": "direction",
    "load": "load on the gear",
    "position": "position",
    "pull": "a position-dependent torque equal in both directions",
    "temperature": "temperature",
    "reversal": "time since the last reversal (as with presliding friction)",
    "gap": "time around motor reversals (as with backlash)",
}
"""Descriptions of the residual factors."""
CAUSES = ("identification", "recordings", "residual", "torque")
"""Kinds of findings that come first, in this order; they often cause the others."""
_MORE = "raise fit.iterations"


def judge(result: Result, commands: Sequence[types.SuggestedCommand] = ()) -> types.Verdict:
    """Return the verdict on a record, ignoring its `verdict`; `commands` are suggested in `Verdict`'s order."""
    ranks = {kind: rank for rank, kind in enumerate(CAUSES)}
    findings = sorted(_find_doubts(result), key=lambda row: (ranks.get(row.kind, len(ranks)), not row.severe))
    severe = any(finding.severe for finding in findings)
    grade: types.Grade = DO_NOT_USE if severe else "use it with care" if findings else CLEAN
    allowed = _allow(commands, grade, identified=not result.not_identified)
    return types.Verdict(grade, findings, allowed)


def _allow(commands: Sequence[types.SuggestedCommand], grade: str, identified: bool) -> list[types.SuggestedCommand]:
    """Return the commands that are safe to suggest: wrong values belong neither on hardware nor in exports."""
    kinds = {row.kind for row in commands}
    left_out: set[str] = {"recording"} if "repair" in kinds else set()
    if grade == DO_NOT_USE:
        left_out |= {"recording", "export"} | ({"law"} if "repair" in kinds or not identified else set())
    elif "repair" in kinds or "recording" in kinds:
        left_out |= {"inspect"}
    allowed = [row for row in commands if row.kind not in left_out]
    return sorted(allowed, key=lambda row: row.kind != "export") if grade == CLEAN else allowed


def is_usable(result: Result) -> bool:
    """Return whether the verdict allows export and experiment design."""
    return result.verdict.grade != DO_NOT_USE


def say_purposes(commands: Sequence[types.SuggestedCommand]) -> str:
    """Return the purposes of suggested commands."""
    return ", ".join(PURPOSES[row.kind] for row in commands)


def say_finding(finding: types.ResultFinding) -> str:
    """Return a finding with its remedy in one sentence."""
    return finding.text + (f"; {finding.mend}" if finding.mend else "")


def _find_doubts(result: Result) -> Iterator[types.ResultFinding]:
    if result.not_identified:
        why, *reasons = result.not_identified
        yield _find(
            "identification", f"the drive was not identified: {why}", f"likely reasons: {'; '.join(reasons)}", True
        )
    for sentence in result.warnings:
        yield _find("recordings", sentence)
    if result.residual:
        yield from _doubt_residual(result.residual)
    if result.torque:
        yield from _doubt_torque(result.torque)
    yield from doubt_errors(result)
    if doubt := doubt_joints(result):
        yield _find("joints", doubt)
    if (doubt := doubt_reference(result.reference)) and not _is_explained(result.residual):
        yield _find("reference", doubt)
    yield from _doubt_train(result)
    yield from _doubt_fit(result.fit)
    yield from _doubt_bounds(result.parameters)
    yield from _doubt_parameters(result)
    yield from _doubt_stability(result)


def _find(
    kind: Any, text: str, mend: str | None = None, severe: bool = False, law: str | None = None
) -> types.ResultFinding:
    return types.ResultFinding(kind, severe, text, mend, law)


def doubt_errors(result: Result) -> Iterator[types.ResultFinding]:
    """Yield the finding on a test error that is missing, or hardly below the one without friction."""
    test, baseline = (result.metrics[part].position_mae for part in ("test", "baseline"))
    if test is None:
        yield _find("gain", "no test error: every test rollout diverged", severe=True)
    elif result.model == "baseline" or not baseline or test <= NOTHING * baseline:
        return
    elif test >= baseline:
        text = "on test data the model is no better than a drive without friction"
        yield _find("gain", text, "do not use its friction", severe=True)
    else:
        yield _find(
            "gain",
            f"on test data the position error is {100 * test / baseline:.0f} % of the error without friction: the "
            "model explains almost nothing, or recordings or bench are wrong",
        )


def _doubt_train(result: Result) -> Iterator[types.ResultFinding]:
    train, test = (result.metrics[part].position_mae for part in ("train", "test"))
    if train is None or test is None or train == 0:
        yield _find("train", "test and training error cannot be compared: one is missing")
    elif test > OVERFIT * train:
        text = f"the test error is {test / train:.2g} times the training error"
        free = sum(row.identified for parameter in result.parameters for row in parameter.by_joint)
        free += result.network.weights if result.network else 0
        samples = sum(log.samples for log in result.data.logs if log.part == "train")
        remedy = "the test data contain motion that the training data lack: compare speeds, loads and times"
        yield _find("train", text, f"the fit may be overfitted, or {remedy}" if ENOUGH * free > samples else remedy)


def _doubt_fit(fit: types.FitRecord) -> Iterator[types.ResultFinding]:
    if fit.stopped == "diverged":
        text = f"the fit diverged after {fit.iterations} iterations"
        yield _find("fit", text, "lower the step size or start from other values", severe=True)
    if fit.stopped == "finished" and fit.method == "lm":
        yield _find("fit", f"the fit did not converge within {fit.iterations} iterations", _MORE)
    if fit.falling > FALLING:
        yield _find(
            "fit", f"the loss still fell by {say_percent(fit.falling)} in the last tenth of the iterations", _MORE
        )
    if fit.moving:
        yield _find("fit", f"parameters still moving at the end of the fit: {', '.join(fit.moving)}", _MORE)


def _doubt_parameters(result: Result) -> Iterator[types.ResultFinding]:
    if doubtful := name_unidentifiable(result.parameters):
        text = f"not identifiable from these data: {', '.join(doubtful)}"
        yield _find("identifiability", text, "do not interpret these values")
    for group in result.indistinct:
        text = f"the data do not distinguish {' and '.join(group)}"
        yield _find("identifiability", text, "fix all but one of them, or record other motion")
    if result.no_intervals is not None and any(p.identified for p in result.parameters):
        yield _find("identifiability", f"no parameter has an interval: {result.no_intervals}")


def list_rollouts(result: Result) -> list[tuple[str, Metrics]]:
    """List the metrics at all horizons and of the long test rollout, with a label of the rollouts."""
    names = {"test": "test", "train": "training", "model": "test", "baseline": "frictionless test"}
    judged = [(names[part], entry[part]) for entry in result.by_horizon for part in ("test", "train", "baseline")]
    return judged + [(names[part], result.paper.a[part]) for part in ("model", "baseline")]


def _doubt_stability(result: Result) -> Iterator[types.ResultFinding]:
    diverged = [(name, metrics) for name, metrics in list_rollouts(result) if metrics.diverged]
    if diverged:
        counts = [f"{m.diverged} of {m.rollouts} {name} rollouts of {m.horizon:g} s" for name, m in diverged]
        severe = any(not name.startswith("frictionless") for name, _ in diverged)
        yield _find("stability", f"diverged rollouts, excluded from the errors: {'; '.join(counts)}", severe=severe)


def _doubt_residual(residual: types.Residual) -> Iterator[types.ResultFinding]:
    rows, unit = residual.by_joint, residual.unit
    factors: dict[tuple[str, str | None], list[tuple[types.JointResidual, types.ResidualFactor]]] = {}
    for row in rows:
        for place in row.places:
            factors.setdefault((place.place, place.law), []).append((row, place))
    for (place, law), pairs in sorted(
        factors.items(), key=lambda item: -max(_share_of_friction(place.torque, row) for row, place in item[1])
    ):
        severe = any(pair.torque > CONTRADICTED * row.friction for row, pair in pairs)
        yield _find("residual", _say_place(place, pairs, unit, len(rows)), _say_law(pairs[0][1]), severe, law)
    for row in rows:
        share = _unexplained(row)
        if share > UNEXPLAINED and row.correlation > ALIKE and not row.places:
            where = f" of {row.joint}" if len(rows) > 1 else ""
            yield _find(
                "residual",
                f"the residual torque{where} exceeds noise by {say_percent(share)} of the friction (correlation of "
                f"consecutive values {row.correlation:.2f}), and no residual factor explains it",
                "check the known values (gains, inertia, delay) and the elasticity between motor and joint",
                severe=share > CONTRADICTED,
            )


def _unexplained(row: types.JointResidual) -> float:
    """Return the RMS residual torque beyond noise, as a share of the friction."""
    return _share_of_friction(float(np.sqrt(max(row.residual**2 - row.noise**2, 0.0))), row)


def _share_of_friction(torque: float, row: types.JointResidual) -> float:
    return torque / max(row.friction, 1e-300)


def _is_explained(residual: types.Residual | None) -> bool:
    rows = residual.by_joint if residual else []
    return bool(rows) and all(_unexplained(row) < UNEXPLAINED and not row.places for row in rows)


def _doubt_torque(torque: types.Torque) -> Iterator[types.ResultFinding]:
    if torque.compared != "torque":
        return
    tests = {row.joint: row.test for row in torque.by_joint}
    shares = {joint: (test.residual or 0.0) / test.torque for joint, test in tests.items() if test.torque}
    if doubtful := {joint: share for joint, share in shares.items() if share > DOUBTED}:
        worst = max(doubtful, key=doubtful.__getitem__)
        where = f" of {name_some([*doubtful])}" if len(tests) > 1 else ""
        yield _find(
            "torque",
            f"recorded torque{where} contradicts the result: on test data it differs from the torque that the motion "
            f"needs by {say_percent(shares[worst])}",
            "check the actuator's gains, signs and units (data.units.torque), and the links' masses",
            severe=shares[worst] > CONTRADICTED,
        )


def _say_place(
    place: str, found: Sequence[tuple[types.JointResidual, types.ResidualFactor]], unit: str, joints: int
) -> str:
    row, factor = max(found, key=lambda pair: _share_of_friction(pair[1].torque, pair[0]))
    where = f" of {name_some([*dict.fromkeys(row.joint for row, _ in found)])}" if joints > 1 else ""
    ripple = ""
    if (periods := factor.periods) is not None:  # the torque's unit tells hinge from slide
        ripple = f" ({periods:.4g} periods per turn)" if unit == "N m" else f" (period {2 * np.pi / periods:.3g} m)"
    size = f"{factor.torque:.2g} {unit}, {say_percent(_share_of_friction(factor.torque, row))} of the friction"
    up_to = "up to " if len(found) > 1 else ""
    return (
        f"the residual torque{where} is not noise: {PLACES[place]}{ripple} explains {up_to}"
        f"{100 * min(factor.share, 1.0):.0f} % of it ({size})"
    )


def _say_law(place: types.ResidualFactor) -> str:
    """Return the remedy for a residual factor: a parameter of the bench, a check, or a model."""
    value = place.value
    if place.place == "constant":
        return f"identify bench.params.torque_offset (about {value:.2g})"
    if place.place == "late":
        return f"identify bench.params.delay (about {value:.2g} s)"
    if place.place == "limit":
        return (
            f"give the actuator a torque_limit (about {value:.3g}): bench.actuator._target_=frictionzoo.bench.JointPD "
            f"'+bench.actuator.params.torque_limit={{init: {value:.3g}, scale: log, identify: true}}'"
        )
    if place.place == "scale":
        times = "" if value is None else f"; {value:.3g} times the actuator's torque would fit"
        return (
            f"check the actuator's gains (bench.actuator.params.kp and kd), the gear ratio, and the mass of link and "
            f"payload{times}; the data do not distinguish these causes"
        )
    if place.place == "gap":
        return f"the model {place.law} has this term" if place.law else "check the model's gap and its initial value"
    if place.place == "pull":
        return "this is not friction: check gravity, payload and springs of the bench, or motor cogging"
    if place.law is None:
        return "the fitted model has this term; check its form and bounds" if place.known else "no model has this term"
    other = "another form of this term" if place.known else "this term"
    return f"the model {place.law} has {other}" + ("" if place.whole else ", but lacks other terms of the fitted model")


def explain_failure(result: Result) -> list[str] | None:
    """Explain why a fit did not identify the drive: symptom, then reasons, likeliest first; None if it may have.

    A fit fails if at least two parameters end at a bound and the test error exceeds a third of the error without
    friction: the model then compensates another error with unrealistic values. A friction term at the lower bound of
    its size does not count: a drive may lack dry friction.
    """
    ended = [p for p in result.parameters if p.at_bound and not (_is_size(p) and not _ended_high(p))]
    error, baseline = (result.metrics[part].position_mae for part in ("test", "baseline"))
    gained_little = error is None or (baseline is not None and error > LITTLE * baseline)
    if len(ended) < BOUNDS or not gained_little:
        return None
    share = (
        "is unknown"
        if error is None or not baseline
        else f"is {100 * error / baseline:.0f} % of the error without friction"
    )
    names = " and ".join(name_where(p, at_bound=True) for p in ended)
    return [
        f"{names} ended at their bounds, and the test error {share}",
        *result.warnings,
        "known values are wrong: the actuator's gains, inertia and gravity in the MJCF, or the recordings' units",
        "commands act with a delay: identify bench.params.delay",
        "the recordings do not excite the drive, or the bounds are unsuitable",
    ]


def _doubt_bounds(parameters: Sequence[ParameterRecord]) -> Iterator[types.ResultFinding]:
    """Yield parameters at their bounds, and links whose inertia leaves nothing for the armature of any joint."""
    for p in parameters:
        if p.at_bound and _is_heavy(p):
            yield _find(
                "identification",
                f"bench.armature of all {len(p.by_joint)} joints ended at its lower bound: the links of the model file "
                "are too heavy",
                "check whether the file counts an inertia twice or adds the rotors to the links; fit=inverse_dynamics "
                "fit.links=[...] identifies link inertias from a recorded torque",
                severe=True,
            )
        elif p.at_bound:
            unit = "" if p.unit == "1" else f" {p.unit}"
            text = f"{name_where(p, at_bound=True)} ended at a bound of {say_bounds(p)}{unit}"
            yield _find("bounds", text, "widen the bounds or try another model", severe=_is_cut_off(p))


def _is_heavy(parameter: ParameterRecord) -> bool:
    """Return whether the armature of each of several joints ended at its lower bound."""
    rows, full = parameter.by_joint, (parameter.owner, parameter.name)
    ended_low = all(row.at_bound for row in rows) and not _ended_high(parameter)
    return full == ("bench", "armature") and len(rows) > 1 and ended_low


def _is_cut_off(parameter: ParameterRecord) -> bool:
    """Return whether a bound cuts off a size or an offset, which other parameters then compensate."""
    is_sized = (_is_size(parameter) or parameter.owner == "bench") and _ended_high(parameter)
    return is_sized or parameter.name.endswith("_offset")


def _is_size(parameter: ParameterRecord) -> bool:
    return parameter.owner == "friction" and parameter.unit in _SIZES


def _ended_high(parameter: ParameterRecord) -> bool:
    ended = (row for row in parameter.by_joint if row.at_bound)
    return any(row.value - row.low >= row.high - row.value for row in ended)


def doubt_joints(result: Result) -> str | None:
    """Report joints that the model does not improve on test data; None if it improves all, or for a single joint."""
    joints = result.by_joint
    if result.model == "baseline" or len(joints) == 1:
        return None
    worse = []
    for joint in joints:
        error, baseline = (joint[part].position_mae for part in ("test", "baseline"))
        if error is not None and baseline and error >= baseline:
            worse.append(f"{joint.joint} (+{100 * (error / baseline - 1):.0f} %)")
    if not worse:
        return None
    return (
        f"on test data {len(worse)} of {len(joints)} joints {'is' if len(worse) == 1 else 'are'} no better than "
        f"without friction: {name_some(worse)}"
    )


def doubt_reference(parameters: Sequence[ReferenceParameter]) -> str | None:
    """Report that the drive without friction, the baseline, ended at bounds; None if it did not."""
    ended = [
        f"{name_where(p, at_bound=True)} ended at a bound of {say_bounds(p)} {p.unit}" for p in parameters if p.at_bound
    ]
    if not ended:
        return None
    return f"in the fit without friction, {' and '.join(ended)}: the change from its error is unreliable"
