"""Common frames: those of SimulatedFrames, with the numbers of evaluate, in any number of processes."""

import gc
import os
from copy import copy

import numpy as np
import pytest
import torch

from tests.placement.worlds import BAY, FLOOR, LOT, OBJECTIVES, WALL, create_frames, lidar, rig, yard
from torchcover.evaluation import evaluate
from torchcover.placement import Objective
from torchcover.placement.common_frames import CachedFrames
from torchcover.placement.queries import Queries
from torchcover.simulation import RegionsOfInterest, Scenario, SimulatedFrames, Simulator, SurfaceReference

NOISY = lidar("noisy", range_noise_m=0.03, dropout=0.2, mount={"x_m": 0.5, "z_m": 2.2, "yaw_deg": 40})
RADAR = {
    "type": "radar", "name": "radar", "mount": {"x_m": 2.1, "z_m": 0.6}, "horizontal_fov_deg": 120,
    "vertical_fov_deg": [-20, 20], "azimuth_cell_deg": 6, "range_cell_m": 0.4, "max_range_m": 40, "dropout": 0.1,
}  # fmt: skip
TWO = rig(lidar(), NOISY, RADAR, name="two")


def same(a, b):
    """Two scores, to the last bit."""
    for name in ("value", "jackknife_values", "frame_counts"):
        np.testing.assert_array_equal(getattr(a.estimate, name), getattr(b.estimate, name))
    assert a.self_hit_share == b.self_hit_share


@pytest.mark.parametrize("scenario", [LOT, yard(WALL)])
def test_other_rigs_score_as_in_own_frames(scenario):
    frames = SimulatedFrames(scenario, TWO, num_frames=8, frame_interval_s=0.4, seed=3)
    other = Simulator(
        scenario, {"first": rig()}, SurfaceReference((((0, 9), (-3, 3)),), num_rays=64), seed=3, frame_interval_s=0.4
    )
    candidate = other.replace_rigs({"candidate": TWO})
    for index in (4, 0, 3, 0):
        scans = candidate.simulate_scans(index)["candidate"]
        np.testing.assert_array_equal(np.concatenate([scan.points for scan in scans]), frames[index].sensor.numpy())
    # And who was there first sees no more and no less for it.
    alone = SimulatedFrames(scenario, rig(), num_frames=8, frame_interval_s=0.4, seed=3)
    np.testing.assert_array_equal(other.simulate_frame(3).clouds["first"], alone[3].sensor.numpy())


def test_ideal_sensors_have_a_point_for_every_hit():
    short = rig(lidar(range_at_10_percent_m=5.0))
    ideal, real = create_frames(num_scenes=1, sensor_model="ideal"), create_frames(num_scenes=1)
    points = [[len(frame.sensor) for frame in of.iterate_frames(short)] for of in (ideal, real)]
    assert points[0] == [len(frame.sensor) for frame in real.iterate_frames(rig(name=short.name))]
    assert points[1][0] < points[0][0]
    assert ideal.resample(1, 1, {}).sensor_model == "ideal"


def test_omitted_rays_change_no_objective(monkeypatch):
    near = {"near": Objective(threshold_m=0.2, band="ground", region={"ahead": {"x_m": (3, 8), "y_m": (-2, 2)}})}
    some = create_frames(objectives=near, num_scenes=1, num_rays=200)
    monkeypatch.setattr(Queries, "search_radius_m", None)
    every = create_frames(objectives=near, num_scenes=1, num_rays=200)
    same(every.score(TWO), some.score(TWO))
    assert len(next(some.iterate_frames(TWO)).sensor) < 0.7 * len(next(every.iterate_frames(TWO)).sensor)


