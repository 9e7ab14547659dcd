"""Drive on a hill, written in each format.

`python -m tests.simulation.recorded.drives datasets/scenarios/tracks` makes the files of the built-in scenarios.
"""

import csv
import json
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchcover.geometry import build_transform, convert_rotation_to_euler, invert
from torchcover.recordings.formats import argoverse2, nuscenes

T0_NS = 315_966_000_000_000_000
STEP_S, STEPS = 0.2, 21
TIMES_S = STEP_S * np.arange(STEPS)
ORIGIN_M = np.array([1400.0, 2200.0])


class RecordedBox(NamedTuple):
    """Box that drives straight, or stands, with positions relative to ORIGIN_M."""

    name: str
    category: str
    size_m: tuple
    start_m: tuple
    yaw_deg: float
    speed_mps: float = 0.0
    first: int = 0
    last: int = STEPS - 1


OTHERS = (
    RecordedBox("a1", "car", (4.5, 1.8, 1.5), (24.0, 0.0), 0.0, 9.0),
    RecordedBox("a2", "car", (4.2, 1.75, 1.6), (60.0, 3.6), 180.0, 11.0),
    RecordedBox("a3", "truck", (9.5, 2.5, 3.4), (-24.0, 0.0), 0.0, 9.0),
    RecordedBox("a4", "bus", (11.6, 2.6, 3.1), (95.0, 3.6), 180.0, 8.0, 5),
    RecordedBox("a5", "car", (4.0, 1.7, 1.4), (15.0, -5.5), 0.0),
    RecordedBox("a6", "car", (5.6, 2.1, 2.4), (29.0, -5.5), 0.0),
    RecordedBox("a7", "pedestrian", (0.7, 0.7, 1.75), (38.0, -9.0), 90.0, 1.4),
    RecordedBox("a8", "bicycle", (1.8, 0.6, 1.75), (8.0, 6.5), 180.0, 4.0, 0, 14),
    RecordedBox("a9", "bollard", (0.3, 0.3, 1.0), (22.0, -8.0), 0.0),
)
EGO = RecordedBox("ego", "car", (4.9, 1.94, 1.63), (0.0, 0.0), 0.0, 9.0)


def compute_hill_heights_m(places_m):
    """Compute the heights of (N, 2) positions: a street that rises and falls by meters, and leans to its side."""
    x, y = (places_m - ORIGIN_M).T
    return 31.0 + 2.5 * np.sin(x / 45.0) + 0.02 * y


def compute_flat_heights_m(places_m):
    """Compute zero heights."""
    return np.zeros(len(places_m))


def poses(somebody, heights=compute_hill_heights_m, times_s=TIMES_S):
    """Compute the (T, 4, 4) poses of the center of the bottom, on the ground and tilted with it."""
    yaw = np.deg2rad(somebody.yaw_deg)
    ahead = np.array([np.cos(yaw), np.sin(yaw)])
    plan_m = ORIGIN_M + somebody.start_m + somebody.speed_mps * times_s[:, None] * ahead
    reach = 1e-4
    slopes = [(heights(plan_m + step) - heights(plan_m - step)) / (2 * reach) for step in reach * np.eye(2)]
    up = np.column_stack([-slopes[0], -slopes[1], np.ones(len(plan_m))])
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    forward = np.column_stack([np.tile(ahead, (len(plan_m), 1)), np.column_stack(slopes) @ ahead])
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    rotation = np.stack([forward, np.cross(up, forward), up], axis=2)
    return build_transform(rotation, np.column_stack([plan_m, heights(plan_m)]))


def seen(somebody):
    """List the frames in which it is present."""
    return range(somebody.first, somebody.last + 1)


def compute_quaternion(matrix):
    """Compute w, x, y, z of a rotation by less than 180 degrees about any axis, or about z."""
    r = matrix[:3, :3]
    w = np.sqrt(max(1 + np.trace(r), 0.0)) / 2
    if w < 1e-6:
        return [0.0, 0.0, 0.0, 1.0] if r[2, 2] > 0.999999 else _rotate_half_turn(r)
    return [w, *((np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])) / (4 * w)).tolist()]


