"""All maps of a run: which there are, what they are called, and what their titles and colours say."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imread

from torchcover.coverage import AGGREGATIONS, Aggregation, BevGrid, Coverage, CoverageMetric, Layer, Region
from torchcover.coverage.aggregations import SumState
from torchcover.coverage.quantities import RADIUS, make_detection_quantity
from torchcover.estimation import Quantity
from torchcover.report import SensorView, build_difference_scale, plot_band_maps, plot_maps, write_figures

SQUARE = BevGrid(x_m=(-20.0, 20.0), y_m=(-10.0, 10.0), cell_m=1.0)
SMALL = BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 1.0), cell_m=1.0, heights={"all": (-1.0, 1.0)})
BANDS = ("ground", "obstacle")
EGO = np.array([[2.0, 1.0], [-2.0, 1.0], [-2.0, -1.0], [2.0, -1.0]])


def coverage_of(grid: BevGrid, **options) -> Coverage:
    metric = CoverageMetric(grid, **options)
    metric.update(torch.zeros(1, 3), torch.tensor([[0.5, 0.5, 0.5], [1.5, 0.5, 0.5]]))
    return metric.compute()


def blocked(steps: int) -> Coverage:
    metric = CoverageMetric(SQUARE, num_blocks=16)
    for index in range(steps):
        points = [[0.5, 0.5, 0.0]] if index % 8 else [[0.5, 0.5, 0.0], [9.5, 0.5, 0.0]]
        metric.update(torch.tensor([[0.5, 0.5, -0.3 - 0.02 * (index % 16)]]), torch.tensor(points), block_index=index)
    return metric.compute()


def names(coverages: dict[str, Coverage], **options) -> list[str]:
    return [name for name, _ in plot_maps(coverages, **options)]


def words(figure: Figure) -> list[str]:
    """Title and subtitle."""
    return [text.get_text() for text in figure.axes[0].texts[:2]]


def legend(figure: Figure) -> list[str]:
    (found,) = [axes.get_legend() for axes in figure.axes if axes.get_legend()]
    return [text.get_text() for text in found.get_texts()]


def colours(figure: Figure) -> np.ndarray:
    """(height, width, 3) in [0, 1]."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3] / 255.0


# One rig


def test_each_quantity_and_band_has_a_figure(tmp_path):
    coverage = coverage_of(SQUARE, thresholds_m=(1.0,))
    keys = ("radius_m", "detection_1m")
    paths = write_figures(plot_maps({"a": coverage}, ego_outline_m=EGO), tmp_path / "new" / "maps")
    stems = [name for key in keys for name in (*(f"{key}_{band}" for band in BANDS), f"near_field_{key}")]
    assert [path.stem for path in paths] == stems
    assert sorted(paths) == sorted((tmp_path / "new" / "maps").iterdir())
    for path in paths:
        height, width, _ = imread(path).shape
        assert 500 < height < 1200
        assert 1000 < width < 2000


def test_maps_show_observed_regions_and_ego():
    metric = CoverageMetric(SQUARE, regions=[Region("ahead", (0.0, 20.0), (-10.0, 10.0))])
    metric.update(torch.zeros(1, 3), torch.tensor([[x, y, 0.0] for x in (-15.5, 9.5) for y in (-3.5, 4.5)]))
    figures = dict(plot_maps({"a": metric.compute()}, ego_outline_m=EGO))
    for name in ("radius_m_ground", "radius_m_obstacle"):
        axes = figures[name].axes[0]
        assert axes.get_xlim() == (-3.0, 10.0)  # a metre behind the ego; as far as any band is known
        assert axes.get_ylim() == (-4.0, 5.0)
        assert axes.images[0].get_array().shape == (9, 13)
    values = figures["radius_m_ground"].axes[0].images[0].get_array()
    assert values[0, 12] == pytest.approx(math.hypot(9.5, 3.5))
    assert values.count() == 2


