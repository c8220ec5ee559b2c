"""The friction law as an ONNX graph, which ONNX Runtime and many others run without Python."""

import logging
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from frictionzoo.core.output import write_atomically
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.export.base import Target, register_target
from frictionzoo.export.graph import DTYPES, Graph, compare, example, inputs, limits, read_dtype, signals
from frictionzoo.export.written import Export
from frictionzoo.models.base import FrictionModel
from frictionzoo.result.identified import Identified

FILE = "friction.onnx"


@register_target("onnx")
class Onnx(Target):
    """The law alone, of any batch size, in one file with its weights, run in ONNX Runtime."""

    options: ClassVar[Mapping[str, str]] = {"dtype": "float64 or float32, of inputs and outputs"}
    packages: ClassVar[tuple[str, ...]] = ("onnx", "onnxscript", "onnxruntime")
    instant: ClassVar[bool] = True

    def write(self, fitted: Identified, folder: Path, options: Mapping[str, str]) -> Export:
        """See `Target.write`."""
        dtype = read_dtype(options)
        write_atomically(folder / FILE, export_onnx(fitted.model, dtype))
        difference = compare(fitted, run_onnx(folder / FILE, fitted.samples, dtype), "ONNX Runtime")
        return Export((FILE,), (difference,), limits(fitted.model))


def export_onnx(model: FrictionModel, dtype: str) -> bytes:
    """The law as a serialised ONNX model.

    Args:
        model: The law, holding its identified values.
        dtype: `float64` or `float32`.
    """
    chosen = DTYPES[dtype]
    batch = torch.export.Dim("batch")
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    with warnings.catch_warnings():
        # About the exporter's own internals, and about packages that no law needs.
        warnings.simplefilter("ignore")
        logger.setLevel(logging.ERROR)
        try:
            program: Any = torch.onnx.export(
                Graph(model, chosen),
                example(model, chosen),
                input_names=signals(model),
                output_names=FrictionTerms._fields,
                dynamic_shapes=tuple({0: batch} for _ in signals(model)),
                dynamo=True,
                verbose=False,
            )
        finally:
            logger.setLevel(level)
    return _without_traces(program.model_proto).SerializeToString()


def run_onnx(path: Path, samples: DriveState, dtype: str) -> FrictionTerms:
    """What the file answers in ONNX Runtime on the CPU.

    Args:
        path: The file.
        samples: Arrays of shape (samples, nv).
        dtype: Of the file.
    """
    import onnxruntime

    session = onnxruntime.InferenceSession(path.read_bytes(), providers=["CPUExecutionProvider"])
    given = {name: tensor.numpy() for name, tensor in inputs(samples, DTYPES[dtype]).items()}
    return FrictionTerms(*(np.asarray(output, np.float64) for output in session.run(None, given)))


def _without_traces(proto: Any) -> Any:
    """The model without where in the source each node came from: paths of this machine, and most of the file."""
    for holder in (proto.graph, *proto.graph.node, *proto.graph.value_info, *proto.graph.input, *proto.graph.output):
        del holder.metadata_props[:]
    return proto
