"""MkDocs hooks: pages from files outside docs/, and links converted for the site.

Each text exists once. README.md is the front page. Other files outside docs/ become pages under the same path; the
notebooks and the configuration become Markdown. `<!-- plug-ins: KIND -->` is replaced with the modules of this
package's plug-ins of that kind. LaTeX equations become MathML.
"""

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from posixpath import dirname, join, normpath, relpath
from typing import Any

import configuration
from latex2mathml import converter
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from frictionzoo.core.registry import KINDS

ROOT = Path(__file__).parent.parent
FRONT = "index.md"
PAGES = ("CONTRIBUTING.md", "CHANGELOG.md", "experiments/*/README.md", "benchmarks/README.md")
COPIED = ("LICENSE", "notebooks/*.ipynb")
EQUATION = re.compile(r"^```math\n(.*?)\n```$", re.M | re.S)
PLUG_INS = re.compile(r"^<!-- plug-ins: (\w+) -->$", re.M)
LINK = re.compile(r"(?<=\]\()([^()\s:#]*)(?:#([\w-]+))?(?=\))")  # to another file or section of the project


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the files outside docs/."""
    for path in _find(*PAGES):
        files.append(File.generated(config, path, content=(ROOT / path).read_text()))
    for path in _find(*COPIED):
        files.append(File.generated(config, path, abs_src_path=str(ROOT / path)))
    for path in _find("notebooks/*.ipynb"):
        files.append(File.generated(config, _page_of(path), content=_read_notebook(ROOT / path)))
    files.append(File.generated(config, FRONT, content=(ROOT / "README.md").read_text()))
    files.append(File.generated(config, "configuration.md", content=configuration.render(ROOT / "conf")))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Convert repository links to site links, add plug-ins and typeset equations."""
    here = page.file.src_uri
    notebook = f"{here.removesuffix('.md')}.ipynb"
    written = next((path for path in (here, notebook) if (ROOT / path).exists()), f"docs/{here}")
    source = "README.md" if here == FRONT else written

    def turn(link: re.Match[str]) -> str:
        path = normpath(join(dirname(source), link[1])) if link[1] else source
        return relpath(_page_of(path), dirname(here) or ".") + (f"#{link[2]}" if link[2] else "")

    return typeset(LINK.sub(turn, add_plug_ins(markdown)))


def typeset(markdown: str) -> str:
    """Convert LaTeX blocks to MathML, which browsers display without scripts and external fonts."""
    return EQUATION.sub(
        lambda block: f'<div class="equation">{converter.convert(block[1], display="block")}</div>', markdown
    )


def add_plug_ins(markdown: str) -> str:
    """Insert the modules of the plug-ins into a page of the reference."""

    def modules(match: re.Match[str]) -> str:
        return "\n\n".join(f"::: {module}" for module in sorted({one.module for one in KINDS[match[1]].own().values()}))

    return PLUG_INS.sub(modules, markdown)


def _find(*patterns: str) -> Iterator[str]:
    """Yield paths relative to the root, as in a link."""
    return (path.relative_to(ROOT).as_posix() for pattern in patterns for path in sorted(ROOT.glob(pattern)))


def _page_of(path: str) -> str:
    """Return the path on the site of a file of the repository."""
    if path == "README.md":
        return FRONT
    if path.partition("/")[0] == "conf":
        return "configuration.md"
    return f"{path.removesuffix('.ipynb')}.md" if path.endswith(".ipynb") else path.removeprefix("docs/")


def _read_notebook(path: Path) -> str:
    """Return the cells of a notebook and their outputs as Markdown, with a link to the notebook file."""
    parts = []
    for cell in json.loads(path.read_text())["cells"]:
        text = "".join(cell["source"])
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
        parts.extend(map(_show_output, cell.get("outputs", [])))
    # HTML, because on_page_markdown would convert a Markdown link to this page.
    return "\n\n".join([*parts, f'<a href="{path.name}" download>{path.name}</a> is this page as a notebook.'])


def _show_output(output: Mapping[str, Any]) -> str:
    data = output.get("data", {})
    if "image/png" in data:
        return f'<img alt="figure" src="data:image/png;base64,{"".join(data["image/png"].split())}">'
    text = "".join(output.get("text") or data.get("text/plain", ""))
    return f"```text\n{text.rstrip()}\n```"
