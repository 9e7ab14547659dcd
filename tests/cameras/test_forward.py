"""The forward models against OpenCV, kornia and the formulas of the papers."""

import cv2
import numpy as np
import pytest
import torch
from kornia.geometry.camera.distortion_kannala_brandt import distort_points_kannala_brandt

from torchcover.cameras import Camera

INTRINSICS = (520.0, 510.0, 318.0, 242.0)
MATRIX = np.array([[520.0, 0.0, 318.0], [0.0, 510.0, 242.0], [0.0, 0.0, 1.0]])
BROWN_CONRADY = [-0.2, 0.06, 1e-3, -2e-3, 0.01, 0.02, -0.01, 0.003, 2e-3, -1e-3, 1e-3, 2e-3, 0.03, -0.02]


def make(model, coefficients):
    return Camera(640, 480, *INTRINSICS, model, coefficients)


def cone(degrees, count=400):
    generator = np.random.default_rng(7)
    angle = np.deg2rad(degrees) * np.sqrt(generator.uniform(0.0, 1.0, count))
    azimuth = generator.uniform(-np.pi, np.pi, count)
    points = np.stack((np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)), axis=1)
    return points * generator.uniform(0.5, 50.0, (count, 1))


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_brown_conrady_equals_opencv(count):
    points = cone(35.0)
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), MATRIX, np.array(BROWN_CONRADY[:count]))
    pixels, _ = make("brown_conrady", BROWN_CONRADY[:count]).project(torch.from_numpy(points))
    np.testing.assert_allclose(pixels.numpy(), expected[:, 0], rtol=0, atol=1e-9)


def test_kannala_brandt_equals_opencv():
    points, k = cone(85.0), np.array([0.03, -0.01, 0.004, -0.001])
    expected, _ = cv2.fisheye.projectPoints(points[None], np.zeros(3), np.zeros(3), MATRIX, k)
    pixels, _ = make("kannala_brandt", k.tolist()).project(torch.from_numpy(points))
    np.testing.assert_allclose(pixels.numpy(), expected[0], rtol=0, atol=1e-9)


def test_kannala_brandt_equals_kornia_where_defined():
    points, k = torch.from_numpy(cone(85.0)), [0.03, -0.01, 0.004, -0.001]
    parameters = torch.tensor([*INTRINSICS, *k], dtype=torch.float64)
    expected = distort_points_kannala_brandt(points[:, :2] / points[:, 2:], parameters)
    torch.testing.assert_close(make("kannala_brandt", k).project(points)[0], expected, rtol=0, atol=1e-9)


def test_the_polynomial_applies_near_the_axis():
    camera = Camera(640, 480, 20000.0, 20000.0, 0.0, 0.0, "kannala_brandt", [0.5, 0.0, 0.0, 0.0])
    x = 9.9e-5
    angle = np.arctan(x)
    pixels, _ = camera.project(torch.tensor([[x, 0.0, 1.0]], dtype=torch.float64))
    exact = 20000.0 * angle * (1.0 + 0.5 * angle**2)
    parameters = torch.tensor([20000.0, 20000.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0], dtype=torch.float64)
    kornias = distort_points_kannala_brandt(torch.tensor([x, 0.0], dtype=torch.float64), parameters)
    assert abs(pixels[0, 0].item() - exact) < 1e-14
    assert abs(kornias[0].item() - exact) > 1e-9


