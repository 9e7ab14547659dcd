"""Reference clouds of a recording: recorded ones, and what all sensors saw within some time."""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from operator import itemgetter
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from torchcover.detection.boxes import Boxes
from torchcover.geometry import BoundingBox, invert, transform_points
from torchcover.recordings.free_space import ScanKey, estimate_surface_areas_m2, estimate_visible_share
from torchcover.recordings.vehicle_cloud import VehicleCloud, find_points_in_box, join_clouds, transform_to_vehicle
from torchcover.recordings.movers import COMPARED_S, WITHIN_M, MovingCluster, find_moving_clusters
from torchcover.recordings.recording import Recording
from torchcover.recordings.sweeps import (
    MOVES_MPS,
    SweepWindow,
    ThinnedScan,
    compute_voxel_indices,
    find_first_occurrences,
    get_vehicle_T_box,
)


class Reference(Protocol):
    """Where the reference clouds of a recording come from."""

    def check(self, recording: Recording, evaluated_sensors: Collection[str], /) -> None:
        """Whether a recording has what is needed.

        Args:
            recording: The recording.
            evaluated_sensors: Names of the sensors that are measured against the reference.

        Raises:
            ValueError: It has not.
        """

    def build_cloud(self, recording: Recording, index: int, evaluated_sensors: Collection[str], /) -> VehicleCloud:
        """The reference cloud of an instant.

        Raises:
            OSError, ValueError: It cannot be read, or has no points.
        """

    def has_area_weights(self, recording: Recording, /) -> bool:
        """Whether its points have weights, the square metres that they stand for."""

    def describe(self, recording: Recording, evaluated_sensors: Collection[str], /) -> Mapping[str, object]:
        """For `summary.json`: `sensor`, settings, and `notes`: what the reader of the numbers has to know."""


class RecordedReference:
    """The clouds of the sensors that were recorded to be the reference."""

    def check(self, recording: Recording, evaluated_sensors: Collection[str]) -> None:
        """Whether there are any."""
        if not recording.reference_sensors:
            raise ValueError(
                f"{recording.path}: no sensor of it was recorded as a reference; accumulate one of all its sensors "
                "(--reference accumulated, AccumulatedReference())"
            )

    def build_cloud(self, recording: Recording, index: int, evaluated_sensors: Collection[str]) -> VehicleCloud:
        """All of them, at that instant."""
        scans = [recording.read_scan(sensor, index) for sensor in recording.reference_sensors]
        found = join_clouds([transform_to_vehicle(scan, recording.ego_box) for scan in scans])
        if not len(found.points_m):
            where = ", ".join(scan.source for scan in scans)
            raise ValueError(f"{where}: the reference cloud has no points, so there is nothing to measure against")
        return found

    def has_area_weights(self, recording: Recording) -> bool:
        """Whether they were recorded with them."""
        return recording.has_area_weights

    def describe(self, recording: Recording, evaluated_sensors: Collection[str]) -> Mapping[str, object]:
        """That it was recorded."""
        sensors = ", ".join(recording.reference_sensors)
        return {"sensor": "recorded", "notes": [f"Reference: recorded by {sensors}."]}


# So many scans have to see past a point.
VOTES = 2
# What stands is seen for at least so long, or half of the time that was looked at; what is no higher is the ground.
STANDS_S, ON_GROUND_M = 1.0, 0.3
SEEN_AGAIN = 0.2
# Farther away, what angles of poses are off by lifts the ground higher.
TILTED = 0.005
# Points that are near each other are beside each other in memory, which is searched in two thirds of the time.
BLOCK_M = 1.6
# Of fewer points, a velocity is a guess.
KNOWN_POINTS = 50
# Where a recording does not say how large its vehicle is.
USUAL_BODY = BoundingBox((-2.4, -0.95, 0.0), (2.4, 0.95, 1.7))

# How far such numbers were off in simulated drives by the window in seconds, with boxes or without: points of detection
# and per cent of the radius (rms over regions and bands; the most of several rigs, rounded up); and points that
# differences of rigs were off. From docs/measured/recordings.md.
OFF = {2.0: {"towns": (11, 52), "highways": (6, 20)}, 5.0: {"towns": (10, 41), "highways": (6, 17)}}
DIFFERENCE_OFF = 4


