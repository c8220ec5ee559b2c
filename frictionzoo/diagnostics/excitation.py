"""Diagnostics of excitation: do training recordings move each joint in both directions and at several speeds?"""

from collections.abc import Iterator, Sequence

import numpy as np

from frictionzoo.bench import Bench
from frictionzoo.core.log import Log
from frictionzoo.diagnostics.findings import Finding

MOVING = 0.05  # share of the top speed above which a joint moves
ONE_WAY = 0.01  # share of moving samples in the rarer direction below which a joint does not reverse
ONE_SPEED = 1.5  # smallest ratio of the 90 % to the 10 % quantile of the speed of moving samples


def check_excitation(logs: Sequence[Log], bench: Bench) -> Iterator[Finding]:
    """Find joints that never reverse or that move at one speed."""
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
