"""Warnings about bodies whose size or proportions suggest wrong units or axes."""

import re
import warnings
from dataclasses import dataclass

import numpy as np

from torchcover.simulation.shapes import Mesh

UNIT_REMEDY = (
    "a file in millimeters needs `meters_per_unit: 0.001` next to its `path`, one in centimeters 0.01, one in inches "
    "0.0254"
)
# Poses that turn the front and the top of a vehicle to x and z, for the usual axes of files.
TURN_REMEDY = (
    "a vehicle's x axis points forward and z up: turn it in a vehicle document, as the shape of a part with `poses: "
)
WIDE_REMEDY = TURN_REMEDY + "[{yaw_deg: -90}]` if its y points forward, `{yaw_deg: 90}` if -y does"
HIGH_REMEDY = (
    TURN_REMEDY + "[{yaw_deg: 90, roll_deg: 90}]` if its y points up and its z forward (glTF and GLB), `{roll_deg: 90}`"
    " if y points up and x forward"
)


@dataclass(frozen=True)
class BodySizeParams:
    """Sizes beyond which a body is probably in wrong units or axes.

    Args:
        max_scenery_m: Height, width or length that no building and no visible terrain has.
        max_road_vehicle_m: Longest lorries of the EU (module combinations) and buses.
        max_actor_m: Longest tram or train unit.
        min_road_vehicle_m: Length of the shortest vehicle on a road, including models and robots.
        min_car_m: Robots shorter than this may have any proportions; no car is shorter.
        mast_slenderness: A body that is higher than this multiple of its length and width is a mast, not a car that
            stands on its nose.
        road_vehicles: Words of categories that are longer than wide and high, and no longer than lorries.
        rail_vehicles: Words of categories that may be longer. Pedestrians, which are wider than long, are in neither.
    """

    max_scenery_m: float = 1000.0
    max_road_vehicle_m: float = 25.25
    max_actor_m: float = 100.0
    min_road_vehicle_m: float = 0.2
    min_car_m: float = 2.0
    mast_slenderness: float = 5.0
    road_vehicles: frozenset[str] = frozenset(
        ("ego", "car", "truck", "lorry", "bus", "van", "suv", "vehicle", "trailer", "taxi", "pickup")
    )
    rail_vehicles: frozenset[str] = frozenset(("tram", "train", "rail", "railed"))


def warn_about_actor_size(owner: str, mesh: Mesh, category: str, params: BodySizeParams = BodySizeParams()) -> None:
    """Warn if the body of the ego vehicle or of an actor has an impossible size or proportions.

    Args:
        owner: Name of the body in the message.
        mesh: Mesh in its own frame, x forward and z up.
        category: Class name, such as `vehicle.truck`.
        params: Limits.

    Warns:
        UserWarning: The body is too large or too small, wider than long, or higher than long.
    """
    words = set(re.split(r"[^a-z]+", category.lower()))
    is_road_vehicle = bool(words & params.road_vehicles) and not words & params.rail_vehicles
    x, y, z = np.ptp(mesh.vertices_m, axis=0).tolist()
    largest_m = max(x, y, z)
    if largest_m > (params.max_road_vehicle_m if is_road_vehicle else params.max_actor_m):
        kind = " for a vehicle on a road" if is_road_vehicle else ""
        _warn_about_size(owner, (x, y, z), f"far too large{kind}; {UNIT_REMEDY}")
    elif is_road_vehicle and largest_m < params.min_road_vehicle_m:
        _warn_about_size(owner, (x, y, z), "too small for a vehicle: is its `meters_per_unit` that of its file?")
    elif is_road_vehicle and largest_m > params.min_car_m and max(y, z) > x and z < params.mast_slenderness * max(x, y):
        finding = f"wider than long; {WIDE_REMEDY}" if y > z else f"higher than long; {HIGH_REMEDY}"
        _warn_about_size(owner, (x, y, z), finding)


def warn_about_scenery_size(owner: str, mesh: Mesh, params: BodySizeParams = BodySizeParams()) -> None:
    """Warn if a static body is larger than any scenery in all three dimensions; a flat body may be a whole city.

    Args:
        owner: Name of the body in the message.
        mesh: Mesh of the body.
        params: Limits.

    Warns:
        UserWarning: The body is too large.
    """
    x, y, z = np.ptp(mesh.vertices_m, axis=0).tolist()
    if min(x, y, z) > params.max_scenery_m:
        _warn_about_size(owner, (x, y, z), f"far too large; {UNIT_REMEDY}")


def _warn_about_size(owner: str, size_m: tuple[float, float, float], finding: str) -> None:
    """Warn about the size of a body; the warning points to the caller of the public function."""
    x, y, z = (f"{extent_m:,.0f}" if extent_m >= 1000 else f"{extent_m:.3g}" for extent_m in size_m)
    warnings.warn(f"{owner}: its body is {x} x {y} x {z} m, {finding}", stacklevel=4)
