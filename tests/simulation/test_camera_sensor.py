"""Cameras in a scene: depth image and cloud describe the same hits."""

import numpy as np
import pytest
import torch

from tests.simulation.small_scenarios import AHEAD, FLOOR, scenario
from torchcover import Rig
from torchcover.data import SimulatedFrames
from torchcover.simulation import CameraSensor, PaperReference, RayHits, Scenario, SensorNoise, SurfaceReference
from torchcover.simulation.rays import split_into_tiles
from torchcover.simulation.scene_geometry import SceneGeometry

LENSES = {
    "pinhole": {"fov_deg": 100.0},
    "brown_conrady": {"lens": "brown_conrady", "coefficients": [-0.25, 0.05, 1e-3, -5e-4]},
    "kannala_brandt": {"lens": "kannala_brandt", "coefficients": [0.05, -0.01, 0.0, 0.0]},
    "double_sphere": {"lens": "double_sphere", "coefficients": [-0.2, 0.6]},
}


def camera(kind="pinhole", /, **changes):
    intrinsics = {} if kind == "pinhole" else {"fx": 60.0, "fy": 62.0, "cx": 79.0, "cy": 61.5}
    content = {
        "type": "camera",
        "name": "front",
        "mount": {"x_m": 1.0, "y_m": 0.2, "z_m": 1.9, "yaw_deg": 20.0, "pitch_deg": 10.0, "roll_deg": -5.0},
        "width": 160,
        "height": 120,
        "max_range_m": 60.0,
        **intrinsics,
        **LENSES[kind],
    }
    return CameraSensor(**{**content, **changes})


@pytest.mark.parametrize("lens", LENSES)
def test_unprojected_depth_images_equal_the_hits(lens):
    sensor = camera(lens)
    snapshot = SceneGeometry(Scenario.load("courtyard").build_scene()).get_snapshot(0)
    vehicle_T_mount = sensor.mount.to_matrix()
    image = snapshot.render_range_image(vehicle_T_mount, sensor.compute_directions(), max_range_m=60.0)
    model = sensor.build_camera()
    cloud = model.to_vehicle(model.unproject(torch.from_numpy(image), depth_kind="distance")).numpy()
    tiles = split_into_tiles(sensor.compute_directions())
    scan = snapshot.scan(vehicle_T_mount, tiles, max_range_m=60.0)
    # The image shows the hood of the ego vehicle, the scan excludes it.
    assert len(cloud) == len(scan.points) + scan.self_hits
    in_order = lambda points: points[np.lexsort(points.round(2).T)]  # noqa: E731
    x, y, z = cloud.T
    on_ego = (np.abs(x) < 2.46) & (np.abs(y) < 0.98) & (z > 0.2) & (z < 1.64)
    assert on_ego.sum() == scan.self_hits
    from_image, from_scan = in_order(cloud[~on_ego]), in_order(scan.points)
    apart = torch.cdist(torch.from_numpy(from_image[::7]).double(), torch.from_numpy(from_scan).double()).min(dim=1)
    assert apart.values.max() < 1e-4


def test_outermost_pixels_define_the_field_of_view():
    # 100 degrees to the edges of the outermost pixels; their centers lie half a pixel inside.
    expected = 2 * np.rad2deg(np.arctan(np.tan(np.deg2rad(50)) * 159 / 160))
    assert camera(mount={}).horizontal_fov_deg == pytest.approx(expected, abs=0.02)


def test_pixels_without_a_ray_are_not_counted():
    # The distortion cannot be inverted beyond a circle within the image.
    folded = camera("brown_conrady", coefficients=[-0.35, 0.0, 0.0, 0.0])
    missing = int(np.isnan(folded.compute_directions()[0]).sum())
    assert 0 < missing < 160 * 120
    frames = SimulatedFrames(
        "courtyard", Rig(name="r", sensors=(folded,)), num_frames=1, reference_sensor=PaperReference(8, 8)
    )
    assert frames[0].counts["sensor_rays"] == 160 * 120 - missing
    assert frames[0].sensor.isfinite().all()
    image = (
        frames.simulator.get_scene_geometry(0)[0]
        .get_snapshot(0)
        .render_range_image(np.eye(4) @ folded.mount.to_matrix(), folded.compute_directions())
    )
    assert np.isnan(image).sum() == missing


