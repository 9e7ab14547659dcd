"""Lenses at their folds and beyond 90 degrees."""

from functools import lru_cache, partial

import numpy as np
import torch
from kornia.geometry.calibration import undistort_points
from kornia.geometry.camera.distortion_kannala_brandt import undistort_points_kannala_brandt

from torchcover.cameras import Camera

from .case import Case, most

FOCAL_PX = 400.0
FOLDING = {"brown_conrady": [-0.3, 0.0, 0.0, 0.0], "kannala_brandt": [-0.15, 0.0, 0.0, 0.0]}


@lru_cache
def folding(model):
    return Camera(100, 100, FOCAL_PX, FOCAL_PX, 0.0, 0.0, model, FOLDING[model])


def fold_px(model):
    """Return the fold of r + k r^3: r^2 = -1 / 3k, at two thirds of r."""
    return FOCAL_PX * 2 / 3 * np.sqrt(-1 / (3 * FOLDING[model][0]))


@lru_cache
def near_the_fold(model, side):
    """Pixels 1 px to 1e-9 px inside of the fold (`side` -1) or outside of it (+1), all around."""
    radius = fold_px(model) + side * np.geomspace(1e-9, 1.0, 40)[:, None]
    azimuth = np.linspace(0.0, 2 * np.pi, 50)
    return torch.from_numpy(np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth)], axis=-1).reshape(-1, 2))


def drawn_radius(model, rays):
    """Radius on the chart of unit directions: the tangent of the angle, or the angle."""
    across, z = np.hypot(*rays[:, :2].T.astype(np.longdouble)), rays[:, 2].astype(np.longdouble)
    return across / z if model == "brown_conrady" else np.arctan2(across, z)


def image_error_px(model, pixels, rays):
    """Distance in the image from where the rays are seen, in longdouble."""
    radius = drawn_radius(model, rays.numpy())
    seen = FOCAL_PX * radius * (1 + FOLDING[model][0] * radius**2)
    error = np.abs(seen - np.hypot(*pixels.numpy().T))
    return most(error) if (rays.isfinite().all(1)).all() else np.inf


def our_rays(model, pixels):
    return folding(model).rays(pixels)[0]


def inside_fold(model, inverse):
    pixels = near_the_fold(model, -1)
    return image_error_px(model, pixels, inverse(model, pixels))


def kornia_rays(model, pixels):
    """Directions from kornia's inverse, which iterates a fixed number of times."""
    camera = folding(model)
    if model == "kannala_brandt":
        plane = undistort_points_kannala_brandt(pixels, torch.cat([camera.intrinsics, camera.coefficients]))
    else:
        matrix, identity = torch.diag(torch.tensor([FOCAL_PX, FOCAL_PX, 1.0]).double()), torch.eye(3).double()
        plane = undistort_points(pixels, matrix, camera.coefficients, identity)
    return torch.nn.functional.pad(plane, (0, 1), value=1.0)


def outside_fold(model, inverse):
    return int(inverse(model, near_the_fold(model, 1)).isfinite().all(1).sum())


def one_pixel_inside(model, inverse):
    """Direction a pixel inside of the fold, against the trigonometric root of the cubic."""
    image = np.longdouble((fold_px(model) - 1.0) / FOCAL_PX)
    fold = np.sqrt(-1 / (3 * np.longdouble(FOLDING[model][0])))
    root = 2 * fold * np.sin(np.arcsin(1.5 * image / fold) / 3)
    rays = inverse(model, torch.tensor([[fold_px(model) - 1.0, 0.0]], dtype=torch.float64))
    return float(abs(drawn_radius(model, rays.numpy())[0] - root))


# Wide angles


FISHEYE = (-0.02, 0.003, -0.001, 0.0001)
WIDE = Camera(100, 100, FOCAL_PX, FOCAL_PX, 0.0, 0.0, "kannala_brandt", FISHEYE)


@lru_cache
def sideways():
    """Pixels of directions 89.9999999 to 100 degrees off the axis, 90 degrees among them."""
    off_axis = np.deg2rad(np.append(90 + np.geomspace(1e-7, 10, 20), [90, 90 - 1e-7]))
    image = off_axis.astype(np.longdouble)
    gain = sum((k * image ** (2 * n + 2) for n, k in enumerate(FISHEYE)), start=np.longdouble(1))
    pixels = torch.from_numpy(np.stack([FOCAL_PX * image * gain, 0 * image], axis=1).astype(np.float64))
    return pixels, off_axis


def fisheye_angles():
    pixels, off_axis = sideways()
    rays = WIDE.rays(pixels)[0].numpy()
    return most(np.arctan2(rays[:, 0], rays[:, 2]) - off_axis)


def fisheye_angles_kornia():
    pixels, off_axis = sideways()
    plane = undistort_points_kannala_brandt(pixels, torch.cat([WIDE.intrinsics, WIDE.coefficients]))
    return most(np.arctan2(plane[:, 0].numpy(), 1.0) - off_axis)


def folds(name, model, naive_way, naive_fails):
    """Create the cases of one lens with a fold."""
    return [
        Case(f"{name}, 1 to 1e-9 px inside its fold", "longdouble", "px", 1e-9, partial(inside_fold, model, our_rays),
             naive_way, partial(inside_fold, model, kornia_rays)),
        Case(f"{name}, 1 px inside its fold", "root of the cubic", "rad", 1e-10,
             partial(one_pixel_inside, model, our_rays),
             naive_way, partial(one_pixel_inside, model, kornia_rays), naive_fails),
        Case(f"{name}, 1e-9 to 1 px outside its fold", "no ray", "of 2,000 answered", 0,
             partial(outside_fold, model, our_rays),
             naive_way, partial(outside_fold, model, kornia_rays)),
    ]  # fmt: skip


CASES = [
    *folds("Brown-Conrady", "brown_conrady", "kornia, 5 iterations", True),
    *folds("Kannala-Brandt", "kannala_brandt", "kornia", False),
    Case("fisheye at 90 degrees off its axis and beyond", "longdouble", "rad", 1e-11, fisheye_angles,
         "kornia", fisheye_angles_kornia),
]  # fmt: skip
