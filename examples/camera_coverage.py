"""What goes wrong when a camera with a strong lens is idealised as a pinhole: `python examples/camera_coverage.py`.

Two cameras of the same intrinsics at one place look at the built-in courtyard: one through its calibrated lens, one
through a pinhole. The difference map shows where the idealised camera claims to see what the real one does not (its
pixels look elsewhere), and where the real one sees what the pinhole leaves out.

The calibration is that of a GoPro HERO4 Session (gyroflow/lens_profiles, CC0-1.0; an OpenCV fisheye fit).
`--calibrations FILE --camera ID` takes another from a JSON file:
{"cameras": [{id, model, width, height, fx, fy, cx, cy, params}, ...]}.
"""

import argparse
import json
from pathlib import Path

from rich.console import Console

from torchcover import BevGrid, CoverageMetric, Region, Rig
from torchcover.data import SimulatedFrames
from torchcover.evaluation import CoverageObserver, observe
from torchcover.report import CoverageTable, plot_maps, print_table, write_figures
from torchcover.simulation import CameraSensor, PaperReference

GOPRO = {
    "id": "gopro_hero4_session_4by3",
    "model": "kannala_brandt",
    "width": 1920,
    "height": 1440,
    "fx": 825.0542507786654,
    "fy": 824.9609160082778,
    "cx": 960.0,
    "cy": 720.0,
    "params": {
        "k1": 0.13786742975264668,
        "k2": -0.09192849226299545,
        "k3": 0.06348999695624412,
        "k4": -0.021031118756775557,
    },
}
REGIONS = (Region("10m ahead", (2.5, 12.5), (-10.0, 10.0)), Region("40m ahead", (2.5, 40.0), (-20.0, 20.0)))
GRID = BevGrid(x_m=(-10.0, 40.0), y_m=(-20.0, 20.0), cell_m=0.25)


def rig_of(name, calibration, lens):
    """A rig of one camera above the windscreen, looking slightly down."""
    width = calibration["width"]
    camera = CameraSensor(
        name="camera",
        mount={"x_m": 0.45, "z_m": 1.75, "pitch_deg": 15.0},
        width=width,
        height=calibration["height"],
        fx=calibration["fx"],
        fy=calibration["fy"],
        cx=calibration["cx"],
        cy=calibration["cy"],
        lens=lens,
        coefficients=() if lens == "pinhole" else tuple(calibration["params"].values()),
        stride=max(1, width // 480),
        max_range_m=100.0,
    )
    return Rig(name=name, sensors=(camera,))


def calibration_of(options):
    """The chosen calibration."""
    if options.calibrations is None:
        return GOPRO
    found = {entry["id"]: entry for entry in json.loads(options.calibrations.read_text())["cameras"]}
    if options.camera not in found:
        raise SystemExit(f"{options.calibrations} has no camera {options.camera!r}; there are {', '.join(found)}")
    return found[options.camera]


def main():
    """Compare the two cameras; print the table, draw the maps."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--calibrations", type=Path)
    parser.add_argument("--camera", default=GOPRO["id"])
    parser.add_argument("--num-frames", type=int, default=48)
    parser.add_argument("--out", type=Path, default=Path("out/camera_coverage"))
    options = parser.parse_args()

    calibration = calibration_of(options)
    rigs = {
        "real lens": rig_of("real lens", calibration, calibration["model"]),
        "pinhole": rig_of("pinhole", calibration, "pinhole"),
    }
    frames = SimulatedFrames(
        "courtyard",
        rigs=rigs,
        num_frames=options.num_frames,
        seed=0,
        reference_sensor=PaperReference(rows=512, columns=512),
    )
    observers = {name: CoverageObserver(CoverageMetric(GRID, max_radius_m=GRID.diagonal_m), name) for name in rigs}
    observe(frames, observers.values(), show_progress=True)
    coverages = {name: observer.compute() for name, observer in observers.items()}
    console = Console()
    print_table(CoverageTable.from_coverages(coverages, REGIONS), console)
    pictures = write_figures(plot_maps(coverages), options.out)
    console.print(f"Wrote {len(pictures)} maps to {options.out}")


if __name__ == "__main__":
    main()
