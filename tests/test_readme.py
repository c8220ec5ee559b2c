"""What the documentation tells a newcomer to type: commands compose, options exist, pages agree with their source."""

import itertools
import re
import runpy
import shlex
import subprocess
import time
from collections.abc import Callable
from contextlib import nullcontext

import pytest
from conftest import Finished, check_each, ending_in_time
from helpers.composing import assert_composes
from helpers.pages import PACKAGE, PAGES, ROOT, blocks_of, commands_of
from omegaconf import OmegaConf

from frictionzoo.cli.commands import COMMANDS
from frictionzoo.core.config import CONF_DIR, compose_config, list_choices, list_options
from frictionzoo.core.declared import section_of
from frictionzoo.models import get_model, model_names

# Not jobs: other commands, completion of a shell's lines, and what a reader has to fill in, such as FOLDER.
START, OTHER = r"(?:python -m frictionzoo\.run|frictionzoo) ", re.compile(rf"({'|'.join(COMMANDS)}|-sc)\b|.*[A-Z]{{3}}")
JOBS = {
    job[1]: page
    for page in PAGES
    if page.parent != PACKAGE
    for command in commands_of(page)
    for job in map(re.compile(rf"{START}(.+)").fullmatch, map(str.strip, command.split("&&")))
    if job and not OTHER.match(job[1])
}


def test_a_command_composes():
    check_each(lambda job, page: assert_composes(shlex.split(job)), JOBS.items())
    assert len(JOBS) >= 15 and "README.md" in {page.name for page in JOBS.values()}  # the pattern still finds them


def test_a_named_option_exists():
    """Options in inline code that are followed by a value, `segments.length=5`, and their sections exist."""
    known = set()
    for name in model_names():
        for key, _ in list_options(section_of(get_model(name)), "model."):
            known |= set(itertools.accumulate(key.split("."), "{}.{}".format))
    for path in CONF_DIR.glob("**/*.yaml"):
        package = re.match(r"# @package (\S+)", path.read_text())
        own = package[1] if package else path.parent.name
        file = OmegaConf.to_container(OmegaConf.load(path))
        for key, _ in list_options(file, "" if own == "_global_" or path.parent == CONF_DIR else f"{own}."):
            known |= set(itertools.accumulate(key.split("."), "{}.{}".format))
    for page in PAGES:
        named = set(re.findall(r"`([a-z_]+(?:\.[a-z_]+)+)=[^`]*`", page.read_text()))
        assert not [option for option in named - known if not option.startswith("hydra.")], page


def test_a_page_lists_every_choice():
    for group, page in (("data", "datasets"), ("logger", "output"), ("fit", "fits"), ("experiment", "experiments")):
        listed = {*re.findall(r"(?<=[`\[])\w+(?=[`\]])", (ROOT / "docs" / f"{page}.md").read_text())}
        assert {path.stem for path in (CONF_DIR / group).glob("*.yaml")} <= listed


def test_a_link_inside_the_project_leads_somewhere():
    for page in PAGES:
        links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text())
        assert not [link for link in links if not (page.parent / link).exists()], page


def test_ci_runs_the_first_blocks_of_the_readme_as_they_stand():
    def show(number):
        return subprocess.run([ROOT / ".ci" / "readme_command", str(number)], capture_output=True, text=True)

    first, second = blocks_of(ROOT / "README.md")[:2]
    assert first.endswith("python -m frictionzoo.run data=twin_clean model=coulomb_stribeck")
    assert '".[test]"' in second and "pytest" in second
    ci = (ROOT / ".ci" / "run").read_text()
    assert '.ci/readme_command "$1"' in ci
    for number, block in enumerate((first, second), 1):
        assert show(number).stdout.strip() == block and f"\nrun_readme_command {number}\n" in ci
    assert show(99).returncode == 1 and "no bash block number 99" in show(99).stderr


