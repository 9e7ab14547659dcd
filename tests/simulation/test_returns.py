"""Range-limited returns: closed forms, and worse conditions never give more returns."""

import re

import numpy as np
import pytest
import yaml

from torchcover.simulation import Lidar, Material, PaperReference, Rig, Scenario, Simulator, list_builtin_names
from torchcover.simulation.returns import (
    MAX_RETURN_PROBABILITY,
    compute_extinction_per_m,
    compute_log_excess,
    compute_return_probability,
)

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
def test_half_of_rays_return_at_rated_range(range_at_10_percent_m, reflectivity):
    """Four times the reflectivity doubles the range."""
    range_m = range_at_10_percent_m * np.sqrt(reflectivity / 0.1)
    excess = compute_log_excess(range_m, 1.0, reflectivity, 1.0, range_at_10_percent_m)
    assert compute_return_probability(excess, 0.3) == pytest.approx(MAX_RETURN_PROBABILITY / 2, abs=1e-15)
    one_spread_nearer = compute_log_excess(range_m * np.exp(-0.3), 1.0, reflectivity, 1.0, range_at_10_percent_m)
    assert compute_return_probability(one_spread_nearer, 0.3) / MAX_RETURN_PROBABILITY == pytest.approx(
        0.8413447460685429
    )


def test_road_returns_fall_with_cubed_range():
    """With cos = h / R, half of the rays return at (R10^2 h)^(1/3)."""
    range_m = (60.0**2 * 1.9) ** (1 / 3)
    assert compute_log_excess(range_m, 1.9 / range_m, 0.1, 1.0, 60.0) == pytest.approx(0.0, abs=1e-14)


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
def test_worse_conditions_never_increase_return_probability(worse):
    hit = {
        "range_m": 50.0,
        "cos_incidence": 0.5,
        "reflectivity": 0.2,
        "incidence_exponent": 1.0,
        "range_at_10_percent_m": 70.0,
    }
    assert compute_log_excess(**(hit | worse)) < compute_log_excess(**hit)


def test_black_never_returns_and_retroreflectors_always_do():
    excess = compute_log_excess(50.0, 0.1, np.array([0.0, np.inf]), 1.0, 1.0)
    assert compute_return_probability(excess, 0.3).tolist() == [0.0, MAX_RETURN_PROBABILITY]


def test_contrast_at_visibility_range_is_five_percent():
    assert np.exp(-compute_extinction_per_m(80.0) * 80.0) == pytest.approx(0.05)
    assert compute_extinction_per_m(None) == 0.0


def test_built_in_materials_are_named_after_files():
    assert [Material.load(name).name for name in list_builtin_names("materials")] == list_builtin_names("materials")


def test_invalid_materials_are_reported():
    for reflectivity in (1.5, -0.1, True, "shiny", float("nan"), None):
        message = "Material: reflectivity: a share of light from 0 to 1, or `retroreflective`, is needed; got "
        with pytest.raises(ValueError, match=f"^{re.escape(message + repr(reflectivity))}$"):
            Material(name="snow", reflectivity=reflectivity)
    with pytest.raises(FileNotFoundError, match="is 'brick' meant"):
        Material.load("bricks")


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"range_at_10_percent_m": 0.0}, "a number above 0"),
        ({"range_at_10_percent_m": 50.0, "log_range_std": 0.0}, "a number above 0"),
        ({"range_factors": [1.0]}, "one for each of the 2 rows is needed; got 1"),
    ],
)
def test_invalid_lidar_keys_are_reported(keys, message):
    with pytest.raises(ValueError, match=message):
        Lidar(**KEYS | keys)


PLAIN = {
    "name": "plain",
    "ego": {"pose": {}, "shape": {"type": "box", "size_m": [0.5, 0.5, 0.5]}},
    "bodies": [
        {"name": "plain", "ground": True, "shape": {"type": "plane", "size_m": [400.0, 400.0]}},
        {"name": "wall", "shape": {"type": "box", "size_m": [1.0, 30.0, 8.0]}, "poses": [{"x_m": 60.0}]},
    ],
}
ROOF = {
    "name": "roof",
    "mount": {"z_m": 2.0},
    "channels": 40,
    "vertical_fov_deg": [-8.0, -1.5],
    "columns": 720,
    "horizontal_fov_deg": 360.0,
    "max_range_m": 150.0,
    "range_at_10_percent_m": 60.0,
    "log_range_std": 0.25,
}