def _rotate_half_turn(r):
    axis = np.sqrt(np.clip((np.diag(r) + 1) / 2, 0.0, None))
    axis[:2] *= np.sign(r[2, :2])
    return [0.0, *axis.tolist()]


def compute_center_pose(world_T_bottom, size_m):
    """Compute the pose of the center of a box."""
    return world_T_bottom @ build_transform(np.eye(3), [0.0, 0.0, size_m[2] / 2])


def write_argoverse2(folder, others=OTHERS, heights=compute_hill_heights_m):
    """Write a log; the poses of the ego vehicle are twice as dense as the cuboids, and begin earlier."""
    import pyarrow as pa
    from pyarrow import feather

    names = {"car": "REGULAR_VEHICLE"}
    folder.mkdir(parents=True, exist_ok=True)
    dense_s = STEP_S / 2 * np.arange(-1, 2 * STEPS)
    world_T_ego = poses(EGO, heights, dense_s) @ argoverse2.vehicle_T_ego
    driven = [
        {"timestamp_ns": T0_NS + round(1e9 * t), **_build_row(pose)}
        for t, pose in zip(dense_s, world_T_ego, strict=True)
    ]
    cuboids = []
    for somebody in others:
        world_T_box = compute_center_pose(poses(somebody, heights), somebody.size_m)
        size = dict(zip(("length_m", "width_m", "height_m"), somebody.size_m, strict=True))
        for k in seen(somebody):
            pose = invert(world_T_ego[2 * k + 1]) @ world_T_box[k]
            category = names.get(somebody.category, somebody.category.upper())
            row = {"timestamp_ns": T0_NS + round(1e9 * TIMES_S[k]), "track_uuid": somebody.name, "category": category}
            cuboids.append({**row, **size, **_build_row(pose)})
    feather.write_feather(pa.Table.from_pylist(driven), str(folder / argoverse2.POSES_FILE))
    feather.write_feather(pa.Table.from_pylist(cuboids), str(folder / "annotations.feather"))
    return folder


def _build_row(pose):
    return dict(zip(argoverse2.POSE_COLUMNS, [*compute_quaternion(pose), *pose[:3, 3].tolist()], strict=True))


def write_nuscenes(folder, others=OTHERS, heights=compute_flat_heights_m, scenes=("scene-0001",)):
    """Write tables; every fifth frame is a sample. Scenes after the first are a minute later, without other objects."""
    names = {"car": "vehicle.car", "truck": "vehicle.truck", "bus": "vehicle.bus.rigid", "bicycle": "vehicle.bicycle",
             "pedestrian": "human.pedestrian.adult", "bollard": "movable_object.barrier"}  # fmt: skip
    tables = {name: [] for name in ("sample", "ego_pose", "sample_annotation", "instance", "category", "scene")}
    tables["category"] = [{"token": f"c-{one}", "name": name} for one, name in names.items()]
    tables["instance"] = [{"token": one.name, "category_token": f"c-{one.category}"} for one in others]
    world_T_ego = poses(EGO, heights) @ nuscenes.vehicle_T_ego
    for number, scene in enumerate(scenes):
        tables["scene"].append({"token": f"s{number}", "name": scene})
        for k, time_s in enumerate(TIMES_S.tolist()):
            time_us = T0_NS // 1000 + round(1e6 * (time_s + 60 * number))
            place = {"rotation": compute_quaternion(world_T_ego[k]), "translation": world_T_ego[k][:3, 3].tolist()}
            tables["ego_pose"].append({"token": f"p{number}-{k}", "timestamp": time_us, **place})
            if k % 5 == 0:
                token = f"k{number}-{k}"
                tables["sample"].append({"token": token, "scene_token": f"s{number}", "timestamp": time_us})
    for one in others:
        boxes, (length, width, height) = compute_center_pose(poses(one, heights), one.size_m), one.size_m
        for k in seen(one):
            if k % 5 == 0:
                place = {"rotation": compute_quaternion(boxes[k]), "translation": boxes[k][:3, 3].tolist()}
                row = {"token": f"{one.name}-{k}", "sample_token": f"k0-{k}", "instance_token": one.name}
                tables["sample_annotation"].append({**row, "size": [width, length, height], **place})
    folder.mkdir(parents=True, exist_ok=True)
    for name, rows in tables.items():
        folder.joinpath(f"{name}.json").write_text("[\n" + ",\n".join(map(json.dumps, rows)) + "\n]\n")
    return folder


