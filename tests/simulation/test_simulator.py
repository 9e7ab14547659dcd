"""Simulator: frames without tensors, and the ego vehicle before a scene is built."""

import pickle

import numpy as np
import pytest

from torchcover.data import SimulatedFrames
from torchcover.geometry import BoundingBox
from torchcover.simulation import PaperReference, Rig, Scenario, Simulator, SurfaceReference, list_builtin_names

SMALL = PaperReference(rows=24, columns=32)
SURFACE = SurfaceReference((((0.0, 20.0), (-5.0, 5.0)),), num_rays=256)
SHORT = {"name": "urban", "traffic": {"type": "urban", "duration_s": 2.0, "time_step_s": 0.5}}


def simulator(reference_sensor=SMALL, scenario=None, **options):
    rigs = {name: Rig.load(name) for name in ("front_roof_32", "front_grille_128")}
    return Simulator(scenario or Scenario.load("courtyard"), rigs, reference_sensor, **options)


def same(a, b):
    return (
        all(np.array_equal(a.clouds[name], b.clouds[name]) for name in a.clouds | b.clouds)
        and np.array_equal(a.reference, b.reference)
        and a.counts == b.counts
    )


@pytest.mark.parametrize("reference_sensor", [SMALL, SURFACE])
def test_frames_are_observations_as_tensors(reference_sensor):
    observation = simulator(reference_sensor, seed=5).simulate_frame(2)
    rigs = {name: name for name in observation.clouds}
    frame = SimulatedFrames("courtyard", rigs=rigs, num_frames=3, seed=5, reference_sensor=reference_sensor)[2]
    assert list(frame.clouds) == list(observation.clouds)
    for name, points in observation.clouds.items():
        assert points.dtype == np.float32
        np.testing.assert_array_equal(frame.clouds[name].numpy(), points)
    np.testing.assert_array_equal(frame.reference.numpy(), observation.reference)
    assert frame.counts == observation.counts
    if observation.reference_weights is None:
        assert frame.reference_weights is None
    else:
        np.testing.assert_array_equal(frame.reference_weights.numpy(), observation.reference_weights)


def test_observations_depend_on_seed_and_index_only():
    made = simulator(scenario=Scenario.model_validate(SHORT), seed=1)
    late = made.simulate_frame(6)
    assert made.simulate_frame(0).counts["moving_bodies"] > 0
    assert same(made.simulate_frame(6), late)
    assert same(pickle.loads(pickle.dumps(made)).simulate_frame(6), late)
    assert not same(simulator(scenario=made.scenario, seed=2).simulate_frame(6), late)


def test_replacing_the_reference_sensor_keeps_the_scene():
    base = simulator(frame_interval_s=0.5)
    replaced = base.replace_reference_sensor(SURFACE)
    assert replaced.get_scene_geometry(3)[0] is base.get_scene_geometry(3)[0]
    assert (base.reference_sensor, replaced.reference_sensor) == (SMALL, SURFACE)
    assert (base.frame_interval_s, replaced.frame_interval_s) == (0.5, 0.5)
    assert len(replaced.simulate_frame(1).reference_weights) == len(replaced.simulate_frame(1).reference)


def test_labels_are_within_the_reference_range():
    far_simulator = simulator(PaperReference(8, 8, max_range_m=60.0), Scenario.model_validate(SHORT))
    near_simulator = far_simulator.replace_reference_sensor(PaperReference(8, 8, max_range_m=20.0))
    names = [{label.name for label in made.compute_labels(1)} for made in (near_simulator, far_simulator)]
    assert names[0] < names[1]
    assert all(np.hypot(*label.center_m[:2]) < 65.0 for label in far_simulator.compute_labels(1))


def test_without_rigs_only_the_reference_is_simulated():
    observation = Simulator(Scenario.load("courtyard"), {}, SMALL).simulate_frame(0)
    assert observation.clouds == {}
    np.testing.assert_array_equal(observation.reference, simulator().simulate_frame(0).reference)


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda: simulator(seed=-1), "seed: a number >= 0 is needed; got -1"),
        (lambda: simulator(frame_interval_s=0.03), "frame_interval_s: a positive multiple"),
        (lambda: simulator().simulate_frame(-1), "index: a number >= 0 is needed; got -1"),
        (lambda: simulator().compute_labels(-2), "index: a number >= 0 is needed; got -2"),
    ],
)
def test_impossible_requests_are_refused(ask, message):
    with pytest.raises(ValueError, match=message):
        ask()


@pytest.mark.parametrize("name", list_builtin_names("scenarios"))
def test_ego_boxes_of_scenario_and_scene_agree(name):
    scenario = Scenario.load(name)
    if hasattr(scenario.traffic, "duration_s"):
        scenario = scenario.model_copy(update={"traffic": scenario.traffic.model_copy(update={"duration_s": 1.0})})
    ego = scenario.build_scene(seed=3, run_index=1).ego.mesh
    np.testing.assert_array_equal(scenario.build_ego_mesh().vertices_m, ego.vertices_m)
    assert scenario.compute_ego_box() == BoundingBox.from_points(ego.vertices_m)
