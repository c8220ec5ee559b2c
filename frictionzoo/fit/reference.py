"""The same bench without friction: what every result is compared with."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from frictionzoo.engine.mjx import Values
from frictionzoo.fit.objective import Objective


def fit_reference(objective: Objective) -> Values:
    """Minimise the objective by L-BFGS-B from the initial values, to its own tolerance.

    With the few parameters of a bench this ends where the recipe would, in a tenth of the time.

    Args:
        objective: That of a bench without friction.

    Returns:
        Physical values of all parameters by owner and name.
    """
    space = objective.space
    derivative = jax.jit(objective.value_and_grad("auto"))
    scale = float(derivative(space.start)[0]) or 1.0

    def value_and_grad(vector: np.ndarray) -> tuple[float, np.ndarray]:
        loss, gradient = derivative(jnp.asarray(vector, space.start.dtype))
        return float(loss) / scale, np.asarray(gradient, np.float64) / scale

    bounds = list(zip(np.asarray(space.low, np.float64), np.asarray(space.high, np.float64), strict=True))
    found = minimize(value_and_grad, np.asarray(space.start, np.float64), jac=True, method="L-BFGS-B", bounds=bounds)
    return jax.tree.map(np.asarray, space.values(jnp.asarray(found.x, space.start.dtype)))
