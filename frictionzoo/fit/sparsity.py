"""Sparse derivatives of robots with branches: coordinates of different legs share one tangent.

A coordinate of one leg does not move the other legs, so a quadruped needs as many tangents as one leg.

Source: A. Curtis, M. Powell, J. Reid, "On the Estimation of Sparse Jacobian Matrices", 1974.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from frictionzoo.fit.space import Space


class Sparsity(NamedTuple):
    """Branches of a robot and the tangents that they share; a robot without branches counts as one branch.

    Attributes:
        joints: Index of each joint of a branch; shorter branches repeat a joint, and `mine` is 0 there.
        mine: 1; 0 where `joints` only fills the row.
        seeds: Tangents that cover all coordinates; each moves at most one coordinate of a branch.
        place: Coordinate that a tangent moves in a branch; the number of coordinates if it moves none.
        states: Tangents of the initial states, positions first, for all branches at once.
    """

    joints: Int[np.ndarray, "branches joints"]
    mine: Float[np.ndarray, "branches joints"]
    seeds: Float[np.ndarray, "tangents coordinates"]
    place: Int[np.ndarray, "branches tangents"]
    states: Float[np.ndarray, "state twice_nv"]

    @classmethod
    def of(cls, space: Space, branches: Sequence[int]) -> "Sparsity":
        """Return the sparsity of these coordinates, given the branch number of each joint."""
        count, numbers = max(branches) + 1, np.asarray(branches)
        members = [np.flatnonzero(numbers == number) for number in range(count)]
        size = max(map(len, members))
        joints = np.array([np.resize(member, size) for member in members])
        mine = np.array([np.arange(size) < len(member) for member in members], float)
        acts = _list_branches(space, numbers)
        colors = _color(acts)
        seeds = np.zeros((max(colors, default=-1) + 1, len(acts)))
        place = np.full((count, len(seeds)), len(acts))
        for coordinate, (color, acted) in enumerate(zip(colors, acts, strict=True)):
            seeds[color, coordinate] = 1.0
            place[sorted(acted), color] = coordinate
        halves = np.zeros((size, len(numbers)))
        for row, used in zip(joints, mine, strict=True):
            halves[np.arange(size)[used > 0], row[used > 0]] = 1.0
        return cls(joints, mine, seeds, place, np.kron(np.eye(2), halves))

    @property
    def nv(self) -> int:
        """Number of joints."""
        return self.states.shape[1] // 2

    def by_branch(self, errors: Float[Array, "segments time nv kinds"]) -> Float[Array, "branches segments terms"]:
        """Return the errors of each branch's joints; 0 where a row is only filled."""
        if len(self.joints) == 1:
            return errors.reshape(1, len(errors), -1)
        rows = jnp.moveaxis(errors[:, :, self.joints] * jnp.asarray(self.mine, errors.dtype)[..., None], 2, 0)
        return rows.reshape(*rows.shape[:2], -1)

    def states_by_branch(self, state: Float[Array, "segments twice_nv"]) -> Float[Array, "branches segments state"]:
        """Return position and velocity of each branch; 0 where a row is only filled."""
        halves = jnp.split(state, 2, axis=1)
        parts = [jnp.swapaxes(half[:, self.joints] * jnp.asarray(self.mine, state.dtype), 0, 1) for half in halves]
        return jnp.concatenate(parts, axis=2)

    def states_together(self, own: Float[Array, "branches segments state"]) -> Float[Array, "segments twice_nv"]:
        """Return states by branch in the order of the joints."""
        halves = [jnp.swapaxes(half, 0, 1) * jnp.asarray(self.mine, own.dtype) for half in jnp.split(own, 2, axis=2)]
        empty = jnp.zeros((own.shape[1], self.nv), own.dtype)
        return jnp.concatenate([empty.at[:, self.joints].add(half) for half in halves], axis=1)

    def gradient(self, own: Float[Array, "branches segments tangents"]) -> Float[Array, "segments coordinates"]:
        """Convert the gradient from tangents by branch to all coordinates, one row per segment."""
        count = self.seeds.shape[1]
        total = jnp.zeros((own.shape[1], count + 1), own.dtype)
        return total.at[:, self.place].add(jnp.swapaxes(own, 0, 1))[:, :count]

    def hessian(self, own: Float[Array, "branches tangents tangents"]) -> Float[Array, "coordinates coordinates"]:
        """Convert the Hessian from tangents by branch to all coordinates."""
        count = self.seeds.shape[1]
        total = jnp.zeros((count + 1, count + 1), own.dtype)
        return total.at[self.place[:, :, None], self.place[:, None, :]].add(own)[:count, :count]


def _list_branches(space: Space, own: Int[np.ndarray, "nv"]) -> list[set[int]]:
    acts = [
        set(own[place.joints[place.group == number]].tolist())
        for place in space.places.values()
        for number in range(len(place.first))
    ]
    everywhere = set(own.tolist())
    return acts + [everywhere] * (len(space.start) - len(acts))


def _color(acts: Sequence[set[int]]) -> list[int]:
    """Return the tangent number of each coordinate; coordinates that act on the same branch get different ones."""
    colors, covered = [0] * len(acts), []
    for coordinate in sorted(range(len(acts)), key=lambda index: -len(acts[index])):
        color = next((number for number, used in enumerate(covered) if not used & acts[coordinate]), len(covered))
        if color == len(covered):
            covered.append(set())
        covered[color] |= acts[coordinate]
        colors[coordinate] = color
    return colors
