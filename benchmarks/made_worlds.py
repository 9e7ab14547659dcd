"""How far are numbers in the world that is made of a drive from those in the world that was driven through?

A drive is simulated, recorded by one LiDAR, and made a world: once with its labels, once without. The rig that recorded
it and others are measured at the same instants there and in the true one.
"""

import argparse
import tempfile
from pathlib import Path
from shutil import rmtree

import numpy as np

from benchmarks.timing import table
from torchcover import evaluate
from torchcover.recordings import open_recording
from torchcover.simulation import Rig, SimulatedFrames, write_recording, write_world

EVERY_S, RAYS = 0.1, 8192
VEHICLE = "suv"
RECORDER = Rig(
    name="recorder",
    sensors=[
        {
            "type": "lidar",
            "name": "roof",
            "channels": 64,
            "vertical_fov_deg": (-25.0, 5.0),
            "horizontal_fov_deg": 360.0,
            "columns": 1200,
            "max_range_m": 200.0,
            "range_noise_m": 0.02,
            "mount": {"x_m": -0.8, "z_m": 1.95},
        }
    ],
)
OTHERS = ("front_roof_128", "front_grille_128")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="urban")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=int, default=10)
    options = parser.parse_args([] if __name__ != "__main__" else None)
    rigs = {"recorder": RECORDER, **{name: Rig.load(name) for name in OTHERS}}
    with tempfile.TemporaryDirectory() as folder:
        drive = Path(folder) / "drive"
        frames = SimulatedFrames(
            options.scenario,
            RECORDER,
            steps=round(options.seconds / EVERY_S) + 1,
            seed=options.seed,
            every_s=EVERY_S,
            boxes=True,
        )
        write_recording(frames, drive)
        worlds, told = {"true": options.scenario}, {}
        for name in ("labels", "none"):
            told[name] = write_world(open_recording(drive), Path(folder) / name)
            worlds[name] = Path(folder) / name / "scenario.yaml"
            rmtree(drive / "boxes", ignore_errors=True)
        found = {name: numbers(rigs, world, options) for name, world in worlds.items()}
    for name, words in told.items():
        print(f"{name}: {words}")
    print()
    places, true = next(iter(found["true"].values()))[0], {rig: of for rig, (_, of) in found["true"].items()}
    rows = []
    for rig, of in true.items():
        rows.append((rig, "the true one", "", "", "", *words_of(of)))
        for name in told:
            own = found[name][rig][1]
            apart = 100 * (own - of)[:, 1]
            to_recorder = 100 * ((own - of) - (found[name]["recorder"][1] - true["recorder"]))[:, 1]
            between = "" if rig == "recorder" else f"{rms(to_recorder):.1f}"
            radii = 100 * (own[:, 0] / of[:, 0] - 1)
            rows.append((rig, f"made, {name}", f"{rms(apart):.1f} / {rms(radii):.0f}", f"{worst(apart):+.1f}", between,
                         *words_of(own)))  # fmt: skip
    table(("rig", "world", "rms", "worst", "rms of the difference to the recorder", *places), rows)


def numbers(rigs, world, options):
    """Names of regions and bands, and (them, 2) radius and detection by area, of each rig."""
    result = evaluate(
        list(rigs.values()),
        str(world),
        steps=options.seconds + 1,
        every_s=1.0,
        seed=options.seed,
        rays=RAYS,
        vehicle=VEHICLE,
        cell_m=0.5,
    )
    found = {}
    for rig, rows in result.table.rows.items():
        places = [f"{row.region.name} {row.summary.height}" for row in rows]
        found[rig] = (
            places,
            np.array([[row.summary.numbers[key].value for key in ("radius_m", "detection_0.4m")] for row in rows]),
        )
    return found


def rms(numbers):
    return float(np.sqrt(np.nanmean(np.square(numbers))))


def worst(numbers):
    return float(numbers[np.nanargmax(np.abs(numbers))])


def words_of(rows):
    return [f"{100 * detection:.0f} % / {radius_m:.2f} m" for radius_m, detection in rows]


if __name__ == "__main__":
    main()
