"""Depth images to points."""

import pickle

import numpy as np
import pytest
import torch

from torchcover.cameras import Camera, convert_carla_pose
from torchcover.geometry import transform_points

INF, NAN = float("inf"), float("nan")


def depth_for(camera, dtype=torch.float64):
    generator = torch.Generator().manual_seed(3)
    return 1.0 + 20.0 * torch.rand(camera.height, camera.width, generator=generator, dtype=dtype)


def test_distance_is_the_length_of_the_point(camera):
    depth = depth_for(camera)
    points = camera.unproject(depth, "distance")
    torch.testing.assert_close(points.norm(dim=1), depth[camera.rays()[1]])


def test_z_depth_is_the_third_coordinate(camera):
    depth = depth_for(camera)
    rays, valid = camera.rays(dtype=torch.float64)
    front = valid & (rays[..., 2] > 0)
    torch.testing.assert_close(camera.unproject(depth, "z")[:, 2], depth[front])
    assert camera.count_excluded(depth)["no_ray"] == int((~front).sum())


def test_stride_takes_every_nth_row_and_column(make_camera):
    camera = make_camera("crooked fold")
    depth = depth_for(camera)
    chosen = torch.zeros(depth.shape, dtype=torch.bool)
    chosen[::3, ::3] = True
    assert torch.equal(camera.unproject(depth, stride=3), camera.unproject(depth, valid_mask=chosen))


def test_a_batch_is_its_images(make_camera):
    camera = make_camera("fold")
    batch = torch.stack([depth_for(camera), depth_for(camera) - 5.0, torch.zeros(72, 96, dtype=torch.float64)])
    masks = torch.rand(batch.shape, generator=torch.Generator().manual_seed(1)) > 0.3
    for valid in (None, masks[0], masks):
        clouds = camera.unproject(batch, valid_mask=valid)
        own = [valid] * 3 if valid is None or valid.ndim == 2 else valid
        assert len(clouds) == 3
        assert len(clouds[2]) == 0
        for cloud, image, mask in zip(clouds, batch, own, strict=True):
            assert torch.equal(cloud, camera.unproject(image, valid_mask=mask))


BAD = {"zero": 0.0, "negative": -1.0, "nan": NAN, "infinite": INF, "beyond_range": 80.0}


@pytest.mark.parametrize("reason", BAD)
@pytest.mark.parametrize("kind", ["z", "distance"])
def test_bad_depths_are_counted_without_points(reason, kind):
    camera = Camera.from_fov(6, 4, 90.0)
    depth = torch.full((4, 6), 2.0)
    depth[1, 2] = depth[3, 5] = BAD[reason]
    assert len(camera.unproject(depth, kind, max_depth_m=50.0)) == 22
    counts = camera.count_excluded(depth, kind, max_depth_m=50.0)
    assert {name: count for name, count in counts.items() if count} == {f"depth_{reason}": 2}


@pytest.mark.parametrize("shape", [(72, 96), (2, 72, 96)])
def test_points_and_reasons_add_up_to_the_pixels(make_camera, shape):
    camera = make_camera("crooked fold")
    generator = torch.Generator().manual_seed(5)
    values = torch.tensor([2.0, 60.0, 0.0, -1.0, NAN, INF, -INF])
    depth = values[torch.randint(len(values), shape, generator=generator)]
    valid = torch.rand(72, 96, generator=generator) > 0.2
    clouds = camera.unproject(depth, stride=2, valid_mask=valid, max_depth_m=50.0)
    points = sum(len(cloud) for cloud in clouds) if depth.ndim == 3 else len(clouds)
    counts = camera.count_excluded(depth, stride=2, valid_mask=valid, max_depth_m=50.0)
    assert points + sum(counts.values()) == depth[..., ::2, ::2].numel()
    assert min(counts.values()) > 0


def test_the_input_is_left_alone(make_camera):
    depth = torch.tensor([[1.0, NAN], [0.0, INF]]).repeat(24, 32)
    before = depth.clone()
    make_camera("pinhole").unproject(depth)
    assert torch.equal(depth.nan_to_num(7.0), before.nan_to_num(7.0))


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_the_cloud_has_the_dtype_of_the_depth(make_camera, dtype):
    points = make_camera("pinhole").unproject(torch.ones(48, 64, dtype=dtype))
    assert points.dtype == (torch.float32 if dtype == torch.float16 else dtype)


def test_a_pickled_camera_is_small_and_the_same():
    camera = Camera(320, 240, 200.0, 200.0, 159.5, 119.5, "brown_conrady", [-0.28, 0.07, 2e-4, 2e-5])
    table = camera.rays()[0]
    payload = pickle.dumps(camera)
    assert len(payload) < table.nbytes / 2
    assert torch.equal(pickle.loads(payload).rays()[0], table)


def test_points_move_between_camera_and_vehicle():
    pose = convert_carla_pose([1.5, 0.2, 2.8], pitch_deg=-10.0, yaw_deg=30.0)
    camera = Camera.from_fov(6, 4, 90.0, vehicle_T_camera=pose)
    points = camera.unproject(torch.full((4, 6), 3.0, dtype=torch.float64))
    moved = camera.to_vehicle(points)
    np.testing.assert_allclose(moved.numpy(), transform_points(pose, points.numpy()), atol=1e-12)
    torch.testing.assert_close(camera.to_camera(moved), points)
