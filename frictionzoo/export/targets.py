"""All targets of this package; importing this module registers them."""

from frictionzoo.export import bench, onnx, torchscript

__all__ = ["bench", "onnx", "torchscript"]
