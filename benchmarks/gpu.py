"""GPU against the CPU of its machine: tests that need a GPU, search, sums, rays and whole frames, in wall time."""

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

RIG = "front_roof_128"
NUM_RAYS = (16_384, 262_144)  # of the reference sensor
GPU_TESTS = (
    "tests/stability/test_stability.py",
    "tests/neighbors/test_packets.py",
    "tests/simulation/test_raycaster.py",
    "tests/simulation/test_simulated.py",
    "tests/coverage/test_on_a_device.py",
)


def main(arguments=()):
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda:0", help="`cpu` tries the benchmark on a machine without a GPU")
    parser.add_argument("--points", type=int, default=10**6, help="of the largest search")
    parser.add_argument("--num-frames", type=int, default=24, help="frames that are timed as a whole")
    parser.add_argument("--tests", action="store_true", help="first run the tests that need a GPU")
    options = parser.parse_args(arguments)
    device = torch.device(options.device)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    print(f"{name}, torch {torch.__version__}, Warp {wp.__version__}, {torch.get_num_threads()} threads\n")
    if options.tests:
        run_gpu_tests()
    headings = ("clouds", "queries", "points", "CPU, `auto` (ms)", "Warp (ms)", "with transfers (ms)", "CuPy (ms)")
    table((*headings, "other points", "farther by, at most"), measure_searches(device, options.points))
    print()
    table(("metric update", "CPU (ms)", "device (ms)", "CPU / device"), measure_updates(device))
    print()
    table(("rays at static bodies", "Embree (ms)", "Warp (ms)", "Embree / Warp", "other bodies"), measure_rays(device))
    print()
    headings = ("a whole frame", "CPU (ms)", "device (ms)", "CPU / device", "detections differ by (points)")
    table(headings, measure_frames(device, options.num_frames))


def run_gpu_tests():
    """Run the tests that need a GPU and print their summary, and the end of their output if one fails."""
    options = ("--numprocesses", "8", "--quiet", "--no-header", "--tb=short", "-p", "no:cacheprovider")
    command = [sys.executable, "-m", "pytest", *GPU_TESTS, "-k", "cuda or GPU or gpu", *options, "-p", "no:benchmark"]
    done = subprocess.run(command, check=False, stdout=subprocess.PIPE, text=True)
    print(f"Tests that need a GPU: {done.stdout.strip().splitlines()[-1].strip('= ')}\n")
    if done.returncode:
        print(done.stdout[-6000:])


def measure_wall_ms(function, device, rounds=5):
    """Measure the median wall time of a function in ms after a warm-up, until the device has finished."""
    times_ms = []
    for _ in range(rounds + 1):
        start_s = time.perf_counter()
        function()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        times_ms.append(1e3 * (time.perf_counter() - start_s))
    return statistics.median(times_ms[1:])


def build_frames(device=None, num_frames=1, num_rays=16_384):
    reference_sensor = create_reference_sensor(num_rays=num_rays)
    options = {"num_frames": num_frames, "frame_interval_s": 10.0, "reference_sensor": reference_sensor}
    return SimulatedFrames("urban", RIG, device=device, **options)


