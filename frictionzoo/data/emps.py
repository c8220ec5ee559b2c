"""EMPS, the Electro-Mechanical Positioning System: public recordings of a ball-screw drive."""

import hashlib
import io
from pathlib import Path
from typing import Any

import scipy.io

from frictionzoo.core.errors import ConfigError, LogError, closest
from frictionzoo.core.log import Dataset, Log
from frictionzoo.data.signals import Signal, check_filter, estimate_velocity
from frictionzoo.data.source import Source, register_source

CITATION = (
    'A. Janot, M. Gautier, M. Brunot, "Data Set and Reference Models of EMPS", Workshop on Nonlinear System '
    "Identification Benchmarks, Eindhoven 2019"
)
OBTAIN = "https://www.nonlinearbenchmark.org/benchmarks/emps"
VARIABLES = ("t", "qm", "vir")


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
        if self.folder is None:
            raise LogError(
                "data.folder=null: the EMPS recordings are not part of the package; set FRICTIONZOO_DATA or "
                f"data.folder to the folder that holds emps/{self.train} and emps/{self.test} (from {OBTAIN})"
            )
        return Dataset(self.name, (self._log(self.train),), (self._log(self.test),))

    def _log(self, file_name: str) -> Log:
        path = Path(str(self.folder)).expanduser() / "emps" / file_name
        content = _read(path)
        time, position, voltage = _columns(path, content)
        # Check the samples before filtering, which would spread one NaN over all of them.
        raw = Log(str(path), time, position[:, None], position[:, None], voltage[:, None], "", False)
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


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise LogError(
            f"{path}: no such file; set FRICTIONZOO_DATA or data.folder to the folder that holds emps/ (from {OBTAIN})"
        ) from None
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror}); expected a .mat file") from None


def _columns(path: Path, content: bytes) -> list[Signal]:
    try:
        stored = scipy.io.loadmat(io.BytesIO(content))
    # SciPy raises many types of errors on a damaged file: ValueError, TypeError, zlib.error, ...
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise LogError(f"{path}: not a readable MATLAB file ({reason}); download it again from {OBTAIN}") from None
    available = [name for name in stored if not name.startswith("__")]
    missing = [name for name in VARIABLES if name not in available]
    if missing:
        raise LogError(
            f"{path}: no variable {', '.join(missing)}, it holds {', '.join(available) or 'none'}; "
            f"{closest(missing[0], available)}; expected t [s], qm [m] and vir [V]"
        )
    for name in VARIABLES:
        kind, shape, times = stored[name].dtype, stored[name].shape, stored["t"].shape
        if kind.kind not in "fiu":
            raise LogError(f"{path}: {name} is of type {kind}, expected real numbers")
        if stored[name].size != max(shape) or stored[name].size != stored["t"].size:
            raise LogError(f"{path}: {name} has shape {shape} and t {times}, expected one column as long as t")
    return [stored[name].ravel().astype(float) for name in VARIABLES]
