"""Where a KD-tree overtakes brute force on the CPU: what `backend="auto"` is set by."""

from benchmarks.clouds import courtyard_clouds
from benchmarks.timing import compare, table
from torchcover import nearest


def main():
    """Print the ratio over numbers of queries and points."""
    reference, sensor = courtyard_clouds(1 << 17, 160_000)
    rows = []
    for points in (10, 100, 1_000, 10_000, 160_000):
        row = [f"{points:,} points"]
        for queries in (1, 4, 16, 64, 256, 1_024):
            query, cloud = reference[:: len(reference) // queries][:queries], sensor[:: len(sensor) // points][:points]
            _, ratios = compare(
                lambda q=query, p=cloud: nearest(q, p, backend="kdtree"),
                lambda q=query, p=cloud: nearest(q, p, backend="cdist"),
                rounds=9,
            )
            row.append(ratios[1])
        rows.append(row)
    print("Time of cdist over time of kdtree:\n")
    table(("", "1 query", "4", "16", "64", "256", "1,024"), rows)


if __name__ == "__main__":
    main()
