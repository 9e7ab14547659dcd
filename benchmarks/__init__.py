"""Benchmarks: `python -m benchmarks.NAME` prints one table, `python -m benchmarks` regenerates the pages.

Nothing is read from the scene cache of an earlier run. Speeds are ratios of processor times, which other processes
change little; two things are compared only within one run, in turns.
"""

import os
import statistics
import time

os.environ["TORCHCOVER_CACHE_GB"] = "0"


def compare(*functions, rounds=7, clock=time.process_time):
    """Seconds of each function and their ratio to the first, as medians over rounds in which they take turns."""
    times = []
    for _ in range(rounds + 1):
        row = []
        for function in functions:
            start = clock()
            function()
            row.append(clock() - start)
        times.append(row)
    times = times[1:]  # the first round warms up
    seconds = [statistics.median(column) for column in zip(*times, strict=True)]
    ratios = [statistics.median(row[k] / row[0] for row in times) for k in range(len(functions))]
    return seconds, ratios


def table(header, rows):
    """Print a Markdown table."""
    print("| " + " | ".join(header) + " |\n|" + "---|" * len(header))
    for row in rows:
        print("| " + " | ".join(f"{cell:.4g}" if isinstance(cell, float) else str(cell) for cell in row) + " |")
