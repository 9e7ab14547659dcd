"""One map: what its colours, marks and words say."""

import math

import matplotlib
import numpy as np
import pytest
import torch
from matplotlib import pyplot
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from torchcover.coverage import BevGrid
from torchcover.coverage.quantities import RADIUS, make_detection_quantity
from torchcover.geometry import build_transform, convert_euler_to_rotation
from torchcover.report import ColorScale, SensorView, build_color_scale, plot_side_by_side
from torchcover.report.colors import INFINITE_COLOR, UNOBSERVED_STYLE

SCALE = ColorScale("blind spot radius", "m", "viridis_r", 0.0, 1.0)
SQUARE = BevGrid(x_m=(-20.0, 20.0), y_m=(-10.0, 10.0), cell_m=1.0)
EGO = np.array([[2.0, 1.0], [-2.0, 1.0], [-2.0, -1.0], [2.0, -1.0]])


class Picture:
    """A drawn figure: its pixels, (height, width, 3) in [0, 1] with row 0 at the top, and its words."""

    def __init__(self, figure: Figure) -> None:
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        self.axes, self.bar = figure.axes
        self.pixels = np.asarray(canvas.buffer_rgba())[..., :3] / 255.0
        (left, bottom), (right, top) = self.axes.get_window_extent().get_points().round().astype(int)
        self.map = self.pixels[len(self.pixels) - top : len(self.pixels) - bottom, left:right]
        self.legend = [text.get_text() for text in self.axes.get_legend().get_texts()]
        self.metres_per_point = 40 / (self.map.shape[1] / figure.dpi * 72)

    def at(self, x_m: float, y_m: float) -> np.ndarray:
        """The colour of a place in the vehicle frame, found without asking matplotlib where it drew it."""
        (west, east), (south, north) = self.axes.get_xlim(), self.axes.get_ylim()
        row = (north - y_m) / (north - south) * len(self.map)
        column = (x_m - west) / (east - west) * self.map.shape[1]
        return self.map[int(row), int(column)]


def flat(value: float = 0.0, grid: BevGrid = SQUARE) -> torch.Tensor:
    return torch.full(grid.shape[1:], value)


def marked(name: str, x_m: float, y_m: float, yaw_deg: float, wide_deg: float, range_m: float) -> SensorView:
    return SensorView(
        name,
        build_transform(convert_euler_to_rotation(yaw_deg, 0.0, 0.0), (x_m, y_m, 1.5)),
        wide_deg,
        (-9.0, 9.0),
        range_m,
    )


def draw(values: torch.Tensor, grid: BevGrid = SQUARE, **options) -> Picture:
    for name in options.keys() & {"sensors", "opacity"}:
        options[name] = {"": options[name]}
    scale, title = options.pop("scale", SCALE), options.pop("title", "A map")
    return Picture(plot_side_by_side({"": values}, grid, scale, title=title, **options))


def test_front_left_blind_spot_is_upper_right():
    values = flat()
    values[17:19, 35:38] = 1.0  # y = 7 to 9 m, x = 15 to 18 m
    dark = draw(values).map.sum(axis=2) < 0.8
    frame = 5  # pixels, which are dark too
    rows, columns = np.nonzero(dark[frame:-frame, frame:-frame])
    middle = (frame + rows.mean()) / len(dark), (frame + columns.mean()) / dark.shape[1]
    assert middle == pytest.approx((0.1, 36.5 / 40), abs=0.01)


