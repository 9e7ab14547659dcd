"""A GPU beside the cores of its machine: the tests that need one, search, sums, rays and whole steps, in wall time."""

import argparse
import statistics
import subprocess
import sys
import time
from functools import partial

import numpy as np
import torch

from benchmarks import table
from torchcover import nearest
from torchcover.data import RegionsOfInterest, SimulatedFrames, create_reference_sensor
from torchcover.evaluation import CoverageObserver, Settings
from torchcover.evaluation.measurement import build_metric
from torchcover.neighbors.warp import wp
from torchcover.simulation import PaperReference
from torchcover.simulation.raycaster import RayCaster

RIG, SCENARIO = "front_roof_128", "urban"
TESTS = ("tests/stability/test_stability.py", "tests/neighbors/test_packets.py", "tests/simulation/test_raycaster.py",
         "tests/simulation/test_simulated.py", "tests/coverage/test_on_a_device.py")  # fmt: skip
OF_A_GPU = "cuda or GPU or gpu"
HOW = ("--numprocesses", "8", "--quiet", "--no-header", "--tb=short", "-p", "no:cacheprovider", "-p", "no:benchmark")
ROUNDS = 5


def main(arguments=()):
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda:0", help="`cpu` tries the benchmark where there is no GPU")
    parser.add_argument("--points", type=int, default=10**6, help="of the largest search")
    parser.add_argument("--num-frames", type=int, default=24, help="that are timed as a whole")
    parser.add_argument("--tests", action="store_true", help="run the tests that need a GPU before")
    options = parser.parse_args(arguments)
    device = torch.device(options.device)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    print(f"{name}, torch {torch.__version__}, Warp {wp.__version__}, {torch.get_num_threads()} threads\n")
    if options.tests:
        command = [sys.executable, "-m", "pytest", *TESTS, "-k", OF_A_GPU, *HOW]
        told = subprocess.run(command, check=False, stdout=subprocess.PIPE, text=True)
        print(f"Tests that need a GPU: {told.stdout.strip().splitlines()[-1].strip('= ')}\n")
        print(told.stdout[-6000:] * bool(told.returncode))
    header = ("clouds", "queries", "points", "CPU, `auto` (ms)", "Warp (ms)", "with transfers (ms)", "CuPy (ms)",
              "other points", "farther by, at most")  # fmt: skip
    table(header, searches(device, options.points))
    print()
    table(("metric update", "CPU (ms)", "device (ms)", "CPU / device"), updates(device))
    print()
    table(("rays at what never moves", "Embree (ms)", "Warp (ms)", "Embree / Warp", "other bodies"), rays(device))
    print()
    table(("a whole step", "CPU (ms)", "device (ms)", "CPU / device", "detections differ by (points)"),
          steps(device, options.num_frames))  # fmt: skip


def wall_ms(function, device):
    """The median of some rounds, after one that warms up; the device has finished."""
    times = []
    for _ in range(ROUNDS + 1):
        begin_s = time.perf_counter()
        function()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        times.append(1e3 * (time.perf_counter() - begin_s))
    return statistics.median(times[1:])


def frames_of(device=None, steps=1, rays=16_384):
    reference = create_reference_sensor(num_rays=rays)
    return SimulatedFrames(
        SCENARIO, RIG, num_frames=steps, frame_interval_s=10.0, reference_sensor=reference, device=device
    )