def measure_searches(device, max_points):
    """Yield a row for each search: in a frame with few and with many reference points, and in random clouds."""
    rng = np.random.default_rng(0)
    for num_rays in NUM_RAYS:
        frame = build_frames(num_rays=num_rays)[0]
        yield measure_search(f"{RIG}, {num_rays:,} rays of the reference", frame.reference, frame.sensor, device)
    for count in (max_points // 10, max_points):
        query, points = (torch.from_numpy(rng.uniform(-50, 50, (count, 3)).astype(np.float32)) for _ in range(2))
        yield measure_search("random", query, points, device)


def measure_search(name, query, points, device):
    """Measure one search on the CPU and on the device, and compare the results."""
    device_query, device_points = query.to(device), points.to(device)
    warp_result = nearest(device_query, device_points, backend="warp")
    cpu_result = nearest(query, points)
    different_count = int((warp_result.index.cpu() != cpu_result.index).sum())
    distance_ratio = warp_result.distance.cpu().double() / cpu_result.distance.double()
    largest_excess = float((distance_ratio - 1).abs().nan_to_num().max())
    cpu_ms = measure_wall_ms(partial(nearest, query, points), torch.device("cpu"))
    warp_ms = measure_wall_ms(partial(nearest, device_query, device_points, backend="warp"), device)

    def search_with_transfers():
        nearest(query.to(device), points.to(device), backend="warp").distance.cpu()

    transfer_ms = measure_wall_ms(search_with_transfers, device)
    cupy_ms = measure_cupy_ms(device_query, device_points)
    times_ms = (cpu_ms, warp_ms, transfer_ms, cupy_ms)
    return name, f"{len(query):,}", f"{len(points):,}", *times_ms, different_count, largest_excess


def measure_cupy_ms(query, points):
    """Measure the search with the tree of CuPy; empty if CuPy is not installed."""
    try:
        import cupy
        from cupyx.scipy.spatial import KDTree
    except ImportError:
        return ""
    cupy_query, cupy_points = (cupy.asarray(cloud.cpu().numpy()) for cloud in (query, points))

    def search():
        KDTree(cupy_points).query(cupy_query)

    return measure_wall_ms(search, query.device)


def measure_updates(device):
    """Yield the time of search and sums of one rig with the default cells; frames come from the CPU."""
    for num_rays in NUM_RAYS:
        frame = build_frames(num_rays=num_rays)[0]
        times_ms = []
        for metric_device in (torch.device("cpu"), device):
            update = partial(update_observer, build_observer(metric_device), frame)
            times_ms.append(measure_wall_ms(update, metric_device))
        yield f"{num_rays:,} rays of the reference", *times_ms, times_ms[0] / times_ms[1]


def update_observer(observer, frame):
    observer.update(frame.to(observer.metric.device))


def build_observer(device):
    query_plan = RegionsOfInterest().build_query_plan(cell_m=0.25)
    return CoverageObserver(build_metric(Settings(), query_plan, has_area_weights=True).to(device), RIG)


def measure_rays(device):
    """Yield the time of rays from the roof at static bodies: as many as a scan, and as the paper's reference."""
    geometry, _ = build_frames().simulator.get_scene_geometry(0)
    origin_m = geometry.scene.ego.trajectory.interpolate(0.0)[:3, 3] + (0.0, 0.0, 1.9)
    casters = [RayCaster(geometry.scene.static_meshes, caster_device) for caster_device in (None, str(device))]
    for size in (480, 1024):
        directions = PaperReference(rows=size, columns=size).compute_directions().reshape(3, -1).astype(np.float32)
        limit_m = np.full(directions.shape[1], 200.0, dtype=np.float32)
        hits, times_ms = [], []
        for caster in casters:
            hits.append(caster.cast(origin_m, directions, limit_m))
            times_ms.append(measure_wall_ms(partial(caster.cast, origin_m, directions, limit_m), device))
        different_count = int((hits[0].body_indices != hits[1].body_indices).sum())
        yield f"{directions.shape[1]:,}", *times_ms, times_ms[0] / times_ms[1], different_count


def measure_frames(device, num_frames):
    """Yield the time per frame of a run without its start, with all threads."""
    regions = RegionsOfInterest().build_query_plan(cell_m=0.25).regions
    for num_rays in NUM_RAYS:
        times_ms, shares = [], []
        for run_device in (None, str(device)):
            frames = build_frames(run_device, num_frames, num_rays)
            observer = build_observer(run_device or "cpu")
            for index in range(num_frames):
                frames.simulator.get_scene_geometry(index)
            update_observer(observer, frames[0])
            start_s = time.perf_counter()
            for index in range(1, num_frames):
                update_observer(observer, frames[index])
            times_ms.append(1e3 * (time.perf_counter() - start_s) / (num_frames - 1))
            scalars = observer.metric.compute().scalars(regions)
            shares.append(np.array([value for name, value in scalars.items() if "detect" in name]))
        largest_difference = float(np.nanmax(np.abs(shares[0] - shares[1])))
        yield f"{num_rays:,} rays of the reference", *times_ms, times_ms[0] / times_ms[1], 100 * largest_difference


if __name__ == "__main__":
    main(sys.argv[1:])
