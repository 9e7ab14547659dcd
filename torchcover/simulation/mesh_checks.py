"""Checks of meshes: inconsistent normals, open bodies, repeated faces, and surfaces that coincide."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.simulation.patches import (
    find_face_edges,
    find_outward_faces,
    find_outward_faces_from_edges,
    label_surfaces,
)
from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.shapes import Mesh, compute_normals, get_corners_m, iterate_mesh_parts

# Faces within this distance coincide.
COINCIDENCE_M = 1e-3
# Faces within this distance are the same to float32.
ROUNDING_M = 1e-4
# Rays start this far from a face: no coincident face lies at their begin or end.
START_DISTANCE_M = COINCIDENCE_M + ROUNDING_M


def check_mesh(owner: str, mesh: Mesh) -> Mesh:
    """Remove repeated faces, and warn about other defects of a mesh.

    Args:
        owner: Name of the mesh in warnings.
        mesh: Mesh.

    Returns:
        Mesh with each face once and with `is_outward`.

    Warns:
        UserWarning: Repeated faces, neighbors whose normals disagree, or a body that is not closed.
    """
    edges, directions = find_face_edges(mesh)
    unique_faces = _find_unique_faces(edges, directions)
    if len(unique_faces) < len(mesh.faces):
        count_text = _format_share(len(mesh.faces) - len(unique_faces), len(mesh.faces))
        _warn(owner, f"{count_text} of its faces are there more than once, and count once")
        mesh = mesh.select_faces(unique_faces)
        edges, directions = find_face_edges(mesh)
    surfaces = label_surfaces(edges)
    face_counts = np.bincount(edges, weights=directions != 0)
    direction_sums = np.bincount(edges, weights=directions)
    is_inner = face_counts == 2
    is_inconsistent = is_inner & (np.abs(direction_sums) == 2)
    is_open = face_counts % 2 == 1
    if is_inconsistent.any():
        _warn(
            owner,
            f"the normals of neighbors disagree at {_format_share(int(is_inconsistent.sum()), int(is_inner.sum()))} of "
            "its inner edges: both sides of its faces count, and nothing lies inside of it; make its normals "
            "consistent in a modeling tool",
        )
    elif is_open.any():
        open_corners = np.flatnonzero(is_open[edges])
        is_open_surface = np.bincount(surfaces[open_corners // 3], minlength=len(mesh.faces)) > 0
        is_open_body = is_open_surface[surfaces] & _find_body_surfaces(mesh, surfaces)[surfaces]
        if is_open_body.any():
            _warn(
                owner,
                f"{_format_share(int(is_open.sum()), int((face_counts > 0).sum()))} of its edges have a face on one "
                "side only, though it looks like a body: rays pass through the holes, and nothing lies inside of it; "
                "close it in a modeling tool",
            )
    return mesh._replace(is_outward=find_outward_faces_from_edges(mesh, edges, directions, surfaces))


def find_coincident_faces(meshes: Sequence[Mesh], allow_within_mesh: Sequence[bool]) -> list[Bools]:
    """Find faces that coincide with another face that is visible from the same side, within 1 mm.

    Points of the faces are tested, so that surfaces with a small common area may be missed.

    Args:
        meshes: Static meshes near the origin.
        allow_within_mesh: For each mesh True to also search for coincident faces within the mesh, such as parts of a
            vehicle that end in one plane.

    Returns:
        For each mesh (F,) True for coincident faces.
    """
    is_outward = np.concatenate([find_outward_faces(mesh) for mesh in meshes])
    mesh_indices = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
    is_coincident = np.zeros(len(mesh_indices), dtype=bool)
    layers = _build_layers(meshes)
    long_side_m = 4.0  # triangles with a longer side are tested at more points
    for part, corners_m in iterate_mesh_parts(meshes):
        has_area = compute_normals(corners_m).any(axis=0)
        is_long = np.linalg.norm(corners_m - corners_m[[2, 0, 1]], axis=1).max(axis=0) > long_side_m
        for is_selected, points_per_side in ((has_area & ~is_long, 2), (has_area & is_long, 10)):
            faces, face_corners_m = part.start + np.flatnonzero(is_selected), corners_m[..., is_selected]
            if len(faces) == 0:
                continue
            normals = compute_normals(face_corners_m).T
            search_within = np.array(allow_within_mesh, dtype=bool)[mesh_indices[faces]]
            for weights in _compute_point_weights(points_per_side):
                points_m = np.tensordot(weights, face_corners_m, 1).T
                rows, other_faces = _find_faces_at_points(points_m, normals, mesh_indices[faces], search_within, layers)
                is_other = other_faces != faces[rows]
                rows, other_faces = rows[is_other], other_faces[is_other]
                is_pair = _find_coincident_pairs(rows, faces[rows], other_faces, normals[rows], meshes, is_outward)
                is_coincident[faces[rows[is_pair]]] = is_coincident[other_faces[is_pair]] = True
    return np.split(is_coincident, np.cumsum([len(mesh.faces) for mesh in meshes])[:-1])


@dataclass(frozen=True, eq=False)
class _Layer:
    """Bodies that do not touch each other.

    `caster` has these bodies, `mesh_mask` (meshes,) marks them, and `face_indices` are the numbers of their faces.
    """

    caster: RayCaster
    mesh_mask: Bools
    face_indices: Int64


def _build_layers(meshes: Sequence[Mesh]) -> list[_Layer]:
    """Distribute bodies to layers, so that bodies that may touch are in different layers.

    Which of several faces at the same position a ray hits first depends on rounding: layers are cast separately.
    """
    lower_m = np.full((len(meshes), 3), np.nan)
    upper_m = np.full((len(meshes), 3), np.nan)
    for index, mesh in enumerate(meshes):
        if len(mesh.faces):
            lower_m[index], upper_m[index] = mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)
    margin_m = 2 * COINCIDENCE_M
    layer_numbers = np.full(len(meshes), -1)
    for index in range(len(meshes)):
        touches = (lower_m[:index] <= upper_m[index] + margin_m) & (upper_m[:index] >= lower_m[index] - margin_m)
        used_layers = layer_numbers[:index][touches.all(axis=1)]
        layer_numbers[index] = next(layer for layer in range(index + 1) if layer not in used_layers)
    face_layers = np.repeat(layer_numbers, [len(mesh.faces) for mesh in meshes])
    layers = []
    for layer in range(layer_numbers.max() + 1):
        mesh_mask = layer_numbers == layer
        caster = RayCaster([meshes[index] for index in np.flatnonzero(mesh_mask).tolist()])
        layers.append(_Layer(caster, mesh_mask, np.flatnonzero(face_layers == layer)))
    return layers


def _find_faces_at_points(
    points_m: Float64, normals: Float64, mesh_indices: Int64, search_within: Bools, layers: Sequence[_Layer]
) -> tuple[Int64, Int64]:
    """Find faces close to points of faces.

    Args:
        points_m: (N, 3) points on N faces.
        normals: (N, 3) normals of these faces.
        mesh_indices: (N,) meshes of these faces.
        search_within: (N,) True if faces of the same mesh are searched as well.
        layers: All faces.

    Returns:
        (K,) rows of the points and (K,) numbers of faces there, the face itself included.
    """
    found_rows, found_faces = [], []
    for layer in layers:
        is_own_layer = layer.mesh_mask[mesh_indices]
        # From above a ray finds faces of other bodies on or below the face. In the body of the face, a second ray from
        # just below is needed, since the first one may hit the face itself.
        for start_m, is_selected in (
            (START_DISTANCE_M, ~is_own_layer | search_within),
            (-ROUNDING_M, is_own_layer & search_within),
        ):
            rows = np.flatnonzero(is_selected)
            starts_m = points_m[rows] + start_m * normals[rows]
            limit_m = START_DISTANCE_M + max(start_m, -COINCIDENCE_M / 2)
            faces = layer.caster.find_first_faces(starts_m, -normals[rows], limit_m)
            is_hit = faces >= 0
            found_rows.append(rows[is_hit])
            found_faces.append(layer.face_indices[faces[is_hit]])
    return np.concatenate(found_rows), np.concatenate(found_faces)


def _find_coincident_pairs(
    rows: Int64, faces: Int64, other_faces: Int64, normals: Float64, meshes: Sequence[Mesh], is_outward: Bools
) -> Bools:
    """Find the pairs of close faces that are visible from the same side.

    Args:
        rows: (K,) points at which the pairs were found.
        faces: (K,) first face of each pair.
        other_faces: (K,) second face.
        normals: (K, 3) normals of the first faces.
        meshes: Meshes.
        is_outward: (all faces,) result of `find_outward_faces`.
    """
    min_cosine = 0.9  # of the angle between coincident faces
    other_normals = compute_normals(get_corners_m(meshes, other_faces)).T
    cosine = (normals * other_normals).sum(axis=1)
    is_parallel, is_opposite = cosine > min_cosine, cosine < -min_cosine
    # The bottom of a body that stands on a sheet is invisible, and so are faces that coincide with it there.
    is_bottom = is_outward[faces] & (normals[:, 2] < -min_cosine)
    is_other_bottom = is_outward[other_faces] & (other_normals[:, 2] < -min_cosine)
    stands_on_sheet = is_bottom & ~is_outward[other_faces] & (is_parallel | is_opposite)
    is_hidden = np.isin(rows, rows[stands_on_sheet])
    # Faces back to back are visible from different sides, unless one of them is a sheet.
    has_common_side = is_parallel | (is_opposite & ~(is_outward[faces] & is_outward[other_faces]) & ~is_other_bottom)
    return np.asarray(~is_hidden & has_common_side)


def warn_about_coincident_faces(names: Sequence[str], coincident_masks: Sequence[Bools]) -> None:
    """Warn about bodies whose surfaces coincide with others.

    Args:
        names: Names of the bodies.
        coincident_masks: For each body (F,) result of `find_coincident_faces`.

    Warns:
        UserWarning: Some faces coincide; up to five bodies are named.
    """
    bodies = {}
    for name, mask in zip(names, coincident_masks, strict=True):
        if mask.any():
            bodies[name] = f"{name!r} ({_format_share(int(mask.sum()), len(mask))} of the faces)"
    if bodies:
        warnings.warn(
            f"{', '.join(list(bodies.values())[:5])}: faces lie within {COINCIDENCE_M * 1000:g} mm of others "
            "with the same orientation; where faces cover each other one counts",
            stacklevel=3,
        )


def _find_unique_faces(edges: Int64, directions: NDArray[np.int8]) -> Int64:
    """Find the faces without those that use the same edges in the same direction as an earlier face."""
    triples = np.sort(edges.reshape(-1, 3) * 3 + 1 + directions.reshape(-1, 3), axis=1)
    # Repeated faces are rare: a hash of each face avoids the slow comparison. Products with random odd numbers collide
    # once in 2^64.
    factors = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)
    hashes = np.sort((triples.view(np.uint64) * factors).sum(axis=1, dtype=np.uint64))
    if (hashes[1:] != hashes[:-1]).all():
        return np.arange(len(triples))
    _, first_faces = np.unique(triples, axis=0, return_index=True)
    return np.sort(first_faces)


def _find_body_surfaces(mesh: Mesh, surfaces: Int64) -> Bools:
    """Find the (F,) surfaces, by label, that look like bodies, since their normals point to all sides."""
    normals = np.empty((3, len(mesh.faces)))
    for part, (first, second, third) in mesh.iterate_parts():
        normals[:, part] = np.cross(second - first, third - first, axis=0)
    sums = np.stack([np.bincount(surfaces, axis, minlength=len(mesh.faces)) for axis in normals])
    area = np.bincount(surfaces, np.linalg.norm(normals, axis=0), minlength=len(mesh.faces))
    # The normals of a sheet add up to its area, of a nearly closed body to about 0.
    max_open_share = 0.5
    return np.asarray(np.linalg.norm(sums, axis=0) < max_open_share * area)


def _compute_point_weights(points_per_side: int) -> Float64:
    """Compute (N, 3) weights of the corners of a triangle for points that are spread over it."""
    a, b = np.indices((points_per_side, points_per_side)).reshape(2, -1)
    is_inside = a + b < points_per_side
    second, third = (a[is_inside] + 1 / 3) / points_per_side, (b[is_inside] + 1 / 3) / points_per_side
    return np.stack([1 - second - third, second, third], axis=1)


def _format_share(count: int, total_count: int) -> str:
    return f"{count:,} of {total_count:,}"


def _warn(owner: str, finding: str) -> None:
    warnings.warn(f"{owner}: {finding}", stacklevel=4)
