"""Laws that hold for every sensor and reference sensor; a new one needs a class and one line."""

import pickle
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
import pytest
import torch

from torchcover import Rig
from torchcover.data import SimulatedFrames
from torchcover.geometry import BoundingBox, build_transform
from torchcover.simulation import (
    REFERENCE_SENSORS,
    SENSORS,
    PaperReference,
    Pose,
    RayHits,
    ReferenceScan,
    RegionsOfInterest,
    Scenario,
    SensorNoise,
    Simulator,
    compute_vertical_fov_deg,
    sample_position_in_shell,
    split_into_tiles,
)
from torchcover.simulation.sensor import RangeSensor
from torchcover.targets import Raster, Target, measure_target_visibility

EGO = BoundingBox((-2.4, -1.0, 0.0), (2.4, 1.0, 1.6))
ASKED = RegionsOfInterest(regions={"20m": {"x_m": (0.0, 20.0), "y_m": (-5.0, 5.0)}}).build_query_plan()
MOUNT = {"x_m": 2.6, "z_m": 1.0, "yaw_deg": 30.0}
RANGES = {"min_range_m": 1.0, "max_range_m": 60.0, "range_noise_m": 0.02, "dropout": 0.1}


class Altimeter(RangeSensor):
    """Smallest possible sensor: it points down ahead."""

    type: Literal["altimeter"] = "altimeter"
    name: str
    mount: Pose = Pose()
    horizontal_fov_deg: float = 20.0
    num_rays: int = 5

    def compute_directions(self):
        across = np.deg2rad(np.linspace(-10.0, 10.0, 5))
        down = np.full(5, np.sqrt(0.5))
        return np.stack([np.sqrt(0.5) * np.cos(across), np.sqrt(0.5) * np.sin(across), -down])[:, None]


@dataclass(frozen=True)
class DownReference:
    """Smallest possible reference sensor: it points straight down."""

    name: ClassVar[str] = "down"
    has_area_weights: ClassVar[bool] = True
    band_frame: ClassVar[str] = "vehicle"

    num_rays: int
    shell_m: float = 0.5
    max_range_m: float = 30.0

    @classmethod
    def from_query_plan(cls, query_plan, num_rays):
        if num_rays is not None and num_rays < 1:
            raise ValueError(f"num_rays: at least 1 is needed; got {num_rays}")
        return cls(8 if num_rays is None else num_rays)

    def scan(self, context):
        pose, redrawn = context.sample_free_pose(self.sample_pose)
        x, y = context.rng.uniform(-0.1, 0.1, size=(2, 1, self.num_rays))
        tiles = split_into_tiles(np.stack([x, y, -np.sqrt(1 - x**2 - y**2)]))
        scan = context.snapshot.scan(pose, tiles, max_range_m=self.max_range_m)
        weights = np.full(len(scan.points), 2.0, dtype=np.float32)
        return ReferenceScan(scan.points, weights, scan.num_rays, scan.self_hits, scan.num_body_casts, redrawn)

    def sample_pose(self, ego_box, rng):
        return build_transform(np.eye(3), sample_position_in_shell(ego_box, self.shell_m, rng))


# Keys of one sensor of each type, in addition to name, type, mount and ranges.
KEYS = {
    "lidar": {"channels": 4, "vertical_fov_deg": [-20, 10], "horizontal_fov_deg": 90, "columns": 16},
    "camera": {"width": 24, "height": 16, "fov_deg": 80},
    "radar": {
        "horizontal_fov_deg": 90,
        "vertical_fov_deg": [-20, 10],
        "azimuth_cell_deg": 7,
        "range_cell_m": 0.5,
        "ray_spacing_m": 2,
    },
    "altimeter": {},
}


@pytest.fixture(params=[*SENSORS, "altimeter"])
def sensor(request, monkeypatch):
    """Create a sensor of each type from keys of a rig file."""
    monkeypatch.setitem(SENSORS, "altimeter", Altimeter)
    keys = {"type": request.param, "name": "a", "mount": MOUNT, **RANGES, **KEYS[request.param]}
    (made,) = Rig.model_validate({"name": "r", "sensors": [keys]}).sensors
    assert type(made) is SENSORS[request.param]
    return made


