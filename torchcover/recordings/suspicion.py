"""What looks wrong about a recording before it is measured: mistakes that would otherwise give an ordinary table."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from torchcover.detection import Boxes, points_in_boxes
from torchcover.files import RECORDING
from torchcover.geometry import BoundingBox, invert
from torchcover.neighbors import nearest
from torchcover.recordings.accumulated_reference import USUAL_BODY, AccumulatedReference
from torchcover.recordings.agreement import clocks_apart, disagreement, jumped
from torchcover.recordings.ground_model import GroundModel, low_surfaces
from torchcover.recordings.in_vehicle import in_vehicle, within
from torchcover.recordings.recorded_reference import RecordedReference, Reference
from torchcover.recordings.recording import Recording, whole_recording

# What is looked at, evenly spread over what will be measured.
FRAMES, POSES = 5, 64
# As far around the vehicle as the ground beneath it is looked for.
GROUND_WITHIN_M = 30.0
# Half of the lowest band: beyond, the ground is in another one, or in none.
GROUND_OFF_M = 0.5
# Clouds of fewer points may be alike; so near, a point is the other one.
ALIKE_POINTS, ALIKE_QUERIES, ALIKE_M = 100, 1000, 1e-3
# Objects this near are seen; what lies lower in their boxes may be the ground.
BOXES_WITHIN_M, BOX_FOOT_M = 40.0, 0.3
# A box is fuller one way if it has so many points, and so many times as many as the other way. So many boxes decide, if
# they are so many times as many as the others, and a share of all.
BOX_POINTS, FULLER, BOXES, MORE, MOST_BOXES = 5, 5, 5, 4, 0.6
# Steps that say where the vehicle goes; in a bend it points elsewhere by far less than this.
STEP_M, WAY_M, SIDEWAYS_DEG, MOST_OF_WAY = (0.05, 20.0), 5.0, (45.0, 135.0), 0.8
FASTEST_MPS = 100.0
# Half of the points of a LiDAR are nearer, in metres; and in centimetres.
FARTHEST_USUAL_M, FARTHEST_USUAL_CM = 300.0, 4000.0
# Who moves less within a window stands.
MOVES_M = 1.0
# Drops are alone: the third of others is farther than this, and such a share of the range. So many times as many are of
# those near and above ground as of those on it, and more than such a share.
AIR_M, AIR_POINTS, NEIGHBOURS, ALONE_M, ALONE, TIMES_ALONE, MOST_ALONE = 15.0, 500, 4, 0.2, 0.03, 3.0, 0.04
# So high above the ground, so many points are the vehicle's own.
OWN_ABOVE_M, OWN_POINTS = 0.3, 20


@dataclass(frozen=True)
class RecordedInstant:
    """One instant: name of each sensor -> (N, 3) float32 its points in the vehicle frame; the boxes."""

    clouds: dict[str, NDArray[np.float32]]
    boxes: Boxes | None


def suspicions(recording: Recording, reference: Reference, rigs: Mapping[str, Sequence[str]], many: int) -> list[str]:
    """What looks wrong about a recording, a sentence each with what to do; it looks at a few frames only.

    A frame that cannot be read is not looked at: whoever measures it will say so.

    Args:
        recording: The recording.
        reference: Where its reference clouds come from.
        rigs: Name of each rig -> its sensors.
        many: How many of its frames will be measured, from the first on.
    """
    judged = dict.fromkeys(sensor for of in rigs.values() for sensor in of)
    if many and (doubt := wrong_units(recording, next(iter(judged)))) is not None:
        return [f"{recording.path}: {doubt}"]
    recorded = recording.reference_sensors if isinstance(reference, RecordedReference) else ()
    sensors = tuple(dict.fromkeys((*judged, *recorded)))
    looks = [
        look
        for position in _spread(many, FRAMES)
        if (look := _look(recording, sensors, recording.frames[position])) is not None
    ]
    widest = max(judged, key=lambda sensor: sum(len(look.clouds[sensor]) for look in looks))
    disagreeing = disagreement(recording, widest, many)
    clouds = {sensor: [look.clouds[sensor] for look in looks] for sensor in sensors}
    elsewhere = ground_is_elsewhere(clouds)
    known = elsewhere is not None or recording.body is not None
    doubts = [
        elsewhere,
        None if known else own_returns([_joined(look, sensors) for look in looks]),
        *(mirrored(sensor, [(look.clouds[sensor], look.boxes) for look in looks]) for sensor in sensors),
        *(
            same_clouds(rig, [(_joined(look, of), _joined(look, recorded)) for look in looks])
            for rig, of in rigs.items()
        ),
        *(wrong_motion(recording) if disagreeing is None else [disagreeing]),
        jumped(recording, many) if disagreeing is None else None,
        *clocks_apart(recording, tuple(judged), many),
        silent(clouds),
        in_the_air(clouds),
        nothing_labelled(recording, many),
        unmarked(recording),
        *(
            (few_in_window(recording, reference), standing(recording, reference, judged, many))
            if isinstance(reference, AccumulatedReference)
            else ()
        ),
    ]
    return [f"{recording.path}: {doubt}" for doubt in doubts if doubt is not None]


def wrong_units(recording: Recording, sensor: str) -> str | None:
    """Whether coordinates are too large for metres."""
    try:
        range_m = np.linalg.norm(recording.scan(sensor, recording.frames[0]).points_m, axis=1)
    except (OSError, ValueError, IndexError):
        return None
    usual_m = float(np.median(np.append(range_m[np.isfinite(range_m)], 0.0)))
    if usual_m < FARTHEST_USUAL_M:
        return None
    unit = "mm" if usual_m > FARTHEST_USUAL_CM else "cm"
    return f"half of the points of {sensor} are beyond {usual_m:,.0f} m: is it {unit}? (--set recording.units={unit})"


def nothing_labelled(recording: Recording, many: int) -> str | None:
    """Whether a recording with labels has none in any frame; of one that says that it is whole, that is so."""
    try:
        labelled = [recording.boxes(recording.frames[position]) for position in _spread(many, POSES)]
    except (OSError, ValueError):
        return None
    if not labelled or any(boxes is None or len(boxes) for boxes in labelled) or _is_whole(recording):
        return None
    return f"it has labels, and none in {len(labelled)} frames: do their names and times fit those of its clouds?"


def unmarked(recording: Recording) -> str | None:
    """Whether it is one of torchcover's, whose frames have instants, that does not say that it is whole."""
    if recording.instants is None or _is_whole(recording):
        return None
    return f"torchcover wrote it, and it has no {RECORDING}: is it whole, with its {len(recording.names):,} frames?"


