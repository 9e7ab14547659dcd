"""Meshes of roadside scenery: closed pieces that are merged into few meshes."""

from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import ArrayLike

from torchcover.geometry import build_transform, convert_euler_to_rotation
from torchcover.geometry.arrays import Float64
from torchcover.simulation.bodies import merge_meshes
from torchcover.simulation.patches import find_outward_faces
from torchcover.simulation.shapes import Mesh, build_band_faces, build_prism_faces, compute_circle_points

CURB_HEIGHT_M = 0.15  # height of curbs and sidewalks above the road
# Depth to which curbs continue below the ground, since it may rise between two of their vertices.
SUNK_M = 0.3
TRUNK_SHARE = 0.1  # width of the trunk of a roadside tree, as a share of the width of the tree


class Scenery(NamedTuple):
    """Static part of a scene.

    Args:
        static_meshes: Meshes that never move.
        ground_indices: Indices of the meshes on which road users drive or walk.
    """

    static_meshes: tuple[Mesh, ...]
    ground_indices: tuple[int, ...]


def build_ground_plane(lower_m: ArrayLike, upper_m: ArrayLike) -> Mesh:
    """Build the ground at z = 0 from two triangles, which leaves no seam through which a ray can pass.

    Args:
        lower_m: (2,) smallest x and y.
        upper_m: (2,) largest x and y.
    """
    (x0, y0), (x1, y1) = np.asarray(lower_m, dtype=np.float64), np.asarray(upper_m, dtype=np.float64)
    corners = np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]])
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), is_outward=np.zeros(2, dtype=bool)).assign_material("road")


def build_prism(outlines_m: Sequence[ArrayLike], heights_m: Sequence[float]) -> Mesh:
    """Build a closed body through horizontal outlines.

    Args:
        outlines_m: Convex (K, 2) outlines, counterclockwise from above.
        heights_m: Ascending z of the outlines.

    Example:
        >>> square_m = build_rectangle((0.0, 1.0), (0.0, 1.0))
        >>> build_prism([square_m, square_m], [0.0, 2.0]).vertices_m.shape
        (8, 3)
    """
    outlines = np.array(outlines_m, dtype=np.float64)
    levels, corners, _ = outlines.shape
    rings = np.empty((levels, corners, 3))
    rings[..., :2] = outlines
    rings[..., 2] = np.reshape(heights_m, (-1, 1))
    return Mesh(rings.reshape(-1, 3), build_prism_faces(levels, corners))


def build_rectangle(x_m: tuple[float, float], y_m: tuple[float, float]) -> Float64:
    """Build the counterclockwise outline (4, 2) between bounds of x and y."""
    return np.array([[x_m[0], y_m[0]], [x_m[1], y_m[0]], [x_m[1], y_m[1]], [x_m[0], y_m[1]]])


def build_box_from_bounds(x_m: tuple[float, float], y_m: tuple[float, float], z_m: tuple[float, float]) -> Mesh:
    """Build a box between bounds of x, y and z."""
    outline = build_rectangle(x_m, y_m)
    return build_prism([outline, outline], z_m)


def build_slab(grid_corners_m: Float64, z_m: tuple[float, float]) -> Mesh:
    """Build a closed body between two heights over a grid, which may bend.

    Args:
        grid_corners_m: (rows, columns, 2) corners; seen from above, columns run to the left of rows.
        z_m: Bottom and top.
    """
    rows, columns, _ = grid_corners_m.shape
    num_corners = rows * columns
    index = np.arange(num_corners).reshape(rows, columns)
    corner, ahead, left, opposite = index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]
    right_triangles = np.stack((corner, ahead, opposite), axis=-1).reshape(-1, 3)
    left_triangles = np.stack((corner, opposite, left), axis=-1).reshape(-1, 3)
    surface = np.concatenate([right_triangles, left_triangles])
    boundary = np.concatenate([index[:-1, 0], index[-1, :-1], index[:0:-1, -1], index[0, :0:-1]])
    sides = build_band_faces(boundary, np.roll(boundary, -1), num_corners)
    positions_m = np.tile(grid_corners_m.reshape(-1, 2), (2, 1))
    faces = np.concatenate([surface[:, ::-1], surface + num_corners, sides])
    vertices_m = np.column_stack([positions_m, np.repeat(z_m, num_corners)])
    return Mesh(vertices_m, faces, is_outward=np.ones(len(faces), dtype=bool))


