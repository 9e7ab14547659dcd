"""What an interactive session shows of results, and their rows as frames of data."""

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
MEETING = {
    "name": "a",
    "ego": {"speed_kmh": [20, 30]},
    "road_user": {"body": "adult", "speed_kmh": 5, "approach_distance_m": 2},
}
MOST_CHARS = 800


@pytest.fixture(scope="module")
def results():
    nasty = (rig := Rig.load("front_roof_32")).model_copy(update={"name": NASTY})
    result = torchcover.evaluate([nasty, rig], num_frames=2, num_rays=1024, cell_m=1.0)
    return {
        "result": result,
        "coverage": result.coverages[NASTY],
        "target": torchcover.map_target_visibility(nasty, "child", raster=Raster((-4.0, 4.0), (-3.0, 3.0), 0.5)),
        "met": torchcover.evaluate_encounters(
            nasty, EncounterSet.model_validate({"name": "s", "encounters": [MEETING]}), num_start_offsets=2
        ),
    }


@pytest.mark.usefixtures("drawn_maps")
@pytest.mark.parametrize("name", ["result", "coverage", "target", "met"])
def test_a_notebook_shows_words_and_a_small_picture_and_names_stay_names(results, name):
    html, tags = results[name]._repr_html_(), []
    parser = HTMLParser()
    parser.handle_starttag = lambda tag, attrs: tags.append(tag)
    parser.feed(html)
    assert set(tags) - {"code"} == {"p", "strong", "img"}
    (picture,) = re.findall(r'src="data:image/png;base64,([^"]+)"', html)
    assert b64decode(picture).startswith(b"\x89PNG")
    assert len(html) < 200_000


def test_a_notebook_is_told_the_verdict(results, monkeypatch):
    monkeypatch.setattr(type(results["result"]), "verdict", ("Seen & told.",))
    assert "<p>Seen &amp; told.</p>" in results["result"]._repr_html_()
    assert repr(results["result"]).endswith("\nSeen & told.")


def test_rows_are_those_of_the_tables_and_unknown_is_nan(results):
    table, rows = results["result"].to_dataframe(), results["result"].summary
    assert len(table) == len(rows)
    for at, row in enumerate(rows):
        assert table["region"][at] == row["region"]
        assert table["detection_0.4m"][at] == pytest.approx(
            np.nan if row["detection_0.4m"] is None else row["detection_0.4m"], nan_ok=True
        )
    assert table["detection_0.4m_error"].isna().all()
    scalars, of_coverage = (
        results["coverage"].scalars(),
        results["coverage"].to_dataframe().set_index(["region", "height"]),
    )
    for key, value in scalars.items():
        name, *place = key.split("/")
        assert of_coverage[name][tuple(place)] == pytest.approx(value, nan_ok=True)
    assert results["met"].to_dataframe()["speed_kmh"].tolist() == [20.0, 30.0]


def test_maps_have_their_places(results):
    coverage, child = results["coverage"], results["target"]
    maps = coverage.to_xarray()
    assert maps["radius_m"].dims == ("height", "y_m", "x_m")
    np.testing.assert_array_equal(maps["radius_m"], coverage.radius)
    there = maps["points"].sel(height="ground").sel(x_m=10.5, y_m=-0.5)
    assert int(there) == int(coverage.points[0, 39, 50])
    places, table = child.to_xarray(), child.to_dataframe()
    np.testing.assert_array_equal(places["points"], child.points)
    np.testing.assert_array_equal(places["points_roof"], child.sensor_points[0])
    assert len(table) == child.points.size
    row, column = 5, 14
    one = table.iloc[row * child.points.shape[1] + column]
    assert (one["x_m"], one["y_m"], one["points"]) == (child.x_m[column], child.y_m[row], child.points[row, column])
    assert (one["side"], one["state"]) == (child.place(row, column).side, STATES[child.state[row, column]])


def test_a_picture_that_there_is_not_is_told(results):
    with pytest.raises(ValueError, match="no map shows 'radius_cm'"):
        results["result"].plot("radius_cm")
    with pytest.raises(ValueError, match="one of radius_m"):
        results["coverage"].plot("radius_cm")


def test_without_the_extra_it_is_told(results, monkeypatch):
    for package in ("pandas", "xarray"):
        monkeypatch.setitem(sys.modules, package, None)
    for ask in (results["result"].to_dataframe, results["coverage"].to_xarray, results["target"].to_dataframe):
        with pytest.raises(ModuleNotFoundError, match=r"pip install 'torchcover\[frames\]'"):
            ask()


def test_what_holds_arrays_is_called_by_their_shapes(results):
    frame = SimulatedFrames("courtyard", "front_roof_32", num_frames=1, boxes=True)[0]
    seen = measure_box_visibility(frame.sensor, frame.reference, frame.boxes, reference_weights=frame.reference_weights)
    assert repr(frame).startswith(f"Frame(clouds={{'front_roof_32': ({len(frame.sensor)}, 3) float32}}, reference=(")
    for one in (frame, frame.boxes, seen, *results.values()):
        assert len(repr(one)) < MOST_CHARS, type(one)
