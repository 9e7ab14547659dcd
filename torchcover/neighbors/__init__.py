"""Exact nearest neighbours. Knows no other part of the house.

One entry, `nearest`; a backend is a file with one function `search(query, points, max_distance, memory_mb)`
that returns the index of a nearest point. What a distance is, and its gradient, is decided once, in `nearest`.
"""

from torchcover.neighbors.choice import BACKENDS
from torchcover.neighbors.query import (
    NearestPoints,
    blind_spot_radius,
    check_cloud,
    check_tensor,
    check_weights,
    nearest,
)

__all__ = ["BACKENDS", "NearestPoints", "blind_spot_radius", "check_cloud", "check_tensor", "check_weights", "nearest"]
