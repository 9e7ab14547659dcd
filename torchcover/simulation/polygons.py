"""Triangles of polygons that need not be convex; nothing that loads torch may be imported here."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

# Polygons whose corners are held at once.
POLYGONS_AT_ONCE = 1 << 16
# Areas below this share of the squared size of a polygon are rounding.
AREA_TOLERANCE = 1e-9


def triangulate(vertices: Float64, polygons: Sequence[Int64]) -> Int64:
    """Split polygons into triangles that cover exactly their area.

    Args:
        vertices: (V, 3) positions.
        polygons: The vertex indices of each, in order around it; those with fewer than three corners have no triangle.

    Returns:
        (T, 3) vertex indices; the triangles of each polygon are together, in the order of the polygons.

    Raises:
        ValueError: An index that no vertex has.

    Example:
        >>> square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        >>> triangulate(square, [np.arange(4)]).tolist()
        [[0, 1, 2], [0, 2, 3]]
    """
    sizes = np.array([len(polygon) for polygon in polygons], dtype=np.int64)
    starts = np.cumsum([0, *np.maximum(sizes - 2, 0)])
    triangles = np.empty((starts[-1], 3), dtype=np.int64)
    for size in np.unique(sizes[sizes > 2]).tolist():
        of_size = np.flatnonzero(sizes == size)
        for first in range(0, len(of_size), POLYGONS_AT_ONCE):
            numbers = of_size[first : first + POLYGONS_AT_ONCE]
            corners = np.stack([polygons[number] for number in numbers])
            if corners.min() < 0 or corners.max() >= len(vertices):
                raise ValueError(f"faces have vertices {corners.min()} to {corners.max()}; there are {len(vertices)}")
            local = _triangulate_alike(vertices[corners])
            rows = starts[numbers][:, None] + np.arange(size - 2)
            triangles[rows] = np.take_along_axis(corners[:, None], local, axis=2)
    return triangles


def find_bad_fans(corners: Float64) -> NDArray[np.bool_]:
    """(P,) whether the triangles between the first corner and the sides of (P, n, 3) polygons cover more than these."""
    return _turned(corners)[0]


def _turned(corners: Float64) -> tuple[NDArray[np.bool_], Float64, Float64]:
    """Which polygons have a triangle of their fan turned over, (P, 3) unit normals, (P,) areas that are rounding."""
    away = corners - corners[:, :1]
    areas = np.cross(away[:, 1:-1], away[:, 2:])
    normals = areas.sum(axis=1)  # Newell's: of all triangles of the fan, those that are turned over included
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    tolerance = AREA_TOLERANCE * np.linalg.norm(np.ptp(corners, axis=1), axis=1) ** 2
    return ((areas * normals[:, None]).sum(axis=2) < -tolerance[:, None]).any(axis=1), normals, tolerance


def _triangulate_alike(corners: Float64) -> Int64:
    """(P, n - 2, 3) corner numbers of the triangles of (P, n, 3) polygons: a fan where that is right, else ears."""
    polygons, size, _ = corners.shape
    fan = np.stack([np.zeros(size - 2, dtype=np.int64), np.arange(1, size - 1), np.arange(2, size)], axis=1)
    triangles = np.tile(fan, (polygons, 1, 1))
    is_turned, normals, tolerance = _turned(corners)
    for number in np.flatnonzero(is_turned).tolist():
        normal = normals[number]
        first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
        first /= np.linalg.norm(first)
        points = corners[number] @ np.stack([first, np.cross(normal, first)], axis=1)
        triangles[number] = _clip_ears(points - points[0], tolerance[number])
    return triangles


def _clip_ears(points: Float64, tolerance: float) -> list[tuple[int, int, int]]:
    """Corner numbers of the n - 2 triangles of an (n, 2) polygon that runs counterclockwise (Meisters 1975)."""
    triangles = []
    left = list(range(len(points)))
    position = 0
    while len(left) > 3:
        for step in range(len(left)):
            at = (position + step) % len(left)
            ear = left[at - 1], left[at], left[(at + 1) % len(left)]
            if _is_ear(points, ear, left, tolerance):
                break
        else:  # the polygon crosses itself: the flattest corner does the least harm
            areas = [abs(_turn(*points[[left[k - 1], left[k], left[(k + 1) % len(left)]]])) for k in range(len(left))]
            at = int(np.argmin(areas))
            ear = left[at - 1], left[at], left[(at + 1) % len(left)]
        triangles.append(ear)
        del left[at]
        position = at - 1
    a, b, c = left
    return [*triangles, (a, b, c)]


def _is_ear(points: Float64, ear: tuple[int, int, int], left: list[int], tolerance: float) -> bool:
    """Whether a corner can be cut off: it is convex, and no other corner lies in its triangle or on its edges."""
    a, b, c = points[list(ear)]
    if _turn(a, b, c) <= tolerance:
        return False
    others = points[left]
    others = others[~((others[:, None] == (a, b, c)).all(axis=2)).any(axis=1)]
    inside = [_turn(start, end, others) >= -tolerance for start, end in ((a, b), (b, c), (c, a))]
    return not np.all(inside, axis=0).any()


def _turn(a: Float64, b: Float64, c: Float64) -> Float64:
    """Twice the signed area of triangles a, b, c; positive if they turn left."""
    return np.asarray((b[0] - a[0]) * (c[..., 1] - a[1]) - (b[1] - a[1]) * (c[..., 0] - a[0]))
