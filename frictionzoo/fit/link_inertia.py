"""Inertia of links, identified together with the drives' parameters, and which part of it the data determine."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from frictionzoo.bench.base_parameters import BaseParameters, find_base_parameters
from frictionzoo.bench.inertia import COORDINATES, SYMBOLS, from_parameters
from frictionzoo.core.errors import ConfigError, closest
from frictionzoo.fit.tilt import Tilt, Tilted
from frictionzoo.fit.torque_balance import BalanceSolution, FreeLinks, append_links, balance, invert
from frictionzoo.fit.torque_equation import TorqueEquation

DETERMINED = 1 / 3
"""The data determine a combination if its standard error is below this share of the prior's standard deviation."""


@dataclass(frozen=True)
class LinkInertia:
    """Identified inertia of links, and how well the data determine it.

    Torque recordings determine base parameters: combinations of link parameters, armatures and everything else that
    acts on torque. A link parameter outside all determined combinations has its value from the prior only.

    Attributes:
        bodies: Names of the links.
        maker: Ten inertial parameters of each link in the model file, of shape (bodies, 10).
        found: Identified parameters, of the same shape, physically consistent.
        base: The base parameters.
        values: Values of the base parameters, of shape (base,).
        errors: Standard error of each, from the data alone.
        spreads: Standard deviation of the prior of each; infinite where it contains a parameter without prior.
        rms: Root mean square of each joint's residual torque [N m or N].
        tilt: Identified tilt of gravity; None where it was not identified.
    """

    bodies: tuple[str, ...]
    maker: Float[np.ndarray, "bodies 10"]
    found: Float[np.ndarray, "bodies 10"]
    base: BaseParameters
    values: Float[np.ndarray, "base"]
    errors: Float[np.ndarray, "base"]
    spreads: Float[np.ndarray, "base"]
    rms: Float[np.ndarray, "nv"]
    tilt: Tilt | None = None

    @property
    def determined(self) -> Bool[np.ndarray, "base"]:
        """Whether the data, not the prior, determine each base parameter."""
        return self.errors < DETERMINED * np.where(np.isinf(self.spreads), np.abs(self.values), self.spreads)

    @property
    def inertia(self) -> dict[str, list[float]]:
        """Ten inertial parameters of each link, in the form of `bench.inertia`."""
        return {name: parameters.tolist() for name, parameters in zip(self.bodies, self.found, strict=True)}

    @property
    def prior_only(self) -> tuple[str, ...]:
        """Link parameters that belong to no base parameter determined by the data."""
        used = (self.base.matrix[self.determined] != 0).any(axis=0)
        names = [f"{symbol} {body}" for body in self.bodies for symbol in SYMBOLS]
        return tuple(name for name, is_used in zip(self.base.names, used, strict=True) if name in names and not is_used)

    def lines(self) -> Iterator[str]:
        """Yield a line for each link, and lines on tilt and on parameters determined only by the prior."""
        for name, old, new in zip(self.bodies, self.maker, self.found, strict=True):
            (old_mass, old_centre, _), (mass, centre, _) = from_parameters(old), from_parameters(new)
            moved = 1e3 * float(np.linalg.norm(centre - old_centre))
            yield f"link {name}: {mass:.4g} kg, the model file's {old_mass:.4g}; centre moved by {moved:.3g} mm"
        if self.tilt is not None:
            yield f"gravity is {self.tilt.say()}: the base is tilted"
        mask = self.determined
        yield f"{mask.sum()} of {len(mask)} combinations of parameters are determined by the data, not by the prior"
        if self.prior_only:
            yield f"only the prior: {', '.join(self.prior_only)}"


