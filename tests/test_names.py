"""Names of a robot in files for other programs: data there, whatever they are, and nothing else."""

import ast
import csv
import functools
import io
import json
import re
import tokenize
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import quote

import msgspec
import mujoco
import numpy as np
import pytest
import torch
import yaml
from conftest import make_run, slow_but, trace_nothing
from helpers.fitted import FREE
from hypothesis import example, given, settings
from hypothesis import strategies as st

import frictionzoo as fz
from frictionzoo.api.identified import Identified
from frictionzoo.bench import Robot, VoltageServo
from frictionzoo.core.build import build
from frictionzoo.core.errors import ExportError
from frictionzoo.core.manifest import MANIFEST
from frictionzoo.core.output import to_json
from frictionzoo.core.segments import Segments
from frictionzoo.core.state import DriveState, Signals
from frictionzoo.core.templates import Code, write_literal, write_yaml
from frictionzoo.core.xml import write_comment, write_xml
from frictionzoo.design.write import table
from frictionzoo.export.base import get_target, match_joint, target_names
from frictionzoo.export.in_place import InPlace
from frictionzoo.export.module import write_module
from frictionzoo.export.mujoco_c import write_native
from frictionzoo.fit.uncertainty import Uncertainty
from frictionzoo.models import ActuatorNetwork, Dahl, MujocoDefault
from frictionzoo.report.card import write_card
from frictionzoo.result.fitted_drive import FittedDrive
from frictionzoo.result.types import ParameterRecord, Result
from frictionzoo.result.values import list_values

PLAIN = ("plain_one", "plain_two")
SLOW = ("actuator_net", "mjx", "onnx")  # compile for seconds
TARGETS = target_names()
OPTIONS = {
    "randomisation": {"ranges": "{bench.armature: [0.8, 1.2], friction.damping: [0.5, 2]}", "count": "3", "files": "1"},
    "bam": {"servo": "xl330"},
    "usd": {"into": str(Path(__file__).parent / "helpers" / "robot.usda"), "joint": "/robot/left/hip,/robot/right/hip"},
}
LAWS = {"actuator_net": ActuatorNetwork}  # targets of one model
EVERYTHING = (
    "/leg/a.b \"\"\" ''' \\ {{ 7 }} {% x %} ${HOME} %s */ --> ---- ]]> </script> <a b='c'> & # $ ^ ( 膝 \U0001f600"
)
HOSTILE = [
    (EVERYTHING, "a---"),
    ('",),)\nimport os; os.abort()\n#', f"{EVERYTHING}\r\n\t"),
    ("/leg/knee", r"C:\x"),
    ("~/a", "../../a"),
    ('"""\nimport os; os.abort()\n"""', "'''"),
    ('$",),)\nimport os; os.abort()\n#', "a\\"),
    ("{{ 7 * 7 }}{% raise %}{# #}", "${oc.env:HOME} %s %(x)s {0} {x}"),
    ("*/ int main(){} /*", "// \\\n#include <x>"),
    ("-->", "a---b--"),
    ("]]></a><b/>", "<![CDATA[ </script><script>alert(1)</script>"),
    ("a armature=\"9\" b='8' damping='1", "&quot; &#10; &amp;"),
    ("left.knee", "leftXknee"),
    ("^.*$", "[a-z]+|(?i)\\d{2}"),
    ("膝 \U0001f600 e\u0301\u202e\u2028", "\u00a0\ufeff"),
    ("\t", "\r\n"),
    (" knee ", "knee"),
    ("joint_b_fixed", "joint_b"),
    ("joint_b_link", "joint_b"),
    ("world", "link1"),
    ("__model__", "leg::knee"),
    ("x" * 300, "y"),
]
XML = st.characters(exclude_categories=("Cs", "Cc"), exclude_characters="\ufffe\uffff", include_characters="\t\r\n")
MARKS = "\" ' ''' { } {{ }} {% */ --> ]]> </script> ${ %s . $ ^ ( # / .. -- = & < > é joint _ \\ \"\"\""
PIECES = st.sampled_from([*MARKS.split(), "\n", "\r", " ", "\U0001f600"])
NAME = st.one_of(st.text(XML, min_size=1, max_size=12), st.lists(PIECES, min_size=1, max_size=6).map("".join))
EXAMPLES = settings(max_examples=100, deadline=None, derandomize=True)
TWO_NAMES = st.lists(NAME, min_size=2, max_size=2, unique=True).map(tuple)


