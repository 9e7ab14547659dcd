"""Exact nearest-neighbor search on CPUs and GPUs, independent of the rest of the package.

`nearest` is the entry point. A backend is a module with one function `search(query, points, max_distance, memory_mb)`
that returns the index of a nearest point; `nearest` itself computes distances and gradients, for all backends alike.
"""

from torchcover.neighbors.backend_choice import BACKENDS
from torchcover.neighbors.query import (
    NearestPoints,
    blind_spot_radius,
    check_cloud,
    check_tensor,
    check_weights,
    nearest,
)

__all__ = ["BACKENDS", "NearestPoints", "blind_spot_radius", "check_cloud", "check_tensor", "check_weights", "nearest"]
