"""Friction curves: friction of the model and of the recordings, over velocity and other inputs of the model."""

import copy
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from frictionzoo.core.state import DriveState
from frictionzoo.fit.uncertainty import LEVEL
from frictionzoo.models.base import FrictionModel, sliding_torque
from frictionzoo.models.sees import observe

SAMPLES = 20_000  # most rows used, evenly spread
POINTS = 61  # points of a curve; odd, to include standstill
BINS = 24  # groups of rows
NEIGHBOURS = 100  # closest rows that represent a point
FEWEST = 10  # fewest rows of a bin or a joint
SPREAD = 0.1, 0.9  # quantiles of the rows of a bin, or of a velocity
DRAWS = 100  # most drives of an interval
_SAMPLED = 81  # velocities of a curve without recordings; odd, to include 0
AROUND = 200  # recorded states of the closest velocity that represent a velocity

_REPLACED = {"velocity": "qvel", "position": "qpos", "temperature": "temperature"}
Torque = Float[np.ndarray, "rows nv"]


class Portrait(NamedTuple):
    """Friction curve of each joint over one quantity; except over velocity, friction is positive against the motion.

    Attributes:
        at: Points of the curve [unit of the quantity]; NaN: the joint has too few rows.
        law: Model torque at these points, median over the closest rows [N m or N].
        low: Lower end of its 95 % interval [N m or N]; NaN: no parameter has an interval.
        high: Upper end [N m or N].
        where: Median of the quantity in each bin of rows; NaN: the bin has too few rows.
        implied: Median of the friction implied by the recorded torque in the bin [N m or N].
        lower: 10 % quantile of that friction.
        upper: 90 % quantile.
    """

    at: Float[np.ndarray, "points nv"]
    law: Float[np.ndarray, "points nv"]
    low: Float[np.ndarray, "points nv"]
    high: Float[np.ndarray, "points nv"]
    where: Float[np.ndarray, "bins nv"]
    implied: Float[np.ndarray, "bins nv"]
    lower: Float[np.ndarray, "bins nv"]
    upper: Float[np.ndarray, "bins nv"]


class Rows(NamedTuple):
    """Recorded inputs of a model for friction curves, rows that count, and the implied friction [N m or N] if known."""

    state: DriveState
    counts: Bool[np.ndarray, "rows nv"]
    implied: Torque | None = None


