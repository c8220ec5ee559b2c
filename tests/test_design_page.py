"""`report.html` of a designed command: what it answers, that it names no folder, and how a real browser shows it."""

from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
import pytest
from helpers.browser import CLIPPED, DRAWN, WIDTHS, needs_browser, open_page, read_data
from helpers.html_pages import HOSTILE, Page, judge_targets

from frictionzoo.core.config import compose_settings
from frictionzoo.design.steps import _list_drive_options
from frictionzoo.design.task import Motion
from frictionzoo.report.design_page import check_command, write_page

HOME = "/home/somebody/runs/first"
LIMITS = {"position": 1.5, "velocity": 4.0, "torque": 2.0}
UNITS = {"position": "rad", "velocity": "rad/s", "torque": "N m"}
KINDS = ("commanded position", "commanded velocity", "position", "velocity", "torque")


def make_note(*joints: str) -> dict[str, Any]:
    """What `excitation.json` holds, of parameters of which the last is not identifiable."""
    ends = [f"/{joint}" for joint in joints] if len(joints) > 1 else [""]
    known = {"share": 0.025, "share_now": 0.5, "identifiable": True, "half_width": 0.01, "value": 0.4, "unit": "N m"}
    lost = known | {"share": 0.8, "share_now": None, "identifiable": False}
    parameters = [{"name": f"friction.static_torque{end}", **known} for end in ends]
    parameters += [{"name": f"friction.a_damping_with_a_long_name{end}", **lost} for end in ends]
    limits = [
        {"joint": joint, "quantity": kind, "unit": UNITS[quantity], "reached": [-0.5, 0.5], "share": share}
        | {"allowed": [-LIMITS[quantity], LIMITS[quantity]]}
        for kind, share in zip(KINDS, (0.3, 0.6, 0.2, 0.5, 0.94), strict=True)
        for quantity in [kind.rpartition(" ")[2]]
        for joint in joints
    ]
    command = {"seconds": 2.0, "rate": 500.0, "home": [0.0] * len(joints), "fps": 50.0, "bandwidth": 8.0}
    return {
        **{"run": HOME, "model": "stribeck", "joints": list(joints), "parameters": parameters, "limits": limits},
        "command": command | {"ramp": 0.2, "period": 2.0, "margin": 0.05},
        "noise": {"quantum": 1e-3, "position_noise": 0.0, "velocity_noise": 0.05},
        "search": {"criterion": "determinant", "starts": 1, "iterations": 3, "seed": 0},
        **{"fit": {"length": 100}, "files": ["command.csv", "expected.csv"]},
        "next": [{"purpose": "Another", "command": f"python -m frictionzoo.design {HOME} velocity=4"}],
    }


def make_motion(joints: int) -> Motion:
    """One that fills the limits of velocity and of torque, and next to nothing of the position's."""
    time = np.arange(1001)[:, None] / 500 * np.ones(joints)
    wave = np.sin(2 * np.pi * 4 * time)
    return Motion(0.1 * wave, 3 * wave, 0.1 * wave, 3 * wave, 1.5 * wave)


def show(folder: Path, *joints: str) -> str:
    write_page(folder / "report.html", make_note(*joints), 0.002, make_motion(len(joints)))
    return (folder / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("joints", [("knee",), (HOSTILE, "knee")], ids=len)
def test_the_page_answers_what_will_be_known_and_what_to_do(tmp_path: Path, joints: tuple[str, ...]) -> None:
    source = show(tmp_path, *joints)
    page = Page(source)
    count = len(joints)
    assert f"{count} of {2 * count} parameters of stribeck are identifiable" in page.text
    assert "± 2.5 %" in page.text and "now ± 50 %" in page.text and "not identifiable" in page.text
    assert "94 %" in page.text and "(-1.5" not in page.text and "-1.5 to 1.5" in page.text
    assert "ros2 topic pub --once /joint_trajectory_controller/joint_trajectory " in page.text
    assert "python -m frictionzoo.design first velocity=4" in page.text
    assert "somebody" not in source and not page.with_attribute("onerror")
    judge_targets(source)
    places = [each["id"] for each in page.with_attribute("id")]
    links = [each["href"] for each in page.with_attribute("href")]
    assert {link[1:] for link in links if link[0] == "#"} <= {*places} and len(places) == len({*places})
    assert [link for link in links if link[0] != "#"][1:] == ["excitation.json", "command.csv", "expected.csv"]
    assert len(source) < 1.5e6


def test_motion_is_drawn_within_its_limits(tmp_path: Path) -> None:
    motion, phase, spectrum = read_data(show(tmp_path, "knee"))["figures"]
    for figure in (motion, phase, spectrum):
        go.Figure(figure)  # raises for a property that plotly does not know
    ends = [[shape["y0"] for shape in motion["layout"]["shapes"] if shape["yref"] == axis] for axis in ("y2", "y3")]
    assert ends == [[-4.0, 4.0], [-2.0, 2.0]]
    low, high = motion["layout"]["yaxis"]["range"]
    assert -0.2 < low < high < 0.2  # the limits would flatten it
    assert motion["layout"]["yaxis2"]["range"][0] < -4 and motion["layout"]["yaxis3"]["range"][1] > 2
    amplitude = spectrum["data"][0]
    assert amplitude["x"][int(np.argmax(amplitude["y"]))] == pytest.approx(4, abs=0.01)
    assert max(amplitude["y"]) == pytest.approx(3, rel=0.01)


def test_what_is_not_identifiable_is_a_doubt() -> None:
    note = make_note("knee")
    assert [check.state for check in check_command(note)] == ["caution", "good", "note", "note"]
    note["parameters"] = note["parameters"][:1]
    assert [check.state for check in check_command(note)] == ["good", "good", "note", "note"]
    (row,) = note["parameters"]
    for now, state in ((2 * row["share"], "good"), (0.5 * row["share"], "caution")):
        row["share_now"] = now
        gain = [check.state for check in check_command(note) if check.title in ("Gain", "Limits")]
        assert gain[0] == state  # to record it is of no use where the run knows as much


def test_the_fit_is_told_the_bench() -> None:
    """Not that of data=files, nor what a recipe finds."""
    settings = compose_settings({"bench": {"params": {"armature": {"init": 0.05}}}}, "bench=emps")
    assert _list_drive_options(settings) == ["bench=emps", "bench.params.armature.init=0.05"]


@needs_browser
@pytest.mark.parametrize("joints", [("knee",), ("FL_thigh_joint", "FL_calf_joint")], ids=len)
def test_a_phone_shows_the_page_in_the_dark(tmp_path: Path, joints: tuple[str, ...]) -> None:
    show(tmp_path, *joints)
    browser = open_page(tmp_path / "report.html", width=390, scheme="dark")
    assert browser.run(DRAWN) == 3 and browser.run("return isDark()")  # the other joint is folded
    opened = "document.querySelectorAll('details').forEach(fold => (fold.open = true)); await pause(100);"
    assert browser.run(opened + DRAWN) == 3 * len(joints)
    inner, page, *drawings = browser.run(WIDTHS)
    assert inner == 390 and page <= inner and max(drawings) <= inner
    assert browser.run(CLIPPED) == []
