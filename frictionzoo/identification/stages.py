"""What a recipe chooses, stage by stage: weights, segments, loss, what is late or askew, and the simulation step."""

import copy
import math
from collections.abc import Generator, Iterator, Mapping
from typing import Any

import numpy as np

from frictionzoo.bench import Bench
from frictionzoo.bench.base import DEFAULT_SOLREFFRICTION
from frictionzoo.checkup.findings import Doubt
from frictionzoo.core.described import remake
from frictionzoo.core.log import Dataset, Log
from frictionzoo.core.params import AUTO
from frictionzoo.fit import Fit, Space
from frictionzoo.fit.auto import Auto
from frictionzoo.fit.lm import MOST_COORDINATES, LevenbergMarquardt
from frictionzoo.fit.loss import soft_width
from frictionzoo.identification.choices import OPTIONAL, RIVALS, Choice, imply, is_open
from frictionzoo.identification.misfit import Misfit
from frictionzoo.identification.noise import Noise
from frictionzoo.identification.pilot import Found, Pilot
from frictionzoo.models import FrictionModel, TorchFriction

_LONGEST, _SHORT = 1.0, 0.1  # s, of segments: with initial states that are estimated along, and for other fits
_FEWEST = 10  # samples of a segment
_MANY = 10  # segments that there are at the least, for the spread between them says how sure a value is
_GROWTH = 20.0  # times that a disturbance may grow within a segment
_COARSEST = 1e-3  # s, of the simulation
_STIFFEST = 5e-4  # s, time constant of the friction constraint
_FIRST_STEPS, _MOST_STEPS = 1e6, 3e6  # simulation steps times joints, of first fits and of the last
_LEAST = 0.1  # share of the segments that is left where they are too many steps
_MOVES = 1 / 3  # of half an interval, that a parameter may move by when the simulation step is halved
_ROUNDS = 3  # of shorter steps
_CLEAR = 1.5  # times half its 95 % interval that an optional parameter is away from 0, with a chance of 0.3 %
_BETTER = 0.02  # share by which a robust loss has to predict a validation block better than least squares
_HELPFUL = 0.005  # share by which a parameter that is not shown has to
_VALIDATION = 0.2  # share of the training recordings


