"""The documentation site: built without warnings, complete, and without anything from the network."""

import ast
import importlib
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
from omegaconf import OmegaConf
from pages import ROOT

from frictionzoo.core.config import CONF_DIR

pytest.importorskip("mkdocs", reason="the extra docs is not installed")  # CI installs it and runs this file

INNER = {"cache", "dry_friction", "linear", "fold", "run", "__main__"}  # modules and folders that are no interface
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
    """A script of docs/."""
    monkeypatch.syspath_prepend(ROOT / "docs")
    return importlib.import_module(name)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site."""
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
    followed = 0
    for page in site.rglob("*.html"):
        for target, anchor in re.findall(r'<a\b[^>]*?\bhref="?([^\s":>#]*)(?:#([^\s">]+))?', page.read_text()):
            other = (page.parent / target) if target else page
            if page.name != "404.html" and other.suffix == ".html":
                assert other.exists(), (page, target)
                assert not anchor or re.search(rf'id="?{re.escape(anchor)}["\s>]', other.read_text()), (page, anchor)
                followed += 1
    assert followed > 100


def test_every_section_of_the_readme_has_a_page(monkeypatch: pytest.MonkeyPatch) -> None:
    hooks = load("hooks", monkeypatch)
    homeless = [anchor for anchor in hooks.read_sections() if hooks.find_section(anchor) is None]
    assert not homeless, "add a line with nothing but a link to the section to a page in docs/"


def test_a_section_that_does_not_exist_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    from mkdocs.exceptions import PluginError

    with pytest.raises(PluginError, match=r"README\.md#nowhere: no such section, expected one of .*data"):
        load("hooks", monkeypatch).read_section("nowhere")


def test_a_text_of_the_readme_is_on_its_page_with_links_of_the_site(site: Path) -> None:
    text = (site / "data.html").read_text()
    assert "Your own recording." in text and "../README.md" not in text
    assert 'href="experiments/emps/index.html"' in text and 'href="notebooks/quickstart.html"' in text
    assert "<code>FRICTIONZOO_DATA</code>" in (site / "index.html").read_text()


def test_every_module_that_is_an_interface_is_in_the_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    hooks = load("hooks", monkeypatch)
    pages = [hooks.add_plug_ins(page.read_text()) for page in (ROOT / "docs" / "api").glob("*.md")]
    named = {name for page in pages for name in re.findall(r"^::: (\S+)$", page, re.M)}
    for path in (ROOT / "frictionzoo").rglob("*.py"):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        defined = [
            node for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef | ast.ClassDef)
        ]
        inner = not INNER.isdisjoint(module.split("."))
        if any(not node.name.startswith("__") for node in defined) and not inner:
            assert module in named, f"add ::: {module} to a page of docs/api/"


def options_of(path: Path) -> set[str]:
    """Every option of a file of conf/, as OmegaConf reads it."""

    def leaves(node: dict, prefix: str) -> set[str]:
        inner = [leaves(v, f"{prefix}{k}.") if isinstance(v, dict) and v else {f"{prefix}{k}"} for k, v in node.items()]
        return set().union(*inner)

    content = OmegaConf.to_container(OmegaConf.load(path), resolve=False)
    content.pop("defaults", None)
    group = path.parent.relative_to(CONF_DIR).as_posix().replace("/", ".")
    package = re.search(r"# @package (\S+)", path.read_text())
    prefix = package[1] if package else group
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
