"""Drawings without cells: a rig on its vehicle, and a frame of a scenario."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from torchcover.geometry import build_transform, convert_euler_to_rotation
from torchcover.report import ActorMark, SensorView, StaticFaces, plot_depth_images, plot_rig, plot_scene
from torchcover.report.page.svg import build_sensor_table, render_rig
from torchcover.report.scene_plots import PARAMS

VERTICES = np.array([[x, y, z] for x in (-2.0, 2.0) for y in (-1.0, 1.0) for z in (0.0, 1.5)])
FACES = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [1, 5, 7], [1, 7, 3], [0, 4, 5], [0, 5, 1]])


def view(yaw=0.0, pitch=0.0, *, at=(2.0, 0.0, 1.0), wide=90.0, high=(-30.0, 10.0), name="lidar", range_m=99.0):
    pose = build_transform(convert_euler_to_rotation(yaw, pitch, 0.0), at)
    return SensorView(name, pose, wide, high, range_m)


class Picture:
    """The pixels of a figure, addressed in metres."""

    def __init__(self, figure: Figure) -> None:
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        self.figure = figure
        self.pixels = np.asarray(canvas.buffer_rgba())[..., :3] / 255.0

    def at(self, axes: int, x: float, y: float) -> np.ndarray:
        column, row = self.figure.axes[axes].transData.transform((x, y))
        return self.pixels[len(self.pixels) - 1 - int(row), int(column)]

    def tinted(self, axes: int, x: float, y: float) -> bool:
        return bool(np.ptp(self.at(axes, x, y)) > 0.03)


def rig(*sensors, **options) -> Picture:
    return Picture(plot_rig(VERTICES, FACES, sensors, title=options.pop("title", "Rig"), **options))


def test_field_of_view_follows_the_extrinsics():
    def direction(azimuth, elevation):
        a, e = np.deg2rad([azimuth, elevation])
        return [np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)]

    left_down = view(yaw=90.0, pitch=20.0)
    inside = [direction(90, -20), direction(90, -49), direction(90, -11), direction(60, -20)]
    outside = [direction(90, -51), direction(90, -9), direction(0, -20), direction(-90, -20)]
    assert left_down.mask_directions(np.array(inside)).all()
    assert not left_down.mask_directions(np.array(outside)).any()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("vehicle_T_sensor", np.full((4, 4), np.nan)),
        ("vehicle_T_sensor", np.eye(3)),
        ("horizontal_fov_deg", 361.0),
        ("horizontal_fov_deg", 0.0),
        ("vertical_fov_deg", (10.0, -10.0)),
        ("vertical_fov_deg", (-91.0, 0.0)),
        ("range_m", 0.0),
    ],
)
def test_an_impossible_sensor_is_refused_by_name(field, value):
    with pytest.raises(ValueError, match=f"'lidar': {field}"):
        replace(view(), **{field: value})


def test_from_above_the_sector_lies_about_the_yaw():
    picture = rig(view(yaw=90.0, at=(0.0, 0.0, 2.0), wide=60.0))
    assert picture.tinted(0, 0.0, 3.0)
    assert not picture.tinted(0, 2.5, 1.2)
    assert not picture.tinted(0, 0.0, -1.2)
    assert picture.tinted(0, 0.4, 3.9)  # to the edge, for nobody's range ends before it


def test_ranges_are_drawn_as_far_as_they_are():
    picture = rig(view(range_m=50.0), view(yaw=180.0, range_m=20.0))
    assert picture.tinted(2, 45.0, 3.0)
    assert not picture.tinted(2, 54.0, 3.0)
    assert picture.tinted(2, -15.0, 2.0)
    assert not picture.tinted(2, -22.0, 2.0)


def test_no_two_of_many_sensors_look_alike():
    sensors = [view(yaw=17.0 * k, name=f"{k}") for k in range(21)]
    legend = rig(*sensors).figure.axes[2].get_legend()
    assert len({to_rgb(entry.get_color()) for entry in legend.legend_handles}) == 21


def test_side_section_follows_pitch_down_to_ground():
    picture = rig(view(high=(-30.0, 10.0)))
    assert picture.tinted(1, 4.0, 1.1)
    assert picture.tinted(1, 4.0, 0.1)
    assert not picture.tinted(1, 4.0, 1.6)
    assert not picture.tinted(1, 2.6, 0.3)
    below = picture.at(1, 4.5, -0.2)
    assert below == pytest.approx(picture.at(1, -1.0, -0.2))


def test_full_turn_has_front_and_rear_sections():
    picture = rig(view(at=(0.0, 0.0, 2.0), wide=360.0, high=(-10.0, 10.0)))
    assert picture.tinted(1, 3.0, 2.0)
    assert picture.tinted(1, -3.0, 2.0)
    assert not picture.tinted(1, 0.0, 2.6)
    assert [text.get_text() for text in picture.figure.axes[1].texts].count("1") == 2


def test_sensor_numbers_stay_on_the_paper():
    sensors = [view(yaw, at=(0.0, 0.0, 0.5), name=f"s{yaw}") for yaw in np.linspace(0, 2 * np.pi, 8, endpoint=False)]
    figure = plot_rig(0.2 * VERTICES, FACES, sensors, title="Robot")
    axes = figure.axes[0]
    (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
    numbers_m = {text.get_text(): text.get_position() for text in axes.texts if text.get_text().isdigit()}
    assert sorted(numbers_m) == list("12345678")
    assert all(x0 < x < x1 and y0 < y < y1 for x, y in numbers_m.values())


def test_sideways_sensor_is_marked_without_section():
    picture = rig(view(yaw=90.0), view())
    labels = [text.get_text() for text in picture.figure.axes[1].texts]
    assert labels.count("1") == 1
    assert labels.count("2") == 1


def test_sensors_are_named_and_nothing_is_clipped():
    sensors = [view(yaw=30.0 * k, name=f"${k} a sensor with a long name") for k in range(9)]
    picture = rig(*sensors, title="A title that is longer than the paper is wide " * 3, subtitle="small")
    (legend,) = [axes.get_legend() for axes in picture.figure.axes if axes.get_legend()]
    entries = [text.get_text() for text in legend.get_texts()]
    assert entries[0] == "1  $0 a sensor with a long name: 90.0° wide, -30.0° to 10.0° high, to 99 m"
    assert len(entries) == 9
    pixels = picture.pixels
    for border in (pixels[:5], pixels[-5:], pixels[:, :5], pixels[:, -5:]):
        assert (border == 1.0).all()
    above, side, ranges = picture.figure.axes
    labels = above.get_ylabel(), side.get_ylabel(), ranges.get_ylabel(), ranges.get_xlabel()
    assert labels == ("y left (m)", "z up (m)", "y left (m)", "x forward (m)")
    assert not above.get_tightbbox().overlaps(side.get_tightbbox())
    assert not side.get_tightbbox().overlaps(ranges.get_tightbbox())
    for axes in (above, side, ranges):
        width, height = axes.get_window_extent().size
        assert width / np.ptp(axes.get_xlim()) == pytest.approx(height / np.ptp(axes.get_ylim()))


def box(x: float, y: float) -> np.ndarray:
    return np.array([[x - 2, y - 1], [x + 2, y - 1], [x + 2, y + 1], [x - 2, y + 1]])


def scene(**options) -> Picture:
    nothing = np.zeros((0, 3), dtype=np.float32)
    bare = StaticFaces(np.zeros((0, 3, 2)), np.zeros(0))
    given = {
        "static_faces": bare,
        "ego_outline_m": box(0, 0),
        "actors": [],
        "sensor_points": nothing,
        "reference_points": nothing,
        "title": "Scene",
    }
    return Picture(plot_scene((-20.0, 30.0), (-10.0, 10.0), **(given | options)))


def test_static_faces_are_darker_with_height():
    squares = [(box(x, 5)[:3], height) for x, height in ((10, 0.0), (15, 0.3), (20, 8.0))]
    standing = StaticFaces(np.array([corners for corners, _ in squares]), np.array([height for _, height in squares]))
    picture = scene(static_faces=standing)
    ground, kerb, house = (picture.at(0, x + 1, 4.6).mean() for x in (10, 15, 20))
    assert ground == 1.0
    assert 1.0 > kerb > house + 0.1
    entries = [text.get_text() for text in picture.figure.axes[0].get_legend().get_texts()]
    assert entries[0] == "static objects, higher ones darker"


def test_actors_have_category_colors():
    actors = [ActorMark("car", box(20, 5)), ActorMark("car", box(10, -5)), ActorMark("bus", box(-10, 5))]
    picture = scene(actors=[*actors, ActorMark("car", box(99, 0))])
    alone = scene(actors=actors[2:])
    first, second, bus = (picture.at(0, *place) for place in ((20, 5), (10, -5), (-10, 5)))
    assert first == pytest.approx(second)
    assert abs(first - bus).max() > 0.1
    assert alone.at(0, -10, 5) == pytest.approx(bus)
    assert picture.at(0, 20, -5) == pytest.approx((1, 1, 1))
    entries = [text.get_text() for text in picture.figure.axes[0].get_legend().get_texts()]
    assert entries[2:] == ["car (2)", "bus (1)", "ego vehicle"]


def test_path_of_a_moving_ego_is_plotted():
    picture = scene(path_m=np.array([[-10.0, -5.0], [25.0, -5.0]]))
    assert picture.at(0, 10.0, -5.0) == pytest.approx(to_rgb(PARAMS.path_color), abs=0.3)
    assert scene().at(0, 10.0, -5.0) == pytest.approx((1, 1, 1))
    entries = [text.get_text() for text in picture.figure.axes[0].get_legend().get_texts()]
    assert "path of the ego vehicle" in entries


def test_clouds_are_drawn_the_rig_over_the_reference():
    line = np.stack([np.linspace(5, 25, 4000), np.full(4000, 5.0), np.zeros(4000)], axis=1)
    picture = scene(reference_points=line, sensor_points=line[:2000])
    assert picture.at(0, 8.0, 5.0) == pytest.approx(to_rgb(PARAMS.sensor_color), abs=0.02)
    assert picture.at(0, 22.0, 5.0) == pytest.approx(to_rgb(PARAMS.reference_color), abs=0.02)
    entries = [text.get_text() for text in picture.figure.axes[0].get_legend().get_texts()]
    assert entries[:2] == ["reference points (4,000)", "points of the rig (2,000)"]


def depths(images, **options) -> Picture:
    return Picture(plot_depth_images(images, title=options.pop("title", "Depths"), **options))


def test_depth_image_is_upright_with_marked_gaps():
    image = np.full((20, 30), 10.0)
    image[:5] = np.inf
    image[-5:] = 2.0
    image[:, :3] = np.nan
    picture = depths({"front": image})
    # Cells count from below, rows of an image from above.
    sky, wall, road = (picture.at(0, 15, height) for height in (18, 10, 2))
    assert sky == pytest.approx(to_rgb(PARAMS.sky_color), abs=0.02)
    assert abs(wall - road).max() > 0.2
    hatched = np.array([picture.at(0, 1, height) for height in np.arange(0.5, 19.0, 0.1)])
    assert np.ptp(hatched, axis=1).max() < 0.02
    assert np.ptp(hatched[:, 0]) > 0.02
    entries = [text.get_text() for text in picture.figure.axes[0].get_legend().get_texts()]
    assert entries == ["nothing within range (22.5 % of the pixels)", "no ray: beyond the lens (10.0 % of the pixels)"]


def test_depth_images_share_a_logarithmic_scale():
    near, middle, far, all_of_them = (np.full((10, 12), value) for value in (4.0, 8.0, 16.0, 4.0))
    all_of_them[:5] = 16.0
    picture = depths({"a": near, "b": middle, "c": far, "d": all_of_them})
    assert picture.at(0, 5, 5) == pytest.approx(picture.at(3, 5, 2))
    assert picture.at(2, 5, 5) == pytest.approx(picture.at(3, 5, 8))
    # The middle colour is that of the geometric mean.
    assert picture.at(1, 5, 5) == pytest.approx(colormaps["viridis_r"](0.5)[:3], abs=0.02)


def test_depth_images_keep_square_pixels():
    picture = depths({f"camera {k}": np.full((10 + 5 * k, 30), 1.0 + k) for k in range(8)})
    *views, bar = picture.figure.axes
    boxes = [axes.get_window_extent() for axes in views]
    for axes, box_ in zip(views, boxes, strict=True):
        assert box_.width / np.ptp(axes.get_xlim()) == pytest.approx(box_.height / np.ptp(axes.get_ylim()), rel=1e-3)
    everything = [*boxes, bar.get_window_extent()]
    assert not any(a.overlaps(b) for k, a in enumerate(everything) for b in everything[:k])


@pytest.mark.parametrize("image", [np.full((3, 3), np.inf), np.full((3, 3), np.nan), np.full((1, 1), 7.0)])
def test_constant_depth_images_are_plotted(image):
    assert depths({"only": image}).figure.axes


@pytest.mark.parametrize(
    ("images", "message"),
    [({}, "at least one"), ({"x": np.zeros(3)}, "'x'.*shape \\(3,\\)"), ({"x": np.zeros((0, 3))}, "'x'")],
)
def test_what_is_no_image_is_refused(images, message):
    with pytest.raises(ValueError, match=message):
        plot_depth_images(images, title="t")


@pytest.mark.parametrize(
    ("pitch", "high", "height_m", "reach_m"),
    [
        (0.0, (-30.0, 10.0), 2.0, 99.0),
        (0.0, (-60.0, -45.0), 2.0, 2.0),  # its most level ray ends on the ground
        (0.0, (-60.0, -45.0), 0.0, 70.0),  # the frame lies in the sensor: nothing is known of the ground
        (90.0, (-45.0, 45.0), 2.0, 2.0),  # looks down
        (-90.0, (-45.0, 45.0), 2.0, 70.0),  # looks up
        (45.0, (-15.0, 15.0), 2.0, 2.0 / np.tan(np.deg2rad(30.0))),
    ],
)
def test_field_of_view_ends_on_the_ground(pitch, high, height_m, reach_m):
    sensor = view(pitch=pitch, at=(1.0, 0.0, height_m), wide=2.0, high=high)
    assert np.linalg.norm(sensor.compute_outline_m(1e4) - (1.0, 0.0), axis=1).max() == pytest.approx(reach_m, rel=0.01)


@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(90.0, 0.0), (0.0, 90.0)])
def test_tilted_lidar_has_its_true_field_of_view(pitch_deg, roll_deg):
    """On its side, it sees as far as its range along its plane, and across it no farther than its elevations allow."""
    pose = build_transform(convert_euler_to_rotation(0.0, pitch_deg, roll_deg), (1.0, 2.0, 1.5))
    view = SensorView("tilted", pose, 360.0, (-15.0, 15.0), 50.0)
    extent_m = np.abs(view.compute_outline_m(10.0) - (1.0, 2.0)).max(axis=0)
    along, across = (1, 0) if pitch_deg else (0, 1)
    assert extent_m[along] == pytest.approx(10.0, rel=1e-3)
    assert extent_m[across] == pytest.approx(10.0 * np.sin(np.deg2rad(15.0)), rel=0.02)
    ((_, _, turned, *_),) = build_sensor_table([view]).rows
    assert turned.text == f"0.0, {pitch_deg:.1f}, {roll_deg:.1f}"
    assert "<polygon" in render_rig([view], None, 0)
    assert "<circle" in render_rig([SensorView("level", np.eye(4), 360.0, (-15.0, 15.0), 50.0)], None, 0)