@pytest.mark.parametrize("extent", [(40, 40), (1000, 400), (160, 9), (3, 50)])
def test_cells_are_whole_numbers_of_pixels(extent):
    columns, rows = extent
    grid = BevGrid(x_m=(0.0, columns / 4), y_m=(0.0, rows / 4), cell_m=0.25)
    values = torch.rand(rows, columns, generator=torch.Generator().manual_seed(0))
    pixels = draw(values, grid).map[::-1]
    across, up = pixels.shape[1] // columns, len(pixels) // rows
    assert across == up >= 1
    assert pixels.shape[:2] == (rows * up, columns * across)
    frame = 1 + (across == 1)  # outer cells that it lies over
    inside = slice(frame, -frame)
    blocks = pixels.reshape(rows, up, columns, across, 3)[inside, :, inside]
    assert (blocks == blocks[:, :1, :, :1]).all()
    # Colours of viridis_r fall strictly in green as values rise.
    green = blocks[:, 0, :, 0, 1].ravel()
    order = values[inside, inside].ravel().argsort()
    assert (np.diff(green[order]) <= 0).all()


def test_cells_below_pixel_size_are_averaged():
    grid = BevGrid(x_m=(0.0, 600.0), y_m=(0.0, 6.0), cell_m=0.1)
    stripes = flat(0.0, grid)
    stripes[:, ::2] = 1.0
    inside = draw(stripes, grid).map[8:-8, 20:-20]
    assert inside.std(axis=(0, 1)).max() < 0.05


def test_unobserved_cells_are_gray_with_their_share():
    values = flat()
    values[:, :10] = math.nan
    picture = draw(values)
    red, green, blue = picture.at(-15.3, 3.3)
    assert red == green == blue
    assert 0.65 < red < 0.8
    assert np.ptp(picture.at(5.0, 3.0)) > 0.3
    assert picture.legend[0] == "unobserved (25.0 % of the cells)"


def test_infinite_cells_do_not_change_the_scale():
    values = flat(0.5)
    values[:, 20:] = math.inf
    picture = draw(values, scale=build_color_scale(RADIUS, values))
    assert picture.at(10.5, 3.5) == pytest.approx(to_rgb(INFINITE_COLOR), abs=0.01)
    assert "infinite: no sensor points in some frame (50.0 % of the cells)" in picture.legend
    assert picture.bar.get_ylim() == (0.0, 0.5)
    assert not any("infinite" in entry for entry in draw(flat()).legend)


def test_values_beyond_the_colours_are_admitted():
    values = flat(0.5)
    values[:2] = 9.0
    bar = draw(values).bar
    assert "10.0 % of the observed cells lie beyond" in bar.get_ylabel()
    # The arrow takes a piece of the place of the bar.
    assert bar.get_window_extent().height < draw(flat(0.5)).bar.get_window_extent().height


def test_rounding_is_not_beyond_the_scale():
    values = flat(1.0).double() * (0.1 + 0.2)
    assert "beyond" not in draw(values, scale=build_color_scale(RADIUS, values)).bar.get_ylabel()


@pytest.mark.parametrize(("yaw", "ahead"), [(0, (1, 0)), (90, (0, 1)), (180, (-1, 0)), (-90, (0, -1))])
def test_positive_yaw_turns_the_arrow_left(yaw, ahead):
    picture = draw(flat(), sensors=[marked("lidar", 3.0, 2.0, yaw, 90.0, math.inf)])
    reach = 10 * picture.metres_per_point  # half an arrow, in metres
    for other in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        dark = picture.at(3.0 + reach * other[0], 2.0 + reach * other[1]).sum() < 0.5
        assert dark == (other == ahead)


def test_field_of_view_is_centered_on_yaw():
    picture = draw(flat(), sensors=[marked("camera", 0.0, 0.0, 90.0, 60.0, 8.0)])

    def is_crossed(angle_deg: float, reaches: np.ndarray) -> bool:
        along = [math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))]
        return any(picture.at(*(reach * np.array(along))).sum() < 1.0 for reach in reaches)

    edge = np.linspace(4.0, 7.5, 60)
    assert is_crossed(60.0, edge)
    assert is_crossed(120.0, edge)
    assert not is_crossed(75.0, edge)
    assert not is_crossed(-60.0, edge)
    assert any(is_crossed(angle, np.linspace(7.9, 8.1, 9)) for angle in np.linspace(80, 100, 30))
    assert not is_crossed(60.0, np.linspace(8.4, 10.0, 30))


