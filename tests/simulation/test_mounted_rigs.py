"""Scene stores: built, cached and shared objects."""

import gc
import weakref
from types import SimpleNamespace

import numpy as np
import pytest

from torchcover.simulation import PaperReference, Rig, Scenario, Simulator, mounted_rigs

# Six frames per run.
SHORT = Scenario.model_validate(
    {
        "name": "lot",
        "ego": {"shape": {"type": "box", "size_m": [4, 2, 1.5]}},
        "traffic": {
            "type": "parking",
            "duration_s": 1.0,
            "time_step_s": 0.2,
            "crossings_per_aisle": 0,
            "parked_share": 0.1,
        },
    }
)
ORDER = np.random.default_rng(0).permutation(24).tolist()


@pytest.fixture
def built(monkeypatch):
    """Record the runs whose scenes were built, in order."""
    run_indices, build_scene = [], Scenario.build_scene

    def counted(self, seed=0, run_index=0, ego_mesh=None):
        run_indices.append(run_index)
        return build_scene(self, seed, run_index, ego_mesh)

    monkeypatch.setattr(Scenario, "build_scene", counted)
    return run_indices


def simulator():
    return Simulator(SHORT, {"roof": Rig.load("front_roof_128")}, PaperReference(8, 8))


def get_ego_positions(made):
    """Get the ego position of each frame, in a shuffled order."""
    scenes = {index: made.get_scene_geometry(index) for index in ORDER}
    return {index: scene.scene.ego.trajectory.positions_m[step] for index, (scene, step) in scenes.items()}


def test_shuffled_frames_build_each_scene_once(built):
    positions_m = get_ego_positions(simulator())
    assert sorted(built) == [0, 1, 2, 3]
    alone = SHORT.build_scene(run_index=1).ego.trajectory.positions_m
    np.testing.assert_array_equal([positions_m[index] for index in range(6, 12)], alone)


@pytest.mark.parametrize(("room_for", "workers"), [(0.5, 1), (2.5, 1), (2.5, 4)])
def test_cached_scenes_stay_within_the_budget(monkeypatch, built, room_for, workers):
    size = simulator().get_scene_geometry(0)[0].num_bytes
    memory_bytes = room_for * size / mounted_rigs.SceneStoreParams().max_memory_share
    monkeypatch.setattr(mounted_rigs, "find_memory_limit_bytes", lambda: memory_bytes)
    monkeypatch.setattr(mounted_rigs, "get_worker_info", lambda: SimpleNamespace(num_workers=workers))
    built.clear()
    made = simulator()
    for run in (0, 1, 0, 2, 0, 1):
        made.get_scene_geometry(6 * run)
    # At most two scenes: scene 2 replaces scene 1, the least recently used.
    assert built == ([0, 1, 2, 1] if room_for / workers > 2 else [0, 1, 0, 2, 0, 1])


def test_dropped_scenes_need_no_garbage_collection():
    made = Simulator(SHORT, {"roof": Rig.load("front_roof_128")}, PaperReference(8, 8), max_cached_bytes=0.0)
    made.simulate_frame(0)
    first = weakref.ref(made.get_scene_geometry(0)[0])
    gc.disable()
    try:
        made.simulate_frame(6)
        assert first() is None
    finally:
        gc.enable()


def test_scenes_share_casters_and_sensors():
    stages = mounted_rigs.MountedRigStore(mounted_rigs.SceneStore(SHORT, seed=0), {"roof": Rig.load("front_roof_128")})
    first, second = stages.get_mounted_rigs(0), stages.get_mounted_rigs(1)
    casters = [set(rigs.scene_geometry.get_snapshot(0).moving_bodies.casters) for rigs in (first, second)]
    assert casters[0] & casters[1]
    assert first.sensors_by_rig is second.sensors_by_rig
