"""Stages of the automatic settings: weights, segments, loss, optional parameters and timestep."""

import copy
import math
from collections.abc import Collection, Generator, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from frictionzoo.bench import Bench
from frictionzoo.bench.template import DEFAULT_SOLREFFRICTION
from frictionzoo.core.described import remake
from frictionzoo.core.log import Dataset, Log
from frictionzoo.core.params import AUTO
from frictionzoo.core.segments import Segments
from frictionzoo.core.telling import tell
from frictionzoo.diagnostics.findings import Doubt
from frictionzoo.fit import Fit, Space
from frictionzoo.fit.auto import Auto
from frictionzoo.fit.lm import MOST_COORDINATES, LevenbergMarquardt
from frictionzoo.fit.loss import soft_width
from frictionzoo.identification.choices import OPTIONAL, RIVALS, Choice, imply, is_open
from frictionzoo.identification.discretisation import halve_step
from frictionzoo.identification.misfit import Misfit
from frictionzoo.identification.noise import Noise
from frictionzoo.identification.pilot import Found, Pilot
from frictionzoo.models import FrictionModel, TorchFriction

_LONGEST, _SHORT = 1.0, 0.1  # s, longest segments with and without estimated initial states
_FEWEST = 10  # samples of a segment
_MANY = 10  # segments at least: the spread between them gives the intervals
_GROWTH = 20.0  # largest growth of a disturbance within a segment
_COARSEST = 1e-3  # s, longest first timestep, or 1/_FEWEST_STEPS of the sample interval if that is longer
_FEWEST_STEPS = 5
_FIRST_STEPS, _MOST_STEPS = 4e5, 3e6  # most simulation steps times joints, of pilots and of the final fit
_LEAST = 0.1  # smallest share of the segments that is kept
_MOVES = 1 / 3  # largest change of a parameter, in half intervals, when the timestep is halved
_ROUNDS = 4  # most halvings of the timestep
_LATE = 0.2  # delay in sample intervals above which there may be other minima
_CLEAR = 1.5  # half 95 % intervals from 0 beyond which an optional parameter counts as identified (0.3 % by chance)
_BETTER = 0.02  # relative gain on the validation block that a robust loss needs
_HELPFUL = 0.005  # relative gain on the validation block that a doubtful parameter needs
_HOPELESS = 3.0  # predicted loss ratio above which softer friction is not fitted
_VALIDATION = 0.2  # share of the training recordings in the validation block
_HELPS = "reduces the validation error"
_NOT_SHOWN = "not identifiable from these data, fixed at 0"


