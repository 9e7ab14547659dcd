"""Common instants: the frames of SimulatedFrames, the numbers of CoverageMetric, whoever holds the worlds."""

import numpy as np
import pytest
import torch

from tests.placement.worlds import BAY, FLOOR, LOT, OBJECTIVES, WALL, held, lidar, rig, yard
from torchcover.coverage import CoverageMetric, Region
from torchcover.data import RegionsOfInterest, SimulatedFrames
from torchcover.placement import Objective, paired
from torchcover.simulation import Scenario, Simulator, SurfaceReference

NOISY = lidar("noisy", range_noise_m=0.03, dropout=0.2, mount={"x_m": 0.5, "z_m": 2.2, "yaw_deg": 40})
RADAR = {
    "type": "radar", "name": "radar", "mount": {"x_m": 2.1, "z_m": 0.6}, "horizontal_fov_deg": 120,
    "vertical_fov_deg": [-20, 20], "azimuth_cell_deg": 6, "range_cell_m": 0.4, "max_range_m": 40, "dropout": 0.1,
}  # fmt: skip
TWO = rig(lidar(), NOISY, RADAR, name="two")


def same(a, b):
    for name in ("instants", "world", "seen_m2", "visible_m2", "known_share"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert (a.self_hit_share, a.rays) == (b.self_hit_share, b.rays)


@pytest.mark.parametrize("scenario", [LOT, yard(WALL)])
def test_another_rig_sees_what_it_would_see_in_frames_of_its_own(scenario):
    frames = SimulatedFrames(scenario, TWO, steps=8, every_s=0.4, seed=3)
    other = Simulator(scenario, {"first": rig()}, SurfaceReference((((0, 9), (-3, 3)),), rays=64), seed=3, every_s=0.4)
    candidate = other.with_rigs({"candidate": TWO})
    for index in (4, 0, 3, 0):
        scans = candidate.scans(index)["candidate"]
        np.testing.assert_array_equal(np.concatenate([scan.points for scan in scans]), frames[index].sensor.numpy())
    # And who was there first sees no more and no less for it.
    alone = SimulatedFrames(scenario, rig(), steps=8, every_s=0.4, seed=3)
    np.testing.assert_array_equal(other.step(3).clouds["first"], alone[3].sensor.numpy())


def test_scores_are_those_of_the_coverage_metric(instants):
    scores = instants.score(TWO)
    (site,) = instants.sites
    sensor = site.grid.reference_sensor(site.rays)
    frames = SimulatedFrames(site.scenario, TWO, steps=9, every_s=0.4, reference_sensor=sensor)
    named = {region.name: region for region in RegionsOfInterest().around(frames.ego_outline_m).regions}
    named["bay"] = Region.polygon("bay", [(2.5, -4.0), (9.0, -4.0), (9.0, 5.0)])

    regions = [named["20m"], named["80m"], named["bay"]]

    def expected(steps):
        """(2, objectives): area, known cells."""
        metric = CoverageMetric(site.grid.grid, (0.2, 0.3), regions=regions, square_metres=True)
        for frame in map(frames.__getitem__, steps):
            metric.update(frame.sensor, frame.reference, weights=frame.reference_weights)
        rows = {(row.region, row.height): row for row in metric.compute().summary()}
        return [
            [
                np.mean(
                    [getattr(rows[region, band], measure)[f"detection_{m}m"].value for m, band, region in questions]
                )
                for questions in (objective.questions for objective in OBJECTIVES.values())
            ]
            for measure in ("numbers", "known")
        ]

    for row, instant in enumerate(instants.instants[:3]):
        np.testing.assert_allclose([scores.area[row], scores.known[row]], expected([instant.step]), rtol=0, atol=1e-9)
    steps = [instant.step for instant in instants.instants if instant.world == 1]
    np.testing.assert_allclose(scores.by_world()[1], expected(steps)[0], rtol=0, atol=1e-9)


@pytest.mark.parametrize("workers", [1, 2])
def test_it_makes_no_difference_who_holds_the_worlds(instants, workers):
    with held(workers=workers) as elsewhere:
        same(elsewhere.score(TWO), instants.score(TWO))
        same(elsewhere.score(rig(), [4, 1]), instants.score(rig(), [4, 1]))
        for held_by in (elsewhere, instants):
            with pytest.raises(ValueError, match="inside the ego of 'lot'"):
                held_by.score(rig(lidar(mount={"z_m": 1.0})))
        same(elsewhere.score(TWO), instants.score(TWO))  # nothing is left over of the error


def test_the_order_of_instants_and_of_rigs_makes_no_difference(instants):
    whole = instants.score(TWO)
    shuffled = instants.score(rig(), [5, 0, 3]), instants.score(TWO, [5, 0, 3])
    same(shuffled[1], whole.at([5, 0, 3]))
    assert not np.array_equal(shuffled[0].seen_m2, shuffled[1].seen_m2)
    both = instants.score(TWO, [1, 2]).joined(instants.score(TWO, [0, 5]))
    np.testing.assert_array_equal(both.area, whole.at([1, 2, 0, 5]).area)
    counts = [instants.bits(TWO, [k]).self_hits.sum() for k in (0, 1, 2, 5)]
    assert both.self_hit_share == pytest.approx(sum(counts) / 4 / sum(sensor.rays for sensor in TWO.sensors))


def test_the_bits_of_a_rig_are_those_of_any_of_its_sensors(instants):
    sensors = [
        lidar("a", mount={"x_m": 2.2, "z_m": 0.6}, horizontal_fov_deg=100),
        lidar("b", mount={"y_m": 1.2, "z_m": 0.9, "yaw_deg": 70}, channels=24, horizontal_fov_deg=200),
        lidar("c"),
    ]
    alone = [instants.bits(rig(sensor)) for sensor in sensors]
    same(instants.scores(alone[0] | alone[1] | alone[2]), instants.score(rig(*sensors)))
    assert (instants.scores(alone[0]).seen_m2 < instants.score(rig(*sensors)).seen_m2).any()
    with pytest.raises(ValueError, match="the same instants"):
        alone[0] | instants.bits(rig(), [1])


def test_what_some_worlds_do_not_show_is_unknown_there_for_all():
    obstacles = {"ahead": Objective(region="20m", band="obstacle"), "ground": Objective(region="20m", band="ground")}
    scenarios = [yard(WALL), yard(name="empty"), LOT]
    found = held(scenarios, obstacles, worlds=1, per_world=1)
    assert found.world_of.tolist() == [0, 1, 2]
    assert found.unknown_worlds == {"ahead": 1, "ground": 0}
    one, other = found.score(rig()), found.score(TWO)
    for scores in (one, other):
        np.testing.assert_array_equal(np.isnan(scores.by_world("known"))[:, 0], [False, True, False])
        np.testing.assert_array_equal(np.isnan(scores.area)[:, 0], [False, True, False])
    assert paired(other, one).worlds.tolist() == [2, 3]
    with pytest.raises(
        ValueError, match="'ahead': of 1 worlds, none shows some surface in each of: obstacle in 20m; use"
    ):
        held([yard()], obstacles)


def test_a_world_without_traffic_shows_each_instant_once():
    found = held([yard(WALL)], per_world=4)
    assert found.world_of.tolist() == [0] * 4
    assert len({one.cell_m2.sum() for one in found.references}) == 4  # draws of the reference


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scenarios": []}, "scenarios: at least one"),
        ({"objectives": {}}, "objectives: at least one"),
        ({"worlds": 0}, "worlds: at least 1"),
        ({"per_world": 4}, "per_world: a run of 'lot' has 3 instants that are 0.4 s apart; got 4"),
        ({"every_s": 0.3}, "every_s: a positive multiple"),
        ({"workers": -1}, "workers: a number >= 0"),
        ({"seed": -1}, "seed: a number >= 0"),
        ({"budget_bytes": 1000.0}, "budget_bytes: 3 worlds .* in which 0 fit; use fewer worlds"),
        ({"budget_bytes": 1000.0, "workers": 1}, "budget_bytes: 3 worlds"),
        ({"objectives": {"a": Objective(region="21m")}}, "objective 'a': region '21m': one of 20m, 80m"),
        ({"objectives": {"a": Objective(region="20m", band="sky")}}, "objective 'a': band 'sky': 'ground' or 'obst"),
        ({"objectives": {"a": Objective(region="20m", band=())}}, "objective 'a': band: at least one"),
        (
            {"objectives": {"a": Objective(region="20m"), "b": Objective(region={"20m": BAY["bay"]})}},
            "objective 'b': region '20m': another objective",
        ),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_said_at_the_door(change, message):
    with pytest.raises(ValueError, match=message):
        held(**change)


def test_rigs_that_cannot_be_and_instants_that_are_not(instants):
    with pytest.raises(ValueError, match="below the ground"):
        instants.score(rig(lidar(mount={"x_m": 3.0, "z_m": -1.0})))
    for numbers in ([], [6], [-1]):
        with pytest.raises(ValueError, match="numbers from 0 to 5 are needed"):
            instants.score(rig(), numbers)
    with pytest.raises(ValueError, match="instants \\[5\\]: the rig was not scored there"):
        instants.score(rig(), [0, 1]).at([1, 5])


def test_a_rig_for_another_vehicle_is_refused_unless_the_vehicle_was_said():
    open_lot = Scenario.model_validate({"name": "open", "bodies": [FLOOR], "ego": {"pose": {}}})
    near = {"near": Objective(region="20m", band="ground")}
    roof = rig(vehicle="renault_zoe")
    with pytest.raises(ValueError, match="is for the vehicle renault_zoe, and these instants have suv: say which"):
        held([open_lot], near).score(roof)
    assert held([open_lot], near, vehicle="renault_zoe").score(roof).area.shape == (2, 1)


def test_a_process_that_was_killed_is_told_and_the_others_end_with_the_search():
    instants = held(workers=9, worlds=2, per_world=1)
    killed, other = (holder.process for holder in instants._holders)
    killed.kill()
    killed.join()
    with pytest.raises(ChildProcessError, match="a process that holds worlds was killed"):
        instants.score(rig())
    instants.close()
    other.join(20)
    assert other.exitcode == 0


def test_threads_make_no_difference(instants):
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1 if before > 1 else 2)
        other = instants.score(TWO)
    finally:
        torch.set_num_threads(before)
    same(other, instants.score(TWO))


def test_a_recording_is_one_world_for_any_seed_and_none_of_it_is_fresh():
    with held(["tracks_table"], {"near": Objective(region="20m", band="ground")}, worlds=3, every_s=0.5) as recorded:
        assert recorded.world_of.tolist() == [0, 0]
        with pytest.raises(ValueError, match="one whose worlds are drawn is needed; 'tracks_table' is the same"):
            recorded.anew(9, 3)
