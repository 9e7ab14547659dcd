"""Redundancy: a rig without a sensor equals a metric of the other sensors."""

import math

import pytest
import torch

from torchcover import BevGrid, Coverage, CoverageMetric, Region
from torchcover.coverage import compute_differences

GRID = BevGrid(x_m=(-2.0, 2.0), y_m=(-1.0, 1.0), cell_m=0.5, heights={"low": (-2.0, 0.3), "high": (0.0, 2.0)})
REGIONS = [
    Region("left", (-2.0, 2.0), (0.0, 1.0)),
    Region.from_corners("corner", [(-2.0, -1.0), (2.0, -1.0), (-2.0, 1.0)]),
]
SENSORS = ("roof", "left", "rear")
OPTIONS = {"thresholds_m": (0.3, 0.8), "max_radius_m": 3.0, "num_blocks": 8, "regions": REGIONS}


def steps(count=16, empty=()):
    for index in range(count):
        generator = torch.Generator().manual_seed(index)
        clouds = {name: torch.randn(9, 3, generator=generator) for name in SENSORS}
        clouds |= {name: torch.empty(0, 3) for name in empty}
        # Sums of powers of two are exact in any order.
        weights = 2.0 ** torch.randint(-3, 3, (300,), generator=generator)
        yield clouds, torch.randn(300, 3, generator=generator), weights


def measured(of_steps, *, without=None, by_sensor=True, **options):
    metric = CoverageMetric(GRID, **{**OPTIONS, **options}, sensor_names=SENSORS if by_sensor else ())
    for clouds, reference, weights in of_steps:
        rest = torch.cat([cloud for name, cloud in clouds.items() if name != without])
        metric.update(clouds if by_sensor else rest, reference, weights=weights)
    return metric.compute()


