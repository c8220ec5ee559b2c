"""What each logger has in its files after a real job, and after one that was interrupted and resumed."""

import csv
import errno
import importlib.util
import json
import re
import sqlite3
import struct
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from conftest import RUNS, Finished, slow_but
from matplotlib.image import imread
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.plugin_event_multiplexer import EventMultiplexer
from tensorboard.plugins.custom_scalar.layout_pb2 import Layout
from tensorboard.plugins.custom_scalar.metadata import CONFIG_SUMMARY_TAG
from tensorboard.plugins.hparams import metadata
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData
from tensorboard.util import tensor_util

from frictionzoo.core.build import build
from frictionzoo.core.config import CONF_DIR
from frictionzoo.core.errors import ConfigError
from frictionzoo.fit import loop
from frictionzoo.fit.loggers import Csv, RunLogger, TensorBoard

JOB = RUNS["coulomb_smooth"]
ITERATIONS = 3
FIGURES = {"figure3_parameters", "figure4_trajectory", "figure5_error"}
SCALARS = {"loss", "grad_norm", "bench.armature", "friction.static_torque", "friction.viscous_coefficient"}


@dataclass(frozen=True)
class Record:
    """What a logger's files hold, read by other code than what wrote them.

    Attributes:
        scalars: Steps and values of each scalar.
        hyperparameters: As text; numbers as the logger keeps them.
        figures: Size of each image, height and width.
        text: The summary.
        ended: Whether the record says that the run ended well.
    """

    scalars: dict[str, dict[int, float]]
    hyperparameters: dict[str, str]
    figures: dict[str, tuple[int, ...]]
    text: str
    ended: bool


def read_tensorboard(run: Path) -> Record:
    events = EventMultiplexer(size_guidance={"tensors": 0}).AddRunsFromDirectory(str(run)).Reload()
    (name,) = events.Runs()  # one row of the HParams tab
    log = events.GetAccumulator(name)
    tags = log.Tags()["tensors"]
    kinds = {tag: log.SummaryMetadata(tag).plugin_data.plugin_name for tag in tags}
    begun, ended = (
        HParamsPluginData.FromString(log.SummaryMetadata(tag).plugin_data.content)
        for tag in (metadata.SESSION_START_INFO_TAG, metadata.SESSION_END_INFO_TAG)
    )
    assert metadata.EXPERIMENT_TAG not in tags  # would fix the columns to those of this run
    values = {tag: log.Tensors(tag) for tag in tags}
    images = {tag: values[tag] for tag in tags if kinds[tag] == "images"}
    (text,) = next(values[tag] for tag in tags if kinds[tag] == "text")
    return Record(
        scalars={
            tag: unique((event.step, tensor_util.make_ndarray(event.tensor_proto).item()) for event in values[tag])
            for tag in tags
            if kinds[tag] == "scalars"
        },
        hyperparameters={
            key: str(getattr(value, value.WhichOneof("kind")))
            for key, value in begun.session_start_info.hparams.items()
        },
        figures={
            tag.removeprefix("figures/"): tuple(int(side) for side in image.tensor_proto.string_val[1::-1])
            for tag, (image,) in images.items()
        },
        text=text.tensor_proto.string_val[0].decode(),
        ended=ended.session_end_info.status == 1,
    )


