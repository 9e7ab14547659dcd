"""What stands beside a road, as closed convex pieces that are merged into few meshes."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import ArrayLike

from torchcover.geometry import build_transform, convert_euler_to_rotation
from torchcover.geometry.arrays import Float64
from torchcover.simulation.bodies import merge_meshes
from torchcover.simulation.patches import find_outward_faces
from torchcover.simulation.shapes import Mesh, build_band_faces, build_prism_faces, compute_circle_points

PAVEMENT_M = 0.15
# Kerbs go on below the ground, as far as it may rise between two of their corners.
SUNK_M = 0.3
PLACES_ALIKE_M = 1e-6
POST_SIDES = 6
CROWN_SIDES = 6


class Scenery(NamedTuple):
    """`static_meshes` meshes that never move, and the numbers of those that one drives or walks on: `ground_indices`."""

    static_meshes: tuple[Mesh, ...]
    ground_indices: tuple[int, ...]


def build_ground_plane(lower_m: ArrayLike, upper_m: ArrayLike) -> Mesh:
    """The one plane at z = 0 under everything: two triangles, so there is no seam for a ray to slip through."""
    (x0, y0), (x1, y1) = np.asarray(lower_m, dtype=np.float64), np.asarray(upper_m, dtype=np.float64)
    corners = np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]])
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), is_outward=np.zeros(2, dtype=bool)).assign_material("road")


def build_prism(outlines_m: Sequence[ArrayLike], heights_m: Sequence[float]) -> Mesh:
    """A closed body through convex (K, 2) outlines, counter-clockwise from above, at ascending heights."""
    outlines = np.array(outlines_m, dtype=np.float64)
    levels, corners, _ = outlines.shape
    rings = np.empty((levels, corners, 3))
    rings[..., :2] = outlines
    rings[..., 2] = np.reshape(heights_m, (-1, 1))
    return Mesh(rings.reshape(-1, 3), build_prism_faces(levels, corners))


def build_rectangle(x_m: tuple[float, float], y_m: tuple[float, float]) -> Float64:
    """(4, 2) outline."""
    return np.array([[x_m[0], y_m[0]], [x_m[1], y_m[0]], [x_m[1], y_m[1]], [x_m[0], y_m[1]]])


def build_box_from_bounds(x_m: tuple[float, float], y_m: tuple[float, float], z_m: tuple[float, float]) -> Mesh:
    """A box between bounds."""
    outline = build_rectangle(x_m, y_m)
    return build_prism([outline, outline], z_m)


def build_slab(grid_corners_m: Float64, z_m: tuple[float, float]) -> Mesh:
    """A closed body between two heights over a net with (rows, columns, 2) corners, which may bend.

    Seen from above, columns are to the left of rows.
    """
    rows, columns, _ = grid_corners_m.shape
    number = np.arange(rows * columns).reshape(rows, columns)
    here, ahead, aside, across = number[:-1, :-1], number[1:, :-1], number[:-1, 1:], number[1:, 1:]
    over = np.concatenate(
        [np.stack(three, axis=-1).reshape(-1, 3) for three in ((here, ahead, across), (here, across, aside))]
    )
    around = np.concatenate([number[:-1, 0], number[-1, :-1], number[:0:-1, -1], number[0, :0:-1]])
    sides, up = build_band_faces(around, np.roll(around, -1), rows * columns), rows * columns
    places_m = np.tile(grid_corners_m.reshape(-1, 2), (2, 1))
    faces = np.concatenate([over[:, ::-1], over + up, sides])
    return Mesh(np.column_stack([places_m, np.repeat(z_m, up)]), faces, is_outward=np.ones(len(faces), dtype=bool))


def build_sidewalk(outlines: ArrayLike, compute_heights_m: Callable[[Float64], Float64]) -> Mesh:
    """Pavement of one or several outlines: closed, from above the ground, whose heights are given, to below it."""
    triangles = shapely.get_coordinates(shapely.get_parts(shapely.constrained_delaunay_triangles(outlines)))
    corners_m = np.round(triangles.reshape(-1, 4, 2)[:, :3].reshape(-1, 2) / PLACES_ALIKE_M) * PLACES_ALIKE_M
    # Complex numbers are sorted in a fraction of the time that rows take.
    places, faces = np.unique(corners_m.view(np.complex128)[:, 0], return_inverse=True)
    places_m, faces = places.view(np.float64).reshape(-1, 2), faces.reshape(-1, 3)
    first, second, third = places[faces].T
    turns_left = ((second - first).conj() * (third - first)).imag > 0
    faces[~turns_left] = faces[~turns_left][:, ::-1]
    above_m, count = compute_heights_m(places_m), len(places_m)
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    # Around the outline an edge has a triangle on one side only.
    key, back = edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0]
    here, following = edges[~np.isin(key, back)].T
    vertices_m = [np.column_stack([places_m, above_m + up_m]) for up_m in (PAVEMENT_M, -SUNK_M)]
    faces = np.concatenate([faces, faces[:, ::-1] + count, build_band_faces(here + count, following + count, -count)])
    mesh = Mesh(np.concatenate(vertices_m), faces).assign_material("pavement")
    # Where places that are alike have become one, it may be open.
    return mesh._replace(is_outward=find_outward_faces(mesh))


def build_box(center_m: ArrayLike, size_m: ArrayLike, bottom_m: float = 0.0, yaw_deg: float = 0.0) -> Mesh:
    """A box about a point (x, y), turned."""
    length, width, height = np.asarray(size_m, dtype=np.float64)
    shape = build_box_from_bounds((-length / 2, length / 2), (-width / 2, width / 2), (bottom_m, bottom_m + height))
    return shape.transform(build_transform(convert_euler_to_rotation(yaw_deg, 0.0, 0.0), [*np.asarray(center_m), 0.0]))


def build_post(center_m: ArrayLike, radius_m: float, bottom_m: float, height_m: float) -> Mesh:
    """An upright post."""
    outline = np.asarray(center_m) + radius_m * compute_circle_points(POST_SIDES)
    return build_prism([outline, outline], [bottom_m, bottom_m + height_m]).assign_material("metal")


def build_tree(
    center_m: ArrayLike, bottom_m: float, trunk_height_m: float, height_m: float, crown_radius_m: float
) -> list[Mesh]:
    """A trunk, and on it a crown as wide as given."""
    shape, centre = compute_circle_points(CROWN_SIDES), np.asarray(center_m)
    outlines = [centre + share * crown_radius_m * shape for share in (0.45, 1.0, 0.9, 0.3)]
    levels = bottom_m + trunk_height_m + np.array([0.0, 0.3, 0.65, 1.0]) * (height_m - trunk_height_m)
    crown = build_prism(outlines, levels.tolist()).assign_material("vegetation")
    return [build_post(centre, 0.15, bottom_m, trunk_height_m).assign_material("wood"), crown]


def merge_by_kind(*kinds: Sequence[Mesh]) -> tuple[Mesh, ...]:
    """One mesh for each kind of thing that there is."""
    return tuple(merge_meshes(list(pieces)) for pieces in kinds if pieces)