def test_numbers_equal_evaluate_to_the_last_bit():
    """By area and over known cells, in regions of several objectives, from frames that nobody has cut."""
    held_by = {
        measure: create_frames(num_scenes=4, frames_per_scene=2, average=measure) for measure in ("area", "cells")
    }
    found = held_by["area"]
    frames = SimulatedFrames(
        found._host_scenarios[0],
        TWO,
        num_frames=max(index.frame_index for index in found.indices) + 1,
        frame_interval_s=0.4,
        reference_sensor=found.queries.build_reference_sensor(1024),
    )
    steps = [index.frame_index for index in found.indices]
    assert len(steps) == 8

    class InOrder(SimulatedFrames):
        """The frames of the search."""

        def __getitem__(self, index):
            return frames[steps[index]]

    in_order = copy(frames)
    in_order.__class__, in_order.num_frames = InOrder, len(steps)
    regions = {"20m": {"x_m": (0.0, 20.0), "y_m": (-5.0, 5.0)}, "80m": {"x_m": (0.0, 80.0), "y_m": (-20.0, 20.0)}}
    ask = RegionsOfInterest.model_validate({"regions": {**regions, **BAY}})
    result = evaluate(frames=in_order, regions=ask, cell_m=0.5, thresholds_m=(0.2, 0.3))
    for measure, frames_of in held_by.items():
        own = frames_of.score(TWO).estimate
        for column, objective in enumerate(OBJECTIVES.values()):
            rows = {(row.region, row.band): row for row in result.coverage.summary()}
            numbers = [
                (rows[place].numbers if measure == "area" else rows[place].cell_averages)[objective.key]
                for place in objective.region_bands
            ]
            values = torch.tensor([number.value for number in numbers], dtype=torch.float64)
            assert own.value[column] == values.mean()


@pytest.mark.parametrize("workers", [1, 2])
def test_it_makes_no_difference_who_holds_the_worlds(frames, workers):
    with create_frames(num_workers=workers) as elsewhere:
        same(elsewhere.score(TWO), frames.score(TWO))
        assert all(
            seen.frame is None for seen in elsewhere._compute(TWO, [0, 3], is_measured=True)
        )  # clouds stay where they are
        same(elsewhere.score(rig()), frames.score(rig()))
        for held_by in (elsewhere, frames):
            with pytest.raises(ValueError, match="inside the ego of 'lot'"):
                held_by.score(rig(lidar(mount={"z_m": 1.0})))
        same(elsewhere.score(TWO), frames.score(TWO))  # nothing is left over of the error


def test_scene_stays_with_the_process_that_built_it(monkeypatch, tmp_path):
    """The k-th batch of a DataLoader is for its k-th worker."""
    built = CachedFrames._build_reference

    def noted(self, index, number):
        (tmp_path / f"{index.scene_id} {number} {os.getpid()}").touch()
        return built(self, index, number)

    monkeypatch.setattr(CachedFrames, "_build_reference", noted)
    with create_frames(num_workers=2, num_scenes=4) as elsewhere:
        for _ in range(2):
            elsewhere.score(rig())
        elsewhere.score(TWO)
    world, number, process = zip(*(path.name.split() for path in tmp_path.iterdir()), strict=True)
    assert sorted(map(int, number)) == list(range(8))
    of_worlds = dict(zip(world, process, strict=True))
    assert set(zip(world, process, strict=True)) == set(of_worlds.items())
    assert sorted(map(list(of_worlds.values()).count, set(process))) == [2, 2]


def test_the_order_of_rigs_makes_no_difference(frames):
    whole = frames.score(TWO)
    other = frames.score(rig())
    same(frames.score(TWO), whole)
    assert not torch.equal(other.estimate.value, whole.estimate.value)
    share = whole.self_hit_share
    counts = [frame.counts for frame in frames.iterate_frames(TWO)]
    assert share == sum(one["self_hits"] for one in counts) / sum(one["rays"] for one in counts)


def test_unobserved_scenes_do_not_contribute():
    obstacles = {"ahead": Objective(region="20m", band="obstacle"), "ground": Objective(region="20m", band="ground")}
    scenarios = [yard(WALL), yard(name="empty"), LOT]
    found = create_frames(scenarios, obstacles, num_scenes=1, frames_per_scene=1)
    assert [index.scene_id for index in found.indices] == [0, 1, 2]
    estimate = found.score(rig()).estimate
    assert torch.isfinite(estimate.jackknife_values).all()
    assert estimate.jackknife_values[1, 0] == estimate.value[0]  # the empty one has no obstacle
    nothing = create_frames([yard()], obstacles).score(rig()).estimate.value
    assert torch.isnan(nothing).tolist() == [True, False]


