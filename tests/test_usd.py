"""The USD layer over a robot's file: its values as Newton reads them, and files that are refused."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import finish
from pxr import Sdf, Usd, UsdPhysics

from frictionzoo.cli.finished import export
from frictionzoo.core.errors import ConfigError, ExportError
from frictionzoo.export.motor import Joint, Motor
from frictionzoo.export.usd import FILE, write_layer

ROBOT = Path(__file__).parent / "helpers" / "robot.usda"
VALUES = Joint(Motor(20.0, 0.5, effort_limit=3.0), 0.01, 0.05, 0.02, 4)


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    path = tmp_path / "robot.usda"
    path.write_bytes(ROBOT.read_bytes())
    return path


@pytest.mark.parametrize(
    ("name", "kind", "place"),
    [
        ("knee", "hinge", "/robot/knee"),
        ("/robot/right/hip", "hinge", "/robot/right/hip"),
        ("a/b-1", "slide", "/robot/a_b_1"),  # as importers of MJCF and URDF name it
    ],
)
def test_a_joint_gets_its_values_and_the_robots_file_stays(robot: Path, name: str, kind: str, place: str) -> None:
    before, path = robot.read_bytes(), robot.with_name(FILE)
    (read,) = write_layer(path, robot, [name], [VALUES], kind)
    assert robot.read_bytes() == before
    flat = [*read.motor.__dict__.values(), *read[1:4]]
    wanted = [*VALUES.motor.__dict__.values(), *VALUES[1:4]]
    assert flat == pytest.approx(wanted, rel=2e-7) and read.lag == 0
    stage = Usd.Stage.Open(str(path))
    assert stage.GetDefaultPrim().GetName() == "robot" and stage.GetMetadata("metersPerUnit") == 1.0
    prim, angle = stage.GetPrimAtPath(place), math.degrees(1) if kind == "hinge" else 1.0
    # Newton's `_resolution_policy.py`: damping of a hinge is per degree, armature and friction are in SI units.
    assert prim.GetAttribute("newton:damping").Get() * angle == pytest.approx(0.02, rel=2e-7)
    assert prim.GetAttribute("newton:armature").Get() == prim.GetAttribute("physxJoint:armature").Get()
    drive = UsdPhysics.DriveAPI(prim, "angular" if kind == "hinge" else "linear")
    assert drive.GetStiffnessAttr().Get() * angle == pytest.approx(20.0, rel=2e-7)
    assert prim.IsA(UsdPhysics.RevoluteJoint) == (kind == "hinge")


def test_what_is_no_robot_of_this_drive_is_refused_in_a_line(robot: Path) -> None:
    centimetres = robot.with_name("cm.usda")
    centimetres.write_text(robot.read_text().replace("metersPerUnit = 1", "metersPerUnit = 0.01"))
    unstated = robot.with_name("unstated.usda")
    unstated.write_text(robot.read_text().replace("metersPerUnit = 1\n", ""))
    xml = robot.with_name("robot.xml")
    xml.write_text("<mujoco/>")
    broken = robot.with_name("broken.usda")
    broken.write_text("#usda 1.0\n(")
    cases = [
        *((robot, "hip", ConfigError, "2 joints"), (robot, "a_b_1", ConfigError, "no PhysicsRevoluteJoint")),
        *(
            (robot, "kne", ConfigError, "did you mean knee"),
            (centimetres, "knee", ExportError, "metersPerUnit is 0.01"),
        ),
        *((unstated, "knee", ExportError, "metersPerUnit"), (xml, "knee", ExportError, "USD cannot read it")),
        *((broken, "knee", ExportError, "cannot"), (robot.with_name("none.usd"), "knee", ExportError, "no such file")),
    ]
    for file, name, error, said in cases:
        with pytest.raises(error, match=said) as refused:
            write_layer(robot.with_name(FILE), file, [name], [VALUES], "hinge")
        assert "\n" not in str(refused.value)
        assert not robot.with_name(FILE).exists()


def test_a_run_is_exported_over_a_robot(finished_run: Callable, robot: Path) -> None:
    run, _ = finished_run("mujoco_default")
    output = robot.with_name("out")
    finished = finish(lambda: export([str(run), "target=usd", f"into={robot}", "joint=knee", f"output={output}"]))
    assert finished.status == 0 and "newton:armature" in finished.out
    layer = Sdf.Layer.FindOrOpen(str(output / FILE))
    assert [*layer.subLayerPaths] == [str(robot.resolve())]
    for options, option in (([], "into"), ([f"into={robot}", "joint=a,b"], "joint")):
        refused = finish(lambda options=options: export([str(run), "target=usd", *options, f"output={output}"]))
        assert refused.status == 2 and f"{option}" in refused.err
