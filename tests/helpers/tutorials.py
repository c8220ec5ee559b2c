"""The code of the tutorials, and the robots that they speak of."""

import re
import xml.etree.ElementTree as ET
from pathlib import Path

from conftest import ROOT

from frictionzoo.bench.robot_file import read_robot
from helpers.robots import GAINS, HEADERS, TRUTH, arm, record

DOCS = ROOT / "docs"
LEG = {"armature": [0.01, 0.008], "frictionloss": [0.25, 0.15], "damping": [0.05, 0.03]}
ENCODER = 2e-4, 1e-2  # rad, rad/s: its noise
SUBSTEPS = 100  # of 20 us: the recipe finds what longer ones do, and steps of 2 ms move friction by a tenth and more


def code_of(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", (DOCS / page).read_text(), re.M | re.S)


def write_robots(folder: Path) -> None:
    """The leg and the arm of the tutorials, and a recording of each."""
    (leg,) = code_of("tutorials/leg.md", "xml")
    headers = {signal: [f"{signal}_hip", f"{signal}_knee"] for signal in ("qpos", "qvel", "ctrl")}
    (folder / "robot.xml").write_text(leg)
    fixed = ET.tostring(read_robot(str(folder / "robot.xml")).root, encoding="unicode")
    gains = {"kp": [25, 40], "kd": [0.6, 1.0]}
    record(folder / "leg.csv", fixed, LEG, gains, headers, seconds=20.0, noise=ENCODER, substeps=SUBSTEPS)
    (folder / "arm.xml").write_text(arm())
    record(folder / "arm.csv", arm(), TRUTH, GAINS, HEADERS)  # in the steps with which the page identifies it
