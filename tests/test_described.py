"""What a part remembers of its constructor, and that it can be made again from it."""

import copy
from typing import Any

import numpy as np
import pytest

from frictionzoo.bench import Force, PositionPD
from frictionzoo.core.build import build
from frictionzoo.core.described import Described, describe
from frictionzoo.core.errors import ConfigError
from frictionzoo.data.files import Files
from frictionzoo.fit import Adam, Grid, Known
from frictionzoo.models import NeuralFriction

SECTION = {"init": 35.0, "low": 1.0, "high": 1e3, "scale": "log", "identify": True}


@pytest.mark.parametrize(
    ("part", "section"),
    [
        (Grid(3), {"_target_": "frictionzoo.fit.Grid", "points": 3}),
        (Known(), {"_target_": "frictionzoo.fit.Known"}),
        (Adam(5, np.float64(0.1)), {"iterations": 5, "learning_rate": 0.1, "schedule": "constant"}),
        (PositionPD(kp=15, kd=0.5), {"_target_": "frictionzoo.bench.PositionPD", "kp": 15, "kd": 0.5, "params": None}),
        (Force({"force_gain": SECTION}, force_offset=0.0), {"params": {"force_gain": SECTION}, "force_offset": 0.0}),
        (NeuralFriction(2, (4, 4)), {"_target_": "frictionzoo.models.NeuralFriction", "hidden": [4, 4], "seed": 0}),
        (Files(train="a.csv", where={"kp": (4, 8)}), {"train": "a.csv", "where": {"kp": [4, 8]}}),
    ],
)
def test_a_part_is_made_again_from_its_section(part: Described, section: dict[str, Any]) -> None:
    described = describe(part)
    assert section.items() <= described.items()
    assert type(build(described)) is type(part) and describe(build(described)) == described
    assert describe(copy.deepcopy(part)) == described


def test_a_parameter_that_nobody_states_is_not_recorded() -> None:
    assert describe(Force(force_gain=2.0)).keys() == {"_target_", "params", "force_gain"}


def test_an_unknown_argument_is_refused_with_the_closest_one() -> None:
    with pytest.raises(TypeError, match=r"^PositionPD: unknown argument kpp; did you mean kp\?"):
        PositionPD(**{"kpp": 15, "kd": 0.5})


def test_what_no_record_can_hold_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"expected numbers, text, lists or parts of frictionzoo"):
        describe(Files(inputs={"gain": object()}))
