"""What `result.json` holds of how sure parameters are together."""

from typing import Annotated, Literal, TypedDict

from frictionzoo.bench.base import Bench
from frictionzoo.fit.covariance import Covariance
from frictionzoo.models.base import FrictionModel
from frictionzoo.result.kinds import Positive, Text


class CovarianceRow(TypedDict):
    """How sure parameters are together: a multivariate Student's t distribution of all that have an interval.

    It is one of the optimiser's coordinates, logarithms or values over a scale; its marginals are the intervals.
    """

    labels: Annotated[list[Text], ("minItems", 1)]
    """Their full names OWNER.NAME, of several joints OWNER.NAME/JOINT with the name of the joint, or of the joints that
    share the value."""
    scale: list[Literal["log"] | float]
    """What makes a coordinate of a value: `log`, or the number that it is divided by."""
    centre: list[float]
    """Middle of each interval; the identified value, unless the fit ended away from its minimum."""
    matrix: list[list[float]]
    """Its shape: half an interval is the 97.5 % quantile of Student's t times the root of the diagonal."""
    freedom: Positive
    """Degrees of freedom of the t distribution."""


def describe_covariance(covariance: Covariance | None, bench: Bench, model: FrictionModel) -> CovarianceRow | None:
    """The section `covariance`; None where no parameter has an interval."""
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
