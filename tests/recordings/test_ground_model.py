"""Ground model of sweeps against closed forms: heights, objects that are no ground, and unknown ground."""

from dataclasses import replace

import numpy as np
import pytest

import torchcover
from tests.recordings.drives import CAR_SIZE_M, Drive
from torchcover.data import AccumulatedReference, RecordedFrames
from torchcover.geometry import build_transform, convert_euler_to_rotation, invert, transform_points
from torchcover.recordings.ground_model import GroundModel, GroundModelParams, extract_low_surfaces

NOISE_M = 0.03
HERE_M = np.zeros(3)


def level(x, y):
    return np.zeros_like(x)


def kerbs(x, y):
    return np.where(np.abs(y) > 5.0, 0.15, 0.0)


def ramp(x, y):
    """Slope of 15 % from x = 10 m to 30 m, level before and after."""
    return np.clip(0.15 * (x - 10.0), 0.0, 3.0)


def hills(x, y):
    return 1.5 * np.sin(x / 25.0) + 0.06 * y


def sample_surface(heights, count=30_000, within_m=40.0, seed=0, noise_m=NOISE_M):
    """Sample points of a surface uniformly, with range noise."""
    generator = np.random.default_rng(seed)
    x, y = generator.uniform(-within_m, within_m, (2, count))
    return np.stack([x, y, heights(x, y) + generator.normal(0.0, noise_m, count)], axis=1)


def make_wall(ends, low_m, high_m, count, seed=1):
    """Sample points of a wall between two positions."""
    generator = np.random.default_rng(seed)
    way = generator.uniform(size=(count, 1))
    across_m = np.array(ends[0]) * (1 - way) + np.array(ends[1]) * way
    return np.column_stack([across_m, generator.uniform(low_m, high_m, count)])


def exclude_rectangle(points_m, *, x=(-np.inf, np.inf), y=(-np.inf, np.inf)):
    """Exclude the points in a rectangle."""
    inside = (points_m[:, 0] > x[0]) & (points_m[:, 0] < x[1]) & (points_m[:, 1] > y[0]) & (points_m[:, 1] < y[1])
    return points_m[~inside]


def build_ground(*parts, place_m=HERE_M):
    return GroundModel.from_surfaces([extract_low_surfaces(part, place_m) for part in parts], place_m)


