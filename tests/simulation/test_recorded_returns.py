"""LiDARs are calibrated by the rays that returned from a road."""

import numpy as np
import pytest

from torchcover.recordings import open_recording
from torchcover.simulation import Rig, calibrate
from torchcover.simulation.recorded_returns import fit_returns
from torchcover.simulation.returns import Material, compute_log_excess, compute_return_probability
from torchcover.simulation.road_returns import RoadParams, count_ground_rays, fit_road_profile

RANGE_M, SPREAD, NOISE_M, HEIGHT_M = 60.0, 0.25, 0.02, 1.9
RIG = Rig.model_validate(
    {
        "name": "truth",
        "sensors": [
            {
                "name": "roof",
                "mount": {"z_m": HEIGHT_M},
                "elevations_deg": np.round(-np.rad2deg(np.arctan(HEIGHT_M / np.geomspace(4, 90, 40))), 6).tolist(),
                "horizontal_fov_deg": 360,
                "columns": 1440,
                "max_range_m": 200,
            }
        ],
    }
)
ROAD = Material.load("road")


def simulate_sweep(generator, wall_m=np.inf, top_m=np.inf):
    """Simulate the returns from a plain with a wall of a given height across the road ahead."""
    directions = RIG.sensors[0].compute_directions().reshape(3, -1)
    range_m = HEIGHT_M / -directions[2]
    with np.errstate(divide="ignore"):
        at_wall_m = HEIGHT_M + directions[2] * wall_m / directions[0]
    cosine, on_wall = -directions[2], (directions[0] * range_m > wall_m) & (at_wall_m < top_m)
    range_m = np.where(on_wall, wall_m / directions[0], range_m)
    excess = compute_log_excess(range_m, cosine, ROAD.numeric_reflectivity, ROAD.incidence_exponent, RANGE_M)
    returned = on_wall | (
        generator.random(len(range_m)) < compute_return_probability(excess, SPREAD, ROAD.log_reflectivity_std)
    )
    measured_m = range_m + NOISE_M * generator.standard_normal(len(range_m))
    return (directions * measured_m).T[returned] + [0.0, 0.0, HEIGHT_M]


def write_recording(folder, sweeps, poses=True):
    (folder / "sensor").mkdir()
    for number, points_m in enumerate(sweeps):
        np.save(folder / "sensor" / f"{number}.npy", points_m)
    if poses:
        step_m = poses if isinstance(poses, float) else 5.0
        rows = [f"{number},{number},{step_m * number},0,0,1,0,0,0" for number in range(len(sweeps))]
        (folder / "poses.csv").write_text("\n".join(["frame,time_s,x_m,y_m,z_m,qw,qx,qy,qz", *rows]))
    return open_recording(folder)


@pytest.fixture(scope="module")
def sweeps():
    generator = np.random.default_rng(5)
    return [simulate_sweep(generator) for _ in range(3)]


def test_calibration_recovers_a_simulated_plain(sweeps, tmp_path):
    rig, [found] = calibrate(write_recording(tmp_path, sweeps), RIG)
    assert abs(np.log(found.fit.range_at_10_percent_m / RANGE_M)) < 3 * found.fit.log_range_error < 0.15
    assert abs(np.log(found.fit.log_range_std / SPREAD)) < 3 * found.fit.log_std_error < 0.6
    assert found.range_noise_m == pytest.approx(NOISE_M, rel=0.1)
    assert rig.sensors[0].range_at_10_percent_m == round(found.fit.range_at_10_percent_m, 1)


def test_errors_follow_the_curvature_of_the_likelihood(sweeps):
    rays = count_ground_rays(sweeps, RIG.sensors[0])
    fit, returned = fit_returns(rays, ROAD), rays.return_counts / rays.ray_counts

    def compute_loss(log_range, log_spread):
        excess = compute_log_excess(
            rays.range_m,
            rays.cos_incidence,
            ROAD.numeric_reflectivity,
            ROAD.incidence_exponent,
            float(np.exp(log_range)),
        )
        seen = compute_return_probability(excess, float(np.exp(log_spread)), ROAD.log_reflectivity_std)
        prior = ((log_spread - np.log(0.3)) / 0.7) ** 2 / 2
        return prior - (returned * np.log(seen) + (1 - returned) * np.log1p(-seen)).sum()

    x, y, step = np.log(fit.range_at_10_percent_m), np.log(fit.log_range_std), 0.02
    grid = np.array([[compute_loss(x + i * step, y + j * step) for j in (-1, 0, 1)] for i in (-1, 0, 1)])
    mixed = (grid[2, 2] - grid[0, 2] - grid[2, 0] + grid[0, 0]) / 4
    curvature = np.array([[np.diff(grid[:, 1], 2)[0], mixed], [mixed, np.diff(grid[1], 2)[0]]]) / step**2
    expected = np.sqrt(np.diag(np.linalg.inv(curvature)))
    assert [fit.log_range_error, fit.log_std_error] == pytest.approx(expected, rel=0.1)


