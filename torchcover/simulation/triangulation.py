"""Triangulation of polygons, convex or not. Nothing that loads torch may be imported here, see `mesh_files`."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]


def triangulate(vertices: Float64, polygons: Sequence[Int64]) -> Int64:
    """Split polygons into triangles that cover exactly their area.

    Args:
        vertices: (V, 3) positions.
        polygons: Vertex indices of each polygon, in order around it; fewer than three corners give no triangle.

    Returns:
        (T, 3) vertex indices; the triangles of each polygon are together, in the order of the polygons.

    Raises:
        ValueError: A polygon has an index that no vertex has.

    Example:
        >>> square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        >>> triangulate(square, [np.arange(4)]).tolist()
        [[0, 1, 2], [0, 2, 3]]
    """
    polygons_per_chunk = 1 << 16  # bounds the memory for the corners of polygons of one size
    sizes = np.array([len(polygon) for polygon in polygons], dtype=np.int64)
    first_triangles = np.cumsum([0, *np.maximum(sizes - 2, 0)])
    triangles = np.empty((first_triangles[-1], 3), dtype=np.int64)
    for size in np.unique(sizes[sizes > 2]).tolist():
        polygon_indices = np.flatnonzero(sizes == size)
        for start in range(0, len(polygon_indices), polygons_per_chunk):
            chunk = polygon_indices[start : start + polygons_per_chunk]
            corners = np.stack([polygons[index] for index in chunk])
            if corners.min() < 0 or corners.max() >= len(vertices):
                raise ValueError(f"faces have vertices {corners.min()} to {corners.max()}; there are {len(vertices)}")
            local_triangles = _triangulate_polygons_of_one_size(vertices[corners])
            rows = first_triangles[chunk][:, None] + np.arange(size - 2)
            triangles[rows] = np.take_along_axis(corners[:, None], local_triangles, axis=2)
    return triangles


def find_bad_fans(corners: Float64) -> NDArray[np.bool_]:
    """Find polygons that a triangle fan does not cover exactly, because one of its triangles is turned over.

    Args:
        corners: (P, n, 3) corners of polygons; a fan joins the first corner with all sides.

    Returns:
        (P,) True where a fan covers more than the polygon.
    """
    return _compute_fans(corners).is_bad


class _Fans(NamedTuple):
    """Properties of the triangle fans of P polygons.

    Args:
        is_bad: (P,) True where a triangle is turned over.
        normals: (P, 3) unit normals of the polygons.
        area_tolerance: (P,) areas up to which a sign is rounding.
    """

    is_bad: NDArray[np.bool_]
    normals: Float64
    area_tolerance: Float64


def _compute_fans(corners: Float64) -> _Fans:
    """Compute the properties of the fans of (P, n, 3) polygons."""
    from_first = corners - corners[:, :1]
    areas = np.cross(from_first[:, 1:-1], from_first[:, 2:])
    # Newell's normal: the sum over all triangles of the fan, including those that are turned over.
    normals = areas.sum(axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    # Areas below this share of the squared size of a polygon are rounding.
    area_tolerance = 1e-9 * np.linalg.norm(np.ptp(corners, axis=1), axis=1) ** 2
    is_bad = ((areas * normals[:, None]).sum(axis=2) < -area_tolerance[:, None]).any(axis=1)
    return _Fans(is_bad, normals, area_tolerance)


def _triangulate_polygons_of_one_size(corners: Float64) -> Int64:
    """Compute (P, n - 2, 3) corner numbers of triangles of (P, n, 3) polygons: a fan if exact, else ear clipping."""
    num_polygons, size, _ = corners.shape
    fan = np.stack([np.zeros(size - 2, dtype=np.int64), np.arange(1, size - 1), np.arange(2, size)], axis=1)
    triangles = np.tile(fan, (num_polygons, 1, 1))
    is_bad, normals, area_tolerance = _compute_fans(corners)
    for index in np.flatnonzero(is_bad).tolist():
        normal = normals[index]
        first_axis = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
        first_axis /= np.linalg.norm(first_axis)
        points = corners[index] @ np.stack([first_axis, np.cross(normal, first_axis)], axis=1)
        triangles[index] = _clip_ears(points - points[0], area_tolerance[index])
    return triangles


def _clip_ears(points: Float64, area_tolerance: float) -> list[tuple[int, int, int]]:
    """Triangulate an (n, 2) polygon that runs counter-clockwise by ear clipping (Meisters 1975).

    Returns:
        Corner numbers of the n - 2 triangles.
    """
    triangles = []
    remaining = list(range(len(points)))
    start = 0
    while len(remaining) > 3:
        for offset in range(len(remaining)):
            tip = (start + offset) % len(remaining)
            ear = _get_ear(remaining, tip)
            if _is_ear(points, ear, remaining, area_tolerance):
                break
        else:  # the polygon crosses itself: the flattest corner does the least harm
            ears = [_get_ear(remaining, tip) for tip in range(len(remaining))]
            areas = [abs(_compute_doubled_area(*points[list(ear)])) for ear in ears]
            tip = int(np.argmin(areas))
            ear = ears[tip]
        triangles.append(ear)
        del remaining[tip]
        start = tip - 1
    a, b, c = remaining
    return [*triangles, (a, b, c)]


def _get_ear(corners: list[int], tip: int) -> tuple[int, int, int]:
    """Get the corner at a position with its two neighbors."""
    return corners[tip - 1], corners[tip], corners[(tip + 1) % len(corners)]


def _is_ear(points: Float64, ear: tuple[int, int, int], remaining: list[int], area_tolerance: float) -> bool:
    """Return True if a corner is convex and no other corner lies in its triangle or on its edges."""
    a, b, c = points[list(ear)]
    if _compute_doubled_area(a, b, c) <= area_tolerance:
        return False
    candidates = points[remaining]
    candidates = candidates[~((candidates[:, None] == (a, b, c)).all(axis=2)).any(axis=1)]
    is_inside_edge = [
        _compute_doubled_area(start, end, candidates) >= -area_tolerance for start, end in ((a, b), (b, c), (c, a))
    ]
    return not np.all(is_inside_edge, axis=0).any()


def _compute_doubled_area(a: Float64, b: Float64, c: Float64) -> Float64:
    """Compute twice the signed area of triangles a, b, c in 2D; positive if they turn left."""
    return np.asarray((b[0] - a[0]) * (c[..., 1] - a[1]) - (b[1] - a[1]) * (c[..., 0] - a[0]))
