"""Trials of the automatic settings: pilot fits with the settings chosen so far."""

import copy
import logging
import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool

from frictionzoo.bench import Bench
from frictionzoo.bench.template import DEFAULT_SOLREFFRICTION
from frictionzoo.core.errors import BenchError
from frictionzoo.core.log import Dataset, Log
from frictionzoo.core.params import AUTO
from frictionzoo.core.segments import Segments, longest_window
from frictionzoo.core.telling import tell
from frictionzoo.diagnostics.findings import Finding
from frictionzoo.fit import Fit, Space
from frictionzoo.fit.auto import Auto
from frictionzoo.fit.lm import MOST_COORDINATES, LevenbergMarquardt
from frictionzoo.fit.loss import soft_width
from frictionzoo.identification.choices import FEWEST, OPTIONAL, RIVALS, change_bench, get, is_open, option_of, put
from frictionzoo.identification.noise import Noise
from frictionzoo.identification.pilot import Pilot, PilotResult
from frictionzoo.models import FrictionModel, TorchFriction
from frictionzoo.result.section_types import AutomaticSetting

_log = logging.getLogger(__name__)
_MANY = 10  # segments at least: the spread between them gives the intervals
COARSEST = 1e-3  # s, longest first timestep, or 1/_FEWEST_STEPS of the sample interval if that is longer
_FEWEST_STEPS = 5
_FIRST_STEPS, MOST_STEPS = 4e5, 3e6  # most simulation steps times joints, of pilots and of the final fit
_LEAST = 0.1  # smallest share of the segments that is kept
_VALIDATION = 0.2  # share of the training recordings in the validation block