def simulate(weather=None, index=0, bodies=None, **keys):
    """Simulate a LiDAR on a plane in one frame."""
    scenario = Scenario.model_validate(PLAIN | {"weather": weather or {}} | ({"bodies": bodies} if bodies else {}))
    rig = Rig.model_validate({"name": "rig", "sensors": [ROOF | keys]})
    return Simulator(scenario, {"rig": rig}, PaperReference(rows=2, columns=2)).simulate_scans(index)["rig"][0]


def test_returns_from_a_plane_follow_the_law():
    every, returned = simulate(range_at_10_percent_m=None), simulate()
    road = Material.load("road")
    is_road = every.points[:, 2] < 1e-3
    excess = compute_log_excess(
        every.range_m.astype(float),
        2.0 / every.range_m,
        road.numeric_reflectivity,
        road.incidence_exponent,
        ROOF["range_at_10_percent_m"],
    )
    expected = compute_return_probability(excess, ROOF["log_range_std"], road.log_reflectivity_std)
    is_returned = np.isin(every.ray_indices, returned.ray_indices)
    for low_m in range(15, 75, 15):
        in_bin = is_road & (every.range_m > low_m) & (every.range_m < low_m + 15)
        error = np.sqrt((expected * (1 - expected))[in_bin].sum()) / in_bin.sum()
        assert is_returned[in_bin].mean() == pytest.approx(expected[in_bin].mean(), abs=4 * error + 1e-9)


@pytest.mark.parametrize(
    ("worse", "keys"),
    [
        ({"visibility_m": 100.0}, {}),
        ({"rain_mm_h": 50.0}, {}),
        ({"road": "wet"}, {}),
        (None, {"range_at_10_percent_m": 40.0}),
        (None, {"range_factors": [0.5] * 40}),
        (None, {"dropout": 0.3}),
    ],
    ids=["fog", "rain", "wet", "short", "factors", "dropout"],
)
def test_worse_conditions_never_add_returns(worse, keys):
    """With the same random numbers, no return is added and some are lost."""
    clear, bad = simulate(), simulate(worse, **keys)
    assert set(bad.ray_indices.tolist()) < set(clear.ray_indices.tolist())


def test_rows_have_separate_range_factors():
    """The rows of the lower half have few returns."""
    factors = np.where(np.arange(40) < 20, 1e-3, 1.0).tolist()
    lower, every = simulate(range_factors=factors).points, simulate().points
    assert len(lower) < 0.6 * len(every)
    assert np.hypot(*lower[:, :2].T).min() > 20 > np.hypot(*every[:, :2].T).min()


def test_reflective_surfaces_return_from_farther_away():
    """Paint, a traffic sign and a black surface in place of the road."""

    def of(material):
        ground = {"name": "plain", "shape": {"type": "plane", "size_m": [400.0, 400.0]}, "material": material}
        return len(simulate(bodies=[ground]).ray_indices)

    assert of("glass") < of("tyre") < of("road") < of("lane_paint") < of("sign")
    assert of("sign") == pytest.approx(
        MAX_RETURN_PROBABILITY * len(simulate(range_at_10_percent_m=None, bodies=PLAIN["bodies"][:1]).ray_indices),
        rel=0.01,
    )


def test_material_paths_are_relative_to_the_scenario(tmp_path):
    """Only the content counts: black returns nothing, whatever its name."""
    of = []
    for reflectivity in (0.0, "retroreflective", 0.0):
        (tmp_path / "own.yaml").write_text(yaml.safe_dump({"name": "own", "reflectivity": reflectivity}))
        ground = PLAIN["bodies"][0] | {"material": "own.yaml"}
        (tmp_path / "scenario.yaml").write_text(yaml.safe_dump(PLAIN | {"bodies": [ground]}))
        scenario = Scenario.load(tmp_path / "scenario.yaml")
        of.append((len(simulate(bodies=scenario.bodies).points), scenario.collect_content()))
    assert of[0] == of[2]
    assert of[0][0] == 0 < of[1][0]
    assert of[0][1] != of[1][1]


