"""All targets of this package; importing this module registers them."""

from frictionzoo.export import bench

__all__ = ["bench"]