def portray(
    model: FrictionModel, draws: Mapping[str, Float[np.ndarray, "count nv"]], rows: Rows
) -> dict[str, Portrait]:
    """Compute friction curves over velocity, and over load, position and temperature if the model depends on them.

    The 95 % interval contains parameter uncertainty only: the 2.5 and 97.5 % quantiles over `draws` by full name, if
    any. A model with memory has its steady torque at constant velocity. The implied friction is the model torque plus
    the residual torque at the same instants: it lies on the curve where the residual is noise, and off it where the
    model does not fit.

    Source: W. A. Larsen, S. J. McCleary, "The use of partial residual plots in regression analysis", 1972.

    Returns:
        Curves by the quantity on the axis.
    """
    part = slice(None, None, max(1, len(rows.counts) // SAMPLES))
    state = rows.state.map(lambda signal: np.asarray(signal[part], np.float64))
    rows = Rows(state, rows.counts[part], None if rows.implied is None else rows.implied[part])
    law = copy.deepcopy(model).double()
    sees = {quantity for joint in range(model.nv) for quantity in law.of_joint(joint)[0].sees} or observe(law, state)
    named = [(name.partition("."), values) for name, values in draws.items()]
    parameters = {name: values for (owner, _, name), values in named if owner == "friction"}
    load = np.abs(state.motor_torque - state.external_torque)
    signals = {"velocity": state.qvel, "load": load, "position": state.qpos, "temperature": state.temperature}
    return {
        name: _portray(law, parameters, rows, name, signal)
        for name, signal in signals.items()
        if signal is not None and (name == "velocity" or name in sees)
    }


def _portray(
    law: FrictionModel, draws: Mapping[str, np.ndarray], rows: Rows, name: str, signal: Float[np.ndarray, "rows nv"]
) -> Portrait:
    nv, along = signal.shape[1], name == "velocity"
    points, nearest = np.full((POINTS, nv), np.nan), np.zeros((POINTS, NEIGHBOURS, nv), int)
    bins = np.full((4, BINS, nv), np.nan)
    for joint in range(nv):
        counted = np.flatnonzero(rows.counts[:, joint])
        if len(counted) < FEWEST:
            continue
        quantity = signal[counted, joint]
        points[:, joint] = _spread_out(quantity, POINTS, along)
        nearest[:, :, joint] = counted[_find_nearest(quantity, points[:, joint])]
        if rows.implied is not None:
            side = 1.0 if along else np.sign(rows.state.qvel[counted, joint])
            bins[:, :, joint] = _sort_into_bins(quantity, side * rows.implied[counted, joint], along)
    states = rows.state.map(lambda column: torch.from_numpy(np.take_along_axis(column[:, None], nearest, axis=0)))
    if name in _REPLACED:
        # The closest rows represent a point in everything but the quantity itself.
        grid = torch.from_numpy(np.broadcast_to(points[:, None], nearest.shape).copy())
        states = states._replace(**{_REPLACED[name]: grid})
    sides = 1.0 if along else torch.sign(states.qvel)
    curve, ends = _draw_law(law, {}, states, sides), np.full((2, *points.shape), np.nan)
    if draws:
        count = min(DRAWS, *map(len, draws.values()))
        drawn = [_draw_law(law, {n: v[i] for n, v in draws.items()}, states, sides) for i in range(count)]
        ends = np.quantile(drawn, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    curve, ends = np.where(np.isnan(points), np.nan, curve), np.where(np.isnan(points), np.nan, ends)
    return Portrait(points, curve, *ends, *bins)


def _spread_out(signal: Float[np.ndarray, "counted"], count: int, along: bool) -> Float[np.ndarray, "count"]:
    """Return points over the signal's range; over velocity, dense around standstill, where models differ most."""
    if not along:
        return np.linspace(signal.min(), signal.max(), count)
    share = np.linspace(-1, 1, count)
    return np.where(share < 0, abs(min(signal.min(), 0.0)), max(signal.max(), 0.0)) * np.sign(share) * share**2


def _find_nearest(signal: Float[np.ndarray, "counted"], at: Float[np.ndarray, "points"]) -> Int[np.ndarray, "points n"]:
    order = np.argsort(signal)
    start = np.clip(np.searchsorted(signal[order], at) - NEIGHBOURS // 2, 0, max(0, len(signal) - NEIGHBOURS))
    return order[np.minimum(start[:, None] + np.arange(NEIGHBOURS), len(signal) - 1)]


def _sort_into_bins(
    signal: Float[np.ndarray, "counted"], torque: Float[np.ndarray, "counted"], along: bool
) -> Float[np.ndarray, "4 bins"]:
    """Return each bin's median of the signal, and median and both quantiles of the torque."""
    place = np.clip(np.searchsorted(_spread_out(signal, BINS + 1, along), signal, "right") - 1, 0, BINS - 1)
    bins = np.full((4, BINS), np.nan)
    for number in np.flatnonzero(np.bincount(place, minlength=BINS) >= FEWEST):
        inside = place == number
        bins[:, number] = np.median(signal[inside]), *np.quantile(torque[inside], (0.5, *SPREAD))
    return bins


def _draw_law(
    law: FrictionModel, values: Mapping[str, np.ndarray], states: DriveState, sides: torch.Tensor | float
) -> Float[np.ndarray, "points nv"]:
    """Return the median model torque over the rows of each point, with these values of some parameters."""
    changed = {name: torch.tensor(value[law.params[name].members(law.nv)]) for name, value in values.items()}
    with torch.no_grad():
        terms = torch.func.functional_call(law, changed, (states,))
        return torch.quantile(sides * sliding_torque(torch, terms, states.qvel), 0.5, dim=1).numpy()


def sample_friction(
    model: FrictionModel, samples: DriveState
) -> tuple[
    Float[np.ndarray, "points"],
    Float[np.ndarray, "points nv"],
    Float[np.ndarray, "points nv"],
    Float[np.ndarray, "points nv"],
]:
    """Compute velocities, dense around 0, and a model's friction there: median, low and high quantile.

    The quantiles are over states recorded near each velocity. A model that depends on the velocity alone has no spread.
    Dry friction of MuJoCo has its sliding value.
    """
    thinned = samples.map(lambda signal: signal[:: max(1, len(signal) // SAMPLES)])
    fastest = float(np.abs(thinned.qvel).max()) or 1.0
    velocity = _spread_out(np.array([-fastest, fastest]), _SAMPLED, along=True)
    curves = np.stack([_torque_near(model, thinned, point) for point in velocity])
    return velocity, curves[:, 0], curves[:, 1], curves[:, 2]


def _torque_near(model: FrictionModel, samples: DriveState, velocity: float) -> Float[np.ndarray, "3 nv"]:
    distance = np.abs(samples.qvel - velocity).max(axis=1)
    nearest = np.argpartition(distance, min(AROUND, len(distance)) - 1)[:AROUND]
    states = samples.map(lambda signal: torch.from_numpy(np.asarray(signal[nearest], np.float64)))
    states = states._replace(qvel=torch.full_like(states.qvel, velocity))
    with torch.no_grad():
        torque = sliding_torque(torch, model(states), states.qvel)
    return np.stack([torch.quantile(torque, share, dim=0).numpy() for share in (0.5, *SPREAD)])
