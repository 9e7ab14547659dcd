"""Recordings, their ground and worlds made of them, far from the origin, against twins in wider types."""

import math
from functools import lru_cache

import numpy as np

from torchcover.geometry import HeightField
from torchcover.recordings.ground_model import GroundModel, extract_low_surfaces
from torchcover.recordings.sweep_window import find_pose_discontinuities
from torchcover.simulation.cell_mesh import CELL_M, build_cell_mesh

from .case import Case, most

FAR_M = np.array([4_194_304.0, -8_388_608.0, 1024.0])  # squares of all scales begin where those at the origin do


@lru_cache
def street():
    """Sample points of a hilly street, and some above it."""
    generator = np.random.default_rng(3)
    x, y = generator.uniform(-30, 30, (2, 8000))
    road_m = np.stack([x, y, np.sin(x / 20) + generator.normal(0.0, 0.03, 8000)], axis=1)
    return road_m, road_m[:500] + np.array([0.0, 0.0, 1.5])


def heights_m(shift_m, dtype=np.float64):
    road_m, above_m = ((points_m + shift_m).astype(dtype).astype(np.float64) for points_m in street())
    return GroundModel.from_surfaces([extract_low_surfaces(road_m, shift_m)], shift_m).compute_heights_m(above_m)


def shifted(dtype=np.float64):
    return most(heights_m(FAR_M, dtype) - heights_m(np.zeros(3)))


@lru_cache
def column():
    """200,000 points of a level street, in one column 4 km above the sea."""
    generator = np.random.default_rng(4)
    points_m = generator.uniform([100.0, 50.0, 4000.0], [100.4, 50.4, 4000.1], (200_000, 3))
    points_m[0] = 100.2, 50.2, 4000.0
    return points_m


def mean_m(of=lambda points_m: extract_low_surfaces(points_m, column()[0])[0, :3]):
    return most(of(column()) - [math.fsum(along) / len(along) for along in column().T.tolist()])


@lru_cache
def raster():
    generator = np.random.default_rng(5)
    field = HeightField(FAR_M[:2], FAR_M[2] + generator.normal(size=(40, 50)), 1.25)
    return field, FAR_M[:2] + generator.uniform(0.0, 40.0, (2000, 2))


def between_corners(dtype=None):
    field, places_m = raster()
    cells = (places_m.astype(np.longdouble) - field.origin_m) / field.cell_m
    (column, row), (x, y) = np.floor(cells).astype(int).T, (cells % 1).T
    first, right, above, across = (field.corner_heights_m[row + j, column + i].astype(np.longdouble)
                                   for i, j in ((0, 0), (1, 0), (0, 1), (1, 1)))  # fmt: skip
    low, high = first + x * (right - first) + y * (across - right), first + y * (above - first) + x * (across - above)
    if dtype is None:
        found_m = field.compute_heights_m(places_m)
    else:
        narrow = HeightField(field.origin_m.astype(dtype), field.corner_heights_m.astype(dtype), field.cell_m)
        found_m = narrow.compute_heights_m(places_m.astype(dtype))
    return most(found_m - np.where(x >= y, low, high))


@lru_cache
def drive():
    """Times and poses of a bend, and one step that jumps by a metre; and after which place it does."""
    times_s = 0.1 * np.arange(100)
    way_m = np.stack([12.0 * times_s, 0.6 * times_s**2, 0.1 * times_s], axis=1)
    way_m[41:] += [0.6, -0.8, 0.0]
    poses = np.tile(np.eye(4), (len(times_s), 1, 1))
    poses[:, :3, 3] = way_m + FAR_M
    return times_s, poses, 40


def wrong_jumps(dtype=np.float64):
    times_s, poses, jump = drive()
    result = find_pose_discontinuities(times_s, poses.astype(dtype).astype(np.float64))
    return float(len(set(result.tolist()) ^ {jump}))


@lru_cache
def cells():
    generator = np.random.default_rng(6)
    return generator.integers(0, 20, (2000, 3)), np.rint(FAR_M / CELL_M).astype(np.int64)


def corners_m(dtype=np.float64):
    here, away = cells()
    result = build_cell_mesh(here + away).vertices_m.astype(dtype).astype(np.longdouble)
    return most(result - np.longdouble(CELL_M) * away - build_cell_mesh(here).vertices_m)


CASES = [
    Case("heights above ground, 8,000 km from the origin", "the same at the origin", "m", 1e-6, shifted,
         "float32 coordinates", lambda: shifted(np.float32)),
    Case("200,000 points in one column, 4 km up", "math.fsum", "m", 1e-9, mean_m,
         "float32 mean", lambda: mean_m(lambda points_m: points_m.astype(np.float32).cumsum(axis=0)[-1] / 200_000)),
    Case("between the corners of a raster, 8,000 km from the origin", "longdouble", "m", 1e-8, between_corners,
         "float32", lambda: between_corners(np.float32)),
    Case("a pose that jumps by 1 m, 8,000 km from the origin", "that step alone", "of 99 steps wrong", 0, wrong_jumps,
         "float32 places", lambda: wrong_jumps(np.float32)),
    Case("cells of a made world, 8,000 km from the origin", "the same at the origin, longdouble", "m", 1e-8, corners_m,
         "float32", lambda: corners_m(np.float32)),
]  # fmt: skip
