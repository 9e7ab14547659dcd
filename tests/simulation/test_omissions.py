"""Omitted work: unneeded casts are omitted and counted, and do not change a frame."""

import numpy as np
import pytest

from torchcover.simulation import PaperReference, Rig, Scenario, Simulator
from torchcover.simulation.scene_geometry import SceneGeometry


def rig(max_range_m=60.0, **keys):
    lidar = {"name": "a", "mount": {"z_m": 1.8}, "channels": 16, "vertical_fov_deg": [-40, 5], "columns": 90}
    return Rig.model_validate(
        {"name": "r", "sensors": [{**lidar, "horizontal_fov_deg": 360, "max_range_m": max_range_m, **keys}]}
    )


def simulator(scenario, keys=None, max_range_m=60.0):
    reference = PaperReference(rows=24, columns=32, max_range_m=max_range_m)
    return Simulator(Scenario.load(scenario), {"r": rig(max_range_m, **(keys or {}))}, reference, seed=1)


def has_same_points(a, b):
    return np.array_equal(a.clouds["r"], b.clouds["r"]) and np.array_equal(a.reference, b.reference)


def test_counts_report_omitted_work_in_traffic():
    near_counts, far_counts = (
        simulator("urban", max_range_m=metres).simulate_frame(5).counts for metres in (30.0, 200.0)
    )
    assert near_counts["moving_bodies"] == far_counts["moving_bodies"]
    assert near_counts["moving_bodies_out_of_range"] > far_counts["moving_bodies_out_of_range"]
    for counts in (near_counts, far_counts):
        in_range = counts["moving_bodies"] - counts["moving_bodies_out_of_range"]
        assert in_range >= 1
        assert counts["ray_body_pairs"] == in_range * (counts["sensor_rays"] + counts["reference_rays"])
        assert 0.8 < counts["ray_body_pairs_omitted"] / counts["ray_body_pairs"] < 1
        assert counts["sensor_rays_reused"] == 0
        assert counts["sensor_self_hits_reused"] == counts["sensor_self_hits"] > 0


def test_counts_report_reused_work_without_motion():
    counts = simulator("courtyard").simulate_frame(5).counts
    assert counts["sensor_rays_reused"] == counts["sensor_rays"] == 16 * 90
    assert counts["sensor_self_hits_reused"] == counts["sensor_self_hits"] > 0
    assert counts["moving_bodies"] == counts["ray_body_pairs"] == counts["ray_body_pairs_omitted"] == 0


@pytest.mark.parametrize("keys", [{}, {"range_noise_m": 0.05, "dropout": 0.2}])
def test_reused_scans_equal_new_scans(keys):
    used = simulator("courtyard", keys)
    for index in (4, 2, 3):
        reused, fresh = used.simulate_frame(index), simulator("courtyard", keys).simulate_frame(index)
        assert has_same_points(reused, fresh)
        assert reused.counts == fresh.counts
    assert np.array_equal(used.simulate_frame(2).clouds["r"], used.simulate_frame(3).clouds["r"]) == (not keys)


def test_changing_a_frame_does_not_affect_the_next():
    used = simulator("courtyard")
    first = used.simulate_frame(0).clouds["r"]
    copy_ = first.copy()
    first[:] = 0.0
    np.testing.assert_array_equal(used.simulate_frame(1).clouds["r"], copy_)


def test_bodies_out_of_range_change_nothing(monkeypatch):
    limited = simulator("urban", max_range_m=40.0).simulate_frame(7)
    original = SceneGeometry.get_snapshot
    monkeypatch.setattr(SceneGeometry, "get_snapshot", lambda self, step, max_distance_m: original(self, step, np.inf))
    everywhere = simulator("urban", max_range_m=40.0)
    unlimited = everywhere.simulate_frame(7)
    scene, step = everywhere.get_scene_geometry(7)
    time_s = np.array([step * scene.scene.time_step_s])
    moves = [
        actor.trajectory for actor in scene.scene.actors if actor.trajectory.is_moving or actor.trajectory.is_transient
    ]
    absent = sum(not np.isfinite(trajectory.interpolate_positions_m(time_s)).all() for trajectory in moves)
    assert unlimited.counts["moving_bodies_out_of_range"] == absent < limited.counts["moving_bodies_out_of_range"]
    assert has_same_points(limited, unlimited)


def test_ranges_start_at_the_sensor(tmp_path):
    """32 m ahead of the vehicle, 29 m ahead of a LiDAR with a range of 30 m."""
    (tmp_path / "t.csv").write_text("t,x,y,z,roll,pitch,yaw\n0,34,0,0,0,0,0\n9,34,9,0,0,0,0\n", encoding="utf-8")
    box = {"type": "box", "size_m": [4, 2, 2]}
    mover = {"name": "mover", "category": "car", "shape": box, "trajectory": tmp_path / "t.csv"}
    ground = {"name": "ground", "shape": {"type": "plane", "size_m": [100, 100]}}
    scenario = Scenario.model_validate({"name": "s", "ego": {"shape": box}, "bodies": [ground], "actors": [mover]})
    reference = PaperReference(rows=8, columns=8, max_range_m=30.0)
    lidar = rig(30.0, mount={"x_m": 3.0, "z_m": 1.0}, vertical_fov_deg=[-1, 1], columns=720)
    observation = Simulator(scenario, {"r": lidar}, reference).simulate_frame(0)
    assert observation.clouds["r"][:, 0].max() == pytest.approx(32.0, abs=1e-3)
