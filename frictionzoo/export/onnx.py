"""Target `onnx`: the friction model as an ONNX graph, for ONNX Runtime and others, without Python."""

import logging
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from frictionzoo import __version__
from frictionzoo.core.state import FrictionTerms
from frictionzoo.export.base import register_target
from frictionzoo.export.graph import Graph, GraphFile, list_facts, list_units
from frictionzoo.result.fitted_drive import FittedDrive


@register_target("onnx")
class Onnx(GraphFile):
    """Friction model with its weights in one ONNX file, for any batch size."""

    packages: ClassVar[tuple[str, ...]] = ("onnx", "onnxscript", "onnxruntime")
    file, runtime = "friction.onnx", "ONNX Runtime"

    def serialise(self, graph: Graph, inputs: Mapping[str, torch.Tensor], fitted: FittedDrive) -> bytes:
        """See `GraphFile.serialise`."""
        facts = list_facts(fitted)
        proto = to_proto(graph, inputs, FrictionTerms._fields, facts)
        proto.producer_name, proto.producer_version = "frictionzoo", __version__
        proto.doc_string = f"Friction law {facts['law']}: {facts['sampling']}. {facts['use']}"
        units = {name: unit for group in list_units(fitted) for name, unit in group.items()}
        for signal in (*proto.graph.input, *proto.graph.output):
            signal.doc_string = units[signal.name]
        return proto.SerializeToString()

    def run(self, path: Path, inputs: Mapping[str, torch.Tensor]) -> tuple[np.ndarray, ...]:
        """See `GraphFile.run`."""
        return run_onnx(path, inputs)


def to_proto(
    module: torch.nn.Module, inputs: Mapping[str, torch.Tensor], outputs: Sequence[str], facts: Mapping[str, str]
) -> Any:
    """Return a module as an ONNX model for any batch size, traced with these inputs by name, with metadata `facts`."""
    batch = torch.export.Dim("batch")
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    with warnings.catch_warnings():
        # Warnings about the exporter's internals, and about packages that no friction model needs.
        warnings.simplefilter("ignore")
        logger.setLevel(logging.ERROR)
        try:
            program: Any = torch.onnx.export(
                *(module, tuple(inputs.values())),
                input_names=tuple(inputs),
                output_names=tuple(outputs),
                dynamic_shapes=tuple({0: batch} for _ in inputs),
                dynamo=True,
                verbose=False,
            )
        finally:
            logger.setLevel(level)
    proto = program.model_proto
    # Source locations of all nodes: paths of this machine, and most of the file.
    for part in (proto.graph, *proto.graph.node, *proto.graph.value_info, *proto.graph.input, *proto.graph.output):
        del part.metadata_props[:]
    del proto.metadata_props[:]
    for key, value in facts.items():
        proto.metadata_props.add(key=key, value=value)
    return proto


def run_onnx(path: Path, inputs: Mapping[str, torch.Tensor]) -> tuple[np.ndarray, ...]:
    """Evaluate an ONNX file on the CPU."""
    import onnxruntime

    session = onnxruntime.InferenceSession(path.read_bytes(), providers=["CPUExecutionProvider"])
    return tuple(map(np.asarray, session.run(None, {name: tensor.numpy() for name, tensor in inputs.items()})))