def build_sidewalk(outlines: ArrayLike, compute_heights_m: Callable[[Float64], Float64]) -> Mesh:
    """Build a closed sidewalk from above the ground to below it.

    Args:
        outlines: Polygon or array of polygons in the ground plane.
        compute_heights_m: Function that returns the ground heights (N,) at positions (N, 2).
    """
    merge_distance_m = 1e-6  # vertices that are closer become one
    triangles = shapely.get_coordinates(shapely.get_parts(shapely.constrained_delaunay_triangles(outlines)))
    corners_m = np.round(triangles.reshape(-1, 4, 2)[:, :3].reshape(-1, 2) / merge_distance_m) * merge_distance_m
    # Complex numbers sort in a fraction of the time of rows.
    places, faces = np.unique(corners_m.view(np.complex128)[:, 0], return_inverse=True)
    places_m, faces = places.view(np.float64).reshape(-1, 2), faces.reshape(-1, 3)
    first, second, third = places[faces].T
    turns_left = ((second - first).conj() * (third - first)).imag > 0
    faces[~turns_left] = faces[~turns_left][:, ::-1]
    above_m, count = compute_heights_m(places_m), len(places_m)
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    # Edges of the outline belong to a single triangle.
    key, back = edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0]
    here, following = edges[~np.isin(key, back)].T
    vertices_m = [np.column_stack([places_m, above_m + up_m]) for up_m in (CURB_HEIGHT_M, -SUNK_M)]
    faces = np.concatenate([faces, faces[:, ::-1] + count, build_band_faces(here + count, following + count, -count)])
    mesh = Mesh(np.concatenate(vertices_m), faces).assign_material("pavement")
    # The mesh may be open where vertices were merged.
    return mesh._replace(is_outward=find_outward_faces(mesh))


def build_box(center_m: ArrayLike, size_m: ArrayLike, bottom_m: float = 0.0, yaw_deg: float = 0.0) -> Mesh:
    """Build a box around a vertical axis.

    Args:
        center_m: (2,) x and y of the axis.
        size_m: (3,) length, width and height.
        bottom_m: z of the bottom.
        yaw_deg: Rotation around the axis.
    """
    length, width, height = np.asarray(size_m, dtype=np.float64)
    shape = build_box_from_bounds((-length / 2, length / 2), (-width / 2, width / 2), (bottom_m, bottom_m + height))
    return shape.transform(build_transform(convert_euler_to_rotation(yaw_deg, 0.0, 0.0), [*np.asarray(center_m), 0.0]))


def build_post(center_m: ArrayLike, radius_m: float, bottom_m: float, height_m: float) -> Mesh:
    """Build an upright metal post with six sides.

    Args:
        center_m: (2,) x and y of the axis.
        radius_m: Radius.
        bottom_m: z of the bottom.
        height_m: Height above the bottom.
    """
    outline = np.asarray(center_m) + radius_m * compute_circle_points(6)
    return build_prism([outline, outline], [bottom_m, bottom_m + height_m]).assign_material("metal")


def build_tree(
    center_m: ArrayLike, bottom_m: float, trunk_height_m: float, height_m: float, crown_radius_m: float
) -> list[Mesh]:
    """Build the trunk and the crown of a tree.

    Args:
        center_m: (2,) x and y of the trunk.
        bottom_m: z of the bottom.
        trunk_height_m: Height at which the crown begins, above the bottom.
        height_m: Height of the tree, above the bottom.
        crown_radius_m: Largest radius of the crown.
    """
    shape, center = compute_circle_points(6), np.asarray(center_m)
    outlines = [center + share * crown_radius_m * shape for share in (0.45, 1.0, 0.9, 0.3)]
    levels = bottom_m + trunk_height_m + np.array([0.0, 0.3, 0.65, 1.0]) * (height_m - trunk_height_m)
    crown = build_prism(outlines, levels.tolist()).assign_material("vegetation")
    return [build_post(center, 0.15, bottom_m, trunk_height_m).assign_material("wood"), crown]


def merge_by_kind(*kinds: Sequence[Mesh]) -> tuple[Mesh, ...]:
    """Merge the meshes of each kind into one mesh; kinds without meshes are omitted."""
    return tuple(merge_meshes(list(pieces)) for pieces in kinds if pieces)


