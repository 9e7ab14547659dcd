"""What stands beside streets: one list of kinds with their places, sizes and densities, for all worlds.

A side of a street is a line that has the street on its left. Along all sides runs of every kind are drawn; what would
stand on a street, across the edge of a pavement, or in what comes before it in the list is left out.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Annotated, Literal, NamedTuple

import numpy as np
import shapely
from pydantic import AfterValidator

from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.simulation.bodies import merge_meshes
from torchcover.simulation.shapes import Mesh, compute_circle_points
from torchcover.simulation.traffic.scenery import PAVEMENT_M, build_box_from_bounds, build_prism

Bounds = tuple[float, float]
Zone = Literal["kerb", "built", "open"]

# What stands on a slope goes on below it.
SUNK_M = 1.0
# Walls and hedges are straight for so long at most.
WALL_M = 10.0
# A side is built up or open for so long, and has corners so often; what is shorter is around no block.
SIDE_M, CORNER_EVERY_M, SMOOTH_M, SHORTEST_M = 60.0, 4.0, 0.3, 30.0
# Corners of a line may coincide.
TINY_M = 1e-9
TAPERED = 0.6
# In the middle of a tree's width, which hangs over the street otherwise.
TRUNK = 0.1


class _Kind(NamedTuple):
    """What stands beside streets, in runs of pieces; lengths are along the street, depths away from it.

    It is at the `kerb`, before the sidewalk, or behind it, along sides that are `built` or `open`, a share of which has
    it: `at_m` from the line, where what is negative hangs over, with gaps from run to run at the usual density. Without
    `piece_m` a piece is as long as its run; walls and hedges consist of pieces without gaps, others have `air_m` in
    between. Of its size the share `foot` must keep off streets. `form` is a key of `FORMS`.
    """

    form: str
    zones: tuple[Zone, ...]
    share: float
    at_m: Bounds
    run_m: Bounds
    gap_m: Bounds
    deep_m: Bounds
    high_m: Bounds
    piece_m: float | None = None
    air_m: float = 0.0
    foot: float = 1.0


BEHIND: tuple[Zone, ...] = ("built", "open")
# Sizes of the small are those of usual products; densities agree with real sweeps in what closes the view
# (docs/measured/streets.md).
KINDS: Mapping[str, _Kind] = {
    "house": _Kind("house", ("built",), 1.0, (0.0, 5.0), (9.0, 24.0), (0.1, 4.0), (9.0, 15.0), (5.0, 24.0)),
    "back_house": _Kind("house", ("built",), 1.0, (24.0, 44.0), (9.0, 22.0), (4.0, 22.0), (9.0, 14.0), (5.0, 22.0)),
    "hedge": _Kind("hedge", ("built",), 0.95, (0.2, 0.8), (8.0, 40.0), (1.0, 5.0), (0.5, 1.1), (0.9, 2.2), WALL_M),
    "hedgerow": _Kind("hedge", ("open",), 1.0, (0.3, 2.0), (20.0, 70.0), (2.0, 6.0), (0.8, 1.6), (1.2, 2.6), WALL_M),
    "fence": _Kind("fence", BEHIND, 0.7, (0.2, 1.2), (8.0, 40.0), (1.0, 9.0), (0.08, 0.08), (0.9, 1.8), WALL_M),
    "lamp": _Kind("lamp", ("kerb",), 0.9, (0.35, 0.45), (0.2, 0.2), (22.0, 34.0), (0.2, 0.2), (6.0, 8.0)),
    "tree": _Kind("tree", ("kerb",), 0.7, (-0.9, -0.6), (2.0, 3.0), (4.0, 11.0), (2.0, 3.0), (6.5, 9.0), foot=TRUNK),
    "sign": _Kind("sign", ("kerb",), 0.9, (0.25, 0.35), (0.06, 0.06), (12.0, 32.0), (0.5, 0.6), (2.4, 3.0)),
    "bin": _Kind("bin", ("kerb",), 0.8, (0.3, 0.4), (0.5, 0.8), (12.0, 40.0), (0.4, 0.5), (0.8, 1.3)),
    "bicycle": _Kind(
        "bicycle", ("kerb",), 0.4, (0.3, 0.4), (1.8, 9.0), (15.0, 60.0), (0.5, 0.5), (1.0, 1.1), 1.75, 0.3
    ),
    "bollard": _Kind(
        "bollard", ("kerb",), 0.35, (0.3, 0.4), (4.0, 16.0), (8.0, 30.0), (0.12, 0.12), (0.8, 1.0), 0.12, 1.5
    ),
    "garden_tree": _Kind("tree", BEHIND, 0.8, (1.5, 20.0), (2.0, 4.0), (4.0, 22.0), (2.0, 4.0), (5.0, 11.0)),
    "bush": _Kind("bush", BEHIND, 0.8, (0.5, 12.0), (1.0, 2.5), (3.0, 16.0), (1.0, 2.5), (0.7, 2.5)),
}
HOUSES = ("house", "back_house")
MOST_TIMES = 4.0


def _known(times: float | Mapping[str, float]) -> float | Mapping[str, float]:
    some = times if isinstance(times, Mapping) else {"tree": times}
    if unknown := sorted(some.keys() - (KINDS.keys() - set(HOUSES))):
        raise ValueError(f"{', '.join(unknown)}: there are {', '.join(kind for kind in KINDS if kind not in HOUSES)}")
    if not all(0.0 <= factor <= MOST_TIMES for factor in some.values()):
        raise ValueError(f"0 to {MOST_TIMES:g} times as much as usually is needed; got {times}")
    return times


# How many times as much there is as usually of all kinds but houses, or of some of them.
RoadsideDensity = Annotated[float | dict[str, float], AfterValidator(_known)]


class StreetSide(NamedTuple):
    """A side of a street in a zone: a line of (K, 2) places that has the street on its left."""

    zone: Zone
    line_m: Float64


def find_street_sides(
    street_area: shapely.Geometry,
    offsets_m: tuple[float, float],
    is_visible: Callable[[Float64], Bools],
    built_share: float,
    generator: np.random.Generator,
) -> list[StreetSide]:
    """The sides of all streets that are known in plan only, a drawn share of them built up.

    `offsets_m` is how far beyond its edge kerb furniture begins, and what stands behind it; `is_visible` which (N, 2) places
    matter.
    """
    sides: list[StreetSide] = []
    for number, away_m in enumerate(offsets_m):
        area = shapely.orient_polygons(shapely.buffer(street_area, away_m, quad_segs=4))
        for ring in shapely.get_parts(shapely.boundary(area)):
            line_m = shapely.get_coordinates(shapely.segmentize(ring.simplify(SMOOTH_M), CORNER_EVERY_M))
            for side_m in (
                np.array_split(line_m, max(round(ring.length / SIDE_M), 1)) if ring.length > SHORTEST_M else ()
            ):
                zone: Zone = "built" if generator.random() < built_share else "open"
                if len(side_m) > 1 and is_visible(side_m).all():
                    sides.append(StreetSide(zone if number else "kerb", side_m))
    return sides


def place_scenery(
    sides: Sequence[StreetSide],
    drivable_areas: Sequence[shapely.Geometry],
    walkable_areas: Sequence[shapely.Geometry],
    sidewalk_areas: Sequence[shapely.Geometry],
    compute_ground_heights_m: Callable[[Float64], Float64],
    density_factors: float | Mapping[str, float],
    generator: np.random.Generator,
) -> tuple[list[Mesh], list[Mesh]]:
    """Draw what stands along the sides of streets: houses and all else, each kind in one mesh; see `Times`.

    In plan, nothing at kerbs may stand on what is `drivable_areas`, nor anything behind sidewalks on what is `walkable_areas`;
    `sidewalk_areas` are a kerb higher than the ground, whose heights `compute_ground_heights_m` gives at (N, 2) places.
    """
    if not sides:
        return [], []
    lines = _Lines(sides)
    drawn = []
    for name, kind in KINDS.items():
        factor = (
            density_factors.get(name, 1.0)
            if isinstance(density_factors, Mapping)
            else 1.0
            if name in HOUSES
            else density_factors
        )
        drawn.append(_drawn(kind, lines, factor, generator))
    kinds = np.repeat(np.arange(len(KINDS)), [len(run) for _, _, run in drawn])
    outlines_m, high_m, run = (np.concatenate(column) for column in zip(*drawn, strict=True))
    kept, raised_m = _free(outlines_m, kinds, run, drivable_areas, walkable_areas, sidewalk_areas)
    outlines_m, high_m, kinds, raised_m = outlines_m[kept], high_m[kept], kinds[kept], raised_m[kept]
    corners_m = compute_ground_heights_m(outlines_m.reshape(-1, 2)).reshape(-1, 4)
    low_m, base_m = corners_m.min(axis=1) + raised_m, corners_m.max(axis=1) + raised_m
    bottom_m = np.where(base_m > low_m, low_m - SUNK_M, low_m)
    houses: list[Mesh] = []
    others: list[Mesh] = []
    for number, (name, kind) in enumerate(KINDS.items()):
        own = kinds == number
        if own.any():
            into = houses if name in HOUSES else others
            into.append(_copies(_form(kind.form), outlines_m[own], bottom_m[own], base_m[own], high_m[own]))
    return houses, others


class _Lines:
    """The lines of sides on one axis: each begins where the last one ended."""

    def __init__(self, sides: Sequence[StreetSide]) -> None:
        self.zones = [side.zone for side in sides]
        count = np.array([len(side.line_m) for side in sides])
        self._first = np.cumsum(count) - count
        self._last = self._first + count - 1
        self._places_m = np.concatenate([np.empty((0, 2)), *(side.line_m for side in sides)])
        steps_m = np.diff(self._places_m, axis=0, append=0.0)
        steps_m[self._last] = steps_m[self._last - 1]
        ways_m = np.linalg.norm(steps_m, axis=1)
        steps_m /= np.maximum(ways_m, TINY_M)[:, None]
        ways_m[self._last] = 0.0
        self._arc_m = np.cumsum(ways_m) - ways_m
        # Halfway between the pieces that meet in a corner.
        ahead = steps_m + np.where(
            np.isin(np.arange(len(steps_m)), self._first)[:, None], steps_m, np.roll(steps_m, 1, 0)
        )
        ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), TINY_M)
        self._right = np.stack([ahead[:, 1], -ahead[:, 0]], axis=1)
        self.length_m = self._arc_m[self._last] - self._arc_m[self._first]

    def along(self, number: Int64, ways_m: Float64) -> tuple[Float64, Float64]:
        """(N, 2, 2) places, and the way to the right there, after (N, 2) ways along lines of some numbers."""
        way_m = self._arc_m[self._first[number]][:, None] + ways_m
        piece = np.searchsorted(self._arc_m, way_m, side="right") - 1
        piece = np.clip(piece, self._first[number][:, None], self._last[number][:, None] - 1)
        long_m = np.maximum(self._arc_m[piece + 1] - self._arc_m[piece], TINY_M)
        share = ((way_m - self._arc_m[piece]) / long_m)[..., None]
        places_m, right = (
            (1 - share) * each[piece] + share * each[piece + 1] for each in (self._places_m, self._right)
        )
        return places_m, right


def _drawn(kind: _Kind, lines: _Lines, times: float, generator: np.random.Generator) -> tuple[Float64, Float64, Int64]:
    """Runs of a kind along the sides that have it, in N pieces.

    Returns (N, 4, 2) outlines in plan, counter-clockwise from the far side on; (N,) heights, and which pieces are one.
    """
    has = np.array([zone in kind.zones for zone in lines.zones], dtype=bool)
    has[has] = generator.random(np.count_nonzero(has)) < kind.share
    numbers = np.flatnonzero(has)
    if not len(numbers) or times == 0:
        return np.empty((0, 4, 2)), np.empty(0), np.empty(0, dtype=np.int64)
    length_m, gap_m = lines.length_m[numbers], (kind.gap_m[0] / times, kind.gap_m[1] / times)
    shape = len(numbers), int(length_m.max() / (kind.run_m[0] + gap_m[0])) + 1
    run_m, between_m = generator.uniform(*kind.run_m, shape), generator.uniform(*gap_m, shape)
    # The first begins anywhere in a gap.
    between_m[:, 0] *= generator.random(len(numbers))
    start_m = np.cumsum(run_m + between_m, axis=1) - run_m
    fits = start_m + kind.run_m[0] <= length_m[:, None]
    on = np.nonzero(fits)[0]
    run_m = np.minimum(run_m[fits], length_m[on] - start_m[fits])
    at_m, deep_m, high_m = (generator.uniform(*bounds, len(on)) for bounds in (kind.at_m, kind.deep_m, kind.high_m))
    first_m, piece_m, run = start_m[fits], run_m, np.arange(len(on))
    if kind.piece_m is not None:
        is_wall = kind.piece_m == WALL_M
        count = np.maximum((run_m / (kind.piece_m + kind.air_m)).astype(np.int64) + is_wall, 1)
        every_m = run_m / count if is_wall else np.full(len(run), kind.piece_m + kind.air_m)
        run = np.repeat(run, count)
        number = np.arange(len(run)) - np.repeat(np.cumsum(count) - count, count)
        first_m, piece_m = first_m[run] + number * every_m[run], (every_m if is_wall else every_m - kind.air_m)[run]
    places_m, right = lines.along(numbers[on[run]], np.stack([first_m, first_m + piece_m], axis=1))
    near_m, far_m = (places_m + right * out_m[run, None, None] for out_m in (at_m, at_m + deep_m))
    # Around a corner what is far out would be stretched, and on its inside squeezed.
    stretched = [np.linalg.norm(side[:, 1] - side[:, 0], axis=1) / piece_m for side in (near_m, far_m)]
    like = (np.abs(np.log(np.maximum(stretched, TINY_M))) < -np.log(TAPERED)).all(axis=0)
    return np.concatenate([far_m, near_m[:, ::-1]], axis=1)[like], high_m[run][like], run[like]


def _free(
    outlines_m: Float64,
    kinds: Int64,
    run: Int64,
    driven: Sequence[shapely.Geometry],
    walked: Sequence[shapely.Geometry],
    pavements: Sequence[shapely.Geometry],
) -> tuple[Bools, Float64]:
    """(N,) which pieces are in nobody's way, and how much higher than the ground they stand."""
    foot = np.array([kind.foot for kind in KINDS.values()])[kinds][:, None, None]
    middles_m = outlines_m.mean(axis=1, keepdims=True)
    feet = shapely.linearrings(middles_m + foot * (outlines_m - middles_m))
    # Of the two geometries it is the query's that is prepared: it had better be the large one.
    free, on, within = (np.zeros(len(kinds), dtype=bool) for _ in range(3))
    at_kerb = np.array(["kerb" in kind.zones for kind in KINDS.values()])[kinds]
    for own, streets in ((at_kerb, driven), (~at_kerb, walked)):
        met = shapely.STRtree(feet[own]).query(np.array(streets, dtype=object), predicate="intersects")[1]
        free[own] = ~np.isin(np.arange(np.count_nonzero(own)), met)
    floors = shapely.STRtree(feet)
    for found, predicate in ((on, "intersects"), (within, "contains")):
        found[floors.query(np.array(pavements, dtype=object), predicate=predicate)[1]] = True
    free &= on == within
    # On the inside of a tight curve, where the ways to the right meet, outlines fold.
    sides = np.roll(outlines_m, -1, axis=1) - outlines_m
    following = np.roll(sides, -1, axis=1)
    free &= (sides[..., 0] * following[..., 1] > sides[..., 1] * following[..., 0]).all(axis=1)
    number = np.flatnonzero(free)
    own = np.unique(np.stack([kinds[number], run[number]]), axis=1, return_inverse=True)[1]
    later, earlier = number[_meeting(outlines_m[number], own)]
    order = np.lexsort((earlier, later))
    for one, other in zip(later[order].tolist(), earlier[order].tolist(), strict=True):
        if free[other]:
            free[one] = False
    return free, PAVEMENT_M * within


