"""What the documentation tells a newcomer to type: commands compose, options exist, pages agree with their source."""

import functools
import itertools
import re
import runpy
import shlex
import subprocess

import pytest
from conftest import check_each, pytest_runtest_setup
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from pages import PACKAGE, PAGES, ROOT, blocks_of, expand, inline_of

from frictionzoo.cli.commands import COMMANDS
from frictionzoo.core.config import CONF_DIR, check_overrides, compose_config, list_options

FLAGS = {"-m", "--cfg", "job", "--help"}
PLACEHOLDER = re.compile(r"[A-Z]{3}")  # FOLDER, NAME, DATE: what a reader has to fill in


def jobs_of(page):
    """The arguments of each command that starts a job, from bash blocks and from inline code."""
    commands = [
        part for text in [*blocks_of(page), *inline_of(page)] for line in text.splitlines() for part in line.split("&&")
    ]
    starts = ("python -m frictionzoo.run ", "frictionzoo ")
    others = (*(f"frictionzoo {name}" for name in COMMANDS), "frictionzoo -sc ")  # the last completes lines of shells
    for command in map(str.strip, commands):
        start = next((start for start in starts if command.startswith(start)), None)
        if start and not command.startswith(others):
            yield shlex.split(command.removeprefix(start))


def options_of(page):
    """Dotted names in inline code that are followed by a value: `segments.length=5`."""
    return set(re.findall(r"`([a-z_]+(?:\.[a-z_]+)+)=[^`]*`", page.read_text()))


JOBS = {
    shlex.join(job): page
    for page in PAGES
    if page.parent != PACKAGE
    for job in jobs_of(page)
    if not any(map(PLACEHOLDER.search, job))
}
compose_once = functools.cache(compose_config)  # pages share most of what they choose; nothing here changes it


def is_choice(override):
    """Whether it chooses a file, or tells Hydra itself something: that has to be composed."""
    name = override.partition("=")[0]
    return name.startswith("hydra") or (CONF_DIR / name).is_dir()


def assert_composes(job):
    """Every job that these arguments of a run stand for."""
    choices = [expand(argument) for argument in job if argument not in FLAGS]
    for values in filter(lambda values: is_choice(values[0]) and len(values) > 1, choices):
        assert all((CONF_DIR / "{}/{}.yaml".format(*value.split("="))).exists() for value in values)
        del values[1:]  # tests/test_config.py composes every file, and experiments with the laws that change them
    for index in range(max(map(len, choices), default=1)):
        overrides = [values[index % len(values)] for values in choices]
        plain = compose_once(*filter(is_choice, overrides))
        config = OmegaConf.create(OmegaConf.to_container(plain))
        for override in map(OverridesParser.create().parse_override, itertools.filterfalse(is_choice, overrides)):
            OmegaConf.update(config, override.key_or_group, override.value(), force_add=True)
        check_overrides(config, plain)


def test_a_command_composes():
    check_each(lambda job, page: assert_composes(shlex.split(job)), JOBS.items())
    assert len(JOBS) >= 15 and "README.md" in {page.name for page in JOBS.values()}  # the pattern still finds them


def test_a_named_option_exists():
    """In the files of conf/, an option or a section."""
    known = set()
    for path in CONF_DIR.glob("**/*.yaml"):
        package = re.match(r"# @package (\S+)", path.read_text())
        own = package[1] if package else path.parent.name
        file = OmegaConf.to_container(OmegaConf.load(path))
        for key, _ in list_options(file, "" if own == "_global_" or path.parent == CONF_DIR else f"{own}."):
            known |= set(itertools.accumulate(key.split("."), "{}.{}".format))
    named = [(str(page), option) for page in PAGES for option in options_of(page)]
    wrong = [each for each in named if each[1] not in known and not each[1].startswith("hydra.")]
    assert not wrong, wrong