def searches(device, most):
    """Of a frame, with few and with many points of the reference, and of random clouds."""
    random = np.random.default_rng(0)
    for rays in (16_384, 262_144):
        frame = frames_of(rays=rays)[0]
        yield searched(f"{RIG}, {rays:,} rays of the reference", frame.reference, frame.sensor, device)
    for count in (most // 10, most):
        clouds = (torch.from_numpy(random.uniform(-50, 50, (count, 3)).astype(np.float32)) for _ in range(2))
        yield searched("random", *clouds, device)


def searched(name, query, points, device):
    there = query.to(device), points.to(device)
    by_warp, by_cpu = nearest(*there, backend="warp"), nearest(query, points)
    differ = int((by_warp.index.cpu() != by_cpu.index).sum())
    farther = float((by_warp.distance.cpu().double() / by_cpu.distance.double() - 1).abs().nan_to_num().max())
    cpu_ms = wall_ms(partial(nearest, query, points), torch.device("cpu"))
    warp_ms = wall_ms(partial(nearest, *there, backend="warp"), device)

    def from_and_to_the_cpu():
        nearest(query.to(device), points.to(device), backend="warp").distance.cpu()

    moved_ms = wall_ms(from_and_to_the_cpu, device)
    counts = f"{len(query):,}", f"{len(points):,}"
    return name, *counts, cpu_ms, warp_ms, moved_ms, by_cupy_ms(*there), differ, farther


def by_cupy_ms(query, points):
    """The tree of CuPy, where it is installed."""
    try:
        import cupy
        from cupyx.scipy.spatial import KDTree
    except ImportError:
        return ""
    clouds = [cupy.asarray(cloud.cpu().numpy()) for cloud in (query, points)]
    return wall_ms(lambda: KDTree(clouds[1]).query(clouds[0]), query.device)


def updates(device):
    """Search and sums of one rig, with the usual cells; frames come from the CPU."""
    for rays in (16_384, 262_144):
        frame = frames_of(rays=rays)[0]
        times = []
        for where in (torch.device("cpu"), device):
            times.append(wall_ms(partial(moved_and_added, observer_on(where), frame), where))
        yield f"{rays:,} rays of the reference", *times, times[0] / times[1]


def moved_and_added(observer, frame):
    observer.update(frame.to(observer.metric.device))


def observer_on(device):
    asked = RegionsOfInterest().build_query_plan(cell_m=0.25)
    return CoverageObserver(build_metric(Settings(), asked, has_area_weights=True).to(device), RIG)


def rays(device):
    """From the vehicle's roof, all around, at what never moves: of a scan, and of the paper's reference."""
    scene, _ = frames_of().simulator.get_scene_geometry(0)
    origin_m = scene.scene.ego.trajectory.interpolate(0.0)[:3, 3] + (0.0, 0.0, 1.9)
    casters = [RayCaster(scene.scene.static_meshes, where) for where in (None, str(device))]
    for size in (480, 1024):
        directions = PaperReference(rows=size, columns=size).compute_directions().reshape(3, -1).astype(np.float32)
        limit_m = np.full(directions.shape[1], 200.0, dtype=np.float32)
        hits = [caster.cast(origin_m, directions, limit_m) for caster in casters]
        times = [wall_ms(partial(caster.cast, origin_m, directions, limit_m), device) for caster in casters]
        differ = int((hits[0].body_indices != hits[1].body_indices).sum())
        yield f"{directions.shape[1]:,}", *times, times[0] / times[1], differ


def steps(device, count):
    """Frames, search and sums of a run, without its start; with all threads."""
    for rays in (16_384, 262_144):
        times, found = [], []
        for where in (None, str(device)):
            frames = frames_of(where, count, rays)
            observer = observer_on(where or "cpu")
            for index in range(count):
                frames.simulator.get_scene_geometry(index)
            moved_and_added(observer, frames[0])
            begin_s = time.perf_counter()
            for index in range(1, count):
                moved_and_added(observer, frames[index])
            times.append(1e3 * (time.perf_counter() - begin_s) / (count - 1))
            found.append(observer.metric.compute())
        regions = RegionsOfInterest().build_query_plan(cell_m=0.25).regions
        shares = [{name: value for name, value in one.scalars(regions).items() if "detect" in name} for one in found]
        differ = max(abs(shares[0][name] - shares[1][name]) for name in shares[0])
        yield f"{rays:,} rays of the reference", *times, times[0] / times[1], 100 * differ


if __name__ == "__main__":
    main(sys.argv[1:])
