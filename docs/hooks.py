"""What MkDocs does besides: pages from files outside docs/, README's sections on them, and links between all of these.

A text exists once. Files outside docs/ become pages under their own path; the notebook and the configuration become
Markdown. A line of a page in docs/ that is nothing but a link to a section of README.md is replaced by that section,
so that it leads there in the repository and is there on the site. In place of `<!-- plug-ins: KIND -->` come the
modules that hold this package's plug-ins of that kind.
"""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from posixpath import dirname, join, normpath, relpath

import configuration
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from frictionzoo.core.registry import KINDS

ROOT = Path(__file__).parent.parent
PAGES = ("CONTRIBUTING.md", "CHANGELOG.md", "experiments/*/README.md", "benchmarks/README.md")
COPIED = ("LICENSE", "notebooks/*.ipynb")
FENCED = re.compile(r"(^```.*?^```$)", re.M | re.S)
SECTION = re.compile(r"^\[[^\]]*\]\(\.\./README\.md(?:#([\w-]+))?\)$", re.M)
PLUG_INS = re.compile(r"^<!-- plug-ins: (\w+) -->$", re.M)
LINK = re.compile(r"(?<=\]\()([^()\s:#]*)(?:#([\w-]+))?(?=\))")  # to another place of the project


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what lies outside docs/."""
    for path in _find(*PAGES):
        files.append(File.generated(config, path, content=(ROOT / path).read_text()))
    for path in _find(*COPIED):
        files.append(File.generated(config, path, abs_src_path=str(ROOT / path)))
    for path in _find("notebooks/*.ipynb"):
        files.append(File.generated(config, _page_of(path), content=_read_notebook(ROOT / path)))
    files.append(File.generated(config, "configuration.md", content=configuration.render(ROOT / "conf")))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Put README's sections in their places, and turn the repository's links into the site's."""
    here = page.file.src_uri
    notebook = f"{here.removesuffix('.md')}.ipynb"
    source = next((path for path in (here, notebook) if (ROOT / path).exists()), f"docs/{here}")

    def include(match: re.Match[str]) -> str:
        return LINK.sub(lambda link: _as_link(*_target(link, "README.md"), source), read_section(match[1] or ""))

    def turn(link: re.Match[str]) -> str:
        path, anchor = _target(link, source)
        return _as_link(_page_of(path, anchor), anchor, here)

    return LINK.sub(turn, SECTION.sub(include, add_plug_ins(markdown)))


def add_plug_ins(markdown: str) -> str:
    """A page of the reference with the modules of its plug-ins."""

    def modules(match: re.Match[str]) -> str:
        return "\n\n".join(f"::: {module}" for module in sorted({one.module for one in KINDS[match[1]].own().values()}))

    return PLUG_INS.sub(modules, markdown)


def read_section(anchor: str) -> str:
    """A section of README.md, from its heading up to the next one; for "", what stands before the first.

    Args:
        anchor: The heading as in a link to it.

    Raises:
        PluginError: There is none.
    """
    sections = read_sections()
    if anchor not in sections:
        raise PluginError(f"README.md#{anchor}: no such section, expected one of {', '.join(sections)}; mend the link")
    return sections[anchor]


def read_sections() -> dict[str, str]:
    """README.md by anchors of its headings of the second level; "" is what stands before the first."""
    blocks = FENCED.split((ROOT / "README.md").read_text())
    blocks[::2] = [re.sub("^## ", "\0## ", block, flags=re.M) for block in blocks[::2]]
    first, *others = "".join(blocks).split("\0")
    return {"": first} | {_slug(section.partition("\n")[0]): section for section in others}


def find_section(anchor: str) -> str | None:
    """The page in docs/ that holds this section of README.md."""
    pages = ((path.name, SECTION.finditer(path.read_text())) for path in sorted((ROOT / "docs").glob("*.md")))
    return next((name for name, found in pages if any((match[1] or "") == anchor for match in found)), None)


def _slug(heading: str) -> str:
    return re.sub(r"[^\w-]", "", heading.removeprefix("## ").strip().lower().replace(" ", "-"))


def _find(*patterns: str) -> Iterator[str]:
    """Paths from the root, as in a link."""
    return (path.relative_to(ROOT).as_posix() for pattern in patterns for path in sorted(ROOT.glob(pattern)))


def _target(link: re.Match[str], source: str) -> tuple[str, str]:
    """Where a link in the file `source` leads: a path from the root, and an anchor."""
    path, anchor = link[1], link[2] or ""
    return normpath(join(dirname(source), path)) if path else source, anchor


def _as_link(path: str, anchor: str, source: str) -> str:
    return relpath(path, dirname(source) or ".") + (f"#{anchor}" if anchor else "")


def _page_of(path: str, anchor: str = "") -> str:
    """What the site calls a file of the repository."""
    if path == "README.md":
        return find_section(anchor) or "index.md"
    if path.partition("/")[0] == "conf":
        return "configuration.md"
    return f"{path.removesuffix('.ipynb')}.md" if path.endswith(".ipynb") else path.removeprefix("docs/")


def _read_notebook(path: Path) -> str:
    """The cells of a notebook as Markdown, and where to get the notebook itself."""
    cells = json.loads(path.read_text())["cells"]
    texts = [(cell["cell_type"], "".join(cell["source"])) for cell in cells]
    parts = [text if kind == "markdown" else f"```python\n{text}\n```" for kind, text in texts]
    # HTML, because a Markdown link to the notebook would lead to this page.
    return "\n\n".join([*parts, f'<a href="{path.name}" download>{path.name}</a> is this page as a notebook.'])
