"""Maps of target visibility: sides, borders, worst positions, files and plots."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from torchcover.evaluation import build_flat_ground, build_target_record, map_target_visibility, save_target_map
from torchcover.geometry import BoundingBox
from torchcover.report.target_plots import PARAMS
from torchcover.simulation import set_ego
from torchcover.targets import Raster, Target, TargetMap

CAR = BoundingBox((-2.0, -1.0, 0.0), (2.0, 1.0, 1.5))
OUTLINE = np.array([[-2.0, -1.0], [2.0, -1.0], [2.0, 1.0], [-2.0, 1.0]])


def build_target_map(points, *, raster=None, state=None, share=None, detection_points=5, least=None):
    """Build a map whose points are a function of x and y, half of them from each of two sensors."""
    raster = raster or Raster((-6.0, 6.0), (-5.0, 5.0), 0.5)
    x, y = raster.positions_m.T
    number = np.broadcast_to(np.asarray(points(x, y), dtype=np.float64), x.shape).reshape(raster.shape)
    if state is None:
        within = (np.abs(x) < 2) & (np.abs(y) < 1)
        state = within.astype(np.uint8).reshape(raster.shape)
    number = np.where(state == 0, number, np.nan)
    return TargetMap(
        rig="<rig>",
        scenario="s",
        target="child_110cm",
        target_size_m=(0.2, 0.3, 1.1),
        target_bottom_m=0.0,
        heading="narrow",
        raster=raster,
        vehicle_box=CAR,
        vehicle_outline_m=OUTLINE,
        sensor_model="ideal",
        sensor_names=("a", "b"),
        sensor_positions_m=np.zeros((2, 2)),
        detection_points=detection_points,
        threshold_m=0.4,
        seed=0,
        num_frames=1,
        state=state,
        free_frames=(state == 0).astype(np.int64),
        sensor_points=np.stack([number / 2, number / 2]),
        detecting_sensors=np.where(number / 2 >= detection_points, 2.0, 0.0),
        detected_share=(number >= detection_points) * 1.0,
        min_points=number if least is None else np.where(state == 0, least, np.nan),
        min_sensors=np.where(number / 2 >= detection_points, 2.0, 0.0),
        surface_share=np.where(state == 0, 1.0, np.nan) if share is None else share,
        visible_m2=number * 0 + 1.0,
    )


def test_detection_border_separates_detected_from_undetected_cells():
    """The target is detected beyond 3.5 m ahead, and beyond 2 m to the left except for a gap."""
    seen = build_target_map(lambda x, y: np.where((x > 3.5) | ((y > 2) & ~((y > 3) & (y < 4))), 9, 0))
    edges = seen.compute_detection_border_m().reshape(-1, 3, 2)
    assert np.isnan(edges[:, 2]).all()
    rows, columns = seen.raster.shape
    expected = set()
    for row, column in np.ndindex(rows, columns):
        for other in ((row, column + 1), (row + 1, column)):
            inside = other[0] < rows and other[1] < columns
            if (
                inside
                and seen.free_mask[row, column]
                and seen.free_mask[other]
                and seen.detected_mask[row, column] != seen.detected_mask[other]
            ):
                x = (seen.x_m[column] + seen.x_m[other[1]]) / 2
                y = (seen.y_m[row] + seen.y_m[other[0]]) / 2
                expected.add((round(x, 6), round(y, 6)))
    assert {tuple(middle) for middle in edges[:, :2].mean(axis=1).round(6) + 0.0} == expected
    assert np.allclose(np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1), seen.raster.cell_m)
    assert len(edges) == len(expected)
    assert not len(build_target_map(lambda x, y: 9).compute_detection_border_m())


def test_sides_are_separated_at_45_degrees():
    seen = build_target_map(lambda x, y: np.where(x > 0, 9, 4))
    assert (np.bincount(seen.side.ravel() + 1) == [32, 104, 104, 120, 120]).all()
    by_side = {(row.side, row.max_distance_m): row for row in seen.summarize_sides()}
    assert by_side["front", 1.0].detected_share == 1.0
    assert by_side["rear", 3.0].detected_share == 0.0
    assert by_side["left", 2.0].detected_share == by_side["right", 2.0].detected_share == 0.5
    assert by_side["left", 1.0].free_cells == 16 + 2
    assert seen.find_max_undetected_ranges_m() == {
        "front": 0.0, "rear": pytest.approx(np.hypot(3.75, 3.75)),
        "left": pytest.approx(np.hypot(3.25, 3.75)), "right": pytest.approx(np.hypot(3.25, 3.75)),
    }  # fmt: skip
    closed = replace(seen, state=np.ones_like(seen.state))
    assert all(row.free_cells == 0 and np.isnan(row.detected_share) for row in closed.summarize_sides())
    assert np.isnan(list(closed.find_max_undetected_ranges_m().values())).all()
    half = replace(seen, detected_share=np.where(seen.free_mask, 0.5, np.nan))
    assert {row.detected_share for row in half.summarize_sides()} == {
        0.5
    }  # in every other frame, whatever the number of points


def test_targets_must_be_detected_in_every_frame():
    """Eighty points in one of sixteen frames are five on average."""
    seen = build_target_map(lambda x, y: 80 / 16, least=0)
    assert not seen.detected_mask.any()


def test_worst_positions_have_fewest_points_and_spacing():
    seen = build_target_map(lambda x, y: np.abs(x) + np.abs(y))
    worst = seen.find_worst_positions(3)
    assert [place.points for place in worst] == sorted(place.points for place in worst)
    assert worst[0].points == np.nanmin(seen.points) == 1.5
    places = np.array([[place.x_m, place.y_m] for place in worst])
    assert np.linalg.norm(places[:, None] - places, axis=2)[~np.eye(3, dtype=bool)].min() >= 1.0
    assert len(seen.find_worst_positions(10_000, min_spacing_m=0.1)) == seen.counts["free"]


def test_files_contain_the_map(tmp_path):
    seen = build_target_map(lambda x, y: np.abs(x) + 0.5, raster=Raster((-3.0, 3.0), (-2.0, 2.0), 1.0))
    names = [path.name for path in save_target_map(seen, tmp_path)]
    assert names == ["targets.csv", "targets.npz", "report.html", "targets.png", "summary.json"]
    with np.load(tmp_path / "targets.npz") as arrays:
        np.testing.assert_array_equal(arrays["points"], seen.points)
        np.testing.assert_array_equal(arrays["detection_border_m"], seen.compute_detection_border_m())
        assert json.loads(str(arrays["settings"]))["raster"] == {
            "x_bounds_m": [-3, 3],
            "y_bounds_m": [-2, 2],
            "cell_m": 1,
        }
        assert arrays["x_m"].tolist() == [-2.5, -1.5, -0.5, 0.5, 1.5, 2.5]
    rows = list(csv.DictReader((tmp_path / "targets.csv").read_text().splitlines()))
    assert len(rows) == 24
    assert (rows[0]["x_m"], rows[0]["points"], rows[0]["points_a"], rows[0]["state"]) == ("-2.5", "3", "1.5", "free")
    assert (rows[8]["state"], rows[8]["points"], rows[8]["side"]) == ("occupied", "", "")
    record = json.loads((tmp_path / "summary.json").read_text())
    assert record["cells"] == {"free": 16, "occupied": 8, "outside": 0, "surface_share_unobserved": 0}
    assert build_target_record(replace(seen, state=np.ones_like(seen.state)))["sides"][0]["detected_share"] is None


def test_plot_shows_cells_at_their_positions():
    seen = build_target_map(lambda x, y: np.where(y > 0, 0, 100))
    figure = seen.plot()
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[..., :3]

    def at(x, y):
        column, row = figure.axes[0].transData.transform((x, y))
        return "#" + "".join(f"{value:02x}" for value in pixels[len(pixels) - 1 - int(row), int(column)])

    assert at(-5.3, 4.3) == at(5.3, 1.3) == PARAMS.undetected_color
    assert at(5.3, -4.3) not in (PARAMS.undetected_color, "#ffffff")
    assert at(1.9, 0.9) == at(-1.9, -0.9) == "#ffffff"  # the vehicle at its true size
    assert at(5.25, 0.0) < "#202020"  # the border of detection
    assert figure.axes[0].get_legend() is not None


def test_targets_load_from_names_and_files(tmp_path):
    (tmp_path / "post.yaml").write_text(
        "name: my post\nparts: [{name: p, shape: {type: box, size_m: [0.2, 0.2, 0.5]}, poses: [{z_m: -3}]}]\n"
    )
    post = Target.load(tmp_path / "post.yaml")
    assert (post.name, post.solid.bounding_box.lower_m[2]) == ("post", 0.0)  # the ground is the lowest point
    (tmp_path / "plate.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    assert Target.load(tmp_path / "plate.obj").solid.bounding_box.size_m == (1.0, 1.0, 1.0)
    assert set_ego(build_flat_ground(), {}, tmp_path / "plate.obj").compute_ego_box().size_m == (1.0, 1.0, 1.0)
    (tmp_path / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 3 2\n")
    with pytest.raises(ValueError, match="lower < upper"):
        Target.load(tmp_path / "flat.obj")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"raster": Raster((3.0, 3.2), (0.0, 0.2), 0.2)}, "larger than the raster of 0.2 x 0.2 m"),
        ({"num_frames": 0}, "num_frames"),
        ({"detection_points": 0}, "detection_points"),
        ({"threshold_m": -1.0}, "threshold"),
        ({"heading": "up"}, "narrow, wide or degrees"),
        ({"target": "moon"}, "'moon' is neither"),
        ({"num_frames": 10**9}, "use fewer frames"),
    ],
)
def test_invalid_options_are_refused(options, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        map_target_visibility("front_roof_32", **{"target": "child", **options})


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        (((-1000.0, 1000.0), (-1000.0, 1000.0), 0.5), "16,000,000 cells exceed the limit of 1,000,000"),
        (((0.0, 1.0), (0.0, 1.0), 0.3), "no whole number of cells"),
        (((1.0, 0.0), (0.0, 1.0), 0.5), "low < high"),
        (((0.0, np.inf), (0.0, 1.0), 0.5), "finite"),
        (((0.0, 1.0), (0.0, 1.0), 0.0), "cell size above 0"),
        (((0.0, 1.0), (0.0, 1.0), np.nan), "cell size above 0"),
        (((0.0, 1.0), (0.0, 1.0), 9.0), "no whole number of cells"),
    ],
)
def test_invalid_rasters_are_refused(bounds, message):
    with pytest.raises(ValueError, match=message):
        Raster(*bounds)
