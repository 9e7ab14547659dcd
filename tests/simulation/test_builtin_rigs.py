"""Built-in rigs have the numbers of their sources, in the vehicle frame."""

import numpy as np
import pytest

from torchcover import Rig
from torchcover.geometry import transform_points
from torchcover.simulation import list_builtin_names
from torchcover.simulation.bodies import Vehicle

RIGS = list_builtin_names("rigs")

# Center of the box in the frame of the source: meters ahead of the rear axle, height of the source's origin.
NUSCENES, KITTI, WAYMO, ARGOVERSE, EDGAR = (1.385, 0.0), (1.337, 0.0), (1.461, 0.0), (1.339, 0.30), (1.5915, 0.338)

# Rig, sensor, frame, position as published (rear axle; x forward, y left, z up).
REAR_AXLE = [
    ("nuscenes", "top", NUSCENES, (0.944, 0.0, 1.840)),
    ("kitti", "velodyne", KITTI, (0.76, 0.0, 1.73 + 0.121)),  # above the origin of its clouds, see the rig
    ("waymo", "top", WAYMO, (1.430, 0.0, 2.184)),
    ("waymo", "front", WAYMO, (4.070, 0.0, 0.689)),
    ("waymo", "side_left", WAYMO, (3.245, 1.025, 0.979)),
    ("waymo", "side_right", WAYMO, (3.245, -1.025, 0.979)),
    ("waymo", "rear", WAYMO, (-1.155, 0.0, 0.464)),
    ("argoverse2", "up_lidar", ARGOVERSE, (1.350, 0.0, 1.640)),
    ("argoverse2", "down_lidar", ARGOVERSE, (1.347, 0.005, 1.526)),
    ("edgar", "ouster_left", EDGAR, (2.312, 0.582, 1.610)),
    ("edgar", "ouster_right", EDGAR, (2.312, -0.665, 1.613)),
    ("edgar", "innovusion_front", EDGAR, (2.259, 0.0, 1.600)),
    ("edgar", "innovusion_rear", EDGAR, (-0.399, 0.003, 1.760)),
    ("nuscenes_cameras", "front", NUSCENES, (1.701, 0.016, 1.511)),
    ("nuscenes_cameras", "front_left", NUSCENES, (1.524, 0.495, 1.509)),
    ("nuscenes_cameras", "front_right", NUSCENES, (1.551, -0.493, 1.496)),
    ("nuscenes_cameras", "back_left", NUSCENES, (1.036, 0.485, 1.591)),
    ("nuscenes_cameras", "back_right", NUSCENES, (1.015, -0.481, 1.562)),
    ("nuscenes_cameras", "back", NUSCENES, (0.028, 0.003, 1.579)),
    ("waymo_cameras", "front", WAYMO, (1.539, -0.024, 2.115)),
    ("waymo_cameras", "side_left", WAYMO, (1.432, 0.111, 2.115)),
    ("waymo_cameras", "side_right", WAYMO, (1.428, -0.112, 2.116)),
    ("argoverse2_cameras", "ring_front_center", ARGOVERSE, (1.635, 0.003, 1.398)),
    ("argoverse2_cameras", "ring_front_left", ARGOVERSE, (1.546, 0.204, 1.394)),
    ("argoverse2_cameras", "ring_side_left", ARGOVERSE, (1.306, 0.276, 1.407)),
    ("argoverse2_cameras", "ring_rear_left", ARGOVERSE, (1.090, 0.126, 1.419)),
    ("argoverse2_cameras", "stereo_front_left", ARGOVERSE, (1.625, 0.251, 1.191)),
    ("argoverse2_cameras", "stereo_front_right", ARGOVERSE, (1.631, -0.248, 1.190)),
    ("kitti_cameras", "colour_left", KITTI, (1.03, 0.06, 1.65)),
    ("edgar_cameras", "front_center", EDGAR, (2.394, -0.008, 1.748)),
    ("edgar_cameras", "rear_left", EDGAR, (-0.356, 0.853, 1.746)),
]