class Stages:
    """The settings on their way: what one stage chooses, the next ones use."""

    def __init__(
        self, settings: Mapping[str, Any], bench: Bench, dataset: Dataset, model: FrictionModel, fit: Fit
    ) -> None:
        self.settings: dict[str, Any] = copy.deepcopy(dict(settings))
        self.doubts: list[Doubt] = []
        self.start: Found | None = None
        self._given, self._plain, self._train, self._model, self._fit = settings, bench, dataset.train, model, fit
        self._free = {name: is_open(settings["bench"]["params"], name) for name in OPTIONAL}
        self._closed = ""  # what is left out while its rival is free
        self._interval = dataset.train[0].timestep
        self._step_is_open = settings["bench"].get("timestep") == AUTO
        if self._step_is_open:  # the longest whole part of a sample interval that is no longer
            longest = min(bench.timestep, _COARSEST)
            self._set_step(self._interval / math.ceil(self._interval / longest - 1e-9))
        self._order_is_open = settings["bench"].get("second_order") == AUTO
        if self._order_is_open:
            self._change(second_order=self._step_is_open and not isinstance(model, TorchFriction))
        self._softness_is_open = settings["bench"].get("solreffriction") == AUTO
        if self._softness_is_open:
            stiff = [max(2 * self._step, _STIFFEST), 1.0] if np.any(model.constrained) else DEFAULT_SOLREFFRICTION
            self._change(solreffriction=list(stiff))
        self._bench = self.bench(free=True)
        self._closed = RIVALS[1] if all(self._free[name] for name in RIVALS) else ""
        self._samples = sum(log.samples for log in dataset.train) * self._bench.nv
        self._small = self._is_small()
        self._found: Found | None = None  # where a pilot with all that is free ended, with the loss that was chosen
        self._first: Found | None = None  # where the first one did, of several starts: others begin there
        self._noise = Noise.of(self._train)
        self._lacking = False  # whether the law leaves more than noise
        self._rounded = False  # whether it leaves what rounding does
        self._kept: dict[str, bool] = {}  # whether what was free is identified
        self._validated: dict[str, float] = {}  # errors on the validation block, by the pilot's settings
        self._shown: list[str] = []  # of it, what recordings show, and not what is of use alone

    def _is_small(self) -> bool:
        """Whether the fit is Levenberg-Marquardt's: then a pilot of it says what is best."""
        coordinates = len(Space(self._bench, self._model, "float64").start)
        of_few = 0 < coordinates <= MOST_COORDINATES and not isinstance(self._model, TorchFriction)
        return isinstance(self._fit, Auto | LevenbergMarquardt) and of_few

    def bench(self, free: bool = False) -> Bench:
        """The test stand by now, with what is still open identified or left out."""
        section = self.settings["bench"]
        params = dict(section.get("params") or {})
        for name in (name for name in OPTIONAL if is_open(params, name)):
            params[name] = {**params[name], "identify": free and name != self._closed}
        changed = {name: section[name] for name in ("timestep", "solreffriction", "second_order") if name in section}
        return remake(self._plain, params=params, **changed)

    def run(self) -> Iterator[Choice]:
        """All stages."""
        yield from self._heed()
        yield from self._weigh()
        yield from self._choose_segments()
        if self._small:
            yield from self._choose_loss()
            yield from self._choose_encoder()
            yield from self._choose_free()
            yield from self._refine_step()
        else:
            yield from self._leave_out()
        yield from self._set("segments.count", *self._count(_MOST_STEPS))

    def _is_open(self, option: str) -> bool:
        section, _, key = option.rpartition(".")
        return (self._given[section] if section else self._given)[key] == AUTO

    def _set(self, option: str, value: Any, reason: str) -> Iterator[Choice]:
        """Choose an option if it is open."""
        if not self._is_open(option):
            return
        section, _, key = option.rpartition(".")
        (self.settings[section] if section else self.settings)[key] = value
        yield Choice(option, value, reason)

    def _heed(self) -> Iterator[Choice]:
        """What the given options leave no choice for, which then counts as given."""
        for choice in imply(self._given["loss"]):
            section, _, key = choice.option.partition(".")
            yield from self._set(*choice)
            if self._is_open(choice.option):
                self._given = {**self._given, section: {**self._given[section], key: choice.value}}

    def _weigh(self) -> Iterator[Choice]:
        """Precision and weights."""
        if self._order_is_open:
            second = self.settings["bench"]["second_order"]
            why = "parameters are the drive's in continuous time" if second else "parameters are those for this step"
            yield Choice("bench.second_order", second, why)
        least_squares = "least squares are solved to the last digit: rounding must stay far below the noise"
        other = "rounding is far below what a fit that is no least squares of few parameters tells apart"
        yield from self._set("dtype", *(("float64", least_squares) if self._small else ("float32", other)))
        noise, several = self._noise, self._bench.nv > 1
        position = " ".join(f"{each:.2g}" for each in noise.position)
        yield from self._set("loss.position", 1.0, f"noise of the measured position: {position} {self._unit}")
        if not self._small:
            yield from self._set("loss.velocity", 1.0, "this fit begins at measured states, whose noise is in both")
        else:
            yield from self._set("loss.velocity", noise.velocity_weight, self._say_velocity(noise))
        why = "each joint's errors count over what is left of them" if several else "there is one joint"
        yield from self._set("loss.by_joint", several, why)
        if not self._small:
            yield from self._set("loss.refine", False, "initial states are estimated in fits of few parameters")

    def _say_velocity(self, noise: Noise) -> str:
        if noise.velocity is None:
            return "velocities were estimated from positions and say next to nothing besides"
        measured = " ".join(f"{each:.2g}" for each in noise.velocity)
        return f"noise of the measured velocity: {measured} {self._unit}/s"

    @property
    def _unit(self) -> str:
        return {"hinge": "rad", "slide": "m"}[self._bench.joint_type]

    def _choose_segments(self) -> Iterator[Choice]:
        """As long as rollouts stay near the recording, however their initial state is off."""
        if not self._is_open("segments.length"):
            return
        longest = self._samples_in(max(_LONGEST, self._model.shortest_segment) if self._small else _SHORT)
        self.settings["segments"]["length"] = longest
        grown = self._pilot().growth()
        steady = int(np.argmax(grown > _GROWTH)) if (grown > _GROWTH).any() else longest
        length = max(min(_FEWEST, longest), steady)
        far = f"a disturbance of the velocity goes {grown[length - 1]:.2g} times as far as without forces"
        yield from self._set("segments.length", length, f"{length * self._interval:.3g} s, in which {far}")

    def _samples_in(self, seconds: float) -> int:
        """Sample intervals of a segment: at most so long, within each recording, and with many others beside it."""
        shortest = min(log.samples for log in self._train) - 1
        among_many = self._samples // self._bench.nv // _MANY
        return min(max(_FEWEST, min(round(seconds / self._interval), among_many)), shortest)

    def _count(self, most_steps: float) -> tuple[int | None, str]:
        """How many segments are simulated in so many steps, and why."""
        length, step = self.settings["segments"]["length"], self._step
        steps = self._samples * self._interval / step
        if steps <= most_steps:
            return None, "all there are"
        share = max(most_steps / steps, _LEAST)
        count = max(1, int(share * self._samples / self._bench.nv / length))
        return count, f"{100 * share:.0f} % of all, evenly spread: with steps of {1e3 * step:.3g} ms these say enough"

    def _pilot(self, most_steps: float = _FIRST_STEPS, **given: Any) -> Pilot:
        """A pilot with the settings as they are by now; what is open of the bench is free.

        Args:
            most_steps: For which segments are left out.
            given: `logs`, in place of all that train, and options of segments and loss in place of the settings'.
        """
        logs = given.pop("logs", self._train)
        how = self._how(most_steps, **given)
        return Pilot(self.bench(free=True), self._model, logs, *how, self.settings["engine"], self._first)

    def _how(self, most_steps: float, **given: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        """Segments and loss of a pilot; arguments as in `_pilot`."""
        usual = {"robust": "none", "robust_scale": 1.0, "encoder_step": 0.0, "refine": True}
        loss = {name: usual[name] if value == AUTO else value for name, value in self.settings["loss"].items()}
        segments = {**self.settings["segments"], "length": given.pop("length", self.settings["segments"]["length"])}
        if segments["count"] == AUTO:
            segments["count"] = self._count(most_steps)[0]
        return segments, {**loss, **given}

    def _choose_loss(self) -> Iterator[Choice]:
        """Least squares, unless the law lacks something and a robust loss predicts a validation block better."""
        pilot, found = yield from self._choose_softness()
        self._first = found
        horizon = self._samples_in(float(self._given["evaluation"]["horizons"][0]))
        errors = pilot.errors(found.vector, self._train, horizon * self._interval)
        misfit = Misfit.of(errors, self._noise.position, bool(self.settings["loss"]["by_joint"]))
        self._lacking, self._rounded, told = misfit.is_more_than_noise, misfit.is_rounding, str(misfit)
        longer = max(horizon, self.settings["segments"]["length"])
        robust = {"robust": "soft_l1", "robust_scale": misfit.scale, "refine": False, "length": longer}
        beyond_it = "beyond, errors count by their size"
        if self.settings["loss"]["robust"] not in (AUTO, "none"):  # of these errors; the pilot knew no scale
            yield from self._set("loss.robust_scale", robust["robust_scale"], beyond_it)
            return
        wanted = self._lacking and all(map(self._is_open, ("loss.robust", "loss.robust_scale", "loss.refine")))
        share = self._validate(**robust) / self._validate() if wanted else 1.0
        if wanted:
            told += f"; a robust loss predicts a validation block with {share:.3g} times the error of least squares"
        if share < 1 - _BETTER:
            yield from self._set("loss.robust", "soft_l1", told)
            yield from self._set("loss.robust_scale", robust["robust_scale"], beyond_it)
            yield from self._set("loss.refine", False, "a robust loss begins at measured states")
            if self._is_open("segments.length") and longer > self.settings["segments"]["length"]:
                self.settings["segments"]["length"] = longer
                yield Choice("segments.length", longer, "longer: so it predicted the validation block")
            return
        self._found = found
        along = "initial states are estimated along, so that the noise of measured ones does not bend the result"
        yield from self._set("loss.robust", "none", told)
        yield from self._set("loss.robust_scale", 1.0, "not used")
        yield from self._set("loss.refine", True, along)

    def _validate(self, **given: Any) -> float:
        """Mean error of position on a block of the training recordings, of a fit that has not seen it.

        Args:
            given: As `_pilot` takes it.
        """
        same = repr((self.settings["bench"], *self._how(_FIRST_STEPS, **given)))
        if same not in self._validated:  # a stage asks again what the one before has asked, with what that chose
            fitted, block = divide(self._train)
            horizon = self._samples_in(float(self._given["evaluation"]["horizons"][0]))
            horizon = min(horizon, min(log.samples for log in block) - 1)
            pilot = self._pilot(logs=fitted, **given)
            errors = pilot.errors(self._go_on(pilot).vector, block, horizon * self._interval)
            self._validated[same] = float(np.abs(errors).mean())
        return self._validated[same]

    def _go_on(self, pilot: Pilot, found: Found | None = None, shifted: bool = False) -> Found:
        """Where a pilot ends that begins where another ended, or else the first of all.

        With a robust loss, which has other minima than least squares, the better end of that and of the initial values.

        Args:
            pilot: The other one.
            found: Where to begin.
            shifted: Whether to try other delays, too: of another loss, the least may be in another sample interval.
        """
        begun = found or self._first
        if begun is None:
            return pilot.fit()
        starts = [begun.among(pilot.space.labels, pilot.start)]
        starts += [pilot.start] if pilot.robust and found is None else []
        return min((pilot.fit(start, beside=begun, shifted=shifted) for start in starts), key=lambda end: end.loss)

    def _choose_encoder(self) -> Iterator[Choice]:
        """Errors within half an encoder's step do not count where rounding is all that is left."""
        step, width = self._noise.step, soft_width(self._noise.step)
        counts = bool(step) and self._rounded and self.settings["loss"]["robust"] == "none"
        if not (counts and self._is_open("loss.encoder_step")):
            told = "rounding is not what is left" if step else "positions are not rounded, or have more noise than that"
            yield from self._set("loss.encoder_step", 0.0, told)
            return
        told = "positions are rounded to it, and nothing more is left: within half of it errors say nothing"
        yield from self._set("loss.encoder_step", step, told)
        if self._is_open("loss.velocity"):
            share = float(np.square(width / self._noise.position).mean())
            self.settings["loss"]["velocity"] = float(f"{share * self._noise.velocity_weight:.3g}")
            told = f"less: beyond half a step, errors of position count as noise of {width:.2g} {self._unit} would"
            yield Choice("loss.velocity", self.settings["loss"]["velocity"], told)
        self._found = None  # with another loss

    def _choose_free(self) -> Iterator[Choice]:
        """What of the bench recordings show: its interval does not hold 0, or it helps to predict others."""
        free = [name for name, is_free in self._free.items() if is_free]
        if not free:
            return
        self._found = self._found or self._go_on(self._pilot(), shifted=True)
        shown = {name: self._is_shown(self._found, name) for name in free if name != self._closed}
        if self._closed:
            shown |= self._judge_rivals()
        doubtful = [name for name, (is_shown, _) in shown.items() if not is_shown]
        self._shown = [name for name in free if name not in doubtful]
        # Where a law lacks something, intervals are wide, and what makes up for it may be of use all the same.
        helping = self._validate() if doubtful and self._lacking else math.inf
        for name in free:
            self._identify(name, name not in doubtful)
        share = helping / self._validate() if math.isfinite(helping) else 1.0
        for name, (is_shown, told) in shown.items():
            helps = not is_shown and name != self._closed and share < 1 - _HELPFUL
            self._identify(name, is_shown or helps)
            why = OPTIONAL[name] if is_shown else "of use" if helps else "not shown"
            beside = f"; with it, the error on a validation block is {share:.3g} times as large" if helps else ""
            yield Choice(f"bench.params.{name}.identify", is_shown or helps, f"{why}: {told}{beside}")

    def _judge_rivals(self) -> dict[str, tuple[bool, str]]:
        """Which of the rivals shows, each tried without the other: of two that do, the one that fits better."""
        first, second = RIVALS
        self._closed = first
        ends = {first: self._found, second: self._go_on(self._pilot(), self._found)}
        shown = {name: self._is_shown(end, name) for name, end in ends.items() if end is not None}
        best, other = sorted(RIVALS, key=lambda name: (not shown[name][0], ends[name].loss))
        self._closed, self._found = other, ends[best]
        if shown[other][0]:
            shown[other] = False, f"{shown[other][1]}; {best} fits better"
        return shown

    def _is_shown(self, found: Found, name: str) -> tuple[bool, str]:
        """Whether an optional parameter is, and its values with half their intervals."""
        param = self._bench.params[name]
        own = [at for at, label in enumerate(found.labels) if label.partition("/")[0] == f"bench.{name}"]
        values, halves = (np.asarray(param.from_coordinate(of[own], np)) for of in (found.vector, found.half))
        ended_high = found.at_bound[own] & (np.abs(values) > 0.5 * np.max(param.each("high", self._bench.nv)))
        shown = bool((np.abs(values) > _CLEAR * halves).any() or ended_high.any())
        unit = param.unit(self._bench.joint_type)
        said = (f"{v:.3g}" + (f" +- {h:.2g}" if np.isfinite(h) else "") for v, h in zip(values, halves, strict=True))
        return shown, f"{', '.join(said)} {unit}" + ("" if np.isfinite(halves).any() else ", of which nothing is told")

    def _identify(self, name: str, whether: bool) -> None:
        self._kept[name] = whether
        params = dict(self.settings["bench"]["params"])
        own = {**self._given["bench"]["params"][name], "identify": whether}
        # Looked for and not found, it is known to be 0 and not what it began with.
        params[name] = own if whether or not self._small else {**own, "init": 0.0}
        self.settings["bench"] = {**self.settings["bench"], "params": params}

    def _refine_step(self) -> Iterator[Choice]:
        """Halve the step until no parameter moves by more than a third of half its interval."""
        found = self._found
        if found is None or not all(self._kept.values()):  # what was free and is not has bent the others
            found = self._go_on(self._pilot(), found)
            looked = {name: self._is_shown(found, name) for name in self._shown}
            for name, (_, told) in ((name, of) for name, of in looked.items() if not of[0]):
                self._identify(name, False)
                yield Choice(f"bench.params.{name}.identify", False, f"not shown without the others: {told}")
            if not all(is_shown for is_shown, _ in looked.values()):
                found = self._go_on(self._pilot(), found)
        reason = ""
        for left in reversed(range(_ROUNDS if self._step_is_open else 0)):
            step = self._set_step(self._step / 2)
            ahead = self._pilot(_MOST_STEPS).step_from(found)
            moves = found.in_halves(ahead)
            largest = float(moves.max(initial=0.0))
            moved = found.labels[int(moves.argmax())]
            reason = f"halved, {moved} would move by {largest:.2g} of half its interval, or of 0.3 %"
            if largest <= _MOVES:
                self._set_step(step)
                break
            found = found._replace(vector=found.vector + ahead)
            if not left:
                self.doubts.append(
                    Doubt(
                        f"bench.timestep={self._step:.3g} s: {reason}, expected at most {_MOVES:.2g}; shorter steps "
                        "take long: set bench.timestep, and fewer segments with segments.count"
                    )
                )
        self.start = found
        if self._step_is_open:
            yield Choice("bench.timestep", self._step, reason)

    def _choose_softness(self) -> Generator[Choice, None, tuple[Pilot, Found]]:
        """Dry friction as stiff as the step allows, or as soft as MuJoCo has it where that fits better.

        Before all that the first fit decides, so that both have the same loss. Returns that fit.
        """
        pilot = self._pilot()
        found = pilot.fit()
        if not self._softness_is_open:
            return pilot, found
        why = "the law has no friction constraint"
        if np.any(self._model.constrained):
            stiff = self._change(solreffriction=list(DEFAULT_SOLREFFRICTION))
            other = self._pilot()
            soft = other.fit(found.vector, beside=found)
            why = f"MuJoCo's own, {DEFAULT_SOLREFFRICTION[0]:g} s, has {soft.loss / found.loss:.3g} times the loss"
            if soft.loss < found.loss:
                pilot, found = other, soft
            else:
                self.settings["bench"] = stiff
        yield Choice("bench.solreffriction", self.settings["bench"]["solreffriction"], why)
        return pilot, found

    def _change(self, **options: Any) -> dict[str, Any]:
        """Take other options of the bench; returns the section before."""
        before = self.settings["bench"]
        self.settings["bench"] = {**before, **options}
        return before

    @property
    def _step(self) -> float:
        """Of the simulation [s]."""
        step = self.settings["bench"].get("timestep")
        return self._plain.timestep if step in (None, AUTO) else step

    def _set_step(self, step: float) -> float:
        """Take another step; returns the one before."""
        before = self._step
        self._change(timestep=step)
        return before

    def _leave_out(self) -> Iterator[Choice]:
        """What a fit without a pilot does not look for."""
        for name in [name for name, free in self._free.items() if free]:
            self._identify(name, False)
            why = "not looked for in this fit; fit a law of few parameters with fit=lm first, then set it"
            yield Choice(f"bench.params.{name}.identify", False, why)
        if self._softness_is_open:
            self._change(solreffriction=list(DEFAULT_SOLREFFRICTION))
            why = "MuJoCo's own; a stiffer one is tried in fits of few parameters"
            yield Choice("bench.solreffriction", list(DEFAULT_SOLREFFRICTION), why)
        yield from self._set("loss.robust", "none", "the errors' tails are looked at in fits of few parameters")
        yield from self._set("loss.robust_scale", 1.0, "not used")
        yield from self._set("loss.encoder_step", 0.0, "least squares average over what the encoder rounds")
        if self._step_is_open:
            yield Choice("bench.timestep", self._step, f"at most {1e3 * _COARSEST:g} ms, a whole part of the interval")


def divide(logs: tuple[Log, ...]) -> tuple[tuple[Log, ...], tuple[Log, ...]]:
    """Recordings to fit, and a validation block: every fifth of many, the last fifth of each of few."""
    every = round(1 / _VALIDATION)
    if len(logs) >= every:
        return tuple(log for at, log in enumerate(logs) if at % every), logs[::every]
    cuts = [(log, round((1 - _VALIDATION) * log.samples)) for log in logs]
    return (
        tuple(log.between(0, cut, "fitted") for log, cut in cuts),
        tuple(log.between(cut, log.samples, "validation") for log, cut in cuts),
    )