def _is_whole(recording: Recording) -> bool:
    return recording.path.is_dir() and whole_recording(recording.path) is not None


def ground_is_elsewhere(clouds: Mapping[str, Sequence[NDArray[np.float32]]]) -> str | None:
    """Whether the ground that sensors see is not at z = 0."""
    off = []
    for sensor, of in clouds.items():
        heights_m = [height_m for cloud in of if (height_m := ground_height_m(cloud)) is not None]
        height_m = float(np.median(heights_m)) if heights_m else 0.0
        if abs(height_m) > GROUND_OFF_M:
            off.append(f"{height_m:+.1f} m ({sensor})")
    if not off:
        return None
    return (
        f"the ground lies at z = {', '.join(off)}, not near 0: give the pose of the sensor in the vehicle frame, whose "
        "origin is on the ground (vehicle_T_sensor)"
    )


def ground_height_m(points_m: NDArray[np.floating]) -> float | None:
    """The height of the ground beneath the vehicle; None where none is seen near it."""
    near_m = points_m[(np.abs(points_m) < GROUND_WITHIN_M).all(axis=1)].astype(np.float64)
    origin_m = np.zeros((1, 3))
    ground = GroundModel.below([low_surfaces(near_m, origin_m[0])], origin_m[0])
    above_m = np.nan if ground is None else float(ground.heights_m(origin_m)[0])
    return None if np.isnan(above_m) else -above_m


def same_clouds(rig: str, pairs: Sequence[tuple[NDArray[np.float32], NDArray[np.float32]]]) -> str | None:
    """Whether all points of the reference are points of the rig: then every radius is 0 m."""
    pairs = [(cloud, reference) for cloud, reference in pairs if len(reference) >= ALIKE_POINTS]
    for cloud, reference in pairs:
        # Drawn by chance: every so many points may be those of the same lasers.
        some = reference[np.random.default_rng(0).integers(len(reference), size=ALIKE_QUERIES)]
        found = nearest(torch.from_numpy(some), torch.from_numpy(cloud), max_distance=ALIKE_M)
        if not bool(found.distance.isfinite().all()):
            return None
    if not pairs:
        return None
    return (
        f"the points of the reference are those of the rig {rig} itself, so that it must look perfect: give another "
        "sensor as the reference, or accumulate one (--reference accumulated)"
    )


