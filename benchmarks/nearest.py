"""The search backends beside what they are made of: bare pykdtree, and torch.cdist in one line."""

import torch
from pykdtree.kdtree import KDTree

from benchmarks.clouds import courtyard_clouds
from benchmarks.timing import compare, table
from torchcover import nearest


def main():
    """Print the ratios."""
    query, points = courtyard_clouds(1 << 20, 160_000)
    few = query[:: len(query) // 4096][:4096].contiguous()
    rows = []

    def add(what, *functions, **options):
        seconds, ratios = compare(*functions, **options)
        rows.append((what, seconds[0], seconds[1], ratios[1]))

    add(
        "1,048,576 x 160,000: pykdtree -> nearest(kdtree)",
        lambda: KDTree(points.numpy()).query(query.numpy()),
        lambda: nearest(query, points, backend="kdtree"),
    )
    add(
        "1,048,576 x 160,000: nearest(kdtree) -> max_distance=0.4",
        lambda: nearest(query, points, backend="kdtree"),
        lambda: nearest(query, points, backend="kdtree", max_distance=0.4),
    )
    add(
        "4,096 x 160,000: torch.cdist(q, p).min(1) -> nearest(cdist)",
        lambda: torch.cdist(few, points).min(dim=1),
        lambda: nearest(few, points, backend="cdist"),
        rounds=3,
    )
    table(("queries x points: first -> second", "first (s)", "second (s)", "second / first"), rows)


if __name__ == "__main__":
    main()