def choose_bodies(model: mujoco.MjModel, patterns: Sequence[str]) -> list[int]:
    """Return the indices of the bodies that a joint moves and whose whole name matches one of the patterns.

    Raises:
        ConfigError: A pattern is not a regular expression, or matches no such body.
    """
    moving = [body for body in range(1, model.nbody) if model.body_weldid[body] and model.body_mass[body] > 0]
    names = {body: model.body(body).name for body in moving if model.body(body).name}
    chosen = set[int]()
    for pattern in patterns:
        try:
            expression = re.compile(pattern)
        except re.error as error:
            raise ConfigError(f"fit.links: {pattern}: no pattern ({error}); expected a regular expression") from None
        matches = [body for body, name in names.items() if expression.fullmatch(name)]
        if not matches:
            raise ConfigError(f"fit.links: {pattern}: no body of that name moves; {closest(pattern, names.values())}")
        chosen |= set(matches)
    return sorted(chosen)


def spread_of(prior: Mapping[str, float]) -> Float[np.ndarray, "10"]:
    """Return the prior's standard deviation of each log-Cholesky coordinate (`mass`, `size`: shares; `centre`: m).

    Raises:
        ConfigError: One is missing, unknown or not above 0.
    """
    for name in sorted(prior.keys() ^ set(COORDINATES)):
        raise ConfigError(f"fit.prior.{name}: expected mass, centre and size, a number above 0 of each")
    for name, value in prior.items():
        if not 0 < value < np.inf:
            raise ConfigError(f"fit.prior.{name}={value}; expected a number above 0")
    return np.array([float(prior[name]) for name in COORDINATES])


def identify_links(
    equation: TorqueEquation, model: mujoco.MjModel, patterns: Sequence[str], prior: Mapping[str, float]
) -> LinkInertia:
    """Identify the inertia of links together with an equation's coordinates, whose values are not kept.

    `patterns` are regular expressions for names of links; `prior` is as in `spread_of`.

    Raises:
        ConfigError: A pattern matches no body that moves, or the prior is invalid.
        BenchError: The inertia of a body in the model file is not physically consistent.
    """
    bodies = choose_bodies(model, patterns)
    names = tuple(model.body(body).name for body in bodies)
    links = FreeLinks.of(equation, bodies, spread_of(prior)) if bodies else None
    balanced = balance(equation, links)
    base, scale = _base(equation, balanced, links, names)
    values = np.concatenate([equation.physical(balanced.vector), balanced.bodies.ravel()])
    information = balanced.information / np.outer(scale, scale)
    errors = np.sqrt(np.diag(invert(information[np.ix_(base.leading, base.leading)])))
    rms = np.sqrt(np.mean(np.square(balanced.residual), axis=0))
    spreads = _spreads(base, links, len(balanced.vector))
    tilt = equation.tilt(balanced) if isinstance(equation, Tilted) else None
    maker = np.zeros((0, 10)) if links is None else links.maker
    return LinkInertia(names, maker, balanced.bodies, base, base.matrix @ values, errors, spreads, rms, tilt)


def _base(
    equation: TorqueEquation, found: BalanceSolution, links: FreeLinks | None, names: Sequence[str]
) -> tuple[BaseParameters, Float[np.ndarray, "all"]]:
    """Return the base parameters of the recordings, and the derivative of physical values by coordinates."""
    columns = append_links(equation.slope(found.vector), links)
    step = 1e-6 * np.ones(len(found.vector))
    moved = (equation.physical(found.vector + step) - equation.physical(found.vector - step)) / (2 * step)
    scale = np.concatenate([np.where(moved != 0, moved, 1.0), np.ones(found.bodies.size)])
    rows = ((columns / scale) / found.sigma[:, None])[equation.moving]
    labels = [*equation.labels, *(f"{symbol} {name}" for name in names for symbol in SYMBOLS)]
    return find_base_parameters(rows, labels), scale


def _spreads(base: BaseParameters, links: FreeLinks | None, size: int) -> Float[np.ndarray, "base"]:
    if links is None:
        return np.full(len(base.matrix), np.inf)
    scaled: Any = links.around.slopes(np.zeros_like(links.spread)) * links.spread[:, None, :]
    link_columns = base.matrix[:, size:].reshape(len(base.matrix), -1, 10)
    variance = np.square(np.einsum("abk,bkl->abl", link_columns, scaled)).sum(axis=(1, 2))
    return np.where((base.matrix[:, :size] != 0).any(axis=1), np.inf, np.sqrt(variance))
