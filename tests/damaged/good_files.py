"""Valid files of all formats that are read."""

import io
import struct
import warnings
import zipfile
from dataclasses import dataclass
from pathlib import Path

import laspy
import lzf
import numpy as np
import torch
import trimesh
from PIL import Image

from tests.cli.hostile import CAMERA, RIG, TOWN, YARD
from tests.recordings.drives import Drive
from tests.recordings.layouts import LAYOUTS
from tests.simulation.recorded.drives import OTHERS, write_argoverse2, write_commonroad, write_csv, write_nuscenes
from tests.simulation.sumo.towns import XODR, drive, fcd, street, together, write_net
from torchcover.cameras import Camera, read_depth
from torchcover.coverage import BevGrid, Coverage, CoverageMetric, Region, TargetSums
from torchcover.coverage.target_sums import read_target_sums
from torchcover.data import read_cloud
from torchcover.evaluation.checkpoint import read_header, read_state, write_checkpoint
from torchcover.files import read_json_table
from torchcover.recordings.formats import frame_files, read_objects
from torchcover.recordings.formats.carla import read_carla_sensors
from torchcover.recordings.formats.folder import read_folder_settings
from torchcover.recordings.formats.kitti import (
    read_calibration,
    read_labels,
    read_oxts,
    read_timestamps,
    vehicle_T_velodyne,
)
from torchcover.recordings.formats.kitti_raw import read_tracklets
from torchcover.recordings.formats.ros import RosBag
from torchcover.recordings.formats.tracks import read_trajectory
from torchcover.recordings.isolated_readers import read_feather
from torchcover.simulation import Rig, Scenario
from torchcover.simulation.recorded.bodies import read_box_actors
from torchcover.simulation.shapes import MeshFile
from torchcover.simulation.sumo.crowd import read_vehicle_types
from torchcover.simulation.sumo.floating import TimeWindow, read_floating_car_data
from torchcover.simulation.sumo.network import read_network
from torchcover.simulation.sumo.simulating import convert_opendrive


@dataclass(frozen=True)
class Kind:
    """One format and its reader.

    Args:
        name: The file's.
        data: A good one.
        read: What reads it; raises for a bad one.
        beside: Other files that belong to it.
    """

    name: str
    data: bytes
    read: object
    beside: tuple[tuple[str, bytes], ...] = ()


def stored(write):
    """Return the bytes that a function writes to a file."""
    stream = io.BytesIO()
    write(stream)
    return stream.getvalue()


def archive(members, compression=zipfile.ZIP_DEFLATED):
    """Create a ZIP archive of files."""

    def write(stream):
        with zipfile.ZipFile(stream, "w", compression) as file:
            for name, data in members.items():
                file.writestr(name, data)

    return stored(write)


def rows(points, separator):
    """Create points as text."""
    return "".join(separator.join(f"{value:.4f}" for value in point) + "\n" for point in points.tolist()).encode()


def pcd(encoding, body):
    """A PCD file of 40 points with intensities."""
    return (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\n"
        f"COUNT 1 1 1 1\nWIDTH 20\nHEIGHT 2\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 40\nDATA {encoding}\n"
    ).encode() + body


def ply(encoding, body):
    """A PLY file of 40 points with intensities."""
    columns = "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity"))
    return f"ply\nformat {encoding} 1.0\nelement vertex 40\n{columns}end_header\n".encode() + body


def las(points, *, compressed):
    """A survey in LAS or LAZ."""
    survey = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    survey.x, survey.y, survey.z = points.T
    return stored(lambda stream: survey.write(stream, do_compress=compressed))


def png(pixels):
    """A PNG image."""
    return stored(lambda stream: Image.fromarray(pixels).save(stream, "png"))


def exr(folder):
    """An EXR image of one channel."""
    import OpenEXR

    path = Path(folder, "seed.exr")
    OpenEXR.File(
        {"compression": OpenEXR.ZIP_COMPRESSION}, {"Z": np.linspace(1, 9, 48, dtype="f4").reshape(6, 8)}
    ).write(str(path))
    return path.read_bytes()


