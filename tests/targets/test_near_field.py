"""Targets in the near field: equal to target maps, whatever the budget, the processes and the side."""

import pickle

import numpy as np
import pytest
import torch

from torchcover.coverage import BevGrid
from torchcover.coverage.target_sums import TargetColumn
from torchcover.data import SimulatedFrames
from torchcover.geometry import build_transform
from torchcover.simulation import PaperReference
from torchcover.simulation.regions_of_interest import build_near_field
from torchcover.targets import NearFieldObserver, Raster, Target, measure_target_visibility, near_field, target_frames
from torchcover.targets.near_field import NearFieldTarget

from .scenes import WALL, build_lidar, build_rig, build_scenario, write_trajectory

LEFT, RIGHT = 2, 3
ALL = 10_000
TOP = build_rig(build_lidar(mount={"z_m": 1.4}, vertical_fov_deg=[-30, 5], columns=90, channels=15))
# Next to the vehicle, which is 2 m wide.
BLOCK = {"name": "block", "shape": {"type": "box", "size_m": [40, 4, 2]}, "poses": [{"y_m": 3.2}]}


def simulate_frames(scenario, num_frames=8, rigs=TOP, seed=0):
    return SimulatedFrames(
        scenario, rigs, num_frames=num_frames, seed=seed, reference_sensor=PaperReference(rows=2, columns=2)
    )


def observe_targets(frames, indices=None, body="pole", **budget):
    observer = NearFieldObserver(frames.simulator, [Target.load(body)], num_blocks=8, **({"frame_stride": 1} | budget))
    for index in range(len(frames)) if indices is None else indices:
        observer.update(frames[index])
    return observer


def get_numbers(observer, region, rig="small"):
    bodies = observer.get_target_sums(rig)
    return list(bodies.estimate(bodies.regions[region], bodies.target_names[0]).to_numbers().values())


@pytest.mark.parametrize(("name", "bodies"), [("child", ()), ("pole", (WALL,))], ids=["free space", "a wall"])
def test_near_field_numbers_equal_those_of_target_maps(name, bodies, monkeypatch):
    scenario, target = build_scenario(*bodies), Target.load(name)
    for module in (target_frames, near_field):  # the surface is visible from random viewpoints otherwise
        monkeypatch.setattr(
            module, "sample_reference_pose", lambda *_: build_transform(np.eye(3), np.array([0.3, 0.2, 1.3]))
        )
    found = measure_target_visibility(TOP, scenario, target, Raster.from_vehicle(scenario.compute_ego_box(), 3.0))
    observer = observe_targets(simulate_frames(scenario, num_frames=1), body=name, positions_per_region=ALL)
    x, y = (torch.from_numpy(each) for each in found.raster.positions_m.T)
    for number, region in enumerate(observer.regions):
        cells = region.mask_points(x, y).numpy().reshape(found.raster.shape)
        free = cells & found.free_mask
        visible_m2 = found.visible_m2[free]
        expected = [cells.sum(), free.sum(), found.detected_share[free].sum(), visible_m2.sum()]
        assert observer.compute()[0, 0, number, :-1].tolist() == pytest.approx(expected)
        share = np.nansum(found.surface_share[free] * visible_m2) / visible_m2.sum()
        assert get_numbers(observer, number)[1].value == pytest.approx(share)
    assert 0.1 < get_numbers(observer, LEFT)[0].value < 1


def test_positions_of_a_region_are_sampled_uniformly():
    vehicle = build_scenario().compute_ego_box()
    grid = BevGrid((-6.0, 6.0), (-5.0, 5.0), 1.0)
    pole = NearFieldTarget.from_target(Target.load("pole"), vehicle, build_near_field(vehicle.outline_m), grid)
    generator = np.random.default_rng(0)
    for places, draws in ((1, 1200), (3, 400)):
        counts = np.bincount(
            np.concatenate([pole.sample_positions(places, generator) for _ in range(draws)]),
            minlength=len(pole.region_indices),
        )
        for region in range(4):
            own = counts[pole.region_indices == region]
            assert own.sum() == draws * places
            # Pearson's chi-square divided by its degrees of freedom plus one.
            excess = ((own - own.mean()) ** 2 / own.mean()).sum() / len(own)
            assert excess == pytest.approx(1.0, abs=5 * np.sqrt(2 / len(own)))


