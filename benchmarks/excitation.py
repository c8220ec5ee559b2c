"""What a designed command is worth: `python benchmarks/excitation.py`.

The hidden drive of `data=twin_clean` is recorded twice in MuJoCo C, for as long and with the same sensors: under the
paper's five harmonics, and under the command that `frictionzoo.excite` designs from the drive found on these, with their
largest position, speed and torque as limits. Intervals are predicted, and then those of `fit=lm segments.length=100`.
"""

import argparse
import time
from typing import Any

import numpy as np
from measure import make_parser, print_table, write_json

from frictionzoo.core.build import build
from frictionzoo.core.config import compose_config
from frictionzoo.core.log import Dataset, Log
from frictionzoo.core.segments import split_by_time
from frictionzoo.excite.excitation import Excitation, excite
from frictionzoo.excite.limits import KINDS
from frictionzoo.identification import Problem, solve
from frictionzoo.logs.twin import Twin
from frictionzoo.result.identified import Identified
from frictionzoo.simulate.context import computing

COLUMNS = {
    "parameter": "parameter",
    "hidden": "hidden",
    "harmonics_predicted": "harmonics, predicted [%]",
    "harmonics": "found [%]",
    "designed_predicted": "designed, predicted [%]",
    "designed": "found [%]",
    "narrower_predicted": "narrower, predicted",
    "narrower": "found",
    "off": "off by [%]",
}
HIDDEN = {  # of the law, by the twin's names
    "bench.armature": "armature",
    "friction.static_torque": "static_torque",
    "friction.kinetic_torque": "coulomb_torque",
    "friction.stribeck_velocity": "stribeck_velocity",
    "friction.viscous_coefficient": "viscous_coefficient",
}
SUBSTEPS = 4


def main() -> None:
    """Record, identify, design, record, identify; print and write."""
    options = parse()
    settings = compose(options)
    twin: Twin = build(settings["data"])
    moment = twin.timestep * np.arange(twin.samples)
    ctrl = twin.excitation.command(moment, np.random.default_rng(twin.seed))
    first, reached = record(twin, ctrl)
    before = identify(settings, first)

    limits = {
        "position": f"[{min(reached['low']):.17g},{max(reached['high']):.17g}]",
        "velocity": f"{reached['velocity']:.17g}",
        "torque": f"{reached['torque']:.17g}",
    }
    began = time.perf_counter()
    designed = excite(limits | asked(options, twin, settings), before)
    seconds = time.perf_counter() - began
    harmonics = foresee(limits | asked(options, twin, settings), before, ctrl)

    second, used = record(twin, designed.motion.ctrl[:, 0])
    after = identify(settings, second)
    rows = [
        row(name, twin, before, after, harmonics[name], expected)
        for name, expected in ((each["name"], each["share"]) for each in designed.note["parameters"])
    ]
    print_table(rows, COLUMNS)
    kept = list(compare(used, reached))
    print()
    print_table(kept)
    print(f"\ndesigned in {seconds:.0f} s")
    write_json(options.out, {"settings": {"seconds": seconds, "limits": kept, "search": designed.note["search"]}, "rows": rows})


if __name__ == "__main__":
    main()