def test_fit_predicts_the_other_half_of_revolutions(sweeps):
    rays = count_ground_rays(sweeps, RIG.sensors[0])
    ahead = np.abs(rays.azimuth_deg) < 90
    fit, judged = fit_returns(rays.select(ahead), ROAD), rays.select(~ahead)
    excess = compute_log_excess(
        judged.range_m,
        judged.cos_incidence,
        ROAD.numeric_reflectivity,
        ROAD.incidence_exponent,
        fit.range_at_10_percent_m,
    )
    probability = compute_return_probability(excess, fit.log_range_std, ROAD.log_reflectivity_std)
    for low_m in range(10, 90, 10):
        there = (judged.range_m >= low_m) & (judged.range_m < low_m + 10)
        rays_there = judged.ray_counts[there].sum()
        if rays_there >= 200:
            real = judged.return_counts[there].sum() / rays_there
            assert real == pytest.approx((probability * judged.ray_counts)[there].sum() / rays_there, abs=0.06)


def test_rays_behind_walls_are_not_counted():
    """Otherwise the occluded road would count as missing returns."""
    rays = count_ground_rays([simulate_sweep(np.random.default_rng(1), wall_m=30.0)], RIG.sensors[0])
    ahead = np.abs(rays.azimuth_deg) < 10
    assert rays.range_m[ahead].max() < 31 < 60 < rays.range_m[~ahead].max()


def test_rays_pass_above_low_obstacles():
    """A beam of 0.5 m occludes the road from 30 to 30 / (1 - 0.5 / 1.9) = 41 m only."""
    beam = count_ground_rays([simulate_sweep(np.random.default_rng(1), wall_m=30.0, top_m=0.5)], RIG.sensors[0])
    ahead = np.abs(beam.azimuth_deg) < 10
    assert not ((beam.range_m[ahead] > 31) & (beam.range_m[ahead] < 40)).any()
    assert ((beam.range_m[ahead] > 45) & (beam.range_m[ahead] < 80)).sum() > 100


def test_road_profile_fits_slopes_and_curvature():
    x, y = np.meshgrid(np.linspace(-60, 60, 121), np.linspace(-6, 6, 25))
    height_m = 0.02 * x - 0.01 * y + 0.2 * (x / 40) ** 2 * (x > 0)
    profile = fit_road_profile(np.stack([x, y, height_m], axis=-1).reshape(-1, 3))
    assert (
        np.abs(
            profile.compute_heights_m(np.stack([x, y, height_m], axis=-1).reshape(-1, 3)) - height_m.reshape(-1)
        ).max()
        < 0.02
    )


def test_points_outside_lanes_are_no_road():
    x, y = np.meshgrid(np.linspace(-60, 60, 121), np.linspace(-20, 20, 81))
    lanes = np.abs(y) < RoadParams().half_lanes_m
    points_m = np.stack([x, y, 0.02 * x + 0.3 * ~lanes], axis=-1)
    whole, alone = fit_road_profile(points_m.reshape(-1, 3)), fit_road_profile(points_m[lanes])
    np.testing.assert_allclose(
        whole.compute_heights_m(points_m[lanes]), alone.compute_heights_m(points_m[lanes]), atol=1e-9
    )


def test_near_rays_are_not_counted(sweeps):
    """Steep rays return for any LiDAR."""
    assert np.tan(np.deg2rad(RIG.sensors[0].compute_elevations_deg())).min() < -HEIGHT_M / 5
    assert count_ground_rays(sweeps, RIG.sensors[0]).range_m.min() > RoadParams().min_range_m


def test_near_road_does_not_determine_the_range(sweeps, tmp_path):
    """All rays return, which any sufficient range explains."""
    _, [found] = calibrate(write_recording(tmp_path, sweeps), RIG)
    rays = count_ground_rays(sweeps, RIG.sensors[0])
    fit = fit_returns(rays.select(rays.range_m < 16), ROAD)
    assert found.fit.is_range_observable
    assert not fit.is_range_observable
    assert "m at 10 %" in found.text
    assert "cannot tell" in found._replace(fit=fit).text


@pytest.mark.parametrize(
    ("sweeps_made", "poses", "told"),
    [
        (lambda made: [points_m[:0] for points_m in made], 5.0, "0 rays to an open road"),
        (lambda made: made, 0.1, "the vehicle does not move, 3 sweeps within 0.20 m"),
        (lambda made: [*made[:2], made[0]], False, "roof: sweeps 0 and 2 are the same cloud"),
    ],
    ids=["empty", "standing", "one sweep again"],
)
def test_uninformative_recordings_are_refused(sweeps, tmp_path, sweeps_made, poses, told):
    with pytest.raises(ValueError, match=told):
        calibrate(write_recording(tmp_path, sweeps_made(sweeps), poses), RIG)


def test_rigs_without_common_sensors_are_refused(sweeps, tmp_path):
    with pytest.raises(ValueError, match="no LiDAR of the rig 'argoverse2' is in it"):
        calibrate(write_recording(tmp_path, sweeps[:1]), Rig.load("argoverse2"))
