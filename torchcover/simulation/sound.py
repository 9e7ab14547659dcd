"""What is wrong with meshes, said by name: normals that disagree, bodies that are open, surfaces that coincide."""

import warnings
from collections.abc import Sequence

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

# Surfaces that are nearer to each other are one; nearer than the other, float32 cannot tell that they are two.
COINCIDE_M = 1e-3
APART_M = 1e-4
# From so far above, and as far below, is asked what coincides: where one may be exactly, no ray begins or ends.
UPON_M = COINCIDE_M + APART_M
# The cosine of the angle between two that coincide, at least.
ALIKE = 0.9
# Of a face so many points are asked along each side, of one that is longer than the other many.
SIDE_POINTS, LONG_SIDE_POINTS, LONG_M = 2, 10, 4.0
# Of a sheet all normals add up to its area, of what is nearly closed to nothing: what is below is meant to be closed.
BODY_SHARE = 0.5
# Odd numbers without a pattern: sums of products with them are alike by chance once in 2^64.
MIXING = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)


def check_mesh(owner: str, mesh: Mesh) -> Mesh:
    """A mesh with each face once, and warnings of what else is wrong with it.

    Warns:
        UserWarning: Faces that are there twice, neighbours whose normals disagree, or a body that is not closed.
    """
    edge, way = find_face_edges(mesh)
    once = _first_of_each(edge, way)
    if len(once) < len(mesh.faces):
        doubled = len(mesh.faces) - len(once)
        _warn(owner, f"{_share(doubled, len(mesh.faces))} of its faces are there more than once, and count once")
        mesh = mesh.select_faces(once)
        edge, way = find_face_edges(mesh)
    surface = label_surfaces(edge)
    faces = np.bincount(edge, weights=way != 0)
    turns = np.bincount(edge, weights=way)
    shared = faces == 2
    disagree = shared & (np.abs(turns) == 2)
    if disagree.any():
        _warn(
            owner,
            f"the normals of neighbours disagree at {_share(int(disagree.sum()), int(shared.sum()))} of its inner "
            "edges: both sides of its faces count, and nothing lies inside of it; make its normals consistent in a "
            "modelling tool",
        )
    elif (faces % 2 == 1).any():
        is_open = np.bincount(surface[np.flatnonzero((faces % 2 == 1)[edge]) // 3], minlength=len(mesh.faces)) > 0
        missing = is_open[surface] & _encloses(mesh, surface)[surface]
        if missing.any():
            _warn(
                owner,
                f"{_share(int((faces % 2 == 1).sum()), int((faces > 0).sum()))} of its edges have a face on one side "
                "only, though it looks like a body: rays pass through the holes, and nothing lies inside of it; close "
                "it in a modelling tool",
            )
    return mesh._replace(is_outward=find_outward_faces_from_edges(mesh, edge, way, surface))


def find_coincident_faces(meshes: Sequence[Mesh], allow_within_mesh: Sequence[bool]) -> list[Bools]:
    """Which faces coincide with another one that looks the same way, or may be seen from both sides, within 1 mm.

    Points of the faces are asked; of two surfaces that cover each other in a small part only, that may be overlooked.
    Meshes never move and are near the origin; `allow_within_mesh` says of each whether its faces may coincide with each other,
    too, as of parts of a vehicle that end in one plane. One (F,) mask for each.
    """
    outward = np.concatenate([find_outward_faces(mesh) for mesh in meshes])
    number = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
    found, layer, in_itself = (
        np.zeros(len(number), dtype=bool),
        _layers(meshes),
        np.array(allow_within_mesh, dtype=bool),
    )
    layers = [
        (
            which,
            RayCaster([meshes[k] for k in np.flatnonzero(layer == which).tolist()]),
            np.flatnonzero(layer[number] == which),
        )
        for which in range(layer.max() + 1)
    ]
    for part, corners_m in iterate_mesh_parts(meshes):
        has_area = compute_normals(corners_m).any(axis=0)
        is_long = np.linalg.norm(corners_m - corners_m[[2, 0, 1]], axis=1).max(axis=0) > LONG_M
        for some, points in ((has_area & ~is_long, SIDE_POINTS), (has_area & is_long, LONG_SIDE_POINTS)):
            faces, corners = part.start + np.flatnonzero(some), corners_m[..., some]
            normals = compute_normals(corners).T
            for shares in _inner_points(points) if len(faces) else ():
                places_m, inner, rows = np.tensordot(shares, corners, 1).T, in_itself[number[faces]], []
                for which, caster, of_layer in layers:
                    own = layer[number[faces]] == which
                    # Of others, to what lies on or below it; of its own body from above and from within, for a ray
                    # that meets the face itself meets nothing else.
                    for start_m, whose in ((UPON_M, ~own | inner), (-APART_M, own & inner)):
                        asked = np.flatnonzero(whose)
                        starts_m, towards = places_m[asked] + start_m * normals[asked], -normals[asked]
                        met = caster.find_first_faces(starts_m, towards, UPON_M + max(start_m, -COINCIDE_M / 2))
                        hit = met >= 0
                        rows.append((asked[hit], of_layer[met[hit]]))
                asked, two = np.concatenate(rows, axis=1)
                others = two != faces[asked]
                asked, one, two = asked[others], faces[asked[others]], two[others]
                upon = normals[asked], compute_normals(get_corners_m(meshes, two)).T
                cosine = (upon[0] * upon[1]).sum(axis=1)
                alike, opposite = cosine > ALIKE, cosine < -ALIKE
                # Nobody sees a bottom that stands on a sheet, nor what coincides with it there.
                down = outward[one] & (upon[0][:, 2] < -ALIKE), outward[two] & (upon[1][:, 2] < -ALIKE)
                stands = np.isin(asked, asked[down[0] & ~outward[two] & (alike | opposite)])
                # Back to back they are seen from different sides: by nobody, that of a body that stands on a sheet.
                same = ~stands & (alike | (opposite & ~(outward[one] & outward[two]) & ~down[1]))
                found[one[same]] = found[two[same]] = True
    return np.split(found, np.cumsum([len(mesh.faces) for mesh in meshes])[:-1])


def _layers(meshes: Sequence[Mesh]) -> Int64:
    """(meshes,) numbers of layers: bodies that may touch are in different ones.

    Which of several faces at one place a ray meets first is up to how the processor rounds: so each is asked apart.
    """
    least_m, most_m = (
        np.array([reach(mesh.vertices_m, axis=0) if len(mesh.faces) else np.full(3, np.nan) for mesh in meshes])
        for reach in (np.min, np.max)
    )
    layers = np.full(len(meshes), -1)
    for body in range(len(meshes)):
        touch = (least_m[:body] <= most_m[body] + 2 * COINCIDE_M) & (most_m[:body] >= least_m[body] - 2 * COINCIDE_M)
        layers[body] = next(free for free in range(body + 1) if free not in layers[:body][touch.all(axis=1)])
    return layers


def warn_about_coincident_faces(names: Sequence[str], coincident_masks: Sequence[Bools]) -> None:
    """Warn of bodies whose surfaces coincide with others."""
    shares = {
        name: f"{name!r} ({_share(int(mask.sum()), len(mask))} of the faces)"
        for name, mask in zip(names, coincident_masks, strict=True)
        if mask.any()
    }
    if shares:
        warnings.warn(
            f"{', '.join(list(shares.values())[:5])}: faces lie within {COINCIDE_M * 1000:g} mm of others that look "
            "the same way; of those that cover each other one counts",
            stacklevel=3,
        )


def _first_of_each(edge: Int64, way: NDArray[np.int8]) -> Int64:
    """Numbers of the faces but those that have the same edges as one before, run through the same way."""
    triples = np.sort(edge.reshape(-1, 3) * 3 + 1 + way.reshape(-1, 3), axis=1)
    # Hardly ever are any alike; then no two have the same number, and the slow comparison is not needed.
    numbers = np.sort((triples.view(np.uint64) * MIXING).sum(axis=1, dtype=np.uint64))
    if (numbers[1:] != numbers[:-1]).all():
        return np.arange(len(triples))
    _, first = np.unique(triples, axis=0, return_index=True)
    return np.sort(first)


def _encloses(mesh: Mesh, surface: Int64) -> Bools:
    """(F,) whether the surface of that number looks like a body: its normals point to all sides."""
    normals = np.empty((3, len(mesh.faces)))
    for part, (first, second, third) in mesh.iterate_parts():
        normals[:, part] = np.cross(second - first, third - first, axis=0)
    sums = np.stack([np.bincount(surface, axis, minlength=len(mesh.faces)) for axis in normals])
    area = np.bincount(surface, np.linalg.norm(normals, axis=0), minlength=len(mesh.faces))
    return np.asarray(np.linalg.norm(sums, axis=0) < BODY_SHARE * area)


def _inner_points(side: int) -> Float64:
    """(N, 3) shares of the corners of a triangle, of points spread over it."""
    a, b = np.indices((side, side)).reshape(2, -1)
    inside = a + b < side
    second, third = (a[inside] + 1 / 3) / side, (b[inside] + 1 / 3) / side
    return np.stack([1 - second - third, second, third], axis=1)


def _share(count: int, of: int) -> str:
    return f"{count:,} of {of:,}"


def _warn(owner: str, what: str) -> None:
    warnings.warn(f"{owner}: {what}", stacklevel=4)
