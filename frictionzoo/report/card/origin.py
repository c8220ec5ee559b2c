"""Origin of values that someone else published and the run only evaluated."""

import hashlib
import math
from collections.abc import Mapping
from pathlib import Path

from frictionzoo.bench.read_bam import read_bam
from frictionzoo.core.errors import ConfigError
from frictionzoo.report.card.types import OriginRow
from frictionzoo.result.fitted_drive import FittedDrive

STATED = ("bam", "source")
_ROUNDED = 1e-6  # relative difference allowed between a float32 value of the run and the file


def refuse_half(options: Mapping[str, str]) -> None:
    """Refuse a parameter file without its source, and a source without a file.

    Raises:
        ConfigError: One of `bam` and `source` is missing.
    """
    for present, missing, hint in (("bam", "source", "who published it and where"), ("source", "bam", "the file")):
        if present in options and missing not in options:
            raise ConfigError(f"{present}={options[present]}: {missing} is missing; say {hint}, {missing}=...")


def read_origin(drive: FittedDrive, options: Mapping[str, str]) -> OriginRow | None:
    """Return the origin of a drive whose values come from a BAM parameter file; None without such a file.

    `options` has `bam`, the file, and `source`, who published it and where; or neither.

    Raises:
        ConfigError: The run identified its values, its model or values differ from the file's, or the file is not a BAM
            parameter file.
    """
    if "bam" not in options:
        return None
    path = Path(options["bam"])
    published = read_bam(path)
    if (method := drive.result["fit"]["method"]) != "known":
        raise ConfigError(
            f"bam={path}: the run identified its values (fit={method}), expected the file's values; run it with "
            f"$(python -m frictionzoo.bench.read_bam {path})"
        )
    if drive.result["model"] != published.model:
        raise ConfigError(
            f"bam={path}: its model is {published.model}, the run's {drive.result['model']}; name the run's own file"
        )
    expected = {f"bench.{name}": value for name, value in published.bench.items()}
    expected |= {f"friction.{name}": value for name, value in published.friction.items()}
    for name, value in expected.items():
        # A delay or an offset that is fixed at 0 is not a parameter of the drive.
        run_values = drive.parameters[name].value.tolist() if name in drive.parameters else [0.0]
        if not all(math.isclose(run_value, value, rel_tol=_ROUNDED) for run_value in run_values):
            raise ConfigError(f"bam={path}: {name} is {value:g}, in the run {run_values[0]:g}; name the run's own file")
    return {
        "project": "BAM",
        "file": path.name,
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "drive": published.actuator,
        "law": published.bam,
        "source": options["source"],
        "remarks": list(published.remarks),
    }