class Still(Identified):
    """A drive in random states that does not move: nothing is compiled."""

    @cached_property
    def samples(self) -> DriveState:
        return DriveState(*np.random.default_rng(0).normal(scale=2.0, size=(5, 20, self.bench.nv)))

    @property
    def place(self) -> str:
        return f"runs/{self.result['data']['name']}"

    def rollout(self, segments: Any = None, timestep: Any = None, values: Any = None) -> tuple[np.ndarray, np.ndarray]:
        return self.segments.qpos[:, 1:], self.segments.qvel[:, 1:]


def write_robot(path: Path, names: Sequence[str]) -> None:
    """An MJCF of a chain whose bodies, joints and motors have these names, and a body without one."""
    root = ET.Element("mujoco")
    ET.SubElement(root, "option", timestep="0.002", integrator="implicitfast")
    body, section = ET.SubElement(root, "worldbody"), ET.SubElement(root, "actuator")
    for name in names:
        body = ET.SubElement(body, "body", name="world_" if name == "world" else name, pos="0 0 -0.2")
        ET.SubElement(body, "joint", name=name, axis="0 1 0")
        ET.SubElement(body, "inertial", pos="0 0 -0.1", mass="1", diaginertia="0.01 0.01 0.01")
        ET.SubElement(section, "motor", name=name, joint=name)
    ET.SubElement(ET.SubElement(body, "body"), "inertial", pos="0 0 0", mass="1", diaginertia="0.1 0.1 0.1")
    path.write_bytes(ET.tostring(root))


def make_drive(path: Path, names: Sequence[str], law: Any = MujocoDefault) -> Identified:
    """A drive as if identified, its data and its run called like its first joint."""
    write_robot(path, names)
    servo = VoltageServo(kt_over_r=0.3, kt2_over_r=0.2, duty_gain=0.01, duty_limit=0.9)
    bench = Robot(str(path), list(names), actuator=servo)
    model = law(2, params=dict.fromkeys(law.dimensions, FREE)).double()
    friction = {name: value.detach().numpy() for name, value in model.state_dict().items()}
    values = {"bench": bench.initial_values() | {"armature": np.array([0.02, 0.03])}, "friction": friction}
    inputs = {name: np.full((1, 20, 2), value) for name, value in (("gain", 16.0), ("supply", 12.0), ("enable", 1.0))}
    rest = np.zeros((1, 21, 2))
    segments = Segments(rest, rest, Signals(np.zeros((1, 20, 2)), inputs), bench.timestep)
    owned = [("bench", param) for param in bench.params.values()]
    owned += [("friction", param) for param in model.params.values()]
    rows = [_describe(bench, owner, param, values[owner][param.name]) for owner, param in owned]
    result = make_run(0, model.name, 2).result
    result.settings, result.data.name, result.parameters = {}, names[0], rows
    result.no_intervals = result.metrics.test.position_mae = None
    known = bench.sampling(bench.timestep), trace_nothing(segments)
    return Still(None, result, bench, model, {}, values, segments, *known)


def _describe(bench: Any, owner: Any, param: Any, value: Any) -> ParameterRecord:
    about: Any = {"low": 0.0, "high": 1.0, "identified": False, "at_bound": False}
    unknown: Any = {"interval": None, "identifiable": None}
    by_joint = list_values(bench, param, f"{owner}.{param.name}", value, Uncertainty())
    for row in by_joint:
        row.identified = False
    values = param.spread(np.asarray(value, float), 2).tolist()
    return ParameterRecord(param.name, owner, values, "1", by_joint=by_joint, **about, **unknown)


def write(target: str, folder: Path, names: Sequence[str]) -> Path:
    """The folder of what a target wrote."""
    (place := folder / "written").mkdir()
    drive = make_drive(folder / "robot.xml", names, LAWS.get(target, MujocoDefault))
    export = get_target(target)().write(drive, place, OPTIONS.get(target, {}))
    assert {*export.files} == {str(path.relative_to(place)) for path in _list_files(place)}
    assert not any("\n" in limit or "\r" in limit for limit in export.limits if "\n" not in "".join(names))
    return place


def _list_files(place: Path) -> list[Path]:
    return sorted(
        path for path in place.rglob("*") if path.is_file() and path.suffix != ".pyc" and path.name != MANIFEST
    )


