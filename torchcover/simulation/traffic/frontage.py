"""Roadside objects: one list of kinds with their offsets, sizes and densities, for all generated scenes.

A side of a street is a line with the street on its left. Runs of every kind are sampled along all sides; objects on a
street, across the edge of a sidewalk, or overlapping an object of an earlier kind are removed.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Literal, NamedTuple

import numpy as np
import shapely
from pydantic import AfterValidator

from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.scenery import CURB_HEIGHT_M, TRUNK_SHARE, build_unit_shape, copy_shape

Bounds = tuple[float, float]
# Curb before the sidewalk, or ground behind the sidewalk of a side with houses ("built") or without ("open").
Zone = Literal["curb", "built", "open"]

TINY_M = 1e-9  # avoids divisions by zero where corners of a line coincide
WALL_SEGMENT_M = 10.0  # largest length of the straight segments of walls and hedges


class RoadsideKind(NamedTuple):
    """Kind of roadside objects, in runs of pieces along a street; lengths are along it, depths away from it.

    Args:
        shape: Name of the shape, see `build_unit_shape`.
        zones: Zones with this kind.
        side_share: Share of the sides of these zones with this kind.
        offset_m: Smallest and largest distance from the line; negative over the street.
        run_m: Smallest and largest length of a run.
        gap_m: Smallest and largest gap between runs, at the usual density.
        depth_m: Smallest and largest depth.
        height_m: Smallest and largest height.
        piece_m: Length of a piece, or `WALL_SEGMENT_M` for walls without gaps; None if a run is one piece.
        piece_gap_m: Gap between the pieces of a run.
        footprint_share: Share of the size that must keep off streets.
    """

    shape: str
    zones: tuple[Zone, ...]
    side_share: float
    offset_m: Bounds
    run_m: Bounds
    gap_m: Bounds
    depth_m: Bounds
    height_m: Bounds
    piece_m: float | None = None
    piece_gap_m: float = 0.0
    footprint_share: float = 1.0


BEHIND: tuple[Zone, ...] = ("built", "open")
# Small objects have the sizes of usual products; densities agree with recorded sweeps in the share of directions
# in which the view ends (docs/measured/streets.md).
KINDS: Mapping[str, RoadsideKind] = {
    "house": RoadsideKind("house", ("built",), 1.0, (0.0, 5.0), (9.0, 24.0), (0.1, 4.0), (9.0, 15.0), (5.0, 24.0)),
    "back_house": RoadsideKind(
        "house", ("built",), 1.0, (24.0, 44.0), (9.0, 22.0), (4.0, 22.0), (9.0, 14.0), (5.0, 22.0)
    ),
    "hedge": RoadsideKind(
        "hedge", ("built",), 0.95, (0.2, 0.8), (8.0, 40.0), (1.0, 5.0), (0.5, 1.1), (0.9, 2.2), WALL_SEGMENT_M
    ),
    "hedgerow": RoadsideKind(
        "hedge", ("open",), 1.0, (0.3, 2.0), (20.0, 70.0), (2.0, 6.0), (0.8, 1.6), (1.2, 2.6), WALL_SEGMENT_M
    ),
    "fence": RoadsideKind(
        "fence", BEHIND, 0.7, (0.2, 1.2), (8.0, 40.0), (1.0, 9.0), (0.08, 0.08), (0.9, 1.8), WALL_SEGMENT_M
    ),
    "lamp": RoadsideKind("lamp", ("curb",), 0.9, (0.35, 0.45), (0.2, 0.2), (22.0, 34.0), (0.2, 0.2), (6.0, 8.0)),
    "tree": RoadsideKind(
        "tree", ("curb",), 0.7, (-0.9, -0.6), (2.0, 3.0), (4.0, 11.0), (2.0, 3.0), (6.5, 9.0),
        footprint_share=TRUNK_SHARE,
    ),
    "sign": RoadsideKind("sign", ("curb",), 0.9, (0.25, 0.35), (0.06, 0.06), (12.0, 32.0), (0.5, 0.6), (2.4, 3.0)),
    "bin": RoadsideKind("bin", ("curb",), 0.8, (0.3, 0.4), (0.5, 0.8), (12.0, 40.0), (0.4, 0.5), (0.8, 1.3)),
    "bicycle": RoadsideKind(
        "bicycle", ("curb",), 0.4, (0.3, 0.4), (1.8, 9.0), (15.0, 60.0), (0.5, 0.5), (1.0, 1.1), 1.75, 0.3
    ),
    "bollard": RoadsideKind(
        "bollard", ("curb",), 0.35, (0.3, 0.4), (4.0, 16.0), (8.0, 30.0), (0.12, 0.12), (0.8, 1.0), 0.12, 1.5
    ),
    "garden_tree": RoadsideKind("tree", BEHIND, 0.8, (1.5, 20.0), (2.0, 4.0), (4.0, 22.0), (2.0, 4.0), (5.0, 11.0)),
    "bush": RoadsideKind("bush", BEHIND, 0.8, (0.5, 12.0), (1.0, 2.5), (3.0, 16.0), (1.0, 2.5), (0.7, 2.5)),
}  # fmt: skip
HOUSES = ("house", "back_house")


def _check_density_factors(factors: float | Mapping[str, float]) -> float | Mapping[str, float]:
    """Check that factors are for known kinds and in the range of the densities that fit along a street."""
    max_factor = 4.0
    by_kind = factors if isinstance(factors, Mapping) else {"tree": factors}
    available = [kind for kind in KINDS if kind not in HOUSES]
    unknown = sorted(by_kind.keys() - set(available))
    if unknown:
        raise ValueError(f"unknown kinds of roadside objects: {', '.join(unknown)}; available: {', '.join(available)}")
    if not all(0.0 <= factor <= max_factor for factor in by_kind.values()):
        raise ValueError(f"density factors must be between 0 and {max_factor:g}; got {factors}")
    return factors


# Factor on the usual density of all kinds but houses, or factors for some kinds.
RoadsideDensity = Annotated[float | dict[str, float], AfterValidator(_check_density_factors)]


class StreetSide(NamedTuple):
    """Side of a street.

    Args:
        zone: Zone of the objects along the line.
        line_m: (K, 2) positions of a line with the street on its left.
    """

    zone: Zone
    line_m: Float64


def find_street_sides(
    street_area: shapely.Geometry,
    offsets_m: tuple[float, float],
    is_visible: Callable[[Float64], Bools],
    built_share: float,
    generator: np.random.Generator,
) -> list[StreetSide]:
    """Find the sides of all streets from their outline.

    Args:
        street_area: Area of all streets in the ground plane.
        offsets_m: Distance from its edge at which objects at the curb begin, and objects behind the sidewalk.
        is_visible: Function that tests which positions (N, 2) are needed.
        built_share: Share of the sides with houses.
        generator: Random generator.
    """
    side_length_m, vertex_spacing_m, tolerance_m = 60.0, 4.0, 0.3
    min_ring_m = 30.0  # shorter edges surround no block
    sides: list[StreetSide] = []
    for is_behind, offset_m in zip((False, True), offsets_m, strict=True):
        area = shapely.orient_polygons(shapely.buffer(street_area, offset_m, quad_segs=4))
        for ring in shapely.get_parts(shapely.boundary(area)):
            if ring.length <= min_ring_m:
                continue
            line_m = shapely.get_coordinates(shapely.segmentize(ring.simplify(tolerance_m), vertex_spacing_m))
            for side_m in np.array_split(line_m, max(round(ring.length / side_length_m), 1)):
                zone: Zone = "built" if generator.random() < built_share else "open"
                if len(side_m) > 1 and is_visible(side_m).all():
                    sides.append(StreetSide(zone if is_behind else "curb", side_m))
    return sides


class RoadsidePieces(NamedTuple):
    """N pieces of roadside objects.

    Args:
        outlines_m: (N, 4, 2) outlines in the ground plane, counterclockwise from the far side on.
        heights_m: (N,) heights.
        runs: (N,) index of the run of each piece.
    """

    outlines_m: Float64
    heights_m: Float64
    runs: Int64


def place_scenery(
    sides: Sequence[StreetSide],
    drivable_areas: Sequence[shapely.Geometry],
    walkable_areas: Sequence[shapely.Geometry],
    sidewalk_areas: Sequence[shapely.Geometry],
    compute_ground_heights_m: Callable[[Float64], Float64],
    density_factors: float | Mapping[str, float],
    generator: np.random.Generator,
) -> tuple[list[Mesh], list[Mesh]]:
    """Place objects along the sides of streets.

    Args:
        sides: Sides of streets.
        drivable_areas: Areas on which no object at a curb may stand.
        walkable_areas: Areas on which no object behind a sidewalk may stand.
        sidewalk_areas: Areas that are higher than the ground by a curb.
        compute_ground_heights_m: Function that returns ground heights (N,) at positions (N, 2).
        density_factors: Factors on the usual densities, see `RoadsideDensity`.
        generator: Random generator.

    Returns:
        Meshes of houses, and of all other objects; each kind is one mesh.
    """
    if not sides:
        return [], []
    lines = SideLines(sides)
    pieces_by_kind = []
    for name, kind in KINDS.items():
        if isinstance(density_factors, Mapping):
            factor = density_factors.get(name, 1.0)
        else:
            factor = 1.0 if name in HOUSES else density_factors
        pieces_by_kind.append(sample_pieces(kind, lines, factor, generator))
    kind_indices = np.repeat(np.arange(len(KINDS)), [len(pieces.runs) for pieces in pieces_by_kind])
    pieces = RoadsidePieces(*(np.concatenate(column) for column in zip(*pieces_by_kind, strict=True)))
    is_free, raised_m = find_free_pieces(pieces, kind_indices, drivable_areas, walkable_areas, sidewalk_areas)
    outlines_m, heights_m = pieces.outlines_m[is_free], pieces.heights_m[is_free]
    kind_indices, raised_m = kind_indices[is_free], raised_m[is_free]
    corners_m = compute_ground_heights_m(outlines_m.reshape(-1, 2)).reshape(-1, 4)
    lowest_m, base_m = corners_m.min(axis=1) + raised_m, corners_m.max(axis=1) + raised_m
    # On a slope, objects continue 1 m below their lowest corner.
    bottom_m = np.where(base_m > lowest_m, lowest_m - 1.0, lowest_m)
    houses: list[Mesh] = []
    objects: list[Mesh] = []
    for index, (name, kind) in enumerate(KINDS.items()):
        is_kind = kind_indices == index
        if is_kind.any():
            shape = build_unit_shape(kind.shape)
            mesh = copy_shape(shape, outlines_m[is_kind], bottom_m[is_kind], base_m[is_kind], heights_m[is_kind])
            (houses if name in HOUSES else objects).append(mesh)
    return houses, objects


class SideLines:
    """Lines of street sides, joined in one table.

    Args:
        sides: Sides of streets.

    Attributes:
        zones: Zone of each line.
        length_m: Length of each line.
    """

    def __init__(self, sides: Sequence[StreetSide]) -> None:
        self.zones = [side.zone for side in sides]
        counts = np.array([len(side.line_m) for side in sides])
        self._first = np.cumsum(counts) - counts
        self._last = self._first + counts - 1
        self._positions_m = np.concatenate([np.empty((0, 2)), *(side.line_m for side in sides)])
        directions = np.diff(self._positions_m, axis=0, append=0.0)
        directions[self._last] = directions[self._last - 1]
        lengths_m = np.linalg.norm(directions, axis=1)
        directions /= np.maximum(lengths_m, TINY_M)[:, None]
        lengths_m[self._last] = 0.0
        self._arc_lengths_m = np.cumsum(lengths_m) - lengths_m
        # At a corner, the normal is the mean of the normals of both segments.
        is_first = np.isin(np.arange(len(directions)), self._first)[:, None]
        forward = directions + np.where(is_first, directions, np.roll(directions, 1, 0))
        forward /= np.maximum(np.linalg.norm(forward, axis=1, keepdims=True), TINY_M)
        self._right = np.stack([forward[:, 1], -forward[:, 0]], axis=1)
        self.length_m = self._arc_lengths_m[self._last] - self._arc_lengths_m[self._first]

    def interpolate(self, line_indices: Int64, distances_m: Float64) -> tuple[Float64, Float64]:
        """Interpolate positions (N, 2, 2) and normals to the right (N, 2, 2).

        Args:
            line_indices: (N,) indices of lines.
            distances_m: (N, 2) distances from the starts of the lines.
        """
        first, last = self._first[line_indices][:, None], self._last[line_indices][:, None]
        arc_lengths_m = self._arc_lengths_m[first[:, 0]][:, None] + distances_m
        segment = np.clip(np.searchsorted(self._arc_lengths_m, arc_lengths_m, side="right") - 1, first, last - 1)
        segment_m = np.maximum(self._arc_lengths_m[segment + 1] - self._arc_lengths_m[segment], TINY_M)
        fraction = ((arc_lengths_m - self._arc_lengths_m[segment]) / segment_m)[..., None]
        positions_m = (1 - fraction) * self._positions_m[segment] + fraction * self._positions_m[segment + 1]
        return positions_m, (1 - fraction) * self._right[segment] + fraction * self._right[segment + 1]


def sample_pieces(
    kind: RoadsideKind, lines: SideLines, density_factor: float, generator: np.random.Generator
) -> RoadsidePieces:
    """Sample the pieces of a kind along the sides of its zones.

    Args:
        kind: Kind of objects.
        lines: Sides of streets.
        density_factor: Factor on the usual density; 0 for no objects.
        generator: Random generator.
    """
    has_kind = np.array([zone in kind.zones for zone in lines.zones], dtype=bool)
    has_kind[has_kind] = generator.random(np.count_nonzero(has_kind)) < kind.side_share
    line_indices = np.flatnonzero(has_kind)
    if not len(line_indices) or density_factor == 0:
        return RoadsidePieces(np.empty((0, 4, 2)), np.empty(0), np.empty(0, dtype=np.int64))
    line_m = lines.length_m[line_indices]
    gap_bounds_m = (kind.gap_m[0] / density_factor, kind.gap_m[1] / density_factor)
    # Enough runs for the longest line are sampled for all lines.
    shape = len(line_indices), int(line_m.max() / (kind.run_m[0] + gap_bounds_m[0])) + 1
    run_m, gap_m = generator.uniform(*kind.run_m, shape), generator.uniform(*gap_bounds_m, shape)
    # The start of a line is anywhere in a gap.
    gap_m[:, 0] *= generator.random(len(line_indices))
    start_m = np.cumsum(run_m + gap_m, axis=1) - run_m
    fits = start_m + kind.run_m[0] <= line_m[:, None]
    rows = np.nonzero(fits)[0]
    run_m = np.minimum(run_m[fits], line_m[rows] - start_m[fits])
    offset_m = generator.uniform(*kind.offset_m, len(rows))
    depth_m = generator.uniform(*kind.depth_m, len(rows))
    height_m = generator.uniform(*kind.height_m, len(rows))
    start_m, piece_m, runs = start_m[fits], run_m, np.arange(len(rows))
    # Runs are divided: walls into equal segments, other kinds into pieces with gaps.
    if kind.piece_m is not None:
        is_wall = kind.piece_m == WALL_SEGMENT_M
        counts = np.maximum((run_m / (kind.piece_m + kind.piece_gap_m)).astype(np.int64) + is_wall, 1)
        spacing_m = run_m / counts if is_wall else np.full(len(runs), kind.piece_m + kind.piece_gap_m)
        runs = np.repeat(runs, counts)
        index_in_run = np.arange(len(runs)) - np.repeat(np.cumsum(counts) - counts, counts)
        start_m = start_m[runs] + index_in_run * spacing_m[runs]
        piece_m = (spacing_m if is_wall else spacing_m - kind.piece_gap_m)[runs]
    ends_m = np.stack([start_m, start_m + piece_m], axis=1)
    positions_m, right = lines.interpolate(line_indices[rows[runs]], ends_m)
    near_m = positions_m + right * offset_m[runs, None, None]
    far_m = positions_m + right * (offset_m + depth_m)[runs, None, None]
    # At corners, pieces that would be stretched outside or squeezed inside by more than this factor are left out.
    min_scale = 0.6
    scales = [np.linalg.norm(line[:, 1] - line[:, 0], axis=1) / piece_m for line in (near_m, far_m)]
    is_undistorted = (np.abs(np.log(np.maximum(scales, TINY_M))) < -np.log(min_scale)).all(axis=0)
    outlines_m = np.concatenate([far_m, near_m[:, ::-1]], axis=1)[is_undistorted]
    return RoadsidePieces(outlines_m, height_m[runs][is_undistorted], runs[is_undistorted])


def find_free_pieces(
    pieces: RoadsidePieces,
    kind_indices: Int64,
    drivable_areas: Sequence[shapely.Geometry],
    walkable_areas: Sequence[shapely.Geometry],
    sidewalk_areas: Sequence[shapely.Geometry],
) -> tuple[Bools, Float64]:
    """Find pieces that keep off streets, edges of sidewalks and pieces of earlier kinds.

    Args:
        pieces: N pieces.
        kind_indices: (N,) index of the kind of each piece in `KINDS`.
        drivable_areas: See `place_scenery`.
        walkable_areas: See `place_scenery`.
        sidewalk_areas: See `place_scenery`.

    Returns:
        (N,) True for free pieces, and (N,) heights of their base above the ground in meters.
    """
    outlines_m = pieces.outlines_m
    footprint_shares = np.array([kind.footprint_share for kind in KINDS.values()])[kind_indices][:, None, None]
    centers_m = outlines_m.mean(axis=1, keepdims=True)
    footprints = shapely.linearrings(centers_m + footprint_shares * (outlines_m - centers_m))
    is_free, touches_sidewalk, is_on_sidewalk = np.zeros((3, len(kind_indices)), dtype=bool)
    # shapely prepares the geometries of the query, so that the large ones are queried.
    is_at_curb = np.array(["curb" in kind.zones for kind in KINDS.values()])[kind_indices]
    for selection, areas in ((is_at_curb, drivable_areas), (~is_at_curb, walkable_areas)):
        tree = shapely.STRtree(footprints[selection])
        blocked = tree.query(np.array(areas, dtype=object), predicate="intersects")[1]
        is_free[selection] = ~np.isin(np.arange(np.count_nonzero(selection)), blocked)
    tree = shapely.STRtree(footprints)
    touches_sidewalk[tree.query(np.array(sidewalk_areas, dtype=object), predicate="intersects")[1]] = True
    is_on_sidewalk[tree.query(np.array(sidewalk_areas, dtype=object), predicate="contains")[1]] = True
    is_free &= touches_sidewalk == is_on_sidewalk
    # On the inside of a tight curve, where the normals meet, outlines are folded.
    edges_m = np.roll(outlines_m, -1, axis=1) - outlines_m
    next_edges_m = np.roll(edges_m, -1, axis=1)
    is_free &= (edges_m[..., 0] * next_edges_m[..., 1] > edges_m[..., 1] * next_edges_m[..., 0]).all(axis=1)
    candidates = np.flatnonzero(is_free)
    kinds_and_runs = np.stack([kind_indices[candidates], pieces.runs[candidates]])
    groups = np.unique(kinds_and_runs, axis=1, return_inverse=True)[1]
    later, earlier = candidates[find_overlapping_pairs(outlines_m[candidates], groups)]
    # A piece yields only to pieces that stay.
    order = np.lexsort((earlier, later))
    for later_piece, earlier_piece in zip(later[order].tolist(), earlier[order].tolist(), strict=True):
        if is_free[earlier_piece]:
            is_free[later_piece] = False
    return is_free, CURB_HEIGHT_M * is_on_sidewalk


def find_overlapping_pairs(outlines_m: Float64, groups: Int64) -> Int64:
    """Find pairs of outlines of different groups that overlap: no edge of either separates them.

    Args:
        outlines_m: (N, 4, 2) convex outlines.
        groups: (N,) group of each outline.

    Returns:
        (2, P) indices of the later and of the earlier outline of each pair.
    """
    # Diagonals have the same bounds as boxes and are created faster.
    diagonals = shapely.linestrings(np.stack([outlines_m.min(axis=1), outlines_m.max(axis=1)], axis=1))
    pairs = shapely.STRtree(diagonals).query(diagonals)
    pairs = pairs[:, (pairs[0] > pairs[1]) & (groups[pairs[0]] != groups[pairs[1]])]
    for order in (1, -1):
        first, second = pairs[::order]
        normals = (np.roll(outlines_m, -1, axis=1) - outlines_m)[first][..., ::-1] * np.array([1.0, -1.0])
        offsets_m = outlines_m[second][:, :, None] - outlines_m[first][:, None]
        distances = np.einsum("pkc,plkc->plk", normals, offsets_m)
        overlaps = ~(distances.min(axis=1) > 0).any(axis=1)
        pairs = pairs[:, overlaps]
    return np.asarray(pairs)
