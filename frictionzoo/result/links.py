"""Estimated link inertias for `result.json`."""

import numpy as np
from jaxtyping import Float

from frictionzoo.bench.inertia import SYMBOLS, from_parameters, to_parameters
from frictionzoo.fit.link_inertia import LinkInertia
from frictionzoo.fit.tilt import Tilt
from frictionzoo.result import torque_types as types


def describe_links(found: LinkInertia) -> types.LinksRow:
    """Return the section `links`: estimated and model file inertias, and the combinations that the data determine."""
    rows = zip(found.base.describe(), found.values, found.errors, found.determined, strict=True)
    return {
        "links": [
            {
                "body": body,
                "found": _describe_inertia(new),
                "maker": _describe_inertia(old),
                "prior_only": [symbol for symbol in SYMBOLS if f"{symbol} {body}" in found.prior_only],
            }
            for body, old, new in zip(found.bodies, found.maker, found.found, strict=True)
        ],
        "gravity": None if found.tilt is None else _describe_gravity(found.tilt),
        "determined": int(found.determined.sum()),
        "base": [
            {"combination": text, "value": float(value), "error": float(error), "determined": bool(determined)}
            for text, value, error, determined in rows
        ],
    }


def _describe_gravity(tilt: Tilt) -> types.GravityRow:
    gravity, maker = tilt.gravity.tolist(), tilt.maker.tolist()
    return {"found": gravity, "maker": maker, "angle": tilt.angle, "error": float(tilt.errors.max())}


def _describe_inertia(parameters: Float[np.ndarray, "10"]) -> types.InertiaRow:
    mass, centre, inertia = from_parameters(parameters)
    about_centre = to_parameters(mass, np.zeros(3), inertia)[4:]
    return {"mass": mass, "centre": centre.tolist(), "inertia": about_centre.tolist()}
