"""A scenario that is seen again says nothing new: distinct instants are counted, and errors know no others."""

import math

import numpy as np
import pytest

import torchcover
from torchcover import Rig, Scenario
from torchcover.data import SimulatedFrames
from torchcover.evaluation.task import compute_frame_interval_s
from torchcover.simulation import PaperReference

RIG = Rig.model_validate(
    {
        "name": "top",
        "sensors": [
            {
                "name": "top",
                "mount": {"z_m": 1.8},
                "channels": 8,
                "vertical_fov_deg": (-30, 0),
                "horizontal_fov_deg": 360,
                "columns": 90,
                "max_range_m": 80,
            }
        ],
    }
)
FEW = {"test_targets": "none", "cell_m": 4.0, "num_rays": 64, "reference": "paper"}


@pytest.fixture
def drive(tmp_path):
    """(number of instants) -> a scenario that the ego drives through, past walls at ever larger distances."""

    def make(instants):
        (tmp_path / "drive.csv").write_text(f"t,x,y,z,roll,pitch,yaw\n0,0,0,0,0,0,0\n{instants},120,0,0,0,0,0\n")
        walls = [{"x_m": x, "y_m": 4 + x / 8} for x in (5, 15, 35, 75)]
        return Scenario.model_validate(
            {
                "name": "drive",
                "ego": {"shape": {"type": "box", "size_m": [4, 2, 1.5]}, "trajectory": str(tmp_path / "drive.csv")},
                "bodies": [
                    {"name": "ground", "shape": {"type": "plane", "size_m": [600, 600]}},
                    {"name": "wall", "shape": {"type": "box", "size_m": [6, 1, 3]}, "poses": walls},
                ],
                "time_step_s": 1.0,
                "duration_s": instants - 1.0,
            }
        )

    return make


def errors(result):
    return np.array([row[key] for row in result.summary for key in row if key.endswith("_error")], dtype=float)


def test_going_round_again_makes_no_error_smaller(drive):
    # A reference whose own draws scatter little: only that becomes less. Four rounds of new data would have half the
    # error.
    settings = {**FEW, "reference": "surface", "num_rays": 1024}
    once, often = (torchcover.evaluate(RIG, drive(8), num_frames=steps, **settings) for steps in (8, 8 * 4))
    known = errors(once) > 0
    assert np.median(errors(often)[known] / errors(once)[known]) > 0.75
    assert often.coverage.block_sums.frame_counts.tolist() == [4] * 8 + [0] * 8
    assert often.record["frame_counts"]["repeated_frames"] == 8 * 3
    assert "32 frames show 8 distinct time steps: the scenario repeats, and confidence intervals account for this." in often.table.notes
    assert "repeats" not in " ".join(once.table.notes)


def test_a_target_error_does_not_go_round_and_round(drive):
    result = torchcover.evaluate(RIG, drive(70), target_error="0.0001%", **FEW)
    assert (result.run.num_frames, result.target_error_lines[0]) == (
        70,
        "Target error not reached in 70 frames; the largest error of each region:",
    )


def test_a_few_instants_have_no_error_however_often_they_are_seen(drive):
    result = torchcover.evaluate(RIG, drive(3), num_frames=24, **FEW)
    assert np.isnan(errors(result)).all()
    assert result.coverage.block_sums.frame_counts.tolist()[:4] == [8, 8, 8, 0]


def test_where_nothing_moves_errors_are_about_the_reference_and_say_so():
    result = torchcover.evaluate(RIG, "courtyard", num_frames=9, **FEW)
    assert (errors(result)[:2] > 0).all()
    assert (
        "All 9 frames show the same time step, so confidence intervals only cover the sampling of reference poses."
        in result.table.notes
    )


def test_nothing_is_said_of_errors_where_there_are_none(drive):
    still = torchcover.evaluate(RIG, "courtyard", num_frames=7, **FEW)
    assert "All 7 frames show the same time step." in still.table.notes
    few = torchcover.evaluate(RIG, drive(3), num_frames=9, **FEW)
    assert "9 frames show 3 distinct time steps: the scenario repeats." in few.table.notes
    assert not any("confidence interval" in note for note in (*still.table.notes, *few.table.notes))


def test_the_steps_of_a_city_are_never_in_two_blocks():
    city = {"name": "urban", "traffic": {"type": "urban", "duration_s": 2.0, "time_step_s": 0.5}}
    few = PaperReference(rows=2, columns=2)
    frames = SimulatedFrames(
        Scenario.model_validate(city), RIG, num_frames=12, frame_interval_s=1.0, reference_sensor=few
    )
    places = [frames.simulator.get_block_index(index) for index in range(12)]
    assert places == [0, 0, 0, 1, 1, 2, 2, 2, 3, 3, 4, 4]
    assert (frames[3].block_index, frames[3].counts["repeated_frames"]) == (1, 0)


@pytest.mark.parametrize("every_steps", [1, 2, 3, 7, 12])
def test_distinct_instants_are_those_that_were_seen(drive, every_steps):
    frames = SimulatedFrames(drive(12), RIG, num_frames=30, frame_interval_s=every_steps * 1.0)
    seen = [frames.simulator.get_block_index(index) for index in range(30)]
    assert seen == [index * every_steps % 12 for index in range(30)]
    assert frames.simulator.num_distinct_frames == len(set(seen)) == 12 // math.gcd(12, every_steps)


@pytest.mark.parametrize("instants", [1, 2, 3, 4, 5, 8, 13, 60, 64, 100, 301, 602, 3001])
def test_any_number_of_steps_lies_evenly_over_a_given_scenario(drive, instants):
    every = round(compute_frame_interval_s(drive(instants), None))
    seen = np.arange(2 * instants) * every % instants
    assert len(set(seen[:instants].tolist())) == instants
    for steps in {min(count, instants) for count in (5, 20, 64, 200)}:
        gaps = np.diff(np.sort(np.append(seen[:steps], seen[:steps] + instants)))
        assert gaps.max() <= 3 * instants / steps + 1


def test_a_time_that_is_given_is_kept_and_traffic_has_its_own():
    assert compute_frame_interval_s(Scenario.load("courtyard"), 0.3) == 0.3
    assert compute_frame_interval_s(Scenario.load("urban"), None) == 10.0
    assert compute_frame_interval_s(Scenario.load("courtyard"), None) == 0.1