class Stages:
    """Stages in order; each uses the choices of the earlier ones."""

    def __init__(
        self, settings: Mapping[str, Any], bench: Bench, dataset: Dataset, model: FrictionModel, fit: Fit
    ) -> None:
        self.settings: dict[str, Any] = copy.deepcopy(dict(settings))
        self.doubts: list[Doubt] = []
        self.start: Found | None = None
        self.pilot: Pilot | None = None  # with the chosen settings
        self._given, self._plain, self._train, self._model, self._fit = settings, bench, dataset.train, model, fit
        self._free = {name: is_open(settings["bench"]["params"], name) for name in OPTIONAL}
        self._interval = dataset.train[0].timestep
        self._step_is_open = settings["bench"].get("timestep") == AUTO
        if self._step_is_open:  # the longest one allowed that divides the sample interval
            longest = max(min(bench.timestep, _COARSEST), self._interval / _FEWEST_STEPS)
            self._change(timestep=self._interval / math.ceil(self._interval / longest - 1e-9))
        self._order_is_open = settings["bench"].get("second_order") == AUTO
        if self._order_is_open:
            self._change(second_order=self._step_is_open and not isinstance(model, TorchFriction))
        self._softness_is_open = settings["bench"].get("solreffriction") == AUTO
        if self._softness_is_open:
            stiff = [2 * self._step, 1.0] if np.any(model.constrained) else DEFAULT_SOLREFFRICTION
            self._change(solreffriction=list(stiff))
        self._bench = self.bench(OPTIONAL)
        self._samples = sum(log.samples for log in dataset.train) * self._bench.nv
        self._small = self._is_small()
        self._pilots: dict[str, Pilot] = {}  # by their settings
        self._found: Found  # result of the last pilot
        self._last: Pilot | None = None  # the last pilot
        self._near: Pilot | None = None  # pilot with the chosen loss, corrected to the chosen timestep
        self._first_step, self._coarse_steps = self._step, self._steps
        # Optional parameters fixed at 0. Rivals act nearly alike, so only one of them is tried at a time.
        self._out: set[str] = set(RIVALS[1:]) if all(self._free[name] for name in RIVALS) else set()
        self._noise = Noise.of(self._train)
        self._lacking = False  # whether the residual exceeds noise
        self._rounded = False  # whether encoder rounding explains the residual
        self._validated: dict[str, float] = {}  # errors on the validation block, by the pilot's settings

    def _is_small(self) -> bool:
        """Return whether pilots represent the fit: Levenberg-Marquardt with few parameters."""
        coordinates = len(Space(self._bench, self._model, "float64").start)
        has_few = 0 < coordinates <= MOST_COORDINATES and not isinstance(self._model, TorchFriction)
        return isinstance(self._fit, Auto | LevenbergMarquardt) and has_few

    def bench(self, free: Collection[str] = ()) -> Bench:
        """Return the test stand with the choices so far; `free`: only these open optional parameters are identified."""
        section = self.settings["bench"]
        params = dict(section.get("params") or {})
        for name in OPTIONAL:
            if free and self._free[name]:
                params[name] = {**self._given["bench"]["params"][name], "identify": name in free}
            elif is_open(params, name):
                params[name] = {**params[name], "identify": False}
        changed = {name: section[name] for name in ("timestep", "solreffriction", "second_order") if name in section}
        return remake(self._plain, params=params, **changed)

    def run(self) -> Iterator[Choice]:
        """Run all stages and yield their choices."""
        yield from self._heed()
        yield from self._weigh()
        yield from self._choose_segments()
        if self._small:
            yield from self._choose_loss()
            self._shorten()  # long timesteps act like a delay
            yield from self._choose_free()
            yield from self._choose_step()
        else:
            yield from self._leave_out()
        yield from self._set("segments.count", *self._count(_MOST_STEPS))
        self.pilot = self._find_pilot() if self._small else None

    def _is_open(self, option: str) -> bool:
        section, _, key = option.rpartition(".")
        return (self._given[section] if section else self._given)[key] == AUTO

    def _set(self, option: str, value: Any, reason: str) -> Iterator[Choice]:
        if not self._is_open(option):
            return
        section, _, key = option.rpartition(".")
        (self.settings[section] if section else self.settings)[key] = value
        yield Choice(option, value, reason)

    def _heed(self) -> Iterator[Choice]:
        """Set the options that the given ones determine; later stages treat them as given."""
        for choice in imply(self._given["loss"]):
            section, _, key = choice.option.partition(".")
            yield from self._set(*choice)
            if self._is_open(choice.option):
                self._given = {**self._given, section: {**self._given[section], key: choice.value}}

    def _weigh(self) -> Iterator[Choice]:
        """Choose precision, integration order and weights."""
        if self._order_is_open:
            second_order = self.settings["bench"]["second_order"]
            reason = "parameters hold in continuous time" if second_order else "parameters hold for this timestep"
            yield Choice("bench.second_order", second_order, reason)
        double_reason = "least squares need rounding errors far below the noise"
        single_reason = "rounding errors are far below the accuracy of this fit"
        yield from self._set("dtype", *(("float64", double_reason) if self._small else ("float32", single_reason)))
        noise, several = self._noise, self._bench.nv > 1
        position = " ".join(f"{value:.2g}" for value in noise.position)
        yield from self._set("loss.position", 1.0, f"noise of the measured position: {position} {self._unit}")
        if not self._small:
            yield from self._set("loss.velocity", 1.0, "this fit starts at measured states, noise included")
        else:
            yield from self._set("loss.velocity", noise.velocity_weight, self._say_velocity(noise))
        reason = "each joint's errors are divided by their RMS at the start" if several else "one joint"
        yield from self._set("loss.by_joint", several, reason)
        if not self._small:
            yield from self._set("loss.refine", False, "initial states are estimated only with few parameters")

    def _say_velocity(self, noise: Noise) -> str:
        if noise.velocity is None:
            return "velocities were estimated from positions and add almost no information"
        measured = " ".join(f"{value:.2g}" for value in noise.velocity)
        return f"noise of the measured velocity: {measured} {self._unit}/s"

    @property
    def _unit(self) -> str:
        return {"hinge": "rad", "slide": "m"}[self._bench.joint_type]

    def _choose_segments(self) -> Iterator[Choice]:
        """Choose segments so short that errors of their initial states grow little."""
        longest = self._samples_in(max(_LONGEST, self._model.shortest_segment) if self._small else _SHORT)
        is_open = self._is_open("segments.length")
        if is_open:
            self.settings["segments"]["length"] = longest
        elif not self._small:
            return
        pilot = self._pilot()
        self._found = Found.begun(pilot.space.labels, pilot.start)
        if self._small:
            self._found = pilot.balance(self.bench({"delay"}))
        if not is_open:
            return
        growth = pilot.growth(self._found)
        stable = int(np.argmax(growth > _GROWTH)) if (growth > _GROWTH).any() else longest
        length = max(min(_FEWEST, longest), stable)
        reason = f"an initial velocity error moves the position {growth[length - 1]:.2g} times as far as without forces"
        yield from self._set("segments.length", length, f"{length * self._interval:.3g} s, within which {reason}")

    def _samples_in(self, seconds: float) -> int:
        """Return a segment length in sample intervals, at most `seconds`, that fits each recording and leaves many."""
        shortest_log = min(log.samples for log in self._train) - 1
        longest = self._samples // self._bench.nv // _MANY
        return min(max(_FEWEST, min(round(seconds / self._interval), longest)), shortest_log)

    def _count(self, most_steps: float) -> tuple[int | None, str]:
        """Return the number of segments within `most_steps` simulation steps (None for all), and the reason."""
        length, step = self.settings["segments"]["length"], self._first_step
        steps = self._samples * self._interval / step
        if steps <= most_steps:
            return None, "all segments"
        share = max(most_steps / steps, _LEAST)
        count = max(1, int(share * self._samples / self._bench.nv / length))
        return count, f"{100 * share:.0f} % of all segments, evenly spread: steps of {1e3 * step:.3g} ms are costly"

    def _pilot(self, most_steps: float = _FIRST_STEPS, **given: Any) -> Pilot:
        """Return a pilot with all open bench parameters free; `given` overrides options of segments and loss."""
        options = self._how(most_steps, **given)
        key = self._say_how(*options)
        if key not in self._pilots:
            bench, start = self.bench(OPTIONAL), getattr(self, "_found", None)
            self._pilots[key] = Pilot(bench, self._model, self._train, *options, self.settings["engine"], start)
        return self._pilots[key]

    def repeat(self, settings: Mapping[str, Any], found: Found) -> Pilot:
        """Return the pilot with settings and result of an earlier run."""
        chosen = settings["bench"]
        if self._softness_is_open and chosen["solreffriction"][0] > 2 * chosen["timestep"]:  # softer than stiff
            self._change(solreffriction=chosen["solreffriction"])
        self._coarse_steps, self.settings, self._found = self._steps, {**settings}, found
        return self._find_pilot()

    def _find_pilot(self) -> Pilot:
        """Return the pilot whose equations the fit uses: slopes at the first timestep, residuals at the chosen."""
        chosen = self._steps
        self._change(**self._coarse_steps)
        pilot = self._pilot(_MOST_STEPS)
        self._change(**chosen)
        if chosen != self._coarse_steps:
            pilot = pilot.approaching(pilot.simulate(self.bench(OPTIONAL)), self._found)
        return pilot

    @property
    def _steps(self) -> dict[str, Any]:
        """Options of the bench that a shorter timestep changes."""
        section = self.settings["bench"]
        return {name: section[name] for name in ("timestep", "solreffriction") if name in section}

    def _say_how(self, *how: Any) -> str:
        return repr((self._step, self.settings["bench"].get("solreffriction"), how))

    def _how(self, most_steps: float, **given: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return segment and loss options of a pilot; arguments as in `_pilot`."""
        defaults = {"robust": "none", "robust_scale": 1.0, "refine": True, "encoder_step": self._noise.step}
        loss = dict(self.settings["loss"])
        if loss["encoder_step"] == AUTO and self._noise.step and loss["robust"] in (AUTO, "none"):
            loss["velocity"] = self._velocity_beside_rounding()
        loss = {name: defaults[name] if value == AUTO else value for name, value in loss.items()}
        segments = {**self.settings["segments"], "length": given.pop("length", self.settings["segments"]["length"])}
        if segments["count"] == AUTO:
            segments["count"] = self._count(most_steps)[0]
        return segments, {**loss, **given}

    def _choose_loss(self) -> Iterator[Choice]:
        """Choose least squares, unless the model lacks something and a robust loss has a smaller validation error."""
        pilot = self._pilot()
        self._go_on(pilot)
        delays = self._found.vector[[label == "bench.delay" for label in self._found.labels]]
        is_late = delays.any() and self._bench.params["delay"].from_coordinate(delays, np) > _LATE * self._interval
        if self._look(pilot).is_more_than_noise or is_late:
            self._go_on(pilot, thorough=True)  # there may be another minimum
        if self._softness_is_open:
            pilot = yield from self._choose_softness(pilot)
        misfit = self._look(pilot)
        self._lacking, self._rounded, reason = misfit.is_more_than_noise, misfit.is_rounding, str(misfit)
        yield from self._choose_encoder()
        if self._lacking:
            misfit = self._measure(pilot.errors(self._found, self._train, self._horizon * self._interval))
        longer = max(self._horizon, self.settings["segments"]["length"])
        robust = {"robust": "soft_l1", "robust_scale": misfit.scale, "refine": False, "length": longer}
        scale_reason = "larger errors get less weight"
        if self.settings["loss"]["robust"] not in (AUTO, "none"):  # a set robust loss needs its scale
            yield from self._set("loss.robust_scale", robust["robust_scale"], scale_reason)
            return
        try_robust = self._lacking and all(map(self._is_open, ("loss.robust", "loss.robust_scale", "loss.refine")))
        error_ratio = self._validate(**robust) / self._validate() if try_robust else 1.0
        if try_robust:
            reason += f"; the robust loss has {error_ratio:.3g} times the validation error of least squares"
        if error_ratio < 1 - _BETTER:
            yield from self._set("loss.robust", "soft_l1", reason)
            yield from self._set("loss.robust_scale", robust["robust_scale"], scale_reason)
            yield from self._set("loss.refine", False, "a robust loss starts at measured states")
            if self._is_open("segments.length") and longer > self.settings["segments"]["length"]:
                self.settings["segments"]["length"] = longer
                yield Choice("segments.length", longer, "the length of the validated fit")
            return
        refine_reason = "multiple shooting; noise in measured initial states would bias the result"
        yield from self._set("loss.robust", "none", reason)
        yield from self._set("loss.robust_scale", 1.0, "not used")
        yield from self._set("loss.refine", True, refine_reason)

    def _go_on(self, pilot: Pilot, thorough: bool = False) -> None:
        """Fit a pilot, starting at the last result."""
        count = len(pilot.space.labels)
        tell(f"automatic settings: fitting {count} parameters in steps of {1e3 * self._first_step:.3g} ms")
        self._found, self._last = pilot.fit(self._found, self._out, thorough), pilot

    def _look(self, pilot: Pilot) -> Misfit:
        """Return the misfit of a pilot at the last result."""
        return self._measure(pilot.residuals(self._found))

    def _measure(self, errors: Float[np.ndarray, "batch time nv"]) -> Misfit:
        return Misfit.of(errors, self._noise.position, bool(self.settings["loss"]["by_joint"]))

    @property
    def _horizon(self) -> int:
        """Samples of an evaluation rollout."""
        return self._samples_in(float(self._given["evaluation"]["horizons"][0]))

    def _choose_softness(self, pilot: Pilot) -> Generator[Choice, None, Pilot]:
        """Choose dry friction as stiff as the timestep allows, or MuJoCo's default if that fits better."""
        reason = "the model has no friction constraint"
        if np.any(self._model.constrained):
            stiff = self._change(solreffriction=list(DEFAULT_SOLREFFRICTION))
            softer, soft = pilot.simulate(self.bench(OPTIONAL)), self._found
            step, loss = pilot.approaching(softer, soft).step(soft)  # a rough prediction with stiff slopes
            if (ratio := loss / soft.loss) < _HOPELESS:
                soft = soft._replace(vector=soft.vector + step)
                soft = pilot.approaching(softer, soft).fit(soft, self._out)
                ratio = soft.loss / self._found.loss
            reason = f"MuJoCo's default, {DEFAULT_SOLREFFRICTION[0]:g} s, gives {ratio:.3g} times the loss"
            if ratio < 1:
                self._found, pilot = soft, self._pilot()
                self._go_on(pilot)
            else:
                self.settings["bench"] = stiff
        yield Choice("bench.solreffriction", self.settings["bench"]["solreffriction"], reason)
        return pilot

    def _validate(self, **given: Any) -> float:
        """Return the mean position error on a validation block of the training recordings; `given` as in `_pilot`."""
        key = repr((self.settings["bench"], self._how(_FIRST_STEPS, **given), sorted(self._out)))
        if key not in self._validated:  # an earlier stage may have asked
            pilot = self._pilot(**given)
            is_fitted, block = hold_back(pilot.segments, self._train)
            result = pilot.fit(self._found, self._out, kept=is_fitted)
            horizon = min(self._horizon, min(log.samples for log in block) - 1)
            self._validated[key] = float(np.abs(pilot.errors(result, block, horizon * self._interval)).mean())
        return self._validated[key]

    def _choose_encoder(self) -> Iterator[Choice]:
        """Ignore errors within half an encoder step if rounding explains the residual."""
        step = self._noise.step
        applies = bool(step) and self._rounded and self.settings["loss"]["robust"] in (AUTO, "none")
        if not (applies and self._is_open("loss.encoder_step")):
            reason = "rounding does not explain the residual" if step else "positions show no rounding beyond noise"
            yield from self._set("loss.encoder_step", 0.0, reason)
            return
        reason = "rounding explains the residual: errors within half an encoder step do not count"
        yield from self._set("loss.encoder_step", step, reason)
        if self._is_open("loss.velocity"):
            reason = (
                f"reduced: beyond half an encoder step, position errors count like noise of {soft_width(step):.2g} "
            )
            self.settings["loss"]["velocity"] = self._velocity_beside_rounding()
            yield Choice("loss.velocity", self.settings["loss"]["velocity"], f"{reason}{self._unit}")

    def _velocity_beside_rounding(self) -> float:
        """Return the weight of velocities when only position errors beyond half an encoder step count."""
        if not self._is_open("loss.velocity"):
            return self.settings["loss"]["velocity"]
        share = float(np.square(soft_width(self._noise.step) / self._noise.position).mean())
        return float(f"{share * self._noise.velocity_weight:.3g}")

    def _choose_free(self) -> Iterator[Choice]:
        """Identify optional parameters that differ clearly from 0 or reduce the validation error."""
        free = [name for name, is_free in self._free.items() if is_free]
        pilot, values = self._near, dict[str, str]()
        assert pilot is not None
        self._go_on(pilot)
        fixed = set(self._out)
        if fixed:
            values |= self._judge_rivals(pilot)
        doubtful = self._doubt(values)
        # If the model lacks something, intervals are wide, and a doubtful parameter may compensate and still help.
        error = self._validate() if doubtful and self._lacking else math.inf
        self._out |= doubtful
        error_ratio = error / self._validate() if math.isfinite(error) else 1.0
        if helps := error_ratio < 1 - _HELPFUL:
            self._out -= doubtful
        elif self._out != fixed:  # parameters that are now fixed had biased the others
            self._go_on(pilot)
            if newly_doubtful := self._doubt(values):
                self._out |= newly_doubtful
                self._go_on(pilot)
        gain = f", to {error_ratio:.3g} times its value without it"
        for name in free:
            chosen = name not in self._out
            self._identify(name, chosen)
            why = _HELPS if helps and name in doubtful else OPTIONAL[name] if chosen else _NOT_SHOWN
            yield Choice(f"bench.params.{name}.identify", chosen, f"{why} ({values[name]})" + gain * (why == _HELPS))

    def _judge_rivals(self, pilot: Pilot) -> dict[str, str]:
        """Leave out the rival that is not identifiable or fits worse; return the reason by its name."""
        ends = dict(zip(RIVALS, (self._found, pilot.foresee(self._found, *RIVALS)), strict=True))
        shown = {name: self._is_shown(end, name) for name, end in ends.items()}
        best, other = sorted(RIVALS, key=lambda name: (not shown[name][0], ends[name].loss))
        self._out, self._found = {other}, ends[best]
        return {other: shown[other][1] + f"; {best} fits better" * shown[other][0]}

    def _doubt(self, told: dict[str, str]) -> set[str]:
        """Return optional parameters that are not identifiable at the last result; add all their values to `told`."""
        shown = {name: self._is_shown(self._found, name) for name, free in self._free.items() if free}
        shown = {name: judgement for name, judgement in shown.items() if name not in self._out}
        told |= {name: text for name, (_, text) in shown.items()}
        return {name for name, (is_shown, _) in shown.items() if not is_shown}

    def _is_shown(self, found: Found, name: str) -> tuple[bool, str]:
        """Return whether an optional parameter is identifiable, and its values with half intervals as text."""
        param = self._bench.params[name]
        rows = [row for row, label in enumerate(found.labels) if label.partition("/")[0] == f"bench.{name}"]
        values, halves = (np.asarray(param.from_coordinate(array[rows], np)) for array in (found.vector, found.half))
        ended_high = found.at_bound[rows] & (np.abs(values) > 0.5 * np.max(param.each("high", self._bench.nv)))
        shown = bool((np.abs(values) > _CLEAR * halves).any() or ended_high.any())
        unit = param.unit(self._bench.joint_type)
        texts = (f"{v:.3g}" + (f" +- {h:.2g}" if np.isfinite(h) else "") for v, h in zip(values, halves, strict=True))
        return shown, f"{', '.join(texts)} {unit}" + ("" if np.isfinite(halves).any() else ", no interval")

    def _identify(self, name: str, whether: bool) -> None:
        params = dict(self.settings["bench"]["params"])
        param = {**self._given["bench"]["params"][name], "identify": whether}
        # Not identifiable in a pilot: 0 instead of its initial value.
        params[name] = param if whether or not self._small else {**param, "init": 0.0}
        self.settings["bench"] = {**self.settings["bench"], "params": params}

    def _choose_step(self) -> Iterator[Choice]:
        """Halve the timestep until a further halving changes no parameter by more than a third of half its interval."""
        reason, largest = self._shorten()
        if largest > _MOVES:
            self.doubts.append(
                Doubt(
                    f"bench.timestep={self._step:.3g} s: {reason}, expected at most {_MOVES:.2g}; set a shorter "
                    "bench.timestep, and fewer segments with segments.count to save time"
                )
            )
        self.start = self._found
        if self._step_is_open:
            yield Choice("bench.timestep", self._step, reason)

    def _shorten(self) -> tuple[str, float]:
        """Halve the timestep as often as needed, with the slopes of the first timestep, which compile once.

        Return the reason to stop, and the largest change by a further halving, in half intervals.
        """
        reason, largest, halvings = "", 0.0, 1
        if self._near is None:
            self._near, self._coarse_steps = self._pilot(), self._steps
            self._coarse = self._near
            if self._near is not self._last:
                self._go_on(self._near)
        while self._step_is_open:
            bench = self.bench(OPTIONAL)
            softness = None if self._softness_is_open else bench.solreffriction  # a set softness is kept
            for _ in range(halvings):
                bench = halve_step(bench, softness)
            tell(f"automatic settings: effect of steps of {1e3 * bench.timestep:.3g} ms")
            near = self._coarse.approaching(self._coarse.simulate(bench), self._found)
            step, _ = near.step(self._found)
            changes = self._found.in_halves(step)
            largest = float(changes.max(initial=0.0))
            label = self._found.labels[int(changes.argmax())]
            share = {1: "half", 2: "a quarter"}.get(halvings, f"1/{2**halvings}")
            reason = f"with {share} of it, {label} would change by {largest:.2g} of half its interval or of 0.3 %"
            if largest <= _MOVES or bench.timestep < self._first_step / 2**_ROUNDS:
                break
            self._change(timestep=bench.timestep)
            if self._softness_is_open:
                self._change(solreffriction=bench.solreffriction)
            self._found = self._found._replace(vector=self._found.vector + step)
            self._near = near
            # A second-order error falls to a quarter with each halving; the last halving checks that.
            remaining = _ROUNDS - round(math.log2(self._first_step / self._step))
            halvings = max(1, min(remaining, math.ceil(math.log(min(largest, 4.0**_ROUNDS) / _MOVES, 4)) - 1))
        return reason, largest

    def _change(self, **options: Any) -> dict[str, Any]:
        """Set options of the bench; return the previous section."""
        before = self.settings["bench"]
        self.settings["bench"] = {**before, **options}
        return before

    @property
    def _step(self) -> float:
        """Simulation timestep [s]."""
        step = self.settings["bench"].get("timestep")
        return self._plain.timestep if step in (None, AUTO) else step

    def _leave_out(self) -> Iterator[Choice]:
        """Fix the options that only pilots can choose."""
        for name in [name for name, free in self._free.items() if free]:
            self._identify(name, False)
            reason = "not estimated in this fit; fit a model with few parameters with fit=lm first, then set it"
            yield Choice(f"bench.params.{name}.identify", False, reason)
        if self._softness_is_open:
            self._change(solreffriction=list(DEFAULT_SOLREFFRICTION))
            reason = "MuJoCo's default; a stiffer constraint is tried only with few parameters"
            yield Choice("bench.solreffriction", list(DEFAULT_SOLREFFRICTION), reason)
        yield from self._set("loss.robust", "none", "a robust loss is tried only with few parameters")
        yield from self._set("loss.robust_scale", 1.0, "not used")
        yield from self._set("loss.encoder_step", 0.0, "least squares average out encoder rounding")
        if self._step_is_open:
            yield Choice("bench.timestep", self._step, f"at most {1e3 * _COARSEST:g} ms, divides the sample interval")


def hold_back(segments: Segments, logs: Sequence[Log]) -> tuple[Bool[np.ndarray, "segments"], list[Log]]:
    """Return which segments to fit, and a validation block of recordings that does not overlap them.

    The block is every fifth recording, or the last fifth of each if there are fewer than five.
    """
    every = round(1 / _VALIDATION)
    cuts = [log.samples * bool(number % every) for number, log in enumerate(logs)]
    if len(logs) < every:
        cuts = [round((1 - _VALIDATION) * log.samples) for log in logs]
    cut_logs = list(zip(logs, cuts, strict=True))
    block = [log.between(cut, log.samples, "validation") for log, cut in cut_logs if cut < log.samples]
    ends = np.array([log.time[0] + (cut - 0.5) * log.timestep for log, cut in cut_logs])
    assert segments.recording is not None and segments.begins is not None
    segment_ends = segments.begins + segments.length * segments.timestep
    return segment_ends < ends[segments.recording], block