@pytest.mark.parametrize("has_area_weights", [True, False])
def test_with_all_sensors_it_is_the_rig(has_area_weights):
    by_sensor, union = (
        measured(steps(), by_sensor=each, has_area_weights=has_area_weights).layers for each in (True, False)
    )
    assert by_sensor.keys() == union.keys()
    for key, layer in union.items():
        torch.testing.assert_close(by_sensor[key].values, layer.values, rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize("empty", [(), ("left",)])
@pytest.mark.parametrize("has_area_weights", [True, False])
def test_failure_numbers_equal_the_rig_without_the_sensor(has_area_weights, empty):
    whole = measured(steps(empty=empty), has_area_weights=has_area_weights)
    alone = measured(steps(empty=empty), by_sensor=False, has_area_weights=has_area_weights)
    for sensor in SENSORS:
        rest = measured(steps(empty=empty), without=sensor, by_sensor=False, has_area_weights=has_area_weights)
        for quantity in rest.quantities:
            key = quantity.key.replace("_", "_area_", 1) if has_area_weights else quantity.key
            result = whole.redundancy.layers[f"{quantity.key}_without_{sensor}"].values
            exact = (
                {"rtol": 0, "atol": 0} if has_area_weights and "detection" in key else {"rtol": 1e-13, "atol": 1e-15}
            )
            torch.testing.assert_close(result, rest.layers[key].values, equal_nan=True, **exact)
        for result, expected, full in zip(whole.summary(), rest.summary(), alone.summary(), strict=True):
            region = next(region for region in REGIONS if region.name == result.region)
            compared = compute_differences({"all": alone, "rest": rest}, region, result.band)["rest"]
            for key, number in expected.numbers.items():
                own = result.redundancy.failure_numbers[sensor][key]
                assert own.value == pytest.approx(number.value, rel=1e-13)
                change = result.redundancy.failure_effects[sensor][key]
                assert change.value == pytest.approx(number.value - full.numbers[key].value, rel=1e-9, abs=1e-13)
                if has_area_weights:
                    assert own.error == pytest.approx(number.error, rel=1e-9)
                    assert change.error == pytest.approx(compared[key].error, rel=1e-6, abs=1e-12)
                    assert change.is_significant == compared[key].is_significant
                else:
                    assert math.isnan(own.error)
                    assert math.isnan(change.error)


def test_how_many_sensors_see_a_point_is_counted():
    whole = measured(steps(), has_area_weights=True)
    # The mean number of detecting sensors is the sum of the detection rates of single sensors.
    alone = []
    for sensor in SENSORS:
        only = [({sensor: clouds[sensor]}, reference, weights) for clouds, reference, weights in steps()]
        alone.append(measured(only, by_sensor=False, has_area_weights=True))
    number = sum(each.layers["detection_area_0.3m"].values for each in alone)
    torch.testing.assert_close(
        whole.redundancy.layers["sensors_0.3m"].values, number, rtol=1e-13, atol=0, equal_nan=True
    )
    for at, row in enumerate(whole.summary()):
        expected = sum(each.summary()[at].numbers["detection_0.8m"].value for each in alone)
        seen_by = row.redundancy.detecting_sensors
        assert seen_by["sensors_0.8m"].value == pytest.approx(expected, rel=1e-13)
        assert 0 < seen_by["detected_by_two_0.8m"].value < row.numbers["detection_0.8m"].value
        assert seen_by["sensors_0.8m"].error > 0


def test_duplicate_sensors_are_redundant_and_single_ones_critical():
    def twins():
        for clouds, reference, weights in steps():
            yield {"roof": clouds["roof"], "left": clouds["roof"], "rear": torch.empty(0, 3)}, reference, weights

    for row in measured(twins(), has_area_weights=True).summary():
        assert row.redundancy.most_critical_sensor is None
        assert {change.value for changes in row.redundancy.failure_effects.values() for change in changes.values()} == {
            0.0
        }
        assert row.redundancy.detecting_sensors["detected_by_two_0.3m"].value == row.numbers["detection_0.3m"].value
    for row in measured(steps(empty=("left", "rear")), has_area_weights=True).summary():
        assert row.redundancy.most_critical_sensor == "roof"
        assert row.redundancy.failure_numbers["roof"]["radius_m"].value == 3.0
        assert row.redundancy.failure_numbers["roof"]["detection_0.8m"].value == 0.0


@pytest.mark.parametrize("has_area_weights", [True, False])
def test_a_file_keeps_it(tmp_path, has_area_weights):
    whole = measured(steps(), has_area_weights=has_area_weights)
    whole.save(tmp_path / "c.npz")
    loaded = Coverage.load(tmp_path / "c.npz")
    assert loaded.regions == tuple(REGIONS)
    assert str(loaded.summary()) == str(whole.summary())
    assert loaded.redundancy.layers.keys() == whole.redundancy.layers.keys()


def test_unsummed_regions_have_no_redundancy_by_area():
    other = Region("other", (0.0, 2.0), (-1.0, 1.0))
    assert measured(steps(2), has_area_weights=True).summary([other])[0].redundancy is None
    assert measured(steps(2)).summary([other])[0].redundancy is not None


@pytest.mark.parametrize(
    ("sensor", "message"),
    [
        (torch.zeros(1, 3), "a dict with the clouds of roof, left, rear is needed; got Tensor"),
        ({"roof": torch.zeros(1, 3)}, "a dict with the clouds of roof, left, rear is needed; got roof"),
    ],
)
def test_other_clouds_are_refused(sensor, message):
    with pytest.raises(ValueError, match=message):
        CoverageMetric(GRID, sensor_names=SENSORS).update(sensor, torch.zeros(1, 3))


def test_named_clouds_need_a_metric_with_sensor_names():
    with pytest.raises(TypeError, match="got clouds by name, for which the metric needs sensor_names="):
        CoverageMetric(GRID).update({"roof": torch.zeros(1, 3)}, torch.zeros(1, 3))
