"""Simulated frames: pure functions of scenario, rig, seed and index."""

from importlib.util import find_spec

import pytest
import torch

from torchcover import Rig, Scenario, nearest
from torchcover.data import SimulatedFrames
from torchcover.simulation import PaperReference

SMALL = PaperReference(rows=48, columns=64)


def frames(seed=3, num_frames=6, rig="front_grille_128"):
    return SimulatedFrames("courtyard", rig, num_frames=num_frames, seed=seed, reference_sensor=SMALL)


def same(a, b):
    return torch.equal(a.sensor, b.sensor) and torch.equal(a.reference, b.reference) and a.counts == b.counts


@pytest.mark.skipif(not find_spec("warp"), reason="Warp is not installed")
@pytest.mark.parametrize("scenario", ["courtyard", "urban"])
@pytest.mark.parametrize("device", ["cpu", *["cuda:0"] * torch.cuda.is_available()])
def test_warp_and_embree_hits_agree(scenario, device):
    """Except for rounding, and rays that pass an edge on the other side."""
    by_embree, by_warp = (
        SimulatedFrames(scenario, "kitti", num_frames=2, frame_interval_s=1.0, device=each)[1]
        for each in (None, device)
    )
    for expected, actual in ((by_embree.sensor, by_warp.sensor), (by_embree.reference, by_warp.reference)):
        for queries, points in ((expected, actual), (actual, expected)):
            assert (nearest(queries, points).distance > 1e-3).float().mean() < 1e-4


def test_seed_and_index_change_only_the_reference():
    a, b, c = frames(seed=0)[0], frames(seed=1)[0], frames(seed=0)[1]
    assert torch.equal(a.sensor, b.sensor)
    assert not torch.equal(a.reference, b.reference)
    assert not torch.equal(a.reference, c.reference)


def test_self_hits_are_excluded_and_counted():
    frame = frames(rig="front_roof_128")[0]
    for cloud in (frame.sensor, frame.reference):
        x, y, z = cloud.T
        assert not ((x.abs() < 2.0) & (y.abs() < 0.8) & (z > 0.3) & (z < 1.6)).any()
    assert frame.counts["sensor_self_hits"] > 0
    assert frame.counts["sensor_rays"] == 128 * 1800
    assert frame.counts["reference_rays"] == 48 * 64


def test_points_of_all_sensors_are_merged():
    grille, roof = Rig.load("front_grille_128").sensors[0], Rig.load("front_roof_128").sensors[0]
    merged = frames(rig=Rig(name="both", sensors=(grille, roof)))[0]
    first, second = frames(rig="front_grille_128")[0], frames(rig="front_roof_128")[0]
    assert torch.equal(merged.sensor, torch.cat([first.sensor, second.sensor]))
    assert merged.counts["sensor_rays"] == 2 * 128 * 1800


@pytest.mark.parametrize("index", [-7, 6, 100])
def test_indices_out_of_range_raise_index_errors(index):
    with pytest.raises(IndexError, match=f"frame {index} of 6"):
        frames()[index]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_frames": 0}, "num_frames: a number from 1 to 1,000,000,000 is needed; got 0"),
        ({"seed": -1}, "seed: .* got -1"),
    ],
)
def test_impossible_requests_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        frames(**changes)


def scenario(ego_z=0.0, wall_x=50.0):
    return Scenario.model_validate(
        {
            "name": "s",
            "ego": {"shape": {"type": "box", "size_m": [4, 2, 1.5]}, "pose": {"z_m": ego_z}},
            "bodies": [
                {"name": "ground", "shape": {"type": "plane", "size_m": [200, 200]}},
                {"name": "wall", "shape": {"type": "box", "size_m": [4, 4, 4]}, "poses": [{"x_m": wall_x}]},
            ],
        }
    )


def lidar(**changes):
    content = {
        "name": "top",
        "mount": {"z_m": 1.8},
        "channels": 16,
        "vertical_fov_deg": (-30, 0),
        "horizontal_fov_deg": 360,
        "columns": 180,
        "max_range_m": 80,
    }
    return Rig.model_validate({"name": "r", "sensors": [{**content, **changes}]})


def test_rigs_share_scene_and_reference_points():
    names = ("front_grille_128", "front_roof_128")
    both = SimulatedFrames(
        "courtyard", rigs={name: name for name in names}, num_frames=2, seed=3, reference_sensor=SMALL
    )[1]
    for name in names:
        alone = frames(rig=name)[1]
        assert torch.equal(both.clouds[name], alone.sensor)
        assert torch.equal(both.reference, alone.reference)
    with pytest.raises(ValueError, match=r"clouds of 2 rigs \(front_grille_128, front_roof_128\): name one"):
        _ = both.sensor


