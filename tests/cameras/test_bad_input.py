"""Every mistake is named, with what arrived and what is allowed."""

import numpy as np
import pytest
import torch

from torchcover.cameras import Camera

INF, NAN = float("inf"), float("nan")
PLAIN = {"width": 8, "height": 6, "fx": 9.0, "fy": 9.0, "cx": 4.0, "cy": 3.0}
SHEARED = np.eye(4) + 0.1 * np.eye(4, k=1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 0}, "width must be a positive integer; got 0"),
        ({"height": 6.0}, "height must be a positive integer; got 6.0"),
        ({"fx": 0.0}, r"fx and fy must be positive; got \[0.0, 9.0\]"),
        ({"fy": -9.0}, "must be positive"),
        ({"cx": NAN}, "must be finite"),
        ({"model": "fish"}, "'fish' is unknown; allowed: pinhole, brown_conrady"),
        ({"model": "brown_conrady", "coefficients": [0.1] * 6}, "takes 4 or 5 or 8 or 12 or 14 .*k1 k2 p1 p2.*got 6"),
        ({"coefficients": [0.1]}, "takes 0 coefficients .*got 1"),
        ({"model": "kannala_brandt", "coefficients": [0.1, INF, 0.0, 0.0]}, "must be finite"),
        ({"model": "eucm", "coefficients": [1.5, 1.0]}, r"alpha must lie in \[0, 1\]; got 1.5"),
        ({"model": "eucm", "coefficients": [0.5, 0.0]}, "beta must lie in"),
        ({"model": "double_sphere", "coefficients": [2.0, 0.5]}, "xi must lie in"),
        ({"model": "double_sphere", "coefficients": [-1.0, 0.5]}, "xi must lie in"),
        ({"model": "mei", "coefficients": [-0.1]}, "xi must lie in"),
        ({"model": "theta_polynomial", "coefficients": [0.0, 1.0, 0.0, 0.0]}, "k1 must be positive"),
        ({"vehicle_T_camera": SHEARED, "name": "front"}, "front: vehicle_T_camera.*deviates from the identity by 0.1"),
        ({"vehicle_T_camera": np.eye(3)}, r"got shape \(3, 3\)"),
    ],
)
def test_a_camera_that_cannot_be(change, message):
    with pytest.raises(ValueError, match=message):
        Camera(**{**PLAIN, **change})


IMAGE = torch.ones(6, 8)


@pytest.mark.parametrize(
    ("depth", "options", "error", "message"),
    [
        (torch.ones(8, 6), {}, ValueError, r"depth must be \(6, 8\) or \(B, 6, 8\); got \(8, 6\)"),
        (torch.ones(1, 1, 6, 8), {}, ValueError, "depth must be"),
        (torch.ones(6, 8, dtype=torch.int32), {}, TypeError, "int32, whose unit is unknown"),
        (IMAGE, {"kind": "range"}, ValueError, "'range' is unknown; allowed: z, distance"),
        (IMAGE, {"stride": 0}, ValueError, "stride must be an integer of at least 1; got 0"),
        (IMAGE, {"valid": torch.ones(6, 8)}, TypeError, "valid must be boolean; got torch.float32"),
        (IMAGE, {"valid": torch.ones(6, 7, dtype=torch.bool)}, ValueError, r"valid must be \(6, 8\).*got \(6, 7\)"),
    ],
)
def test_a_depth_image_that_does_not_fit(depth, options, error, message):
    for method in (Camera(**PLAIN).unproject, Camera(**PLAIN).count_dropped):
        with pytest.raises(error, match=message):
            method(depth, **options)


@pytest.mark.parametrize("points", [torch.ones(3), torch.ones(4, 2), torch.ones(4, 3, dtype=torch.int64)])
def test_points_that_are_none(points):
    with pytest.raises(ValueError, match=r"points are floats \(N, 3\)"):
        Camera(**PLAIN).project(points)


def test_pixels_that_are_none():
    with pytest.raises(ValueError, match=r"pixels are floats \(..., 2\)"):
        Camera(**PLAIN).rays(torch.ones(3))


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(4), r"shape \(3, 3\); got \(4, 4\)"),
        ([[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], "no skew"),
        (np.zeros((3, 3)).tolist(), "never calibrated; calibrate it first"),
        ([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 2.0]], "0, 0, 1"),
    ],
)
def test_a_matrix_that_is_no_camera(matrix, message):
    with pytest.raises(ValueError, match=message):
        Camera.from_matrix(matrix, 8, 6)


@pytest.mark.parametrize("fov", [0.0, 180.0, NAN])
def test_a_field_of_view_that_is_none(fov):
    with pytest.raises(ValueError, match="between 0 and 180 degrees"):
        Camera.from_fov(8, 6, fov)
