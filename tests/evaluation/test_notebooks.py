"""Results in notebooks: HTML with a figure, and rows and maps as data frames and xarray data sets."""

import re
import sys
from base64 import b64decode
from html.parser import HTMLParser

import numpy as np
import pytest

import torchcover
from torchcover.data import SimulatedFrames
from torchcover.detection import measure_box_visibility
from torchcover.encounters import EncounterSet
from torchcover.simulation import Rig
from torchcover.targets import STATES, Raster

NASTY = "<script>alert(1)</script>"
CROSSING = {
    "name": "a",
    "ego": {"speed_kmh": [20, 30]},
    "road_user": {"body": "adult", "speed_kmh": 5, "approach_distance_m": 2},
}
MAX_REPR_CHARS = 800


@pytest.fixture(scope="module")
def results():
    nasty = (rig := Rig.load("front_roof_32")).model_copy(update={"name": NASTY})
    result = torchcover.evaluate([nasty, rig], num_frames=2, num_rays=1024, cell_m=1.0)
    return {
        "result": result,
        "coverage": result.coverages[NASTY],
        "target": torchcover.map_target_visibility(nasty, "child", raster=Raster((-4.0, 4.0), (-3.0, 3.0), 0.5)),
        "encounters": torchcover.evaluate_encounters(
            nasty, EncounterSet.model_validate({"name": "s", "encounters": [CROSSING]}), num_start_offsets=2
        ),
    }


@pytest.mark.usefixtures("drawn_maps")
@pytest.mark.parametrize("name", ["result", "coverage", "target", "encounters"])
def test_notebooks_show_escaped_text_and_one_small_figure(results, name):
    html, tags = results[name]._repr_html_(), []
    parser = HTMLParser()
    parser.handle_starttag = lambda tag, attrs: tags.append(tag)
    parser.feed(html)
    assert set(tags) - {"code"} == {"p", "strong", "img"}
    (picture,) = re.findall(r'src="data:image/png;base64,([^"]+)"', html)
    assert b64decode(picture).startswith(b"\x89PNG")
    assert len(html) < 200_000


def test_notebooks_show_the_verdict(results, monkeypatch):
    monkeypatch.setattr(type(results["result"]), "verdict", ("Detected & measured.",))
    assert "<p>Detected &amp; measured.</p>" in results["result"]._repr_html_()
    assert repr(results["result"]).endswith("\nDetected & measured.")


def test_data_frames_have_the_rows_of_the_summary(results):
    table, rows = results["result"].to_dataframe(), results["result"].summary
    assert len(table) == len(rows)
    for index, row in enumerate(rows):
        assert table["region"][index] == row["region"]
        assert table["detection_0.4m"][index] == pytest.approx(
            np.nan if row["detection_0.4m"] is None else row["detection_0.4m"], nan_ok=True
        )
    assert table["detection_0.4m_error"].isna().all()
    coverage_table = results["coverage"].to_dataframe().set_index(["region", "band"])
    for key, value in results["coverage"].scalars().items():
        name, *region_and_band = key.split("/")
        assert coverage_table[name][tuple(region_and_band)] == pytest.approx(value, nan_ok=True)
    assert results["encounters"].to_dataframe()["speed_kmh"].tolist() == [20.0, 30.0]


def test_xarray_maps_have_coordinates(results):
    coverage, child = results["coverage"], results["target"]
    maps = coverage.to_xarray()
    assert maps["radius_m"].dims == ("band", "y_m", "x_m")
    np.testing.assert_array_equal(maps["radius_m"], coverage.radius)
    points = maps["point_counts"].sel(band="ground").sel(x_m=10.5, y_m=-0.5)
    assert int(points) == int(coverage.point_counts[0, 39, 50])
    target_maps, table = child.to_xarray(), child.to_dataframe()
    np.testing.assert_array_equal(target_maps["points"], child.points)
    np.testing.assert_array_equal(target_maps["points_roof"], child.sensor_points[0])
    assert len(table) == child.points.size
    row, column = 5, 14
    record = table.iloc[row * child.points.shape[1] + column]
    assert (record["x_m"], record["y_m"]) == (child.x_m[column], child.y_m[row])
    assert record["points"] == child.points[row, column]
    assert (record["side"], record["state"]) == (child.get_position(row, column).side, STATES[child.state[row, column]])


def test_an_unknown_layer_cannot_be_plotted(results):
    with pytest.raises(ValueError, match="no map shows 'radius_cm'"):
        results["result"].plot("radius_cm")
    with pytest.raises(ValueError, match="one of radius_m"):
        results["coverage"].plot("radius_cm")


def test_missing_packages_are_named_with_their_extra(results, monkeypatch):
    for package in ("pandas", "xarray"):
        monkeypatch.setitem(sys.modules, package, None)
    for convert in (results["result"].to_dataframe, results["coverage"].to_xarray, results["target"].to_dataframe):
        with pytest.raises(ModuleNotFoundError, match=r"pip install 'torchcover\[frames\]'"):
            convert()


def test_the_repr_of_arrays_is_their_shape(results):
    frame = SimulatedFrames("courtyard", "front_roof_32", num_frames=1, boxes=True)[0]
    weights = frame.reference_weights
    visibility = measure_box_visibility(frame.sensor, frame.reference, frame.boxes, reference_weights=weights)
    assert repr(frame).startswith(f"Frame(clouds={{'front_roof_32': ({len(frame.sensor)}, 3) float32}}, reference=(")
    for value in (frame, frame.boxes, visibility, *results.values()):
        assert len(repr(value)) < MAX_REPR_CHARS, type(value)
