"""Loggers that record a fit's history for viewers; each writes to its own folder in the run's folder."""

import csv
import importlib.util
import io
import json
import logging
import os
import re
import sqlite3
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import yaml
from lightning.pytorch.loggers import Logger, MLFlowLogger, TensorBoardLogger, WandbLogger
from matplotlib.image import imread
from torch.utils.tensorboard.summary import hparams

from frictionzoo import __version__
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.manifest import Manifest
from frictionzoo.core.output import manifest_of

_DATABASE = "mlflow/mlflow.db"
_TAG = "frictionzoo"  # marks this program's MLflow runs


class RunLogger(ABC):
    """Record of one run.

    It starts empty with every start of the fit. After a resume the loop logs the checkpoint's history again, so no row
    is missing or doubled.
    """

    def start(
        self, folder: Path, hyperparameters: Mapping[str, Any], parameters: Mapping[str, str] | None = None
    ) -> Logger:
        """Begin the record, in place of an interrupted run's record, and return Lightning's logger.

        `hyperparameters` are settings that distinguish this run: numbers, text, booleans, None and lists of these.
        `parameters` maps the full name of each identified parameter to its unit and limits in words; its scalars are
        called `NAME` or `NAME/JOINT`.

        Raises:
            OutputError: A file that this program did not write is in the record's place.
            OSError: The folder cannot be written.
        """
        self._files = manifest_of(folder, "run")
        self._files.begin()
        self._logger = self._open(folder)
        self._logger.log_hyperparams(dict(hyperparameters))
        return self._logger

    def finish(self, step: int, metrics: Mapping[str, float], figures: Sequence[Path], text: str) -> None:
        """End the record after `step` iterations: final metrics by name, PNG files in `figures/`, summary in Markdown.

        Raises:
            OSError: A file cannot be written.
        """
        self._logger.log_metrics(dict(metrics), step)
        self._hand_over(step, figures, text)
        self._logger.finalize("success")

    @abstractmethod
    def _open(self, folder: Path) -> Logger:
        """Return Lightning's logger, on an empty record."""

    @abstractmethod
    def _hand_over(self, step: int, figures: Sequence[Path], text: str) -> None:
        """Record figures and text, the arguments of `finish`."""


class TensorBoard(RunLogger):
    """Event files in `tensorboard/`, for `tensorboard --logdir FOLDER` on a run, on outputs or on a whole sweep."""

    def start(
        self, folder: Path, hyperparameters: Mapping[str, Any], parameters: Mapping[str, str] | None = None
    ) -> Logger:
        """Begin the record: the run in the HParams tab, loss and a chart per parameter in the Custom Scalars tab."""
        logger = super().start(folder, hyperparameters, parameters)
        self._logger.experiment.add_custom_scalars(_lay_out(parameters or {}))
        # Lightning and torch would fix the tab's columns to those of one run. Without that, TensorBoard gathers them
        # from all runs, which differ in a sweep over models or fits.
        plain = {k: v if type(v) in (int, float, str) else json.dumps(v) for k, v in hyperparameters.items()}
        _, begun, self._ended = hparams(plain, {})
        self._logger.experiment.file_writer.add_summary(begun)
        return logger

    def _open(self, folder: Path) -> Logger:
        _empty(self._files, "tensorboard")
        # purge_step: a running TensorBoard drops the interrupted run's rows from this step on.
        options = {"default_hp_metric": False, "purge_step": 0, "filename_suffix": f".{self._files.token}"}
        return _Events(folder, name="tensorboard", version="", **options)

    def finish(self, step: int, metrics: Mapping[str, float], figures: Sequence[Path], text: str) -> None:
        """End the record, and add the finished event file to the manifest."""
        super().finish(step, metrics, figures, text)
        self._files.adopt("tensorboard")

    def _hand_over(self, step: int, figures: Sequence[Path], text: str) -> None:
        writer = self._logger.experiment
        for path in figures:
            writer.add_image(f"figures/{path.stem}", imread(path), step, dataformats="HWC")
        writer.add_text("summary", text, step)
        writer.file_writer.add_summary(self._ended)


class _Events(TensorBoardLogger):
    """Lightning's logger without `hparams.yaml`: the name of its only file carries this run's token."""

    def save(self) -> None:
        self.experiment.flush()


def _lay_out(parameters: Mapping[str, str]) -> dict[str, dict[str, list[Any]]]:
    """Return categories of charts with patterns of scalar names, in the form of torch's writer."""
    charts = {f"{name} [{text}]": ["Multiline", [rf"^{re.escape(name)}(/.*)?$"]] for name, text in parameters.items()}
    fit = {"loss": ["Multiline", ["^loss$"]], "gradient norm": ["Multiline", ["^grad_norm$"]]}
    return {"fit": fit, "parameters": charts}


class Csv(RunLogger):
    """CSV logger: in `csv/`, scalars in `metrics.csv`, hyperparameters in `hparams.yaml`, figures in `summary.md`."""

    def _open(self, folder: Path) -> Logger:
        _empty(self._files, "csv")
        self._folder = folder / "csv"
        return _Table(self._files)

    def _hand_over(self, step: int, figures: Sequence[Path], text: str) -> None:
        shown = [f"![{path.stem}]({os.path.relpath(path, self._folder)})" for path in figures]
        self._files.write("csv/summary.md", "\n\n".join([text, *shown, ""]).encode())