def blank(text: str) -> tuple[str, list[str | None], list[str]]:
    """The syntax tree of a Python file without its constants; its docstrings; its comments."""
    tree = ast.parse(text)
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    docstrings = [ast.get_docstring(node) for node in ast.walk(tree) if isinstance(node, documented)]
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant):
            node.value = type(node.value).__name__
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return ast.dump(tree), docstrings, [token.string for token in tokens if token.type == tokenize.COMMENT]


def rename(value: Any, names: dict[str, str]) -> Any:
    """A JSON value with other names in place of these."""
    if isinstance(value, dict):
        return {rename(key, names): rename(part, names) for key, part in value.items()}
    if isinstance(value, list):
        return [rename(part, names) for part in value]
    return re.sub("|".join(names), lambda match: names[match[0]], value) if isinstance(value, str) else value


def judge_python(plain: Path, written: Path, names: dict[str, str]) -> None:
    before, after = (path.read_text(encoding="utf-8") for path in (plain, written))
    assert blank(before) == blank(after)
    patterns = {match_joint(old): match_joint(new) for old, new in names.items()}
    trees = [[*ast.walk(ast.parse(text))] for text in (before, after)]
    for was, now in zip(*trees, strict=True):
        if isinstance(was, ast.Constant):
            assert now.value == patterns.get(was.value, rename(was.value, names))


def near(name: str) -> Iterator[str]:
    """Names that differ from this one in a character."""
    for at in range(min(len(name), 40)):
        yield from (name[:at] + other + name[at + 1 :] for other in ("", "x", "\n", name[at].swapcase()))
    yield from (name + end for end in ("x", "\n", " ", "$", "_"))
    yield from (start + name for start in ("x", " ", "^"))


def judge_xml(plain: Path, written: Path, names: dict[str, str]) -> None:
    before, after = (list(ET.fromstring(path.read_bytes()).iter()) for path in (plain, written))
    assert [element.tag for element in before] == [element.tag for element in after]
    for was, now in zip(before, after, strict=True):
        assert now.attrib.keys() == was.attrib.keys()
        pairs = [*((was.attrib[key], value) for key, value in now.attrib.items()), (was.text or "", now.text or "")]
        for old, new in pairs:  # a name that another one has gets an underscore
            assert new.strip() in (rename(old, names).strip(), rename(old, names).strip() + "_")
    if written.suffix != ".sdf":  # MuJoCo reads no SDFormat; `read_sdf` did
        model = mujoco.MjSpec.from_string(written.read_text(encoding="utf-8")).compile()
        assert [model.joint(joint).name for joint in range(model.njnt)] == list(names.values())


def judge_json(plain: Path, written: Path, names: dict[str, str]) -> None:
    assert json.loads(written.read_text()) == rename(json.loads(plain.read_text()), names)


def judge_arrays(plain: Path, written: Path, names: dict[str, str]) -> None:
    with np.load(plain, allow_pickle=False) as before, np.load(written, allow_pickle=False) as after:
        assert [*before["joints"]] == [*names] and [*after["joints"]] == [*names.values()]
        assert sorted(before) == sorted(after)


