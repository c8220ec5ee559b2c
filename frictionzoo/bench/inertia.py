"""Parametrisations of link inertia: ten inertial parameters, pseudo-inertia and log-Cholesky coordinates.

A robot's inverse dynamics is linear in the ten parameters: mass m [kg], first moments m c [kg m], and the inertia about
the origin of the body frame, in its axes and in the order of MuJoCo's `fullinertia`: Ixx, Iyy, Izz, Ixy, Ixz, Iyz
[kg m^2]. The pseudo-inertia J contains second moments S instead of the inertia I:

    J = [[S, m c], [m c', m]],  S = trace(I) / 2 - I

J is positive definite if and only if the parameters are physically consistent: a body of positive mass can have them.

Source: P. Wensing, S. Kim, J.-J. Slotine, "Linear matrix inequalities for physically consistent inertial parameter
identification", 2018.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float, Inexact

from frictionzoo.bench.compiled import inertia_of, principal_axes, put_inertial
from frictionzoo.core.errors import BenchError

SYMBOLS = ("m", "mx", "my", "mz", "Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz")
"""Names of the ten parameters of a body."""
COORDINATES = ("mass", *("centre",) * 3, *("size",) * 6)
"""Property that each log-Cholesky coordinate of a body changes."""
THINNEST = 1e-3
"""Least spread of a body's mass along each axis [m]; for a point or a rod the logarithm would be infinite."""
_AXES = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])  # index of each entry of a symmetric matrix among its six numbers


def inertial_parameters(model: mujoco.MjModel, bodies: Sequence[int]) -> Float[np.ndarray, "bodies 10"]:
    """Return the ten parameters of bodies of a compiled model, given by index."""
    rows = [to_parameters(model.body_mass[body], model.body_ipos[body], inertia_of(model, body)) for body in bodies]
    return np.stack(rows)


def to_parameters(
    mass: float, centre: Float[np.ndarray, "3"], inertia: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "10"]:
    """Return a body's ten parameters from mass [kg], centre [m] and inertia about it in the body's axes [kg m^2]."""
    about_origin = inertia + mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return np.concatenate([[mass], mass * centre, _six(about_origin)])