def test_unlimited_field_of_view_has_no_arc():
    picture = draw(flat(), sensors=[marked("camera", -20.0, 0.0, 0.0, 20.0, math.inf)])
    end = range(math.ceil(0.9 * picture.map.shape[1]), picture.map.shape[1] - 5)
    rows, columns = np.nonzero(picture.map[5:-5, end].sum(axis=2) < 0.5)
    y_m = 10.0 - (rows + 5) / len(picture.map) * 20.0
    assert np.abs(y_m) == pytest.approx(
        (columns + end[0]) / picture.map.shape[1] * 40.0 * math.tan(math.radians(10.0)), abs=0.1
    )
    assert y_m.min() < 0.0 < y_m.max()


def test_close_sensors_share_a_label():
    at = (("a", 0.0, 0.0), ("b", 0.2, 0.0), ("c", 0.0, 180.0))
    sensors = [marked(name, x_m, 0.0, yaw, 90.0, 10.0) for name, x_m, yaw in at]
    picture = draw(flat(), sensors=[*sensors, marked("$away$", 99.0, 0.0, 0.0, 90.0, 10.0)])
    labels = [text.get_text() for text in picture.axes.texts]
    assert "1, 2" in labels
    assert "3" in labels
    assert picture.legend[1:5] == ["a", "b", "c", "$away$ (outside the map)"]
    marks = [entry.get_marker() for entry in picture.axes.get_legend().legend_handles[1:5]]
    assert marks == ["$1$", "$2$", "$3$", "$4$"]
    assert picture.pixels.size < draw(flat()).pixels.size * 1.3  # the paper does not follow it


def test_the_ego_is_filled_and_named():
    picture = draw(flat(1.0), ego_outline_m=EGO)
    assert picture.at(0.0, 0.0) == pytest.approx((1.0, 1.0, 1.0))
    assert picture.at(3.0, 0.0).sum() < 1.0
    assert "ego vehicle" in picture.legend


def test_nothing_is_clipped_or_hidden():
    sensors = [marked(f"a sensor with a long name, number {n}", 0.0, 0.0, 45.0 * n, 90.0, 10.0) for n in range(8)]
    title = "A title that is much longer than this narrow map is wide, and that nobody would ever write"
    narrow = BevGrid(x_m=(-1.0, 1.0), y_m=(-20.0, 20.0), cell_m=1.0)
    for grid in (narrow, SQUARE, BevGrid(x_m=(-40.0, 40.0), y_m=(-1.0, 1.0), cell_m=1.0)):
        picture = draw(flat(2.0, grid), grid, title=title, subtitle=title, sensors=sensors, ego_outline_m=EGO)
        pixels = picture.pixels
        for border in (pixels[:5], pixels[-5:], pixels[:, :5], pixels[:, -5:]):
            assert (border == 1.0).all()
        assert picture.axes.get_legend().get_window_extent().y1 < picture.axes.get_window_extent().y0


def test_dollars_are_no_formula():
    broken = r"$\frac{$"
    headings = draw(flat(), title=broken, subtitle=f"{broken} too").axes.texts
    assert [text.get_text() for text in headings] == [broken, f"{broken} too"]
    legend = draw(flat(), sensors=[marked(broken, 0.0, 0.0, 0.0, 90.0, 10.0)]).axes.get_legend()
    assert broken in [text.get_text() for text in legend.get_texts()]


@pytest.mark.parametrize("value", [math.nan, math.inf, 0.0, 1e-9, 1e9])
def test_single_cell_and_constant_maps_are_plotted(value):
    grid = BevGrid(x_m=(0.0, 1.0), y_m=(0.0, 1.0), cell_m=1.0)
    values = flat(value, grid)
    picture = draw(values, grid, scale=build_color_scale(RADIUS, values))
    unknown = picture.axes.get_legend().get_texts()[0].get_text()
    assert unknown == f"unobserved ({100 if math.isnan(value) else 0} % of the cells)"


