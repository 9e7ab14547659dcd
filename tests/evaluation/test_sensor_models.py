"""Sensor models and weather: named in every result, and never an improvement."""

from dataclasses import replace

import pytest

from torchcover.evaluation import evaluate
from torchcover.report import render_page
from torchcover.simulation import Lidar, Rig, Weather

RIG = Rig.model_validate(
    {
        "name": "roof",
        "sensors": [
            {
                "name": "roof",
                "mount": {"z_m": 1.9},
                "channels": 32,
                "vertical_fov_deg": [-25.0, 5.0],
                "columns": 360,
                "horizontal_fov_deg": 360.0,
                "max_range_m": 150.0,
                "range_at_10_percent_m": 40.0,
            }
        ],
    }
)
SETTINGS = {"num_frames": 2, "num_rays": 1024}


def get_numbers(result, name):
    """Return the rows with a radius by region and band."""
    rows = [row for row in result.summary if row["rig"] == name]
    return {(row["region"], row["band"]): row for row in rows if row["radius_m"] is not None}


def get_radius_and_detection(row):
    detection = next(value for key, value in row.items() if key.startswith("detection"))
    return row["radius_m"], detection


@pytest.fixture(scope="module")
def results():
    """Results of ideal sensors, and of real sensors in increasingly bad weather."""
    weather = ("clear", "fog_200m", "fog_50m", "rain_50mm_h")
    ideal = evaluate(RIG, "courtyard", sensor_model="ideal", **SETTINGS)
    return ideal, evaluate(RIG, "courtyard", weather=weather, **SETTINGS)


@pytest.mark.parametrize(
    ("better", "worse"),
    [
        ("roof", "roof, clear"),
        ("roof, clear", "roof, fog_200m"),
        ("roof, fog_200m", "roof, fog_50m"),
        ("roof, clear", "roof, rain_50mm_h"),
    ],
)
def test_worse_conditions_never_improve_a_rig(results, better, worse):
    ideal, real = results
    before = get_numbers(ideal if better == "roof" else real, better)
    after = get_numbers(real, worse)
    assert before.keys() == after.keys()
    falls = 0
    for key in before:
        (radius_m, detection), (worse_radius_m, worse_detection) = (
            get_radius_and_detection(before[key]),
            get_radius_and_detection(after[key]),
        )
        assert worse_radius_m >= radius_m - 1e-9
        assert worse_detection <= detection + 1e-9
        falls += worse_detection < detection
    assert falls


def test_results_name_sensor_model_and_weather(results):
    ideal, real = results
    assert ideal.record["sensor_model"] == {"roof": "ideal"}
    assert "Sensor model: ideal" in str(ideal)
    assert set(real.record["sensor_model"].values()) == {"real"}
    assert real.record["weather"]["roof, fog_50m"] == "fog_50m"
    assert "Weather: clear, fog_200m, fog_50m, rain_50mm_h." in str(real)


def test_different_sensor_models_are_a_finding(results):
    _, real = results
    mixed = replace(real, source={**real.source, "sensor_model": {"a": "real", "b": "ideal"}})
    assert mixed.verdict[-1] == "Sensor models differ: a real, b ideal; differences between rigs include their effect."
    assert not any("Sensor model" in sentence for result in results for sentence in result.verdict)


def test_the_paper_reference_implies_ideal_sensors():
    result = evaluate(RIG, reference="paper", num_rays=256, num_frames=1)
    assert result.record["sensor_model"] == {"roof": "ideal"}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"sensor_model": "perfect"}, "`ideal` or `real` is needed"),
        ({"sensor_model": "real", "rigs": "front_roof_32"}, "no LiDAR of the rig 'front_roof_32'"),
        ({"weather": "fog_10m"}, "is 'fog_100m' or"),
        ({"weather": [Weather(), Weather(visibility_m=9.0)]}, "two have the same name, weather, weather"),
    ],
)
def test_invalid_sensor_models_and_weathers_are_rejected(settings, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        evaluate(**({"rigs": RIG, "num_frames": 1} | settings))


def test_lidar_models_define_range_at_ten_percent():
    assert Lidar.model_validate({"name": "a", "model": "velodyne_vlp32c"}).range_at_10_percent_m == 115.0


def test_results_name_perfect_depth_and_scan_periods():
    camera = {"type": "camera", "mount": {"x_m": 2.0, "z_m": 1.5}, "width": 32, "height": 24, "max_range_m": 60.0}
    camera |= {"name": "front", "fov_deg": 90.0}
    cameras = {
        "exact": {},
        "stereo": {"stereo": {"baseline_m": 0.1, "subpixel_px": 0.2}},
        "rolling": {"scan": {"period_s": 0.03}},
    }
    rigs = [Rig.model_validate({"name": name, "sensors": [{**camera, **more}]}) for name, more in cameras.items()]
    alone = evaluate(rigs[1], "courtyard", **SETTINGS)
    assert not any("depth" in note or "Scan" in note for note in alone.record["notes"])
    result = evaluate(rigs, "courtyard", **SETTINGS)
    depth = "Perfect depth is assumed for cameras of exact (front); rolling (front)"
    scans = "Scan periods differ: exact at once, stereo at once, rolling 0.03 s. Motion during the scan"
    page = render_page(result.page).partition('<script type="application/json"')[0]
    for text in (depth, scans):
        assert any(text in note for note in result.record["notes"])
        assert text in " ".join(str(result).split())
        assert text in page
    assert any(scans in sentence for sentence in result.verdict)
