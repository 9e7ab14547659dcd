"""Do readers keep up with the disk, and how soon does a long recording start?

KITTI's raw layout, 120,000 points a scan of a street; processor time of one thread. The straight way is `np.fromfile`,
the transform in float64, and float32 again.
"""

import json
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from benchmarks import compare, table
from torchcover.data import AccumulatedReference, RecordedFrames, open_recording
from torchcover.recordings.formats.kitti import vehicle_T_velodyne
from torchcover.recordings.vehicle_cloud import transform_to_vehicle

POINTS, SWEEPS, LONG = 120_000, 50, 100_000
LINKS = 50_000  # files that may be one file


def main():
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        drive = kitti(Path(folder, "drive"), 2 * SWEEPS)
        reading(open_recording(drive))
        accumulating(drive)
    rows = []
    for layout, write in {"kitti_raw": kitti, "folder": plain, "nuscenes": nuscenes}.items():
        with tempfile.TemporaryDirectory() as folder:
            path = write(Path(folder, layout), LONG, few_points=True)
            start, used = time.perf_counter(), time.process_time()
            frames = RecordedFrames(path)
            opened = time.process_time() - used
            frames[len(frames) // 4]
            rows.append((layout, opened, time.process_time() - used, time.perf_counter() - start))
    print(f"\n{LONG:,} frames")
    table(("layout", "opened, s", "first frame, s", "by the clock, s"), rows)


def reading(recording):
    paths = [Path(recording.read_scan("velodyne", index).source) for index in range(SWEEPS)]

    def straight():
        for path in paths:
            points = np.fromfile(path, "<f4").reshape(-1, 4)[:, :3].astype(np.float64)
            (points @ vehicle_T_velodyne[:3, :3].T + vehicle_T_velodyne[:3, 3]).astype(np.float32)

    def ours():
        for index in range(SWEEPS):
            transform_to_vehicle(recording.read_scan("velodyne", index), recording.ego_box)

    seconds, ratios = compare(straight, ours)
    rows = [
        (name, 1000 * s / SWEEPS, r) for name, s, r in zip(("straight", "the reader"), seconds, ratios, strict=True)
    ]
    table(("scan in the vehicle frame", "ms", "ratio"), rows)


def accumulating(drive):
    frames = RecordedFrames(drive, reference=AccumulatedReference(0.1 * (SWEEPS - 1) + 0.01))
    used = []
    for index in range(SWEEPS // 2, SWEEPS // 2 + 12):
        start = time.process_time()
        frames[index]
        used.append(time.process_time() - start)
    print(f"\n{SWEEPS} sweeps of {POINTS:,} points: {used[0]:.2f} s the first frame, then {np.median(used[1:]):.2f} s")


def kitti(path, frames, *, few_points=False):
    """A drive along a street."""
    for place in ("velodyne_points/data", "oxts/data"):
        (path / place).mkdir(parents=True)
    identity = "R: 1 0 0 0 1 0 0 0 1\nT: 0 0 0\n"
    (path.parent / "calib_imu_to_velo.txt").write_text(identity)
    start = np.datetime64("2011-09-26T13:02:25.000000000")
    times = start + (np.arange(frames) * 10**8).astype("timedelta64[ns]")
    (path / "velodyne_points" / "timestamps.txt").write_text("\n".join(map(str, times)))
    generator = np.random.default_rng(0)
    for index in range(frames):
        scan, oxts = path / "velodyne_points/data" / f"{index:010d}.bin", path / "oxts/data" / f"{index:010d}.txt"
        if few_points and index % LINKS:
            first = f"{index // LINKS * LINKS:010d}"
            scan.hardlink_to(scan.with_stem(first))
            oxts.hardlink_to(oxts.with_stem(first))
            continue
        scan.write_bytes(cloud(generator, 640 if few_points else POINTS).tobytes())
        oxts.write_text(f"49.0 {8.0 + 1e-5 * index} 100 0 0 0 " + "0 " * 24)
    return path


def cloud(generator, points):
    """(N, 4) float32 of a turn of 64 lasers between walls 15 m to the left and right."""
    elevation = np.deg2rad(np.linspace(-24.8, 2.0, 64))[:, None]
    azimuth = np.linspace(0, 2 * np.pi, points // 64, endpoint=False)[None]
    ray = np.stack(
        np.broadcast_arrays(np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation))
    )
    with np.errstate(divide="ignore"):
        ground_m, wall_m = np.where(ray[2] < 0, -1.73 / ray[2], np.inf), 15.0 / np.abs(ray[1])
    range_m = np.minimum(np.minimum(ground_m, wall_m), 80.0) + generator.normal(0.0, 0.02, ray.shape[1:])
    rows = np.concatenate([ray * range_m, generator.uniform(0, 1, (1, *range_m.shape))])
    return rows.reshape(4, -1).T.astype("<f4")


def plain(path, frames, *, few_points):
    assert few_points
    (path / "sensor").mkdir(parents=True)
    points = cloud(np.random.default_rng(0), 640).tobytes()
    for index in range(frames):
        scan = path / "sensor" / f"{index}.bin"
        if index % LINKS:
            scan.hardlink_to(scan.with_stem(str(index // LINKS * LINKS)))
        else:
            scan.write_bytes(points)
    rows = (f"{index},{0.1 * index:.1f},{index},0,0,1,0,0,0\n" for index in range(frames))
    (path / "poses.csv").write_text("frame,time_s,x_m,y_m,z_m,qw,qx,qy,qz\n" + "".join(rows))
    return path


def nuscenes(path, frames, *, few_points):
    """Tables of sweeps, every tenth a key frame; all are the same file."""
    assert few_points
    (path / "v1.0-mini").mkdir(parents=True)
    (path / "samples" / "LIDAR_TOP").mkdir(parents=True)
    rows = np.column_stack([cloud(np.random.default_rng(0), 640), np.arange(640) % 32]).astype("<f4")
    (path / "samples" / "LIDAR_TOP" / "a.pcd.bin").write_bytes(rows.tobytes())
    still = {"rotation": [1, 0, 0, 0]}
    times = [100_000 * index for index in range(frames)]
    tables = {
        "scene": [{"token": "s", "name": "scene-0001"}],
        "category": [{"token": "c", "name": "car"}],
        "instance": [{"token": "i", "category_token": "c"}],
        "sample": [
            {"token": f"k{number}", "scene_token": "s", "timestamp": times[10 * number]}
            for number in range(frames // 10)
        ],
        "calibrated_sensor": [{"token": "m", "translation": [0, 0, 1.84], **still}],
        "ego_pose": [
            {"token": f"p{index}", "translation": [index, 0, 0], "timestamp": times[index], **still}
            for index in range(frames)
        ],
        "sample_data": [
            {"token": f"d{index}", "sample_token": f"k{index // 10}", "ego_pose_token": f"p{index}"}
            | {"calibrated_sensor_token": "m", "timestamp": times[index], "is_key_frame": index % 10 == 0}
            | {"filename": "samples/LIDAR_TOP/a.pcd.bin"}
            for index in range(frames)
        ],
        "sample_annotation": [],
    }
    for name, rows in tables.items():
        (path / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows))
    return path


if __name__ == "__main__":
    main()
