"""How far are numbers in the world that is made of a drive from those in the world that was driven through?

A drive is simulated, recorded by one LiDAR, and made a world: once with its labels, once without. The rig that recorded
it and others are measured at the same instants there and in the true one.
"""

import argparse
import tempfile
from pathlib import Path
from shutil import rmtree

import numpy as np

from benchmarks.accumulated_reference import words
from benchmarks.recorded_measure import distance
from benchmarks.timing import table
from torchcover import evaluate, forward_regions
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
    for name, made in told.items():
        print(f"{name}: {made}")
    print()
    places, rows = [f"{region.name} {height}" for region in forward_regions() for height in ("ground", "obstacle")], []
    for rig in rigs:
        own = {name: of[rig] for name, of in found.items()}
        rows.append((rig, "the true one", "", "", "", *words(own["true"])))
        for name in told:
            apart = [100 * (found[name][of] - found["true"][of])[:, 1] for of in (rig, "recorder")]
            between = "" if rig == "recorder" else f"{np.sqrt(np.nanmean((apart[0] - apart[1]) ** 2)):.1f}"
            rows.append((rig, f"made, {name}", *distance(own[name], own["true"]), between, *words(own[name])))
    table(("rig", "world", "rms", "worst", "rms of the difference to the recorder", *places), rows)


def numbers(rigs, world, options):
    """Radius and detection by area of each rig, over the forward regions and bands."""
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
    asked = [region.name for region in forward_regions()]
    return {
        rig: np.array(
            [
                [row.summary.numbers[key].value for key in ("radius_m", "detection_0.4m")]
                for row in rows
                if row.region.name in asked
            ]
        )
        for rig, rows in result.table.rows.items()
    }


if __name__ == "__main__":
    main()
