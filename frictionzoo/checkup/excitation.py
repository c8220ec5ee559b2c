"""Whether recordings that train move a joint both ways, and at more than one speed."""

from collections.abc import Iterator, Sequence

import numpy as np

from frictionzoo.bench import Bench
from frictionzoo.checkup.findings import Finding
from frictionzoo.core.log import Log

MOVING = 0.05  # share of the top speed from which on a joint moves
ONE_WAY = 0.01  # share of the moving samples that go the other way, below which a joint does not reverse
ONE_SPEED = 1.5  # times by which the fastest tenth of the moving samples is at least faster than the slowest


def check_excitation(logs: Sequence[Log], bench: Bench) -> Iterator[Finding]:
    """Joints that never reverse, and joints that move at one speed."""
    for joint, name in enumerate(bench.joints):
        of = f" of {name}" if bench.nv > 1 else ""
        velocity = np.concatenate([log.qvel[:, joint] for log in logs])
        top = float(np.quantile(np.abs(velocity), 0.99))
        moving = velocity[np.abs(velocity) > MOVING * top]
        if not top > 0 or len(moving) < 2:
            continue
        back = min(float(np.mean(moving > 0)), float(np.mean(moving < 0)))
        slow, fast = np.quantile(np.abs(moving), [0.1, 0.9])
        if back < ONE_WAY:
            yield Finding(
                "one way",
                False,
                f"the motion{of} never reverses ({100 * back:.2g} % of it goes the other way): dry friction and "
                "a constant torque cannot be distinguished; record both directions and list them in data.train",
                joint=name,
            )
        if fast < ONE_SPEED * slow:
            yield Finding(
                "one speed",
                False,
                f"the motion{of} has one speed, {slow:.3g} to {fast:.3g} in most samples: dry and viscous friction "
                "cannot be distinguished; record slower and faster motion and list it in data.train, or fix one of "
                "them (model=mujoco_default model.params.damping.identify=false)",
                joint=name,
            )