def from_parameters(
    parameters: Float[np.ndarray, "10"],
) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Return mass [kg], centre [m], and inertia about the centre in the axes of the body frame [kg m^2]."""
    mass, centre = float(parameters[0]), parameters[1:4] / parameters[0]
    about_origin = parameters[4:][_AXES]
    return mass, centre, about_origin - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))


def put_parameters(model: mujoco.MjModel, body: int, parameters: Float[np.ndarray, "10"]) -> None:
    """Set the ten parameters of a body of a compiled model, given by index.

    Raises:
        BenchError: The parameters are not physically consistent.
    """
    if not is_consistent(parameters):
        raise BenchError(
            f"body {model.body(body).name}: no mass distribution has {np.array2string(parameters, precision=4)} as "
            "m, m c, I; expected a positive definite pseudo-inertia; fit it with log-Cholesky coordinates"
        )
    mass, centre, inertia = from_parameters(parameters)
    principal, quaternion = principal_axes(inertia)
    put_inertial(model, body, np.concatenate([[mass], centre, quaternion, principal]))


def to_pseudo_inertia(parameters: Float[np.ndarray, "*batch 10"]) -> Float[np.ndarray, "*batch 4 4"]:
    """Return the pseudo-inertia for the ten parameters of bodies."""
    inertia = parameters[..., 4:][..., _AXES]
    trace = np.trace(inertia, axis1=-2, axis2=-1)[..., None, None]
    second = trace / 2 * np.eye(3) - inertia
    first_moment, mass = parameters[..., 1:4], parameters[..., :1]
    upper = np.concatenate([second, first_moment[..., None]], axis=-1)
    return np.concatenate([upper, np.concatenate([first_moment, mass], axis=-1)[..., None, :]], axis=-2)


def from_pseudo_inertia(pseudo: Inexact[np.ndarray, "*batch 4 4"]) -> Inexact[np.ndarray, "*batch 10"]:
    """Return the ten parameters of bodies for their pseudo-inertias, real or complex."""
    second = pseudo[..., :3, :3]
    inertia = np.trace(second, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - second
    return np.concatenate([pseudo[..., 3, 3:], pseudo[..., :3, 3], _six(inertia)], axis=-1)


def is_consistent(parameters: Float[np.ndarray, "*batch 10"]) -> Any:
    """Return for each body whether its ten parameters are physically consistent."""
    return np.linalg.eigvalsh(to_pseudo_inertia(parameters))[..., 0] > 0


@dataclass(frozen=True)
class LogCholesky:
    """Log-Cholesky coordinates of bodies' inertia; every vector is physically consistent, zero is the nominal body.

    For one body with nominal `mass` m0 [kg], `centre` c0 [m] and second moments S0 = L0 L0' about the centre, with
    `factor` L0 [kg^(1/2) m]:

        m = m0 exp(x0),  c = c0 + (x1, x2, x3),  S = exp(x0) L0 A A' L0'
        A = [[exp(x4), x7, x8], [0, exp(x5), x9], [0, 0, exp(x6)]]

    with S about the new centre and L0 upper triangular. x1 to x3 are in metres. The pseudo-inertia is U U' with an
    upper triangular U with positive diagonal for every x, and every positive definite pseudo-inertia has coordinates.

    Source: C. Rucker, P. Wensing, "Smooth parameterization of rigid-body inertia", 2022, here relative to the nominal
    body instead of a body of unit mass.
    """

    mass: Float[np.ndarray, "bodies"]
    centre: Float[np.ndarray, "bodies 3"]
    factor: Float[np.ndarray, "bodies 3 3"]

    @classmethod
    def around(cls, parameters: Float[np.ndarray, "bodies 10"], names: Sequence[str]) -> "LogCholesky":
        """Return the coordinates relative to nominal bodies, with at least the thickness `THINNEST`.

        Raises:
            BenchError: A body has no mass, or its inertia is not physical.
        """
        parts = [_reference(nominal, name) for nominal, name in zip(parameters, names, strict=True)]
        mass, centre, factor = (np.array(part) for part in zip(*parts, strict=True))
        return cls(mass, centre, factor)

    def parameters(self, coordinates: Inexact[np.ndarray, "bodies 10"]) -> Inexact[np.ndarray, "bodies 10"]:
        """Return the ten parameters of each body from its coordinates, real or complex."""
        x = np.moveaxis(coordinates, -1, 0)
        ratio, (s12, s13, s23), zero = np.exp(x[0]), x[7:], 0 * x[0]
        d1, d2, d3 = np.exp(x[4:7])
        stretch = np.stack([d1, s12, s13, zero, d2, s23, zero, zero, d3], axis=-1).reshape(-1, 3, 3)
        spread = self.factor @ stretch
        mass, centre = self.mass * ratio, self.centre + x[1:4].T
        first_moment = mass[:, None] * centre
        about_origin = ratio[:, None, None] * spread @ spread.swapaxes(-1, -2)
        about_origin = about_origin + first_moment[:, :, None] * centre[:, None, :]
        upper = np.concatenate([about_origin, first_moment[..., None]], axis=-1)
        lower = np.concatenate([first_moment, mass[:, None]], axis=-1)[..., None, :]
        return from_pseudo_inertia(np.concatenate([upper, lower], axis=-2))

    def slopes(self, coordinates: Float[np.ndarray, "bodies 10"]) -> Float[np.ndarray, "bodies 10 10"]:
        """Return the derivative of each body's ten parameters, in rows, with respect to its coordinates, in columns."""
        # A complex step has no cancellation, and the derivative is exact to rounding.
        steps = 1e-30j * np.eye(10)
        columns = [self.parameters(coordinates + step).imag / 1e-30 for step in steps]
        return np.stack(columns, axis=-1)

    def coordinates(self, parameters: Float[np.ndarray, "bodies 10"]) -> Float[np.ndarray, "bodies 10"]:
        """Return the coordinates of bodies from their ten parameters, which must be physically consistent."""
        rows = []
        for body, mass0, centre0, factor0 in zip(parameters, self.mass, self.centre, self.factor, strict=True):
            mass, centre, _ = from_parameters(body)
            second = to_pseudo_inertia(body)[:3, :3] - mass * np.outer(centre, centre)
            stretch = np.linalg.solve(factor0, _upper_cholesky(second * mass0 / mass))
            sizes = np.concatenate([np.log(np.diag(stretch)), stretch[np.triu_indices(3, 1)]])
            rows.append(np.concatenate([[np.log(mass / mass0)], centre - centre0, sizes]))
        return np.array(rows)


def _reference(
    parameters: Float[np.ndarray, "10"], name: str
) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    if not parameters[0] > 0:
        raise BenchError(f"body {name}: a mass of {parameters[0]:g} kg, expected more than 0; leave it out of the fit")
    mass, centre, inertia = from_parameters(parameters)
    moments, axes = np.linalg.eigh(np.trace(inertia) / 2 * np.eye(3) - inertia)
    if moments[0] < -1e-6 * max(moments[-1], mass * THINNEST**2):
        raise BenchError(
            f"body {name}: principal inertias {np.array2string(np.linalg.eigvalsh(inertia), precision=3)} kg m^2, "
            "one exceeds the sum of the others; expected a physical inertia; correct its inertial"
        )
    moments = np.maximum(moments, mass * THINNEST**2)
    return mass, centre, _upper_cholesky((axes * moments) @ axes.T)


def _upper_cholesky(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Return the upper triangular U with U U' = matrix."""
    return np.linalg.cholesky(matrix[::-1, ::-1])[::-1, ::-1]


def _six(inertia: Any) -> Any:
    """Return Ixx, Iyy, Izz, Ixy, Ixz, Iyz of symmetric matrices, of shape (..., 6)."""
    return np.stack([inertia[..., i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))], axis=-1)
