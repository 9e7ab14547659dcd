"""What the metrics of others cost: eight rigs with and without them, in processor time; and each metric by itself."""

import statistics
import time

import torch

from benchmarks.timing import table
from torchcover.evaluation import CoverageObserver
from torchcover.evaluation.measuring import metric_of
from torchcover.evaluation.other_metrics import metrics_of
from torchcover.evaluation.settings import Settings
from torchcover.evaluation.task import task_of

RIGS = {
    "eight of four LiDARs": (
        "hu2022_center", "hu2022_line", "hu2022_line_roll", "hu2022_pyramid", "hu2022_pyramid_pitch",
        "hu2022_pyramid_roll", "hu2022_square", "hu2022_trapezoid",
    ),
    "eight of one to six sensors": (
        "front_roof_32", "front_roof_128", "front_grille_128", "kitti", "nuscenes", "waymo", "argoverse2", "edgar",
    ),
}  # fmt: skip
# Those that walk through voxels are apart.
FRAME_METRICS = ("object_coverage", "perception_entropy", "k_cover", "point_density", "false_visible")
STEPS = 4
# The sums of eight rigs over cells of 0.25 m take 3 GB.
CELL_M = 0.5


def main():
    """Print seconds of a step in `urban`: of a pass without them, of the boxes, and of each metric in turn.

    What two metrics share, the first of them pays for. Frames are made with and without boxes in turns.
    """
    torch.set_num_threads(1)
    rows = []
    for words, rigs in RIGS.items():
        seconds = seconds_of(rigs)
        without = seconds["frames"] + seconds["coverage"]
        added = [seconds[name] for name in ("boxes", *FRAME_METRICS)]
        rows.append((words, without, 1 + sum(added) / without, *added))
    table(("rigs", "without (s)", "with all, ratio", "boxes (s)", *(f"{name} (s)" for name in FRAME_METRICS)), rows)


def seconds_of(rigs):
    """Median over the steps of the processor time that each part takes."""
    plain, settings = (
        Settings(rigs, "urban", steps=STEPS + 1, metrics=names, vehicle="suv", cell_m=CELL_M)
        for names in ((), FRAME_METRICS)
    )
    task, with_boxes = (task_of(each) for each in (plain, settings))
    metrics = metrics_of(with_boxes, settings).of_rigs
    coverage = [
        CoverageObserver(metric_of(plain, task.asked, square_metres=task.frames.square_metres), rig)
        for rig in task.rigs
    ]
    spent = []
    for step in range(STEPS + 1):
        row = {}
        frame = timed(row, "frames", lambda step=step: task.frames[step])
        frame = timed(row, "boxes", lambda step=step: with_boxes.frames[step])
        for name, observers in {
            "coverage": coverage,
            **{name: metrics[name].values() for name in FRAME_METRICS},
        }.items():
            timed(row, name, lambda frame=frame, observers=observers: [one.update(frame) for one in observers])
        row["boxes"] -= row["frames"]
        spent.append(row)
    return {name: statistics.median(row[name] for row in spent[1:]) for name in spent[0]}  # the first builds the city


def timed(row, name, function):
    """What the function gives; its processor time goes into the row."""
    start = time.process_time()
    found = function()
    row[name] = time.process_time() - start
    return found


if __name__ == "__main__":
    main()
