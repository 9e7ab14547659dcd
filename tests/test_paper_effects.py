"""The physical effects that the paper names, on a reduced run: a car ahead on a flat road between two walls."""

from typing import NamedTuple

import numpy as np
import pytest
import torch

from torchcover import BevGrid, CoverageMetric, Region, Rig, Scenario
from torchcover.data import SimulatedFrames
from torchcover.evaluation import CoverageObserver, observe
from torchcover.simulation import PaperReference

RIGS = ("front_grille_128", "front_roof_128", "front_roof_64", "front_roof_32")
# 40 degrees wide: no wall comes into their view before x = 24 m.
FITTED = ("paper_fit_grille_128", "paper_fit_roof_128", "paper_fit_roof_64", "paper_fit_roof_32")
LEADER_X_M = 13.0
GRID = BevGrid(x_m=(0.0, 80.0), y_m=(-10.0, 10.0), cell_m=0.5)
ROAD = Scenario.model_validate(
    {
        "name": "road",
        "ego": {"shape": {"type": "vehicle", "vehicle": "suv"}},
        "bodies": [
            {"name": "ground", "shape": {"type": "plane", "size_m": [400, 400]}},
            {
                "name": "walls",
                "shape": {"type": "box", "size_m": [120, 0.4, 4]},
                "poses": [{"x_m": 50, "y_m": 9}, {"x_m": 50, "y_m": -9}],
            },
        ],
        "actors": [
            {
                "name": "leader",
                "category": "car",
                "shape": {"type": "vehicle", "vehicle": "sedan"},
                "pose": {"x_m": LEADER_X_M},
            }
        ],
    }
)


class Here(NamedTuple):
    """The numbers of a place."""

    radius_m: float
    detection: float


@pytest.fixture(scope="module")
def coverage():
    reference = PaperReference(rows=256, columns=256)
    rigs = (*RIGS, *FITTED)
    frames = SimulatedFrames(ROAD, rigs={name: name for name in rigs}, num_frames=8, seed=0, reference_sensor=reference)
    observers = {name: CoverageObserver(CoverageMetric(GRID, max_radius_m=GRID.diagonal_m), name) for name in rigs}
    observe(frames, observers.values())
    return {name: observer.compute() for name, observer in observers.items()}


def row(coverage, rig, x, y=(-8.0, 8.0), band="ground"):
    rows = coverage[rig].summary([Region("here", x, y)])
    (found,) = [row for row in rows if row.band == band]
    assert found.observed_cells > 0
    return Here(found.numbers["radius_m"].value, found.numbers["detection_0.4m"].value)


def test_hood_occludes_ground_from_roof_sensors(coverage):
    lidar = Rig.load("front_roof_128").sensors[0]
    seen = SimulatedFrames(ROAD, "front_roof_128", num_frames=1, reference_sensor=PaperReference(8, 8))[0]
    assert seen.counts["sensor_self_hits"] > 0.005 * seen.counts["sensor_rays"]
    # Without a body the lowest row would reach the ground here; with it, rows end on the hood.
    first_m = lidar.mount.x_m + lidar.mount.z_m / np.tan(np.deg2rad(25.0))
    ahead = seen.sensor[(seen.sensor[:, 1].abs() < 0.3) & (seen.sensor[:, 2] < 0.05), 0]
    assert ahead.min() > first_m + 0.1
    in_front = row(coverage, "front_roof_128", (2.5, 4.5), (-1.0, 1.0))
    assert in_front.detection < 0.2 < 0.9 < row(coverage, "front_grille_128", (4.5, 7.0), (-1.0, 1.0)).detection


@pytest.mark.parametrize("rig", FITTED)
def test_narrow_lidar_misses_obstacles_outside_its_view(coverage, rig):
    """The paper's LiDAR tables have it in all 12 rows."""
    ground, obstacle = (row(coverage, rig, (0.0, 20.0), (-10.0, 10.0), height) for height in ("ground", "obstacle"))
    assert obstacle.radius_m > 1.3 * ground.radius_m
    leader, walls = (row(coverage, rig, (0.0, 20.0), y, "obstacle") for y in ((-2.0, 2.0), (8.0, 10.0)))
    assert walls.detection < 0.05 < 0.5 < leader.detection


@pytest.mark.parametrize("rig", [*RIGS, *FITTED])
def test_far_ahead_blind_spots_are_smaller_higher_up(coverage, rig):
    """Rows graze the road, and meet the walls at a wider angle."""
    ground, obstacle = (row(coverage, rig, (24.0, 80.0), (-10.0, 10.0), height) for height in ("ground", "obstacle"))
    assert obstacle.radius_m < 0.7 * ground.radius_m
    assert obstacle.detection > ground.detection


@pytest.mark.parametrize("rig", ["front_grille_128", "front_roof_128"])
def test_the_vehicle_ahead_casts_a_shadow(coverage, rig):
    behind = (LEADER_X_M + 2.5, LEADER_X_M + 7.0)
    shadow, beside = row(coverage, rig, behind, (-1.0, 1.0)), row(coverage, rig, behind, (4.0, 7.0))
    assert shadow.radius_m > 2 * beside.radius_m


def test_the_shadow_is_larger_for_the_grille(coverage):
    behind, across = (LEADER_X_M + 2.5, 60.0), (-1.5, 1.5)
    grille, roof = (row(coverage, rig, behind, across) for rig in ("front_grille_128", "front_roof_128"))
    assert grille.radius_m > 1.2 * roof.radius_m
    assert grille.detection < roof.detection


def test_grille_ground_detection_fades_at_19_m(coverage):
    """Rows 0.24 degrees apart from 0.62 m up: at 19 m, rings on the ground are twice the ball of 0.8 m apart."""
    near, at, far = (row(coverage, "front_grille_128", x, (3.0, 7.0)).detection for x in ((8, 12), (18, 21), (26, 30)))
    assert near > 0.95
    assert 0.3 < at < 0.75
    assert far < 0.35
    assert row(coverage, "front_roof_128", (18, 21), (3.0, 7.0)).detection > 0.85


def test_resolution_matters_for_ground_and_long_range(coverage):
    def detection(rig, x, height):
        return row(coverage, rig, x, (-10.0, 10.0), height).detection

    def gain(x, height):
        return detection("front_roof_128", x, height) - detection("front_roof_32", x, height)

    assert gain((0.0, 20.0), "ground") > 0.1
    assert gain((40.0, 80.0), "obstacle") > 0.05
    assert gain((0.0, 20.0), "obstacle") < 0.05
    for x, height in (((0.0, 20.0), "ground"), ((40.0, 80.0), "obstacle")):
        order = [detection(rig, x, height) for rig in ("front_roof_32", "front_roof_64", "front_roof_128")]
        assert order == sorted(order)


def test_the_rigs_are_compared_on_the_same_cells(coverage):
    for name in RIGS[1:]:
        assert torch.equal(coverage[name].point_counts, coverage[RIGS[0]].point_counts)
