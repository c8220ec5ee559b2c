"""The documentation site: built without warnings, complete, and without anything from the network."""

import ast
import importlib
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from conftest import changed
from helpers.pages import ROOT
from omegaconf import OmegaConf

import frictionzoo as fz
from frictionzoo.core.config import CONF_DIR
from frictionzoo.core.registry import KINDS
from frictionzoo.result.verdict import PLACES

pytest.importorskip("mkdocs", reason="the extra docs is not installed")  # CI installs it and runs this file

INNER = {"cache", "dry_friction", "linear", "tree", "groups", "fold", "robot_file", "run", "__main__"}  # no interfaces
COMMENTED = """# The head.
_target_: a.B

# What it is,
# in two lines.
outer: # and a third
  inner: ${mul:2,${x}} # 1 | 2
  flow: { low: 1, high: '#2' } # [N m]
  list:
    - a
    - b
"""


def load(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(ROOT / "docs")
    return importlib.import_module(name)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    finished = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert finished.returncode == 0, finished.stderr
    return folder


def test_no_page_loads_anything_from_the_network(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 20
    for page in [*pages, *site.rglob("*.css")]:
        loaded = re.findall(r"<(?:script|link|img|iframe)\b[^>]*?\b(?:src|href)=\"?([^\s\">]+)", page.read_text())
        loaded += re.findall(r"(?:url\(|@import )[\"']?([^\s\"')]+)", page.read_text())
        assert not [address for address in loaded if re.match(r"(https?:)?//", address)], page


def test_a_link_between_pages_leads_to_a_place_on_the_site(site: Path) -> None:
    pages = {page.resolve(): page.read_text() for page in site.rglob("*.html")}
    places = {page: {*re.findall(r'id="?([^\s">]+)["\s>]', text)} for page, text in pages.items()}
    followed = 0
    for page, text in pages.items():
        for target, anchor in re.findall(r'<a\b[^>]*?\bhref="?([^\s":>#]*)(?:#([^\s">]+))?', text):
            other = (page.parent / target).resolve() if target else page
            if page.name != "404.html" and other.suffix == ".html":
                assert other in pages, (page, target)
                assert not anchor or anchor in places[other], (page, anchor)
                followed += 1
    assert followed > 100


def test_the_readme_is_the_front_page_and_leads_every_reader_to_a_tutorial(site: Path) -> None:
    front, data, sets = ((site / f"{name}.html").read_text() for name in ("index", "data", "datasets"))
    assert "<code>FRICTIONZOO_DATA</code>" in front and "README.md" not in front and "Identify a drive" in data
    assert 'href="data.html"' in front and 'href="CONTRIBUTING.html"' in front and (site / "landing.svg").exists()
    assert 'href="experiments/emps/index.html"' in sets and 'href="notebooks/quickstart.html"' in data
    linked = re.findall(r'href="?tutorials/(\w+)\.html', front.partition("<article")[2].partition("</article>")[0])
    assert {*linked} == {path.stem for path in (ROOT / "docs" / "tutorials").glob("*.md")} and len({*linked}) >= 5


def test_the_picture_shows_a_run(finished_run: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    picture, fit = load("draw_landing", monkeypatch), fz.load(finished_run("mujoco_default")[0])
    simulated = changed(fit.result, data={"origin": "simulated"})
    position, error = picture.draw(replace(fit, result=simulated)).axes
    measured, without, found = (line.get_ydata() for line in position.lines)
    assert np.array_equal(measured, fit.curves.measured_qpos[0, 1 :: picture.EVERY, 0])
    assert np.array_equal(found, fit.curves.qpos[0, :: picture.EVERY, 0])
    for line, states in zip(error.lines[1:], (without, found), strict=True):
        np.testing.assert_allclose(line.get_ydata(), 1e3 * (states - measured), atol=1e-9)
    drawn = picture.PICTURE.read_text()
    assert len(drawn) < 150_000 and "<image" not in drawn and "fill: #ffffff" in drawn  # legible on any page


EQUATIONS = {
    "c dz/dt - F w / sqrt(w^2)": r"c\,\frac{\mathrm{d}z}{\mathrm{d}t} - \frac{F\,w}{\sqrt{w^{2}}}",
    "|F_+| <= (a + b) / (2 c) |v|": r"\left| F_{+} \right| \le \frac{a + b}{2\,c}\,\left| v \right|",
    "(a) (b) / 2,  t_long^sign(v)": r"\frac{\left( a \right)\,\left( b \right)}{2} ,\  \quad "
    r"t_{\text{long}}^{\operatorname{sign}\left( v \right)}",
    "f'(x) = damping v for v > 0": r"f'\left( x \right) = \text{damping}\ v\ \text{for}\ v > 0",
}


def test_an_equation_in_plain_text_is_typeset_and_half_a_one_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    to_fences = load("equations", monkeypatch).to_fences
    for text, latex in EQUATIONS.items():
        assert to_fences(text) == f"```math\n{latex}\n```"
    for half in ("(a", "a)", "|a", "a /", "x^"):
        with pytest.raises(ValueError, match="in '"):
            to_fences(half)


def test_the_equations_of_all_laws_are_typeset_on_the_site(site: Path) -> None:
    page = (site / "models.html").read_text()
    equations = re.findall(r'<div class="?equation"?>(.*?)</div>', page, re.S)
    assert len(equations) >= len(KINDS["models"].own()) and all(one.startswith("<math") for one in equations)
    for equation in equations:
        assert "\\" not in equation and "merror" not in equation, equation


def test_every_module_that_is_an_interface_is_in_the_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    hooks = load("hooks", monkeypatch)
    pages = [hooks.add_plug_ins(page.read_text()) for page in (ROOT / "docs" / "api").glob("*.md")]
    named = {name for page in pages for name in re.findall(r"^::: (\S+)$", page, re.M)}
    for path in (ROOT / "frictionzoo").rglob("*.py"):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        body = ast.parse(path.read_text()).body
        names = [node.name for node in body if isinstance(node, ast.FunctionDef | ast.ClassDef)]
        if INNER.isdisjoint(module.split(".")) and any(not name.startswith("__") for name in names):
            assert module in named, f"add ::: {module} to a page of docs/api/"


def leaves(node: dict, prefix: str) -> set[str]:
    inner = [leaves(v, f"{prefix}{k}.") if isinstance(v, dict) and v else {f"{prefix}{k}"} for k, v in node.items()]
    return set().union(*inner)


def options_of(path: Path) -> set[str]:
    """Every option of a file of conf/, as OmegaConf reads it."""
    content = OmegaConf.to_container(OmegaConf.load(path), resolve=False)
    content.pop("defaults", None)
    package = re.search(r"# @package (\S+)", path.read_text())
    prefix = package[1] if package else path.parent.relative_to(CONF_DIR).as_posix().replace("/", ".")
    return leaves(content, "" if prefix in (".", "_global_") else f"{prefix}.")


def test_every_option_is_on_the_page_of_the_configuration(monkeypatch: pytest.MonkeyPatch) -> None:
    configuration = load("configuration", monkeypatch)
    page = configuration.render(CONF_DIR)
    for path in CONF_DIR.rglob("*.yaml"):
        rows = configuration.read_rows(path, path.parent.relative_to(CONF_DIR).as_posix())
        assert options_of(path) <= {row.option for row in rows}, path
        assert all(f"| `{row.option}` |" in page for row in rows), path


def test_an_option_has_its_value_and_its_comment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "fit.yaml").write_text(COMMENTED)
    configuration = load("configuration", monkeypatch)
    assert configuration.read_rows(tmp_path / "fit.yaml", "group/sub") == [
        ("group.sub._target_", "a.B", ""),
        ("group.sub.outer", "", "What it is, in two lines. and a third"),
        ("group.sub.outer.inner", "${mul:2,${x}}", "1 | 2"),
        ("group.sub.outer.flow", "", "[N m]"),
        ("group.sub.outer.flow.low", "1", ""),
        ("group.sub.outer.flow.high", "'#2'", ""),
        ("group.sub.outer.list", "- a - b", ""),
    ]
    page = configuration.render(tmp_path)
    assert "The head.\n" in page
    assert "| `outer.inner` | `${mul:2,${x}}` | 1 \\| 2 |" in page


def test_the_page_of_findings_has_each_residual_factor() -> None:
    page = (ROOT / "docs" / "findings.md").read_text()
    assert not [text for text in PLACES.values() if text not in page]