def test_radius_scale_ends_at_98th_percentile():
    radius = torch.cat([torch.linspace(0.0, 1.0, 1000), torch.full((5,), 500.0), torch.tensor([math.nan, math.inf])])
    assert build_color_scale(RADIUS, radius).high == pytest.approx(0.99, abs=0.01)


def test_dark_means_blind_in_every_scale():
    halves = flat(0.0)
    halves[:, 20:] = 100.0
    for scale, blind in (
        (build_color_scale(RADIUS, halves), 10.0),
        (build_color_scale(make_detection_quantity(0.4), halves), -10.0),
    ):
        picture = draw(halves, scale=scale)
        assert picture.at(blind, 5.0).sum() < 1.0 < picture.at(-blind, 5.0).sum()


def test_few_blind_cells_set_the_scale():
    assert build_color_scale(RADIUS, torch.tensor([0.0] * 999 + [3.14])).high == 3.2


def test_drawing_leaves_the_global_state_of_matplotlib_alone():
    before = dict(matplotlib.rcParams)
    draw(flat())
    assert dict(matplotlib.rcParams) == before
    assert pyplot.get_fignums() == []


def test_less_opaque_cells_are_grayer():
    values, opacity = flat(1.0), torch.linspace(0.0, 1.0, 40).expand(20, 40)
    picture = draw(values, opacity=opacity)
    grey, pale, full = (picture.at(x_m, 3.3) for x_m in (-19.6, 0.5, 19.5))
    assert grey == pytest.approx(to_rgb(UNOBSERVED_STYLE["facecolor"]), abs=0.1)
    assert full == pytest.approx(draw(values).at(19.5, 3.3))
    # The hatch of the ground shows through: by less than what is compared.
    greens = picture.map[40, 10:-10, 1]
    assert greens[:300].mean() > greens[300:600].mean() > greens[600:900].mean()
    assert full[1] < pale[1] < grey[1]
    assert any(entry.startswith("paler") for entry in picture.legend)
    assert not any(entry.startswith("paler") for entry in draw(values).legend)


def test_opacity_does_not_hide_unobserved_or_infinite():
    values = flat(0.5)
    values[:, :10], values[:, 30:] = math.nan, math.inf
    opaque, none = torch.ones(20, 40), torch.zeros(20, 40)
    assert draw(values, opacity=opaque).at(-15.3, 3.3) == pytest.approx(draw(values).at(-15.3, 3.3))
    assert draw(values, opacity=opaque).at(15.5, 3.3) == pytest.approx(to_rgb(INFINITE_COLOR), abs=0.01)
    for x_m in (-15.3, 0.5, 15.5):
        assert np.ptp(draw(values, opacity=none).at(x_m, 3.3)) < 0.01


def test_wrong_shapes_are_refused_with_what_arrived():
    with pytest.raises(ValueError, match=r"opacity: got shape \(40, 20\); give that of a band, \(20, 40\)"):
        draw(flat(), opacity=flat().T)
    with pytest.raises(ValueError, match=r"got shape \(40, 20\)"):
        draw(flat().T)
    for outline, shape in ((EGO[:2], r"\(2, 2\)"), (EGO[0], r"\(2,\)"), (np.zeros((4, 3)), r"\(4, 3\)")):
        with pytest.raises(ValueError, match=f"ego_outline_m: got shape {shape}"):
            draw(flat(), ego_outline_m=outline)


@pytest.mark.parametrize("bounds", [(1.0, 1.0), (2.0, 1.0), (0.0, math.inf), (math.nan, 1.0)])
def test_a_scale_without_extent_is_refused(bounds):
    with pytest.raises(ValueError, match="finite low < high"):
        ColorScale("radius", "m", "viridis", *bounds)