def compute_rms_error(ground, heights, within_m=38.0):
    """Compute the root mean square error over a raster, and the share of its positions with a height."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-within_m, within_m, 0.7), np.arange(-within_m, within_m)))
    off_m = ground.compute_heights_m(np.stack([x, y, heights(x, y)], axis=1))
    return np.sqrt(np.nanmean(off_m**2)), np.isfinite(off_m).mean()


@pytest.mark.parametrize(
    ("heights", "most_m"), [(level, 0.01), (kerbs, 0.03), (ramp, 0.03), (hills, 0.01), (lambda x, y: 0.2 * x, 0.02)]
)
def test_heights_are_relative_to_the_road(heights, most_m):
    ground = build_ground(sample_surface(heights))
    error_m, known = compute_rms_error(ground, heights)
    assert error_m < most_m
    assert known == 1.0


def test_objects_and_roofs_are_no_ground():
    cars = []
    for k, (x, y) in enumerate([(-15, 4), (-8, -4), (7, 4), (14, -4), (14, 4), (22, 4)]):
        roof = sample_surface(level, 300, 1.0, seed=k, noise_m=0.01) * [2.0, 0.9, 1.0] + [x, y, 1.45]
        side = make_wall([(x - 2, y - 0.9), (x + 2, y - 0.9)], 0.25, 1.2, 200, seed=k)
        cars += [roof, side]
    crown = sample_surface(level, 500, 4.0, noise_m=0.5) + np.array([0.0, 12.0, 4.0])
    road = sample_surface(level)
    for x, y in [(-15, 4), (-8, -4), (7, 4), (14, -4), (14, 4), (22, 4)]:
        road = exclude_rectangle(road, x=(x - 2, x + 2), y=(y - 0.9, y + 0.9))  # the ground below a car is not observed
    wall = make_wall([(-38.0, 20.0), (38.0, 20.0)], 0.0, 9.0, 6000)
    ground = build_ground(np.concatenate([exclude_rectangle(road, y=(20.0, np.inf)), *cars, crown, wall]))
    for what in (*cars, crown, wall):
        np.testing.assert_allclose(ground.compute_heights_m(what), what[:, 2], atol=0.05)


def test_reflections_below_do_not_lower_the_road():
    below = sample_surface(level, 1600, 40.0, seed=5) - [0.0, 0.0, 2.0]
    below[:800] = below[800:] + np.array([0.05, 0.05, -0.05])  # in pairs
    ground = build_ground(np.concatenate([sample_surface(level), below]))
    assert compute_rms_error(ground, level)[0] < 0.01
    assert (ground.compute_heights_m(below) < -1.5).all()


def test_distant_trucks_without_base_are_no_ground():
    far = make_wall([(70.0, -1.2), (70.0, 1.2)], 1.0, 3.5, 60)
    ground = build_ground(np.concatenate([sample_surface(level), far]))
    assert np.isnan(ground.compute_heights_m(far)).all()
    near = far - [25.0, 0.0, 0.0]  # 5 m behind what was seen
    np.testing.assert_allclose(
        build_ground(np.concatenate([sample_surface(level), near])).compute_heights_m(near), near[:, 2], atol=0.1
    )


def test_road_level_of_the_vehicle_is_chosen():
    road = sample_surface(level)
    deck = sample_surface(level, 6000, 40.0, seed=2) * [1.0, 0.12, 1.0] + [0.0, 0.0, 5.5]  # 10 m wide
    under = build_ground(road, deck, place_m=np.array([0.0, 0.0, 0.0]))
    np.testing.assert_allclose(under.compute_heights_m(deck), 5.5, atol=0.15)
    # Neither the ground below the deck nor that behind the parapet is observed from above.
    above = build_ground(exclude_rectangle(road, y=(-7.0, 7.0)), deck, place_m=np.array([0.0, 0.0, 5.5]))
    np.testing.assert_allclose(above.compute_heights_m(deck), 0.0, atol=0.15)
    off_m = above.compute_heights_m(road)
    assert np.isnan(off_m[np.abs(road[:, 1]) > 17.0]).all()
    np.testing.assert_allclose(off_m[np.isfinite(off_m)], -5.5, atol=0.5)


def test_ground_is_unknown_beyond_observed_points():
    road = sample_surface(level)
    holed = road[np.hypot(*(road[:, :2] - [5.0, 20.0]).T) > 16.0]
    ground = build_ground(holed)
    places_m = np.array([[5.0, 20.0, 1.0], [5.0, 7.0, 1.0], [-30.0, 0.0, 1.0], [70.0, 0.0, 1.0], [0.0, -999.0, 1.0]])
    found_m = ground.compute_heights_m(places_m)
    assert np.isnan(found_m).tolist() == [True, False, False, True, True]
    np.testing.assert_allclose(found_m[1:3], 1.0, atol=0.05)


def test_walls_alone_give_no_ground():
    walls = [make_wall([(-40.0, y), (40.0, y)], 0.0, 6.0, 8000) for y in (-4.0, 4.0)]
    assert build_ground(*walls) is None
    ceiling = sample_surface(level, 5000) * [1.0, 0.1, 1.0] + [0.0, 0.0, 6.0]
    assert build_ground(*walls, ceiling) is None
    assert build_ground(np.empty((0, 3))) is None
    assert build_ground() is None
    assert build_ground(sample_surface(level) + np.array([100.0, 0.0, 0.0])) is None  # none of it is near


def test_nonfinite_points_are_ignored():
    road = sample_surface(hills)
    bad = np.array([[np.nan, 0.0, 0.0], [0.0, 0.0, np.inf], [1.0, 1.0, -np.inf]])
    places_m = sample_surface(hills, 100, seed=7)
    expected_m = build_ground(road).compute_heights_m(places_m)
    np.testing.assert_array_equal(build_ground(np.concatenate([road, bad])).compute_heights_m(places_m), expected_m)
    assert np.isnan(build_ground(road).compute_heights_m(np.array([[np.nan, 0.0, 0.0], [0.0, 0.0, np.nan]]))).all()


def test_order_of_points_and_sweeps_is_irrelevant():
    one, two, places_m = (
        sample_surface(hills, seed=1),
        sample_surface(kerbs, 3000, seed=2),
        sample_surface(hills, 300, seed=3),
    )
    expected_m = build_ground(one, two).compute_heights_m(places_m)
    turned = np.random.default_rng(0).permutation(one)
    np.testing.assert_allclose(build_ground(two, turned).compute_heights_m(places_m), expected_m, atol=2e-6)


def test_large_coordinates_change_nothing():
    road, places_m = sample_surface(hills), sample_surface(hills, 300, seed=3)
    expected_m = build_ground(road).compute_heights_m(places_m)
    shift_m = np.array([4096, -8192, 0]) * GroundModelParams().column_m + [0.0, 0.0, 512.0]
    shifted = build_ground(road + shift_m, place_m=shift_m)
    np.testing.assert_allclose(shifted.compute_heights_m(places_m + shift_m), expected_m, atol=1e-8)


class Road(Drive):
    """The drive past the wall on a road that rises by 3 %, in a vehicle that pitches and rolls."""

    tilt_deg = (0.0, 0.0)

    def get_world_T_vehicle(self, index):
        return super().get_world_T_vehicle(index) @ build_transform(
            convert_euler_to_rotation(0.0, *self.tilt_deg), np.zeros(3)
        )

    def read_scan(self, sensor, index):
        scan = super().read_scan(sensor, index)
        road_m = sample_surface(rises, 12_000, 30.0, seed=index) + self.origin_m
        road_m = transform_points(invert(self.get_world_T_vehicle(index) @ scan.vehicle_T_sensor), road_m)
        return replace(scan, points_m=np.concatenate([scan.points_m, road_m]))


def rises(x, y):
    return 0.03 * x


@pytest.mark.parametrize("tilt_deg", [(0.0, 0.0), (2.0, -2.0)])
@pytest.mark.parametrize("origin_m", [(0.0, 0.0, 0.0), (513_248.0, 5_403_655.0, 260.0)])
def test_pitch_and_roll_do_not_change_heights(tilt_deg, origin_m):
    road = Road(steps=3, labelled=False, origin_m=origin_m)
    road.tilt_deg = tilt_deg
    frames = RecordedFrames(road, reference=AccumulatedReference(10.0))
    assert frames.has_heights()
    frame = frames[1]
    placed_m = transform_points(road.get_world_T_vehicle(1), frame.reference.numpy().astype(np.float64)) - origin_m
    expected_m = placed_m[:, 2] - rises(placed_m[:, 0], placed_m[:, 1])
    found_m = frame.reference_heights_m.numpy()
    assert found_m.dtype == np.float32
    known = np.isfinite(found_m)
    assert known.mean() > 0.95
    assert np.sqrt(((found_m - expected_m)[known] ** 2).mean()) < 0.02
    assert (placed_m[~known, 0] > 35.0).all()  # the wall goes on where the road was not seen


def test_the_bottom_of_a_box_has_a_height():
    road = Road(steps=2)
    boxes = RecordedFrames(road)[1].boxes
    place_m = road.world_T_car(1)[:3, 3]
    expected_m = place_m[2] - CAR_SIZE_M[2] / 2 - rises(*place_m[:2])
    np.testing.assert_allclose(boxes.bottom_heights_m, [expected_m], atol=0.02)


def test_heights_do_not_depend_on_reading_order():
    forward, backward = (RecordedFrames(Road(steps=4), reference=AccumulatedReference(0.2)) for _ in range(2))
    one = [forward[index].reference_heights_m for index in range(4)]
    other = [backward[index].reference_heights_m for index in reversed(range(4))][::-1]
    for first, second in zip(one, other, strict=True):
        np.testing.assert_array_equal(first, second)


def test_ground_of_one_frame_without_times():
    road = Road(steps=2, labelled=False)
    road.times_s = None
    frames = RecordedFrames(road, rigs={"left": ("left",)}, reference=AccumulatedReference(0.0))
    frame = frames[1]
    placed_m = transform_points(road.get_world_T_vehicle(1), frame.reference.numpy().astype(np.float64))
    off_m = frame.reference_heights_m.numpy() - (placed_m[:, 2] - rises(placed_m[:, 0], placed_m[:, 1]))
    assert np.sqrt(np.nanmean(off_m**2)) < 0.03


def test_bands_are_over_z_without_ground():
    frames = RecordedFrames(Drive(), reference=AccumulatedReference(0.5))
    result = torchcover.evaluate(frames=frames, cell_m=8.0)
    assert result.coverage.band_frame == "vehicle"
    assert "Ground: none was found near the vehicle" in " ".join(result.table.notes)
    assert RecordedFrames(Drive())[0].reference_heights_m.isnan().all()
    assert RecordedFrames(Road(steps=2), use_ground_model=False)[0].reference_heights_m is None


def test_bands_are_over_ground_with_ground():
    frames = RecordedFrames(Road(steps=4), reference=AccumulatedReference(0.5))
    result = torchcover.evaluate(frames=frames, cell_m=8.0)
    assert result.coverage.band_frame == "ground"
    assert "Ground: height field through the ground points of all sensors" in " ".join(result.table.notes)