def coverage(folder):
    """A saved result with blocks and sums over the surface."""
    grid = BevGrid(x_m=(0.0, 4.0), y_m=(0.0, 2.0), cell_m=0.5)
    metric = CoverageMetric(grid, num_blocks=8, max_radius_m=9.0, has_area_weights=True)
    random = torch.Generator().manual_seed(0)
    for _ in range(8):
        reference = torch.rand(60, 3, generator=random) * torch.tensor([4.0, 2.0, 1.0])
        metric.update(reference[::5] + 0.1, reference, weights=torch.ones(60))
    path = Path(folder, "seed.npz")
    metric.compute().save(path)
    return path.read_bytes()


def target_sums():
    """Sums of one test target in one region and two blocks."""
    grid, region = BevGrid(x_m=(0.0, 4.0), y_m=(0.0, 2.0), cell_m=1.0), Region("front", (0.0, 4.0), (0.0, 2.0))
    counts, sums, maps = torch.tensor([3, 4]), torch.ones(2, 1, 1, 5), torch.ones(1, 2, 4, 2)
    file = io.BytesIO()
    np.savez(file, **TargetSums(("pole",), (region,), 5, 0.4, grid, counts, sums.double(), maps.double()).to_arrays())
    return file.getvalue()


ROS = b"""image_width: 640
image_height: 480
camera_name: head
camera_matrix: {rows: 3, cols: 3, data: [520., 0., 318., 0., 510., 242., 0., 0., 1.]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.2, 0.1, 0.0, 0.001, 0.02]}
"""
OPENCV = b"""%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 520., 0., 318., 0., 510., 242., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 4
   cols: 1
   dt: d
   data: [ 1e-1, 0., 0., 0. ]
"""
KITTI = b"""P0: 520 0 318 0 0 510 242 0 0 0 1 0
P2: 520 0 318 44.8 0 510 242 0.2 0 0 1 0.003
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0.01 0 0 -1 -0.07 1 0 0 -0.27
"""
POSES = b"""sensor:
  vehicle_T_sensor: [[1, 0, 0, -0.52], [0, 1, 0, 0], [0, 0, 1, 1.73], [0, 0, 0, 1]]
vehicle: {lower_m: [-2.4, -0.9, 0.05], upper_m: [2.4, 0.9, 1.6]}
reference: {area_weights: true}
rigs:
  roof: {flip_y: true, min_range_m: 0.5, vehicle_T_sensor: [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 2.0], [0, 0, 0, 1]]}
"""
DRIVEN = b"""frame,time_s,x_m,y_m,z_m,qw,qx,qy,qz
f1,0.0,513248.1,5403655.2,260.1,1,0,0,0
f2,0.1,513249.1,5403655.3,260.1,0.6,0,0,0.8
"""
CARLA = b"""[
 {"id": "roof", "type": "sensor.lidar.ray_cast", "x": 0.7, "y": 0.4, "z": 1.6, "yaw": 30.0, "channels": "64"},
 {"id": "reference", "type": "sensor.lidar.ray_cast", "roll": 2.5, "rotation_frequency": 20}
]"""
LABELS = b"""x_m,y_m,z_m,length_m,width_m,height_m,yaw_rad,id,category
10.5,-2.0,0.75,4.5,1.8,1.5,0.1,a,car
-7.5,3.0,0.9,0.6,0.6,1.8,-3.1,,pedestrian
"""
SENSORS = b'[{"token": "s1", "channel": "CAM_FRONT"}, {"token": "s2", "channel": "LIDAR_TOP"}]'
CALIBRATED = b"""[
 {"token": "a", "sensor_token": "s1", "translation": [1.7, 0.0, 1.5], "rotation": [0.5, -0.5, 0.5, -0.5],
  "camera_intrinsic": [[520.0, 0.0, 318.0], [0.0, 510.0, 242.0], [0.0, 0.0, 1.0]]},
 {"token": "l", "sensor_token": "s2", "translation": [0.9, 0, 1.8], "rotation": [1, 0, 0, 0], "camera_intrinsic": []}
]"""


TRAJECTORY = b"t,x,y,z,roll,pitch,yaw\n" + b"".join(b"%d,%d.5,2,0,0,0,%d\n" % (k, 3 * k, k) for k in range(9))
BOXES = b"t,id,category,x,y,z,length,width,height,yaw\n" + b"".join(
    b"%d,a%d,car,%d,2,0,4,2,1.5,90\n" % (k, k % 2, 3 * k) for k in range(12)
)