@pytest.mark.parametrize("group, page", [("data", "data"), ("logger", "fits"), ("fit", "fits"), ("experiment", "run")])
def test_a_page_lists_every_choice(group, page):
    text = (ROOT / "docs" / f"{page}.md").read_text()
    for path in (CONF_DIR / group).glob("*.yaml"):
        assert re.search(rf"[`\[]{path.stem}[`\]]", text), path.stem


def test_a_link_inside_the_project_leads_somewhere():
    links = [(page, link) for page in PAGES for link in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text())]
    wrong = [(str(page), link) for page, link in links if not (page.parent / link).exists()]
    assert not wrong, wrong


@pytest.mark.parametrize("number", [1, 2])
def test_ci_runs_the_first_blocks_of_the_readme_as_they_stand(number):
    first, second = blocks_of(ROOT / "README.md")[:2]
    assert first.endswith("python -m frictionzoo.run model=coulomb_stribeck")
    assert '".[test]"' in second and "pytest" in second
    shown = subprocess.run([ROOT / ".ci" / "readme_command", str(number)], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == (first, second)[number - 1]
    ci = (ROOT / ".ci" / "run").read_text()
    assert '.ci/readme_command "$1"' in ci and f"run_readme_command {number}" in map(str.strip, ci.splitlines())


def test_a_missing_block_of_the_readme_stops_ci():
    shown = subprocess.run([ROOT / ".ci" / "readme_command", "99"], capture_output=True, text=True)
    assert shown.returncode == 1
    assert "no bash block number 99" in shown.stderr


def test_tests_end_in_time_where_a_time_is_set(monkeypatch: pytest.MonkeyPatch):
    pytest_runtest_setup()
    monkeypatch.setenv("TESTS_UNTIL", "1e9")
    with pytest.raises(pytest.skip.Exception, match="run `make slow`"):
        pytest_runtest_setup()


def test_the_schemas_of_json_files_are_made_from_their_types():
    script = runpy.run_path(str(ROOT / "docs" / "write_schema.py"))
    for name in script["TYPES"]:
        same = script["find_path"](name).read_text() == script["lay_out"](script["make_schema"](name)) + "\n"
        assert same, f"{name}.schema.json: run `make docs`"


def test_the_pages_of_json_files_are_made_from_their_schemas():
    script = runpy.run_path(str(ROOT / "docs" / "write_result.py"))
    schemas = {path.name.removesuffix(".schema.json") for path in (ROOT / "frictionzoo").rglob("*.schema.json")}
    assert schemas == set(script["SCHEMAS"])
    for name in script["SCHEMAS"]:
        assert (ROOT / "docs" / f"{name}.md").read_text() == script["render"](name), "run `make docs`"


def test_the_pages_of_plug_ins_are_made_from_their_docstrings(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(ROOT / "docs")
    for name, render in runpy.run_path(str(ROOT / "docs" / "write_plugins.py"))["PAGES"].items():
        text = (ROOT / "docs" / f"{name}.md").read_text()
        same = text == render(text)
        assert same, f"docs/{name}.md: run `make docs`"


def test_the_page_of_models_has_a_row_and_a_section_for_each():
    text = (ROOT / "docs" / "models.md").read_text()
    rows, headings = (re.findall(pattern, text, re.M) for pattern in (r"^\| \[`(\w+)`\]", r"^## `(\w+)`$"))
    names = sorted(path.stem for path in (CONF_DIR / "model").glob("*.yaml"))
    assert rows == headings == names


def test_constraints_are_exact_and_cover_what_the_project_asks_for():
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if line and not line.startswith("#")]
    pins = {name.lower().replace("_", "-"): version for name, version in (line.split("==") for line in lines)}
    assert not [version for version in pins.values() if "+" in version]  # a local build is not on PyPI
    asked = re.findall(
        r'"([A-Za-z][\w-]*)(?:[<>=~][^"]*)"', (ROOT / "pyproject.toml").read_text().split("[project.scripts]")[0]
    )
    assert len(asked) > 20
    assert not [name for name in asked if name.lower() not in pins and name != "hatchling"]