def mirrored(sensor: str, looks: Iterable[tuple[NDArray[np.float32], Boxes | None]]) -> str | None:
    """Whether boxes hold points only where left and right are exchanged."""
    sightings = fuller = fuller_mirrored = 0
    for points_m, boxes in looks:
        if boxes is None:
            continue
        rows = boxes.rows[torch.linalg.vector_norm(boxes.centre_m[:, :2], dim=1) < BOXES_WITHIN_M].clone()
        rows[:, 2] += BOX_FOOT_M / 2
        rows[:, 5] -= BOX_FOOT_M
        wanted = Boxes.from_rows(rows[rows[:, 5] > 0])
        sightings += len(wanted)
        points = _points_in_each(points_m, wanted)
        points_mirrored = _points_in_each(points_m * np.array([1, -1, 1], np.float32), wanted)
        fuller += int((points >= (FULLER * points_mirrored).clamp(min=BOX_POINTS)).sum())
        fuller_mirrored += int((points_mirrored >= (FULLER * points).clamp(min=BOX_POINTS)).sum())
    if fuller_mirrored < max(BOXES, MORE * fuller, MOST_BOXES * sightings):
        return None
    return (
        f"{fuller_mirrored} of {sightings} labelled boxes have points of {sensor} only if its left and right are "
        f"exchanged, and {fuller} the way it is: turn its y axis round (flip_y), as for a left-handed simulator"
    )


def own_returns(clouds: Sequence[NDArray[np.float32]]) -> str | None:
    """Whether there are returns at each instant where a vehicle of usual size stands: they are its own."""
    above = BoundingBox((*USUAL_BODY.lower_m[:2], OWN_ABOVE_M), USUAL_BODY.upper_m)
    counts = [len(within(cloud, above)) for cloud in clouds]
    if min(counts, default=0) < OWN_POINTS:
        return None
    return (
        f"{int(np.median(counts)):,} points an instant lie where the vehicle itself stands, and trail through the "
        "reference if they are its own: say how large it is (--vehicle NAME, or x0,x1,y0,y1,z0,z1)"
    )


def wrong_motion(recording: Recording) -> list[str]:
    """Whether the vehicle drives sideways, or faster than any does."""
    places = _spread(max(len(recording.names) - 1, 0), POSES)
    try:
        pairs = [(recording.world_T_vehicle(place), recording.world_T_vehicle(place + 1)) for place in places]
    except (OSError, ValueError):
        return []
    way_m = np.array([(invert(one) @ two)[:2, 3] for one, two in pairs if one is not None and two is not None])
    if len(way_m) < len(pairs) or not pairs:
        return []
    found, length_m = [], np.linalg.norm(way_m, axis=1)
    if recording.times_s is not None:
        speed_mps = float(np.median(length_m / np.diff(recording.times_s)[places]))
        if speed_mps > FASTEST_MPS:
            found.append(
                f"by its poses and times the vehicle drives at {speed_mps:,.0f} m/s: give both from the same clock, in "
                "seconds, and places in metres"
            )
    steps = (length_m > STEP_M[0]) & (length_m < STEP_M[1])
    aside_deg = np.rad2deg(np.arctan2(way_m[:, 1], way_m[:, 0]))
    aside = steps & (np.abs(aside_deg) > SIDEWAYS_DEG[0]) & (np.abs(aside_deg) < SIDEWAYS_DEG[1])
    if length_m[steps].sum() >= WAY_M and length_m[aside].sum() > MOST_OF_WAY * length_m[steps].sum():
        found.append(
            f"by its poses the vehicle drives sideways, {np.median(aside_deg[aside]):+.0f} degrees from its x axis: "
            "x has to point forward, y to the left"
        )
    return found


def few_in_window(recording: Recording, reference: AccumulatedReference) -> str | None:
    """Whether the time over which a reference is accumulated holds one instant only, or the drive is far shorter."""
    times_s, window_s = recording.times_s, reference.window_s
    if times_s is None or not len(times_s) or not window_s:
        return None
    lasts_s, apart_s = float(times_s[-1] - times_s[0]), float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0
    if apart_s > window_s / 2:
        return (
            f"its instants are {apart_s:g} s apart, and a window of {window_s:g} s reaches none but its own: are "
            "the times in seconds? Else ask for a longer window (--set recording.window_s=SECONDS)"
        )
    if lasts_s >= window_s / 2:
        return None
    return (
        f"it lasts {lasts_s:.3g} s, {len(times_s)} instants, and its reference is to be of {window_s:g} s: so short a "
        "time shows little but what is seen at the instant, and numbers are far too good: give a longer drive"
    )


