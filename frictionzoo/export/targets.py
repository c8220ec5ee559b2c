"""All targets of this package; importing this module registers them."""

from frictionzoo.export import bench, mujoco_c

__all__ = ["bench", "mujoco_c"]
