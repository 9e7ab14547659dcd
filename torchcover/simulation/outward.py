"""Which faces of a mesh have an outer side and an inner side that nobody sees."""

import numpy as np
from numpy.typing import NDArray

from torchcover.simulation.shapes import Mesh

Numbers = NDArray[np.int64]

# A sheet with a face on each of its sides encloses nothing, up to rounding.
VOLUME_ROUNDING = 1e-9


def outward_faces(mesh: Mesh) -> NDArray[np.bool_]:
    """Whether each face belongs to a closed surface that is turned outwards: its back is then never seen from outside.

    Faces that share an edge belong to one surface. It is closed if every edge is run through as often one way as the
    other, and turned outwards if it encloses a volume that is not negative. A face of any other surface, such as a
    plane, an open mesh, or a ball that is turned inside out, may be seen from both sides.

    Args:
        mesh: Vertices and faces; vertices at the same place are one.

    Returns:
        (F,) bool.

    Example:
        >>> from torchcover.simulation.shapes import Box, Plane
        >>> outward_faces(Box(type="box", size_m=(1, 1, 1)).mesh()).tolist() == [True] * 12
        True
        >>> outward_faces(Plane(type="plane", size_m=(1, 1)).mesh()).tolist()
        [False, False]
    """
    corners = _welded(mesh.vertices_m)[mesh.faces]
    start, end = corners.ravel(), corners[:, [1, 2, 0]].ravel()
    lower, upper = np.minimum(start, end), np.maximum(start, end)
    _, edge = np.unique(lower * len(mesh.vertices_m) + upper, return_inverse=True)
    edge = edge.reshape(-1)
    face = np.repeat(np.arange(len(mesh.faces)), 3)
    surface = _connected(edge, face, len(mesh.faces))
    # An edge from a corner to itself goes no way.
    turns = np.bincount(edge, weights=np.sign(end - start))
    open_edges = np.bincount(surface[face], weights=turns[edge] != 0, minlength=len(mesh.faces))
    first, second, third = (mesh.vertices_m - mesh.vertices_m.mean(axis=0))[mesh.faces].transpose(1, 0, 2)
    volumes = np.einsum("fc,fc->f", first, np.cross(second, third))
    volume = np.bincount(surface, weights=volumes, minlength=len(mesh.faces))
    rounding = VOLUME_ROUNDING * np.bincount(surface, weights=np.abs(volumes), minlength=len(mesh.faces))
    outward: NDArray[np.bool_] = ((open_edges == 0) & (volume >= -rounding))[surface]
    return outward


def _welded(vertices_m: NDArray[np.float64]) -> Numbers:
    """(V,) number of the place of each vertex; `np.unique` along an axis takes five times as long."""
    order = np.lexsort(vertices_m.T)
    differs = (np.diff(vertices_m[order], axis=0) != 0).any(axis=1)
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.concatenate([[0], np.cumsum(differs)])
    return number


def _connected(edge: Numbers, face: Numbers, faces: int) -> Numbers:
    """(faces,) number of the surface of each face: the smallest number of a face of it."""
    order = np.argsort(edge, kind="stable")
    shared = np.flatnonzero(np.diff(edge[order]) == 0)
    one, other = face[order[shared]], face[order[shared + 1]]
    surface = np.arange(faces)
    while (surface[one] != surface[other]).any():
        smaller = np.minimum(surface[one], surface[other])
        np.minimum.at(surface, surface[one], smaller)
        np.minimum.at(surface, surface[other], smaller)
        while (surface[surface] != surface).any():
            surface = surface[surface]
    return surface
