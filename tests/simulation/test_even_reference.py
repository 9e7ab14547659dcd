"""A reference sensor that looks where it is asked to: what its rays aim at, and what its weights are."""

import math

import numpy as np
import pytest

from torchcover.data import SimulatedFrames
from torchcover.geometry import BoundingBox
from torchcover.simulation import EvenReference, PaperReference, Scenario, Simulator
from torchcover.simulation.paper_reference import paper_density
from torchcover.simulation.rays import into_tiles

EGO = BoundingBox((-2.45, -0.97, 0.0), (2.45, 0.97, 1.63))
NEAR, FAR = ((0.0, 20.0), (-5.0, 5.0)), ((0.0, 160.0), (-40.0, 40.0))


def rays_of(sensor, seed=0, place_m=None):
    """Place and (3, N) directions of one step."""
    generator = np.random.default_rng(seed)
    pose = sensor.vehicle_T_reference(EGO, generator)
    if place_m is not None:
        pose[:3, 3] = place_m
    tiles = sensor.tiles(pose, generator)
    return pose, tiles, np.concatenate([tile.directions for tile in tiles], axis=1).astype(np.float64)


def density_of(sensor, pose, directions):
    """The density that the weights imply: the paper's over the weight."""
    (tile,) = into_tiles(directions[:, None], tile_columns=directions.shape[1])
    weights = sensor.weights(pose, (tile,), np.arange(directions.shape[1]))
    elevation = np.arcsin(np.clip(directions[2], -1, 1))
    return np.interp(elevation, np.linspace(-np.pi / 2, np.pi / 2, len(paper_density())), paper_density()) / weights


def test_rays_that_reach_the_ground_are_even_over_each_area():
    pose, _, directions = rays_of(EvenReference((NEAR, FAR), rays=4 * 3200), place_m=[1.0, 0.0, 2.0])
    to_ground = directions[:, :3200]  # of the first area, the first half
    x, y, _ = pose[:3, 3][:, None] - to_ground * pose[2, 3] / to_ground[2]
    counts, _, _ = np.histogram2d(x, y, bins=[np.arange(0, 20.1, 0.25), np.arange(-5, 5.1, 0.25)])
    assert counts.shape == (80, 40)
    assert counts.sum() == 3200
    # One ray a patch of a quarter metre; float32 directions may take one across a border.
    assert (counts == 1).mean() > 0.99


@pytest.mark.parametrize("tilt", [{}, {"pitch_deg": 1.5}, {"pitch_deg": -1.5}, {"yaw_deg": 70.0, "roll_deg": 1.5}])
def test_rays_aim_at_the_level_ground_however_the_vehicle_is_tilted(tilt):
    """At 160 m a degree is 2.8 m: aimed along the vehicle's own plane, rays end short of the far half or above it."""
    document = {
        "name": "tilted",
        "ego": {"shape": {"type": "box", "size_m": [4, 2, 1.5]}, "pose": {"z_m": 0.2, **tilt}},
        "bodies": [{"name": "ground", "shape": {"type": "plane", "size_m": [900, 900]}, "poses": [{"z_m": 0.2}]}],
    }
    sensor = EvenReference((FAR,), rays=8000)
    seen = Simulator(Scenario.model_validate(document), {}, sensor).step(0)
    x, y, z = seen.reference[:3900].T.astype(float)  # of the first half, which reaches the ground
    counts, _, _ = np.histogram2d(x, y, bins=[np.linspace(0, 160, 5), np.linspace(-40, 40, 5)])
    np.testing.assert_allclose(counts[1:], 250, rtol=0.1)  # nearer the ego is in the way
    assert (np.abs(z).max() > 1.0) == bool(tilt)
    assert (seen.reference_weights > 0).all()


def test_every_area_gets_as_many_rays():
    _, tiles, directions = rays_of(EvenReference((NEAR, FAR, ((-40.0, 160.0), (-40.0, 40.0))), rays=6000))
    assert 0.9 * 6000 < directions.shape[1] <= 6000
    assert len(tiles) == 6
    sizes = [tile.directions.shape[1] for tile in tiles]
    assert max(sizes) - min(sizes) < 0.05 * max(sizes)


def test_a_step_looks_elsewhere_than_the_one_before_but_always_at_the_same_places():
    sensor = EvenReference((FAR,), rays=512)
    assert np.array_equal(rays_of(sensor, seed=1)[2], rays_of(sensor, seed=1)[2])
    one, other = rays_of(sensor, 1, [0, 0, 2.0])[2], rays_of(sensor, 2, [0, 0, 2.0])[2]
    assert not (one == other).any(axis=0).any()


