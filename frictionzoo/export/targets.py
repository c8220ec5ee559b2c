"""All targets of this package; importing this module registers them."""

from frictionzoo.export import bam, bench, onnx, torchscript

__all__ = ["bam", "bench", "onnx", "torchscript"]
