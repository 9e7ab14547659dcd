"""How bodies move along the places that SUMO tells: the front axle leads and the rest is drawn along, off the kerbs."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.simulation.sumo.floating import TIME_SLACK_S, SumoTrack
from torchcover.simulation.traffic.fleet import HITCHES, compute_tractrix_yaw_rad, compute_trailer_poses, stack_paths

# Bodies have a pose this often, and places are means over so much time before and after.
FINE_S, SMOOTH_S = 0.1, 1.0
# Corners of ways are rounded over so much before and after them; ways are looked at this often.
CORNER_M, ALONG_M = 3.0, 0.5
# The axles of vehicles lie so far from their middle, as a share of the length; people turn about a point behind them.
AXLE_SHARE, HEELS_M = 0.3, 0.4
# Nobody walks faster: SUMO lets people jump where ways meet, which they walk off with so much more speed instead.
FASTEST_ON_FOOT_MPS, CATCH_UP_MPS, HURRIES_MPS = 4.0, 0.8, 3.5
# People go so far within the edges of pavements and crossings, to which those come back who were no farther from them.
OFF_EDGE_M, BESIDE_M = 0.25, 2.0
# Whether bodies are over kerbs is looked at this often along their ways.
LOOK_M = 1.0
# How often a way is moved aside, over which length before and after, and the room that is left; to rub is to be off.
SWINGS, SWING_M, SWING_LENGTHS, ROOM_M, RUBS_M = 4, 8.0, 1.0, 0.1, 0.05
# Outlines of bodies are that far apart, unless one is so much above the other. Who meets whom is looked for in pieces
# of ways of so many poses.
APART_M, ABOVE_M, PIECE_STEPS = 0.05, 3.0, 20
BODIES_AT_ONCE = 256


class RoadUser(NamedTuple):
    """Somebody, where their front is, the length that the simulation takes them for, and the body that stands for them.

    `part_sizes_m` are lengths and widths of the body, and of what it draws along.
    """

    track: SumoTrack
    kind: str
    length_m: float
    part_sizes_m: tuple[tuple[float, float], ...]

    @property
    def lead_offset_m(self) -> float:
        """How far the point that leads is before the middle."""
        return 0.0 if self.track.is_pedestrian else AXLE_SHARE * self.part_sizes_m[0][0]

    @property
    def trailer_axle_distance_m(self) -> float:
        """How far the axles of what it draws along are behind the point that leads, on a straight."""
        return (
            self.lead_offset_m - HITCHES[self.kind].hitch_offset_m + HITCHES[self.kind].hitch_to_axle_m
            if self.kind in HITCHES
            else 0.0
        )

    @property
    def trailing_distance_m(self) -> float:
        """How far the point that is drawn along is behind the one that leads."""
        return HEELS_M if self.track.is_pedestrian else 2 * self.lead_offset_m


class Motion(NamedTuple):
    """Where a body is, at (K,) evenly spaced times; those who are there all the time share them.

    `poses` are (K, 3) x and y of its middle, of its front if it is in two parts, and its heading in radians, without
    leaps; `trailer_poses` is likewise what it draws along; `curb_overlap_m` how far its outline reaches over a kerb at the worst.
    """

    road_user: RoadUser
    times_s: Float64
    poses: Float64
    curb_overlap_m: float = 0.0
    trailer_poses: Float64 | None = None

    @property
    def parts(self) -> list[tuple[Float64, tuple[float, float]]]:
        """Poses of its parts, one or two, and their lengths and widths."""
        poses = [self.poses] if self.trailer_poses is None else [self.poses, self.trailer_poses]
        return list(zip(poses, self.road_user.part_sizes_m, strict=True))

    @property
    def is_plausible(self) -> bool:
        """Whether it walks as people do, or stays off the kerbs."""
        if self.road_user.track.is_pedestrian:
            return bool((_lengths(np.diff(self.poses, axis=0)) < FASTEST_ON_FOOT_MPS * np.diff(self.times_s)).all())
        return self.curb_overlap_m < RUBS_M


def compute_motions(
    road_users: Sequence[RoadUser],
    duration_s: float,
    origin_m: Float64,
    obstacles: NDArray[np.object_] | None = None,
    walkable_area: shapely.Geometry | None = None,
) -> list[Motion]:
    """Move bodies along their tracks, without those who are there for no time; `origin_m` is subtracted of all places.

    Vehicles swing out for `obstacles`, polygons in plan of pavements and what is parked, where they can. Who is beside
    what people walk on goes along its edge instead, where there is time to.
    """
    shapely.prepare(walkable_area)
    times_s = np.linspace(0.0, duration_s, int(np.ceil(duration_s / FINE_S - TIME_SLACK_S)) + 1)
    there: list[tuple[RoadUser, Float64]] = []
    for user in road_users:
        first, end = np.searchsorted(times_s, user.track.times_s[[0, -1]] + [-TIME_SLACK_S, TIME_SLACK_S]).tolist()
        if end - first > 1:
            there.append((user, times_s if end - first == len(times_s) else times_s[first:end]))
    found: list[Motion] = []
    for start in range(0, len(there), BODIES_AT_ONCE):
        some, own_s = zip(*there[start : start + BODIES_AT_ONCE], strict=True)
        ways_m = [_lead_m(user, at_s, origin_m, walkable_area) for user, at_s in zip(some, own_s, strict=True)]
        poses = _poses(some, ways_m)
        over_m = np.zeros(len(some)) if obstacles is None else _keep_off(some, ways_m, poses, obstacles)
        rears = _rears(some, poses)
        found += map(Motion, some, own_s, poses, over_m.tolist(), map(rears.get, range(len(some))))
    return found


def _lead_m(user: RoadUser, times_s: Float64, origin_m: Float64, walked: shapely.Geometry | None) -> Float64:
    """(K, 2) where the point goes that leads, at (K,) times."""
    track = user.track
    told_m = (_without_jumps(track) if track.is_pedestrian else track.front_positions_m[:, :2]) - origin_m
    even_m = np.stack([np.interp(times_s, track.times_s, axis) for axis in told_m.T], axis=1)
    if track.is_pedestrian and walked is not None and not walked.is_empty:
        even_m = _along_edges(even_m, times_s[1] - times_s[0], walked)
    half_s = max(SMOOTH_S, float(np.median(np.diff(track.times_s))))
    smooth_m = smooth_positions(even_m, int(np.ceil(half_s / (times_s[1] - times_s[0]))))
    before_middle_m = user.lead_offset_m + (HITCHES[user.kind].center_offset_m if user.kind in HITCHES else 0.0)
    behind_m = 0.0 if track.is_pedestrian else max(user.length_m / 2 - before_middle_m, 0.0)
    return _behind(smooth_m, behind_m, np.deg2rad(track.yaw_deg[0]))


def _poses(users: Sequence[RoadUser], ways_m: Sequence[Float64]) -> list[Float64]:
    """(K, 3) of each, along the (K, 2) way of its point that leads."""
    lead_m = stack_paths(ways_m)
    start = np.deg2rad([user.track.yaw_deg[0] for user in users])
    yaw = compute_tractrix_yaw_rad(lead_m, np.array([user.trailing_distance_m for user in users]), start)
    ahead_m = np.array([user.lead_offset_m for user in users])[:, None] * np.stack([np.cos(yaw), np.sin(yaw)], axis=2)
    poses = np.concatenate([lead_m - ahead_m, yaw[..., None]], axis=2)
    return [poses[: len(way_m), number].copy() for number, way_m in enumerate(ways_m)]


def _rears(users: Sequence[RoadUser], poses: Sequence[Float64]) -> dict[int, Float64]:
    """(K, 3) poses of what some draw along, by their numbers, along those of fronts."""
    fronts = [number for number, user in enumerate(users) if user.kind in HITCHES]
    rears = compute_trailer_poses([users[number].kind for number in fronts], [poses[number] for number in fronts])
    return dict(zip(fronts, rears, strict=True))


def _keep_off(
    users: Sequence[RoadUser], ways_m: Sequence[Float64], poses: list[Float64], obstacles: NDArray[np.object_]
) -> Float64:
    """Let vehicles swing out where the inner side of a turn would come over a kerb; (N,) how far they still do."""
    over_m, moved_m, aside_m = np.zeros(len(users)), list(ways_m), [np.zeros(len(way_m)) for way_m in ways_m]
    left = [np.stack([-np.sin(own[:, 2]), np.cos(own[:, 2])], axis=1) for own in poses]
    rears = _rears(users, poses)
    # When bodies are looked at, and what they draw along.
    look: dict[tuple[int, bool], Int64] = {}
    for number, (user, way_m) in enumerate(zip(users, ways_m, strict=True)):
        if not user.track.is_pedestrian:
            steps = np.diff((_along_m(way_m) / LOOK_M).astype(np.int64), prepend=-1)
            look[number, False] = np.flatnonzero(steps)
            if number in rears:
                look[number, True] = look[number, False]
    for swing in range(SWINGS + 1):
        counts = [len(at) for at in look.values()]
        of = np.repeat(np.array([number for number, _ in look], dtype=np.int64), counts)
        rear = np.repeat(np.array([is_rear for _, is_rear in look], dtype=bool), counts)
        when = np.concatenate([np.empty(0, dtype=np.int64), *look.values()])
        size_m = np.repeat(
            np.array([users[number].part_sizes_m[is_rear] for number, is_rear in look]).reshape(-1, 2), counts, axis=0
        )
        looked_at = [(rears if is_rear else poses)[number][at] for (number, is_rear), at in look.items()]
        sides_m = _push_m(obstacles, np.concatenate([np.empty((0, 3)), *looked_at]), size_m)
        over_m[[number for number, _ in look]] = 0.0
        np.maximum.at(over_m, of, np.abs(sides_m).max(axis=0))
        push_m = sides_m.sum(axis=0)
        met = np.unique(of[push_m != 0.0]).tolist()
        if not met or swing == SWINGS:
            break
        look = {key: at for key, at in look.items() if key[0] in met}
        for number in met:
            pushed = (of == number) & (push_m != 0.0)
            wanted_m = push_m[pushed] + np.copysign(ROOM_M, push_m[pushed])
            along_m, lag_m = _along_m(ways_m[number]), users[number].trailing_distance_m
            middle_m = along_m[when[pushed]] - np.where(rear[pushed], lag_m, 0.0)
            away = np.abs(along_m[:, None] - middle_m) / (SWING_M + SWING_LENGTHS * users[number].part_sizes_m[0][0])
            bumps_m = wanted_m * np.where(away < 1, (1 + np.cos(np.pi * away)) / 2, 0.0)
            aside_m[number] += bumps_m.max(axis=1).clip(min=0.0) + bumps_m.min(axis=1).clip(max=0.0)
            moved_m[number] = ways_m[number] + aside_m[number][:, None] * left[number]
        again = _poses([users[number] for number in met], [moved_m[number] for number in met])
        for number, own in zip(met, again, strict=True):
            poses[number] = own
        rears = _rears(users, poses)
    return over_m


def drop_colliding_users(motions: Sequence[Motion]) -> list[Motion]:
    """Those that can be, and are never where another one is: of two that meet the one stays that meets fewer.

    The first is there all the time, and stays.
    """
    motions = [motions[0], *(body for body in motions[1:] if body.is_plausible)]
    meets = np.zeros((len(motions), len(motions)), dtype=bool)
    step_s = float(motions[0].times_s[1])
    # With the height at which it is told to be: who is on a bridge meets nobody below.
    heights_m = [
        np.interp(body.times_s, body.road_user.track.times_s, body.road_user.track.front_positions_m[:, 2])
        for body in motions
    ]
    parts = [
        (number, np.column_stack([poses, heights_m[number]]), size_m)
        for number, body in enumerate(motions)
        for poses, size_m in body.parts
    ]
    of = np.array([number for number, _, _ in parts])
    first = [round(float(motions[number].times_s[0]) / step_s) for number in of.tolist()]
    size_m = np.array([size_m for _, _, size_m in parts]) + APART_M
    reach_m = np.linalg.norm(size_m, axis=1)[:, None] / 2
    for begin in range(0, len(motions[0].times_s), PIECE_STEPS):
        poses = np.full((PIECE_STEPS, len(parts), 4), np.nan)
        for number, (_, own, _) in enumerate(parts):
            start = begin - first[number]
            piece = own[max(start, 0) : max(start + PIECE_STEPS, 0)]
            poses[max(-start, 0) :, number][: len(piece)] = piece
        there = np.flatnonzero(np.isfinite(poses[..., 0]).any(axis=0))
        places_m = poses[:, there, :2]
        low_m = np.fmin.reduce(places_m) - reach_m[there]
        high_m = np.fmax.reduce(places_m) + reach_m[there]
        boxes = shapely.box(*low_m.T, *high_m.T)
        one, other = there[shapely.STRtree(boxes).query(boxes)]
        one, other = (pair[of[one] < of[other]] for pair in (one, other))
        meet = _overlap(poses[:, one], size_m[one], poses[:, other], size_m[other])
        met = (meet & (np.abs(poses[:, one, 3] - poses[:, other, 3]) < ABOVE_M)).any(axis=0)
        one, other = of[one[met]], of[other[met]]
        meets[one, other] = meets[other, one] = True
    number_met = meets.sum(axis=1)
    number_met[0] = -1
    stays = np.ones(len(motions), dtype=bool)
    for number in np.argsort(number_met, kind="stable").tolist():
        if stays[number]:
            stays[meets[number]] = False
    return [body for body, kept in zip(motions, stays.tolist(), strict=True) if kept]


def _overlap(one: Float64, size_m: Float64, other: Float64, other_size_m: Float64) -> Bools:
    """(T, K) whether K pairs of rectangles with poses (T, K, 3 or more) do, as no axis of either separates them."""
    between_m, turn = other[..., :2] - one[..., :2], other[..., 2] - one[..., 2]
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    meet = np.isfinite(turn)
    for yaw, own, its in ((one[..., 2], size_m, other_size_m), (other[..., 2], other_size_m, size_m)):
        forward_m = between_m[..., 0] * np.cos(yaw) + between_m[..., 1] * np.sin(yaw)
        left_m = between_m[..., 1] * np.cos(yaw) - between_m[..., 0] * np.sin(yaw)
        meet &= 2 * np.abs(forward_m) < own[:, 0] + its[:, 0] * cos + its[:, 1] * sin
        meet &= 2 * np.abs(left_m) < own[:, 1] + its[:, 0] * sin + its[:, 1] * cos
    return meet


def _push_m(obstacles: NDArray[np.object_], poses: Float64, size_m: Float64) -> Float64:
    """(2, K) how far K rectangles have to go to their right, negative, and to their left to be off obstacles."""
    outlines = shapely.polygons(compute_rectangle_corners_m(poses, size_m))
    part, body = shapely.STRtree(outlines).query(obstacles, predicate="intersects")
    common = shapely.intersection(outlines[body], obstacles[part])
    places_m, of_pair = shapely.get_coordinates(common, return_index=True)
    away_m, yaw = places_m - poses[body[of_pair], :2], poses[body[of_pair], 2]
    left_m = away_m[:, 1] * np.cos(yaw) - away_m[:, 0] * np.sin(yaw)
    low_m, high_m = np.full((2, len(body)), [[np.inf], [-np.inf]])
    np.minimum.at(low_m, of_pair, left_m)
    np.maximum.at(high_m, of_pair, left_m)
    # A piece lies on the side where its middle is.
    half_m = size_m[body, 1] / 2
    need_m = np.where(low_m + high_m > 0, low_m - half_m, high_m + half_m)
    pushed = np.zeros((2, len(poses)))
    for worst, of_side in zip((np.minimum, np.maximum), pushed, strict=True):
        worst.at(of_side, body, need_m)
    return pushed


def compute_rectangle_corners_m(poses: Float64, sizes_m: Float64) -> Float64:
    """(K, 4, 2) corners of K rectangles with poses x, y and a heading in radians, and a length and width."""
    forward = np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
    left = np.stack([-forward[:, 1], forward[:, 0]], axis=1)
    half = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]) / 2
    along_m, aside_m = (half[:, k] * sizes_m[:, k, None] for k in (0, 1))
    return np.asarray(poses[:, None, :2] + along_m[..., None] * forward[:, None] + aside_m[..., None] * left[:, None])


def _lengths(vectors: Float64) -> Float64:
    """(...) lengths in plan of (..., 2) vectors, or of what else begins with x and y."""
    return np.asarray(np.hypot(vectors[..., 0], vectors[..., 1]))


def _along_m(way_m: Float64) -> Float64:
    """(K,) the length of a (K, 2) way up to each place."""
    return np.concatenate([[0.0], _lengths(np.diff(way_m, axis=0)).cumsum()])


def smooth_positions(positions_m: Float64, half_window: int) -> Float64:
    """(K, 2) means over so many places before and after; beyond the ends it goes on as it came."""
    weights = np.hanning(2 * half_window + 3)[1:-1] / np.hanning(2 * half_window + 3).sum()
    padded_m = np.pad(positions_m, ((half_window, half_window), (0, 0)), "reflect", reflect_type="odd")
    return np.stack([np.convolve(axis, weights, "valid") for axis in padded_m.T], axis=1)


def _behind(way_m: Float64, behind_m: float, yaw: float) -> Float64:
    """(K, 2) the same way so much behind, with corners rounded; before its begin it has a heading."""
    along_m = _along_m(way_m)
    told_m = np.concatenate([[-behind_m], along_m])
    way_m = np.concatenate([way_m[:1] - behind_m * np.array([np.cos(yaw), np.sin(yaw)]), way_m])
    at_m = np.linspace(-behind_m, along_m[-1], 2 + int((along_m[-1] + behind_m) / ALONG_M))
    even_m = np.stack([np.interp(at_m, told_m, axis) for axis in way_m.T], axis=1)
    round_m = smooth_positions(even_m, round(CORNER_M / ALONG_M))
    return np.stack([np.interp(along_m - behind_m, at_m, axis) for axis in round_m.T], axis=1)


def _without_jumps(track: SumoTrack) -> Float64:
    """(K, 2) places of somebody on foot; what was jumped is walked before and after, a little faster."""
    times_s, places_m = track.times_s, track.front_positions_m[:, :2]
    steps_m = np.diff(places_m, axis=0)
    lengths_m = _lengths(steps_m)
    walked_m = places_m.copy()
    for at in np.flatnonzero(lengths_m > FASTEST_ON_FOOT_MPS * np.diff(times_s)).tolist():
        takes_s = min(lengths_m[at] / CATCH_UP_MPS, times_s[-1] - times_s[0])
        begin_s = (times_s[at : at + 2].mean() - takes_s / 2).clip(times_s[0], times_s[-1] - takes_s)
        share = ((times_s - begin_s) / takes_s).clip(0.0, 1.0) - (np.arange(len(times_s)) > at)
        walked_m += share[:, None] * steps_m[at]
    return walked_m


def _along_edges(way_m: Float64, step_s: float, walked: shapely.Geometry) -> Float64:
    """(K, 2) places of somebody on foot, who goes along the edge of what is walked on instead of beside it.

    SUMO lets people walk straight through places where streets meet, even those that bend around a carriageway.
    """
    off = ~shapely.contains_xy(walked, *way_m.T)
    if not off.any():
        return way_m
    found_m, rings = way_m.copy(), shapely.get_rings(shapely.get_parts(walked.buffer(-OFF_EDGE_M)))
    for first, end in np.flatnonzero(np.diff(np.pad(off, 1).astype(np.int8))).reshape(-1, 2).tolist():
        ends = shapely.points(way_m[[max(first - 1, 0), min(end, len(way_m) - 1)]])
        nearest = rings[int(shapely.distance(rings[:, None], ends).sum(axis=1).argmin())]
        begin_m, end_m = shapely.line_locate_point(nearest, ends)
        length_m = shapely.length(nearest)
        along_m = (end_m - begin_m + length_m / 2) % length_m - length_m / 2
        if shapely.distance(nearest, ends).max() < BESIDE_M and abs(along_m) < HURRIES_MPS * step_s * (end - first + 1):
            share = np.arange(1, end - first + 1) / (end - first + 1)
            at = shapely.line_interpolate_point(nearest, (begin_m + share * along_m) % length_m)
            found_m[first:end] = shapely.get_coordinates(at)
    return found_m
