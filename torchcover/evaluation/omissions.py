"""Omissions: work that a run did not need to do, because it cannot change the result."""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torchcover.coverage import AGGREGATIONS, Aggregation, Coverage
from torchcover.report import PageTable, build_text_cells
from torchcover.simulation import CameraSensor, Sensor

# Description of each omission -> names of the frame counts that have its number and the total.
COUNTED_OMISSIONS = {
    "moving bodies beyond the range of all sensors: not placed": ("moving_bodies_out_of_range", "moving_bodies"),
    "road users of SUMO or a recording where no body can be: removed": ("road_users_omitted", "moving_bodies"),
    "pairs of a ray and a moving body that cannot intersect: not tested": ("ray_body_pairs_omitted", "ray_body_pairs"),
    "sensor rays in a static scene: cast once for all frames": ("sensor_rays_reused", "sensor_rays"),
    "sensor rays that cannot hit near a reference point: not cast": ("sensor_rays_omitted", "sensor_rays"),
    "self hits, which end on the ego vehicle: reused from the first scan": (
        "sensor_self_hits_reused",
        "sensor_self_hits",
    ),
}
# Packages that take long to import -> their purpose. Some lenses with distortion do not need kornia, but the list must
# not suggest that their distortion was ignored.
SLOW_PACKAGES = {"kornia": "lenses with distortion", "lightning": "training"}


@dataclass(frozen=True)
class Omission:
    """Work that a run did not do.

    Args:
        description: The work, and why it was not needed.
        count: Number of omitted items; None where nothing is counted.
        total: Number of all items; None where nothing is counted.
    """

    description: str
    count: int | None = None
    total: int | None = None


def list_omissions(
    frame_counts: Mapping[str, int],
    coverages: Sequence[Coverage],
    aggregations: Sequence[Aggregation] = (),
    sensors: Sequence[Sensor] = (),
    *,
    num_workers: int = 0,
    num_ranks: int = 1,
) -> list[Omission]:
    """List the omissions of a run; call it at the end of the run, before other code imports more modules.

    Args:
        frame_counts: Sums of `Frame.counts`.
        coverages: Coverage of each rig.
        aggregations: Requested aggregations.
        sensors: Sensors of all rigs, as far as they are known.
        num_workers: Number of processes per rank that made the frames; their imports are unknown.
        num_ranks: Number of ranks that shared the run.

    Returns:
        Omissions with a count first, then aggregations and packages.
    """
    num_frames = max((coverage.counts["num_frames"] for coverage in coverages), default=0)
    is_static = 0 < frame_counts.get("sensor_rays", 0) == frame_counts.get("sensor_rays_reused", 0)
    # In a static scene, each process casts the rays of its first frame.
    first_frames = min(num_frames, num_ranks * max(num_workers, 1)) if is_static else 0
    omissions = []
    for description, (count_name, total_name) in COUNTED_OMISSIONS.items():
        count = frame_counts.get(count_name, 0)
        if first_frames and count_name.endswith("_reused"):
            count = count * (num_frames - first_frames) // num_frames
        if count:
            omissions.append(Omission(description, count, frame_counts[total_name]))
    outside_points = sum(coverage.counts["outside_points"] for coverage in coverages)
    inside_points = sum(coverage.counts["inside_points"] for coverage in coverages)
    if outside_points:
        description = "reference points outside the grid: no search for sensor points"
        omissions.append(Omission(description, outside_points, inside_points + outside_points))
    requested = {aggregation.name for aggregation in aggregations}
    unused = [aggregation.description for aggregation in AGGREGATIONS if aggregation.name not in requested]
    if unused:
        omissions.append(Omission(f"{', '.join(unused)}: not requested, not computed"))
    used_packages = set(SLOW_PACKAGES) if num_workers else set(sys.modules)
    if any(isinstance(sensor, CameraSensor) and sensor.lens != "pinhole" for sensor in sensors):
        used_packages.add("kornia")
    for package, purpose in SLOW_PACKAGES.items():
        if package not in used_packages:
            omissions.append(Omission(f"{package}, for {purpose}: not imported"))
    return omissions


def build_omissions_table(omissions: Sequence[Omission]) -> PageTable:
    """Build the table of omissions.

    Args:
        omissions: Omissions of a run.

    Returns:
        Table with description, count, total and share.
    """
    rows = []
    for omission in omissions:
        texts = (omission.description, "", "", "")
        if omission.count is not None and omission.total is not None:
            share = f"{omission.count / omission.total:.1%}"
            texts = (omission.description, f"{omission.count:,}", f"{omission.total:,}", share)
        rows.append(build_text_cells(*texts))
    return PageTable("Omissions that cannot change the result", ("work", "count", "of", "share"), rows)
