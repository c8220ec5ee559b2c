"""All targets of this package; importing this module registers them."""

from frictionzoo.export import bench, mjx_module, mujoco_c

__all__ = ["bench", "mjx_module", "mujoco_c"]
