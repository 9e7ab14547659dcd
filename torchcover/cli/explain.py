"""What a run left out because its scene did not need it: for `--explain` and `summary.json`."""

import sys
from collections.abc import Mapping, Sequence

from rich.table import Table
from rich.text import Text

from torchcover.coverage import AGGREGATIONS, Coverage

# What it is, how often it was left out, and of how many; the counts are those of the frames, added up.
COUNTED = (
    ("moving bodies out of every sensor's range: not placed", "moving_bodies_out_of_range", "moving_bodies"),
    ("pairs of a ray and a moving body that cannot meet: not cast", "ray_body_pairs_left_out", "ray_body_pairs"),
    ("rays of sensors where nothing moves: cast once, for all steps", "sensor_rays_reused", "sensor_rays"),
    ("rays that end on the ego itself: known from the first scan", "sensor_self_hits_reused", "sensor_self_hits"),
)
# Packages that take long to import, and what would have needed them.
HEAVY = {"kornia": "lenses with distortion", "lightning": "training", "pypcd4": "binary PCD files"}

Omission = dict[str, object]


def left_out(frame_counts: Mapping[str, int], coverages: Sequence[Coverage]) -> list[Omission]:
    """List what was left out of a run.

    Args:
        frame_counts: Sums of `Frame.counts`.
        coverages: What the metrics gave, one for each rig.

    Returns:
        Records with `what`, `count` and `of`; the two are None where there is nothing to count.
    """
    records: list[Omission] = [
        {"what": what, "count": frame_counts[count], "of": frame_counts[of]}
        for what, count, of in COUNTED
        if frame_counts.get(count)
    ]
    outside = sum(coverage.counts["outside_points"] for coverage in coverages)
    inside = sum(int(coverage.points.sum()) for coverage in coverages)
    if outside:
        what = "reference points outside every cell: not searched for"
        records.append({"what": what, "count": outside, "of": inside + outside})
    if len(coverages[0].layers) == len(coverages[0].quantities):
        others = ", ".join(aggregation.words for aggregation in AGGREGATIONS)
        records.append({"what": f"{others}: not asked for, not kept", "count": None, "of": None})
    records += [
        {"what": f"{package}, for {use}: not imported", "count": None, "of": None}
        for package, use in HEAVY.items()
        if package not in sys.modules
    ]
    return records


def explanation(records: Sequence[Omission]) -> Table:
    """The records as a table for the terminal."""
    table = Table(title="Left out, for this run did not need it", title_justify="left")
    table.add_column("what")
    for column in ("count", "of", "share"):
        table.add_column(column, justify="right")
    for record in records:
        count, of = record["count"], record["of"]
        counted = isinstance(count, int) and isinstance(of, int)
        numbers = (f"{count:,}", f"{of:,}", f"{count / of:.1%}") if counted else ("", "", "")  # type: ignore[operator]
        table.add_row(Text(str(record["what"])), *numbers)
    return table