def write_commonroad(path, others=OTHERS):
    """Write version 2020a: objects that never move are static."""
    parts = [f'<commonRoad timeStepSize="{STEP_S}" commonRoadVersion="2020a" benchmarkID="HILL_Drive-1_1_T-1">']
    for number, one in enumerate(others, 1):
        kind = "dynamic" if one.speed_mps else "static"
        length, width, _ = one.size_m
        shape = f"<rectangle><length>{length}</length><width>{width}</width></rectangle>"
        parts.append(f'<{kind}Obstacle id="{number}"><type>{one.category}</type><shape>{shape}</shape>')
        states = [_build_state(one, k) for k in (seen(one) if one.speed_mps else range(1))]
        parts.append(f"<initialState>{states[0]}</initialState>")
        if len(states) > 1:
            parts.append(f"<trajectory>{''.join(f'<state>{state}</state>' for state in states[1:])}</trajectory>")
        parts.append(f"</{kind}Obstacle>")
    parts.append(
        f'<planningProblem id="100"><initialState>{_build_state(EGO, 0)}</initialState></planningProblem></commonRoad>'
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(parts) + "\n")
    return path


def _build_state(one, k):
    x, y, _ = poses(one, compute_flat_heights_m)[k][:3, 3]
    return (
        f"<position><point><x>{x:.6f}</x><y>{y:.6f}</y></point></position>"
        f"<orientation><exact>{np.deg2rad(one.yaw_deg):.9f}</exact></orientation><time><exact>{k}</exact></time>"
    )


def write_csv(folder, others=OTHERS, heights=compute_hill_heights_m):
    """Write `boxes.csv` and `ego.csv`; the boxes do not tilt."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "boxes.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["t", "id", "category", "x", "y", "z", "length", "width", "height", "yaw"])
        for one in others:
            places_m = poses(one, heights)[:, :3, 3]
            for k in seen(one):
                place = [f"{metres:.6f}" for metres in places_m[k].tolist()]
                rows.writerow([f"{TIMES_S[k]:.1f}", one.name, one.category, *place, *one.size_m, one.yaw_deg])
    driven = poses(EGO, heights)
    with (folder / "ego.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["t", "x", "y", "z", "roll", "pitch", "yaw"])
        for time_s, pose in zip(TIMES_S, driven, strict=True):
            yaw, pitch, roll = convert_rotation_to_euler(pose[:3, :3]).tolist()
            numbers = [*pose[:3, 3].tolist(), roll, pitch, yaw]
            rows.writerow([f"{time_s:.1f}", *(f"{number:.9f}" for number in numbers)])
    return folder


def rewrite(path, change):
    """Change the cells of each row of a table, including the header; rows for which it returns None are dropped."""
    rows = (change(line.split(",")) for line in path.read_text().splitlines())
    path.write_text("\n".join(",".join(row) for row in rows if row))


def write_all(folder):
    """Write all four formats, as the built-in scenarios have them."""
    write_argoverse2(folder / "argoverse2")
    write_nuscenes(folder / "nuscenes")
    write_commonroad(folder / "commonroad.xml")
    write_csv(folder / "table")


if __name__ == "__main__":
    write_all(Path(sys.argv[1]))