@pytest.mark.parametrize("place_m", [[1.0, 0.3, 2.1], [-2.9, 0.0, 0.4], [2.9, 1.2, 1.0]])
def test_the_density_is_that_of_the_rays(place_m):
    """The integral of the density over a part of the sphere is the share of the rays in it."""
    sensor = EvenReference((NEAR, ((-10.0, 10.0), (-10.0, 10.0))), rays=200_000)
    pose, _, rays = rays_of(sensor, place_m=place_m)
    for low, high in [(-1.0, -0.6), (-0.6, -0.3), (-0.3, -0.1), (-0.1, 0.0), (0.0, 0.3)]:
        for forward in (True, False):
            # Quasi-uniform in z and azimuth: dz dphi is a solid angle.
            z, phi = np.meshgrid(
                low + (high - low) * (np.arange(300) + 0.5) / 300, np.pi * (np.arange(300) + 0.5) / 300 - np.pi / 2
            )
            phi = phi if forward else phi + np.pi
            directions = np.stack([np.cos(phi) * np.sqrt(1 - z**2), np.sin(phi) * np.sqrt(1 - z**2), z]).reshape(3, -1)
            expected = density_of(sensor, pose, directions).mean() * (high - low) * np.pi
            inside = (rays[2] >= low) & (rays[2] < high) & ((rays[0] > 0) == forward)
            assert inside.mean() == pytest.approx(expected, rel=0.03, abs=0.003)


def test_the_papers_density_is_one_over_the_sphere_and_that_of_its_rays():
    elevation = np.linspace(-np.pi / 2, np.pi / 2, len(paper_density()))
    whole = 2 * np.pi * np.trapezoid(paper_density() * np.cos(elevation), elevation)
    assert whole == pytest.approx(1.0, abs=0.01)

    paper, generator = PaperReference(rows=64, columns=64), np.random.default_rng(0)
    poses = [paper.vehicle_T_reference(EGO, generator)[:3, :3] for _ in range(400)]
    z = np.concatenate([(pose @ paper.directions().reshape(3, -1))[2] for pose in poses])
    for low, high in [(-90, -60), (-60, -30), (-30, -10), (-10, 0), (0, 20)]:
        part = np.linspace(*np.deg2rad([low, high]), 200)
        expected = 2 * np.pi * np.trapezoid(np.interp(part, elevation, paper_density()) * np.cos(part), part)
        sines = np.sin(np.deg2rad([low, high]))
        assert ((z >= sines[0]) & (z < sines[1])).mean() == pytest.approx(expected, abs=0.02)


def test_weights_are_positive_and_finite_at_every_border():
    sensor = EvenReference((NEAR, FAR), rays=20_000)
    for seed in range(5):
        pose, tiles, directions = rays_of(sensor, seed)
        weights = sensor.weights(pose, tiles, np.arange(directions.shape[1]))
        assert weights.dtype == np.float32
        assert np.isfinite(weights).all()
        assert (weights > 0).all()


def test_frames_carry_a_weight_for_each_point():
    sensor = EvenReference((NEAR,), rays=1024)
    frames = SimulatedFrames("courtyard", "front_roof_32", steps=2, reference_sensor=sensor)
    frame = frames[1]
    assert frame.reference_weights.shape == (len(frame.reference),)
    assert (
        SimulatedFrames("courtyard", "front_roof_32", steps=1, reference_sensor=PaperReference(4, 4))[
            0
        ].reference_weights
        is None
    )
    again = SimulatedFrames("courtyard", "front_roof_32", steps=2, reference_sensor=sensor)[1]
    assert bool((again.reference == frame.reference).all())
    assert bool((again.reference_weights == frame.reference_weights).all())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"areas": ()}, "areas: at least one rectangle"),
        ({"areas": (((1.0, 0.0), (0.0, 1.0)),)}, "areas: finite bounds, lower first"),
        ({"areas": (((0.0, math.inf), (0.0, 1.0)),)}, "areas: finite bounds"),
        ({"areas": (NEAR, FAR), "rays": 3}, "rays: at least 2 for each of 2 areas are needed; got 3"),
        ({"areas": (NEAR,), "shell_m": 0.0}, "shell_m: a positive thickness"),
        ({"areas": (NEAR,), "max_range_m": math.nan}, "max_range_m: a positive distance"),
    ],
)
def test_what_makes_no_sense_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        EvenReference(**{"rays": 64, **options})