@pytest.fixture(params=[*REFERENCE_SENSORS, "down"])
def reference_sensor(request, monkeypatch):
    """Create a reference sensor of each kind from areas and a number of rays."""
    monkeypatch.setitem(REFERENCE_SENSORS, "down", DownReference)
    made = REFERENCE_SENSORS[request.param].from_query_plan(ASKED, 900)
    assert made.name == request.param
    return made


def test_sensor_directions_are_unit_vectors_or_nan(sensor):
    directions = sensor.compute_directions()
    assert directions.dtype == np.float64
    assert directions.ndim == 3
    assert len(directions) == 3
    has_ray = ~np.isnan(directions)
    assert has_ray.any()
    assert (has_ray.all(axis=0) == has_ray.any(axis=0)).all()
    lengths = np.linalg.norm(directions, axis=0)[has_ray[0]]
    np.testing.assert_allclose(lengths, 1.0, atol=1e-12)
    np.testing.assert_array_equal(sensor.compute_directions(), directions)


def test_fields_of_view_contain_all_rays(sensor):
    x, y, z = sensor.compute_directions()
    low, high = compute_vertical_fov_deg(sensor)
    middle = np.rad2deg(np.arcsin(z))[:, x.shape[1] // 2]
    assert (low, high) == pytest.approx((np.nanmin(middle), np.nanmax(middle)))
    azimuth_deg = np.rad2deg(np.arctan2(y, x))[len(x) // 2]
    assert 0 < np.nanmax(azimuth_deg) - np.nanmin(azimuth_deg) <= sensor.horizontal_fov_deg + 1e-9 <= 360 + 1e-9


def create_hits(sensor, range_m, ray=None):
    """Create hits of all or some rays at given ranges."""
    pixel_of_ray = np.flatnonzero(~np.isnan(sensor.compute_directions()[0]))
    ray = np.arange(len(pixel_of_ray)) if ray is None else ray
    return RayHits(ray, np.broadcast_to(range_m, len(ray)).astype(np.float32), pixel_of_ray)


def list_hits(returns, count):
    """List the hits that give a point."""
    return np.arange(count) if returns.hit_indices is None else returns.hit_indices


def test_only_hits_within_range_limits_give_points(sensor):
    exact = sensor.model_copy(update={"range_noise_m": 0.0, "dropout": 0.0})
    assert exact.is_exact
    assert not sensor.is_exact
    near_hits, far_hits = create_hits(exact, 0.99), create_hits(exact, 1.0)
    assert len(list_hits(exact.measure(near_hits, SensorNoise(None)), len(near_hits.ray_indices))) == 0
    hit = list_hits(exact.measure(far_hits, SensorNoise(None)), len(far_hits.ray_indices))
    assert len(hit) > 0
    assert (np.diff(hit) > 0).all()
    none = create_hits(exact, 5.0, np.empty(0, dtype=np.int64))
    assert len(list_hits(exact.measure(none, SensorNoise(None)), 0)) == 0


def test_beams_are_measured_independently(sensor):
    """Removing hits of some beams does not change the points of other beams, for any number of positions."""
    beams, random = sensor.compute_beam_indices(), np.random.default_rng(5)
    all_hits = create_hits(sensor, random.uniform(0.5, 9.0, len(create_hits(sensor, 1.0).ray_indices)))
    of_ray = all_hits.ray_indices if beams is None else beams.ravel()[all_hits.pixel_indices]
    measured = sensor.measure(all_hits, SensorNoise(np.random.default_rng(0), num_rays=len(all_hits.ray_indices)))
    remaining = np.flatnonzero(of_ray % 3 != 1)
    part = RayHits(
        all_hits.ray_indices[remaining],
        all_hits.range_m[remaining],
        all_hits.ray_pixel_indices,
        np.zeros(len(remaining), dtype=np.int64),
    )
    of_part = sensor.measure(part, SensorNoise(np.random.default_rng(0), num_rays=len(all_hits.ray_indices)))
    left = np.isin(measured.hit_indices, remaining)
    np.testing.assert_array_equal(remaining[of_part.hit_indices], measured.hit_indices[left])
    np.testing.assert_array_equal(of_part.range_error_m, measured.range_error_m[left])
    twice = RayHits(
        np.tile(all_hits.ray_indices, 2),
        np.tile(all_hits.range_m, 2),
        all_hits.ray_pixel_indices,
        np.repeat([0, 1], len(all_hits.ray_indices)),
    )
    combined = sensor.measure(twice, SensorNoise(np.random.default_rng(0), num_rays=len(all_hits.ray_indices)))
    np.testing.assert_array_equal(
        combined.hit_indices, np.concatenate([measured.hit_indices, measured.hit_indices + len(all_hits.ray_indices)])
    )


def test_random_numbers_do_not_depend_on_the_hits(sensor):
    """Otherwise the hits of one thread would affect the random numbers of another."""
    rays = len(create_hits(sensor, 1.0).ray_indices)
    used, fresh = (SensorNoise(np.random.default_rng(2), num_rays=rays) for _ in range(2))
    sensor.measure(create_hits(sensor, 1.0, np.empty(0, dtype=np.int64)), used)
    first, second = (sensor.measure(create_hits(sensor, 5.0), draws) for draws in (used, fresh))
    np.testing.assert_array_equal(first.hit_indices, second.hit_indices)
    np.testing.assert_array_equal(first.range_error_m, second.range_error_m)


def test_sensors_survive_pickling_and_saving(sensor):
    assert pickle.loads(pickle.dumps(sensor)) == sensor
    rig = Rig(name="r", sensors=(sensor,))
    assert Rig.model_validate(rig.model_dump()) == rig


def test_wrong_sensor_keys_are_named(sensor):
    keys = sensor.model_dump() | {"colour": "red"}
    with pytest.raises(ValueError, match=r"sensors\.0\.colour\n.*Extra inputs"):
        Rig.model_validate({"name": "r", "sensors": [keys]})


def test_a_sensor_is_simulated(sensor):
    exact = sensor.model_copy(update={"range_noise_m": 0.0, "dropout": 0.0, "min_range_m": 0.0})
    frames = SimulatedFrames(
        "courtyard", Rig(name="r", sensors=(exact,)), num_frames=1, reference_sensor=PaperReference(8, 8)
    )
    frame = frames[0]
    assert frame.counts["sensor_rays"] == (~np.isnan(exact.compute_directions()[0])).sum()
    assert sensor.num_rays == exact.compute_directions()[0].size
    ranges_m = (frame.sensor.double() - torch.tensor([2.6, 0.0, 1.0])).norm(dim=1)
    assert 0 < len(ranges_m) <= frame.counts["sensor_rays"]
    assert ranges_m.max() <= exact.max_range_m


def test_the_scenario_decides_the_range_of_sensors(sensor, monkeypatch):
    rig = Rig(name="r", sensors=(sensor.model_copy(update={"range_noise_m": 0.0, "dropout": 0.0}),))

    def simulate():
        frames = SimulatedFrames("courtyard", rig, num_frames=1, reference_sensor=PaperReference(8, 8))
        return frames[0].reference, (frames[0].sensor.double() - torch.tensor([2.6, 0.0, 1.0])).norm(dim=1)

    def targets():
        raster = Raster((4.0, 12.0), (-1.0, 7.0), 1.0)
        return np.nansum(
            measure_target_visibility(rig, Scenario.load("courtyard"), Target.load("adult"), raster).points
        )

    (whole, away_m), of_targets = simulate(), targets()
    reach_m = float(away_m.min() + away_m.max()) / 2 - 0.01
    monkeypatch.setattr(Scenario, "compute_max_range_m", lambda *_: reach_m)
    reference, near_m = simulate()
    assert torch.equal(reference, whole)
    assert (near_m <= reach_m).all()
    assert (away_m > reach_m).any()
    if sensor.compute_beam_indices() is None:  # otherwise a point depends on all hits of its beam
        assert len(near_m) == (away_m <= reach_m).sum()
    monkeypatch.setattr(Scenario, "compute_max_range_m", lambda *_: 1.0)
    assert targets() == 0 < of_targets or sensor.type == "altimeter"


@pytest.mark.parametrize("content", ["lidar", 3, {"type": ["lidar"]}, {"type": "sonar"}, None])
def test_unknown_sensor_types_list_the_valid_ones(content):
    kinds = " or a ".join(map(repr, SENSORS))
    with pytest.raises(ValueError, match=rf"sensors\.0\n.*type: a sensor is a {kinds}; got"):
        Rig.model_validate({"name": "r", "sensors": [content]})


@pytest.mark.parametrize("sensor", [PaperReference(8, 8), DownReference(8)], ids=["paper", "down"])
def test_reference_positions_lie_in_the_shell(sensor):
    grown_m = sensor.shell_m + 1e-12
    for seed in range(50):
        pose = sensor.sample_pose(EGO, np.random.default_rng(seed))
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        np.testing.assert_array_equal(pose[3], [0, 0, 0, 1])
        assert (pose[:3, 3] >= np.array(EGO.lower_m) - [grown_m, grown_m, 0]).all()
        assert (pose[:3, 3] <= np.array(EGO.upper_m) + grown_m).all()
        assert ((pose[:3, 3] < EGO.lower_m) | (pose[:3, 3] > EGO.upper_m)).any()


def test_reference_sensors_have_a_default_ray_number(reference_sensor):
    default_sensor = type(reference_sensor).from_query_plan(ASKED, None)
    assert default_sensor == type(reference_sensor).from_query_plan(ASKED, None)
    assert default_sensor != reference_sensor


@pytest.mark.parametrize("rays", [0, -4])
def test_a_reference_sensor_without_rays_is_refused(reference_sensor, rays):
    with pytest.raises(ValueError, match=f"num_rays: at least .*; got {rays}"):
        type(reference_sensor).from_query_plan(ASKED, rays)


def test_a_reference_sensor_survives_pickling(reference_sensor):
    simulator = Simulator(Scenario.load("courtyard"), {}, reference_sensor)
    used = simulator.simulate_frame(1)
    travelled = pickle.loads(pickle.dumps(reference_sensor))
    assert travelled == reference_sensor
    assert hash(travelled) == hash(reference_sensor)
    np.testing.assert_array_equal(
        simulator.replace_reference_sensor(travelled).simulate_frame(1).reference, used.reference
    )


def test_reference_sensors_use_only_the_frame_rng(reference_sensor):
    np.random.seed(1)  # noqa: NPY002  (the random numbers that it must not draw)
    state = np.random.get_state()[1].copy()  # noqa: NPY002
    simulator = Simulator(Scenario.load("courtyard"), {}, reference_sensor, seed=3)
    first, repeated, second = simulator.simulate_frame(4), simulator.simulate_frame(4), simulator.simulate_frame(5)
    np.testing.assert_array_equal(first.reference, repeated.reference)
    assert not np.array_equal(first.reference, second.reference)
    np.testing.assert_array_equal(np.random.get_state()[1], state)  # noqa: NPY002


def test_reference_points_are_in_range_and_weighted(reference_sensor):
    observation = Simulator(Scenario.load("courtyard"), {}, reference_sensor).simulate_frame(0)
    assert observation.reference.dtype == np.float32
    assert observation.reference.shape == (len(observation.reference), 3)
    farthest_m = np.linalg.norm(EGO.corners_m, axis=1).max() + 2 * reference_sensor.shell_m
    assert np.linalg.norm(observation.reference, axis=1).max() <= reference_sensor.max_range_m + farthest_m
    assert reference_sensor.has_area_weights == (observation.reference_weights is not None)
    if observation.reference_weights is not None:
        assert observation.reference_weights.dtype == np.float32
        assert len(observation.reference_weights) == len(observation.reference)
        assert (observation.reference_weights > 0).all()
        assert np.isfinite(observation.reference_weights).all()


def test_a_reference_sensor_is_simulated(reference_sensor):
    frames = SimulatedFrames("courtyard", "front_roof_32", num_frames=2, seed=4, reference_sensor=reference_sensor)
    frame, loaded_frame = frames[1], pickle.loads(pickle.dumps(frames))[1]
    assert frame.counts["reference_rays"] == pytest.approx(900, rel=0.15)
    assert 0 < len(frame.reference) <= frame.counts["reference_rays"]
    assert torch.equal(frame.reference, loaded_frame.reference)
    assert frame.reference_weights is None or len(frame.reference_weights) == len(frame.reference)
    assert not torch.equal(frames[0].reference, frame.reference)
