"""Where a fit runs: one device, several, or one that is not there."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from frictionzoo.fit.objective import BLOCK_STATES


def parameters(folder: Path) -> dict[str, float]:
    result = json.loads((folder / "result.json").read_text())
    return {item["name"]: item["value"] for item in result["parameters"]}


@pytest.mark.slow
@pytest.mark.parametrize("fit", ["lm", "adam", "grid"])
def test_two_devices_find_what_one_finds(
    start: Callable, tiny: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fit: str
) -> None:
    # 39 segments: neither two devices nor the blocks share them evenly.
    options = (*tiny, "model=mujoco_default", f"fit={fit}", "segments.count=39", "loss.velocity=0.1")
    short = {"adam": ("fit.iterations=10",), "lm": (), "grid": ("fit.points=3",)}[fit]
    for devices in (1, 2):
        monkeypatch.setenv("XLA_FLAGS", f"--xla_force_host_platform_device_count={devices}")
        process = start(*options, *short, f"hydra.run.dir={devices}")
        _, err = process.communicate()
        assert process.returncode == 0, err
        assert (f"spread over {devices} devices" in err) == (devices > 1)
    one, two = (parameters(tmp_path / str(devices)) for devices in (1, 2))
    assert one.keys() == two.keys()
    for name, value in one.items():
        assert two[name] == pytest.approx(value, rel=1e-9), name
    assert BLOCK_STATES > 39


def test_a_gpu_that_is_not_there_is_one_line(call: Callable, tiny: tuple[str, ...]) -> None:
    finished = call(*tiny, "device=cuda")
    assert finished.status == 2
    assert "device=cuda: JAX finds none, expected a GPU" in finished.err