# Rig, x, y, z as published in CARLA's frame (y right).
CARLA = {
    "hu2022_center": ((0, 0, 0, 0), (0, 0, 0, 0), (2.4, 2.6, 2.8, 3.0)),
    "hu2022_line": ((0, 0, 0, 0), (-0.6, -0.4, 0.4, 0.6), (2.2,) * 4),
    "hu2022_line_roll": ((0, 0, 0, 0), (-0.6, -0.4, 0.4, 0.6), (2.2,) * 4),
    "hu2022_square": ((-0.5, -0.5, 0.5, 0.5), (0.5, -0.5, 0.5, -0.5), (2.2,) * 4),
    "hu2022_pyramid": ((-0.2, 0.4, -0.2, -0.2), (-0.6, 0, 0, 0.6), (2.2, 2.4, 2.6, 2.2)),
    "hu2022_pyramid_roll": ((-0.2, 0.4, -0.2, -0.2), (-0.6, 0, 0, 0.6), (2.2, 2.4, 2.6, 2.2)),
    "hu2022_pyramid_pitch": ((-0.2, 0.4, -0.2, -0.2), (-0.6, 0, 0, 0.6), (2.2, 2.4, 2.6, 2.2)),
    "hu2022_trapezoid": ((-0.4, -0.4, 0.2, 0.2), (0.2, -0.2, 0.5, -0.5), (2.2,) * 4),
    "place3d_1x64": ((0, 0), (0, 0), (2.0, 2.0)),
    "place3d_center": ((0, 0, 0, 0), (0, 0, 0, 0), (1.8, 2.0, 2.2, 2.4)),
    "place3d_line": ((0, 0, 0, 0), (-0.6, -0.4, 0.4, 0.6), (1.8, 2.2, 2.2, 1.8)),
    "place3d_pyramid": ((-0.8, 0.2, -0.6, -0.8), (-0.6, 0, 0, 0.6), (1.8, 2.0, 2.4, 1.8)),
    "place3d_square": ((-1, -1, 0.2, 0.2), (0.5, -0.5, 0.5, -0.5), (2.0, 2.0, 2.2, 2.2)),
    "place3d_trapezoid": ((-0.6, -0.6, 0.2, 0.2), (0.6, -0.6, 0.4, -0.4), (2.0, 2.0, 1.8, 1.8)),
    "place3d_optimised_detection": ((0.5, -0.4, 0, -0.1), (0.5, 0.1, 0, -0.5), (2.5, 2.6, 2.8, 2.7)),
    "place3d2024_center": ((0, 0, 0, 0), (0, 0, 0, 0), (2.2, 2.4, 2.6, 2.8)),
    "place3d2024_line": ((0, 0, 0, 0), (-0.6, -0.4, 0.4, 0.6), (2.2,) * 4),
    "place3d2024_pyramid": ((-0.2, 0.4, -0.2, -0.2), (-0.6, 0, 0, 0.6), (2.2, 2.4, 2.6, 2.2)),
    "place3d2024_square": ((-0.5, -0.5, 0.5, 0.5), (0.5, -0.5, 0.5, -0.5), (2.2,) * 4),
    "place3d2024_trapezoid": ((-0.4, -0.4, 0.2, 0.2), (0.2, -0.2, 0.5, -0.5), (2.2,) * 4),
    "place3d2024_line_roll": ((0, 0, 0, 0), (-0.6, -0.4, 0.4, 0.6), (2.2,) * 4),
    "place3d2024_pyramid_roll": ((-0.2, 0.4, -0.2, -0.2), (-0.6, 0, 0, 0.6), (2.2, 2.4, 2.6, 2.2)),
    "place3d2024_optimised_detection": ((0.5, -0.4, 0, -0.1), (0.5, 0.1, 0, -0.5), (2.5, 2.6, 2.8, 2.7)),
    "place3d2024_optimised_segmentation": ((0, 0.6, 0.4, 0.1), (0.5, 0.3, 0, -0.6), (2.6, 2.8, 2.5, 2.8)),
}
# Roll in radians in CARLA; a positive roll lowers the right side, as in this package.
ROLLS = {
    "hu2022_line_roll": (-0.28, 0, 0, 0.28),
    "hu2022_pyramid_roll": (-0.28, 0, 0, 0.28),
    "place3d_optimised_detection": (-0.3, -0.2, 0, 0),
    "place3d2024_line_roll": (-0.3, 0, 0, -0.3),
    "place3d2024_pyramid_roll": (-0.3, 0, 0, -0.3),
    "place3d2024_optimised_detection": (-0.3, -0.2, 0, 0),
    "place3d2024_optimised_segmentation": (-0.3, 0, 0, 0.2),
}
# Placements with a second rig that reads the rolls as degrees.
IN_DEGREES = [name for name in ROLLS if name.startswith("place3d2024")]


def get_mount_matrix(rig, sensor):
    (matched,) = [candidate for candidate in Rig.load(rig).sensors if candidate.name == sensor]
    return matched.mount.to_matrix()


def compute_direction_deg(matrix, direction=(1.0, 0.0, 0.0)):
    """Convert a direction of the sensor frame to azimuth and elevation in degrees in the vehicle frame."""
    x, y, z = matrix[:3, :3] @ direction
    return np.rad2deg(np.arctan2(y, x)), np.rad2deg(np.arcsin(z))


@pytest.mark.parametrize("name", RIGS)
def test_descriptions_state_the_source_and_sensors_have_names(name):
    rig = Rig.load(name)
    assert rig.name == name
    assert any(word in rig.description for word in ("/", "assumption"))


