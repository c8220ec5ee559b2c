"""Branches of a robot: simulated side by side as MuJoCo does, and derivatives taken only where a parameter acts."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
import pytest
import torch

from frictionzoo.bench import Bench, PositionPD
from frictionzoo.bench.branches import group_alike
from frictionzoo.core.segments import Sampling, Segments
from frictionzoo.core.state import DriveState, FrictionTerms, Signals
from frictionzoo.fit import Objective, Space
from frictionzoo.fit.normal_equations import NormalEquations
from frictionzoo.models import FrictionModel
from frictionzoo.models.mujoco_default import MujocoDefault
from frictionzoo.simulation.drive import Drive
from frictionzoo.simulation.proof import Recorded, initial_values, prove

pytestmark = pytest.mark.usefixtures("x64")

SECTION = {"low": 1e-3, "high": 10.0, "scale": "log", "identify": True}
OFFSET = {"init": 0.01, "low": -0.2, "high": 0.2, "scale": 0.1, "identify": True}
DELAY = {"init": 0.003, "low": 0.0, "high": 0.02, "scale": 0.01, "identify": True, "tie": True}


def law(**changes: Any) -> MujocoDefault:
    return MujocoDefault(5, {name: {"init": 0.1, **SECTION, **changes} for name in ("frictionloss", "damping")})


def segments(bench: Bench, sampling: Sampling) -> Segments:
    rng = np.random.default_rng(0)
    ctrl = 0.5 * np.cumsum(rng.normal(size=(7, 12 + sampling.history, 5)), axis=1)
    qpos = rng.normal(size=(7, 13, 5))
    return Segments(qpos, rng.normal(size=qpos.shape), Signals(ctrl), sampling.interval)


def test_branches_that_are_alike_differ_in_numbers_of_links_alone(robot: Callable[..., Bench]) -> None:
    bench = robot()
    assert bench.branches == (0, 0, 1, 2, 2)
    joints = [np.array([0, 1]), np.array([2]), np.array([3, 4])]
    parts = [bench.only(own.tolist()).compile(constraint=False) for own in joints]
    legs, tail = group_alike(joints, parts)
    assert legs.joints.tolist() == [[0, 1], [3, 4]] and tail.joints.tolist() == [[2]]
    model = bench.compile(constraint=False)
    places = {"body_pos", "body_quat", "body_ipos", "body_iquat", "jnt_axis"}
    assert {field for field, _ in legs.fields} <= places and not tail.fields
    for row, part in zip(legs.links, (parts[0], parts[2]), strict=True):
        assert row.tolist() == [np.ravel(getattr(part, field))[place] for field, place in legs.fields]
    assert model.ntree == 3


@pytest.mark.parametrize("constraint", [True, False])
def test_a_robot_of_branches_is_simulated_as_mujoco_does(robot: Callable[..., Bench], constraint: bool) -> None:
    bench = robot(params={"position_offset": OFFSET})
    model = law() if constraint else Viscous(5, {"damping": {"init": 0.1, **SECTION}})
    rng = np.random.default_rng(1)
    signals = Signals(rng.normal(size=(40, 5)))
    recorded = Recorded(rng.normal(size=(40, 5)), rng.normal(size=(40, 5)), signals, np.zeros((40, 0)))
    drive = Drive.assemble(bench, model, "auto")
    assert drive.engine.name == "specialised" and drive.engine.note.startswith("the dynamics reduce to 2 x ")
    assert prove(bench, model, "specialised", initial_values(bench, model), recorded).rollout < 1e-11


class Viscous(MujocoDefault):
    """Damping alone, as a torque."""

    dimensions = {"damping": "damping"}
    constraint = False

    def terms(self, xp: Any, values: Any, state: DriveState) -> FrictionTerms:
        return FrictionTerms(torque=values["damping"] * state.qvel)


class Coupled(Viscous):
    """The same with the mean velocity of all joints."""

    def terms(self, xp: Any, values: Any, state: DriveState) -> FrictionTerms:
        return FrictionTerms(torque=values["damping"] * (state.qvel + 0.1 * state.qvel.sum(-1)[..., None]))


@pytest.mark.usefixtures("in_haste")
@pytest.mark.parametrize(("tied", "refine"), [(False, False), pytest.param(True, True, marks=pytest.mark.slow)])
def test_equations_are_those_of_one_problem(robot: Callable[..., Bench], tied: bool, refine: bool) -> None:
    tie = {"hip": "(left|right)_hip", "knee": ".*_knee"} if tied else None
    bench = robot(tie=tie, params={"position_offset": OFFSET, "delay": DELAY})
    model = Viscous(5, {"damping": {"init": 0.1, **SECTION}}) if refine else law()
    together, apart = (equations(bench, model, refine, alone) for alone in (True, False))
    assert apart[1] == (9 if not tied else 1 + 2 + 2 * 2)
    assert together[1] == len(together[0].gradient)
    for one, other in zip(together[0][:3], apart[0][:3], strict=True):
        # The search for initial states ends elsewhere: a leg's step does not wait for another's.
        close = 1e-5 if refine else 1e-9
        np.testing.assert_allclose(one, other, rtol=close, atol=close * np.abs(one).max())


def test_a_law_that_joins_the_branches_is_one_problem(robot: Callable[..., Bench]) -> None:
    section = {"damping": {"init": 0.1, **SECTION}}
    for kind, branches in ((Viscous, (0, 0, 1, 2, 2)), (Coupled, (0,) * 5)):
        assert Drive.assemble(robot(), kind(5, section), "auto").rollout.branches == branches


def equations(bench: Bench, model: FrictionModel, refine: bool, alone: bool) -> tuple[NormalEquations, int]:
    """The normal equations, and how many tangents they took."""
    sampling = bench.sampling(0.004)
    drive = Drive.assemble(bench, model, "auto", sampling)
    rollout = drive.rollout
    if alone:
        object.__setattr__(rollout, "branches", (0,) * 5)
    space = Space(bench, model, "float64")
    together = replace(segments(bench, sampling), follows=np.arange(7) % 4 > 0) if refine else segments(bench, sampling)
    loss = {"refine": refine, "continuity": 0.1 if refine else 0.0, "by_joint": refine}
    objective = Objective(space, rollout, together, 1.0, 0.01, **loss).balanced()
    found = objective.compile_normal_equations()(np.asarray(space.start))
    return found, len(objective._sparsity.seeds)


def test_a_joint_that_touches_another_branch_is_one_problem(tmp_path: Path) -> None:
    balls = "".join(
        f'<body pos="{x} 0 0"><joint name="j{x}" axis="0 1 0"/><geom size="0.1" pos="0.2 0 0"/></body>' for x in (0, 1)
    )
    path = tmp_path / "balls.xml"
    path.write_text(f"<mujoco><worldbody>{balls}</worldbody></mujoco>")
    bench = Bench(str(path), ["j0", "j1"], actuator=PositionPD(kp=1, kd=1))
    assert bench.branches == (0, 0)
    assert mujoco.MjModel.from_xml_path(str(path)).ntree == 2


def test_a_gradient_passes_through_branches(robot: Callable[..., Bench]) -> None:
    import frictionzoo as fz

    bench, model = robot(), law()
    state = torch.zeros((2, 5), dtype=torch.float64)
    ctrl = torch.ones((2, 4, 5), dtype=torch.float64, requires_grad=True)
    qpos, _ = fz.rollout(bench, model, state, state, ctrl)
    qpos[..., 2].sum().backward()
    moved = ctrl.grad.abs().sum((0, 1)) > 0
    assert moved.tolist() == [False, False, True, False, False]
    assert jax.config.jax_enable_x64
