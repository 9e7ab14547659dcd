"""Ground faces of meshes: the level faces on which one can drive or walk."""

from collections.abc import Sequence

import numpy as np

from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.simulation.local_ground import ROUNDING_M, build_vertical_directions
from torchcover.simulation.patches import find_face_edges, find_outward_faces, label_connected_faces
from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.shapes import Mesh

# Steepest face that counts as level, with a margin for rounding.
MAX_SLOPE_DEG = 45.0 + 1e-6


def find_level_faces(mesh: Mesh, outward_mask: Bools | None = None) -> Bools:
    """Find the faces on which one could stand: not too steep, and on the upper side of a closed body.

    Args:
        mesh: Mesh with F faces.
        outward_mask: (F,) result of `find_outward_faces`; None to compute it.

    Returns:
        (F,) True for level faces.
    """
    is_level, is_downward = _find_faces_towards(mesh, 1.0), find_downward_faces(mesh)
    if is_downward.any():
        # Faces of open surfaces are visible, and can carry, from both sides.
        is_level |= is_downward & ~(find_outward_faces(mesh) if outward_mask is None else outward_mask)
    return is_level


def find_downward_faces(mesh: Mesh) -> Bools:
    """Find the faces whose normal points downwards and that are not too steep to stand on.

    Args:
        mesh: Mesh with F faces.

    Returns:
        (F,) True for these faces.
    """
    return _find_faces_towards(mesh, -1.0)


def _find_faces_towards(mesh: Mesh, z_sign: float) -> Bools:
    """Find the (F,) faces whose normals are within the largest slope of up (1) or down (-1)."""
    is_towards = np.empty(len(mesh.faces), dtype=bool)
    for part, (first, second, third) in mesh.iterate_parts():
        normals = np.cross(second - first, third - first, axis=0)
        min_z = np.cos(np.deg2rad(MAX_SLOPE_DEG)) * np.linalg.norm(normals, axis=0)
        is_towards[part] = (z_sign * normals[2] >= min_z) & (min_z > 0)
    return is_towards


def find_ground_faces(meshes: Sequence[Mesh], positions_m: Float64) -> list[Bools]:
    """Find the level faces below positions, and all level faces that are connected with them.

    Two level surfaces are connected if they share an edge, or if one continues where the other ends with a step of at
    most 0.3 m. If no position has a level face within a meter, any level face below counts, or else a sheet above.

    Args:
        meshes: Meshes in one frame with z up.
        positions_m: (N, 3) positions of the ego vehicle on the ground.

    Returns:
        For each mesh (F,) True for ground faces.
    """
    outward_masks = [find_outward_faces(mesh) for mesh in meshes]
    ground_masks = [find_level_faces(mesh, is_outward) for mesh, is_outward in zip(meshes, outward_masks, strict=True)]
    if not any(is_level.any() for is_level in ground_masks):
        return ground_masks
    level_corners_m, level_outward = [], []
    for mesh, is_level, is_outward in zip(meshes, ground_masks, outward_masks, strict=True):
        level_corners_m.append(mesh.vertices_m[mesh.faces[is_level]])
        level_outward.append(is_outward[is_level])
    corners_m = np.concatenate(level_corners_m)
    level_mesh = Mesh(corners_m.reshape(-1, 3), np.arange(3 * len(corners_m)).reshape(-1, 3))
    edges, edge_faces = find_face_edges(level_mesh)[0], np.repeat(np.arange(len(corners_m)), 3)
    labels = label_connected_faces(edges, edge_faces, len(corners_m))
    _, surfaces = np.unique(labels, return_inverse=True)  # surface of each level face
    surface_faces = np.split(np.argsort(surfaces, kind="stable"), np.cumsum(np.bincount(surfaces))[:-1])
    # Each surface is a body of its own, so that hits tell the surface.
    caster = RayCaster(
        [Mesh(corners_m[faces].reshape(-1, 3), level_mesh.faces[: len(faces)]) for faces in surface_faces]
    )
    border_edges = np.flatnonzero(np.bincount(edges)[edges] == 1)
    probes_m = _compute_probes_m(corners_m, border_edges)
    max_step_m = 0.3  # a step of stairs, or a high curb
    neighbors = _find_surfaces_near(caster, probes_m.reshape(-1, 3), max_step_m)
    border_surfaces = surfaces[edge_faces[border_edges]].repeat(probes_m.shape[1])
    pairs = np.stack([border_surfaces, neighbors])[:, neighbors >= 0]
    groups = label_connected_faces(np.tile(np.arange(pairs.shape[1]), 2), pairs.ravel(), surfaces.max() + 1)
    is_sheet = np.bincount(surfaces, weights=np.concatenate(level_outward)) == 0
    ground_surfaces = _find_surfaces_at(caster, positions_m, is_sheet)
    is_ground = np.isin(groups, groups[ground_surfaces])[surfaces]
    first_face = 0
    for mask in ground_masks:
        num_level = int(np.count_nonzero(mask))
        mask[mask] = is_ground[first_face : first_face + num_level]
        first_face += num_level
    return ground_masks


def _find_surfaces_at(caster: RayCaster, positions_m: Float64, is_sheet: Bools) -> Int64:
    """Find the surfaces on which positions stand; if none is near, surfaces far below, or else sheets above."""
    max_height_m = 1.0  # distance of the ground above or below a position on the ground
    surfaces = _find_surfaces_near(caster, positions_m, max_height_m)
    if (surfaces >= 0).any():
        return surfaces[surfaces >= 0]
    for z_sign in (-1.0, 1.0):
        limit_m = np.full(len(positions_m), np.inf, dtype=np.float32)
        directions = build_vertical_directions(len(positions_m), z_sign)
        hits = caster.cast_from_each(positions_m.astype(np.float32), directions, limit_m)
        surfaces = hits.body_indices.astype(np.int64)
        surfaces = surfaces[(surfaces >= 0) & ((z_sign < 0) | is_sheet[np.maximum(surfaces, 0)])]
        if len(surfaces):
            return surfaces
    return np.empty(0, dtype=np.int64)


def _compute_probes_m(corners_m: Float64, border_edges: Int64) -> Float64:
    """Compute (edges, probes, 3) positions slightly beyond border edges, at the height of the edge."""
    gap_m = 0.02
    edge_shares = np.array([0.1, 0.5, 0.9])
    face, side = np.divmod(border_edges, 3)
    start_m, end_m, apex_m = (corners_m[face, (side + offset) % 3] for offset in range(3))
    along, outwards = (end_m - start_m)[:, :2], ((start_m + end_m) / 2 - apex_m)[:, :2]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    normal *= np.sign((normal * outwards).sum(axis=1, keepdims=True))
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    probes_m = start_m[:, None] + edge_shares[:, None] * (end_m - start_m)[:, None]
    probes_m[..., :2] += gap_m * normal[:, None]
    return np.asarray(probes_m)


def _find_surfaces_near(caster: RayCaster, positions_m: Float64, max_height_m: float) -> Int64:
    """Find the (N,) highest surface within a vertical distance of each position; -1 for none."""
    max_height_m += ROUNDING_M
    starts_m = (positions_m + np.array([0.0, 0.0, max_height_m])).astype(np.float32)
    limit_m = np.full(len(starts_m), 2 * max_height_m, dtype=np.float32)
    directions = build_vertical_directions(len(starts_m), -1.0)
    return caster.cast_from_each(starts_m, directions, limit_m).body_indices.astype(np.int64)
