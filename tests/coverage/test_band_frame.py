"""Height bands above ground and over z of the vehicle frame: closed forms and refused inputs."""

import dataclasses
import math

import pytest
import torch

from torchcover import BevGrid, Coverage, CoverageMetric
from torchcover.contrib import FalseVisible, KCover, PointDensity
from torchcover.coverage import Maximum, check_paired
from torchcover.data import Frame
from torchcover.evaluation import CoverageObserver
from torchcover.simulation import Lidar

EXTENT = {"x_m": (0.0, 40.0), "y_m": (0.0, 1.0), "cell_m": 1.0}
GROUND, VEHICLE = (BevGrid(**EXTENT, band_frame=band_frame) for band_frame in ("ground", "vehicle"))
# A ramp with slope 0.1 from x = 0: in every cell a point on it, and a point 1 m above it.
ALONG_M = torch.arange(40) + 0.5
ON_RAMP = torch.stack([ALONG_M, torch.full_like(ALONG_M, 0.5), 0.1 * ALONG_M], dim=1)
ABOVE = ON_RAMP + torch.tensor([0.0, 0.0, 1.0])
REFERENCE = torch.cat([ON_RAMP, ABOVE])
HEIGHT = torch.cat([torch.zeros(40), torch.ones(40)])


def measured(grid, height=None, **parameters):
    metric = CoverageMetric(grid, **parameters)
    metric.update(ON_RAMP, REFERENCE, heights_m=height)
    return metric.compute()


def test_on_a_ramp_bands_follow_the_ground():
    """Above ground, the ramp is ground and objects are obstacles; by z the ramp is an obstacle from 5 to 20 m."""
    by_ground, by_z = measured(GROUND, HEIGHT), measured(VEHICLE)
    assert (by_ground.point_counts == 1).all()
    torch.testing.assert_close(by_ground.radius[:, 0].float(), torch.tensor([[0.0] * 40, [1.0] * 40]))
    road = by_z.point_counts[:, 0]
    assert road[0].tolist() == [1] * 5 + [0] * 35
    assert road[1].tolist() == [1] * 5 + [2] * 5 + [1] * 10 + [0] * 20
    assert (by_ground.band_frame, by_z.band_frame) == ("ground", "vehicle")


def test_on_level_ground_both_are_the_same():
    points = REFERENCE * torch.tensor([1.0, 1.0, 0.0]) + torch.tensor([0.0, 0.0, 1.0]) * HEIGHT[:, None]
    both = []
    for grid, height in ((GROUND, HEIGHT), (VEHICLE, None)):
        metric = CoverageMetric(grid, aggregations=(Maximum(),), sensor_names=("low", "high"))
        metric.update({"low": ON_RAMP, "high": ABOVE}, points, heights_m=height)
        both.append(metric.compute())
    by_ground, by_z = both
    for key, layer in by_ground.layers.items():
        assert torch.equal(layer.values, by_z.layers[key].values)
    assert by_ground.counts == by_z.counts
    assert repr(by_ground.summary()) == repr(by_z.summary())


def test_points_without_ground_are_excluded_and_counted():
    holes = HEIGHT.clone()
    holes[:10] = math.nan
    result = measured(GROUND, holes)
    assert result.point_counts[:, 0].sum(dim=1).tolist() == [30, 40]
    assert (result.counts["no_ground_points"], result.counts["outside_points"]) == (10, 10)
    many = BevGrid(**EXTENT, heights={f"b{k}": (float(k), k + 1.0) for k in range(40)}, band_frame="ground")
    assert len(many.assign_cells(REFERENCE, holes).point_indices) == 70
    assert GROUND.count_points_by_column(REFERENCE, holes).sum() == 70


