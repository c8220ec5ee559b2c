"""All targets of this package; importing this module registers them."""

from frictionzoo.export import bam, bench, isaaclab, mjlab, mjx_module, mujoco_c, onnx, torchscript

__all__ = ["bam", "bench", "isaaclab", "mjlab", "mjx_module", "mujoco_c", "onnx", "torchscript"]