def test_saved_rigs_keep_materials_of_housings(tmp_path, monkeypatch):
    """The same holds for any file that a document names."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").mkdir()
    (tmp_path / "own.yaml").write_text(yaml.safe_dump({"name": "own", "reflectivity": 0.4}))
    body = {"name": "mast", "shape": {"type": "cylinder", "radius_m": 0.1, "height_m": 1.0}, "material": "own.yaml"}
    sensor = KEYS | {"mount": {}, "housing": [body]}
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump({"name": "r", "sensors": [sensor]}))
    rig = Rig.load("rig.yaml")
    rig.save("there/again.yaml")
    monkeypatch.chdir(tmp_path / "there")
    loaded_rig = Rig.load("again.yaml")
    assert loaded_rig.sensors[0].housing[0].material == str(tmp_path / "own.yaml")
    assert loaded_rig.collect_content() == Rig.load(tmp_path / "rig.yaml").collect_content()


def test_reflectivity_is_constant_over_body_and_time():
    """Black cars have few returns, and the same cars are black one frame later."""
    bodies = [
        PLAIN["bodies"][0],
        *(
            {
                "name": f"car {number}",
                "material": "car_paint",
                "shape": {"type": "box", "size_m": [4.0, 1.8, 1.5]},
                "poses": [{"x_m": 40.0 * np.cos(number / 4), "y_m": 40.0 * np.sin(number / 4)}],
            }
            for number in range(24)
        ),
    ]
    every, shares = simulate(range_at_10_percent_m=None, bodies=bodies), []
    on_car = every.points[:, 2] > 0.01
    car = np.round(np.arctan2(every.points[:, 1], every.points[:, 0]) * 4).astype(int)
    for index in (0, 1):
        is_returned = np.isin(every.ray_indices, simulate(index=index, bodies=bodies).ray_indices)
        shares.append(np.array([is_returned[on_car & (car == number)].mean() for number in np.unique(car[on_car])]))
    assert np.ptp(shares[0]) > 0.9
    assert np.abs(shares[0] - shares[1]).max() < 0.25


def test_ideal_rigs_have_no_range_at_10_percent():
    rig = Rig.model_validate({"name": "rig", "sensors": [ROOF]})
    ideal = rig.apply_sensor_model("ideal")
    assert (rig.sensor_model, ideal.sensor_model, ideal.apply_sensor_model(None).sensor_model) == (
        "real",
        "ideal",
        "ideal",
    )
    assert not rig.sensors[0].is_exact
    assert ideal.sensors[0].is_exact
    with pytest.raises(ValueError, match="no LiDAR of the rig 'rig' has a range_at_10_percent_m"):
        ideal.apply_sensor_model("real")


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"weather": {"visibility_m": 0.0}}, "visibility_m: a number above 0"),
        ({"weather": {"rain_mm_h": -1.0}}, "a number of at least 0"),
        ({"bodies": [PLAIN["bodies"][0] | {"material": "raod"}]}, "is 'road' meant"),
    ],
)
def test_invalid_weather_and_materials_are_reported(keys, message, tmp_path):
    path = tmp_path / "world.yaml"
    path.write_text(yaml.safe_dump(PLAIN | keys))
    with pytest.raises(ValueError, match=message):
        Scenario.load(path)


def test_fog_limits_cameras_but_not_radars():
    foggy = Scenario.model_validate(PLAIN | {"weather": {"visibility_m": 50.0}})
    camera, radar = Rig.load("three_cameras").sensors[0], Rig.load("nuscenes_radars").sensors[0]
    assert foggy.compute_max_range_m(camera) == 50.0
    assert foggy.compute_max_range_m(radar) == radar.max_range_m
    assert foggy.compute_max_range_m(Rig.load("kitti").sensors[0]) == Rig.load("kitti").sensors[0].max_range_m
