"""A card's values that somebody else published, which the run judged and did not identify."""

import hashlib
import math
from collections.abc import Mapping
from pathlib import Path

from frictionzoo.card.types import OriginRow
from frictionzoo.core.errors import ConfigError
from frictionzoo.export.read_bam import read_bam
from frictionzoo.result.identified import Identified

STATED = ("bam", "source")
_ROUNDED = 1e-6  # share by which a value of a run in float32 may differ from the file's


def refuse_half(options: Mapping[str, str]) -> None:
    """Refuse a file without who published it, and the reverse.

    Raises:
        ConfigError: One of `bam` and `source` is missing.
    """
    for given, missing, what in (("bam", "source", "who published it and where"), ("source", "bam", "the file")):
        if given in options and missing not in options:
            raise ConfigError(f"{given}={options[given]}: {missing} is missing; say {what}, {missing}=...")


def read_origin(drive: Identified, options: Mapping[str, str]) -> OriginRow | None:
    """Of a parameter file of BAM, whose values the drive's are; None where no file is named.

    Args:
        drive: Of a run with `fit=known`.
        options: `bam`, the file, and `source`, who published it and where; or neither.

    Raises:
        ConfigError: The run identified something, its values are not the file's, or it is no parameter file of BAM.
    """
    if "bam" not in options:
        return None
    path = Path(options["bam"])
    published = read_bam(path)
    if (method := drive.result["fit"]["method"]) != "known":
        raise ConfigError(
            f"bam={path}: the run's values are its own, of fit={method}, expected those of the file; run it with "
            f"$(python -m frictionzoo.export.read_bam {path})"
        )
    if drive.result["model"] != published.model:
        raise ConfigError(
            f"bam={path}: its law is {published.model}, the run's {drive.result['model']}; name the run's own file"
        )
    expected = {f"bench.{name}": value for name, value in published.bench.items()}
    expected |= {f"friction.{name}": value for name, value in published.friction.items()}
    for name, value in expected.items():
        # A delay or an offset that is known to be 0 is none of the parameters.
        held = drive.parameters[name].value.tolist() if name in drive.parameters else [0.0]
        if not all(math.isclose(one, value, rel_tol=_ROUNDED) for one in held):
            raise ConfigError(f"bam={path}: {name} is {value:g} in it, {held[0]:g} in the run; name the run's own file")
    return {
        "project": "BAM",
        "file": path.name,
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "drive": published.actuator,
        "law": published.bam,
        "source": options["source"],
        "remarks": list(published.remarks),
    }