def _meeting(outlines_m: Float64, group: Int64) -> Int64:
    """(2, P) pairs of (N, 4, 2) convex outlines of two groups that no side of the one or the other separates."""
    # Their diagonals have the same bounds as boxes, and are made in less time.
    diagonals = shapely.linestrings(np.stack([outlines_m.min(axis=1), outlines_m.max(axis=1)], axis=1))
    pairs = shapely.STRtree(diagonals).query(diagonals)
    pairs = pairs[:, (pairs[0] > pairs[1]) & (group[pairs[0]] != group[pairs[1]])]
    for way in (1, -1):
        one, other = pairs[::way]
        normals = (np.roll(outlines_m, -1, axis=1) - outlines_m)[one][..., ::-1] * np.array([1.0, -1.0])
        beyond = np.einsum("pkc,plkc->plk", normals, outlines_m[other][:, :, None] - outlines_m[one][:, None])
        meet = ~(beyond.min(axis=1) > 0).any(axis=1)
        pairs = pairs[:, meet]
    return np.asarray(pairs)


def _copies(form: Mesh, outlines_m: Float64, bottom_m: Float64, base_m: Float64, high_m: Float64) -> Mesh:
    """A form, once over each of (N, 4, 2) outlines: it stands on a base, and its lowest corners go on to a bottom."""
    x, y, z = form.vertices_m.T
    weights = np.stack([(1 - x) * (1 - y), x * (1 - y), x * y, (1 - x) * y], axis=1)
    count, corners = len(outlines_m), len(x)
    places_m = np.einsum("vc,ncd->nvd", weights, outlines_m)
    heights_m = np.where(z == 0.0, bottom_m[:, None], base_m[:, None] + high_m[:, None] * z)
    faces = form.faces + corners * np.arange(count)[:, None, None]
    return Mesh(
        np.concatenate([places_m, heights_m[..., None]], axis=2).reshape(-1, 3),
        faces.reshape(-1, 3),
        np.tile(form.filled_material_indices, count),
        np.ones(len(faces) * len(form.faces), dtype=bool),  # as all forms are closed
    )


