"""Roadside objects: clearance, overlaps, ground contact and densities."""

import numpy as np
import pytest
import shapely
import trimesh
from pydantic import TypeAdapter, ValidationError

from torchcover.simulation.bodies import merge_meshes
from torchcover.simulation.traffic import UrbanTraffic
from torchcover.simulation.traffic.frontage import HOUSES, KINDS, RoadsideDensity, StreetSide, place_scenery

# A street along x to either side of a curve, 3 m wide, with a sidewalk of 2 m on its right.
ARC_M = np.linspace(-1.2, 0.0, 30)
LINE_M = np.concatenate([100.0 * np.column_stack([np.sin(ARC_M), 1 - np.cos(ARC_M)]), [[120.0, 0.0]]])
STREET = shapely.LineString(LINE_M).buffer(3.0, quad_segs=32)
OFF = {name: 0.0 for name in KINDS if name not in HOUSES}


def offset_line(right_m):
    line = shapely.LineString(LINE_M).offset_curve(-right_m, quad_segs=64)
    return np.array(line.coords)


def compute_slope_heights_m(places_m):
    return 0.05 * places_m[:, 0] + 0.02 * places_m[:, 1]


def place_objects(times, zone="built", compute_heights_m=compute_slope_heights_m, sidewalk_areas=(), seed=0):
    sides = [StreetSide("curb", offset_line(3.3)), StreetSide(zone, offset_line(5.3))]
    return place_scenery(
        sides, [STREET], [STREET.buffer(1.9)], sidewalk_areas, compute_heights_m, times, np.random.default_rng(seed)
    )


@pytest.fixture(scope="module")
def usual_objects():
    return place_objects(1.0)


def split_solids(meshes):
    return trimesh.Trimesh(*merge_meshes(list(meshes))[:2], process=False).split(only_watertight=False)


def test_roadside_objects_are_closed_and_grounded(usual_objects):
    for mesh in (*usual_objects[0], *usual_objects[1]):
        assert trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False).is_volume
    for solid in split_solids((*usual_objects[0], *usual_objects[1])):
        foot_m = solid.vertices[:, 2].min() - compute_slope_heights_m(solid.vertices[:, :2])
        # Crowns, arms of lamps and plates of signs are above the ground.
        assert foot_m.max() < 0.0 or foot_m.min() > 0.5 or len(solid.vertices) == 12


def test_objects_keep_off_streets_and_houses_off_sidewalks(usual_objects):
    houses, others = usual_objects
    feet = [
        shapely.MultiPoint(s.vertices[:, :2]).convex_hull
        for s in split_solids(others)
        if np.ptp(s.vertices[:, 2]) > 0.3
    ]
    crowns = [foot for foot in feet if foot.area > 2.0]
    assert not any(foot.intersects(STREET) for foot in feet if foot not in crowns)
    assert min(shapely.MultiPoint(s.vertices[:, :2]).distance(STREET) for s in split_solids(houses)) > 1.8


def test_objects_at_corners_are_not_stretched():
    turn = np.linspace(0.0, np.pi / 2, 8)
    around_m = 3.0 * np.column_stack([np.cos(turn), np.sin(turn)])
    line_m = np.concatenate([[[3.0, -80.0]], around_m, [[-80.0, 3.0]]])
    houses, _ = place_scenery(
        [StreetSide("built", line_m)], [], [], (), lambda at: np.zeros(len(at)), OFF, np.random.default_rng(0)
    )
    corners_m = np.concatenate([mesh.vertices_m.reshape(-1, 2, 4, 3)[:, 0, :, :2] for mesh in houses])
    lengths_m = np.linalg.norm(np.roll(corners_m, -1, axis=1) - corners_m, axis=2)[:, ::2]
    longest_m = max(KINDS[name].run_m[1] for name in HOUSES)
    assert len(corners_m) > 5
    assert lengths_m.max() < longest_m / 0.6


def test_density_factors_scale_object_counts():
    few, usual, many = (sum(len(m.faces) for m in place_objects(times)[1]) for times in (0.25, 1.0, 3.0))
    assert 0 < few < usual < many
    assert place_objects(0.0)[1] == []
    assert place_objects(0.0)[0]
    hedges = place_objects({**OFF, "hedge": 1.0})[1]
    assert len(hedges) == 1
    assert np.ptp(hedges[0].material_indices) == 0
    assert place_objects({**OFF, "hedge": 1.0}, "open") == ([], [])


def test_no_sides_give_no_objects():
    assert place_scenery([], [STREET], [], [], compute_slope_heights_m, 1.0, np.random.default_rng(0)) == ([], [])


def test_short_lines_and_repeated_corners_are_accepted():
    short = StreetSide("curb", np.array([[0.0, 0.0], [0.3, 0.0]]))
    twice = StreetSide("open", np.repeat(offset_line(5.3), 2, axis=0))
    _, others = place_scenery([short, twice], [STREET], [], [], compute_slope_heights_m, 1.0, np.random.default_rng(0))
    assert others
    assert all(np.isfinite(mesh.vertices_m).all() for mesh in others)


def test_objects_on_sidewalks_are_raised_by_a_curb():
    flat = place_objects(
        1.0, compute_heights_m=lambda places_m: np.zeros(len(places_m)), sidewalk_areas=[shapely.box(-50, -80, 60, 40)]
    )
    for solid in split_solids((*flat[0], *flat[1])):
        x, foot_m = solid.vertices[:, 0], solid.vertices[:, 2].min()
        if foot_m < 0.5:
            inside = (x.min() > -50) and (x.max() < 60)
            assert foot_m == pytest.approx(0.15 if inside else 0.0, abs=0.1)


@pytest.mark.parametrize("times", [-0.1, 100.0, float("nan"), {"hedge": 100.0}, {"hedges": 1.0}, {"house": 0.0}])
def test_invalid_density_factors_are_rejected(times):
    with pytest.raises(ValidationError):
        TypeAdapter(RoadsideDensity).validate_python(times)
    with pytest.raises(ValueError, match="UrbanTraffic: roadside_density"):
        UrbanTraffic(roadside_density=times)
