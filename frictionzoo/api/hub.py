"""Download of cards from the Hugging Face hub, with the optional package huggingface-hub."""

import importlib.util
import json
import re
from pathlib import Path

from frictionzoo.core.errors import ConfigError, RunError
from frictionzoo.core.output import RESULT

PREFIX = "hub:"
_NAME = re.compile(r"(?P<repository>[\w-][\w.-]*/[\w-][\w.-]*)(@(?P<revision>[\w./-]+))?")
_FILE = re.compile(r"[\w-][\w.-]*")


def fetch_card(name: str) -> Path:
    """Return the folder of a card in the hub's cache, after downloading the files that are not cached.

    `name` is `hub:OWNER/NAME` or `hub:OWNER/NAME@REVISION`, with a branch, tag or commit.

    Raises:
        ConfigError: The name has another form, or huggingface-hub is not installed.
        RunError: There is no such card, or the hub does not answer.
    """
    parts = _NAME.fullmatch(name.removeprefix(PREFIX))
    if parts is None:
        raise ConfigError(f"{name}: expected {PREFIX}OWNER/NAME, or {PREFIX}OWNER/NAME@REVISION")
    if importlib.util.find_spec("huggingface_hub") is None:
        raise ConfigError(
            f'{name}: huggingface-hub not found, expected an installed package; pip install "frictionzoo[hub]"'
        )
    repository = parts["repository"]
    page = _fetch(name, repository, RESULT, parts["revision"])
    folder, commit = page.parent, page.parent.name  # each cache folder belongs to one commit
    for file in _list_files(page):
        _fetch(name, repository, file, commit)
    return folder


def _fetch(name: str, repository: str, file: str, revision: str | None) -> Path:
    # Imported here: an optional dependency.
    from huggingface_hub import errors, hf_hub_download

    problems = {
        errors.RepositoryNotFoundError: f"no such public repository; expected {PREFIX}OWNER/NAME",
        errors.RevisionNotFoundError: "no such revision; expected a branch, tag or commit of the repository",
        errors.LocalEntryNotFoundError: f"the hub does not answer, and {file} is not cached; try again later",
        errors.EntryNotFoundError: f"no {file}, expected a card; name another repository",
    }
    try:
        return Path(hf_hub_download(repository, file, revision=revision))
    except (OSError, RuntimeError, *problems) as error:
        other = f"{' '.join(str(error).split())[:200]}; try again later"
        problem = next((text for kind, text in problems.items() if isinstance(error, kind)), other)
        raise RunError(f"{name}: {problem}") from None


def _list_files(path: Path) -> list[str]:
    """Return the file names listed in a card's `result.json`; empty if it is invalid, which `read_run` reports."""
    try:
        files = [*json.loads(path.read_text(encoding="utf-8"))["card"]["files"]]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []
    return [name for name in files if isinstance(name, str) and _FILE.fullmatch(name)]
