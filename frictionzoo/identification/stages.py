"""Stages of the automatic settings: weights, segments, loss, optional parameters and timestep."""

import math

import numpy as np
from jaxtyping import Float

from frictionzoo.bench.template import DEFAULT_SOLREFFRICTION
from frictionzoo.core.params import AUTO
from frictionzoo.core.telling import tell
from frictionzoo.diagnostics.findings import Finding
from frictionzoo.fit.loss import soft_width
from frictionzoo.identification.choices import FEWEST, GAIN, OPTIONAL, RIVALS, imply, option_of, put
from frictionzoo.identification.noise import Misfit
from frictionzoo.identification.pilot import Pilot, PilotResult, halve_step
from frictionzoo.identification.trials import COARSEST, MOST_STEPS, Trials

_LONGEST, _SHORT = 1.0, 0.1  # s, longest segments with and without estimated initial states
_GROWTH = 20.0  # largest growth of a disturbance within a segment
_MOVES = 1 / 3  # largest change of a parameter, in half intervals, when the timestep is halved
_ROUNDS = 4  # most halvings of the timestep
_LATE = 0.2  # delay in sample intervals above which there may be other minima
_CLEAR = 1.5  # half 95 % intervals from 0 beyond which an optional parameter counts as identified (0.3 % by chance)
_FAULTY = 0.05  # relative error up to which a file's gain stays known, as errors of link inertia may cause it
_ROBUST_GAIN = 0.02  # relative gain on the validation block that a robust loss needs
_HELPFUL = 0.005  # relative gain on the validation block that a doubtful parameter needs
_HOPELESS = 3.0  # predicted loss ratio above which softer friction is not fitted, and a step prediction not followed
_HELPS = "reduces the validation error"
_NOT_SHOWN = "not identifiable from these data, fixed at 0"
_AGREES = "the data agree with the file's value"