@pytest.mark.parametrize("name", RIGS)
def test_sensors_lie_outside_the_vehicle_and_above_ground(name):
    rig = Rig.load(name)
    sensors = rig.sensors
    positions = np.array([sensor.mount.to_matrix()[:3, 3] for sensor in sensors])
    # A camera is smaller than a LiDAR, and may sit right on the body.
    room_m = np.array([0.03 if sensor.type == "lidar" else 0.0 for sensor in sensors])
    assert (positions[:, 2] > 0.3).all()
    for part in Vehicle.load(rig.vehicle or "suv").parts:
        for mesh in part.build_meshes():
            # Parts are convex: a point inside lies behind every face.
            a, b, c = (mesh.vertices_m[mesh.faces[:, corner]] for corner in range(3))
            normals = np.cross(b - a, c - a)
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            distance = ((positions[:, None] - a) * normals).sum(2).max(1)
            assert (distance > room_m).all()


@pytest.mark.parametrize(("rig", "sensor", "frame", "published"), REAR_AXLE)
def test_positions_match_the_source(rig, sensor, frame, published):
    before_axle, axle_height = frame
    np.testing.assert_allclose(
        get_mount_matrix(rig, sensor)[:3, 3] + [before_axle, 0.0, -axle_height], published, atol=6e-4
    )


@pytest.mark.parametrize("rig", CARLA)
def test_carla_positions_have_left_and_right_exchanged(rig):
    positions = np.array([sensor.mount.to_matrix()[:3, 3] for sensor in Rig.load(rig).sensors])
    np.testing.assert_allclose((positions * [1, -1, 1]).T, CARLA[rig], atol=1e-9)


@pytest.mark.parametrize("rig", CARLA)
def test_carla_roll_lowers_the_right_axis(rig):
    rolls = ROLLS.get(rig, (0,) * len(CARLA[rig][0]))
    for sensor, roll in zip(Rig.load(rig).sensors, rolls, strict=True):
        right = sensor.mount.to_matrix()[:3, :3] @ [0, -1, 0]
        assert right[2] == pytest.approx(-np.sin(roll), abs=1e-5)


@pytest.mark.parametrize("name", IN_DEGREES)
def test_roll_readings_differ_only_in_the_unit(name):
    radians, degrees = Rig.load(name), Rig.load(f"{name}_degrees")
    for sensor, degrees_sensor, roll in zip(radians.sensors, degrees.sensors, ROLLS[name], strict=True):
        assert degrees_sensor.mount.roll_deg == roll
        assert degrees_sensor.model_copy(update={"mount": sensor.mount}) == sensor
        assert degrees_sensor.mount.model_copy(update={"roll_deg": sensor.mount.roll_deg}) == sensor.mount
    assert "Doubt about the unit" in radians.description
    assert "Doubt about the unit" in degrees.description


def test_place3d_placements_use_the_lidar_of_place3d():
    placements = [name for name in RIGS if name.startswith("place3d2024_")]
    assert len(placements) == 9 + len(IN_DEGREES)
    for name in placements:
        for sensor in Rig.load(name).sensors:
            rows = sensor.compute_elevations_deg()
            assert (len(rows), rows.min(), rows.max()) == (16, pytest.approx(-24.8), pytest.approx(2.0))
            assert (sensor.columns, sensor.max_range_m, sensor.horizontal_fov_deg) == (250, 100.0, 360.0)
    for name in RIGS:
        if name.startswith("place3d_"):
            assert "no mAP has been published" in Rig.load(name).description


def test_the_pitched_placement_looks_down():
    front = Rig.load("hu2022_pyramid_pitch").sensors[1].mount.to_matrix()
    assert compute_direction_deg(front)[1] == pytest.approx(np.rad2deg(-0.09), abs=1e-3)


@pytest.mark.parametrize(
    ("rig", "sensor", "azimuth", "elevation"),
    [
        ("nuscenes", "top", 0.1, -1.39),
        ("waymo", "side_left", 88.8, 0.0),
        ("waymo", "side_right", -92.2, 0.0),
        ("waymo", "rear", 178.4, 0.0),
        # The source turns the z axis outwards: 90 degrees less 1.369065 rad, and 1.7552732 rad less 90 degrees.
        ("edgar", "innovusion_front", 0.0, -11.558),
        ("edgar", "innovusion_rear", 180.0, -10.570),
    ],
)
def test_sensor_directions_match_the_source(rig, sensor, azimuth, elevation):
    direction_deg = compute_direction_deg(get_mount_matrix(rig, sensor))
    assert (direction_deg[0] - azimuth + 180) % 360 - 180 == pytest.approx(0.0, abs=1e-3)
    assert direction_deg[1] == pytest.approx(elevation, abs=1e-3)


