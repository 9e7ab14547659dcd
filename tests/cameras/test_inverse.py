"""The inverse of the lens: what it answers reproduces the pixel, and what has an answer is answered."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from torchcover.cameras import Camera, inverse
from torchcover.cameras.inverse import build_start_table
from torchcover.cameras.models import build_lens
from torchcover.cameras.valid_region import find_valid_region


def grid(camera):
    y, x = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    return torch.stack((x, y), dim=-1).double()


def test_valid_pixels_project_back_within_a_billionth(camera):
    rays, valid = camera.rays(dtype=torch.float64)
    pixels, visible = camera.project(rays[valid])
    assert visible.all()
    assert (pixels - grid(camera)[valid]).norm(dim=1).max() <= 1e-9


def test_rays_are_unit_where_valid_and_nan_elsewhere(camera):
    rays, valid = camera.rays(dtype=torch.float64)
    assert ((rays[valid].norm(dim=1) - 1.0).abs() < 1e-14).all()
    assert rays[~valid].isnan().all()


def test_pixel_counts_add_up_without_unconverged(camera):
    counts = camera.count_pixels()
    assert sum(counts.values()) == camera.width * camera.height
    assert counts["pixels_valid"] == int(camera.rays()[1].sum()) > 0
    assert counts["pixels_unconverged"] == 0


def test_single_pixels_equal_the_table(camera):
    table, valid = camera.rays(dtype=torch.float64)
    single, answered = camera.rays(grid(camera)[::5, ::7])
    assert torch.equal(answered, valid[::5, ::7])
    torch.testing.assert_close(single, table[::5, ::7], rtol=0, atol=1e-7, equal_nan=True)


def test_float32_rays_are_precise_at_4k():
    camera = Camera(3840, 2160, 1900.0, 1900.0, 1925.0, 1070.0, "brown_conrady", [-0.16, -0.02, 1e-4, 5e-4, 0.04])
    pixels = grid(camera)[::40, ::40].float()
    rays, valid = camera.rays(pixels)
    assert rays.dtype == torch.float32
    assert valid.all()
    assert (camera.project(rays.reshape(-1, 3))[0] - pixels.reshape(-1, 2)).abs().max() <= 1e-3


RADIAL = {
    "k1 -0.6": ("brown_conrady", [-0.6, 0.0, 0.0, 0.0]),
    "k1 -0.3": ("brown_conrady", [-0.3, 0.0, 0.0, 0.0]),
    "k1 0.6": ("brown_conrady", [0.6, 0.0, 0.0, 0.0]),
    "fold and back": ("brown_conrady", [-0.35, 0.16, 0.0, 0.0, -0.04]),
    "pole": ("brown_conrady", [0.0, 0.0, 0.0, 0.0, 0.0, -0.5, 0.0, 0.0]),
    "fisheye": ("kannala_brandt", [0.1379, -0.0919, 0.0635, -0.021]),
    "fisheye fold": ("kannala_brandt", [-0.15, 0.0, 0.0, 0.0]),
    "polynomial": ("theta_polynomial", [1.0, -0.2, 0.0, -0.05]),
}


def bracketed(radial, distorted, limit):
    """Smallest radius with this distorted radius, by a scan and a bracketing solver; None where there is none."""
    scan = np.tan(np.linspace(0.0, np.arctan(50.0), 20001)) if np.isinf(limit) else np.linspace(0.0, limit, 20001)
    with np.errstate(all="ignore"):
        values = radial(scan) - distorted
    # the first descent, or jump over a pole, ends the valid region
    falling = np.flatnonzero(np.diff(values) <= 0)
    end = falling[0] + 2 if len(falling) else len(scan)
    above = np.flatnonzero(values[:end] >= 0)
    if len(above) == 0:
        return None
    return (
        0.0
        if above[0] == 0
        else brentq(lambda r: radial(r) - distorted, scan[above[0] - 1], scan[above[0]], xtol=1e-15)
    )


@pytest.mark.parametrize("name", RADIAL)
def test_a_bracketing_solver_finds_nothing_that_newton_misses(name):
    model, coefficients = RADIAL[name]
    camera = Camera(100, 100, 100.0, 100.0, 0.0, 0.0, model, coefficients)
    lens = camera._optics._solver
    columns = torch.linspace(0.0, 220.0, 111, dtype=torch.float64)
    rays, valid = camera.rays(torch.stack((columns, torch.zeros_like(columns)), dim=1))
    a, b, _ = lens.chart.project(*rays.unbind(1))
    for column, found, answered in zip(columns.tolist(), a.tolist(), valid.tolist(), strict=True):
        truth = bracketed(lens.distortion.distort_radius, column / 100.0, lens.chart.limit)
        assert answered == (truth is not None), column
        if answered:
            # near the fold the radius is known to the square root of what the pixel is
            assert abs(lens.distortion.distort_radius(found) - column / 100.0) < 1e-11
            assert found == pytest.approx(truth, abs=1e-5)
    assert b[valid].abs().max() == 0.0


small = st.floats(-0.02, 0.02)


# Two lenses whose regions are so bent that the first start of Newton's method leads nowhere.
@example(radial=(-0.0625, 0.0), tangential=(0.0, 0.0), k3=0.0, prism=(0.0, 0.0, 0.0, 0.015625), seed=0)
@example(radial=(-0.09375, -0.09375), tangential=(0.0, 0.0), k3=0.0234375, prism=(0.0, 0.015625, 0.0, 0.0), seed=0)
@settings(max_examples=25, deadline=None)
@given(
    radial=st.tuples(st.floats(-0.6, 0.6), st.floats(-0.2, 0.2)),
    tangential=st.tuples(small, small),
    k3=st.floats(-0.05, 0.05),
    prism=st.tuples(small, small, small, small),
    seed=st.integers(0, 2**31),
)
def test_all_points_of_valid_region_are_solved(radial, tangential, k3, prism, seed):
    coefficients = [*radial, *tangential, k3, 0.0, 0.0, 0.0, *prism]
    camera = Camera(100, 100, 500.0, 500.0, 0.0, 0.0, "brown_conrady", coefficients)
    distortion = camera._optics._solver.distortion
    if distortion is None:
        return
    region = find_valid_region(distortion, np.inf)
    generator = np.random.default_rng(seed)
    azimuth = generator.uniform(-np.pi, np.pi, 300)
    edge = np.minimum(region.edge_radius(np.cos(azimuth), np.sin(azimuth)), 3.0)
    radius = edge * np.sqrt(generator.uniform(0.0, 0.98, 300))
    a, b = radius * np.cos(azimuth), radius * np.sin(azimuth)
    at = distortion.linearize(a, b)
    table = build_start_table(distortion, np.inf, 1e3)
    _, _, status = inverse.solve(distortion, region, table, at.u, at.v, (500.0, 500.0))
    assert (status == inverse.ANSWERED).all()


@pytest.mark.parametrize("name", RADIAL)
def test_critical_radii_include_all_turning_points(name):
    distortion = build_lens(*RADIAL[name], is_trainable=False).distortion
    scan = np.linspace(0.0, 3.0, 30_001)
    with np.errstate(all="ignore"):
        turns = scan[1:-1][np.diff(np.sign(np.diff(distortion.distort_radius(scan)))) != 0]
    assert (len(turns) > 0) == (name != "k1 0.6")
    for turn in turns:
        assert np.abs(distortion.find_critical_radii() - turn).min() < 2 * scan[1]


class Drawn:
    """A distortion by formulas: of the radius and azimuth of a drawn point those of its image, and a determinant."""

    def __init__(self, image, determinant, *, is_radial):
        self.image, self.determinant, self.is_radial = image, determinant, is_radial

    def find_critical_radii(self):
        return np.empty(0)

    def linearize(self, a, b):
        drawn = np.hypot(a, b)
        radius, azimuth = self.image(drawn, np.arctan2(b, a))
        u, v = radius * np.cos(azimuth), radius * np.sin(azimuth)
        return SimpleNamespace(u=u, v=v, determinant=self.determinant(drawn))


def test_valid_region_ends_at_nan_determinants():
    lens = Drawn(
        lambda radius, azimuth: (radius, azimuth), lambda radius: np.where(radius < 0.7, 1.0, np.nan), is_radial=True
    )
    assert find_valid_region(lens, 2.0).edge_radius.values == pytest.approx([0.7], abs=1e-12)


def test_max_distorted_radius_covers_cusped_edges():
    def image(radius, azimuth):
        return radius * (1 + 0.5 * np.cos(7 * azimuth)), azimuth + 0.8 * np.sin(3 * azimuth)

    lens = Drawn(image, lambda radius: 1.0 + 0.0 * radius, is_radial=False)
    region, azimuth = find_valid_region(lens, 2.0), np.linspace(-np.pi, np.pi, 997)
    at = lens.linearize(2 * np.cos(azimuth), 2 * np.sin(azimuth))
    assert region.max_distorted_radius.contains(np.hypot(at.u, at.v) * (1 - 1e-3), at.u, at.v).all()


def test_the_solution_nearer_the_axis_is_chosen(make_camera):
    camera = make_camera("fold")
    rays, valid = camera.rays(dtype=torch.float64)
    fold = (1.0 / 0.9) ** 0.5  # d(r - 0.3 r^3)/dr = 0
    radius = rays[..., :2].norm(dim=-1) / rays[..., 2]
    assert 0.0 < valid.double().mean() < 1.0
    assert radius[valid].max() <= fold * (1.0 + 1e-9)
    distance = (grid(camera) - torch.tensor([47.0, 35.0])).norm(dim=-1)
    assert torch.equal(valid, distance <= 40.0 * (fold - 0.3 * fold**3))


@pytest.mark.parametrize(("name", "edge"), [("fold", (1.0 / 0.9) ** 0.5), ("pole", 2.0**0.5)])
def test_no_point_is_visible_behind_a_fold(name, edge, make_camera):
    radius = edge * torch.tensor([0.999, 1.001, 1.02, 1.3, 3.0], dtype=torch.float64)
    points = torch.stack((radius * 0.8, radius * -0.6, torch.ones_like(radius)), dim=1)
    pixels, visible = make_camera(name).project(points)
    assert pixels.isfinite().all(dim=1).tolist() == [True, False, False, False, False]
    assert not visible[1:].any()


def test_only_fisheyes_see_beyond_ninety_degrees(make_camera):
    sideways = torch.tensor([[1.0, 0.0, -0.1]], dtype=torch.float64)
    assert make_camera("fisheye 220").project(sideways)[1].all()
    assert not make_camera("pinhole").project(sideways)[1].any()


def test_solution_is_right_where_kornia_diverges():
    # kornia issue 4285: k1 = 0.5, off by 288 px
    camera = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, "brown_conrady", [0.5, 0.0, 0.0, 0.0])
    rays, valid = camera.rays(grid(camera)[::16, ::16])
    assert valid.all()
    assert (camera.project(rays.reshape(-1, 3))[0] - grid(camera)[::16, ::16].reshape(-1, 2)).abs().max() <= 1e-9


def test_nan_pixels_have_no_ray(camera):
    rays, valid = camera.rays(torch.tensor([[float("nan"), 1.0], [float("inf"), 1.0]]))
    assert not valid.any()
    assert rays.isnan().all()


def test_chunk_size_changes_nothing(make_camera, monkeypatch):
    whole = make_camera("crooked fold").rays(dtype=torch.float64)
    monkeypatch.setattr(inverse, "_PIXELS_PER_CHUNK", 1000)
    pieces = make_camera("crooked fold").rays(dtype=torch.float64)
    assert torch.equal(whole[1], pieces[1])
    assert torch.equal(whole[0].nan_to_num(9.0), pieces[0].nan_to_num(9.0))
