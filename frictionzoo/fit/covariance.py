"""Joint distribution of the identified coordinates, and draws from it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class Covariance:
    """Multivariate Student's t distribution of coordinates.

    Attributes:
        labels: Name of each coordinate, one of `Space.labels`.
        centre: Middle of each coordinate's interval.
        matrix: Scale matrix: half an interval is Student's quantile times the root of its diagonal.
        freedom: Degrees of freedom.
    """

    labels: tuple[str, ...]
    centre: Float[np.ndarray, "own"]
    matrix: Float[np.ndarray, "own own"]
    freedom: float

    def draw(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "count own"]:
        """Draw vectors: normal ones over the root of a chi-squared number that a vector's coordinates share.

        Source: S. Kotz, S. Nadarajah, "Multivariate t distributions and their applications", 2004, section 1.1.
        """
        # With fewer stretches than coordinates the matrix is singular and has no Cholesky factor.
        eigenvalues, axes = np.linalg.eigh(self.matrix)
        normal = rng.standard_normal((count, len(self.labels))) @ (axes * np.sqrt(np.maximum(eigenvalues, 0))).T
        return self.centre + normal / np.sqrt(rng.chisquare(self.freedom, (count, 1)) / self.freedom)
