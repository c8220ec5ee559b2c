"""Where a fit runs: one device, or several."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from frictionzoo.fit.blocks import BLOCK_STATES

TWO_DEVICES = "--xla_force_host_platform_device_count=2"
FITS = {
    "adam": ["fit=adam", "fit.iterations=10"],
    "lm": ["fit=lm", "fit.iterations=30"],
    "grid": ["fit=grid", "fit.points=3"],
    "together": ["fit=lm", "segments.count=null", "segments.length=10", "loss.refine=true", "loss.continuity=1"],
}
COMPARE = """
import sys
from frictionzoo.fit import blocks
from frictionzoo.cli.run import NOT_IDENTIFIED, main
from frictionzoo.report import with_matplotlib
with_matplotlib.save_figure = lambda *_: None  # figures take long to render, and nobody looks
devices = blocks.devices_of
for name, own in {fits}.items():
    for count in (1, 2):
        blocks.devices_of = lambda rollout: devices(rollout)[:count]
        sys.argv[1:] = [*{options}, *own, f"hydra.run.dir={{name}}{{count}}"]
        try:
            main()
        except SystemExit as end:  # so few iterations need not find the drive
            assert end.code == NOT_IDENTIFIED
"""


def parameters(folder: Path) -> dict[str, float]:
    result = json.loads((folder / "result.json").read_text())
    return {item["name"]: item["value"] for item in result["parameters"]}


@pytest.mark.slow
@pytest.mark.usefixtures("in_haste")
def test_two_devices_find_what_one_finds(start: Callable, tiny: tuple[str, ...], tmp_path: Path) -> None:
    # 39 segments: neither two devices nor the blocks share them evenly.
    options = (*tiny, "model=mujoco_default", "segments.count=39", "loss.velocity=0.1")
    started = start(program=("-c", COMPARE.format(fits=FITS, options=options)), XLA_FLAGS=TWO_DEVICES)
    _, err = started.communicate()
    assert started.returncode == 0 and err.count("run on 2 devices") == len(FITS), err
    for fit in FITS:
        one, two = (parameters(tmp_path / f"{fit}{count}") for count in (1, 2))
        assert two == pytest.approx(one, rel=1e-9), fit
    assert BLOCK_STATES > 39
