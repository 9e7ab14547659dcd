from math import pi

import pytest
import torch

from torchcover.cameras import Camera

# Every model, plain and extreme: (width, height, fx, fy, cx, cy, model, coefficients).
# fmt: off
LENSES = {
    "pinhole": (64, 48, 50.0, 60.0, 31.0, 25.0, "pinhole", []),
    "barrel": (96, 72, 60.0, 58.0, 47.3, 35.1, "brown_conrady", [-0.28, 0.07, 2e-4, 2e-5]),
    "pincushion": (96, 72, 90.0, 90.0, 40.0, 35.0, "brown_conrady", [0.6, 0.1, 0.0, 0.0, 0.02]),
    "rational": (80, 72, 63.0, 63.0, 41.5, 40.7, "brown_conrady", [3.13, 2.32, 8e-5, -5e-5, 0.13, 3.46, 3.35, 0.66]),
    "prism": (80, 60, 70.0, 70.0, 40.0, 30.0, "brown_conrady",
              [-0.2, 0.05, 1e-3, -1e-3, *[0.0] * 4, 0.01, 2e-3, -0.01, 0.0]),
    "tilted": (80, 60, 90.0, 90.0, 40.0, 30.0, "brown_conrady", [-0.1, *[0.0] * 11, 0.1, -0.05]),
    "fold": (96, 72, 40.0, 40.0, 47.0, 35.0, "brown_conrady", [-0.3, 0.0, 0.0, 0.0]),
    "crooked fold": (96, 72, 40.0, 40.0, 47.0, 35.0, "brown_conrady", [-0.3, 0.02, 0.01, -0.02]),
    "pole": (96, 72, 40.0, 40.0, 47.0, 35.0, "brown_conrady", [0.0, 0.0, 0.0, 0.0, 0.0, -0.5, 0.0, 0.0]),
    "three focal lengths off axis": (96, 72, 15.0, 15.0, 47.0, 35.0, "brown_conrady", [0.3, 0.05, 1e-3, 0.0, 0.001]),
    "short": (64, 64, 20.0, 20.0, 31.5, 31.5, "brown_conrady", [0.05, 0.0, 0.0, 0.0]),
    "long": (64, 64, 20000.0, 20000.0, 31.5, 31.5, "brown_conrady", [-0.4, 1.0, 1e-3, 1e-3]),
    "axis outside": (64, 64, 300.0, 300.0, -500.0, 90.0, "brown_conrady", [-0.05, 0.004, 1e-4, 1e-4]),
    "fisheye 190": (96, 96, 28.0, 28.0, 47.5, 47.5, "kannala_brandt", [-0.02, 0.003, -0.001, 0.0001]),
    "fisheye 220": (96, 96, 25.0, 25.0, 47.5, 47.5, "kannala_brandt", [0.0, 0.0, 0.0, 0.0]),
    "fisheye fold": (96, 96, 40.0, 40.0, 47.5, 47.5, "kannala_brandt", [-0.15, 0.0, 0.0, 0.0]),
    "woodscape": (96, 72, 1.0, 1.0, 47.5, 35.5, "theta_polynomial", [33.0, -3.0, 4.8, -0.7]),
    "mei": (70, 70, 74.0, 74.0, 35.0, 35.0, "mei", [2.55, 0.05, 4.5, 1.3e-3, -7e-4]),
    "mei plain": (70, 70, 40.0, 40.0, 35.0, 35.0, "mei", [0.9]),
    "eucm": (75, 48, 46.0, 46.0, 36.6, 24.9, "eucm", [0.59, 1.12]),
    "eucm flat": (75, 48, 46.0, 46.0, 36.6, 24.9, "eucm", [0.4, 0.9]),
    "double sphere": (51, 51, 15.8, 15.8, 25.5, 25.7, "double_sphere", [-0.17, 0.59]),
}
# fmt: on


@pytest.fixture(params=LENSES, ids=lambda name: name.replace(" ", "_"))
def camera(request: pytest.FixtureRequest) -> Camera:
    return Camera(*LENSES[request.param], name=request.param)


@pytest.fixture
def make_camera():
    return lambda name, **changes: Camera(*LENSES[name], name=name, **changes)


@pytest.fixture
def directions() -> torch.Tensor:
    """Unit vectors all over the sphere, the axis and its opposite among them."""
    angle = torch.linspace(0.0, pi, 40, dtype=torch.float64)[:, None]
    azimuth = torch.arange(24, dtype=torch.float64) * (2.0 * pi / 24)
    parts = (angle.sin() * azimuth.cos(), angle.sin() * azimuth.sin(), angle.cos().expand(40, 24))
    return torch.stack(parts, dim=-1).reshape(-1, 3)
