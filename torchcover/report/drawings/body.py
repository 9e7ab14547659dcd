"""A body as drawings show it, shaded, from one of its sides."""

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from numpy.typing import NDArray

Points = NDArray[np.float64]

LIGHT = np.array([0.3, -0.5, 0.81])


class View(NamedTuple):
    """Where one looks from: which directions of the vehicle frame are to the right, upwards, and towards the eye."""

    right: tuple[int, int, int]
    up: tuple[int, int, int]
    towards: tuple[int, int, int]

    def flat(self, points_m: Points) -> Points:
        """(..., 2) what (..., 3) points are on the paper."""
        return np.stack([points_m @ np.array(self.right), points_m @ np.array(self.up)], axis=-1)


VIEWS = {
    "above": View((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "left": View((-1, 0, 0), (0, 0, 1), (0, 1, 0)),
    "right": View((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "front": View((0, 1, 0), (0, 0, 1), (1, 0, 0)),
    "rear": View((0, -1, 0), (0, 0, 1), (-1, 0, 0)),
}


def draw_body(axes: Axes, vertices_m: Points, faces: NDArray[np.int64], view: View) -> None:
    """Draw a body, shaded: what is nearer to the eye is drawn later.

    Args:
        axes: What to draw in.
        vertices_m: (V, 3) corners.
        faces: (F, 3) triangles.
        view: Where one looks from.
    """
    corners = vertices_m[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    shade = 0.55 + 0.35 * np.clip(normals @ LIGHT, 0.0, 1.0)
    order = np.argsort((corners @ np.array(view.towards)).max(axis=1), kind="stable")
    colours = np.repeat(shade[order, None], 3, axis=1)
    shown = view.flat(corners[order])
    axes.add_collection(PolyCollection(list(shown), facecolors=colours, edgecolors=colours, linewidths=0.3, zorder=1))