class _Table(Logger):
    """Replacement of Lightning's `CSVLogger` that notes each row in the run's manifest."""

    _PATH = "csv/metrics.csv"

    def __init__(self, files: Manifest) -> None:
        super().__init__()
        self._files, self._columns = files, list[str]()
        self._rows: list[dict[str, Any]] = []

    @property
    def name(self) -> str:
        return "csv"

    @property
    def version(self) -> str:
        return ""

    def log_hyperparams(self, params: Any, *args: Any, **kwargs: Any) -> None:
        self._files.write("csv/hparams.yaml", yaml.safe_dump(dict(params), allow_unicode=True).encode())

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        self._rows.append({**metrics, "step": step})

    def save(self) -> None:
        columns, before = sorted({*self._columns}.union(*self._rows)), []
        if columns == self._columns:
            self._files.append(self._PATH, _write_rows(columns, self._rows))
        else:
            if self._columns:
                with open(self._files.root / self._PATH, newline="", encoding="utf-8") as file:
                    before = [*csv.DictReader(file)]
            header = dict(zip(columns, columns, strict=True))
            self._files.write(self._PATH, _write_rows(columns, [header, *before, *self._rows]))
        self._columns, self._rows = columns, []

    def finalize(self, status: str) -> None:
        self.save()


def _write_rows(columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> bytes:
    text = io.StringIO(newline="")
    csv.DictWriter(text, columns).writerows(rows)
    return text.getvalue().encode()


class Wandb(RunLogger):
    """Weights & Biases run in `wandb/`, offline: nothing reaches the network until the user calls `wandb sync`.

    Args:
        project: Name of the project to which `wandb sync` adds the run.

    Raises:
        ConfigError: wandb is not installed.
    """

    def __init__(self, project: str = "frictionzoo") -> None:
        _require("wandb", "wandb")
        self._project = project

    def _open(self, folder: Path) -> Logger:
        os.environ["WANDB_ERROR_REPORTING"] = "false"  # offline runs would send reports too
        import wandb

        wandb.finish(exit_code=1)  # Lightning would continue a run that a failed job of the same sweep left open
        _empty(self._files, "wandb")
        quiet = {"silent": True, "console": "off", "x_disable_stats": True, "x_disable_meta": True}
        self._run = wandb.init(
            project=self._project,
            id=self._files.token,
            name=folder.name,
            dir=folder,
            mode="offline",
            settings=wandb.Settings(**quiet, disable_git=True, disable_code=True, x_disable_machine_info=True),
        )
        self._run.define_metric("*", step_metric="trainer/global_step")
        return WandbLogger(experiment=self._run)

    def _hand_over(self, step: int, figures: Sequence[Path], text: str) -> None:
        import wandb

        images = {f"figures/{path.stem}": wandb.Image(str(path)) for path in figures}
        self._run.log({**images, "trainer/global_step": step})
        self._run.notes = text  # the run's page shows it as Markdown
        self._run.finish()


class Mlflow(RunLogger):
    """MLflow run in `mlflow/`: the database `mlflow.db`, and the figures and `summary.md` as artifacts.

    Args:
        experiment: Name of the MLflow experiment.

    Raises:
        ConfigError: mlflow, or a package that it needs to write a database, is not installed.
    """

    def __init__(self, experiment: str = "frictionzoo") -> None:
        _require("mlflow", "mlflow", "sqlalchemy", "alembic")
        self._experiment = experiment

    def _open(self, folder: Path) -> Logger:
        os.environ["MLFLOW_DISABLE_TELEMETRY"] = "true"
        import mlflow

        home = folder.absolute() / "mlflow"
        self._make_database()
        # MLflow logs the creation of each table.
        logging.getLogger("mlflow").setLevel(logging.WARNING)
        store = f"sqlite:///{home / 'mlflow.db'}"
        client = mlflow.MlflowClient(store)
        # MLflow keeps the database open, so an earlier run is marked as deleted, not removed.
        experiments = [experiment.experiment_id for experiment in client.search_experiments()]
        for earlier in client.search_runs(experiments, f"tags.{_TAG} != ''"):
            client.delete_run(earlier.info.run_id)
        return MLFlowLogger(
            self._experiment,
            folder.name,
            tracking_uri=store,
            tags={_TAG: __version__},
            artifact_location=(home / "artifacts").as_uri(),
        )

    def _make_database(self) -> None:
        """Create a database whose header marks it as this program's; MLflow does not change the header."""
        self._files.refuse([_DATABASE])
        if self._files.owns(_DATABASE):
            return
        mark = bytes.fromhex(self._files.token)
        with closing(sqlite3.connect(":memory:")) as empty:
            for pragma, part in (("user_version", mark[:4]), ("application_id", mark[4:])):
                empty.execute(f"PRAGMA {pragma}={int.from_bytes(part, signed=True)}")
            content = empty.serialize()
        # SQLite's header: user_version at 60, application_id at 68.
        self._files.mark(_DATABASE, 60, content[60:72])
        self._files.write(_DATABASE, content)

    def _hand_over(self, step: int, figures: Sequence[Path], text: str) -> None:
        client, run = self._logger.experiment, self._logger.run_id
        for path in figures:
            client.log_artifact(run, str(path), "figures")
        client.log_text(run, text, "summary.md")


def _require(extra: str, *packages: str) -> None:
    missing = [package for package in packages if importlib.util.find_spec(package) is None]
    if missing:
        raise ConfigError(
            f"logger={extra}: {' and '.join(missing)} not found, expected an installed package; "
            f'pip install "frictionzoo[{extra}]"'
        )


def _empty(files: Manifest, folder: str) -> None:
    """Remove an earlier record of this program; raise OutputError if the folder holds anything else."""
    files.refuse_inside(folder)
    files.clear(folder)
