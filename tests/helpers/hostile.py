"""Runs and cards of strangers: mutated at random and handed to the program, in a process that an audit hook watches.

`python hostile.py RUN CARD SCRATCH COUNT SEED` prints one line of JSON: what went wrong, and for each command how often
it ended well and how often it refused. RUN and CARD are folders that the program wrote, SCRATCH is empty.
"""

import contextlib
import copy
import hashlib
import io
import json
import os
import pickle
import random
import shutil
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
import torch

import frictionzoo as fz
from frictionzoo.cli import run
from frictionzoo.cli.finished import compare, distill, export
from frictionzoo.core.errors import FrictionzooError
from frictionzoo.core.manifest import MANIFEST, FileState, Manifest
from frictionzoo.report import with_matplotlib
from frictionzoo.result.card import hash_record

MARK = "stranger_was_here"
PROCESSES = ("subprocess.", "os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "pty.", "os.startfile")
SOCKETS = ("socket.connect", "socket.bind", "socket.getaddrinfo", "socket.gethostby", "socket.sendto", "urllib.")
WRITES = ("os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.symlink", "os.truncate", "os.chmod")
PYTHON = f"open({MARK!r}, 'w').close()\nimport sys; sys.{MARK} = True\nclass Law: ...\nmain = X = Law\n"
COMMANDS = {"load": 560, "card": 300, "compare": 60, "export": 25, "resume": 50, "distill": 5}
"""How often each is tried, of a thousand times; a resumed or distilled run is fitted, where nothing refuses it."""


class Bomb:
    """What an unpickled file would do."""

    def __reduce__(self) -> tuple[Any, ...]:
        return exec, (PYTHON,)


class Watch:
    """An audit hook: notes, and stops, what no file of a stranger may bring about."""

    def __init__(self, scratch: Path, allowed: list[Path]) -> None:
        self.scratch = str(scratch)
        self.allowed = [os.path.realpath(path) for path in allowed]
        self.case: str | None = None
        self.seen: list[str] = []
        sys.addaudithook(self.hear)

    def hear(self, event: str, arguments: tuple[Any, ...]) -> None:
        """The hook; while no case is tried, anything goes."""
        if self.case is None:
            return
        if wrong := self._judge(event, arguments):
            case, self.case = self.case, None  # formatting a stack opens files
            frames = [f"{Path(f.filename).name}:{f.lineno}" for f in traceback.extract_stack()[-9:-2]]
            self.case = case
            self.seen.append(f"{wrong} from {' '.join(frames)}")
            raise PermissionError(wrong)

    def _judge(self, event: str, arguments: tuple[Any, ...]) -> str | None:
        if event.startswith((*PROCESSES, *SOCKETS)):
            return f"{event} {arguments!r:.200}"
        if event in ("exec", "compile", "import", "ctypes.dlopen") and self._is_foreign(arguments):
            return f"{event} {arguments!r:.200}"
        if event == "pickle.find_class" and arguments[0] in ("builtins", "os", "posix", "subprocess", "nt"):
            return f"{event} {arguments!r:.200}"
        if event == "open" and isinstance(arguments[0], str | bytes | os.PathLike):
            path, mode, flags = arguments
            if set(mode or "") & set("wax+") or (flags or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC):
                return self._outside(event, path)
        if event in WRITES:
            first, last = (0, 2) if event in ("os.rename", "os.link") else (1, 2) if "link" in event else (0, 1)
            return next((wrong for place in arguments[first:last] if (wrong := self._outside(event, place))), None)
        return None

    def _is_foreign(self, arguments: tuple[Any, ...]) -> bool:
        code = arguments[0]
        if hasattr(code, "co_filename"):
            return MARK in repr((code.co_names, code.co_consts)) or code.co_filename.startswith(self.scratch)
        return any(MARK in str(each) or str(each).startswith((self.scratch, "stranger")) for each in arguments if each)

    def _outside(self, event: str, path: Any) -> str | None:
        if not isinstance(path, str | bytes | os.PathLike):
            return None
        # A link that is removed or renamed is itself changed, not what it leads to.
        folder, name = os.path.split(os.fsdecode(path))
        real = os.path.join(os.path.realpath(folder), name) if event != "open" else os.path.realpath(os.fsdecode(path))
        inside = [*self.allowed, os.path.join(self.scratch, str(self.case))]
        return None if any(real == each or real.startswith(each + os.sep) for each in inside) else f"{event} {real}"


NAMES = """os.system subprocess.Popen builtins.exec torch.load hydra.utils.instantiate stranger.Law run.stranger.Law x
.. frictionzoo.design.__main__.X frictionzoo.cli.commands.main frictionzoo.core.build.build
frictionzoo.data.files.Files frictionzoo.fit.loggers.Wandb frictionzoo.fit.loggers.Mlflow frictionzoo.bench.Robot
frictionzoo.models.Stribeck frictionzoo.models.ByJoint frictionzoo.fit.Several"""
TARGETS = (*NAMES.split(), "", None, 3)
WORDS = """../evil /etc/passwd ${oc.env:HOME} ${oc.create:{_target_:os.system}} ??? \x1b[31m \x1b]0;title\x07 x\x00y
%s%n ~ * [ ( $\\frac{1}$ \u202egpj.exe {{7*7}} </script> hub:a/b http://127.0.0.1:9/x sqlite:////etc/x.db user auto
inf 1e999"""
TEXTS = (*WORDS.split(), "", "a" * 10_000, "a\nb", '"; import os', "\ud800")
VALUES = (
    *(None, True, False, 0, -1, 1, 10**9, 10**30, -(2**63), 1e308, 1e-320, -1.5),
    *([], {}, [[]], [None], [1, "a"], {"a": 1}),
    *({"_target_": "os.system", "command": f"touch {MARK}"}, {"_target_": "frictionzoo.bench.Force"}, *TEXTS),
)
CHOICES = ("../evil", "evil", "/tmp/evil", "../../hydra/launcher/joblib", "${oc.env:HOME}", "knee.yaml", "wandb", 3)
DOCUMENTS = (
    *("- model=../evil", "- ++hydra.callbacks.x._target_=stranger.Law", "- hydra/launcher=joblib", "[", "3", "\x00"),
    *(f"!!python/object/apply:os.system ['touch {MARK}']", f"- !!python/object/apply:os.system ['touch {MARK}']"),
    *("hydra: {runtime: {choices: {model: '\x1b[31m'}}}", "hydra: {callbacks: {x: {_target_: stranger.Law}}}"),
    "a: &a [*a]",
)
EVIL = "# @package _global_\nhydra: {callbacks: {x: {_target_: stranger.Law}}}\n"


def _pick(folder: Path, rng: random.Random, pattern: str = "*.json") -> Path:
    return rng.choice([path for path in folder.rglob(pattern) if path.is_file() and path.suffix != ".png"])


def _list_places(node: Any) -> Iterator[tuple[Any, Any]]:
    for key, value in [*(enumerate(node) if isinstance(node, list) else node.items())]:
        yield node, key
        if isinstance(value, dict | list):
            yield from _list_places(value)


def change_json(folder: Path, rng: random.Random) -> None:
    """Another value, one less or one more somewhere in a file of JSON; another class, of a third of all files."""
    path = _pick(folder, rng)
    content = json.loads(path.read_text())
    for _ in range(rng.choice((1, 1, 1, 3))):
        places = [*_list_places(content if rng.random() < 0.5 else content.get("settings", content))]
        classes = [place for place in places if place[1] == "_target_"] if rng.random() < 0.3 else []
        node, key = rng.choice(classes or places)
        what, value = rng.random(), copy.deepcopy(rng.choice(VALUES))
        if key == "_target_":
            node[key] = rng.choice(TARGETS)
        elif what < 0.1:
            del node[key]
        elif what < 0.2 and isinstance(node, dict):
            node[rng.choice(TEXTS)] = value
        else:
            node[key] = {"_target_": rng.choice(TARGETS), "args": [f"touch {MARK}"]} if what < 0.25 else value
    path.write_text(json.dumps(content))


def change_choices(folder: Path, rng: random.Random) -> None:
    """Another file of a configuration group, and overrides of Hydra's own settings."""
    path = folder / ".hydra" / "settings.json"
    if not path.exists():
        return change_json(folder, rng)
    content = json.loads(path.read_text())
    group = rng.choice([*content["choices"], "hydra/launcher", "+hydra", "model@hydra.callbacks", "../x", "experiment"])
    content["choices"][group] = rng.choice(CHOICES)
    content["options"].append(rng.choice(("hydra.callbacks.x._target_=stranger.Law", "-m", "+a=\x1b", "x")))
    path.write_text(json.dumps(content))
    return None


def change_form(folder: Path, rng: random.Random) -> None:
    """A file of JSON that is none, or in a form that no reader expects."""
    path = _pick(folder, rng)
    text = path.read_text()
    replaced = [
        *((": 0.", ": NaN"), (": 1", ": 1" + "0" * 400), (": 1", ": 1e999"), (": 1", ": 1" + "0" * 5000)),
        *(('"settings"', '"settings": {}, "settings"'), ("coulomb", "\\u001b[31m"), ("frictionzoo", "stranger")),
        *(("knee", "\\ud800"), ("frictionzoo.bench", "frictionzoo.design.__main__")),
    ]
    forms = (
        *("[]", "3", "null", "", '{"a":', "[" * 100_000, '{"a":' * 900 + "1" + "}" * 900, "\ufeff" + text, text * 2),
        *(text.replace(old, new, 1 if ":" in old else -1) for old, new in replaced),
        text[: rng.randrange(len(text))],
    )
    path.write_text(rng.choice(forms), encoding="utf-8")


def change_yaml(folder: Path, rng: random.Random) -> None:
    """Hostile YAML in Hydra's record."""
    place = folder / ".hydra"
    place.mkdir(exist_ok=True)
    (place / f"{rng.choice(('overrides', 'config', 'hydra'))}.yaml").write_text(rng.choice(DOCUMENTS))


def change_bytes(folder: Path, rng: random.Random) -> None:
    """Bytes of a file that hold something else."""
    path, saved = _pick(folder, rng, "*"), io.BytesIO()
    torch.save({"frictionzoo": Bomb(), "state_dict": {}}, saved)
    flipped = bytearray(content := path.read_bytes())
    for _ in range(rng.choice((1, 8, 64)) if content else 0):
        flipped[rng.randrange(len(content))] = rng.randrange(256)
    bombs = pickle.dumps(Bomb()), saved.getvalue(), (2**62).to_bytes(8, "little") + b"{}", PYTHON.encode()
    path.write_bytes(rng.choice((content[: rng.randrange(len(content) + 1)], flipped, *bombs)))


def change_arrays(folder: Path, rng: random.Random) -> None:
    """Arrays of another shape, type or size in a file of safetensors or in the checkpoint."""
    path = rng.choice([*folder.rglob("*.safetensors"), *folder.rglob("last.ckpt")])
    if path.suffix == ".ckpt":
        saved = torch.load(path, weights_only=True)
        part, place = saved["frictionzoo"], rng.choice(("progress", "history", "identity"))
        shorter = part[place][:-1] if place != "identity" else {}
        part[place] = rng.choice(([], {}, None, "x", [torch.zeros(3)], [torch.zeros(2, 2).bool()] * 8, shorter))
        if rng.random() < 0.3:
            saved[rng.choice([key for key in saved if key != "frictionzoo"])] = rng.choice((None, 3, "x", [], {}))
        return torch.save(saved, path)
    arrays = dict(safetensors.numpy.load(path.read_bytes()))
    for name in rng.sample(sorted(arrays), min(len(arrays), rng.choice((1, 1, 2, 9)))):
        old = arrays.pop(name)
        changed = (old.astype(np.float16), old.astype(bool), old * np.nan, old * 1e300, old[..., None], old[:1])
        new = rng.choice((np.zeros(0), np.zeros((2, 2)), np.zeros((1, 0, 3)), *changed))
        arrays[name if rng.random() < 0.8 else f"{name}\x1b[31m"] = new
    path.write_bytes(safetensors.numpy.save({name: np.ascontiguousarray(values) for name, values in arrays.items()}))


def _hash_again(folder: Path, rng: random.Random) -> None:
    """Most often, have a card's record agree with its files."""
    path = folder / "result.json"
    with contextlib.suppress(ValueError, KeyError, TypeError, AttributeError, OSError, RecursionError):
        content = json.loads(path.read_text())
        if rng.random() < 0.8:
            hashes = {
                name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in content["card"]["files"]
            }
            content["card"]["files"] = hashes | {path.name: hash_record(content)}
            path.write_text(json.dumps(content))


def change_links(folder: Path, rng: random.Random) -> None:
    """A link out of the folder in place of a file or a folder."""
    outside = folder.parent.parent / "outside"
    path = rng.choice([path for path in folder.rglob("*") if not path.is_symlink()])
    kind = path.is_dir()
    shutil.rmtree(path) if kind else path.unlink()
    path.symlink_to(outside if kind else outside / "file")


def add_files(folder: Path, rng: random.Random) -> None:
    """Files that Python, Hydra or a library might pick up."""
    python = ("stranger", "conftest", "sitecustomize", "frictionzoo/__init__", "run/stranger", "hydra_plugins/x")
    yaml = ("model/evil", "conf/model/evil", ".hydra/evil", "evil", "hydra/launcher/evil")
    for names, suffix, content in ((python, "py", PYTHON), (yaml, "yaml", EVIL)):
        for path in (folder / f"{name}.{suffix}" for name in names):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(content)
    if rng.random() < 0.5:
        (folder / rng.choice((".running", "comparison", "export", "distilled"))).mkdir(exist_ok=True)


MUTATIONS: tuple[tuple[Callable[[Path, random.Random], None], int], ...] = (
    *((change_json, 52), (change_choices, 8), (change_form, 10), (change_yaml, 4)),
    *((change_bytes, 12), (change_arrays, 10), (change_links, 4), (add_files, 4)),
)


def sign(folder: Path) -> None:
    """List all files of a folder in a new manifest, as a stranger can: none counts as changed or foreign."""
    (folder / MANIFEST).unlink(missing_ok=True)
    files = [path for path in folder.rglob("*") if path.is_file() and not path.is_symlink()]
    Manifest(folder, "run").record(
        {path.relative_to(folder).as_posix(): FileState.of(path.read_bytes()) for path in files}
    )


def do(command: str, folder: Path) -> str:
    """Have the program take up a folder; returns `done` or `refused`."""
    out, output = io.StringIO(), f"output={folder.parent / 'output'}"
    options: dict[str, Callable[[], Any]] = {
        **dict.fromkeys(("load", "card"), lambda: print(repr(fz.load(folder)), end="")),
        "compare": lambda: compare([str(folder), "--output", output[7:]]),
        "export": lambda: export([str(folder), "target=mjcf", output]),
        "resume": lambda: run.main([f"resume={folder}"]),
        "distill": lambda: distill([str(folder), "model=coulomb_smooth", "fit=adam", "fit.iterations=1", output]),
    }
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        try:
            options[command]()
            return "done"
        except FrictionzooError as error:
            assert "\n" not in str(error)
            out.write(str(error))
            return "refused"
        except SystemExit as end:
            lines = [line for line in out.getvalue().splitlines() if line.startswith("frictionzoo: ")]
            assert end.code in (0, 2, 3) and (end.code != 2 or len(lines) == 1), out.getvalue()
            return "refused" if end.code == 2 else "done"
        finally:
            text = out.getvalue()
            controls = {chr(code) for code in (*range(10), *range(11, 32), *range(127, 160), 0x202E)}
            assert not set(text) & controls and "Traceback" not in text, repr(text)


def mutate(folder: Path, rng: random.Random) -> list[str]:
    """Change a folder in one way or two; returns which. Links come last: nothing here writes through one."""
    mutations = rng.choices(*zip(*MUTATIONS, strict=True), k=rng.choice((1, 1, 2)))
    for change in sorted(mutations, key=lambda each: each is change_links):
        with contextlib.suppress(Exception):
            change(folder, rng)  # a second one may not know what the first has left
    _hash_again(folder, rng)
    if rng.random() < 0.9:
        sign(folder)
    return [change.__name__ for change in mutations]


def main(source: Path, card: Path, scratch: Path, count: int, seed: int) -> None:
    """Try so many mutations. PDF is left out: it draws what PNG draws, and takes a second to embed its fonts."""
    save = with_matplotlib.save_figure
    with_matplotlib.save_figure = lambda figure, path: None if path.suffix == ".pdf" else save(figure, path)
    tempfile.tempdir = str(scratch)
    places = [Path(os.environ[name]) for name in ("XDG_CACHE_HOME", "JAX_COMPILATION_CACHE_DIR")]
    outside, watch = scratch / "outside", Watch(scratch, [*places, Path(os.devnull)])
    outside.mkdir()
    (outside / "file").write_text("mine")
    counts, wrong = Counter[str](), []
    for number in range(-len(COMMANDS), count):  # the first are not changed, and have to end well
        rng, folder = random.Random(seed * 1_000_003 + number), scratch / str(number) / "run"
        command = [*COMMANDS][number] if number < 0 else rng.choices([*COMMANDS], [*COMMANDS.values()])[0]
        left_out = shutil.ignore_patterns(*(() if command == "card" else ("report.html", "*.png")))
        shutil.copytree(card if command == "card" else source, folder, ignore=left_out)
        case = {"case": number, "command": command, "by": mutate(folder, rng) if number >= 0 else []}
        os.chdir(folder.parent)
        sys.path_importer_cache.clear()
        watch.seen.clear()
        watch.case = str(number) if number >= 0 else None  # the first also import what libraries look up
        try:
            outcome = do(command, folder)
        except BaseException as error:
            outcome = "wrong"
            frames = [f"{Path(f.filename).name}:{f.lineno}" for f in traceback.extract_tb(error.__traceback__)[-4:]]
            wrong.append(case | {"error": f"{type(error).__name__}: {error!s:.600}", "at": frames})
        finally:
            watch.case = None
        counts[f"{command} {outcome}"] += 1
        if watch.seen:
            wrong.append(case | {"seen": watch.seen[:3]})
        if number < 0 and outcome != "done":
            wrong.append(case | {"error": "refused without a change"})
        left = {path.name: path.read_bytes() for path in outside.iterdir()}
        if [*scratch.rglob(MARK)] or hasattr(sys, MARK) or left != {"file": b"mine"}:
            wrong.append(case | {"error": "executed, or written outside"})
            break
        os.chdir(scratch)
        if not os.environ.get("KEEP_CASES"):
            shutil.rmtree(folder.parent)
    print(json.dumps({"wrong": wrong, "counts": dict(sorted(counts.items()))}))


if __name__ == "__main__":
    main(*(Path(each).resolve() for each in sys.argv[1:4]), int(sys.argv[4]), int(sys.argv[5]))