def mesh(path):
    """Read a mesh without the warning that it is not closed."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*the mesh is not closed")
        return MeshFile(type="mesh", path=path).build_mesh()


def scene_files():
    """List files of scenes: trajectories, boxes, meshes and documents."""
    poses = {"times_s": np.arange(5.0), "world_T_body": np.stack([np.eye(4)] * 5)}
    ball = trimesh.creation.icosphere(subdivisions=1)
    yield Kind("trajectory.csv", TRAJECTORY, read_trajectory)
    yield Kind("trajectory.npz", stored(lambda stream: np.savez(stream, **poses)), read_trajectory)
    yield Kind("boxes.csv", BOXES, read_box_actors)
    for suffix in ("ply", "obj", "stl", "glb", "off"):
        data = ball.export(file_type=suffix)
        yield Kind(f"mesh.{suffix}", data if isinstance(data, bytes) else data.encode(), mesh)
    yield Kind("rig.yaml", RIG.encode(), Rig.load)
    yield Kind("camera.yaml", CAMERA.encode(), Rig.load)
    yield Kind("yard.yaml", YARD.encode(), Scenario.load)
    yield Kind("town.yaml", TOWN.encode(), Scenario.load)


def track_files(folder):
    """List files of recorded tracks and of SUMO."""
    log = write_argoverse2(Path(folder) / "log", OTHERS[:3])
    tables = write_nuscenes(Path(folder) / "tables", OTHERS[:3])
    table = write_csv(Path(folder) / "table", OTHERS[:2])
    for path in (*sorted(log.glob("*.feather")), *sorted(tables.glob("*.json"))):
        others = ((other.name, other.read_bytes()) for other in path.parent.iterdir() if other != path)
        yield Kind(path.name, path.read_bytes(), in_folder, tuple(others))
    commonroad = write_commonroad(Path(folder) / "commonroad.xml", OTHERS[:2])
    for path in (commonroad, table / "boxes.csv"):
        yield Kind(f"tracks_{path.name}", path.read_bytes(), read_objects)
    yield Kind("town.net.xml", write_net(Path(folder) / "a.net.xml", street()).read_bytes(), read_network)
    driven = fcd(together(drive(until=2.0), drive("b", start=90.0, until=2.0))).encode()
    yield Kind("fcd.xml", driven, lambda path: read_floating_car_data(path, TimeWindow(0.0, 1.0)))
    yield Kind("town.rou.xml", ROUTES, read_vehicle_types)
    yield Kind("road.xodr", XODR.encode(), lambda path: convert_opendrive(path, Path(folder), omit_missing_links=False))


def in_folder(path):
    """Read the tracks that a file belongs to."""
    return read_objects(path.parent)


ROUTES = b"""<routes><vType id="taxi" vClass="taxi" length="4.6"/><vType id="bike" vClass="bicycle"/>
<vehicle id="a" type="taxi" depart="0"><route edges="east west"/></vehicle></routes>"""


def recording_files(folder):
    """List files of recordings other than clouds."""
    drive, places = Drive(steps=3), {}
    for layout, write in LAYOUTS.items():
        (Path(folder) / layout).mkdir()
        places[layout] = write(drive, Path(folder) / layout)
    kitti, nuscenes, argoverse2 = (places[layout] for layout in ("kitti_raw", "nuscenes", "argoverse2"))

    def boxes(path):
        return read_tracklets(path, vehicle_T_velodyne)

    def cuboids(path):
        return read_feather(path, ("timestamp_ns", "track_uuid", "qw", "tx_m"))

    for path, read in (
        (kitti.parent / "calib_imu_to_velo.txt", read_calibration),
        (kitti / "oxts" / "data" / "0000000000.txt", read_oxts),
        (kitti / "velodyne_points" / "timestamps.txt", lambda path: read_timestamps(path, [0])),
        (kitti / "tracklet_labels.xml", boxes),
        (nuscenes / "v1.0-mini" / "sample_data.json", read_json_table),
        (argoverse2 / "annotations.feather", cuboids),
    ):
        yield Kind(path.name, path.read_bytes(), read)
    yield Kind("label_2.txt", KITTI_LABEL, read_labels)
    yield Kind("drive.mcap", (places["ros"] / "drive.mcap").read_bytes(), bag)
    yield Kind("drive.db3", (places["ros database"] / "drive.db3").read_bytes(), bag)


def bag(path):
    """Read a whole bag."""
    recording = RosBag(path)
    for index in recording.key_frames:
        for sensor in recording.sensors:
            recording.read_scan(sensor, index)


KITTI_LABEL = b"Car 0.00 0 1.5 100 100 200 200 1.5 1.6 3.9 1.0 1.6 20.0 1.5\n" * 3


def checkpoint(folder):
    """Create a checkpoint of one observer."""
    path = Path(folder) / "checkpoint.npz"
    run = {"num_frames": 3, "counts": {"sensor_rays": 9}, "skipped_frames": [], "duration_s": 1.5}
    state = {"dense": torch.arange(1, 40), "sparse": torch.eye(20, dtype=torch.float64), "looks": [1, None, "two"]}
    write_checkpoint(path, {"identity": {"seed": "0"}, "run": run}, {"one": state})
    return path.read_bytes()


def kinds(folder):
    """One of each format that is read.

    Args:
        folder: Where libraries may write what they write into files only.
    """
    random = np.random.default_rng(0)
    cloud = random.uniform([-40, -40, -2, 0], [40, 40, 3, 1], (40, 4)).astype("<f4")
    xyz = cloud[:, :3].astype(np.float64)
    rings = np.c_[cloud, np.arange(40) % 16].astype("<f4")
    packed = lzf.compress(cloud.T.tobytes(), 2000)
    member = stored(lambda stream: np.save(stream, xyz))
    colour = random.integers(0, 256, (6, 8, 4), dtype=np.uint8)
    rgb, grey = colour[..., :3].copy(), random.integers(0, 65536, (6, 8)).astype(np.uint16)
    clouds = {
        "c.npy": stored(lambda stream: np.save(stream, cloud)),
        "c64.npy": member,
        "deflated.npz": archive({"points.npy": member}),
        "stored.npz": archive({"points.npy": member}, zipfile.ZIP_STORED),
        "c.bin": cloud.tobytes(),
        "c.pcd.bin": rings.tobytes(),
        "ascii.pcd": pcd("ascii", rows(cloud, " ")),
        "binary.pcd": pcd("binary", cloud.tobytes()),
        "compressed.pcd": pcd("binary_compressed", struct.pack("<II", len(packed), cloud.nbytes) + packed),
        "ascii.ply": ply("ascii", rows(cloud, " ")),
        "binary.ply": ply("binary_little_endian", cloud.tobytes()),
        "c.csv": b"x,y,z,intensity\n" + rows(cloud, ","),
        "c.xyz": b"# x y z intensity\n" + rows(cloud, " "),
        "c.las": las(xyz, compressed=False),
        "c.laz": las(xyz, compressed=True),
    }

    def depth(path):
        return read_depth(path, meters_per_unit=0.001 if path.stem.startswith("whole") else None)

    depths = {
        "rgb.png": png(rgb),
        "rgba.png": png(colour),
        "whole.png": png(grey),
        "d.npy": stored(lambda stream: np.save(stream, grey.astype(np.float32))),
        "whole.npy": stored(lambda stream: np.save(stream, grey)),
        "d.exr": exr(folder),
    }

    def nuscenes(path):
        return Camera.from_nuscenes(path.parent, "CAM_FRONT")

    return (
        *(Kind(name, data, read_cloud) for name, data in clouds.items()),
        *(Kind(name, data, depth) for name, data in depths.items()),
        Kind("ros.yaml", ROS, Camera.from_ros),
        Kind("opencv.yml", OPENCV, Camera.from_opencv),
        Kind("kitti.txt", KITTI, lambda path: Camera.from_kitti(path, 2, width=640, height=480)),
        Kind("sensor.json", SENSORS, nuscenes, (("calibrated_sensor.json", CALIBRATED),)),
        Kind("calibrated_sensor.json", CALIBRATED, nuscenes, (("sensor.json", SENSORS),)),
        Kind("frames.yaml", POSES, read_folder_settings),
        Kind("poses.csv", DRIVEN, lambda path: frame_files.PoseTable(path, ("f1", "f2"), has_times=True)),
        Kind("sensors.json", CARLA, read_carla_sensors),
        Kind("labels.csv", LABELS, frame_files.read_boxes),
        Kind("coverage.npz", coverage(folder), Coverage.load),
        Kind("targets.npz", target_sums(), read_target_sums),
        *scene_files(),
        *track_files(folder),
        *recording_files(folder),
        Kind("checkpoint.npz", checkpoint(folder), lambda path: read_state(path, read_header(path), "one")),
    )
