"""The law of returns: what it says where that is known, and that nothing bad makes more of them."""

import numpy as np
import pytest
from pydantic import ValidationError

from torchcover.simulation import Lidar, Material, builtin_names
from torchcover.simulation.returns import SURE, extinction_per_m, log_excess, return_probability

KEYS = {
    "name": "a",
    "channels": 2,
    "vertical_fov_deg": [-9, 0],
    "columns": 4,
    "horizontal_fov_deg": 360,
    "max_range_m": 9,
}


@pytest.mark.parametrize("range_at_10_percent_m", [40.0, 200.0])
@pytest.mark.parametrize("reflectivity", [0.1, 0.4])
def test_every_other_ray_returns_from_where_the_data_sheet_says(range_at_10_percent_m, reflectivity):
    """Four times as bright is twice as far."""
    range_m = range_at_10_percent_m * np.sqrt(reflectivity / 0.1)
    excess = log_excess(range_m, 1.0, reflectivity, 1.0, range_at_10_percent_m)
    assert return_probability(excess, 0.3) == pytest.approx(SURE / 2, abs=1e-15)
    one_spread_nearer = log_excess(range_m * np.exp(-0.3), 1.0, reflectivity, 1.0, range_at_10_percent_m)
    assert return_probability(one_spread_nearer, 0.3) / SURE == pytest.approx(0.8413447460685429)


def test_lambert_on_a_road_falls_with_the_cube_of_the_range():
    """cos = h / R: where half the rays return is at (R10^2 h)^(1/3)."""
    range_m = (60.0**2 * 1.9) ** (1 / 3)
    assert log_excess(range_m, 1.9 / range_m, 0.1, 1.0, 60.0) == pytest.approx(0.0, abs=1e-14)


@pytest.mark.parametrize(
    "worse",
    [
        {"range_m": 60.0},
        {"cos_incidence": 0.3},
        {"reflectivity": 0.1},
        {"incidence_exponent": 1.5},
        {"range_at_10_percent_m": 50.0},
        {"extinction_per_m": 0.001},
    ],
)
def test_whatever_is_worse_returns_less(worse):
    hit = {
        "range_m": 50.0,
        "cos_incidence": 0.5,
        "reflectivity": 0.2,
        "incidence_exponent": 1.0,
        "range_at_10_percent_m": 70.0,
    }
    assert log_excess(**(hit | worse)) < log_excess(**hit)


def test_what_reflects_nothing_never_returns_and_a_retroreflector_always_does():
    excess = log_excess(50.0, 0.1, np.array([0.0, np.inf]), 1.0, 1.0)
    assert return_probability(excess, 0.3).tolist() == [0.0, SURE]


def test_a_contrast_of_five_percent_is_left_at_the_visibility():
    assert np.exp(-extinction_per_m(80.0) * 80.0) == pytest.approx(0.05)
    assert extinction_per_m(None) == 0.0


def test_each_builtin_material_is_called_as_its_file():
    assert [Material.load(name).name for name in builtin_names("materials")] == builtin_names("materials")


def test_bad_materials_are_told():
    with pytest.raises(ValidationError, match="less than or equal to 1"):
        Material(name="snow", reflectivity=1.2)
    with pytest.raises(ValidationError, match="greater than or equal to 0"):
        Material(name="hole", reflectivity=-0.1)
    with pytest.raises(FileNotFoundError, match="is 'brick' meant"):
        Material.load("bricks")


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"range_at_10_percent_m": 0.0}, "greater than 0"),
        ({"range_at_10_percent_m": 50.0, "spread": 0.0}, "greater than 0"),
        ({"range_factors": [1.0]}, "one for each of the 2 rows is needed; got 1"),
    ],
)
def test_bad_keys_of_a_lidar_are_told(given, told):
    with pytest.raises(ValidationError, match=told):
        Lidar.model_validate(KEYS | given)
