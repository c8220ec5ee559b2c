"""What a run leaves in its folder."""

import copy
import time
from pathlib import Path

import safetensors.torch

from frictionzoo import __version__
from frictionzoo.core.errors import OutputError
from frictionzoo.core.output import RESULT, write_atomically
from frictionzoo.export.bench import write_bench
from frictionzoo.export.nearest import find_nearest
from frictionzoo.result.curves import write_curves
from frictionzoo.result.identified import LAW, Identified
from frictionzoo.result.record import write_result
from frictionzoo.show.run_page import write_report
from frictionzoo.show.run_plots import write_figures

MJCF = "identified.xml"
REPORT = "report.html"


def save(identified: Identified, folder: Path) -> None:
    """Write figures, values, curves, the MJCF and the page, and `result.json` last: where that is, all is.

    Args:
        identified: The drive.
        folder: The run's folder; what is there of an earlier run is replaced.

    Raises:
        OutputError: A file cannot be written.
    """
    began = time.perf_counter()
    try:
        (folder / RESULT).unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: {error.strerror}; expected a folder that can be written, name another") from error
    write_figures(folder / "figures", identified.result, identified.curves)
    # One entry only: safetensors writes several in an order that changes from run to run.
    header = {"frictionzoo": f"{identified.model.name}, version {__version__}"}
    write_atomically(folder / LAW, safetensors.torch.save(dict(identified.state), header))
    write_curves(folder, identified.curves)
    # What `python -m frictionzoo.export RUN target=mjcf` writes, too.
    write_atomically(folder / MJCF, write_bench(identified, find_nearest(identified)).encode())
    result = copy.deepcopy(identified.result)
    result["timing"]["total"] += time.perf_counter() - began
    write_report(folder / REPORT, result, identified.curves)
    write_result(folder / RESULT, result)
