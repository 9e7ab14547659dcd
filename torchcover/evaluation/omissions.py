"""What a run left out because its scene did not need it."""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torchcover.coverage import AGGREGATIONS, Aggregation, Coverage
from torchcover.simulation import CameraSensor, Sensor

# What it is, how often it was left out, and of how many; the counts are those of the frames, added up.
COUNTED = (
    ("moving bodies out of every sensor's range: not placed", "moving_bodies_out_of_range", "moving_bodies"),
    ("pairs of a ray and a moving body that cannot meet: not cast", "ray_body_pairs_left_out", "ray_body_pairs"),
    ("rays of sensors where nothing moves: cast once, for all steps", "sensor_rays_reused", "sensor_rays"),
    ("rays that end on the ego itself: known from the first scan", "sensor_self_hits_reused", "sensor_self_hits"),
)
# Packages that take long to import, and what would have needed them; not all lenses with distortion need kornia, but
# where there is one, nobody is to think that its distortion was left out.
HEAVY = {"kornia": "lenses with distortion", "lightning": "training", "lzf": "compressed PCD files"}


@dataclass(frozen=True)
class Omission:
    """Something that a run left out.

    Args:
        what: What it is, and why it could be left out.
        count: How often; None where there is nothing to count.
        of: Of how many; likewise.
    """

    what: str
    count: int | None = None
    of: int | None = None


def left_out(
    frame_counts: Mapping[str, int],
    coverages: Sequence[Coverage],
    aggregations: Sequence[Aggregation] = (),
    sensors: Sequence[Sensor] = (),
    *,
    workers: int = 0,
) -> list[Omission]:
    """List what was left out of a run, at its end: later, other modules may have been imported for other reasons.

    Args:
        frame_counts: Sums of `Frame.counts`.
        coverages: What the metrics gave, one for each rig.
        aggregations: Those that were asked for.
        sensors: Those that are known of all rigs.
        workers: Processes that made the frames. What they have imported nobody knows.
    """
    found = [
        Omission(what, frame_counts[count], frame_counts[of]) for what, count, of in COUNTED if frame_counts.get(count)
    ]
    outside = sum(coverage.counts["outside_points"] for coverage in coverages)
    inside = sum(coverage.counts["inside_points"] for coverage in coverages)
    if outside:
        found.append(Omission("reference points outside every cell: not searched for", outside, inside + outside))
    asked_for = {aggregation.name for aggregation in aggregations}
    others = [aggregation.words for aggregation in AGGREGATIONS if aggregation.name not in asked_for]
    if others:
        found.append(Omission(f"{', '.join(others)}: not asked for, not kept"))
    used = set(HEAVY) if workers else set(sys.modules)
    if any(isinstance(sensor, CameraSensor) and sensor.lens != "pinhole" for sensor in sensors):
        used.add("kornia")
    unused = [package for package in HEAVY if package not in used]
    return found + [Omission(f"{package}, for {HEAVY[package]}: not imported") for package in unused]
