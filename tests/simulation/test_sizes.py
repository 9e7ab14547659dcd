"""Memory limits: demands that do not fit are refused early, with their size."""

import pytest

from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation import (
    CameraSensor,
    Lidar,
    PaperReference,
    Pose,
    Rig,
    Scenario,
    Simulator,
    SurfaceReference,
    memory,
)
from torchcover.simulation.memory import check_memory_fits, find_memory_limit_bytes
from torchcover.simulation.scene import Actor, Scene, count_time_steps
from torchcover.simulation.scene_geometry import SceneGeometry
from torchcover.simulation.shapes import Box
from torchcover.simulation.traffic import HighwayTraffic, UrbanTraffic

SPACED = {"vertical_fov_deg": (-10, 10), "horizontal_fov_deg": 360, "max_range_m": 50}
AREAS = (((0.0, 20.0), (-5.0, 5.0)),)


@pytest.fixture
def small(monkeypatch):
    """Simulate a machine with 100 MB."""
    monkeypatch.setattr(memory, "find_memory_limit_bytes", lambda: 1e8)


def test_demands_beyond_the_memory_are_refused(small):
    assert 1e8 < find_memory_limit_bytes() < 1e15
    check_memory_fits("a scan", 1e8, "take less")
    with pytest.raises(ValueError, match=r"a scan: 0.2 GB of memory .*, and this machine has 0.1 GB; take less"):
        check_memory_fits("a scan", 2e8, "take less")


def test_container_memory_limits_apply(tmp_path, monkeypatch):
    (tmp_path / "memory.max").write_text("5000000\n")
    (tmp_path / "none").write_text("max\n")
    monkeypatch.setattr(memory, "CGROUP_LIMITS", (tmp_path / "missing", tmp_path / "none", tmp_path / "memory.max"))
    find_memory_limit_bytes.cache_clear()
    try:
        assert find_memory_limit_bytes() == 5e6
    finally:
        find_memory_limit_bytes.cache_clear()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Lidar(name="a", channels=10**9, columns=9, **SPACED), "channels: a number of at most 100000"),
        (lambda: Lidar(name="a", channels=9, columns=10**9, **SPACED), "columns: a number of at most 1000000"),
        (
            lambda: CameraSensor(name="a", width=10**9, height=9, fov_deg=90, max_range_m=9),
            "width: a number of at most 200000",
        ),
        (lambda: Pose(x_m=1e300), "x_m: a number of at most 1000000000"),
        (lambda: UrbanTraffic(people_per_km=1e6), "people_per_km: a number of at most 1000"),
        (lambda: HighwayTraffic(duration_s=1e9), "duration_s: a number of at most 3600"),
        (lambda: count_time_steps(1e9, 0.1), r"1e\+10 time steps of 0.1 s, over 1,000,000; shorten it"),
        (lambda: count_time_steps(1.0, 1e-320), "inf time steps"),
    ],
)
def test_numbers_beyond_their_limits_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("stride", [16, 40])
def test_a_single_camera_column_spans_one_pixel(stride):
    camera = CameraSensor(name="c", width=16, height=8, fov_deg=90, stride=stride, max_range_m=9)
    ahead = CameraSensor(name="c", width=16, height=8, fov_deg=90, max_range_m=9).horizontal_fov_deg
    assert 0 < camera.horizontal_fov_deg < ahead / 10


def test_too_many_rays_are_refused_early(small):
    lidar = Lidar(name="a", channels=1000, columns=1000, **SPACED)
    scenario, rigs = Scenario.load("courtyard"), {"r": Rig(name="r", sensors=(lidar,))}
    message = r"1,000,012 rays per frame \(1,000,000 of the rig's .*, 12 of the reference\)"
    with pytest.raises(ValueError, match=message):
        Simulator(scenario, rigs, PaperReference(rows=3, columns=4))
    fits = Simulator(scenario, {}, PaperReference(rows=3, columns=4))
    with pytest.raises(ValueError, match=r"1,000,000 of the reference\): 0.3 GB"):
        fits.replace_reference_sensor(SurfaceReference(AREAS, num_rays=1_000_000))


def test_too_many_time_steps_are_refused(small):
    mesh = Box(type="box", size_m=(4, 2, 1)).build_mesh()
    ego = Actor("ego", "ego", mesh, Trajectory.create_static((0, 0, 0)))
    cars = tuple(Actor(f"car {k}", "car", mesh, Trajectory.create_static((9.0 * k, 9, 0))) for k in range(3))
    with pytest.raises(ValueError, match=r"500,001 time steps of 4 bodies: 0.192 GB of memory are needed"):
        SceneGeometry(Scene((), ego, cars, time_step_s=0.1, duration_s=50_000.0))


@pytest.mark.parametrize(
    "traffic", [UrbanTraffic(duration_s=600.0, traffic_per_km=100), HighwayTraffic(duration_s=3600.0)]
)
def test_too_much_traffic_is_refused_early(small, traffic):
    with pytest.raises(ValueError, match=r"traffic of about [\d,]+ for [\d,]+ time steps: .* shorten the duration"):
        traffic.build_scene(0)


def test_later_overlaps_are_found_before_the_run(tmp_path):
    rows = [f"{t},{20 - 2 * t},0,0,0,0,0" for t in range(11)]
    (tmp_path / "a.csv").write_text("\n".join(["t,x,y,z,roll,pitch,yaw", *rows]))
    box = {"type": "box", "size_m": [4, 2, 1]}
    actor = {"name": "a", "category": "car", "shape": box, "trajectory": str(tmp_path / "a.csv")}
    ground = {"name": "ground", "shape": {"type": "plane", "size_m": [100, 100]}}
    steps = {"time_step_s": 1.0, "duration_s": 10.0}
    scenario = Scenario.model_validate(
        {"name": "s", "ego": {"shape": box}, "bodies": [ground], "actors": [actor]} | steps
    )
    simulator = Simulator(scenario, {}, PaperReference(rows=4, columns=4))
    simulator.check_run(9)
    with pytest.raises(ValueError, match=r"actor 'a' overlaps the ego at t = 9 s"):
        simulator.check_run(10)
    with pytest.raises(ValueError, match=r"at t = 9 s"):
        simulator.simulate_frame(9)
    # 0, 3, 6, and then 9.
    every_third = Simulator(scenario, {}, PaperReference(rows=4, columns=4), frame_interval_s=3.0)
    every_third.check_run(3)
    with pytest.raises(ValueError, match=r"at t = 9 s"):
        every_third.check_run(4)


def test_traffic_has_at_least_two_time_steps():
    assert len(HighwayTraffic(duration_s=1e-320).build_scene(0).ego.trajectory.times_s) == 2
