"""Coverages that the tests of tables and figures share."""

import pytest
import torch

from torchcover.coverage import BevGrid, Coverage, CoverageMetric, Region

GRID = BevGrid(x_m=(-8.0, 12.0), y_m=(-5.0, 5.0), cell_m=1.0)
# Nothing was ever probed behind x = -5 m.
REGIONS = (Region("near", (0.0, 5.0), (-5.0, 5.0)), Region("behind", (-8.0, -6.0), (-5.0, 5.0)))


def cloud(count: int, seed: int) -> torch.Tensor:
    """Points in front of x = -5 m, in both bands."""
    unit = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))
    return unit * torch.tensor([17.0, 10.0, 2.4]) + torch.tensor([-5.0, -5.0, -0.45])


def measured(sensor: torch.Tensor, *, grid: BevGrid = GRID, seed: int = 0, **options) -> Coverage:
    """One step of a rig with these points."""
    metric = CoverageMetric(grid, **options)
    metric.update(sensor, cloud(300, seed))
    return metric.compute()


def over_steps(size: int, seed: int, steps: int, **options) -> Coverage:
    """One cloud of the rig a step, against reference points of that step."""
    metric = CoverageMetric(GRID, num_blocks=16, **options)
    for index in range(steps):
        metric.update(cloud(size, seed * 100 + index), cloud(100, 1000 + index), block_index=index)
    return metric.compute()


def over_surface(size: int, seed: int, steps: int) -> Coverage:
    """As `over_steps`, but every reference point stands for 0.1 to 0.9 square metres."""
    metric = CoverageMetric(GRID, num_blocks=16, has_area_weights=True)
    for index in range(steps):
        m2 = 0.1 + 0.8 * torch.rand(100, generator=torch.Generator().manual_seed(index))
        metric.update(cloud(size, seed * 100 + index), cloud(100, 1000 + index), weights=m2, block_index=index)
    return metric.compute()


@pytest.fixture(scope="session")
def regions():
    """One that is known in part, one that is not."""
    return REGIONS


@pytest.fixture(scope="session")
def measure():
    """(points of a rig, options of the metric) -> its coverage after one step."""
    return measured


@pytest.fixture(scope="session")
def points():
    """(count, seed) -> points of a rig."""
    return cloud


@pytest.fixture(scope="session")
def pair():
    """Few points, and the same with many more; one step, no errors."""
    few, more = cloud(20, 1), cloud(200, 2)
    return {"few": measured(few), "many": measured(torch.cat([few, more]))}


@pytest.fixture(scope="session")
def blind():
    """A rig without a point, one that sees, and another without a point; infinite radii."""
    seeing, nothing = measured(cloud(50, 1)), measured(torch.zeros(0, 3))
    return {"blind": nothing, "seeing": seeing, "[blind]": measured(torch.zeros(0, 3))}


@pytest.fixture(scope="session")
def trios():
    """Steps -> few points, as many other points, and many more, in every step; with errors."""
    kept = {}

    def trio(steps: int) -> dict[str, Coverage]:
        if steps not in kept:
            sizes = {"few": (20, 1), "other": (20, 2), "many": (300, 3)}
            kept[steps] = {name: over_steps(size, seed, steps) for name, (size, seed) in sizes.items()}
        return kept[steps]

    return trio


@pytest.fixture(scope="session")
def surface_pair():
    """Few points and many, against the same surface points; 24 steps, with errors."""
    return {"few": over_surface(20, 1, 24), "many": over_surface(300, 3, 24)}


@pytest.fixture(scope="session")
def trio(trios):
    """The three of 24 steps."""
    return trios(24)