class _Body(NamedTuple):
    """Points of an object that moves, (M, 3) in the vehicle frame, and how many square metres a place sees at most."""

    points_m: NDArray[np.float64]
    most_m2: float


class AccumulatedReference:
    """What all sensors of a recording saw around an instant, moved to where it is at that instant.

    Scans are moved by the poses of the vehicle, and points in labelled boxes that move, or within 0.1 m of their sides,
    with their boxes. Points of such an object that has no box at the instant are left out. Of the others, those go that
    rays of two scans see past, and those above ground where nothing is seen for long; what moved is put where it is at
    the instant. One point a voxel is kept, if it is seen from beside the vehicle, and counts by square metres.

    A sensor that is judged takes no part at the instant itself, for its points would be 0 m from themselves. At other
    instants it does: what it never sees, this reference does not know either.

    Args:
        window_s: Time between the first scan and the last, half of it before the instant. 0: only the other sensors, at
            that instant.
        voxel_m: Side of a voxel in metres.
        sensors: Names of the sensors that take part; all if not given. Leave out those that are judged for an answer
            that does not depend on them.
        min_motion_m: A vehicle that moves less within a window stands still: a judged sensor that takes part shows
            little more than its scan of the instant, so that such an instant has no reference points, and is counted.
            In a simulated yard, detection on the ground up to 80 m ahead was 49 points too high without motion, 38 with
            1 m, 25 with 2 m, 14 with 4 m and 0 with 10 m.

    Raises:
        ValueError: A negative time, or a side that is not positive.
    """

    def __init__(
        self,
        window_s: float = 2.0,
        *,
        voxel_m: float = 0.1,
        sensors: Collection[str] | None = None,
        min_motion_m: float = 2.0,
    ) -> None:
        if not 0 <= window_s < np.inf:
            raise ValueError(f"window_s: seconds, 0 or more, are needed; got {window_s}")
        if not 0 < voxel_m < np.inf:
            raise ValueError(f"voxel_m: a positive length is needed; got {voxel_m}")
        self.window_s = window_s
        self.voxel_m = voxel_m
        self.sensors = None if sensors is None else tuple(sensors)
        self.min_motion_m = min_motion_m
        self._sweeps = SweepWindow(window_s, voxel_m)

    @property
    def sweep_window(self) -> SweepWindow:
        """What it is made of."""
        return self._sweeps

    def check(self, recording: Recording, evaluated_sensors: Collection[str]) -> None:
        """Whether the recording says when and where its scans were made.

        Raises:
            ValueError: It does not, or has no such sensors, or nothing would be left at any instant.
        """
        unknown = set(self.sensors or ()) - {*recording.sensors, *recording.reference_sensors}
        if unknown:
            raise ValueError(
                f"reference: {recording.path} has no sensor {', '.join(sorted(unknown))}; it has "
                f"{', '.join(recording.sensors)}"
            )
        if self.window_s == 0:
            if not set(self._taking_part(recording)) - set(evaluated_sensors):
                raise ValueError(
                    f"{recording.path}: the reference of an instant (window 0 s) needs a sensor that is not judged; "
                    f"all are ({', '.join(evaluated_sensors)}): choose some with --sensors, or a longer window"
                )
            return
        if recording.times_s is None or recording.get_world_T_vehicle(0) is None:
            missing = "when its scans were made" if recording.times_s is None else "where the vehicle was"
            raise ValueError(
                f"{recording.path}: a reference cannot be accumulated, for the recording does not say {missing}; add "
                "it, or a recorded reference"
            )

    def is_stationary(self, recording: Recording, index: int, evaluated_sensors: Collection[str]) -> bool:
        """Return whether the vehicle stands still in the window of an instant in which a judged sensor takes part."""
        if set(evaluated_sensors).isdisjoint(self._taking_part(recording)):
            return False
        poses = [
            recording.get_world_T_vehicle(instant) for instant in self._sweeps.find_frames_in_window(recording, index)
        ]
        places_m = [pose[:3, 3] for pose in poses if pose is not None]
        return len(places_m) > 1 and float(np.linalg.norm(np.ptp(places_m, axis=0))) < self.min_motion_m

    def build_cloud(self, recording: Recording, index: int, evaluated_sensors: Collection[str]) -> VehicleCloud:
        """The reference cloud of an instant; without points if the vehicle stands still, see `is_stationary`.

        Raises:
            OSError, ValueError: A scan cannot be read, or no point is left.
        """
        if self.is_stationary(recording, index, evaluated_sensors):
            return VehicleCloud(np.empty((0, 3), np.float32), Counter(standing=1), np.empty(0, np.float32))
        sweeps, sensors = self._sweeps, self._taking_part(recording)
        votes = sweeps.count_free_space_votes(recording, sensors, index)
        scans = {
            key: sweeps.get_thinned_scan(recording, *key)
            for key in votes
            if key[1] != index or key[0] not in evaluated_sensors
        }
        within = set(sweeps.find_frames_in_window(recording, index))
        used = {key: scan for key, scan in scans.items() if key[1] in within}
        dropped = Counter[str](sweeps=sum(not scan.excluded_counts["sweeps_skipped"] for scan in used.values()))
        if skipped := sweeps.count_skipped_frames(recording, index):
            dropped["sweeps_skipped"] = len(sensors) * skipped
        for scan in used.values():
            dropped += scan.excluded_counts
            dropped["gone"] += scan.unnamed_object_point_count
        bodies = self._bodies(recording.read_boxes(index), used.values(), dropped)
        local_m = self._standing(recording, index, scans, used, votes, dropped)
        # Noise, and errors of poses, make the ground a thick layer that would count for more and hide what is behind.
        level_m = self._on_ground(recording, index, local_m)
        first = find_first_occurrences(sweeps.compute_voxel_indices(level_m))
        first = first[np.argsort(compute_voxel_indices(level_m[first], BLOCK_M), kind="stable")]
        vehicle_T_local = invert(sweeps.compute_local_T_vehicle(recording, index))
        points_m, level_m = (
            np.concatenate([transform_points(vehicle_T_local, of[first]), *(body.points_m for body in bodies)])
            for of in (local_m, level_m)
        )
        part = np.repeat(np.arange(1 + len(bodies)), [len(first), *(len(body.points_m) for body in bodies)])
        own = _beneath_or_in(points_m, recording.ego_box)
        dropped["ego_vehicle"] += len(own)
        points_m, level_m, part = (np.ascontiguousarray(np.delete(of, own, axis=0)) for of in (points_m, level_m, part))
        share = estimate_visible_share(level_m, recording.ego_box or USUAL_BODY, self.voxel_m, index)
        seen = share > 0
        dropped["hidden"] = int((~seen).sum())
        points_m, level_m, part, share = points_m[seen], level_m[seen], part[seen], share[seen]
        if not len(points_m):
            raise ValueError(
                f"no reference point is left of the scans within {self.window_s / 2:g} s of this instant, of which "
                f"{dropped['sweeps']} were used and {dropped['sweeps_skipped']} not, as where poses jump; "
                "--set skip_bad_frames=true leaves it out"
            )
        m2 = estimate_surface_areas_m2(level_m)
        # Of few points in a box, the eighth neighbour is beside it.
        most_m2 = np.array([np.inf, *(body.most_m2 for body in bodies)])
        m2 *= np.minimum(1.0, most_m2[part] / np.bincount(part, m2)[part])
        return VehicleCloud(points_m.astype(np.float32), dropped, (m2 * share).astype(np.float32))

    def _bodies(self, labelled: Boxes | None, scans: Iterable[ThinnedScan], dropped: Counter[str]) -> list[_Body]:
        """What was seen of the objects that move, with their boxes to where these are at the instant."""
        of_box: dict[str, list[NDArray[np.float64]]] = {}
        for scan in scans:
            for name, points_m in scan.object_points_m.items():
                of_box.setdefault(name, []).append(points_m)
        boxes, found = {name: number for number, name in enumerate(labelled.ids)} if labelled else {}, []
        for name, boxed in of_box.items():
            points_m = np.concatenate(boxed)
            if labelled is None or name not in boxes:
                dropped["gone"] += len(points_m)
                continue
            first = find_first_occurrences(self._sweeps.compute_voxel_indices(points_m))
            placed_m = transform_points(get_vehicle_T_box(labelled, boxes[name]), points_m[first])
            found.append(_Body(placed_m, _sides_m2(*labelled.size_m[boxes[name]].tolist())))
        return found

    def _standing(
        self,
        recording: Recording,
        index: int,
        scans: Mapping[ScanKey, ThinnedScan],
        used: Mapping[ScanKey, ThinnedScan],
        votes: Mapping[ScanKey, NDArray[np.int16]],
        dropped: Counter[str],
    ) -> NDArray[np.float64]:
        """(N, 3) places where something stands, and of what moves where it is at the instant, one a voxel."""
        passing = self._passing(recording, index, scans)
        loose = {key: (votes[key] >= VOTES) | passing[key] for key in scans}
        dropped["rays"] = sum(len(scan.static_points_m) for scan in scans.values() if scan.range_image is not None)
        dropped["seen_past"] = sum(int((votes[key] >= VOTES).sum()) for key in used)
        dropped["passing"] = sum(int((passing[key] & (votes[key] < VOTES)).sum()) for key in used)
        found = self._movers(recording, index, {key: scan.static_points_m[loose[key]] for key, scan in scans.items()})
        dropped["movers"] = sum(
            len(mover.points_m) >= KNOWN_POINTS and bool(np.linalg.norm(mover.velocity_mps) > MOVES_MPS)
            for mover in found
        )
        moved_m = np.concatenate([np.empty((0, 3)), *(mover.points_m for mover in found)])
        local_m = np.concatenate([*(scan.static_points_m[~loose[key]] for key, scan in used.items()), moved_m])
        voxel = np.concatenate(
            [
                *(scan.voxel_indices[~loose[key]] for key, scan in used.items()),
                self._sweeps.compute_voxel_indices(moved_m),
            ]
        )
        # Still those first that were seen nearest in time.
        return np.asarray(local_m[np.sort(find_first_occurrences(voxel))])

    def classify_points(
        self, recording: Recording, index: int
    ) -> dict[ScanKey, tuple[NDArray[np.float64], NDArray[np.int8]]]:
        """Of each scan of the window `Thinned.still_m`, and (N,) 0 if it stands, 1 if it passes, 2 if seen past."""
        votes = self._sweeps.count_free_space_votes(recording, self._taking_part(recording), index)
        scans = {key: self._sweeps.get_thinned_scan(recording, *key) for key in votes}
        passing, within = (
            self._passing(recording, index, scans),
            set(self._sweeps.find_frames_in_window(recording, index)),
        )
        return {
            key: (scan.static_points_m, np.where(votes[key] >= VOTES, 2, passing[key]).astype(np.int8))
            for key, scan in scans.items()
            if key[1] in within
        }

    def _on_ground(self, recording: Recording, index: int, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 3) points, those near the ground put on it."""
        ground = self._sweeps.get_ground_model(recording, index)
        if ground is None:
            return points_m
        heights_m = ground.compute_heights_m(points_m)
        away_m = np.linalg.norm(points_m[:, :2] - self._sweeps.compute_local_T_vehicle(recording, index)[:2, 3], axis=1)
        down_m = np.where(np.abs(heights_m) <= ON_GROUND_M + TILTED * away_m, heights_m, 0.0)
        return np.asarray(points_m - down_m[:, None] * np.array([0.0, 0.0, 1.0]))

    def _passing(
        self, recording: Recording, index: int, scans: Mapping[ScanKey, ThinnedScan]
    ) -> dict[ScanKey, NDArray[np.bool_]]:
        """Of the points of each scan, those above ground where nothing is seen for long."""
        times_s = np.zeros(len(recording.frame_names)) if recording.times_s is None else recording.times_s
        in_time = sorted(scans, key=itemgetter(1))
        lengths = [len(scans[key].occupied_cells[0]) for key in in_time]
        cells = np.concatenate([np.empty(0, np.int64), *(scans[key].occupied_cells[0] for key in in_time)])
        instants, rank = np.unique(np.array([instant for _, instant in in_time], np.int64), return_inverse=True)
        order = np.argsort(cells, kind="stable")
        seen, another = np.repeat(rank, lengths)[order], np.diff(cells[order], prepend=-1) != 0
        start = np.flatnonzero(another)
        length = np.diff(np.append(start, len(seen)))
        end = start + length - 1
        first, last = seen[start], seen[end]
        changes = np.cumsum(another | (np.diff(seen, prepend=0) != 0))
        count = changes[end] - changes[start] + 1
        least_s = min(STANDS_S, np.ptp(times_s[instants]) / 2) if len(instants) else 0.0
        shortly = times_s[instants[last]] - times_s[instants[first]] < least_s - 1e-6
        shortly |= count < SEEN_AGAIN * (last - first + 1)
        short = np.empty(len(cells), np.bool_)
        short[order] = np.repeat(shortly, length)
        ground, found = self._sweeps.get_ground_model(recording, index), {}
        for key, of_scan in zip(in_time, np.split(short, np.cumsum(lengths)), strict=False):
            scan = scans[key]
            passing = of_scan[scan.occupied_cells[1]]
            if ground is not None:
                rows = np.flatnonzero(passing)
                passing[rows] = ~(ground.compute_heights_m(scan.static_points_m[rows]) <= ON_GROUND_M)
            found[key] = passing
        return found

    def _movers(
        self, recording: Recording, index: int, loose_m: Mapping[ScanKey, NDArray[np.float64]]
    ) -> list[MovingCluster]:
        """What moves around the instant."""
        if recording.times_s is None:
            return []
        place_m = self._sweeps.compute_local_T_vehicle(recording, index)[:2, 3]
        near_m, apart_s = [], []
        for (_, instant), points_m in loose_m.items():
            since_s = recording.times_s[instant] - recording.times_s[index]
            if abs(since_s) <= COMPARED_S:
                near_m.append(points_m[np.linalg.norm(points_m[:, :2] - place_m, axis=1) < WITHIN_M])
                apart_s.append(since_s)
        return find_moving_clusters(near_m, np.array(apart_s))

    def has_area_weights(self, recording: Recording) -> bool:
        """Yes: what lies between the nearest points of each."""
        return True

    def describe(self, recording: Recording, evaluated_sensors: Collection[str]) -> Mapping[str, object]:
        """Settings, and what such a reference cannot know."""
        taking_part = self._taking_part(recording)
        among = [sensor for sensor in taking_part if sensor in evaluated_sensors] if self.window_s else []
        measured_s, off = min(OFF.items(), key=lambda measured: abs(measured[0] - self.window_s))
        told = ", ".join(
            f"{points} points of detection and {share} % of radii in {of}" for of, (points, share) in off.items()
        )
        notes = [
            f"Reference: accumulated from {', '.join(taking_part)} over {self.window_s:g} s, one point in "
            f"{self.voxel_m:g} m, cleaned by rays.",
            "What none of them saw in that time is unknown, and in no number.",
            f"In simulated drives, with windows of {measured_s:g} s, boxes or none, such "
            f"numbers were off the truth, beyond their intervals, by (rms) {told}; differences between two rigs by "
            f"{DIFFERENCE_OFF} points.",
        ]
        if among:
            notes.append(
                f"Frames in whose window the vehicle moves less than {self.min_motion_m:g} m have no reference points."
            )
            notes.append(
                f"{', '.join(among)} took part, which cannot show what it never sees: it is blinder than this."
            )
        return {
            "sensor": "accumulated",
            "sensors": list(taking_part),
            "judged_among_them": among,
            "window_s": self.window_s,
            "voxel_m": self.voxel_m,
            "off": {"window_s": measured_s, "points_and_percent": off},
            "notes": notes,
        }

    def _taking_part(self, recording: Recording) -> tuple[str, ...]:
        return tuple(recording.sensors) if self.sensors is None else self.sensors


def _beneath_or_in(points_m: NDArray[np.float64], body: BoundingBox | None) -> NDArray[np.intp]:
    """Numbers of the points where the vehicle stands; no other sensor could see them at that instant."""
    if body is None:
        return np.empty(0, np.intp)
    return find_points_in_box(points_m, BoundingBox((*body.lower_m[:2], -np.inf), body.upper_m))


def _sides_m2(length_m: float, width_m: float, height_m: float) -> float:
    """How much of a box can be seen from a place: two of its sides and its top."""
    return (length_m + width_m) * height_m + length_m * width_m
