"""Logs of a servo that stands still under a command."""

import numpy as np

from frictionzoo.core.log import Log, Payload

INTERVAL = 0.01
PAYLOAD = Payload(0.5, (0.0, 0.0, -0.1), (1e-3, 1e-3, 1e-3))


def record(command: np.ndarray, **extras: float) -> Log:
    """A log with this command, of a drive that stands still."""
    samples = len(command)
    still = np.zeros((samples, 1))
    inputs = {"gain": 16.0, "supply": 12.0, "enable": 1.0} | extras
    columns = {name: np.full((samples, 1), value) for name, value in inputs.items()}
    return Log(
        "servo", INTERVAL * np.arange(samples), still, still, command[:, None], "", True, PAYLOAD, extras=columns
    )


def wander(samples: int, seed: int) -> np.ndarray:
    """A command of steps and sines."""
    rng = np.random.default_rng(seed)
    time = INTERVAL * np.arange(samples)
    steps = np.repeat(rng.uniform(-0.6, 0.6, size=samples // 50 + 1), 50)[:samples]
    return steps + 0.4 * np.sin(2 * np.pi * rng.uniform(0.5, 2) * time + rng.uniform(0, 6))
