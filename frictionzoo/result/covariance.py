"""Covariance of the parameters for `result.json`."""

from frictionzoo.bench.base import Bench
from frictionzoo.fit.uncertainty import Covariance
from frictionzoo.models.base import FrictionModel
from frictionzoo.result.types import CovarianceRow


def describe_covariance(covariance: Covariance | None, bench: Bench, model: FrictionModel) -> CovarianceRow | None:
    """Return the section `covariance`; None if no parameter has an interval."""
    if covariance is None:
        return None
    params = {"bench": bench.params, "friction": model.params}
    names = [label.partition("/")[0].split(".", 1) for label in covariance.labels]
    return {
        "labels": list(covariance.labels),
        "scale": [params[owner][name].scale for owner, name in names],  # pyright: ignore[reportReturnType]
        "centre": covariance.centre.tolist(),
        "matrix": covariance.matrix.tolist(),
        "freedom": covariance.freedom,
    }