def read_csv(run: Path) -> Record:
    with open(run / "csv" / "metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    text = (run / "csv" / "summary.md").read_text()
    links = [line.partition("](")[2].rstrip(")") for line in text.splitlines() if line.startswith("![")]
    hyperparameters = yaml.safe_load((run / "csv" / "hparams.yaml").read_text())
    return Record(
        scalars={
            name: unique((int(row["step"]), float(row[name])) for row in rows if row[name])
            for name in rows[0]
            if name != "step"
        },
        hyperparameters={key: str(value) for key, value in hyperparameters.items()},
        figures={Path(link).stem: imread(run / "csv" / link).shape[:2] for link in links},
        text=text,
        ended=True,
    )


def read_wandb(run: Path) -> Record:
    import wandb
    from wandb.proto.wandb_internal_pb2 import Record as Entry

    wandb.teardown()  # as at the end of a process: what writes the file ends, and has written all of it
    (path,) = (run / "wandb").glob("offline-run-*/run-*.wandb")
    entries = [Entry.FromString(content) for content in read_leveldb_log(path.read_bytes())]
    rows = [
        {tuple(item.nested_key): json.loads(item.value_json) for item in entry.history.item}
        for entry in entries
        if entry.HasField("history")
    ]
    configs = [update for entry in entries for update in entry.config.update if update.key]
    names = {key[0] for row in rows for key in row if len(key) == 1 and not key[0].startswith("_")}
    images = {key[0]: path for row in rows for key, path in row.items() if key[1:] == ("path",)}
    return Record(
        scalars={
            name: unique((row["trainer/global_step",], row[name,]) for row in rows if (name,) in row)
            for name in names - {"trainer/global_step"}
        },
        hyperparameters={item.key: str(json.loads(item.value_json)) for item in configs},
        figures={
            name.removeprefix("figures/"): imread(path.parent / "files" / image).shape[:2]
            for name, image in images.items()
        },
        text=[entry.run.notes for entry in entries if entry.run.notes][-1],
        ended=[entry.exit.exit_code for entry in entries if entry.HasField("exit")] == [0],
    )


def read_leveldb_log(content: bytes) -> Iterator[bytes]:
    """Records of wandb's file: LevelDB's log format, in blocks of 32 KiB, after a header of 7 bytes."""
    whole, position = b"", 7
    while position + 7 <= len(content):
        left = 32768 - position % 32768
        if left < 7:
            position += left
            continue
        _, size, kind = struct.unpack_from("<IHB", content, position)
        whole += content[position + 7 : position + 7 + size]
        position += 7 + size
        if kind in (1, 4):  # whole, or the last part
            yield whole
            whole = b""


def read_mlflow(run: Path) -> Record:
    with closing(sqlite3.connect(run / "mlflow" / "mlflow.db")) as database:
        runs = database.execute("SELECT run_uuid, status FROM runs WHERE lifecycle_stage = 'active'").fetchall()
        ((identity, status),) = runs
        metrics = database.execute("SELECT key, step, value FROM metrics WHERE run_uuid = ?", (identity,)).fetchall()
        params = database.execute("SELECT key, value FROM params WHERE run_uuid = ?", (identity,)).fetchall()
    artifacts = run / "mlflow" / "artifacts" / identity / "artifacts"
    return Record(
        scalars={name: unique((step, value) for key, step, value in metrics if key == name) for name, _, _ in metrics},
        hyperparameters=dict(params),
        figures={path.stem: imread(path).shape[:2] for path in (artifacts / "figures").glob("*.png")},
        text=(artifacts / "summary.md").read_text(),
        ended=status == "FINISHED",
    )


def unique(pairs: Iterator[tuple[int, float]]) -> dict[int, float]:
    """A value for each step, refused where there are two."""
    listed = list(pairs)
    assert len(dict(listed)) == len(listed)
    return dict(sorted(listed))


READERS = {"tensorboard": read_tensorboard, "csv": read_csv, "wandb": read_wandb, "mlflow": read_mlflow}
FINAL = {
    "MAE/test_position": ("metrics", "test", "position_mae"),
    "RMSE/test_position": ("metrics", "test", "position_rmse"),
    "MAE/train_position": ("metrics", "train", "position_mae"),
    "fit/loss": ("fit", "loss"),
    "fit/seconds": ("timing", "fit"),
}


def check(run: Path, finished: Finished, logger: str) -> None:
    """The run ended well, and its record agrees with its own files."""
    assert finished.status == 0, finished.err
    # No lines but our own, loggers are told to be silent: the engine, the segments, the checkpoint.
    assert len(finished.err.splitlines()) == (3 if "resuming" in finished.err else 2), finished.err
    assert [name for name in READERS if (run / name).exists()] == [logger]
    assert f'href="{logger}/"' in (run / "report.html").read_text(encoding="utf-8")
    record = READERS[logger](run)
    result = json.loads((run / "result.json").read_text())
    saved = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["frictionzoo"]["history"]
    assert set(record.scalars) >= SCALARS
    for name in SCALARS:
        assert list(record.scalars[name]) == list(range(ITERATIONS))
    np.testing.assert_allclose(list(record.scalars["loss"].values()), saved[0].numpy(), rtol=1e-6)
    for name, path in FINAL.items():
        value = result
        for key in path:
            value = value[key]
        assert record.scalars[name] == {ITERATIONS: pytest.approx(value, rel=1e-6)}, name
    for parameter in result["parameters"]:
        name = f"identified/{parameter['owner']}.{parameter['name']}"
        assert (name in record.scalars) == parameter["identified"]
        if parameter["identified"]:
            assert record.scalars[name] == {ITERATIONS: pytest.approx(parameter["value"], rel=1e-6)}
            assert f"| {name.partition('/')[2]} | {parameter['value']:.4g} |" in record.text

    told = record.hyperparameters
    for name, text in {"model": "coulomb_smooth", "data": "files", "fit": "adam", "dtype": "float64"}.items():
        assert told[name] == text
    for name, number in {
        **{"seed": 0, "segments.length": 5, "fit.learning_rate": 0.01, "fit.iterations": ITERATIONS},
    }.items():
        assert float(told[name]) == number
    assert not {name for name in told if name.endswith("_target_") or name.startswith(("logger", "resume"))}
    assert record.figures == {path.stem: imread(path).shape[:2] for path in (run / "figures").glob("*.png")}
    assert set(record.figures) == FIGURES
    assert record.ended


def test_a_job_is_recorded(finished_run: Callable) -> None:
    check(*finished_run("coulomb_smooth"), "tensorboard")


def test_tensorboard_has_a_chart_for_each_parameter(finished_run: Callable) -> None:
    run = finished_run("coulomb_smooth")[0]
    events = EventMultiplexer(size_guidance={"tensors": 0}).AddRunsFromDirectory(str(run)).Reload()
    log = events.GetAccumulator(*events.Runs())
    (layout,) = log.Tensors(CONFIG_SUMMARY_TAG)
    charts = [each for part in Layout.FromString(layout.tensor_proto.string_val[0]).category for each in part.chart]
    drawn = {
        tag: chart.title for chart in charts for tag in log.Tags()["tensors"] if re.match(*chart.multiline.tag, tag)
    }
    result = json.loads((run / "result.json").read_text())
    parameters = {f"{p['owner']}.{p['name']}": p for p in result["parameters"] if p["identified"]}
    assert drawn.keys() == {"loss", "grad_norm", *parameters} >= SCALARS and len({*drawn.values()}) == len(charts)
    for name in parameters:
        row = parameters[name]["by_joint"][0]
        assert drawn[name] == f"{name} [{parameters[name]['unit']}, {row['low']:g} to {row['high']:g}]"


@pytest.mark.parametrize("logger", slow_but(["csv"], READERS))
def test_an_interrupted_and_resumed_run_is_recorded_once(call, tiny, tmp_path, monkeypatch, logger):
    run, save = tmp_path / "run", loop._Saver.on_train_epoch_end

    def save_once(*arguments: Any) -> None:
        if (run / "checkpoints").exists():
            raise OSError(errno.ENOSPC, "No space left on device")
        save(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(loop._Saver, "on_train_epoch_end", save_once)
        assert call(*tiny, *JOB, f"logger={logger}", "hydra.run.dir=run").status == 2
    # The logger knows all iterations and the checkpoint the first two: the other is done, and logged, again.
    assert int(torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["frictionzoo"]["progress"][0]) == 2
    if logger not in ("csv", "tensorboard"):  # starts a program, or reads a database that may be a stranger's
        refused = call(f"resume={run}")
        assert refused.status == 2 and f"add logger={logger}" in refused.err
    check(run, call(f"resume={run}", f"logger={logger}"), logger)


@pytest.mark.parametrize("logger", [TensorBoard(), Csv()], ids=["tensorboard", "csv"])
def test_a_saved_row_is_on_disk_at_once(tmp_path: Path, logger: RunLogger) -> None:
    record = logger.start(tmp_path, {"model": "mujoco_default"})
    for step in range(3):
        record.log_metrics({"loss": 1.0 / (1 + step)}, step)
        record.save()
        assert read_losses(tmp_path) == pytest.approx([1.0, 0.5, 1 / 3][: step + 1])


def read_losses(run: Path) -> list[float]:
    """The losses so far of a run that has not ended."""
    if (run / "csv").exists():
        with open(run / "csv" / "metrics.csv", newline="") as file:
            return [float(row["loss"]) for row in csv.DictReader(file)]
    return [event.value for event in EventAccumulator(str(run / "tensorboard")).Reload().Scalars("loss")]


def test_every_logger_of_the_configuration_is_tested() -> None:
    assert {path.stem for path in (CONF_DIR / "logger").glob("*.yaml")} == set(READERS)


@pytest.mark.parametrize(
    ("name", "option", "lost"),
    [("Wandb", "project", "wandb"), ("Mlflow", "experiment", "mlflow"), ("Mlflow", "experiment", "sqlalchemy")],
)
def test_a_missing_package_is_told_in_one_line(monkeypatch, name, option, lost):
    section = {"_target_": f"frictionzoo.fit.loggers.{name}", option: "friction"}
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == lost else name)
    with pytest.raises(ConfigError, match=rf"^logger={name.lower()}: {lost} "):
        build(section)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name)
    assert isinstance(build(section), RunLogger)