class Stages(Trials):
    """Stages in order; each uses the choices of the earlier ones."""

    def run(self) -> None:
        """Run all stages."""
        tell("automatic settings: weights and segments")
        self.prepare()
        if self._has_pilots:
            self._choose_loss()
            self._shorten()  # long timesteps act like a delay
            self._choose_optional()
            self._choose_step()
        else:
            self._leave_out()
        self._choose("segments.count", *self._count(MOST_STEPS))
        self.pilot = self._find_pilot() if self._has_pilots else None

    def prepare(self) -> None:
        """Run the stages that need no fit: implied options, precision, weights and segments."""
        for choice in list(imply(self._given["loss"])):
            if self._is_open(choice.option):
                self._choose(choice.option, choice.value, choice.reason)
                put(self._given, choice.option, choice.value)  # later stages treat it as given
        self._weigh()
        self._choose_segments()

    def _weigh(self) -> None:
        second_order = self.settings["bench"].get("second_order")
        reason = f"parameters are valid {'in continuous time' if second_order else 'for this timestep'}"
        self._choose("bench.second_order", second_order, reason)
        double_reason = "least squares need rounding errors far below the noise"
        single_reason = "rounding errors are far below the accuracy of this fit"
        self._choose("dtype", *(("float64", double_reason) if self._has_pilots else ("float32", single_reason)))
        noise, several = self._noise, self._bench.nv > 1
        position = " ".join(f"{value:.2g}" for value in noise.position)
        self._choose("loss.position", 1.0, f"noise of the measured position: {position} {self._unit}")
        velocity, weight = noise.velocity, noise.velocity_weight if self._has_pilots else 1.0
        if not self._has_pilots:
            reason = "this fit starts at measured states, noise included"
        elif velocity is None:
            reason = "velocities were estimated from positions and add almost no information"
        else:
            measured = " ".join(f"{value:.2g}" for value in velocity)
            reason = f"noise of the measured velocity: {measured} {self._unit}/s"
        self._choose("loss.velocity", weight, reason)
        reason = "each joint's errors are divided by their RMS at the start" if several else "one joint"
        self._choose("loss.by_joint", several, reason)
        if not self._has_pilots:
            self._choose("loss.refine", False, "initial states are estimated only with few parameters")

    @property
    def _unit(self) -> str:
        return {"hinge": "rad", "slide": "m"}[self._bench.joint_type]

    def _choose_segments(self) -> None:
        """Choose segments so short that errors of their initial states grow little."""
        longest = self._samples_in(max(_LONGEST, self._model.shortest_segment) if self._has_pilots else _SHORT)
        is_open = self._is_open("segments.length")
        if is_open:
            self.settings["segments"]["length"] = longest
        elif not self._has_pilots:
            return
        pilot = self._pilot()
        self._result = PilotResult.begun(pilot.space.labels, pilot.start)
        if self._has_pilots:
            self._result = pilot.balance(self.bench({"delay"}))
        if not is_open:
            return
        growth = pilot.growth(self._result)
        stable = int(np.argmax(growth > _GROWTH)) if (growth > _GROWTH).any() else longest
        length = max(min(FEWEST, longest), stable)
        reason = f"forces multiply the effect of an initial velocity error on the position by {growth[length - 1]:.2g}"
        self._choose("segments.length", length, f"{length * self._interval:.3g} s: {reason}")

    def _choose_loss(self) -> None:
        """Choose least squares, unless the model lacks something and a robust loss has a smaller validation error."""
        pilot = self._pilot()
        self._go_on(pilot)
        delays = self._result.vector[[label == "bench.delay" for label in self._result.labels]]
        is_late = delays.any() and self._bench.params["delay"].from_coordinate(delays, np) > _LATE * self._interval
        if self._look(pilot).is_more_than_noise or is_late:
            self._go_on(pilot, thorough=True)  # there may be another minimum
        if self._softness_is_open:
            pilot = self._choose_softness(pilot)
        misfit = self._look(pilot)
        self._lacking, self._rounded, reason = misfit.is_more_than_noise, misfit.is_rounding, str(misfit)
        self._choose_encoder()
        if self._lacking:
            misfit = self._measure(pilot.errors(self._result, self._train, self._horizon * self._interval))
        longer = max(self._horizon, self.settings["segments"]["length"])
        robust = {"robust": "soft_l1", "robust_scale": misfit.scale, "refine": False, "length": longer}
        scale_reason = "larger errors get less weight"
        if self.settings["loss"]["robust"] not in (AUTO, "none"):  # a set robust loss needs its scale
            self._choose("loss.robust_scale", robust["robust_scale"], scale_reason)
            return
        try_robust = self._lacking and all(map(self._is_open, ("loss.robust", "loss.robust_scale", "loss.refine")))
        error_ratio = self._validate(**robust) / self._validate() if try_robust else 1.0
        if try_robust:
            reason += f"; the robust loss has {error_ratio:.3g} times the validation error of least squares"
        if error_ratio < 1 - _ROBUST_GAIN:
            self._choose("loss.robust", "soft_l1", reason)
            self._choose("loss.robust_scale", robust["robust_scale"], scale_reason)
            self._choose("loss.refine", False, "a robust loss needs measured initial states")
            if longer > self.settings["segments"]["length"]:
                self._choose("segments.length", longer, "the length of the validated fit")
            return
        refine_reason = "multiple shooting; noise in measured initial states would bias the result"
        self._choose("loss.robust", "none", reason)
        self._choose("loss.robust_scale", 1.0, "not used")
        self._choose("loss.refine", True, refine_reason)

    def _go_on(self, pilot: Pilot, thorough: bool = False) -> None:
        self._fits += 1
        count, step = len(pilot.space.labels), 1e3 * self._first_step
        tell(f"automatic settings: pilot fit {self._fits}, {count} parameters, steps of {step:.3g} ms")
        self._result, self._last_pilot = pilot.fit(self._result, self._left_out, thorough), pilot

    def _look(self, pilot: Pilot) -> Misfit:
        return self._measure(pilot.residuals(self._result))

    def _measure(self, errors: Float[np.ndarray, "batch time nv"]) -> Misfit:
        return Misfit.of(errors, self._noise.position, bool(self.settings["loss"]["by_joint"]))

    def _choose_softness(self, pilot: Pilot) -> Pilot:
        """Choose dry friction as stiff as the timestep allows, or MuJoCo's default if that fits better."""
        reason = "the model has no friction constraint"
        if np.any(self._model.constrained):
            stiff = self._change(solreffriction=list(DEFAULT_SOLREFFRICTION))
            softer, soft = pilot.simulate(self.bench(OPTIONAL)), self._result
            step, loss = pilot.approaching(softer, soft).step(soft)  # a rough prediction with stiff slopes
            if (ratio := loss / soft.loss) < _HOPELESS:
                soft = soft._replace(vector=soft.vector + step)
                soft = pilot.approaching(softer, soft).fit(soft, self._left_out)
                ratio = soft.loss / self._result.loss
            reason = f"MuJoCo's default, {DEFAULT_SOLREFFRICTION[0]:g} s, gives {ratio:.3g} times the loss"
            if ratio < 1:
                self._result, pilot = soft, self._pilot()
                self._go_on(pilot)
            else:
                self.settings["bench"] = stiff
        self._choose("bench.solreffriction", self.settings["bench"]["solreffriction"], reason)
        return pilot

    def _choose_encoder(self) -> None:
        """Ignore errors within half an encoder step if rounding explains the residual."""
        step = self._noise.step
        applies = bool(step) and self._rounded and self.settings["loss"]["robust"] in (AUTO, "none")
        if not (applies and self._is_open("loss.encoder_step")):
            reason = "rounding does not explain the residual" if step else "positions show no rounding beyond noise"
            self._choose("loss.encoder_step", 0.0, reason)
            return
        reason = "rounding explains the residual: errors within half an encoder step do not count"
        self._choose("loss.encoder_step", step, reason)
        reason = f"reduced: position errors beyond half an encoder step count like noise of {soft_width(step):.2g} "
        self._choose("loss.velocity", self._velocity_beside_rounding(), f"{reason}{self._unit}")

    def _choose_optional(self) -> None:
        """Identify optional parameters that differ clearly from absent ones or reduce the validation error."""
        pilot, values = self._corrected_pilot, dict[str, str]()
        assert pilot is not None
        self._go_on(pilot)
        fixed = set(self._left_out)
        if fixed:
            values |= self._judge_rivals(pilot)
        doubtful = self._doubt(values)
        # If the model lacks something, intervals are wide, and a doubtful parameter may compensate and still help.
        error = self._validate() if doubtful and self._lacking else math.inf
        self._left_out |= doubtful
        error_ratio = error / self._validate() if math.isfinite(error) else 1.0
        if helps := error_ratio < 1 - _HELPFUL:
            self._left_out -= doubtful
        elif self._left_out != fixed:  # parameters that are now fixed had biased the others
            self._go_on(pilot)
            if newly_doubtful := self._doubt(values):
                self._left_out |= newly_doubtful
                self._go_on(pilot)
        gain = f"; ratio {error_ratio:.3g}"
        for name in self._free:
            chosen, kept = name not in self._left_out, _AGREES if name == GAIN else _NOT_SHOWN
            why = _HELPS if helps and name in doubtful else OPTIONAL[name] if chosen else kept
            reason = f"{why} ({values[name]})" + gain * (why == _HELPS)
            self._choose(f"{option_of(name)}.identify", chosen, reason)
            if not chosen and name != GAIN:
                put(self.settings, f"{option_of(name)}.init", 0.0)  # instead of its initial value

    def _judge_rivals(self, pilot: Pilot) -> dict[str, str]:
        """Leave out the rival that is not identifiable or fits worse; return the reason by its name."""
        ends = dict(zip(RIVALS, (self._result, pilot.foresee(self._result, *RIVALS)), strict=True))
        shown = {name: self._is_shown(end, name) for name, end in ends.items()}
        best, other = sorted(RIVALS, key=lambda name: (not shown[name][0], ends[name].loss))
        self._left_out, self._result = {other}, ends[best]
        return {other: shown[other][1] + f"; {best} fits better" * shown[other][0]}

    def _doubt(self, told: dict[str, str]) -> set[str]:
        """Return optional parameters that are not identifiable at the last result; add all their values to `told`."""
        shown = {name: self._is_shown(self._result, name) for name in self._free if name not in self._left_out}
        told |= {name: text for name, (_, text) in shown.items()}
        return {name for name, (is_shown, _) in shown.items() if not is_shown}

    def _is_shown(self, found: PilotResult, name: str) -> tuple[bool, str]:
        """Return whether an optional parameter is identifiable, and its values with half intervals as text."""
        param, pilot = self._bench.params[name], self._corrected_pilot
        assert pilot is not None
        rows = [row for row, label in enumerate(found.labels) if label.partition("/")[0] == f"bench.{name}"]
        absent = dict(zip(pilot.space.labels, pilot.absent, strict=True))
        vector, halves = found.vector[rows], found.half[rows]
        values = np.asarray(param.from_coordinate(vector, np))
        away = np.abs(vector - [absent[found.labels[row]] for row in rows])
        # At its upper bound a value has no interval, and 0 explains the recordings still less.
        ended_high = found.at_bound[rows] & (np.abs(values) > 0.5 * np.max(param.each("high", self._bench.nv)))
        least = np.maximum(_CLEAR * halves, _FAULTY if name == GAIN else 0.0)
        shown = bool((away > least).any() or ended_high.any())
        halves = halves * values if param.scale == "log" else np.asarray(param.from_coordinate(halves, np))
        unit = param.unit(self._bench.joint_type)
        texts = (f"{v:.3g}" + (f" +- {h:.2g}" if np.isfinite(h) else "") for v, h in zip(values, halves, strict=True))
        return shown, f"{', '.join(texts)} {unit}" + ("" if np.isfinite(halves).any() else ", no interval")

    def _choose_step(self) -> None:
        """Halve the timestep until a further halving changes no parameter by more than a third of half its interval."""
        reason, largest = self._shorten()
        if largest > _MOVES:
            self.doubts.append(
                Finding(
                    "caution",
                    "timestep",
                    f"bench.timestep={self._step:.3g} s: {reason}, expected at most {_MOVES:.2g}; set a shorter "
                    "bench.timestep, and fewer segments with segments.count to save time",
                )
            )
        self.start = self._result
        self._choose("bench.timestep", self._step, reason)

    def _shorten(self) -> tuple[str, float]:
        """Halve the timestep as often as needed, with the slopes of the first timestep, which compile once.

        Return the reason to stop, and the largest change by a further halving, in half intervals.
        """
        reason, largest, halvings = "", 0.0, 1
        if self._corrected_pilot is None:
            self._corrected_pilot, self._coarse_steps = self._pilot(), self._steps
            self._coarse_pilot = self._corrected_pilot
            if self._corrected_pilot is not self._last_pilot:
                self._go_on(self._corrected_pilot)
        while self._step_is_open:
            bench = self.bench(OPTIONAL)
            softness = None if self._softness_is_open else bench.solreffriction  # a set softness is kept
            for _ in range(halvings):
                bench = halve_step(bench, softness)
            tell(f"automatic settings: effect of steps of {1e3 * bench.timestep:.3g} ms")
            near = self._coarse_pilot.approaching(self._coarse_pilot.simulate(bench), self._result)
            step, loss = near.step(self._result)
            if loss > _HOPELESS * self._result.loss:  # the result is one of long steps: slopes there do not hold
                tell(f"automatic settings: pilot fit again in steps of {1e3 * bench.timestep:.3g} ms")
                fitted = near.fit(self._result, self._left_out)
                step = fitted.among(self._result.labels, self._result.vector) - self._result.vector
            changes = self._result.in_halves(step)
            largest = float(changes.max(initial=0.0))
            label = self._result.labels[int(changes.argmax())]
            share = {1: "half", 2: "a quarter"}.get(halvings, f"1/{2**halvings}")
            reason = f"at {share} of this timestep, {label} would change by {largest:.2g} times its uncertainty "
            reason += "(half its interval, or 0.3 % of its value if that is larger)"
            if largest <= _MOVES or bench.timestep < self._first_step / 2**_ROUNDS:
                break
            self._change(timestep=bench.timestep)
            if self._softness_is_open:
                self._change(solreffriction=bench.solreffriction)
            self._result = self._result._replace(vector=self._result.vector + step)
            self._corrected_pilot = near
            # A second-order error falls to a quarter with each halving; the last halving checks that.
            remaining = _ROUNDS - round(math.log2(self._first_step / self._step))
            halvings = max(1, min(remaining, math.ceil(math.log(min(largest, 4.0**_ROUNDS) / _MOVES, 4)) - 1))
        return reason, largest

    def _leave_out(self) -> None:
        """Fix the options that only pilots can choose."""
        for name in self._free:
            reason = "not estimated in this fit; fit a model with few parameters by fit=lm, then set this value"
            self._choose(f"{option_of(name)}.identify", False, reason)
        reason = "MuJoCo's default; a stiffer constraint is tried only with few parameters"
        self._choose("bench.solreffriction", list(DEFAULT_SOLREFFRICTION), reason)
        self._choose("loss.robust", "none", "a robust loss is tried only with few parameters")
        self._choose("loss.robust_scale", 1.0, "not used")
        self._choose("loss.encoder_step", 0.0, "least squares average out encoder rounding")
        reason = f"at most {1e3 * COARSEST:g} ms, or a fifth of the sample interval if that is longer"
        self._choose("bench.timestep", self._step, reason)
