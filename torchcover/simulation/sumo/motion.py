"""How bodies move along the places that SUMO tells: the front axle leads and the rest is drawn along, off the kerbs."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from torchcover.simulation.sumo.floating import TIME_SLACK_S, SumoTrack

Numbers = NDArray[np.float64]

# Bodies have a pose this often, and places are means over so much time before and after.
FINE_S = 0.1
SMOOTH_S = 1.0
# Corners of ways are rounded over so much before and after them; ways are looked at this often.
CORNER_M, ALONG_M = 3.0, 0.5
STANDS_M = 1e-6
# The axles of vehicles lie so far from their middle, as a share of the length; people turn about a point behind them.
AXLE_SHARE = 0.3
HEELS_M = 0.4
# Nobody walks faster: SUMO lets people jump where ways meet, which they walk off with so much more speed instead.
FASTEST_ON_FOOT_MPS = 4.0
CATCH_UP_MPS = 0.8
# Who follows its own way so closely is off the kerbs, as its lane is.
ASTRAY_M, LOOKS_EVERY = 0.25, 2
# How often a way is moved aside, and over which length before and after; some room is left.
SWINGS = 4
SWING_LENGTHS, SWING_M = 1.0, 8.0
ROOM_M = 0.1
# Wheels that come so near to a kerb rub along it.
RUBS_M = 0.05
BODIES_AT_ONCE = 256
# Outlines of bodies are that far apart. Who meets whom is looked for in pieces of ways of so many poses.
APART_M = 0.05
PIECE_STEPS = 20


class RoadUser(NamedTuple):
    """Somebody, and the body that stands for it.

    Args:
        track: Where its front is.
        kind: Of its body.
        length_m: That the simulation takes it for.
        size_m: Length and width of the body.
    """

    track: SumoTrack
    kind: str
    length_m: float
    size_m: tuple[float, float]


class Motion(NamedTuple):
    """Where a body is.

    Args:
        user: Whose.
        times_s: (K,) evenly spaced; those who are there all the time share them.
        poses: (K, 3) x and y of its middle, and its heading in radians, without leaps.
        over_kerb_m: How far its outline reaches onto the pavement at the worst.
    """

    user: RoadUser
    times_s: Numbers
    poses: Numbers
    over_kerb_m: float = 0.0

    @property
    def can_be(self) -> bool:
        """Whether it walks as people do, or stays off the kerbs."""
        ways_m = _lengths(np.diff(self.poses, axis=0))
        if self.user.track.on_foot:
            return bool((ways_m < FASTEST_ON_FOOT_MPS * np.diff(self.times_s)).all())
        return self.over_kerb_m < RUBS_M


def motions(
    users: Sequence[RoadUser],
    duration_s: float,
    origin_m: Numbers,
    obstacles: NDArray[np.object_] | None = None,
) -> list[Motion]:
    """Move bodies along their tracks, without those who are there for no time.

    Args:
        users: Who.
        duration_s: Of the run, from 0 on.
        origin_m: (2,) what is subtracted of all places.
        obstacles: Polygons in plan, of pavements and what is parked: vehicles swing out for them where they can.
    """
    times_s = np.linspace(0.0, duration_s, int(np.ceil(duration_s / FINE_S - TIME_SLACK_S)) + 1)
    by_time = sorted(range(len(users)), key=lambda number: users[number].track.times_s[0])
    found: dict[int, Motion] = {}
    for start in range(0, len(users), BODIES_AT_ONCE):
        some = by_time[start : start + BODIES_AT_ONCE]
        group = _Group([users[number] for number in some], times_s, origin_m)
        if obstacles is not None:
            group.keep_off(obstacles)
        found |= {some[at]: motion for at, motion in group.motions()}
    return [found[number] for number in sorted(found)]


class _Group:
    """Bodies side by side, (T, N): before and after its time each goes straight on."""

    def __init__(self, users: Sequence[RoadUser], times_s: Numbers, origin_m: Numbers) -> None:
        self.users = users
        self._times_s = times_s
        step_s = times_s[1] - times_s[0]
        tracks = [user.track for user in users]
        self._first, self._end = (
            np.array([rounded((at - slack_s) / step_s) for at in ends]).astype(np.int64).clip(0, len(times_s))
            for rounded, slack_s, ends in (
                (np.ceil, TIME_SLACK_S, [track.times_s[0] for track in tracks]),
                (lambda at: np.floor(at) + 1, -TIME_SLACK_S, [track.times_s[-1] for track in tracks]),
            )
        )
        steps_s = [float(np.median(np.diff(track.times_s))) for track in tracks if len(track.times_s) > 1]
        half = int(np.ceil(max(SMOOTH_S, *steps_s, 0.0) / step_s))
        self._from = int(self._first.min()) - half
        own_s = step_s * np.arange(self._from - half, int(self._end.max()) + 2 * half)
        places_m = np.empty((len(own_s), len(users), 2))
        yaw = np.deg2rad([track.yaw_deg[0] for track in tracks])
        for number, track in enumerate(tracks):
            told_m = _without_jumps(track) if track.on_foot else track.places_m[:, :2]
            places_m[:, number] = _straight_on(own_s, track.times_s, told_m - origin_m)
        weights = np.hanning(2 * half + 3)[1:-1]
        smooth_m = sum(
            weight / weights.sum() * places_m[k : len(places_m) - 2 * half + k] for k, weight in enumerate(weights)
        )
        on_foot = np.array([track.on_foot for track in tracks])
        self._size_m = np.array([user.size_m for user in users])
        told_length_m = np.array([user.length_m for user in users])
        self._ahead_m = np.where(on_foot, 0.0, AXLE_SHARE * self._size_m[:, 0])
        self._wheelbase_m = np.where(on_foot, HEELS_M, 2 * self._ahead_m)
        self._heading = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
        behind_m = np.where(on_foot, 0.0, np.maximum(told_length_m / 2 - self._ahead_m, 0.0))
        self._lead_m = self._along(np.asarray(smooth_m), behind_m)
        self._on_foot = on_foot
        self.yaw = tractrix(self._lead_m, self._wheelbase_m, yaw)
        self.over_kerb_m = np.zeros(len(users))

    def _along(self, ways_m: Numbers, behind_m: Numbers) -> Numbers:
        """The same ways so much behind, without corners; before their begin and after their end they are straight."""
        along_m = _along_m(ways_m)
        begin, end = (
            CORNER_M * np.where(stands[:, None], self._heading, step / np.maximum(_lengths(step), STANDS_M)[:, None])
            for step in np.diff(ways_m, axis=0)[[0, -1]]
            for stands in (_lengths(step) < STANDS_M,)
        )
        half = round(CORNER_M / ALONG_M)
        weights = np.hanning(2 * half + 3)[1:-1] / np.hanning(2 * half + 3).sum()
        found = np.empty_like(ways_m)
        for number, back_m in enumerate(behind_m.tolist()):
            far = 1 + back_m / CORNER_M
            way_m = np.vstack(
                [ways_m[0, number] - far * begin[number], ways_m[:, number], ways_m[-1, number] + 2 * end[number]]
            )
            told_m = np.concatenate([[-far * CORNER_M], along_m[:, number], [along_m[-1, number] + 2 * CORNER_M]])
            at_m = np.arange(told_m[0], told_m[-1], ALONG_M)
            for axis in (0, 1):
                rounded_m = np.convolve(np.interp(at_m, told_m, way_m[:, axis]), weights, mode="valid")
                found[:, number, axis] = np.interp(along_m[:, number] - back_m, at_m[half:-half], rounded_m)
        return found

    def poses(self, at: tuple[Any, ...] = ()) -> Numbers:
        """(..., 3) x and y of the middles, and headings: of (T, N), or of those at some places of that."""
        yaw, number = self.yaw[at], at[1] if at else slice(None)
        x_m, y_m = np.moveaxis(self._lead_m[at], -1, 0)
        ahead_m = self._ahead_m[number]
        return np.stack([x_m - ahead_m * np.cos(yaw), y_m - ahead_m * np.sin(yaw), yaw], axis=-1)

    def keep_off(self, obstacles: NDArray[np.object_]) -> None:
        """Swing out where the inner side of a turn would come over a kerb, as long vehicles do."""
        lead_m, start = self._lead_m.copy(), self.yaw[0].copy()
        along_m, way = _along_m(lead_m), _held(np.gradient(lead_m, axis=0))
        left = np.stack([-way[..., 1], way[..., 0]], axis=2)
        rear_m = 2 * self.poses()[..., :2] - lead_m
        astray_m = _lengths(rear_m - self._along(lead_m, self._wheelbase_m))
        step = np.arange(len(lead_m))[:, None] + self._from
        there = (step >= self._first) & (step < self._end) & (step % LOOKS_EVERY == 0) & ~self._on_foot
        aside_m, look = np.zeros(lead_m.shape[:2]), there & (astray_m > ASTRAY_M)
        for swing in range(SWINGS + 1):
            at, number = np.nonzero(look)
            push_m = _push_m(obstacles, self.poses((at, number)), self._size_m[number])
            self.over_kerb_m[look.any(axis=0)] = 0.0
            np.maximum.at(self.over_kerb_m, number, np.abs(push_m))
            met = np.flatnonzero(self.over_kerb_m)
            if len(met) == 0 or swing == SWINGS:
                return
            for one in met.tolist():
                own = np.flatnonzero((number == one) & (push_m != 0.0))
                wanted_m = push_m[own] + np.copysign(ROOM_M, push_m[own])
                within_m = SWING_M + SWING_LENGTHS * self._size_m[one, 0]
                away = np.abs(along_m[:, one, None] - along_m[at[own], one]) / within_m
                bumps_m = wanted_m * np.where(away < 1, (1 + np.cos(np.pi * away)) / 2, 0.0)
                aside_m[:, one] += bumps_m.max(axis=1).clip(min=0.0) + bumps_m.min(axis=1).clip(max=0.0)
            self._lead_m[:, met] = lead_m[:, met] + aside_m[:, met, None] * left[:, met]
            self.yaw[:, met] = tractrix(self._lead_m[:, met], self._wheelbase_m[met], start[met])
            look = there & (aside_m != 0.0)

    def motions(self) -> list[tuple[int, Motion]]:
        """Of those who are there for some time, by number."""
        found, poses = [], self.poses()
        for number, user in enumerate(self.users):
            first, end = int(self._first[number]), int(self._end[number])
            own = slice(first - self._from, end - self._from)
            if end - first > 1:
                times_s = self._times_s if end - first == len(self._times_s) else self._times_s[first:end]
                over_m = float(self.over_kerb_m[number])
                found.append((number, Motion(user, times_s, poses[own, number].copy(), over_m)))
        return found


def possible(bodies: Sequence[Motion]) -> list[Motion]:
    """Those that can be, and are never where another one is: of two that meet the one stays that meets fewer.

    Args:
        bodies: Some, of which the first is there all the time, and stays.
    """
    bodies = [bodies[0], *(body for body in bodies[1:] if body.can_be)]
    meets = np.zeros((len(bodies), len(bodies)), dtype=bool)
    step_s = float(bodies[0].times_s[1])
    first = [round(float(body.times_s[0]) / step_s) for body in bodies]
    size_m = np.array([body.user.size_m for body in bodies]) + APART_M
    reach_m = np.linalg.norm(size_m, axis=1)[:, None] / 2
    for begin in range(0, len(bodies[0].times_s), PIECE_STEPS):
        poses = np.full((PIECE_STEPS, len(bodies), 3), np.nan)
        for number, body in enumerate(bodies):
            start = begin - first[number]
            piece = body.poses[max(start, 0) : max(start + PIECE_STEPS, 0)]
            poses[max(-start, 0) :, number][: len(piece)] = piece
        there = np.flatnonzero(np.isfinite(poses[..., 0]).any(axis=0))
        places_m = poses[:, there, :2]
        low_m = np.fmin.reduce(places_m) - reach_m[there]
        high_m = np.fmax.reduce(places_m) + reach_m[there]
        boxes = shapely.box(*low_m.T, *high_m.T)
        one, other = there[shapely.STRtree(boxes).query(boxes)]
        one, other = one[one < other], other[one < other]
        met = _overlap(poses[:, one], size_m[one], poses[:, other], size_m[other]).any(axis=0)
        meets[one[met], other[met]] = meets[other[met], one[met]] = True
    number_met = meets.sum(axis=1)
    number_met[0] = -1
    stays = np.ones(len(bodies), dtype=bool)
    for number in np.argsort(number_met, kind="stable").tolist():
        if stays[number]:
            stays[meets[number]] = False
    return [body for body, kept in zip(bodies, stays.tolist(), strict=True) if kept]


def _overlap(one: Numbers, size_m: Numbers, other: Numbers, other_size_m: Numbers) -> NDArray[np.bool_]:
    """(T, K) whether K pairs of rectangles with poses (T, K, 3) do, as no axis of either separates them."""
    between_m, turn = other[..., :2] - one[..., :2], other[..., 2] - one[..., 2]
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    meet = np.isfinite(turn)
    for yaw, own, its in ((one[..., 2], size_m, other_size_m), (other[..., 2], other_size_m, size_m)):
        forward_m = between_m[..., 0] * np.cos(yaw) + between_m[..., 1] * np.sin(yaw)
        left_m = between_m[..., 1] * np.cos(yaw) - between_m[..., 0] * np.sin(yaw)
        meet &= 2 * np.abs(forward_m) < own[:, 0] + its[:, 0] * cos + its[:, 1] * sin
        meet &= 2 * np.abs(left_m) < own[:, 1] + its[:, 0] * sin + its[:, 1] * cos
    return meet


def tractrix(lead_m: Numbers, length_m: Numbers, yaw: Numbers) -> Numbers:
    """Headings of rods that are drawn along at their front end, exactly for ways of straight pieces.

    Args:
        lead_m: (T, N, 2) where the front ends go.
        length_m: (N,) of the rods; their rear ends never slip sideways.
        yaw: (N,) headings at first, in radians.

    Returns:
        (T, N) headings, without leaps: with the angle a between rod and way, tan(a / 2) falls by exp(-way / length).
    """
    ways_m = np.diff(lead_m, axis=0)
    towards = np.arctan2(ways_m[..., 1], ways_m[..., 0])
    falls = np.exp(-_lengths(ways_m) / length_m)
    found = np.empty(lead_m.shape[:2])
    found[0] = yaw
    for k, (toward, fall) in enumerate(zip(towards, falls, strict=True)):
        half = np.tan((toward - found[k]) / 2)
        found[k + 1] = found[k] + 2 * (np.arctan(half) - np.arctan(half * fall))
    return found


def _push_m(obstacles: NDArray[np.object_], poses: Numbers, size_m: Numbers) -> Numbers:
    """(K,) how far K rectangles have to go to their left to be off obstacles, or to their right if that is negative.

    Args:
        obstacles: Polygons in plan.
        poses: (K, 3) x and y of their middles, and their headings in radians.
        size_m: (K, 2) their lengths and widths.
    """
    outlines = shapely.polygons(corners_m(poses, size_m))
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
    pushed = np.zeros(len(poses))
    for worst in (np.minimum, np.maximum):
        of_side = np.zeros(len(poses))
        worst.at(of_side, body, need_m)
        pushed += of_side
    return pushed


def corners_m(poses: Numbers, size_m: Numbers) -> Numbers:
    """(K, 4, 2) corners of K rectangles with poses x, y and a heading in radians, and a length and width."""
    forward = np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
    left = np.stack([-forward[:, 1], forward[:, 0]], axis=1)
    half = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]) / 2
    along_m, aside_m = (half[:, k] * size_m[:, k, None] for k in (0, 1))
    found: Numbers = poses[:, None, :2] + along_m[..., None] * forward[:, None] + aside_m[..., None] * left[:, None]
    return found


def _lengths(vectors: Numbers) -> Numbers:
    """(...) lengths in plan of (..., 2) vectors, or of what else begins with x and y."""
    lengths: Numbers = np.hypot(vectors[..., 0], vectors[..., 1])
    return lengths


def _along_m(ways_m: Numbers) -> Numbers:
    """(T, N) the lengths of (T, N, 2) ways up to each place."""
    steps_m = _lengths(np.diff(ways_m, axis=0))
    return np.concatenate([np.zeros((1, ways_m.shape[1])), steps_m.cumsum(axis=0)])


def _held(ways: Numbers) -> Numbers:
    """(T, N, 2) unit vectors; who stands keeps the last, or has the first to come."""
    size = _lengths(ways)
    at = np.where(size > STANDS_M, np.arange(len(ways))[:, None], 0)
    at = np.maximum.accumulate(at, axis=0)
    first = (size > STANDS_M).argmax(axis=0)
    at = np.maximum(at, first)
    found = np.take_along_axis(ways, at[..., None], axis=0)
    return found / np.maximum(_lengths(found), STANDS_M)[..., None]


def _straight_on(times_s: Numbers, told_s: Numbers, told_m: Numbers) -> Numbers:
    """(T, 2) places at times; before the first and after the last it goes on as it did."""
    if len(told_s) > 1:
        step_s = times_s[-1] - times_s[0] + told_s[-1] - told_s[0]
        before, after = ((told_m[one] - told_m[two]) / (told_s[one] - told_s[two]) for one, two in ((1, 0), (-1, -2)))
        told_s = np.concatenate([[told_s[0] - step_s], told_s, [told_s[-1] + step_s]])
        told_m = np.concatenate([[told_m[0] - step_s * before], told_m, [told_m[-1] + step_s * after]])
    return np.stack([np.interp(times_s, told_s, axis) for axis in told_m.T], axis=1)


def _without_jumps(track: SumoTrack) -> Numbers:
    """(K, 2) places of somebody on foot; what was jumped is walked before and after, a little faster."""
    times_s, places_m = track.times_s, track.places_m[:, :2]
    steps_m = np.diff(places_m, axis=0)
    lengths_m = _lengths(steps_m)
    walked_m = places_m.copy()
    for at in np.flatnonzero(lengths_m > FASTEST_ON_FOOT_MPS * np.diff(times_s)).tolist():
        takes_s = min(lengths_m[at] / CATCH_UP_MPS, times_s[-1] - times_s[0])
        begin_s = (times_s[at : at + 2].mean() - takes_s / 2).clip(times_s[0], times_s[-1] - takes_s)
        share = ((times_s - begin_s) / takes_s).clip(0.0, 1.0) - (np.arange(len(times_s)) > at)
        walked_m += share[:, None] * steps_m[at]
    return walked_m
