"""Gradients through the solution of the lens, against finite differences."""

import pytest
import torch

from torchcover.cameras import Camera

PIXELS = torch.tensor([[20.0, 15.0], [40.25, 30.5], [47.0, 35.0], [70.0, 50.0]], dtype=torch.float64)
MODELS = {
    "pinhole": [],
    "brown_conrady": [-0.28, 0.07, 2e-3, 1e-3, 0.01],
    "brown_conrady rational": [0.2, 0.1, 1e-3, -1e-3, 0.01, 0.15, 0.05, 0.01],
    "brown_conrady tilted": [-0.2, 0.05, 1e-3, -1e-3, 0.01, 0, 0, 0, 0.01, 0.002, -0.01, 0.001, 0.05, -0.03],
    "brown_conrady idle": [0.0, 0.0, 0.0, 0.0],
    "kannala_brandt": [-0.02, 0.003, -0.001, 0.0001],
    "mei": [1.2, 0.05, -0.02, 1e-3, -7e-4],
    "eucm": [0.59, 1.12],
    "double_sphere": [-0.17, 0.59],
}


def vector(values):
    return torch.tensor(values, dtype=torch.float64, requires_grad=len(values) > 0)


@pytest.fixture(params=MODELS)
def lens(request):
    """A function of intrinsics and coefficients that makes the camera, and both."""
    model = request.param.split()[0]

    def build(intrinsics, coefficients):
        return Camera(96, 72, *intrinsics, model, coefficients)

    return build, vector([60.0, 58.0, 47.0, 35.0]), vector(MODELS[request.param])


def test_rays_by_intrinsics_coefficients_and_pixels(lens):
    build, intrinsics, coefficients = lens
    pixels = PIXELS.clone().requires_grad_()
    inputs = (intrinsics, coefficients, pixels)
    assert torch.autograd.gradcheck(lambda i, k, p: build(i, k).rays(p)[0], inputs, fast_mode=True)


def test_projection_by_intrinsics_coefficients_and_points(lens):
    build, intrinsics, coefficients = lens
    points = torch.tensor([[0.3, -0.2, 1.0], [0.0, 0.1, 2.0], [0.0, 0.0, 1.5]], dtype=torch.float64, requires_grad=True)
    inputs = (intrinsics, coefficients, points)
    assert torch.autograd.gradcheck(lambda i, k, p: build(i, k).project(p)[0], inputs, fast_mode=True)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_stay_finite_at_the_origin(lens, dtype):
    """As a return at range 0 is: it has no pixel, and every other point keeps its share of the gradient."""
    build, intrinsics, coefficients = lens
    point = torch.tensor([[0.3, -0.2, 1.0]], dtype=dtype)
    nothing = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, -0.0], [1e-30, 0.0, 0.0]], dtype=dtype)
    gradients = []
    for points in (point, torch.cat([nothing, point])):
        given = [intrinsics, coefficients, points.requires_grad_()]
        pixels, valid = build(intrinsics, coefficients).project(points)
        assert valid.tolist() == [False] * (len(points) - 1) + [True]
        of_all = torch.autograd.grad(pixels.sum(), [x for x in given if x.requires_grad], retain_graph=True)
        assert all(gradient.isfinite().all() for gradient in of_all)
        *of_lens, of_points = torch.autograd.grad(pixels[valid].sum(), [x for x in given if x.requires_grad])
        gradients.append([*of_lens, of_points[-1:]])
        assert (of_points[:-1] == 0).all()
    for alone, among in zip(*gradients, strict=True):
        torch.testing.assert_close(among, alone)


def test_unprojection_by_depth_and_calibration():
    depth = torch.tensor([[2.0, 3.0, 7.0], [4.0, 5.0, 6.0]], dtype=torch.float64, requires_grad=True)

    valid = torch.tensor([[True, True, False], [True, True, True]])

    def cloud(depth, intrinsics, coefficients):
        return Camera(3, 2, *intrinsics, "brown_conrady", coefficients).unproject(depth, valid_mask=valid)

    inputs = (depth, vector([2.0, 2.1, 1.0, 0.5]), vector([-0.1, 0.01, 1e-3, -1e-3]))
    assert torch.autograd.gradcheck(cloud, inputs)


def test_gradients_are_finite_everywhere(camera):
    intrinsics = camera.intrinsics.clone().requires_grad_()
    coefficients = camera.coefficients.clone().requires_grad_(len(camera.coefficients) > 0)
    twin = Camera(camera.width, camera.height, *intrinsics, camera.model, coefficients)
    rays, valid = twin.rays(dtype=torch.float64)
    rays[valid].sum().backward()
    assert intrinsics.grad.isfinite().all()
    assert intrinsics.grad.abs().sum() > 0
    assert coefficients.grad is None or coefficients.grad.isfinite().all()


def test_second_derivatives_are_refused():
    coefficients = vector([-0.28, 0.07, 0.0, 0.0])
    rays, _ = Camera(96, 72, 60.0, 60.0, 47.0, 35.0, "brown_conrady", coefficients).rays(PIXELS)
    (first,) = torch.autograd.grad(rays.sum(), coefficients, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        first.sum().backward()


def test_cached_tables_are_not_used_with_gradients():
    focal = torch.tensor(60.0, dtype=torch.float64, requires_grad=True)
    camera = Camera(8, 6, focal, focal, 4.0, 3.0)
    with torch.no_grad():
        assert not camera.rays()[0].requires_grad
    assert camera.rays()[0].requires_grad