def test_stride_takes_every_nth_row_and_column():
    np.testing.assert_array_equal(camera(stride=3).compute_directions(), camera().compute_directions()[:, ::3, ::3])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fov_deg": None}, "intrinsics are missing"),
        ({"fx": 50.0}, "give one or the other"),
        ({"lens": "mei", "coefficients": [0.1]}, "give one or the other"),
        ({"min_range_m": 70.0}, "must be below max_range_m"),
        ({"fov_deg": 180.0}, "a number below 180"),
        ({"fov_deg": None, "fx": 50, "fy": 50, "cx": 80, "cy": 60, "lens": "magic"}, "magic"),
        ({"fov_deg": None, "fx": 50, "fy": 50, "cx": 80, "cy": 60, "lens": "mei", "coefficients": [1, 2]}, "mei"),
        ({"stereo": {"baseline_m": 0.0, "subpixel_px": 0.2}}, r"stereo\.baseline_m: a number above 0"),
        ({"stereo": {"baseline_m": 0.3, "subpixel_px": -0.2}}, r"stereo\.subpixel_px: a number above 0"),
        ({"range_noise_share": 1.0}, r"range_noise_share: a number below 1"),
        ({"range_noise_m": 60.0}, r"range_noise_m \(60\.0\) must be below max_range_m \(60\.0\)"),
    ],
)
def test_an_impossible_camera_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        camera(**changes)


def test_depth_error_follows_the_stereo_model():
    pair = {"baseline_m": 0.3, "subpixel_px": 0.25}
    sensor = camera(stereo=pair, range_noise_share=0.03, range_noise_m=0.04, width=500, fov_deg=90.0)  # f is 250 px
    range_m = np.array([1.0, 10.0, 59.0])
    stereo_m = range_m**2 * 0.25 / (250 * 0.3)
    np.testing.assert_allclose(
        sensor.compute_noise_std_m(range_m), np.sqrt(stereo_m**2 + (0.03 * range_m) ** 2 + 0.04**2)
    )
    ray = np.arange(5000)
    hits = RayHits(ray, np.full(5000, 50.0), ray)
    _, error_m = sensor.measure(hits, SensorNoise(np.random.default_rng(0)))
    assert error_m[error_m > -50].std() == pytest.approx(float(sensor.compute_noise_std_m(np.array(50.0))), rel=0.05)
    wild = camera(stereo={**pair, "subpixel_px": 20.0}).measure(hits, SensorNoise(np.random.default_rng(0)))
    assert wild.range_error_m.min() == -50.0
    assert camera(stereo=None).is_exact
    assert not camera(range_noise_share=0.1).is_exact


def test_point_counts_are_pixels_of_the_full_image():
    car = {"category": "car", "shape": {"type": "box", "size_m": [4, 2, 1.5]}, "name": "car", "pose": {"x_m": 9.0}}
    made = scenario(FLOOR, actors=[car])
    rigs = {
        str(stride): Rig(
            name="r", sensors=(camera(stride=stride, mount={"x_m": 2.1, "z_m": 1.7}, width=640, height=480),)
        )
        for stride in (1, 2, 5)
    }
    reference_sensor = SurfaceReference((AHEAD,), num_rays=50)
    (frame,) = SimulatedFrames(made, rigs=rigs, num_frames=1, reference_sensor=reference_sensor, boxes=True)
    full, *strided = (int(hits) for hits in frame.boxes.points_in_box.values())
    assert full > 5000
    assert strided == pytest.approx([full, full], rel=0.05)