def judge_graph(plain: Path, written: Path, names: dict[str, str]) -> None:
    if written.suffix == ".onnx":
        import onnx

        facts = {fact.key: fact.value for fact in onnx.load(written).metadata_props}
    else:
        extra = {"frictionzoo.json": ""}
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", r"`torch\.jit", DeprecationWarning)
            torch.jit.load(written, _extra_files=extra)
        facts = json.loads(extra["frictionzoo.json"])
    assert json.loads(facts["joints"]) == [*names.values()]


def judge_header(plain: Path, written: Path, names: dict[str, str]) -> None:
    """Names are string literals in one line; every other line is the harmless file's."""
    pairs = list(zip(plain.read_text().splitlines(), written.read_text().splitlines(), strict=True))
    ((_, line),) = [(before, after) for before, after in pairs if before != after]
    literals = re.findall(r'"((?:[^"\\]|\\[0-7]{3})*)"', line.partition("{")[2])
    read = [re.sub(r"\\([0-7]{3})", lambda byte: chr(int(byte[1], 8)), text).encode("latin1") for text in literals]
    assert [name.decode() for name in read] == [*names.values()]


def judge_same(plain: Path, written: Path, names: dict[str, str]) -> None:
    """The file has names of another file only."""
    assert plain.read_bytes() == written.read_bytes() and not any(name in plain.read_text() for name in names)


JUDGES: dict[str, Callable[[Path, Path, dict[str, str]], None]] = {
    ".py": judge_python,
    **dict.fromkeys((".xml", ".urdf", ".sdf"), judge_xml),
    ".json": judge_json,
    ".h": judge_header,
    ".npz": judge_arrays,
    ".usda": judge_same,
    **dict.fromkeys((".onnx", ".pt"), judge_graph),
}


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """What a target writes of harmless names."""
    return functools.cache(lambda target: write(target, tmp_path_factory.mktemp(target), PLAIN))


def judge(target: str, plain: Path, folder: Path, names: Sequence[str]) -> None:
    """A target has refused names that its format lacks, in a line, or differs from the harmless file in them alone."""
    try:
        written = write(target, folder, names)
    except ExportError as error:
        assert any(map(REFUSED[target], names)), error
        assert str(error).isprintable()
        return
    expected = {str(path.relative_to(plain)): path for path in _list_files(plain)}
    instead = dict(zip(PLAIN, names, strict=True))
    quoted = {old: quote(new, safe="") for old, new in instead.items()}
    renamed = {rename(name, quoted): path for name, path in expected.items()}
    assert {str(path.relative_to(written)) for path in _list_files(written)} == renamed.keys()
    for name, path in renamed.items():
        assert path.suffix in JUDGES, f"add a function to JUDGES that reads names in {path.suffix} files"
        JUDGES[path.suffix](path, written / name, instead)


def lacks_sdf(name: str) -> bool:
    """Whether SDFormat has no such name."""
    outer = name != name.strip() or any(blank in name for blank in "\t\r\n")
    return outer or name == "world" or "::" in name or (name[:2] == name[-2:] == "__")


REFUSED = {"sdf": lacks_sdf, "bam": lambda name: len(name) > 60}  # names that a format lacks
CHEAP = [target for target in TARGETS if target not in SLOW]


@pytest.mark.parametrize("target", slow_but(CHEAP, TARGETS))
def test_a_target_writes_names_as_data(target, plain, tmp_path_factory):
    for names in HOSTILE[:2]:
        judge(target, plain(target), tmp_path_factory.mktemp(target), names)


@pytest.mark.slow
@pytest.mark.parametrize("target", CHEAP)
def test_a_target_writes_any_name_as_data(target, plain, tmp_path_factory):
    @settings(EXAMPLES, max_examples=12)
    @given(TWO_NAMES)
    def writes(names: tuple[str, str]) -> None:
        judge(target, plain(target), tmp_path_factory.mktemp(target), names)

    for names in HOSTILE[2:]:
        writes = example(names)(writes)
    writes()


@EXAMPLES
@given(
    st.one_of(NAME, st.text(), st.lists(NAME), st.tuples(st.text(), st.floats(allow_nan=False, allow_infinity=False)))
)
def test_a_literal_is_the_value_on_one_line(value: Any) -> None:
    text = write_literal(value)
    assert ast.literal_eval(text) == value and "\n" not in text and "\r" not in text


def test_literals_are_as_a_programmer_writes_them() -> None:
    assert write_literal("knee") == '"knee"' and write_literal('a"b') == "'a\"b'" and write_literal("it's") == '"it\'s"'
    assert write_literal(("knee",)) == '("knee",)' and write_literal({"a": [1, 0.5]}) == '{"a": [1, 0.5]}'
    assert write_literal(np.float64(0.1)) == "0.1" and write_literal(Code("np.pi")) == "np.pi"


@EXAMPLES
@given(NAME, NAME)
def test_a_regular_expression_matches_one_joint(name: str, other: str) -> None:
    assert [each for each in {name, other, *near(name)} if re.fullmatch(match_joint(name), each)] == [name]


@EXAMPLES
@given(st.one_of(NAME, st.text()))
def test_xml_holds_a_name_or_refuses_it_in_a_line(name: str) -> None:
    root = ET.Element("a", name=name)
    root.append(write_comment(name))
    ET.SubElement(root, "b")
    if re.fullmatch("[\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]*", name):
        read = ET.fromstring(write_xml(root))
        assert read.attrib == {"name": name} and [part.tag for part in read] == ["b"]
    else:
        with pytest.raises(ExportError) as refused:
            write_xml(root)
        assert str(refused.value).isprintable()


@EXAMPLES
@given(NAME)
def test_an_attribute_is_set_where_it_is(name: str) -> None:
    root = ET.Element("a")
    ET.SubElement(root, "b", name=name, armature="1")
    file = InPlace.read(ET.tostring(root))
    file.set(file.tags[1], {"armature": "2", "damping": name})
    file.remark(name)
    read = ET.fromstring(file.write())
    assert read[0].attrib == {"name": name, "armature": "2", "damping": name} and len(read) == 1


@EXAMPLES
@given(st.lists(st.one_of(NAME, st.text()), min_size=1, max_size=3))
def test_yaml_and_tables_hold_names(names: list[str]) -> None:
    assert yaml.safe_load(f"joint_names: {write_yaml(names)}\nlast: 1\n") == {"joint_names": names, "last": 1}
    text = table(names, np.zeros(2), {"qpos": np.zeros((2, len(names)))}).decode()
    headers = [f"qpos_{name}" for name in names] if len(names) > 1 else ["qpos"]
    assert next(csv.reader(io.StringIO(text, newline=""))) == ["time", *headers]


def test_a_law_s_name_is_data_in_a_module(tmp_path: Path) -> None:
    drive, more = make_drive(tmp_path / "robot.xml", PLAIN), {"example_install": "", "late_remark": ""}
    texts = []
    for name in ("mujoco_default", '"""\nimport os; os.abort()\n"""'):
        drive.model.name = name  # pyright: ignore[reportAttributeAccessIssue] - of the class
        for template in ("mujoco_drive.py.jinja", "mjx_drive.py.jinja"):
            write_module(drive, tmp_path, template, "drive.py", **more)
            texts.append((tmp_path / "drive.py").read_text())
    for plain, written in zip(texts[:2], texts[2:], strict=True):
        assert blank(plain) == blank(written)


@pytest.mark.parametrize("names", [("knee", "knee_friction"), *HOSTILE[:4]])
def test_bristles_of_joints_have_names_of_their_own(names: tuple[str, str], tmp_path: Path) -> None:
    model = mujoco.MjModel.from_xml_string(write_native(make_drive(tmp_path / "robot.xml", names, law=Dahl)))
    assert [model.joint(joint).name for joint in range(2)] == list(names)
    assert len({model.actuator(actuator).name for actuator in range(model.nactuator)}) == 4


def rename_knee(drive: Identified, path: Path, name: str) -> Identified:
    """A run's drive with another name of its joint, of its data and in its own file."""
    root = ET.fromstring(drive.bench.template())
    for joint in root.iter("joint"):
        joint.set("name", name)
    path.write_bytes(ET.tostring(root))
    settings = drive.result.settings
    section = {**settings["bench"], "mjcf": str(path), "joint": name}
    content = json.loads(json.dumps(to_json(drive.result)).replace('"knee"', json.dumps(name)))
    result = msgspec.convert(content | {"settings": {**settings, "bench": section}}, Result)
    return replace(drive, bench=build(section), result=result)


CARDS = ["/leg/knee", "a|b`c <i>\n## x"]


@pytest.mark.parametrize("name", slow_but(CARDS, [*CARDS, r"C:\x", "~/a", f"{Path.home()}/knee", "${oc.env:HOME}"]))
def test_a_card_keeps_names_and_shortens_paths(name, finished_run, recording, tmp_path):
    run, _ = finished_run("mujoco_default")
    drive = rename_knee(fz.load(run), tmp_path / "robot.xml", name)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FittedDrive, "load", lambda folder: drive)
        place, told = write_card(run, {"licence": "cc-by-4.0", "output": str(tmp_path / "card")})
    read = fz.load(place)
    assert read.bench.joints == (name,) and read.result["joints"] == [name] and told == []
    assert [row["name"] for row in read.result["parameters"][0]["by_joint"]] == [name]
    text = (place / "result.json").read_text() + (place / "README.md").read_text()
    for private in (str(recording.parent), str(run), str(tmp_path)):
        assert private not in text
    lines = (place / "README.md").read_text().splitlines()
    rows = [line for line in lines if line.startswith("|")]
    assert not any("<i>" in line or line.startswith("## x") for line in lines)
    assert {len(re.findall(r"(?<!\\\\)\|", row)) for row in rows} == {3, 5, 6}
