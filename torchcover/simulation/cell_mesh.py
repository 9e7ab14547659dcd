"""Meshes of cubic cells."""

import numpy as np

from torchcover.geometry.arrays import Int64
from torchcover.simulation.shapes import Mesh

# Side of a cell.
CELL_M = 0.2


def build_cell_mesh(cell_indices: Int64) -> Mesh:
    """Build the surface of a set of cells; sides between two of them are omitted.

    Args:
        cell_indices: (N, 3) different cells, in multiples of `CELL_M`.

    Returns:
        The mesh; its faces point outwards.

    Example:
        >>> mesh = build_cell_mesh(np.array([[0, 0, 0], [0, 0, 1]]))
        >>> mesh.faces.shape, mesh.vertices_m.max(axis=0).tolist()
        ((20, 3), [0.2, 0.2, 0.4])
    """
    # Direction of each side of a cell, and its corners in the order that turns the face outwards.
    sides = (
        ([-1, 0, 0], [[0, 0, 0], [0, 0, 1], [0, 1, 1], [0, 1, 0]]),
        ([1, 0, 0], [[1, 0, 0], [1, 1, 0], [1, 1, 1], [1, 0, 1]]),
        ([0, -1, 0], [[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]]),
        ([0, 1, 0], [[0, 1, 0], [0, 1, 1], [1, 1, 1], [1, 1, 0]]),
        ([0, 0, -1], [[0, 0, 0], [0, 1, 0], [1, 1, 0], [1, 0, 0]]),
        ([0, 0, 1], [[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]),
    )
    origin = cell_indices.min(axis=0) - 1
    shape = tuple(cell_indices.max(axis=0) - origin + 3)

    def flatten(indices: Int64) -> Int64:
        return np.asarray(np.ravel_multi_index(tuple((indices - origin).T), shape))

    cell_numbers = np.sort(flatten(cell_indices))
    corners = []
    for direction, side_corners in sides:
        neighbor_numbers = flatten(cell_indices + np.array(direction))
        nearest = np.searchsorted(cell_numbers, neighbor_numbers).clip(max=len(cell_numbers) - 1)
        has_free_side = cell_numbers[nearest] != neighbor_numbers
        corners.append((cell_indices[has_free_side][:, None] + np.array(side_corners)).reshape(-1, 3))
    vertex_numbers, quads = np.unique(flatten(np.concatenate(corners)), return_inverse=True)
    quads = quads.reshape(-1, 4)
    vertices = np.stack(np.unravel_index(vertex_numbers, shape), axis=1) + origin
    return Mesh(vertices * CELL_M, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))
