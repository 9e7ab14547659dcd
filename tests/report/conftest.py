"""Coverages for the tests of tables and figures."""

import pytest
import torch

from torchcover.coverage import BevGrid, Coverage, CoverageMetric, Region

GRID = BevGrid(x_m=(-8.0, 12.0), y_m=(-5.0, 5.0), cell_m=1.0)
# No reference point lies behind x = -5 m.
REGIONS = (Region("near", (0.0, 5.0), (-5.0, 5.0)), Region("behind", (-8.0, -6.0), (-5.0, 5.0)))


def sample_cloud(count: int, seed: int) -> torch.Tensor:
    """Sample points in front of x = -5 m, in both bands."""
    unit = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))
    return unit * torch.tensor([17.0, 10.0, 2.4]) + torch.tensor([-5.0, -5.0, -0.45])


def measure_frame(sensor: torch.Tensor, *, grid: BevGrid = GRID, seed: int = 0, **options) -> Coverage:
    """Measure one frame of a rig with these points."""
    metric = CoverageMetric(grid, **options)
    metric.update(sensor, sample_cloud(300, seed))
    return metric.compute()


def measure_frames(size: int, seed: int, num_frames: int, **options) -> Coverage:
    """Measure frames with another cloud and other reference points in each."""
    metric = CoverageMetric(GRID, num_blocks=16, **options)
    for index in range(num_frames):
        metric.update(sample_cloud(size, seed * 100 + index), sample_cloud(100, 1000 + index), block_index=index)
    return metric.compute()


def measure_surface(size: int, seed: int, num_frames: int) -> Coverage:
    """Measure the same frames, with reference points that represent 0.1 to 0.9 square meters each."""
    metric = CoverageMetric(GRID, num_blocks=16, has_area_weights=True)
    for index in range(num_frames):
        weights_m2 = 0.1 + 0.8 * torch.rand(100, generator=torch.Generator().manual_seed(index))
        metric.update(
            sample_cloud(size, seed * 100 + index),
            sample_cloud(100, 1000 + index),
            weights=weights_m2,
            block_index=index,
        )
    return metric.compute()


@pytest.fixture(scope="session")
def regions():
    """A partly observed region, and an unobserved one."""
    return REGIONS


@pytest.fixture(scope="session")
def measure():
    """Function from the points of a rig and options of the metric to its coverage after one frame."""
    return measure_frame


@pytest.fixture(scope="session")
def points():
    """Function from count and seed to the points of a rig."""
    return sample_cloud


@pytest.fixture(scope="session")
def pair():
    """A rig with few points, and one with the same points and many more; one frame, no errors."""
    few, more = sample_cloud(20, 1), sample_cloud(200, 2)
    return {"few": measure_frame(few), "many": measure_frame(torch.cat([few, more]))}


@pytest.fixture(scope="session")
def blind():
    """Two rigs without points, whose radii are infinite, and one with points between them."""
    no_points = torch.zeros(0, 3)
    seeing = measure_frame(sample_cloud(50, 1))
    return {"blind": measure_frame(no_points), "seeing": seeing, "[blind]": measure_frame(no_points)}


@pytest.fixture(scope="session")
def trios():
    """Function from the number of frames to rigs with few, as many other, and many points, with errors."""
    cache = {}

    def measure_trio(num_frames: int) -> dict[str, Coverage]:
        if num_frames not in cache:
            sizes = {"few": (20, 1), "other": (20, 2), "many": (300, 3)}
            cache[num_frames] = {}
            for name, (size, seed) in sizes.items():
                cache[num_frames][name] = measure_frames(size, seed, num_frames)
        return cache[num_frames]

    return measure_trio


@pytest.fixture(scope="session")
def surface_pair():
    """Rigs with few and many points against the same surface points; 24 frames, with errors."""
    return {"few": measure_surface(20, 1, 24), "many": measure_surface(300, 3, 24)}


@pytest.fixture(scope="session")
def trio(trios):
    """Rigs of `trios` after 24 frames."""
    return trios(24)
