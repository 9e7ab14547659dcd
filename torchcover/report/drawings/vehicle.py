"""A vehicle from five sides, and the regions of its skin that sensors can be mounted on."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from torchcover.report.maps.sheet import HEADING_POINTS, Bounds, fit_paper, stack_views, write_heading, write_title

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
    """Draw (F, 3) triangles between (V, 3) corners, shaded: what is nearer to the eye is drawn later."""
    corners = vertices_m[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    shade = 0.55 + 0.35 * np.clip(normals @ LIGHT, 0.0, 1.0)
    order = np.argsort((corners @ np.array(view.towards)).max(axis=1), kind="stable")
    colours = np.repeat(shade[order, None], 3, axis=1)
    shown = view.flat(corners[order])
    axes.add_collection(PolyCollection(list(shown), facecolors=colours, edgecolors=colours, linewidths=0.3, zorder=1))


WIDTH_IN = 7.5
COLOURS = colormaps["turbo"]  # as many as there are regions, and no grey
AROUND_LENGTHS = 0.06
OPPOSITE = {"left": "right", "right": "left", "front": "rear", "rear": "front"}
HIGHLIGHT: dict[str, Any] = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.75}


class SkinPatch(NamedTuple):
    """A region of the skin.

    Args:
        name: What it is called.
        seen_from: "above", "front", "rear", "left" or "right".
        places_m: (K, L, 3) places on it, in rows and columns.
    """

    name: str
    seen_from: str
    places_m: Points


def draw_vehicle(
    vertices_m: Points, faces: NDArray[np.int64], patches: Sequence[SkinPatch], *, title: str, subtitle: str = ""
) -> Figure:
    """Draw a vehicle from five sides: each region filled where it is seen from, and its outline from beside it.

    Args:
        vertices_m: (V, 3) corners of the vehicle's body in the vehicle frame in metres.
        faces: (F, 3) its triangles.
        patches: The regions.
        title: First line.
        subtitle: Second line, smaller.

    Returns:
        A figure of its own, outside pyplot: from above, from the left, from the right, and from both ends.
    """
    around_m = AROUND_LENGTHS * float(np.ptp(vertices_m[:, 0]))
    low, high = vertices_m.min(axis=0) - around_m, vertices_m.max(axis=0) + around_m
    half_m = float(max(high[0], -low[0], high[1] - low[1]))  # the front and the rear have half of the paper each
    x, z = (-half_m, half_m), (float(low[2]), float(high[2]))
    views: list[tuple[Bounds, Bounds]] = [(x, (float(low[1]), float(high[1]))), (x, z), (x, z), (x, z)]
    figure, (above, left, right, ends) = stack_views(views, width_in=WIDTH_IN)
    shown = [("above", above, 0.0), ("left", left, 0.0), ("right", right, 0.0)]
    shown += [("front", ends, -half_m / 2), ("rear", ends, half_m / 2)]
    for seen_from, axes, shift_m in shown:
        _draw_side(axes, vertices_m, faces, patches, seen_from, shift_m)
    above.set_ylabel("y left (m)")
    right.set_xlabel("x forward (m)")
    for axes in (left, right):
        axes.set_ylabel("z up (m)")
    for axes in (left, ends):
        axes.set_xticks([])
    write_heading(above, "from above")
    write_heading(left, "from the left")
    write_heading(right, "from the right")
    write_heading(ends, "from the front, and from the rear")
    write_title(above, title, subtitle, lift_points=HEADING_POINTS)
    fit_paper(figure)
    return figure


def _draw_side(
    axes: Axes,
    vertices_m: Points,
    faces: NDArray[np.int64],
    patches: Sequence[SkinPatch],
    seen_from: str,
    shift_m: float,
) -> None:
    view = VIEWS[seen_from]
    aside = shift_m * np.array(view.right)
    draw_body(axes, vertices_m + aside, faces, view)
    for at, patch in enumerate(patches):
        if patch.seen_from == OPPOSITE.get(seen_from):
            continue
        colour, flat = COLOURS((at + 0.5) / len(patches)), view.flat(patch.places_m + aside)
        outline = np.concatenate([flat[:, 0], flat[-1], flat[::-1, -1], flat[0, ::-1]])
        axes.plot(*outline.T, color=colour, linewidth=0.7, zorder=2)
        if patch.seen_from == seen_from:
            corners = [flat[:-1, :-1], flat[1:, :-1], flat[1:, 1:], flat[:-1, 1:]]
            pieces = np.stack(corners, axis=2).reshape(-1, 4, 2)
            axes.add_collection(PolyCollection(list(pieces), facecolors=colour, alpha=0.6, linewidths=0, zorder=3))
            words: dict[str, Any] = {"fontsize": 6.5, "ha": "center", "va": "center", "bbox": HIGHLIGHT, "zorder": 4}
            x, y = outline.mean(axis=0).tolist()
            axes.text(x, y, patch.name, **words)