@pytest.mark.slow
@pytest.mark.usefixtures("unrendered")
def test_the_first_run_gives_the_table_of_the_readme(call: Callable[..., Finished]):
    """Rounding differs between machines. The hidden drive, as in the data's configuration, is within each interval."""
    options = blocks_of(ROOT / "README.md")[0].rpartition("frictionzoo.run ")[2].split()
    drive, finished = compose_config(*options).data.drive, call(*options)
    table = r"^\| `\w+\.(\w+)` \| (\S+) \| (\S+) to (\S+) \| (\S+) "
    rows = re.findall(table, (ROOT / "README.md").read_text(), re.M)
    printed = re.findall(r"^\w+\.(\w+) +(\S+) +(\S+) to (\S+) .* identified$", finished.out, re.M)
    assert len(rows) == 5 and "verdict: no problems found" in finished.out
    for (name, *stated, hidden), (other, *numbers) in zip(rows, printed, strict=True):
        (value, low, high), truth = map(float, stated), float(hidden)
        assert name == other and [value, low, high] == pytest.approx([*map(float, numbers)], rel=5e-3)
        assert truth == drive[{"kinetic_torque": "coulomb_torque"}.get(name, name)] and low <= truth <= high


def test_tests_end_in_time_where_a_time_is_set(monkeypatch: pytest.MonkeyPatch):
    """One that would begin later is skipped, and one that has begun by then."""
    for until, seconds in ((None, 0.0), ("1e9", 0.0), (str(time.time() + 0.2), 10.0)):
        with monkeypatch.context() as patch:
            patch.setenv("TESTS_UNTIL", until) if until else patch.delenv("TESTS_UNTIL", raising=False)
            expected = pytest.raises(pytest.skip.Exception, match="run `make slow`") if until else nullcontext()
            with expected, ending_in_time():
                time.sleep(seconds)


def test_what_make_docs_writes_is_up_to_date(monkeypatch: pytest.MonkeyPatch):
    """The schemas of JSON files from their types, their pages from the schemas, pages of plug-ins from docstrings."""
    monkeypatch.syspath_prepend(docs := ROOT / "docs")
    schema, result, plugins = (runpy.run_path(f"{docs}/write_{name}.py") for name in ("schema", "result", "plugins"))
    schemas = {path.name.removesuffix(".schema.json") for path in (ROOT / "frictionzoo").rglob("*.schema.json")}
    assert schemas == {*result["SCHEMAS"]}
    find, make, lay_out = (schema[name] for name in ("find_path", "make_schema", "lay_out"))
    pages = {docs / f"{name}.md": render for name, render in plugins["PAGES"].items()}
    made = {find(name): lay_out(make(name)) + "\n" for name in schema["TYPES"]}
    made |= {docs / f"{name}.md": result["render"](name) for name in schemas}
    made |= {page: render(page.read_text()) for page, render in pages.items()}
    assert not [path for path, text in made.items() if path.read_text() != text], "run `make docs`"


def test_the_page_of_models_has_a_row_and_a_section_for_each():
    text = (ROOT / "docs" / "models.md").read_text()
    rows, headings = (re.findall(pattern, text, re.M) for pattern in (r"^\| \[`(\w+)`\]", r"^## `(\w+)`$"))
    assert rows == headings == list_choices("model")


def test_constraints_are_exact_and_cover_what_the_project_asks_for():
    pins = dict(re.findall(r"^([\w.-]+)==(\S+)$", (ROOT / "constraints.txt").read_text(), re.M))
    names = {name.lower().replace("_", "-") for name in pins}
    assert not [version for version in pins.values() if "+" in version]  # a local build is not on PyPI
    project = (ROOT / "pyproject.toml").read_text().split("[project.scripts]")[0]
    asked = {name.lower() for name in re.findall(r'"([A-Za-z][\w-]*)[<>=~][^"]*"', project)}
    assert len(asked) > 20 and asked - {"hatchling"} <= names
