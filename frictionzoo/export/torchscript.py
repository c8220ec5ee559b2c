"""Target `torchscript`: the friction model as TorchScript, for `torch.jit.load` and libtorch without frictionzoo."""

import io
import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from frictionzoo.export.base import register_target
from frictionzoo.export.graph import Graph, GraphFile, list_facts
from frictionzoo.result.fitted_drive import FittedDrive

FACTS = "frictionzoo.json"
"""Metadata file in the archive: `torch.jit.load(path, _extra_files={"frictionzoo.json": ""})`."""

_OWN = ("version", ".data/serialization_id")  # the writer adds these records


@register_target("torchscript")
class TorchScript(GraphFile):
    """Friction model with its weights in one TorchScript file, for any batch size and device."""

    packages: ClassVar[tuple[str, ...]] = ("torch",)
    file, runtime = "friction.pt", "torch.jit.load"
    remarks = (
        "PyTorch calls TorchScript deprecated; simulators still load it. It is not Isaac Lab's actuator network: "
        "target=actuator_net writes that.",
    )

    def serialise(self, graph: Graph, inputs: Mapping[str, torch.Tensor], fitted: FittedDrive) -> bytes:
        """See `GraphFile.serialise`."""
        return to_script(graph, inputs, list_facts(fitted))

    def run(self, path: Path, inputs: Mapping[str, torch.Tensor]) -> tuple[np.ndarray, ...]:
        """See `GraphFile.run`."""
        return tuple(map(np.asarray, load_script(path)(**inputs)))


def to_script(module: torch.nn.Module, inputs: Mapping[str, Any], facts: Mapping[str, str]) -> bytes:
    """Return a module as TorchScript, traced with these inputs, with `facts` in the archive."""
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"`torch\.jit", DeprecationWarning)
        # Of the checks of an LSTM's shapes, which do not depend on the batch.
        warnings.filterwarnings("ignore", category=torch.jit.TracerWarning, module=r"torch\.nn\.modules\.rnn")
        traced = torch.jit.trace(module, tuple(inputs.values()))
        torch.jit.save(traced, buffer, _extra_files={FACTS: json.dumps(dict(facts), indent=2)})
    return _without_traces(buffer.getvalue())


def load_script(path: Path) -> torch.jit.ScriptModule:
    """Load a TorchScript file."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"`torch\.jit", DeprecationWarning)
        return torch.jit.load(path)


def _without_traces(content: bytes) -> bytes:
    """Remove the source locations of all operations: paths of this machine."""
    buffer, reader = io.BytesIO(), torch._C.PyTorchFileReader(io.BytesIO(content))
    writer = torch._C.PyTorchFileWriter(buffer)
    for name in reader.get_all_records():
        if not name.endswith(".debug_pkl") and name not in _OWN:
            record = reader.get_record(name)
            writer.write_record(name, record, len(record))
    writer.write_end_of_file()
    return buffer.getvalue()
