"""Identification from measured torque without simulation: the inverse dynamics identification model (IDIM)."""

import logging
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from frictionzoo.core.errors import ConfigError
from frictionzoo.fit.base import Evaluation, Fit, refuse_nothing, refuse_torch, register_method
from frictionzoo.fit.blocks import Blocks
from frictionzoo.fit.link_inertia import LinkInertia, identify_links, spread_of
from frictionzoo.fit.lm import refuse_many
from frictionzoo.fit.motion import BANDWIDTH, Filtering, Recordings
from frictionzoo.fit.normal_equations import Scores
from frictionzoo.fit.objective import Objective
from frictionzoo.fit.space import Space
from frictionzoo.fit.tilt import Tilt, Tilted
from frictionzoo.fit.torque_balance import balance
from frictionzoo.fit.torque_equation import TorqueEquation

_log = logging.getLogger(__name__)
_PASSES, _LEVEL = 10, 1e-5  # rounds of links and gravity, and change of the leaning below which they have converged
_REMEDY = "fit=inverse_dynamics", "use fit=adam, which begins at the initial values"
PRIOR: Mapping[str, float] = {"mass": 0.1, "centre": 0.02, "size": 0.3}


@register_method("inverse_dynamics")
class InverseDynamics(Fit):
    """Weighted least squares between the drive torque and the torque that links, armature and friction need.

    This is the standard method for industrial robots. It needs recordings of torque (or of commands that the actuator
    model turns into torque) along motions that excite all joints. Velocities and accelerations come from the positions
    alone. Both sides of the equation pass the same low-pass filter and are decimated. Joints are weighted by the
    inverse deviation of their residual torque. The reported loss is the geometric mean of the residual variances of the
    joints [N^2 m^2 or N^2].

    It simulates no rollout. It therefore works on torque-driven arms, whose long rollouts diverge, and gives other fits
    a starting point. Limits: samples near standstill do not count, because the direction of friction is unknown there,
    and a model with memory contributes its friction at constant velocity.

    Source: M. Gautier, "Dynamic identification of robots with power model", 1997; J. Hollerbach, W. Khalil, M. Gautier,
    "Model identification", in: Springer Handbook of Robotics, 2016.

    Args:
        bandwidth: Frequency up to which torques are compared [Hz].
        cutoff: Cut-off of the low-pass filter of the positions [Hz]; None for five times the bandwidth, or less if the
            sample rate requires it.
        order: Order of that filter, which runs forwards and backwards.
        slow: Share of a joint's root mean square speed below which a sample does not count.
        held: Whether a recorded command acts until the next sample, as in a simulation; if not, only at its instant,
            like a measured torque or current.
        links: Bodies whose inertia is identified, by name or by regular expressions that match whole names. The fit
            identifies them first, together with all other parameters, and then replaces the model file's inertia.
        tilt: Whether to identify the direction of gravity in the frame of the base in that step too. A base tilted by
            one degree puts a torque on a vertical joint that the model file does not predict.
        prior: Standard deviations of the prior, centred on the model file's inertia: `mass` and `size` (spread about
            the centre) as shares, `centre` in m.

    Raises:
        ConfigError: An argument is out of range.
    """

    traced = False

    def __init__(
        self,
        bandwidth: float = BANDWIDTH,
        cutoff: float | None = None,
        order: int = 4,
        slow: float = 0.025,
        held: bool = True,
        links: str | Sequence[str] = (),
        prior: Mapping[str, float] = PRIOR,
        tilt: bool = False,
    ) -> None:
        self.filtering = Filtering(bandwidth, cutoff, order, slow)
        self.held = held
        self._links = [links] if isinstance(links, str) else list(links)
        spread_of(prior)  # raises ConfigError for an invalid prior
        self._prior, self._tilt = dict(prior), tilt

    def revise(self, recordings: Recordings) -> LinkInertia | None:
        """See `Fit.revise`; identifies link inertia and gravity if asked to."""
        if not self._links and not self._tilt:
            return None
        space = Space(recordings.bench, recordings.model, jnp.result_type(float))
        refuse_many(space, *_REMEDY)
        bench = weighed = recordings.bench
        tilt = Tilt.upright(bench.compile(constraint=False).opt.gravity.copy()) if self._tilt else None
        for _ in range(_PASSES):  # links and gravity in turn, because the links' weight depends on both
            leaning = bench.with_gravity(tilt.gravity.tolist()) if tilt else bench
            how = space, recordings._replace(bench=leaning), self.filtering, self.held
            equation = Tilted(*how, tilt, weighed) if tilt else TorqueEquation(*how)
            result = identify_links(equation, leaning.compile(constraint=False), self._links, self._prior)
            if tilt is None or result.tilt is None or (np.abs(result.tilt.leaning - tilt.leaning) < _LEVEL).all():
                break
            tilt, weighed = result.tilt, bench.with_inertia(result.inertia)
        return result

    def total(self, objective: Objective) -> int:
        """See `Fit.total`; refuses networks, models only in torch, and segments without recordings."""
        refuse_nothing(objective)
        refuse_torch(objective, self.name)
        if objective.recordings is None:
            raise ConfigError(
                "fit=inverse_dynamics: another drive's rollouts to follow, expected recordings; use fit=lm"
            )
        refuse_many(objective.space, *_REMEDY)
        return 2

    def equation(self, objective: Objective) -> TorqueEquation:
        """Return the residual torque as a function of the objective's coordinates."""
        recordings = objective.recordings
        assert recordings is not None
        return objective.remember(
            (self.filtering, self.held),
            lambda: TorqueEquation(objective.space, recordings, self.filtering, self.held),
        )

    def init(self, objective: Objective) -> tuple[Any, Any]:
        """See `Fit.init`."""
        return objective.space.start, np.asarray(0)

    def step(self, objective: Objective, vector: Any, state: Any, data: Blocks) -> tuple[Evaluation, Any, Any]:
        """See `Fit.step`; the first iteration finds the minimum, the second evaluates it."""
        equation = self.equation(objective)
        equations, _ = equation.scores(np.asarray(vector, np.float64))
        evaluation = Evaluation(equations.loss, 2 * equations.gradient, not np.isfinite(equations.loss))
        if state == 0 and not evaluation.lost:
            vector = balance(equation).vector
            for (one, other), share in equation.couplings(vector).items():
                _log.warning(
                    "%s and %s: the other joint's motion explains %.0f %% of the residual torque, as with a gear that "
                    "couples joints, which a bench lacks: do not interpret the values of these two joints",
                    *(equation.joints[joint] for joint in (one, other)),
                    100 * share,
                )
        return evaluation, vector, state + 1

    def done(self, state: Any) -> Any:
        """See `Fit.done`."""
        return state > 1

    def prepare(self, objective: Objective) -> None:
        """See `Fit.prepare`."""
        self.equation(objective)

    def compile_scores(self, objective: Objective) -> Scores:
        """See `Fit.compile_scores`; uses the residual torque."""
        return self.equation(objective).scores
