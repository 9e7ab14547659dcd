"""Does an unlabelled bag say what a labelled folder of the same drive says?

A drive is simulated, and recorded with its boxes by one LiDAR that sees all around; the same scans and poses go into a
bag of ROS 2, which has no boxes. Both are read back and measured at instants a second apart against an accumulated
reference, and so is the simulation at these instants.
"""

import argparse
import tempfile
from pathlib import Path

import torch

from benchmarks.accumulated_reference import OTHER, REGIONS, TRUTH_RAYS, added, metric, numbers, words
from benchmarks.recorded_measure import distance
from benchmarks.timing import table
from tests.recordings import bags
from torchcover.data import (
    AccumulatedReference,
    RecordedFrames,
    RegionsOfInterest,
    SimulatedFrames,
    open_recording,
    reference_called,
    write_recording,
)
from torchcover.simulation import Rig

EVERY_S, MARGIN_S, APART_S = 0.1, 3.0, 1.0


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="urban")
    parser.add_argument("--seed", type=int, default=42)
    parser.add_argument("--seconds", type=float, default=14.0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    drive = SimulatedFrames(
        options.scenario,
        Rig(name="recorder", sensors=[OTHER]),
        steps=round(options.seconds / EVERY_S),
        seed=options.seed,
        every_s=EVERY_S,
        boxes=True,
    )
    margin, apart = (round(time_s / EVERY_S) for time_s in (MARGIN_S, APART_S))
    instants = range(margin, len(drive) - margin, apart)
    asked = RegionsOfInterest().around(drive.ego_outline_m)
    truth = of(drive.with_reference_sensor(reference_called(rays=TRUTH_RAYS, asked=asked)), instants)
    rows = [("the truth", "", "", "", "", *words(truth))]
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        write_recording(drive, root / "folder")
        recorded = open_recording(root / "folder")
        as_bag(recorded, root / "bag")
        for window_s in (2.0, 5.0):
            labelled = None
            for name in ("folder", "bag"):
                recording = open_recording(root / name)
                recording.body = recorded.body
                found = of(RecordedFrames(recording, reference=AccumulatedReference(window_s)), instants)
                between = ("", "") if labelled is None else distance(found, labelled)
                labelled = found
                rows.append((f"{name}, {window_s:g} s", *distance(found, truth), *between, *words(found)))
    places = [f"{region.name} {height}" for region in REGIONS for height in ("ground", "obstacle")]
    apart_words = ("rms from the folder", "worst")
    table(("recording, window", "rms from the truth", "worst", *apart_words, *places), rows)


def of(frames, instants):
    """The numbers of some instants."""
    measured = metric()
    for instant in instants:
        frame = frames[instant]
        added(measured, frame, next(iter(frame.clouds)))
    return numbers(measured.compute(), "area")


def as_bag(recording, path):
    """The scans and poses of a recording of one sensor as a bag."""
    (sensor,) = recording.sensors
    mount = recording.scan(sensor, 0).vehicle_T_sensor
    messages = [("/tf_static", bags.T0_NS, bags.tree(bags.link("base_link", sensor, mount)))]
    for index, time_s in enumerate(recording.times_s):
        time_ns = bags.T0_NS + round(1e9 * float(time_s))
        messages.append(("/odometry", time_ns, bags.odometry(recording.world_T_vehicle(index), time_ns)))
        points = bags.points(recording.scan(sensor, index).points_m)
        messages.append((f"/{sensor}", time_ns, bags.cloud(points, time_ns, sensor)))
    bags.bag(path, messages)


if __name__ == "__main__":
    main()
