"""Cards of values that somebody else published: of a run that judged a parameter file of BAM."""

import json
import re
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path

import cards
import pytest
from conftest import finish, job_settings, needs_data, render_nothing, run_main
from helpers.bam import M1, options, write_logs

import frictionzoo as fz
from frictionzoo.bench.read_bam import read_bam
from frictionzoo.cli.finished import card as main
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.output import RESULT
from frictionzoo.report.card import PAGE, write_card

PUBLISHED = M1 | {"max_velocity": 5.3}
SOURCE = "A. Maker, https://example.org/drives"


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("published") / "m1.json"
    path.write_text(json.dumps(PUBLISHED))
    return path


@pytest.fixture(scope="module")
def run(file: Path, compilation_cache: Path) -> Path:
    """The run that judged it."""
    logs = file.with_name("logs")
    logs.mkdir()
    write_logs(logs, M1, seconds=1.6)
    folder, short = file.with_name("run"), ("evaluation.horizons=[0.5]", "evaluation.trajectory=1.0")
    with job_settings(compilation_cache), pytest.MonkeyPatch.context() as patch:
        render_nothing(patch)
        done = run_main(*options(logs, file), *short, f"hydra.run.dir={folder}")
    assert done.status in (0, 3), done.err
    return folder


def settings(file: Path, **others: str) -> dict[str, str]:
    return {"licence": "apache-2.0", "bam": str(file), "source": SOURCE, **others}


def test_its_values_are_labelled_as_theirs(run: Path, file: Path, tmp_path: Path) -> None:
    folder, _ = write_card(run, settings(file, output=str(tmp_path / "card")))
    origin = json.loads((folder / RESULT).read_text())["card"]["origin"]
    assert origin == {
        "project": "BAM",
        "file": "m1.json",
        "sha256": sha256(file.read_bytes()).hexdigest(),
        "drive": "sts3215",
        "law": "m1",
        "source": SOURCE,
        "remarks": list(read_bam(file).remarks),
    }
    page = (folder / PAGE).read_text()
    assert (
        "Armature and friction of BAM's drive `sts3215` with its model `m1`, published as `m1.json` in A. Maker" in page
    )
    assert "frictionzoo did not identify these values; it evaluated them on recordings" in page
    assert "identified by frictionzoo" not in page and "drive was not identified" not in page
    assert f"SHA-256 `{origin['sha256']}`" in page and "BAM's servo follows commands at 5.3 rad/s at most" in page
    (line,) = re.findall(r"^\| bench\.armature .*$", page, re.M)
    assert "| 0.0261 |" in line and "known" in line
    drive = fz.load(folder)
    assert drive.parameters["friction.damping"].value.tolist() == [M1["friction_viscous"]]


@pytest.mark.slow
@needs_data
def test_published_values_are_judged_on_recordings_of_their_servo(tmp_path, monkeypatch, capsys):
    """The values are those of BAM's m1.json for the XL330, of 2026."""
    file, others = tmp_path / "m1.json", tmp_path / "other.json"
    published = {"kt": 0.37005, "R": 3.49835, "armature": 0.00198982, "q_offset": -0.00176724}
    published |= {"friction_base": 0.0182117, "friction_viscous": 0.005902, "model": "m1", "actuator": "xl330"}
    file.write_text(json.dumps(published))
    others.write_text(json.dumps(published | {"actuator": "mx64"}))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["cards.py", "--licence", "apache-2.0", "--bam", "m1.json", "other.json"])
    assert cards.main() == 1
    said = capsys.readouterr()
    assert said.out == "bam_xl330_m1: cards/bam_xl330_m1\n"
    assert said.err.startswith("other.json: actuator=mx64; ") and said.err.count("\n") == 1
    drive = fz.load(tmp_path / "cards" / "bam_xl330_m1")
    error = drive.result["metrics"]["test"]["position_mae"]
    assert error and 0.03 < error < 0.08  # the laws identified here reach 0.051
    assert [path.name for path in (tmp_path / "cards").iterdir()] == ["bam_xl330_m1"]


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"friction_viscous": 0.07}, r"friction\.damping is 0\.07, in the run 0\.0599; name the run's own file$"),
        ({"R": 2.0}, r"bench\.kt_over_r is 0\.5888, in the run "),
        ({"model": "m3", "load_friction_base": 0.1}, "its model is load_dependent, the run's mujoco_default"),
        ({"actuator": "erob80_50"}, r"actuator=erob80_50"),
    ],
)
def test_values_of_another_file_are_refused(run: Path, tmp_path: Path, change: dict, expected: str) -> None:
    other = tmp_path / "other.json"
    other.write_text(json.dumps(PUBLISHED | change))
    with pytest.raises(ConfigError, match=rf"{re.escape(str(other))}.*{expected}"):
        write_card(run, settings(other, output=str(tmp_path / "card")))
    assert [*tmp_path.iterdir()] == [other]


def test_values_that_a_run_found_are_not_others(finished_run: Callable, file: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"the run identified its values \(fit=lm\)"):
        write_card(finished_run("mujoco_default")[0], settings(file, output=str(tmp_path / "card")))
    assert not [*tmp_path.iterdir()]


def test_a_file_without_its_source_is_refused_and_the_reverse(run: Path, file: Path) -> None:
    refused = finish(lambda: main([str(run), "licence=mit", f"bam={file}"]))
    assert refused.status == 2 and refused.err.startswith(f"frictionzoo: bam={file}: source is missing")
    with pytest.raises(ConfigError, match=r"^source=BAM: bam is missing"):
        write_card(run, {"licence": "mit", "source": "BAM"})
    assert not (run / "card").exists()