def silent(clouds: Mapping[str, Sequence[NDArray[np.float32]]]) -> str | None:
    """Whether sensors have nothing at some instants."""
    empty = {sensor: sum(not len(cloud) for cloud in of) for sensor, of in clouds.items()}
    if not any(empty.values()):
        return None
    told = ", ".join(
        f"{sensor} has no point in {count} of {len(clouds[sensor])}" for sensor, count in empty.items() if count
    )
    return (
        f"{told} frames that were looked at: it counts as blind there; if it was off, measure where it was on, or "
        "leave it out (--sensors)"
    )


def in_the_air(clouds: Mapping[str, Sequence[NDArray[np.float32]]]) -> str | None:
    """Whether many near points hang alone in the air, as drops do."""
    shares = {sensor: share for sensor, of in clouds.items() if (share := share_alone(of)) > MOST_ALONE}
    if not shares:
        return None
    told = ", ".join(f"{share:.0%} ({sensor})" for sensor, share in shares.items())
    return (
        f"of the points above ground within {AIR_M:g} m {told} have no others near them: rain, snow or dust? They "
        "count as surface, hide what is behind them, and make a rig look better: leave them out"
    )


def share_alone(clouds: Sequence[NDArray[np.float32]]) -> float:
    """How many of the near points above ground are alone; 0 where those on the ground are, too: it is sparse."""
    from pykdtree.kdtree import KDTree

    near_m = [cloud[np.linalg.norm(cloud, axis=1) < AIR_M] for cloud in clouds]
    near_m = [near for near in near_m if len(near) >= AIR_POINTS]
    if not near_m:
        return 0.0
    alone = [
        KDTree(of).query(of, k=NEIGHBOURS)[0][:, -1] > ALONE_M + ALONE * np.linalg.norm(of, axis=1) for of in near_m
    ]
    above, which = np.concatenate(near_m)[:, 2] > GROUND_OFF_M, np.concatenate(alone)
    share, on_ground = (float(which[of].mean()) if of.any() else 0.0 for of in (above, ~above))
    return share if share > TIMES_ALONE * on_ground else 0.0


def standing(recording: Recording, reference: AccumulatedReference, judged: Iterable[str], many: int) -> str | None:
    """Whether a judged sensor is its own reference in windows in which it hardly moves."""
    taking_part, times_s = recording.sensors if reference.sensors is None else reference.sensors, recording.times_s
    if times_s is None or not set(taking_part) & set(judged):
        return None
    ways_m = []
    for position in _spread(many, FRAMES):
        instants = reference.sweeps.instants(recording, recording.frames[position])
        poses = [pose for instant in instants if (pose := recording.world_T_vehicle(instant)) is not None]
        if np.ptp(times_s[instants]) >= reference.window_s / 2 > 0:
            ways_m.append(float(np.linalg.norm(np.ptp([pose[:3, 3] for pose in poses], axis=0))))
    still = sum(way_m < MOVES_M for way_m in ways_m)
    if not ways_m or still < len(ways_m) / 2:
        return None
    return (
        f"the vehicle stands in {still} of {len(ways_m)} windows, where its own scans show little but what they see at "
        "the instant, and numbers are far too good: measure where it drives, or against a sensor that is not judged"
    )


def _look(recording: Recording, sensors: Sequence[str], instant: int) -> RecordedInstant | None:
    try:
        clouds = {sensor: in_vehicle(recording.scan(sensor, instant), recording.body).points_m for sensor in sensors}
        return RecordedInstant(clouds, recording.boxes(instant))
    except (OSError, ValueError):
        return None


def _joined(look: RecordedInstant, sensors: Sequence[str]) -> NDArray[np.float32]:
    return np.concatenate([np.empty((0, 3), np.float32), *(look.clouds[sensor] for sensor in sensors)])


def _points_in_each(points_m: NDArray[np.float32], boxes: Boxes) -> torch.Tensor:
    return torch.bincount(points_in_boxes(torch.from_numpy(points_m), boxes).box, minlength=len(boxes))


def _spread(count: int, most: int) -> list[int]:
    """At most so many numbers below `count`, from the first to the last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist() if count else []
