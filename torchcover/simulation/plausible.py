"""Hints that a body is in another unit than metres, or turned: only where nothing real would look like it."""

import re
import warnings

import numpy as np

from torchcover.simulation.shapes import Mesh

# No building, and no terrain within a sensor's range, is higher.
TALLEST_SCENERY_M = 1000.0
# The longest lorries of the EU (module combinations of 25.25 m) and buses; the longest tram or train unit.
LONGEST_ON_ROADS_M = 25.25
LONGEST_M = 100.0
# Smaller robots exist with any proportions; no car is shorter.
SHORTEST_CAR_M = 2.0
SHORTEST_M = 0.2

# Words of a category that stand for what is longer than wide and high, and no longer than lorries. Of the others,
# people are wider than long, and trams longer.
ROAD_VEHICLES = {"ego", "car", "truck", "lorry", "bus", "van", "suv", "vehicle", "trailer", "taxi", "pickup"}
RAIL_VEHICLES = {"tram", "train", "rail", "railed"}

TURN = (
    "a vehicle's x axis points forward and z up: turn it in a vehicle document, as the shape of a part with "
    "`poses: [{yaw_deg: 90}]`"
)
UNITS = (
    "a file in millimetres needs `metres_per_unit: 0.001` beside its `path`, one in centimetres 0.01, one in inches "
    "0.0254"
)


def warn_of_mover(owner: str, mesh: Mesh, category: str) -> None:
    """Warn if the ego or an actor is as large, as small or as wide as none is.

    Args:
        owner: What the warning calls it.
        mesh: Its form, x forward and z up.
        category: What it is: "ego", or that of an actor.
    """
    words = set(re.split(r"[^a-z]+", category.lower()))
    on_roads = bool(words & ROAD_VEHICLES) and not words & RAIL_VEHICLES
    x, y, z = np.ptp(mesh.vertices_m, axis=0).tolist()
    longest_m = max(x, y, z)
    if longest_m > (LONGEST_ON_ROADS_M if on_roads else LONGEST_M):
        _warn(owner, (x, y, z), f"far too large{' for a vehicle on a road' if on_roads else ''}; {UNITS}")
    elif on_roads and longest_m < SHORTEST_M:
        _warn(owner, (x, y, z), "too small for a vehicle: is its `metres_per_unit` that of its file?")
    elif on_roads and longest_m > SHORTEST_CAR_M and max(y, z) > x:
        _warn(owner, (x, y, z), f"{'wider' if y > z else 'higher'} than long; {TURN}")


def warn_of_scenery(owner: str, mesh: Mesh) -> None:
    """Warn if what never moves, which may be a whole city, is larger than any in all three extents.

    Args:
        owner: What the warning calls it.
        mesh: Its form.
    """
    x, y, z = np.ptp(mesh.vertices_m, axis=0).tolist()
    if min(x, y, z) > TALLEST_SCENERY_M:
        _warn(owner, (x, y, z), f"far too large; {UNITS}")


def _warn(owner: str, size_m: tuple[float, float, float], what: str) -> None:
    x, y, z = (f"{extent_m:,.0f}" if extent_m >= 1000 else f"{extent_m:.3g}" for extent_m in size_m)
    warnings.warn(f"{owner}: its body is {x} x {y} x {z} m, {what}", stacklevel=4)
