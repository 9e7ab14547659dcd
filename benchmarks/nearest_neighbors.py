"""Packets beside pykdtree, scipy, Open3D and nanoflann, Warp beside CuPy on a GPU: trees built every time.

What `auto` takes is held against the better of packets and KD-tree.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch
from pykdtree.kdtree import KDTree
from scipy.spatial import cKDTree

from benchmarks import compare, table
from torchcover import nearest
from torchcover.data import SimulatedFrames
from torchcover.neighbors.backend_choice import choose_search
from torchcover.simulation import PaperReference

RIGS = ("front_roof_128", "nuscenes", "edgar", "kitti_cameras")
SIZES = (10**3, 10**4, 10**5, 10**6, 10**7)
MOST_QUERIES = 100_000
SLOW = 500_000  # queries and points together: only pykdtree is compared, and fewer times
# What a call pays of loading numba, if there are a hundred: `auto` counts it, and so does its ratio.
SHARE_OF_LOADING_S = 5e-3
RESULT = Path("out/benchmarks/search.json")


def main():
    """Print the table from a process in which every library has one thread; the figures go to `RESULT`, too."""
    command = [sys.executable, "-m", "benchmarks.nearest_neighbors", "measure"]
    subprocess.run(command, env=os.environ | {"OMP_NUM_THREADS": "1"}, check=True)


def measure():
    """Ratios of processor time; where there is a GPU, of wall time on it."""
    torch.set_num_threads(1)
    searches = {"packets": packets, "KD-tree": kdtree, "pykdtree": pykdtree, "scipy": scipy} | optional()
    result = {"torch": torch.__version__, "threads": 1}
    result["figures"] = compared(searches, ("packets", "KD-tree", "pykdtree"), time.process_time)
    if torch.cuda.is_available():
        print(f"\nOn {torch.cuda.get_device_name()}, seconds of wall time:\n")
        searches = on_cuda()
        result["on_cuda"] = compared(searches, searches, time.perf_counter)
    RESULT.parent.mkdir(parents=True, exist_ok=True)
    RESULT.write_text(json.dumps(result, indent=1))
    print(f"\nAll figures: {RESULT}")


def compared(searches, of_large, clock):
    """Print the seconds of the first search and ratios of the others to it; of large clouds those `of_large` alone."""
    ours, *others = searches
    figures = []

    def rows():
        for name, query, points in cases():
            few = len(query) + len(points) < SLOW
            names = [search for search in searches if few or search in of_large]
            timed = [lambda search=searches[each], q=query, p=points: search(q, p) for each in names]
            seconds, ratios = compare(*timed, rounds=3 if few else 1, clock=clock)
            times, ratio = (dict(zip(names, numbers, strict=True)) for numbers in (seconds, ratios))
            figures.append({"case": name, "queries": len(query), "points": len(points), "seconds": times})
            counts = f"{len(query):,}", f"{len(points):,}"
            yield (
                name,
                *counts,
                times[ours],
                *(ratio.get(other, "") for other in others),
                *of_auto(query, points, times),
            )

    header = "clouds", "queries", "points", f"{ours} (s)", *(f"{other} / {ours}" for other in others)
    table((*header, "`auto` takes", "better / auto"), rows())
    return figures


def of_auto(query, points, seconds):
    """What `auto` takes, and the better of packets and KD-tree over it; the time of packets with their share."""
    search = choose_search(torch.from_numpy(query), torch.from_numpy(points), "auto")
    taken = {"packets": "packets", "kdtree": "KD-tree"}.get(search.__module__.rpartition(".")[2])
    if taken not in seconds:
        return "", ""
    cost = {"packets": seconds["packets"] + SHARE_OF_LOADING_S, "KD-tree": seconds["KD-tree"]}
    return taken, min(cost.values()) / cost[taken]


def cases():
    """Name, queries and points: rigs in `urban` under three references, random clouds, degenerate ones."""
    references = {
        "default": None,
        "paper's, 256 x 256": PaperReference(rows=256, columns=256),
        "paper's, 1024 x 1024": PaperReference(),
    }
    for name, sensor in references.items():
        frame = SimulatedFrames(
            "urban", rigs={rig: rig for rig in RIGS}, num_frames=1, reference_sensor=sensor, vehicle="suv"
        )[0]
        for rig in RIGS:
            yield f"{rig}, {name}", frame.reference.numpy(), frame.get_cloud(rig).numpy()
    random = np.random.default_rng(0)
    for size in SIZES:
        query, points = (random.uniform(-50, 50, (n, 3)).astype(np.float32) for n in (min(size, MOST_QUERIES), size))
        yield "random", query, points
    for count in (10**4, 10**5):
        query, points = random.uniform(-80, 80, (2, count, 1)).astype(np.float32) * np.float32([0.8, 0.599, 0.03])
        yield "on a line", query, points
        yield "in a plane", *(random.uniform(-50, 50, (2, count, 3)).astype(np.float32) * np.float32([1, 1, 0]))
        query = random.uniform(-50, 50, (count, 3)).astype(np.float32)
        yield "far apart", query, random.permutation(query) + np.float32([1e4, 0, 0])
        points = random.uniform(-50, 50, (10 * count, 3)).astype(np.float32)
        yield "around a line", query, points * np.float32([1, 0, 0])
        yield "around a plane", query, points * np.float32([1, 1, 0])


def packets(query, points):
    return nearest(torch.from_numpy(query), torch.from_numpy(points), backend="packets")


def kdtree(query, points):
    return nearest(torch.from_numpy(query), torch.from_numpy(points), backend="kdtree")


def pykdtree(query, points):
    return KDTree(points).query(query)


def scipy(query, points):
    return cKDTree(points).query(query)


def optional():
    """What is compared with where it is installed."""
    found = {}
    try:
        import open3d

        def open3d_search(query, points):
            index = open3d.core.nns.NearestNeighborSearch(open3d.core.Tensor(np.ascontiguousarray(points)))
            index.knn_index()
            return index.knn_search(open3d.core.Tensor(query), 1)

        found["Open3D"] = open3d_search
    except ImportError:
        pass
    try:
        import pynanoflann

        def nanoflann_search(query, points):
            index = pynanoflann.KDTree(n_neighbors=1, metric="L2", leaf_size=16)
            index.fit(np.ascontiguousarray(points))
            return index.kneighbors(query)

        found["nanoflann"] = nanoflann_search
    except ImportError:
        pass
    return found


def on_cuda():
    """Searches of clouds that are brought to the first GPU, CuPy's where it is installed."""

    def warp(query, points):
        nearest(torch.from_numpy(query).cuda(), torch.from_numpy(points).cuda(), backend="warp").index.cpu()

    found = {"warp": warp}
    try:
        import cupy
        from cupyx.scipy.spatial import KDTree as CupyTree

        def cupy_search(query, points):
            CupyTree(cupy.asarray(points)).query(cupy.asarray(query))[1].get()

        found["CuPy"] = cupy_search
    except ImportError:
        pass
    return found


if __name__ == "__main__":
    measure() if sys.argv[1:] == ["measure"] else main()