def test_near_field_map_spans_two_ego_lengths():
    sensors = {"a": [SensorView("roof", np.eye(4), 90.0, (-10.0, 10.0), 8.0)]}
    coverage = blocked(16)
    near = dict(plot_maps({"a": coverage}, ego_outline_m=EGO, sensors=sensors))["near_field_radius_m"]
    *views, _ = near.axes
    assert [view.get_xlim() for view in views] == [(-10.0, 10.0)] * 2
    assert [view.get_ylim() for view in views] == [(-9.0, 9.0)] * 2
    for view in views:
        assert view.get_aspect() == 1.0
        (ego,) = view.patches
        assert ego.get_xy()[:4].tolist() == EGO.tolist()
        (dot,) = view.lines
        assert (dot.get_marker(), dot.get_markersize()) == ("o", 4.5)


def test_every_aggregation_is_drawn_under_its_key():
    aggregations = [kind.parse(kind.example) for kind in AGGREGATIONS]
    points = torch.tensor([[0.5, 0.5, 0.5], [1.5, 0.5, 0.5]])
    for over_surface, others in ((False, ()), (True, ("radius_m", "detection_0.4m"))):
        metric = CoverageMetric(SMALL, aggregations=aggregations, has_area_weights=over_surface)
        metric.update(torch.zeros(1, 3), points, weights=torch.ones(2))
        coverage = metric.compute()
        shown = names({"a": coverage})
        # The first are those of the measure; the other measure is in the files.
        assert shown == [f"{key}_all" for key in coverage.layers if key not in others]
        assert len(shown) >= 2 + len(AGGREGATIONS)


@dataclass(frozen=True)
class Emptiness(Aggregation):
    """Nothing that the package knows of."""

    name: ClassVar[str] = "emptiness"
    description: ClassVar[str] = "emptinesses"

    def create_states(self, num_cells):
        return {"sum": SumState(torch.zeros(num_cells, dtype=torch.float64))}

    def update(self, sums, frame):
        pass

    def compute_layers(self, sums, observed_frames, max_radius_m):
        return [Layer(Quantity("emptiness", "share of emptiness", "share", lower_is_better=True), sums["sum"] + 0.5)]


def test_custom_quantities_are_plotted():
    coverage = coverage_of(SMALL, thresholds_m=(), aggregations=(Emptiness(),))
    figure = dict(plot_maps({"a": coverage}))["emptiness_all"]
    assert words(figure)[0] == "Share of emptiness, all"
    assert (figure.axes[1].get_ylabel(), figure.axes[1].get_ylim()) == ("share of emptiness (%)", (0.0, 100.0))
    assert "difference_emptiness_all_b_minus_a" in names({"a": coverage, "b": coverage})


def test_the_bands_of_a_quantity_share_their_colours():
    grid = BevGrid(x_m=(0.0, 1.0), y_m=(0.0, 1.0), cell_m=1.0, heights={"low": (0.0, 1.0), "high": (9.0, 11.0)})
    metric = CoverageMetric(grid, thresholds_m=())
    metric.update(torch.zeros(1, 3), torch.tensor([[0.5, 0.5, 0.5], [0.5, 0.5, 10.0]]))
    low, high = (colours(figure)[400, 400] for _, figure in plot_maps({"a": metric.compute()}))
    assert np.abs(low - high).max() > 0.5


@pytest.mark.usefixtures("blank_maps")
def test_band_names_become_distinct_file_names(tmp_path):
    bands = ["../up", "a/b", "a\\b", "A b", "a_b_3", "$x$", "long" * 99, "Höhe", "\n"]
    heights = {name: (float(at), at + 1.0) for at, name in enumerate(bands)}
    grid = BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 1.0), cell_m=1.0, heights=heights)
    paths = write_figures(plot_maps({"a": coverage_of(grid, thresholds_m=())}), tmp_path / "maps")
    assert len({path.name.lower() for path in paths}) == len(bands)
    assert sorted(tmp_path.rglob("*.png")) == sorted(paths)
    assert all(path.parent == tmp_path / "maps" for path in paths)


def test_the_title_names_quantity_band_cell_and_steps():
    figures = dict(plot_maps({"a": coverage_of(SQUARE, thresholds_m=())}))
    expected = ["Mean blind spot radius, obstacle", "z 0.5 to 2 m; 1 frame, cells of 1 m"]
    assert words(figures["radius_m_obstacle"]) == expected