@pytest.mark.parametrize("count", [4, 5, 8, 12])
def test_linearized_distortion_equals_kornia(count):
    distortion = make("brown_conrady", BROWN_CONRADY[:count])._optics._solver.distortion
    a, b = np.random.default_rng(1).uniform(-0.8, 0.8, (2, 500))
    at = distortion.linearize(a, b)
    u, v = distortion.distort(torch.from_numpy(a), torch.from_numpy(b))
    np.testing.assert_allclose((at.u, at.v), (u.numpy(), v.numpy()), rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", ["barrel", "rational", "prism", "fisheye 190", "woodscape", "mei"])
def test_the_jacobian_is_the_derivative(name, make_camera):
    distortion = make_camera(name)._optics._solver.distortion
    a, b = (torch.from_numpy(x).requires_grad_() for x in np.random.default_rng(2).uniform(-0.4, 0.4, (2, 200)))
    u, v = distortion.distort(a, b)
    at = distortion.linearize(a.detach().numpy(), b.detach().numpy())
    u_a, u_b = torch.autograd.grad(u.sum(), (a, b), retain_graph=True)
    v_a, v_b = torch.autograd.grad(v.sum(), (a, b))
    for ours, theirs in ((at.u_a, u_a), (at.u_b, u_b), (at.v_a, v_a), (at.v_b, v_b)):
        np.testing.assert_allclose(ours, theirs.numpy(), rtol=1e-12, atol=1e-12)


def mei(p, xi, k1, k2, p1, p2):
    x, y, z = p / np.linalg.norm(p)
    x, y = x / (z + xi), y / (z + xi)
    s = x * x + y * y
    g = 1.0 + k1 * s + k2 * s * s
    return x * g + 2 * p1 * x * y + p2 * (s + 2 * x * x), y * g + p1 * (s + 2 * y * y) + 2 * p2 * x * y


def eucm(p, alpha, beta):
    x, y, z = p
    below = alpha * np.sqrt(beta * (x * x + y * y) + z * z) + (1.0 - alpha) * z
    return x / below, y / below


def double_sphere(p, xi, alpha):
    x, y, z = p
    d1 = np.sqrt(x * x + y * y + z * z)
    d2 = np.sqrt(x * x + y * y + (xi * d1 + z) ** 2)
    below = alpha * d2 + (1.0 - alpha) * (xi * d1 + z)
    return x / below, y / below


def theta_polynomial(p, k1, k2, k3, k4):
    x, y, z = p
    rho = np.hypot(x, y)
    t = np.arctan2(rho, z)
    gain = (k1 * t + k2 * t**2 + k3 * t**3 + k4 * t**4) / rho
    return x * gain, y * gain


@pytest.mark.parametrize(
    ("formula", "coefficients"),
    [
        (mei, [2.5, 0.05, 4.5, 1e-3, -7e-4]),
        (eucm, [0.6, 1.1]),
        (double_sphere, [-0.2, 0.57]),
        (theta_polynomial, [1.0, -0.1, 0.14, -0.02]),
    ],
)
def test_other_models_equal_their_papers(formula, coefficients):
    points = cone(100.0)
    pixels, _ = make(formula.__name__, coefficients).project(torch.from_numpy(points))
    expected = [np.array(formula(p, *coefficients)) * [520.0, 510.0] + [318.0, 242.0] for p in points]
    np.testing.assert_allclose(pixels.numpy(), expected, rtol=0, atol=1e-9)


def test_the_image_is_half_open(make_camera):
    camera = make_camera("pinhole")  # 64 x 48, fx 50, fy 60, cx 31, cy 25
    u = torch.tensor([-0.5, -0.5001, 63.4999, 63.5], dtype=torch.float64)
    points = torch.stack(
        ((u - 31.0) / 50.0, torch.zeros(4, dtype=torch.float64), torch.ones(4, dtype=torch.float64)), 1
    )
    pixels, visible = camera.project(points)
    assert visible.tolist() == [True, False, True, False]
    assert pixels.isfinite().all()


def test_points_without_an_image_are_nan(camera):
    bad = torch.tensor([[float("nan"), 0.0, 1.0], [0.0, float("inf"), 1.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])
    pixels, visible = camera.project(bad)
    assert not visible.any()
    assert pixels.isnan().all()


def test_rays_of_projected_directions_equal_them(camera, directions):
    pixels, visible = camera.project(3.0 * directions)
    # Also far outside the image, but not at the horizon, 1e16 px away, nor straight back, where azimuth is rounding.
    shown = (pixels.abs() < 1e5).all(dim=1) & (directions[:, 2] > -0.999)
    rays, valid = camera.rays(pixels[shown])
    assert shown[visible].all()
    assert valid.all()
    torch.testing.assert_close(rays, directions[shown], rtol=0, atol=1e-7)
