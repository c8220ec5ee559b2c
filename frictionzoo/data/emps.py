"""EMPS, the Electro-Mechanical Positioning System: public recordings of a ball-screw drive."""

import hashlib
from pathlib import Path
from typing import Any

from frictionzoo.core.errors import ConfigError, LogError
from frictionzoo.core.log import Dataset, Log
from frictionzoo.data.columns import pick
from frictionzoo.data.formats import find_files, get_format
from frictionzoo.data.formats.base import read_bytes
from frictionzoo.data.signals import check_filter, estimate_velocity
from frictionzoo.data.source import Source, register_source

CITATION = (
    'A. Janot, M. Gautier, M. Brunot, "Data Set and Reference Models of EMPS", Workshop on Nonlinear System '
    "Identification Benchmarks, Eindhoven 2019"
)
OBTAIN = "https://www.nonlinearbenchmark.org/benchmarks/emps"


@register_source("emps")
class Emps(Source):
    """EMPS recordings: one training file, and a test file with pulses.

    The files contain the measured position and the control voltage. The velocity is estimated from the position; the
    position is not filtered. The voltage is the command; the bench converts it to a force.

    Source: A. Janot, M. Gautier, M. Brunot, Nonlinear System Identification Benchmarks, Eindhoven 2019.

    Args:
        name: The data set's name.
        folder: Folder that contains `emps/`; None if the user has not set one.
        train: File name of the training recording.
        test: File name of the test recording.
        cutoff: Cut-off frequency of the velocity estimate [Hz].
        order: Order of the velocity estimate's filter.

    Raises:
        ConfigError: The filter's order or cut-off is impossible, or a part is not a single file name.
    """

    def __init__(self, name: str, folder: str | None, train: Any, test: Any, cutoff: float, order: int) -> None:
        check_filter("data", cutoff, order)
        for option, file_name in (("train", train), ("test", test)):
            if not isinstance(file_name, str):
                raise ConfigError(f"data.{option}={file_name}: expected the name of one file in the folder emps/")
        self.name, self.folder, self.cutoff, self.order = name, folder, cutoff, order
        self.train, self.test = train, test

    def load(self) -> Dataset:
        """Load both recordings.

        Raises:
            LogError: No folder is set, or a file is missing, unreadable or has other contents.
        """
        return Dataset(self.name, (self._log(self.train),), (self._log(self.test),))

    def _log(self, file_name: str) -> Log:
        path = find_files([f"emps/{file_name}"], self.folder, OBTAIN)[0]
        content = read_bytes(Path(path))
        table = get_format("mat").parse(path, content)
        time, position, voltage = (pick(table, name).astype(float) for name in ("t", "qm", "vir"))
        for name, values in (("qm", position), ("vir", voltage)):
            if len(values) != len(time):
                raise LogError(f"{path}: {name} has {len(values)} samples and t {len(time)}, expected as many")
        # Check the samples before filtering, which would spread one NaN over all of them.
        raw = Log(path, time, position[:, None], position[:, None], voltage[:, None], "", False)
        velocity = estimate_velocity(position, raw.timestep, self.cutoff, self.order, raw.name)
        return Log(
            file_name,
            time,
            raw.qpos,
            velocity[:, None],
            raw.ctrl,
            hashlib.sha256(content).hexdigest(),
            simulated=False,
            velocity_estimated=True,
            metadata={"citation": CITATION, "file": file_name},
            units={"qpos": "m", "ctrl": "V"},
        )