def test_the_sensors_of_the_rig_are_named():
    sensor = SensorView("the lidar", np.eye(4), 90.0, (-9.0, 9.0), 5.0)
    coverage = coverage_of(SQUARE, thresholds_m=())
    _, figure = next(plot_maps({"a": coverage}, sensors={"a": [sensor], "another": []}, ego_outline_m=EGO))
    assert {"the lidar", "ego vehicle"} <= set(legend(figure))


def test_band_maps_are_side_by_side():
    figures = dict(plot_band_maps(coverage_of(SQUARE)))
    assert list(figures) == ["radius_m", "detection_0.4m"]
    headings = [axes.texts[0].get_text() for axes in figures["radius_m"].axes[:2]]
    assert headings == ["ground, z -0.5 to 0.5 m", "obstacle, z 0.5 to 2 m"]


# Several rigs


@pytest.mark.usefixtures("blank_maps")
def test_each_later_rig_has_a_difference_map(pair, measure, points, tmp_path):
    three = {**pair, "a/b": measure(points(40, 5))}
    paths = write_figures(plot_maps(three, ego_outline_m=EGO), tmp_path)
    places = [f"{key}_{band}" for key in ("radius_m", "detection_0.4m") for band in BANDS]
    expected = [f"{place}.png" for place in places]
    expected += [f"difference_{place}_{rig}_minus_few.png" for place in places for rig in ("many", "a_b")]
    expected += ["near_field_radius_m.png", "near_field_detection_0.4m.png"]
    assert sorted(path.name for path in paths) == sorted(expected)


def test_worse_cells_are_red_and_better_blue(measure):
    """The second rig sees at the front left only, the first at the rear right only."""
    front_left, rear_right = torch.tensor([[11.0, 4.0, 0.0]]), torch.tensor([[-4.0, -4.0, 0.0]])
    rigs = {"first": measure(rear_right, thresholds_m=(5.0,)), "second": measure(front_left, thresholds_m=(5.0,))}
    differences = [figure for name, figure in plot_maps(rigs) if name.startswith("difference")]
    assert len(differences) == 4
    for figure in differences:
        red, _, blue = np.moveaxis(colours(figure), 2, 0)
        is_blue, is_red = blue - red > 0.2, red - blue > 0.2
        width = red.shape[1]
        # Left of the colour bar, which has both colours.
        (blue_y, blue_x), (red_y, red_x) = (np.argwhere(c[:, : int(0.85 * width)]).T for c in (is_blue, is_red))
        assert blue_x.mean() > red_x.mean() + 0.2 * width
        assert blue_y.mean() < red_y.mean()


def test_difference_title_names_rigs_and_direction(pair):
    differences = [words(figure) for name, figure in plot_maps(pair) if name.startswith("difference")]
    quantities = ("mean blind spot radius", "detection within 0.4 m")
    expected = [f"many minus few: {quantity}, {band}" for quantity in quantities for band in BANDS]
    assert [title for title, _ in differences] == expected
    assert all(subtitle.startswith("blue: many is better, red: few is better; z ") for _, subtitle in differences)


def test_difference_scale_is_symmetric_and_robust():
    differences = torch.cat([torch.linspace(-1.0, 0.5, 1000), torch.tensor([900.0, float("nan"), float("inf")])])
    scale = build_difference_scale(RADIUS, differences)
    assert scale.low == -scale.high
    assert 0.9 <= scale.high <= 1.0
    assert (scale.colormap, scale.unit) == ("RdBu_r", "m")
    within = build_difference_scale(make_detection_quantity(0.4), differences)
    assert (within.colormap, within.unit) == ("RdBu", "percentage points")
    assert build_difference_scale(RADIUS, torch.zeros(9)).high > 0


def test_unpaired_coverages_are_refused(measure, points):
    with pytest.raises(ValueError, match="'a' and 'b' cannot be compared"):
        plot_maps({"a": measure(points(9, 1)), "b": measure(points(9, 1), seed=7)})


def test_titles_say_what_carried_the_rigs():
    coverage = coverage_of(SMALL)
    _, figure = next(plot_maps({"a": coverage}, vehicle="van"))
    assert "; on van, 1 frame" in words(figure)[1]
    _, figure = next(plot_maps({"a": coverage}))
    assert " on " not in words(figure)[1]
