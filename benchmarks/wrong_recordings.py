"""What the door says of recordings that are right, and of the same ones read wrongly.

`python -m benchmarks.wrong_recordings [FOLDER ...]`: simulated drives, and those in the folders, with poses.
"""

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.run import table
from torchcover.data import AccumulatedReference, RecordedFrames, open_recording, write_recording
from torchcover.evaluation.settings import Settings
from torchcover.evaluation.task import simulation
from torchcover.geometry import invert, quaternion_from_rotation, rigid, rotation_from_euler, rotation_from_quaternion

STEPS = 30
WORLDS = {"urban": (0, 7, 8), "highway": (0, 7, 8), "parking": (0, 7, 8)}
RIGHT = {
    "as it is": "",
    "3 cm of noise on ranges": "",
    "poses off by 5 cm and 0.1 degrees": "",
}
WRONG = {
    "rain or dust, a tenth of the points": "rain, snow or dust",
    "the first two sweeps": "give a longer drive",
    "a pose that jumps by 0.7 m": "give poses without jumps",
    "stands": "measure where it drives",
    "rotations x, y, z, w": "--quaternions xyzw",
    "poses are vehicle_T_world": "--poses inverse",
    "x and y of poses exchanged": "--poses yx",
    "x and y of clouds exchanged": "--axes yxz",
    "clouds in mm": "--units mm",
    "poses a sweep late": "--lag 0.1",
    "likewise, from the first on": "--lag 0.1",
    "poses at half the rate": "--poses held",
    "poses that stand": "give the real poses",
    "one cloud again and again": "leave it out",
}


class Misread:
    """A recording with one thing wrong."""

    reference_sensors = ()
    instants = None

    def __init__(self, recording, fault):
        self._recording, self._fault = recording, fault
        # A drive that was late before its first sweep, too, has lost that.
        self._before = fault == "likewise, from the first on"
        count = 2 if fault == "the first two sweeps" else len(recording.names) - self._before
        self.names, self.frames = recording.names[:count], range(count)
        self.times_s = recording.times_s[:count]

    def __getattr__(self, name):
        return getattr(self._recording, name)

    def scan(self, sensor, index):
        """What is stored."""
        number = {"one cloud again and again": 0, "stands": 0}.get(self._fault, index + self._before)
        scan, random = self._recording.scan(sensor, number), np.random.default_rng(index)
        points_m = scan.points_m.astype(np.float64)
        if self._fault.startswith("3 cm") or self._fault == "stands":
            range_m = np.maximum(np.linalg.norm(points_m, axis=1, keepdims=True), 0.1)
            points_m *= 1 + random.normal(0, 0.03, (len(points_m), 1)) / range_m
        elif self._fault.startswith("rain"):
            drops_m = random.uniform([-15, -15, -1.5], [15, 15, 3], (len(points_m) // 10, 3))
            points_m = np.concatenate([points_m, drops_m])
        elif self._fault == "x and y of clouds exchanged":
            points_m = points_m[:, [1, 0, 2]]
        elif self._fault == "clouds in mm":
            points_m *= 1000
        return replace(scan, points_m=points_m)

    def world_T_vehicle(self, index):
        """Where it says that the vehicle was."""
        earlier = {"poses a sweep late": max(index - 1, 0), "poses at half the rate": index // 2 * 2}
        number = {**earlier, "poses that stand": 0, "stands": 0}.get(self._fault, index)
        pose, random = self._recording.world_T_vehicle(number), np.random.default_rng(index)
        if self._fault.startswith("a pose that jumps"):
            return rigid(np.eye(3), np.array([0.5, 0.5, 0.0]) * (index >= len(self.names) // 2)) @ pose
        if self._fault.startswith("poses off"):
            return pose @ rigid(rotation_from_euler(*random.normal(0, 0.1, 3)), random.normal(0, 0.05, 3))
        if self._fault == "rotations x, y, z, w":
            wxyz = quaternion_from_rotation(pose[:3, :3])
            return rigid(rotation_from_quaternion(np.roll(wxyz, -1)), pose[:3, 3])
        if self._fault == "x and y of poses exchanged":
            return rigid(pose[:3, :3], pose[[1, 0, 2], 3])
        return invert(pose) if self._fault == "poses are vehicle_T_world" else pose

    def boxes(self, index):
        """Nothing is labelled."""


def matters(recording, fault):
    """Whether anything within a third of a second is moved to elsewhere by 10 cm, at 20 m."""
    if "poses" not in fault and "rotations" not in fault and "likewise" not in fault:
        return True
    wrong, first = Misread(recording, fault), int("likewise" in fault)
    off = [
        invert(wrong.world_T_vehicle(one)) @ wrong.world_T_vehicle(one + 3)
        - invert(recording.world_T_vehicle(one + first)) @ recording.world_T_vehicle(one + first + 3)
        for one in range(len(wrong.names) - 3)
    ]
    return max(np.linalg.norm(each[:3, 3]) + 20 * np.linalg.norm(each[:3, :3]) for each in off) > 0.1


def drives(folder, given):
    """Name of a kind of drive -> the recordings of it."""
    found = {}
    for world, seeds in WORLDS.items():
        for seed in seeds:
            place = Path(folder) / f"{world}{seed}"
            settings = Settings("front_roof_64", world, steps=STEPS, seed=seed, every_s=0.1)
            write_recording(simulation(settings, boxes=True).frames, place, "folder", progress=iter)
            found.setdefault(world, []).append(open_recording(place))
    for path in given:
        found.setdefault("given", []).append(open_recording(path))
    return found


def main(argv):
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="*", type=Path)
    arguments = parser.parse_args(argv)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        of = drives(folder, arguments.folders)
        for fault, mended in {**RIGHT, **WRONG}.items():
            row = [fault, mended]
            for recordings in of.values():
                said = [
                    RecordedFrames(Misread(each, fault), reference=AccumulatedReference()).doubts()
                    for each in recordings
                    if not mended or matters(each, fault)
                ]
                # An ego that stands at a light is told of, too.
                said = [[doubt for doubt in doubts if fault == "stands" or "stands in" not in doubt] for doubts in said]
                found, right = sum(map(bool, said)), sum(mended in " ".join(doubts) for doubts in said if doubts)
                row.append(f"{found} / {right} of {len(said)}" if mended else f"{found} of {len(said)}")
            rows.append(row)
    table(("recording", "what mends it", *of), rows)


if __name__ == "__main__":
    main(sys.argv[1:])
