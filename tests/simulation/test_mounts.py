"""Mounting positions are above the ground and outside of bodies in every frame."""

import warnings

import numpy as np
import pytest

from torchcover.simulation import Lidar, PaperReference, Pose, Rig, Scenario, Simulator
from torchcover.simulation.rig import set_ego
from torchcover.simulation.scene_geometry import SceneGeometry

EGO = {"shape": {"type": "box", "size_m": [4, 2, 1]}}
GROUND = {"name": "ground", "shape": {"type": "plane", "size_m": [400, 400]}}
# 5 m ahead of the start position, above the roof of the ego.
BAR = {"name": "bar", "shape": {"type": "box", "size_m": [1, 8, 1]}, "poses": [{"x_m": 5.0, "z_m": 1.5}]}


def build_simulator(tmp_path, mount, *, speed_mps=0.0, bodies=(), actors=()):
    """Simulate a sensor `top` of the rig `mine`; with a speed, the ego drives along x for five seconds."""
    ego, steps = EGO, {}
    if speed_mps:
        rows = [f"{t},{speed_mps * t},0,0,0,0,0" for t in range(6)]
        (tmp_path / "ego.csv").write_text("\n".join(["t,x,y,z,roll,pitch,yaw", *rows]))
        ego, steps = {**EGO, "trajectory": str(tmp_path / "ego.csv")}, {"time_step_s": 1.0, "duration_s": 5.0}
    scenario = Scenario.model_validate({"name": "s", "ego": ego, "bodies": [GROUND, *bodies], "actors": actors} | steps)
    pattern = {"channels": 4, "vertical_fov_deg": (-30, 10), "horizontal_fov_deg": 360, "columns": 12}
    lidar = Lidar(name="top", mount=Pose(**mount), max_range_m=60, **pattern)
    return Simulator(scenario, {"mine": Rig(name="mine", sensors=(lidar,))}, PaperReference(rows=4, columns=4))


@pytest.mark.parametrize("speed_mps", [0.0, 2.0])
@pytest.mark.parametrize("mount", [{"z_m": -1.73}, {"x_m": 3.0, "z_m": -0.01}])
def test_sensors_below_the_ground_are_refused(tmp_path, mount, speed_mps):
    with pytest.raises(ValueError, match=r"rig 'mine': sensor 'top' at .* lies below the ground, or inside a wall"):
        build_simulator(tmp_path, mount, speed_mps=speed_mps).simulate_frame(0)


def test_distant_mounts_suggest_wrong_units(tmp_path):
    # The ego box ends 2 m ahead and 1 m up: 20 m from its upper front edge on either axis.
    assert len(build_simulator(tmp_path, {"x_m": 2.0, "z_m": 20.9}).simulate_frame(0).clouds["mine"]) > 0
    with pytest.raises(ValueError, match=r"'top' at .* lies 1799 m away from the ego .*in meters.* millimeters\?"):
        build_simulator(tmp_path, {"z_m": 1800.0}).simulate_frame(0)
    with pytest.raises(ValueError, match=r"'top' at .* lies 20 m away from the ego"):
        build_simulator(tmp_path, {"x_m": -22.1, "z_m": 0.5}).simulate_frame(0)


def test_only_foreign_vehicles_suggest_the_vehicle_option():
    kitti = Rig.load("kitti")
    low = kitti.sensors[0].model_copy(update={"mount": Pose(z_m=0.8)})
    low = kitti.model_copy(update={"sensors": (low,)})
    for vehicle, message in (
        (None, "move its mount$"),
        ("suv", r"own vehicle \(--vehicle volkswagen_passat_estate\)$"),
    ):
        scenario = set_ego(Scenario.load("courtyard"), {"kitti": low}, vehicle)
        with pytest.raises(ValueError, match=message):
            Simulator(scenario, {"kitti": low}, PaperReference(rows=4, columns=4)).simulate_frame(0)


def test_sensors_inside_other_bodies_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"'top' at .* inside a wall"):
        build_simulator(tmp_path, {"x_m": 5.0, "z_m": 2.0}, bodies=[BAR]).simulate_frame(0)
    van = {"name": "van", "category": "car", "shape": {"type": "box", "size_m": [5, 2, 3]}, "pose": {"y_m": 4.0}}
    with pytest.raises(ValueError, match=r"'top' at .* or another body"):
        build_simulator(tmp_path, {"y_m": 3.5, "z_m": 2.0}, actors=[van]).simulate_frame(0)


def test_driving_into_a_wall_is_refused_there(tmp_path):
    driving = build_simulator(tmp_path, {"z_m": 2.0}, speed_mps=1.0, bodies=[BAR])
    assert len(driving.simulate_frame(4).clouds["mine"]) > 0
    with pytest.raises(ValueError, match="'top' at"):
        driving.simulate_frame(5)


@pytest.mark.parametrize("speed_mps", [0.0, 2.0])
def test_sensors_exactly_on_the_ground_cause_warnings(tmp_path, speed_mps):
    lying = build_simulator(tmp_path, {"x_m": 3.0, "z_m": 0.0}, speed_mps=speed_mps)
    with pytest.warns(UserWarning, match=r"rig 'mine': sensor 'top' at \[3.0, 0.0, 0.0\] m lies exactly on the ground"):
        lying.simulate_frame(1 if speed_mps else 0)


@pytest.mark.parametrize("speed_mps", [0.0, 2.0])
def test_sensors_may_lie_on_the_ego_surface(tmp_path, speed_mps):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert (
            len(
                build_simulator(tmp_path, {"z_m": 1.0}, speed_mps=speed_mps, bodies=[BAR])
                .simulate_frame(0)
                .clouds["mine"]
            )
            > 0
        )


@pytest.mark.parametrize("moving", [False, True])
def test_the_ego_is_neither_ground_nor_enclosing(tmp_path, moving):
    scene = SceneGeometry(build_simulator(tmp_path, {"z_m": 1.6}, speed_mps=2.0 * moving).scenario.build_scene())
    snapshot = scene.get_snapshot(0)
    assert not snapshot.is_occupied(np.array([0.0, 0.0, 0.5]))
    assert not snapshot.is_on_surface(np.array([0.5, 0.5, 1.0]))
    assert snapshot.is_on_surface(np.array([30.0, 0.5, 0.0]))
