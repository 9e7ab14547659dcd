"""Drawings without cells: a rig on its vehicle, and a frame of a scenario."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from torchcover.geometry import rigid, rotation_from_euler
from torchcover.report import ActorMark, SensorView, draw_rig, draw_scene
from torchcover.report.rig_view import COLOURS, FIRST_REACH_M
from torchcover.report.scene_view import REFERENCE, SENSOR

VERTICES = np.array([[x, y, z] for x in (-2.0, 2.0) for y in (-1.0, 1.0) for z in (0.0, 1.5)])
FACES = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [1, 5, 7], [1, 7, 3], [0, 4, 5], [0, 5, 1]])


def view(yaw=0.0, pitch=0.0, *, at=(2.0, 0.0, 1.0), wide=90.0, high=(-30.0, 10.0), name="lidar", range_m=99.0):
    pose = rigid(rotation_from_euler(yaw, pitch, 0.0), at)
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
    return Picture(draw_rig(VERTICES, FACES, sensors, title=options.pop("title", "Rig"), **options))


def test_a_sensor_sees_within_its_angles_however_it_is_turned():
    def direction(azimuth, elevation):
        a, e = np.deg2rad([azimuth, elevation])
        return [np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)]

    left_down = view(yaw=90.0, pitch=20.0)
    inside = [direction(90, -20), direction(90, -49), direction(90, -11), direction(60, -20)]
    outside = [direction(90, -51), direction(90, -9), direction(0, -20), direction(-90, -20)]
    assert left_down.sees(np.array(inside)).all()
    assert not left_down.sees(np.array(outside)).any()


def test_from_above_the_sector_lies_about_the_yaw():
    picture = rig(view(yaw=90.0, at=(0.0, 0.0, 2.0), wide=60.0))
    assert picture.tinted(0, 0.0, 3.0)
    assert not picture.tinted(0, 2.5, 1.2)
    assert not picture.tinted(0, 0.0, -1.2)
    assert not picture.tinted(0, 0.0, FIRST_REACH_M + 0.3)


def test_from_the_side_the_fan_lies_about_the_pitch_and_ends_at_the_ground():
    picture = rig(view(high=(-30.0, 10.0)))
    assert picture.tinted(1, 4.0, 1.1)
    assert picture.tinted(1, 4.0, 0.1)
    assert not picture.tinted(1, 4.0, 1.6)
    assert not picture.tinted(1, 2.6, 0.3)
    below = picture.at(1, 4.5, -0.2)
    assert below == pytest.approx(picture.at(1, -1.0, -0.2))


def test_a_full_turn_is_a_fan_to_the_front_and_one_to_the_rear():
    picture = rig(view(at=(0.0, 0.0, 2.0), wide=360.0, high=(-10.0, 10.0)))
    assert picture.tinted(1, 3.0, 2.0)
    assert picture.tinted(1, -3.0, 2.0)
    assert not picture.tinted(1, 0.0, 2.6)
    assert [text.get_text() for text in picture.figure.axes[1].texts].count("1") == 2


def test_a_sensor_that_looks_sideways_is_marked_though_it_has_no_fan():
    picture = rig(view(yaw=90.0), view())
    labels = [text.get_text() for text in picture.figure.axes[1].texts]
    assert labels.count("1") == 1
    assert labels.count("2") == 1


def test_a_short_range_is_drawn_as_it_is():
    picture = rig(view(range_m=1.0))
    assert picture.tinted(0, 2.8, 0.2)
    assert not picture.tinted(0, 3.3, 0.2)


def test_every_sensor_is_named_with_its_angles_and_nothing_is_clipped():
    sensors = [view(yaw=30.0 * k, name=f"${k} a sensor with a long name") for k in range(9)]
    picture = rig(*sensors, title="A title that is longer than the paper is wide " * 3, subtitle="small")
    (legend,) = [axes.get_legend() for axes in picture.figure.axes if axes.get_legend()]
    entries = [text.get_text() for text in legend.get_texts()]
    assert entries[0] == "1  $0 a sensor with a long name: 90.0° wide, -30.0° to 10.0° high, to 99 m"
    assert len(entries) == 9
    pixels = picture.pixels
    for border in (pixels[:5], pixels[-5:], pixels[:, :5], pixels[:, -5:]):
        assert (border == 1.0).all()
    above, side = picture.figure.axes
    assert (above.get_ylabel(), side.get_xlabel(), side.get_ylabel()) == ("y left (m)", "x forward (m)", "z up (m)")
    assert not above.get_tightbbox().overlaps(side.get_tightbbox())
    for axes in (above, side):
        width, height = axes.get_window_extent().size
        assert width / np.ptp(axes.get_xlim()) == pytest.approx(height / np.ptp(axes.get_ylim()))


def box(x: float, y: float) -> np.ndarray:
    return np.array([[x - 2, y - 1], [x + 2, y - 1], [x + 2, y + 1], [x - 2, y + 1]])


def scene(**options) -> Picture:
    nothing = np.zeros((0, 3), dtype=np.float32)
    given = {"ego_outline_m": box(0, 0), "actors": [], "sensor": nothing, "reference": nothing, "title": "Scene"}
    return Picture(draw_scene((-20.0, 30.0), (-10.0, 10.0), **(given | options)))


def test_actors_are_where_they_are_in_the_colour_of_their_category():
    actors = [ActorMark("car", box(20, 5)), ActorMark("car", box(10, -5)), ActorMark("bus", box(-10, 5))]
    picture = scene(actors=[*actors, ActorMark("car", box(99, 0))])
    alone = scene(actors=actors[2:])
    first, second, bus = (picture.at(0, *place) for place in ((20, 5), (10, -5), (-10, 5)))
    assert first == pytest.approx(second)
    assert abs(first - bus).max() > 0.1
    assert alone.at(0, -10, 5) == pytest.approx(bus)
    assert picture.at(0, 20, -5) == pytest.approx((1, 1, 1))
    entries = [text.get_text() for text in picture.figure.axes[0].get_legend().get_texts()]
    assert entries[2:] == ["car (2)", "bus (1)", "ego"]


def test_clouds_are_drawn_the_rig_over_the_reference():
    line = np.stack([np.linspace(5, 25, 4000), np.full(4000, 5.0), np.zeros(4000)], axis=1)
    picture = scene(reference=line, sensor=line[:2000])
    assert picture.at(0, 8.0, 5.0) == pytest.approx(to_rgb(SENSOR), abs=0.02)
    assert picture.at(0, 22.0, 5.0) == pytest.approx(to_rgb(REFERENCE), abs=0.02)
    entries = [text.get_text() for text in picture.figure.axes[0].get_legend().get_texts()]
    assert entries[:2] == ["reference points (4,000)", "points of the rig (2,000)"]


def test_colours_of_sensors_differ():
    assert len(set(COLOURS)) == len(COLOURS)