@pytest.mark.parametrize("keys", [{}, {"rig": "front_roof_128", "rigs": {"a": "front_roof_128"}}])
def test_one_rig_or_several_are_needed(keys):
    with pytest.raises(ValueError, match="one rig is needed, or several"):
        SimulatedFrames("courtyard", num_frames=1, **keys)


def test_range_noise_is_along_the_ray():
    exact = SimulatedFrames(scenario(), lidar(), num_frames=1, reference_sensor=SMALL)[0].sensor
    frame = SimulatedFrames(scenario(), lidar(range_noise_m=0.05), num_frames=1, reference_sensor=SMALL)[0]
    assert torch.equal(frame.sensor, exact)
    exact, noisy = exact.double(), frame.get_measured_points().double()
    origin = torch.tensor([0.0, 0.0, 1.8]).double()
    ray = (exact - origin) / (exact - origin).norm(dim=1, keepdim=True)
    along = ((noisy - exact) * ray).sum(dim=1)
    assert ((noisy - exact) - along[:, None] * ray).abs().max() < 1e-5
    torch.testing.assert_close(frame.measurements["r"].error_m.double(), along, rtol=0, atol=1e-5)
    assert along.std() == pytest.approx(0.05, rel=0.06)
    assert abs(along.mean()) < 4 * 0.05 / len(along) ** 0.5


def test_dropout_removes_its_share_of_points():
    exact = SimulatedFrames(scenario(), lidar(), num_frames=2, reference_sensor=SMALL)
    thinned = SimulatedFrames(scenario(), lidar(dropout=0.3), num_frames=2, reference_sensor=SMALL)
    count, remaining_count = len(exact[0].sensor), len(thinned[0].sensor)
    assert abs(remaining_count / count - 0.7) < 4 * (0.21 / count) ** 0.5
    assert set(map(tuple, thinned[0].sensor.tolist())) <= set(map(tuple, exact[0].sensor.tolist()))
    assert not torch.equal(thinned[0].sensor[:50], thinned[1].sensor[:50])


def test_occupied_reference_poses_are_resampled_and_counted():
    close = SimulatedFrames(scenario(wall_x=4.05), lidar(), num_frames=40, reference_sensor=SMALL)
    wide = SimulatedFrames(scenario(wall_x=50.0), lidar(), num_frames=40, reference_sensor=SMALL)
    assert sum(close[index].counts["reference_poses_resampled"] for index in range(40)) > 0
    assert sum(wide[index].counts["reference_poses_resampled"] for index in range(40)) == 0
    for index in range(40):
        points = close[index].reference
        inside = ((points - torch.tensor([4.05, 0.0, 2.0])).abs() < 1.99).all(dim=1)
        assert not inside.any()


@pytest.mark.parametrize("name", ["urban", "highway", "parking"])
def test_traffic_is_reproducible_in_any_order(name):
    short = Scenario.model_validate({"name": name, "traffic": {"type": name, "duration_s": 1.0, "time_step_s": 0.5}})
    made = SimulatedFrames(short, lidar(), num_frames=5, seed=1, reference_sensor=SMALL)
    in_order = [made[index] for index in range(5)]
    repeated = SimulatedFrames(short, lidar(), num_frames=5, seed=1, reference_sensor=SMALL)
    assert all(same(in_order[index], repeated[index]) for index in (4, 2, 3, 0))
    assert not torch.equal(in_order[0].sensor, in_order[3].sensor)
    other_seed_frame = SimulatedFrames(short, lidar(), num_frames=1, seed=2, reference_sensor=SMALL)[0]
    assert not torch.equal(in_order[0].sensor, other_seed_frame.sensor)


def test_longer_frame_intervals_show_later_time_steps():
    small_reference = PaperReference(rows=2, columns=2)
    each = SimulatedFrames("parking", "front_roof_32", num_frames=1301, seed=1, reference_sensor=small_reference)
    spread = SimulatedFrames(
        "parking", "front_roof_32", num_frames=3, seed=1, reference_sensor=small_reference, frame_interval_s=65.0
    )
    assert (each.frame_interval_s, spread.frame_interval_s) == (0.1, 65.0)
    for index in range(3):  # the last frame is in another scene
        assert torch.equal(spread[index].sensor, each[650 * index].sensor)


@pytest.mark.parametrize("frame_interval_s", [0.0, -0.1, 0.05, 0.15, float("nan"), float("inf")])
def test_frame_intervals_are_multiples_of_time_steps(frame_interval_s):
    with pytest.raises(
        ValueError, match=r"frame_interval_s: a positive multiple of the time step of .urban., 0.1 s, is needed"
    ):
        SimulatedFrames("urban", "front_roof_32", num_frames=1, frame_interval_s=frame_interval_s)