class Trials:
    """Settings chosen so far, and pilot fits with them."""

    def __init__(
        self, settings: Mapping[str, Any], bench: Bench, dataset: Dataset, model: FrictionModel, fit: Fit
    ) -> None:
        self.settings: dict[str, Any] = copy.deepcopy(dict(settings))
        self.choices: list[AutomaticSetting] = []
        self.doubts: list[Finding] = []
        self.start: PilotResult | None = None
        self.pilot: Pilot | None = None  # with the chosen settings
        self._given: dict[str, Any] = copy.deepcopy(dict(settings))
        self._plain, self._train, self._model = bench, dataset.train, model
        self._free = [name for name in OPTIONAL if self._is_open(f"{option_of(name)}.identify")]
        self._interval = dataset.train[0].timestep
        self._step_is_open = self._is_open("bench.timestep")
        if self._step_is_open:  # the longest one allowed that divides the sample interval
            longest = max(min(bench.timestep, COARSEST), self._interval / _FEWEST_STEPS)
            self._change(timestep=self._interval / math.ceil(self._interval / longest - 1e-9))
        if self._is_open("bench.second_order"):
            self._change(second_order=self._step_is_open and not isinstance(model, TorchFriction))
        self._softness_is_open = self._is_open("bench.solreffriction")
        if self._softness_is_open:
            stiff = [2 * self._step, 1.0] if np.any(model.constrained) else DEFAULT_SOLREFFRICTION
            self._change(solreffriction=list(stiff))
        self._fix_impossible()
        self._bench = self.bench(OPTIONAL)
        self._samples = sum(log.samples for log in dataset.train) * self._bench.nv
        coordinates = len(Space(self._bench, model, "float64").start)
        is_few = 0 < coordinates <= MOST_COORDINATES and not isinstance(model, TorchFriction)
        # Whether pilots represent the fit: Levenberg-Marquardt with few parameters.
        self._has_pilots = isinstance(fit, Auto | LevenbergMarquardt) and is_few
        self._pilots: dict[str, Pilot] = {}  # by their settings
        self._fits = 0  # pilot fits so far, for the terminal
        self._result: PilotResult  # result of the last pilot
        self._last_pilot: Pilot | None = None  # the last pilot
        self._corrected_pilot: Pilot | None = None  # pilot with the chosen loss, corrected to the chosen timestep
        self._first_step, self._coarse_steps = self._step, self._steps
        # Optional parameters fixed at 0. Rivals act nearly alike, so only one of them is tried at a time.
        self._left_out: set[str] = set(RIVALS[1:]) if {*RIVALS} <= {*self._free} else set()
        self._noise = Noise.of(self._train)
        self._lacking = False  # whether the residual exceeds noise
        self._rounded = False  # whether encoder rounding explains the residual
        self._validated: dict[str, float] = {}  # errors on the validation block, by the pilot's settings

    def _fix_impossible(self) -> None:
        """Fix an encoder offset that the MJCF does not allow."""
        try:
            self.bench(OPTIONAL)
        except BenchError:
            option = "bench.params.position_offset"
            if "position_offset" not in self._free:
                raise
            self._free.remove("position_offset")
            reason = "a spring, limit, tendon or reference position of the MJCF would not shift with the encoder"
            self._choose(f"{option}.identify", False, reason)
            put(self.settings, f"{option}.init", 0.0)

    def bench(self, free: Collection[str] = ()) -> Bench:
        """Return the test stand with the choices so far; `free`: only these open optional parameters are identified."""
        settings = {"bench": copy.deepcopy(self.settings["bench"])}
        for name in self._free:
            option = option_of(name)
            if free:
                put(settings, option, {**get(self._given, option), "identify": name in free})
            elif is_open(settings, f"{option}.identify"):
                put(settings, f"{option}.identify", False)
        return change_bench(self._plain, settings["bench"])

    def repeat(self, settings: Mapping[str, Any], found: PilotResult) -> Pilot:
        """Return the pilot with settings and result of an earlier run."""
        chosen = settings["bench"]
        if self._softness_is_open and chosen["solreffriction"][0] > 2 * chosen["timestep"]:  # softer than stiff
            self._change(solreffriction=chosen["solreffriction"])
        self._coarse_steps, self.settings, self._result = self._steps, {**settings}, found
        return self._find_pilot()

    def _is_open(self, option: str) -> bool:
        return is_open(self._given, option)

    def _choose(self, option: str, value: Any, reason: str) -> None:
        """Set an option and record the choice, unless the user set it, or the open options lack it."""
        if self._is_open(option):
            put(self.settings, option, value)
            self.choices.append(AutomaticSetting(option, value, reason))
            _log.debug("%s", self.choices[-1])

    def _pilot(self, most_steps: float = _FIRST_STEPS, **given: Any) -> Pilot:
        """Return a pilot with all open bench parameters free; `given` overrides options of segments and loss."""
        options = self._how(most_steps, **given)
        key = repr((self._step, self.settings["bench"].get("solreffriction"), options))
        if key not in self._pilots:
            bench, start = self.bench(OPTIONAL), getattr(self, "_result", None)
            self._pilots[key] = Pilot(bench, self._model, self._train, *options, self.settings["engine"], start)
        return self._pilots[key]

    def _find_pilot(self) -> Pilot:
        """Return the pilot whose equations the fit uses: slopes at the first timestep, residuals at the chosen."""
        chosen = self._steps
        self._change(**self._coarse_steps)
        pilot = self._pilot(MOST_STEPS)
        self._change(**chosen)
        if chosen != self._coarse_steps:
            pilot = pilot.approaching(pilot.simulate(self.bench(OPTIONAL)), self._result)
        return pilot

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

    def _count(self, most_steps: float) -> tuple[int | None, str]:
        """Return the number of segments within `most_steps` simulation steps (None for all), and the reason."""
        length, step = self.settings["segments"]["length"], self._first_step
        steps = self._samples * self._interval / step
        if steps <= most_steps:
            return None, "all segments"
        share = max(most_steps / steps, _LEAST)
        count = max(1, int(share * self._samples / self._bench.nv / length))
        return count, f"{100 * share:.0f} % of all segments, evenly spaced: steps of {1e3 * step:.3g} ms are costly"

    def _samples_in(self, seconds: float) -> int:
        """Return a segment length in sample intervals, at most `seconds`, that fits the recordings and leaves many."""
        longest = self._samples // self._bench.nv // _MANY
        return min(max(FEWEST, min(round(seconds / self._interval), longest)), longest_window(self._train))

    def _velocity_beside_rounding(self) -> float:
        """Return the weight of velocities when only position errors beyond half an encoder step count."""
        if not self._is_open("loss.velocity"):
            return self.settings["loss"]["velocity"]
        share = float(np.square(soft_width(self._noise.step) / self._noise.position).mean())
        return float(f"{share * self._noise.velocity_weight:.3g}")

    def _validate(self, **given: Any) -> float:
        """Return the mean position error on a validation block of the training recordings; `given` as in `_pilot`."""
        key = repr((self.settings["bench"], self._how(_FIRST_STEPS, **given), sorted(self._left_out)))
        if key not in self._validated:  # an earlier stage may have asked
            tell("automatic settings: fit without the validation block, and its errors there")
            pilot = self._pilot(**given)
            is_fitted, block = hold_back(pilot.segments, self._train)
            result = pilot.fit(self._result, self._left_out, kept=is_fitted)
            horizon = min(self._horizon, longest_window(block))
            self._validated[key] = float(np.abs(pilot.errors(result, block, horizon * self._interval)).mean())
        return self._validated[key]

    def _change(self, **options: Any) -> dict[str, Any]:
        before = self.settings["bench"]
        self.settings["bench"] = {**before, **options}
        return before

    @property
    def _steps(self) -> dict[str, Any]:
        """Options of the bench that a shorter timestep changes."""
        section = self.settings["bench"]
        return {name: section[name] for name in ("timestep", "solreffriction") if name in section}

    @property
    def _step(self) -> float:
        step = self.settings["bench"].get("timestep")
        return self._plain.timestep if step in (None, AUTO) else step

    @property
    def _horizon(self) -> int:
        """Samples of an evaluation rollout."""
        return self._samples_in(float(self._given["evaluation"]["horizons"][0]))


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