@pytest.mark.parametrize(
    ("grid", "height", "message"),
    [
        (GROUND, None, r"heights_m\[0\]: bands over the ground need the heights of points above it; got none"),
        (
            VEHICLE,
            HEIGHT,
            r"heights_m\[0\]: of no use for bands over z of the vehicle; use BevGrid\(band_frame='ground'\)",
        ),
        (GROUND, HEIGHT[:3], r"heights_m\[0\]: shape \(80,\), one for each point, is needed; got \(3,\)"),
        (
            GROUND,
            HEIGHT / 0,
            r"heights_m\[0\]: finite meters are needed, NaN where there is no ground; got infinite ones",
        ),
        (GROUND, [HEIGHT, HEIGHT], "1 weights, 2 heights, 1 block indices and 1 errors for 1 reference clouds"),
    ],
)
def test_mismatched_heights_are_refused(grid, height, message):
    with pytest.raises(ValueError, match=message) as refused:
        measured(grid, height)
    assert "\n" not in str(refused.value)
    with pytest.raises(ValueError, match="band_frame: ground or vehicle is needed; got 'world'"):
        BevGrid(**EXTENT, band_frame="world")


def test_a_step_without_points_needs_no_heights():
    metric = CoverageMetric(GROUND)
    metric.update([], [], weights=[])
    metric.update(ON_RAMP, torch.zeros(0, 3))
    assert metric.compute().counts["empty_reference_frames"] == 1


def test_different_band_frames_cannot_be_merged_or_compared(tmp_path):
    ground, vehicle = CoverageMetric(GROUND), CoverageMetric(VEHICLE)
    ground.update(ON_RAMP, REFERENCE, heights_m=HEIGHT)
    with pytest.raises(ValueError, match="cannot merge metrics with different grid"):
        vehicle.merge_state(ground)
    with pytest.raises(RuntimeError, match=r"belongs to another metric .* with other grid"):
        vehicle.load_state_dict(ground.metric_state)
    path = tmp_path / "coverage.npz"
    ground.compute().save(path)
    loaded = Coverage.load(path)
    assert (loaded.band_frame, loaded.grid) == ("ground", GROUND)
    with pytest.raises(ValueError, match="'a' and 'b' cannot be compared: they differ in their band_frame"):
        check_paired({"a": loaded, "b": measured(VEHICLE)})


def test_what_looks_at_frames_takes_their_heights():
    frame = Frame(
        {"rig": ON_RAMP}, REFERENCE, 0, "ramp", sensor_point_counts={"rig": {"one": 40}}, reference_heights_m=HEIGHT
    )
    observer, k_cover = CoverageObserver(CoverageMetric(GROUND)), KCover(GROUND, (), has_area_weights=False)
    density = PointDensity(GROUND, ())
    level = {"channels": 1, "columns": 1, "horizontal_fov_deg": 1, "max_range_m": 60, "mount": {"z_m": 1.0}}
    rays = [Lidar(name="ray", vertical_fov_deg=(up, up), **level) for up in (60, 0)]
    predicted = [FalseVisible([ray], None, GROUND) for ray in rays]
    for one in (observer, k_cover, density, *predicted):
        one.update(frame)
    assert torch.equal(observer.compute().point_counts, measured(GROUND, HEIGHT).point_counts)
    assert k_cover.compute()[0].value == 0.5
    # All points of the rig are on the ramp, one per square meter; by z half of them lie above 2 m.
    assert [number.value for number in density.compute()[1:]] == [1.0, 1.0]
    over_z = PointDensity(VEHICLE, ())
    over_z.update(frame)
    assert over_z.compute()[1].value == 0.5
    # Points above the ramp are detected in none of its 40 cells; rays 1 m above ground cross one of them, or all.
    assert [one.compute()[1].value for one in predicted] == [1 / 40, 1.0]
    unknown = dataclasses.replace(frame, reference_heights_m=None)
    for one in (observer, k_cover, density):
        with pytest.raises(ValueError, match=r"frame 'ramp': the heights .* are unknown; use the band frame vehicle"):
            one.update(unknown)