def copy_shape(shape: Mesh, outlines_m: Float64, bottom_m: Float64, base_m: Float64, heights_m: Float64) -> Mesh:
    """Copy a unit shape onto N outlines.

    Args:
        shape: Closed mesh in the unit cube.
        outlines_m: (N, 4, 2) outlines of the unit square in the ground plane.
        bottom_m: (N,) z of the vertices at z = 0.
        base_m: (N,) z from which the heights count.
        heights_m: (N,) heights.
    """
    x, y, z = shape.vertices_m.T
    # Bilinear coordinates of the vertices in the outline.
    weights = np.stack([(1 - x) * (1 - y), x * (1 - y), x * y, (1 - x) * y], axis=1)
    num_copies = len(outlines_m)
    positions_m = np.einsum("vc,ncd->nvd", weights, outlines_m)
    z_m = np.where(z == 0.0, bottom_m[:, None], base_m[:, None] + heights_m[:, None] * z)
    faces = shape.faces + len(x) * np.arange(num_copies)[:, None, None]
    vertices_m = np.concatenate([positions_m, z_m[..., None]], axis=2).reshape(-1, 3)
    material_indices = np.tile(shape.filled_material_indices, num_copies)
    is_outward = np.ones(num_copies * len(shape.faces), dtype=bool)
    return Mesh(vertices_m, faces.reshape(-1, 3), material_indices, is_outward)


@cache
def build_unit_shape(name: str) -> Mesh:
    """Build a shape in the unit cube, with the street beyond y = 1.

    Args:
        name: Shape of a kind of roadside objects; "bicycle" for all unknown names.
    """
    box = build_box_from_bounds((0.0, 1.0), (0.0, 1.0), (0.0, 1.0))
    if name == "house":
        return box
    if name in ("hedge", "fence", "bin"):
        return box.assign_material({"hedge": "vegetation", "fence": "wood", "bin": "metal"}[name])
    if name == "bollard":
        return build_round_shape([0.0, 1.0], [1.0, 1.0]).assign_material("metal")
    if name == "lamp":
        post = build_round_shape([0.0, 0.97], [1.0, 0.7]).assign_material("metal")
        return merge_meshes([post, build_box_from_bounds((0.2, 0.8), (0.0, 11.0), (0.975, 1.0))])
    if name == "tree":
        trunk = build_round_shape([0.0, 0.42], [TRUNK_SHARE, TRUNK_SHARE]).assign_material("wood")
        crown = build_round_shape([0.42, 0.6, 0.8, 1.0], [0.45, 1.0, 0.9, 0.3])
        return merge_meshes([trunk, crown.assign_material("vegetation")])
    if name == "bush":
        return build_round_shape([0.0, 0.4, 0.8, 1.0], [0.7, 1.0, 0.9, 0.4]).assign_material("vegetation")
    if name == "sign":
        post = build_box_from_bounds((0.0, 1.0), (0.45, 0.55), (0.0, 0.75)).assign_material("metal")
        return merge_meshes([post, build_box_from_bounds((0.2, 0.8), (0.0, 1.0), (0.755, 1.0)).assign_material("sign")])
    frame = build_box_from_bounds((0.42, 0.58), (0.44, 0.56), (0.25, 0.88))
    handlebar = build_box_from_bounds((0.66, 0.7), (0.0, 1.0), (0.94, 1.0))
    return merge_meshes([build_wheel(0.0), build_wheel(0.6), frame, handlebar])


def build_round_shape(levels: Sequence[float], diameters: Sequence[float]) -> Mesh:
    """Build a shape with six sides around the vertical axis of the unit cube.

    Args:
        levels: Ascending z.
        diameters: Diameter at each level.
    """
    ring = 0.5 * compute_circle_points(6)
    return build_prism([np.array([0.5, 0.5]) + diameter * ring for diameter in diameters], levels)


def build_wheel(x: float) -> Mesh:
    """Build a wheel of a bicycle in the unit cube.

    Args:
        x: Smallest x of the wheel.
    """
    ring = 0.5 * compute_circle_points(6)
    outline = np.array([x, 0.0]) + np.array([0.4, 0.65]) * (ring / np.array([1.0, np.sqrt(0.75)]) + 0.5)
    disc = build_prism([outline, outline], [0.46, 0.54])
    return Mesh(disc.vertices_m[:, [0, 2, 1]], disc.faces[:, ::-1])
