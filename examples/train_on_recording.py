"""Train a detector on a recording: was visible what it misses? `python examples/train_on_recording.py PATH`.

PATH is a recording with poses and labelled cars, such as a drive of KITTI's raw data with its tracklets
(`2011_09_26/2011_09_26_drive_0005_sync`). Without it, a small one is simulated and written first, with one LiDAR where
KITTI has its own.

The reference is accumulated from the recording itself. The coverage of its frames does not depend on the detector: it
is measured once, and says nothing about which epoch is best. Recall over visibility does. The detector is that of
train_detector.py; needs `pip install 'torchcover[lightning,tensorboard]'`.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
from rich.console import Console
from rich.progress import track
from rich.table import Table
from train_detector import OPERATING_SCORE, REGIONS, SCORES, coverage_metric, in_region, thinned, train

from torchcover import Rig
from torchcover.data import AccumulatedReference, RecordedFrames, SimulatedFrames, write_recording
from torchcover.simulation import PaperReference

CARS = ("car", "Car", "vehicle.car", "REGULAR_VEHICLE")  # in simulations and KITTI, in nuScenes, in Argoverse 2
# The last fifth is validated on: neighbours in time are alike, and must not be on both sides.
TRAINED = 0.8
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
    """Ten seconds of city traffic as a plain folder: clouds, poses, boxes."""
    rig = Rig.model_validate({"name": "kitti", "sensors": [LIDAR]})
    unused = PaperReference(rows=1, columns=1)
    write_recording(
        SimulatedFrames("urban", rig, num_frames=50, frame_interval_s=0.2, reference_sensor=unused, boxes=True),
        folder,
        "folder",
    )


def read(frames):
    """What to train on, and what to validate on with its reference; `network RIG` is what the detector is fed."""
    rig, trained, kept = frames.rigs[0], int(TRAINED * len(frames)), []
    for frame in track(frames, description="accumulating the reference", total=len(frames)):
        if frame.boxes is None:
            raise SystemExit(f"{frames.recording.path}: no labelled boxes, and recall is about objects")
        fed, boxes = {f"network {rig}": thinned(frame.get_measured_points(rig))}, in_region(frame.boxes, CARS)
        if len(kept) < trained:
            kept.append(replace(frame, clouds=fed, reference=frame.reference[:0], boxes=boxes))
        else:
            kept.append(replace(frame, clouds={rig: frame.get_cloud(rig), **fed}, boxes=boxes))
    return rig, kept[:trained], kept[trained:]


def report(module, coverage, path, console):
    """A table and a figure of both: what could be seen, and what was found of it."""
    for line in coverage.summary(REGIONS):
        seen = line.numbers["detection_0.4m"].value
        console.print(
            f"{line.region}: {seen:.1%} within 0.4 m, of the {line.observed_share:.1%} of the cells that are known"
        )
    recall = module.counts.compute_curve("visibility").recall
    table = Table("visibility", "cars", "recall", "95 % interval", title=f"recall at score {OPERATING_SCORE}")
    row = SCORES.index(OPERATING_SCORE)
    for column, name in enumerate(module.counts.visibility_bins):
        value, low, high = (float(part[row, column]) for part in (recall.value, recall.low, recall.high))
        table.add_row(name, str(int(recall.trials[row, column])), f"{value:.2f}", f"{low:.2f} to {high:.2f}")
    console.print(table)
    figure, (left, right) = plt.subplots(1, 2, figsize=(12.0, 4.5), layout="constrained")
    coverage_metric(has_area_weights=False).plot(coverage, left)
    module.recall.plot(module.counts, right, score_threshold=OPERATING_SCORE)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main():
    """Read, train, report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", nargs="?", type=Path)
    parser.add_argument("--window", type=float, default=1.0, help="seconds that the reference is accumulated over")
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
    console.print(*frames.reference_record["notes"], sep="\n")
    rig, training_frames, validation_frames = read(frames)
    metric = coverage_metric(has_area_weights=False)
    module, coverage = train(rig, training_frames, validation_frames, metric, options, console)
    report(module, coverage, options.out / "recall.png", console)
    console.print(f"Wrote {options.out / 'recall.png'} and event files for TensorBoard beside it")


if __name__ == "__main__":
    main()
