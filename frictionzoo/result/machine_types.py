"""What `result.json` holds of the program that found it, as types."""

from typing import TypedDict

from frictionzoo.result.kinds import Count, NotNegative


class ProofRow(TypedDict):
    """How far the engine is from MuJoCo C."""

    step: NotNegative
    """Largest difference of a position or velocity after one step [rad or m, rad/s or m/s], relative where they are
    above 1."""
    rollout: NotNegative
    """The same after all steps."""
    cases: Count
    """Rollouts."""
    steps: Count
    """Steps in each."""


Versions = TypedDict(
    "Versions",
    {
        "frictionzoo": str,
        "python": str,
        "mujoco": str,
        "mujoco-mjx": str,
        "jax": str,
        "torch": str,
        "optax": str,
        "lightning": str,
        "numpy": str,
    },
)