def test_a_world_without_traffic_shows_each_instant_once():
    found = create_frames([yard(WALL)], frames_per_scene=4)
    assert [index.scene_id for index in found.indices] == [0] * 4
    assert (
        len({float(frame.reference_weights.sum()) for frame in found.iterate_frames()}) == 4
    )  # draws of the reference


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scenarios": []}, "scenarios: got none"),
        ({"objectives": {}}, "objectives: got none"),
        ({"num_scenes": 0}, "num_scenes: got 0; give at least 1"),
        ({"frames_per_scene": 4}, "frames_per_scene: got 4, but a run of 'lot' has 3 frames at intervals of 0.4 s"),
        ({"frame_interval_s": 0.3}, "frame_interval_s: a positive multiple"),
        ({"num_workers": -1}, "num_workers: got -1; give 0 or more"),
        ({"seed": -1}, "seed: a number >= 0"),
        ({"budget_bytes": 1000.0}, "budget_bytes: 3 scenes need .* enough for 0; use fewer scenes"),
        ({"budget_bytes": 1000.0, "num_workers": 1}, "budget_bytes: 3 scenes"),
        ({"scenarios": [LOT, "courtyard"]}, "the ego vehicles differ"),
        ({"objectives": {"a": Objective(region="21m")}}, "objective 'a': region '21m': give one of 20m, 80m"),
        ({"objectives": {"a": Objective(region="20m", band="sky")}}, "objective 'a': band 'sky': give 'ground' or"),
        ({"objectives": {"a": Objective(region="20m", band=())}}, "objective 'a': band: got none"),
        (
            {"objectives": {"a": Objective(region="20m"), "b": Objective(region={"20m": BAY["bay"]})}},
            "objective 'b': region '20m': two objectives define it differently",
        ),
    ],
)  # fmt: skip
def test_invalid_settings_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        create_frames(**change)


def test_rigs_that_cannot_be(frames):
    with pytest.raises(ValueError, match="below the ground"):
        frames.score(rig(lidar(mount={"x_m": 3.0, "z_m": -1.0})))


def test_rig_of_another_vehicle_needs_explicit_vehicle():
    open_lot = Scenario.model_validate({"name": "open", "bodies": [FLOOR], "ego": {"pose": {}}})
    near = {"near": Objective(region="20m", band="ground")}
    roof = rig(vehicle="renault_zoe")
    with pytest.raises(ValueError, match="its vehicle is renault_zoe, and that of these frames suv; set vehicle="):
        create_frames([open_lot], near).score(roof)
    assert len(create_frames([open_lot], near, vehicle="renault_zoe").score(roof).estimate.value) == 1


def test_killed_worker_is_reported_and_ends_the_search():
    frames = create_frames(num_workers=9, num_scenes=2, frames_per_scene=1)
    killed, other = frames._loader._iterator._workers

    def ask():
        killed.kill()
        killed.join()
        frames.score(rig())

    with pytest.raises((ChildProcessError, RuntimeError), match=r"was killed|is killed by signal"):  # at any time
        ask()
    frames.close()
    gc.collect()  # the error knows of what it was raised from
    other.join(20)
    assert other.exitcode == 0


def test_threads_make_no_difference(frames):
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1 if before > 1 else 2)
        other = frames.score(TWO)
    finally:
        torch.set_num_threads(before)
    same(other, frames.score(TWO))


def test_recording_is_one_scene_without_held_out_scenes():
    with create_frames(
        ["tracks_table"], {"near": Objective(region="20m", band="ground")}, num_scenes=3, frame_interval_s=0.5
    ) as recorded:
        assert [index.scene_id for index in recorded.indices] == [0, 0]
        with pytest.raises(ValueError, match="scenarios: 'tracks_table' is the same for any seed"):
            recorded.resample(9, 3, {})