@cache
def _form(name: str) -> Mesh:
    """A form over the unit square with the street beyond y = 1, from z = 0 to 1."""
    whole = ((0.0, 1.0), (0.0, 1.0), (0.0, 1.0))
    ring = 0.5 * compute_circle_points(6)
    middle = np.array([0.5, 0.5])

    def turned(levels: Sequence[float], sizes: Sequence[float]) -> Mesh:
        return build_prism([middle + size * ring for size in sizes], levels)

    def wheel(x: float) -> Mesh:
        around = np.array([x, 0.0]) + np.array([0.4, 0.65]) * (ring / np.array([1.0, np.sqrt(0.75)]) + 0.5)
        disc = build_prism([around, around], [0.46, 0.54])
        return Mesh(disc.vertices_m[:, [0, 2, 1]], disc.faces[:, ::-1])

    parts = {
        "house": [build_box_from_bounds(*whole)],
        "hedge": [build_box_from_bounds(*whole).assign_material("vegetation")],
        "fence": [build_box_from_bounds(*whole).assign_material("wood")],
        "bin": [build_box_from_bounds(*whole).assign_material("metal")],
        "bollard": [turned([0.0, 1.0], [1.0, 1.0]).assign_material("metal")],
        "lamp": [turned([0.0, 0.97], [1.0, 0.7]).assign_material("metal"), build_box_from_bounds((0.2, 0.8), (0.0, 11.0), (0.975, 1.0))],
        "tree": [
            turned([0.0, 0.42], [TRUNK, TRUNK]).assign_material("wood"),
            turned([0.42, 0.6, 0.8, 1.0], [0.45, 1.0, 0.9, 0.3]).assign_material("vegetation"),
        ],
        "bush": [turned([0.0, 0.4, 0.8, 1.0], [0.7, 1.0, 0.9, 0.4]).assign_material("vegetation")],
        "sign": [
            build_box_from_bounds((0.0, 1.0), (0.45, 0.55), (0.0, 0.75)).assign_material("metal"),
            build_box_from_bounds((0.2, 0.8), (0.0, 1.0), (0.755, 1.0)).assign_material("sign"),
        ],
        "bicycle": [
            wheel(0.0), wheel(0.6), build_box_from_bounds((0.42, 0.58), (0.44, 0.56), (0.25, 0.88)),
            build_box_from_bounds((0.66, 0.7), (0.0, 1.0), (0.94, 1.0)),
        ],
    }  # fmt: skip
    return merge_meshes(parts[name])
