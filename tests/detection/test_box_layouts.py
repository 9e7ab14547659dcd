"""Boxes as others write them down, against corners in closed form."""

import math

import numpy as np
import pytest
import torch

from torchcover.detection import Boxes
from torchcover.detection.boxes import build_upright_rows
from torchcover.geometry import build_transform, convert_euler_to_rotation

RANDOM = np.random.default_rng(11)


def test_upright_boxes_keep_centers_and_headings_when_transformed():
    center_m, size_m = RANDOM.normal(size=(6, 3)), RANDOM.uniform(1.0, 5.0, (6, 3))
    yaw = RANDOM.uniform(-3.0, 3.0, 6)
    heading = np.stack([np.cos(yaw), np.sin(yaw), np.zeros(6)], axis=1)
    same = build_upright_rows(center_m, size_m, heading, None)
    assert same.numpy() == pytest.approx(np.column_stack([center_m, size_m, yaw]), abs=1e-6)
    vehicle_T_source = build_transform(convert_euler_to_rotation(90.0, 0.0, 0.0), np.array([10.0, 0.0, 1.0]))
    turned = build_upright_rows(center_m, size_m, heading, vehicle_T_source).numpy()
    x, y, z = center_m.T
    assert turned[:, :3] == pytest.approx(np.column_stack([10.0 - y, x, 1.0 + z]), abs=1e-5)
    assert turned[:, 3:6] == pytest.approx(size_m, abs=1e-6)
    assert np.cos(turned[:, 6] - yaw - np.pi / 2) == pytest.approx(1.0)


def test_headings_keep_the_precision_of_short_numbers():
    heading = np.array([[0.6, 0.8, 0.0]], dtype=np.float16)
    (row,) = build_upright_rows(np.ones((1, 3), np.float16), np.ones((1, 3), np.float16), heading, None)
    assert row[6].item() == pytest.approx(math.atan2(*map(float, heading[0, 1::-1])), abs=1e-6)


def test_no_boxes_are_none():
    assert build_upright_rows([], [], [], None).shape == (0, 7)
    assert len(Boxes.from_kitti_label([])) == 0


@pytest.mark.parametrize(("at", "value", "message"), [
    (0, [[0.0, 0.0, np.nan], [0.0, 0.0, 0.0]], "centers of boxes: 1 of 2 are not finite"),
    (1, [[1.0, 2.0], [1.0, 2.0]], r"sizes of boxes: shape \(K, 3\) is needed; got \(2, 2\)"),
    (2, [1.0, 0.0, 0.0], r"headings of boxes: shape \(K, 3\) is needed; got \(3,\)"),
    (2, [[1.0, 0.0, 0.0]], "equal numbers of centers, sizes and headings are needed; got 2, 2 and 1"),
])  # fmt: skip
def test_what_is_no_list_of_boxes_is_refused(at, value, message):
    given = [np.ones((2, 3)).tolist() for _ in range(3)]
    given[at] = value
    with pytest.raises(ValueError, match=message):
        build_upright_rows(*given, None)


def test_kitti_labels_give_the_bottom_center():
    # Height 1.5, width 1.8, length 4.2; bottom at x right 2, y down 1.6, z ahead 20; turned to the camera's right.
    label = [0.0, 0.0, 0.0, 0, 0, 10, 10, 1.5, 1.8, 4.2, 2.0, 1.6, 20.0, 0.0]
    axes = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    (row,) = Boxes.from_kitti_label([label], build_transform(axes, np.array([0.0, 0.0, 1.7]))).rows
    assert row.tolist() == pytest.approx([20.0, -2.0, 1.7 - 1.6 + 0.75, 4.2, 1.8, 1.5, -np.pi / 2], abs=1e-6)
    turned = list(label)
    turned[-1] = -np.pi / 2  # along the camera's view
    (row,) = Boxes.from_kitti_label([turned], build_transform(axes, np.zeros(3))).rows
    assert row[6].item() == pytest.approx(0.0, abs=1e-6)
    assert torch.equal(Boxes.from_rows(row[None]).rows[0], row)


def test_kitti_occlusion_levels_become_visible_shares():
    labels = np.ones((5, 14))
    labels[:, 1] = 0, 1, 2, 3, -1  # fully visible, partly and largely occluded, unknown
    visibility = Boxes.from_kitti_label(labels).visibility
    torch.testing.assert_close(visibility, torch.tensor([0.9, 0.6, 0.2, math.nan, math.nan]), equal_nan=True)


def test_labels_at_once_are_those_one_by_one():
    labels = np.random.default_rng(0).normal(size=(5, 14))
    labels[:, 7:10] = np.abs(labels[:, 7:10])
    camera = build_transform(convert_euler_to_rotation(-87.0, 2.0, -91.0), np.array([0.3, -0.2, 1.7]))
    together = Boxes.from_kitti_label(labels, camera).rows
    assert together.shape == (5, 7)
    torch.testing.assert_close(together, torch.cat([Boxes.from_kitti_label([one], camera).rows for one in labels]))


@pytest.mark.parametrize("shape", [(14, 15), (13, 15), (28, 7), (14,), (2, 2, 14)])
def test_labels_of_kitti_have_14_numbers_each(shape):
    with pytest.raises(ValueError, match=rf"label_values: shape \(K, 14\) is needed, .* got \({shape[0]},"):
        Boxes.from_kitti_label(np.ones(shape))
    assert len(Boxes.from_kitti_label([])) == 0