def test_symmetric_rig_has_symmetric_results():
    frames = simulate_frames(build_scenario(), num_frames=32)
    every = observe_targets(frames, [0], positions_per_region=ALL)
    assert get_numbers(every, LEFT)[0].value == get_numbers(every, RIGHT)[0].value
    assert 0.1 < get_numbers(every, LEFT)[0].value < 0.9
    some = observe_targets(frames, positions_per_region=3)
    (left, *_), (right, *_) = get_numbers(some, LEFT), get_numbers(some, RIGHT)
    assert 0.01 < left.error < 0.15
    for one in (left, right):
        assert abs(one.value - get_numbers(every, LEFT)[0].value) < 4 * one.error


def test_merged_parts_equal_the_whole(tmp_path):
    path = write_trajectory(tmp_path, (0, 0, 0, 0), (2, 20, 0, 0))
    frames = simulate_frames(
        build_scenario(ego={"shape": {"type": "box", "size_m": [4, 2, 1]}, "trajectory": str(path)}), num_frames=20
    )
    whole, parts = (
        observe_targets(frames, frame_stride=4, positions_per_region=2),
        [observe_targets(frames, part, frame_stride=4, positions_per_region=2) for part in (range(10), range(10, 20))],
    )
    first = pickle.loads(pickle.dumps(parts[0]))  # as between ranks
    first.merge_state(pickle.loads(pickle.dumps(parts[1])))
    assert all(torch.equal(one, first.metric_state[name]) for name, one in whole.metric_state.items())
    assert (int(whole.num_frames), int(whole.compute()[..., TargetColumn.TRIED].sum())) == (5, 5 * 4 * 2)
    again = NearFieldObserver(frames.simulator, [Target.load("pole")], num_blocks=8)
    again.load_state_dict(whole.state_dict())
    assert torch.equal(again.compute(), whole.compute())
    other = NearFieldObserver(frames.simulator, [Target.load("child")], num_blocks=8)
    with pytest.raises(ValueError, match="different targets"):
        other.merge_state(whole)


def test_numbers_are_nan_without_free_positions():
    observer = observe_targets(
        simulate_frames(build_scenario(BLOCK), num_frames=8), body="child", positions_per_region=3
    )
    left, right = observer.get_target_sums("small").summarize()[LEFT:]
    assert (left.num_cells, left.observed_cells, left.visible_m2) == (24, 0, pytest.approx(np.nan, nan_ok=True))
    assert all(np.isnan([one.value, one.error]).all() and one.count == 0 for one in left.numbers.values())
    assert 0 < right.observed_cells == next(iter(right.numbers.values())).count


def test_reused_ray_ends_equal_new_ones(tmp_path, monkeypatch):
    path = write_trajectory(tmp_path, (0, 0, 0, 0), (2, 20, 0, 0))
    ego = {"shape": {"type": "box", "size_m": [4, 2, 1]}, "trajectory": str(path)}
    frames = simulate_frames(build_scenario(WALL, ego=ego), rigs=build_rig(build_lidar(mount={"z_m": 1.1})))
    frame = frames[3]
    observer = NearFieldObserver(frames.simulator, [Target.load("pole")], frame_stride=1)
    kept = observer.compute_sums(frame)
    stage, instant = frames.simulator.prepare_frame(3)
    (mounted,) = stage.sensors_by_rig["small"]
    known = mounted.compute_ray_ends(instant)
    monkeypatch.setattr(mounted, "_last_scan", None)
    anew = mounted.compute_ray_ends(instant)
    assert np.array_equal(known.range_m, anew.range_m)
    assert np.array_equal(known.is_hit, anew.is_hit)
    assert 0 < known.is_hit.sum() < len(known.is_hit)
    assert all(map(torch.equal, kept[1:], observer.compute_sums(frame)[1:]))
