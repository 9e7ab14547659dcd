"""Frames that repeat a scenario add no information: errors only count distinct time steps."""

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
SMALL = {"test_targets": "none", "cell_m": 4.0, "num_rays": 64, "reference": "paper"}


@pytest.fixture
def drive(tmp_path):
    """Return a function from the number of time steps to a scenario with walls at increasing distances."""

    def make(num_time_steps):
        (tmp_path / "drive.csv").write_text(f"t,x,y,z,roll,pitch,yaw\n0,0,0,0,0,0,0\n{num_time_steps},120,0,0,0,0,0\n")
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
                "duration_s": num_time_steps - 1.0,
            }
        )

    return make


def get_errors(result):
    return np.array([row[key] for row in result.summary for key in row if key.endswith("_error")], dtype=float)


def test_repeated_frames_do_not_reduce_errors(drive):
    # The sampling of the reference contributes little; only this part falls. Four times as many new frames would
    # halve the error.
    settings = {**SMALL, "reference": "surface", "num_rays": 1024}
    once, often = (torchcover.evaluate(RIG, drive(8), num_frames=num_frames, **settings) for num_frames in (8, 8 * 4))
    known = get_errors(once) > 0
    assert np.median(get_errors(often)[known] / get_errors(once)[known]) > 0.75
    assert often.coverage.block_sums.frame_counts.tolist() == [4] * 8 + [0] * 8
    assert often.record["frame_counts"]["repeated_frames"] == 8 * 3
    assert (
        "32 frames show 8 distinct time steps: the scenario repeats, and confidence intervals account for this."
        in often.table.notes
    )
    assert "repeats" not in " ".join(once.table.notes)


def test_a_target_error_stops_before_frames_repeat(drive):
    result = torchcover.evaluate(RIG, drive(70), target_error="0.0001%", **SMALL)
    assert (result.run.num_frames, result.target_error_lines[0]) == (
        70,
        "Target error not reached in 70 frames; the largest error of each region:",
    )


def test_few_distinct_frames_have_no_error(drive):
    result = torchcover.evaluate(RIG, drive(3), num_frames=24, **SMALL)
    assert np.isnan(get_errors(result)).all()
    assert result.coverage.block_sums.frame_counts.tolist()[:4] == [8, 8, 8, 0]


def test_errors_of_static_scenes_cover_the_reference():
    result = torchcover.evaluate(RIG, "courtyard", num_frames=9, **SMALL)
    assert (get_errors(result)[:2] > 0).all()
    assert (
        "All 9 frames show the same time step, so confidence intervals only cover the sampling of reference poses."
        in result.table.notes
    )


def test_notes_without_errors_do_not_mention_intervals(drive):
    static = torchcover.evaluate(RIG, "courtyard", num_frames=7, **SMALL)
    assert "All 7 frames show the same time step." in static.table.notes
    few = torchcover.evaluate(RIG, drive(3), num_frames=9, **SMALL)
    assert "9 frames show 3 distinct time steps: the scenario repeats." in few.table.notes
    assert not any("confidence interval" in note for note in (*static.table.notes, *few.table.notes))


def test_frames_of_one_scene_share_a_block():
    city = {"name": "urban", "traffic": {"type": "urban", "duration_s": 2.0, "time_step_s": 0.5}}
    reference = PaperReference(rows=2, columns=2)
    frames = SimulatedFrames(
        Scenario.model_validate(city), RIG, num_frames=12, frame_interval_s=1.0, reference_sensor=reference
    )
    block_indices = [frames.simulator.get_block_index(index) for index in range(12)]
    assert block_indices == [0, 0, 0, 1, 1, 2, 2, 2, 3, 3, 4, 4]
    assert (frames[3].block_index, frames[3].counts["repeated_frames"]) == (1, 0)


@pytest.mark.parametrize("every_steps", [1, 2, 3, 7, 12])
def test_distinct_frames_are_counted(drive, every_steps):
    frames = SimulatedFrames(drive(12), RIG, num_frames=30, frame_interval_s=every_steps * 1.0)
    block_indices = [frames.simulator.get_block_index(index) for index in range(30)]
    assert block_indices == [index * every_steps % 12 for index in range(30)]
    assert frames.simulator.num_distinct_frames == len(set(block_indices)) == 12 // math.gcd(12, every_steps)


@pytest.mark.parametrize("num_time_steps", [1, 2, 3, 4, 5, 8, 13, 60, 64, 100, 301, 602, 3001])
def test_frames_are_spread_evenly_over_a_scenario(drive, num_time_steps):
    every = round(compute_frame_interval_s(drive(num_time_steps), None))
    time_steps = np.arange(2 * num_time_steps) * every % num_time_steps
    assert len(set(time_steps[:num_time_steps].tolist())) == num_time_steps
    for steps in {min(count, num_time_steps) for count in (5, 20, 64, 200)}:
        gaps = np.diff(np.sort(np.append(time_steps[:steps], time_steps[:steps] + num_time_steps)))
        assert gaps.max() <= 3 * num_time_steps / steps + 1


def test_frame_interval_default_depends_on_the_scenario():
    assert compute_frame_interval_s(Scenario.load("courtyard"), 0.3) == 0.3
    assert compute_frame_interval_s(Scenario.load("urban"), None) == 10.0
    assert compute_frame_interval_s(Scenario.load("courtyard"), None) == 0.1