@pytest.mark.parametrize(
    ("rig", "sensor", "azimuth"),
    [
        ("nuscenes_cameras", "front", 0.3),
        ("nuscenes_cameras", "front_left", 55.2),
        ("nuscenes_cameras", "front_right", -56.4),
        ("nuscenes_cameras", "back_left", 108.6),
        ("nuscenes_cameras", "back_right", -110.8),
        ("nuscenes_cameras", "back", 179.9),
        ("waymo_cameras", "front", 0.2),
        ("waymo_cameras", "front_left", 44.2),
        ("waymo_cameras", "front_right", -44.6),
        ("waymo_cameras", "side_left", 89.2),
        ("waymo_cameras", "side_right", -90.1),
        ("argoverse2_cameras", "ring_front_center", 0.0),
        ("argoverse2_cameras", "ring_front_left", 45.0),
        ("argoverse2_cameras", "ring_front_right", -45.0),
        ("argoverse2_cameras", "ring_side_left", 99.2),
        ("argoverse2_cameras", "ring_side_right", -98.9),
        ("argoverse2_cameras", "ring_rear_left", 153.1),
        ("argoverse2_cameras", "ring_rear_right", -152.8),
    ],
)
def test_camera_directions_match_the_source_and_are_upright(rig, sensor, azimuth):
    matrix = get_mount_matrix(rig, sensor)
    direction_deg = compute_direction_deg(matrix)
    assert direction_deg[0] == pytest.approx(azimuth, abs=0.1)
    assert abs(direction_deg[1]) < 3.5
    assert matrix[2, 2] > 0.99


def test_kittis_cameras_have_their_baselines():
    left, right, colour_left, colour_right = (sensor.mount.y_m for sensor in Rig.load("kitti_cameras").sensors)
    assert left - right == pytest.approx(0.54)
    assert colour_left - colour_right == pytest.approx(0.54)
    assert colour_left - left == pytest.approx(0.06)


@pytest.mark.parametrize("rig", [name for name in RIGS if name.endswith("_cameras")])
def test_published_cameras_have_a_ray_per_pixel(rig):
    for sensor in Rig.load(rig).sensors:
        assert np.isfinite(sensor.compute_directions()).all()
    if rig != "three_cameras":
        lidars = Rig.load(rig.removesuffix("_cameras"))
        assert {sensor.type for sensor in lidars.sensors} == {"lidar"}


def test_edgar_lidars_have_the_rotation_of_the_urdf():
    for sensor, (roll, pitch, yaw) in {
        "ouster_left": (-0.3461248, 0.0165291, -0.0162606),
        "ouster_right": (0.3551248, 0.0165291, 0.0061281),
    }.items():
        (cr, sr), (cp, sp), (cy, sy) = ((np.cos(angle), np.sin(angle)) for angle in (roll, pitch, yaw))
        about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
        about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        np.testing.assert_allclose(get_mount_matrix("edgar", sensor)[:3, :3], about_z @ about_y @ about_x, atol=2e-5)


def test_argoverses_lower_lidar_hangs_upside_down():
    matrix = get_mount_matrix("argoverse2", "down_lidar")
    np.testing.assert_allclose(matrix[:3, :3] @ [0, 0, 1], [0, 0, -1], atol=1e-12)
    assert compute_direction_deg(matrix)[0] == pytest.approx(-11.6)


def test_roof_rigs_differ_only_in_their_rows():
    roofs = {rows: Rig.load(f"front_roof_{rows}").sensors[0] for rows in (32, 64, 128)}
    for rows, sensor in roofs.items():
        assert len(sensor.compute_elevations_deg()) == rows
        assert sensor.model_copy(update={"channels": 128}) == roofs[128]


@pytest.mark.parametrize("rig", sorted(set(RIGS) - {"front_grille_128"}))
def test_rays_reach_the_ground_in_front(rig):
    """With a gross error of a mount, such as a roll of 180 degrees, no ray hits the road ahead."""
    reached = 0
    for sensor in Rig.load(rig).sensors:
        matrix, directions = sensor.mount.to_matrix(), sensor.compute_directions().reshape(3, -1)
        ends = transform_points(matrix, directions.T)
        origin = matrix[:3, 3]
        fall = origin[2] - ends[:, 2]
        distance = np.divide(origin[2], fall, out=np.full_like(fall, np.inf), where=fall > 1e-3)
        road = origin + np.minimum(distance, 1e6)[:, None] * (ends - origin)
        ahead = (distance < sensor.max_range_m) & (road[:, 0] > 4) & (road[:, 0] < 40) & (np.abs(road[:, 1]) < 2)
        reached += int(ahead.sum())
    assert reached > 100
