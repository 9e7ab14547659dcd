"""Train a detector on a recording and compare its misses with visibility: `python examples/train_on_recording.py PATH`.

PATH is a recording with poses and labeled cars, such as a drive of KITTI raw with its tracklets
(`2011_09_26/2011_09_26_drive_0005_sync`). Without it, a small recording with KITTI's LiDAR is simulated first.

The reference is accumulated from the recording itself. The coverage of its frames does not depend on the detector and
is measured once; recall over visibility depends on it. The detector is that of train_detector.py. Needs
`pip install 'torchcover[lightning,tensorboard]'`.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
from rich.console import Console
from rich.progress import track
from rich.table import Table
from train_detector import (
    OPERATING_SCORE,
    REGIONS,
    SCORES,
    build_coverage_metric,
    select_cars_in_region,
    thin_cloud,
    train,
)

from torchcover import Rig
from torchcover.data import AccumulatedReference, RecordedFrames, SimulatedFrames, write_recording
from torchcover.simulation import PaperReference

CARS = ("car", "Car", "vehicle.car", "REGULAR_VEHICLE")  # simulations, KITTI, nuScenes, Argoverse 2
# Share of the frames for training; the last fifth is for validation, because consecutive frames are correlated.
TRAINING_SHARE = 0.8
LIDAR = {
    "type": "lidar",
    "name": "velodyne",
    "mount": {"x_m": -0.58, "z_m": 1.73},
    "channels": 64,
    "columns": 512,
    "vertical_fov_deg": [-24.8, 2.0],
    "horizontal_fov_deg": 360.0,
    "max_range_m": 120.0,
}


def write_small_recording(folder):
    """Write ten seconds of city traffic in the folder format: point clouds, poses, boxes."""
    rig = Rig.model_validate({"name": "kitti", "sensors": [LIDAR]})
    unused = PaperReference(rows=1, columns=1)
    write_recording(
        SimulatedFrames("urban", rig, num_frames=50, frame_interval_s=0.2, reference_sensor=unused, boxes=True),
        folder,
        "folder",
    )


def prepare_frames(frames):
    """Prepare training frames, and validation frames with reference; `network RIG` is the input of the detector."""
    rig, training_count, prepared = frames.metadata.rigs[0], int(TRAINING_SHARE * len(frames)), []
    for frame in track(frames, description="accumulating the reference", total=len(frames)):
        if frame.boxes is None:
            raise SystemExit(f"{frames.recording.path}: labeled boxes are needed for recall, and there are none")
        inputs = {f"network {rig}": thin_cloud(frame.get_measured_points(rig))}
        boxes = select_cars_in_region(frame.boxes, CARS)
        if len(prepared) < training_count:
            prepared.append(replace(frame, clouds=inputs, reference=frame.reference[:0], boxes=boxes))
        else:
            prepared.append(replace(frame, clouds={rig: frame.get_cloud(rig), **inputs}, boxes=boxes))
    return rig, prepared[:training_count], prepared[training_count:]


def print_report(module, coverage, path, console):
    """Print and plot the coverage and the recall over visibility."""
    for row in coverage.summary(REGIONS):
        rate = row.numbers["detection_0.4m"].value
        console.print(
            f"{row.region}: {rate:.1%} within 0.4 m, of the {row.observed_share:.1%} of the cells that are observed"
        )
    recall = module.counts.compute_curve("visibility").recall
    table = Table("visibility", "cars", "recall", "95 % interval", title=f"recall at score {OPERATING_SCORE}")
    score_index = SCORES.index(OPERATING_SCORE)
    for column, name in enumerate(module.counts.visibility_bins):
        value, low, high = (float(part[score_index, column]) for part in (recall.value, recall.low, recall.high))
        table.add_row(name, str(int(recall.trials[score_index, column])), f"{value:.2f}", f"{low:.2f} to {high:.2f}")
    console.print(table)
    figure, (left, right) = plt.subplots(1, 2, figsize=(12.0, 4.5), layout="constrained")
    build_coverage_metric(has_area_weights=False).plot(coverage, left)
    module.recall.plot(module.counts, right, score_threshold=OPERATING_SCORE)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main():
    """Read the recording, train the detector and report the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", nargs="?", type=Path)
    parser.add_argument("--window", type=float, default=1.0, help="accumulation window of the reference in seconds")
    parser.add_argument("--epochs", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/train_on_recording"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)

    console = Console()
    recording = options.recording or options.out / "recording"
    if options.recording is None and not recording.exists():
        console.print(f"simulating a small recording: {recording}")
        write_small_recording(recording)
    frames = RecordedFrames(recording, reference=AccumulatedReference(options.window), use_ground_model=False)
    console.print(*frames.describe_reference()["notes"], sep="\n")
    rig, training_frames, validation_frames = prepare_frames(frames)
    metric = build_coverage_metric(has_area_weights=False)
    module, coverage = train(rig, training_frames, validation_frames, metric, options, console)
    print_report(module, coverage, options.out / "recall.png", console)
    console.print(f"Wrote {options.out / 'recall.png'} and event files for TensorBoard")


if __name__ == "__main__":
    main()
