"""Effect of a lens model on coverage: `python examples/camera_coverage.py`.

Two cameras with the same intrinsics and extrinsics observe the built-in courtyard, one with its calibrated distortion
and one as a pinhole camera. The difference map shows where the pinhole camera detects surfaces that the real one does
not, because its pixels have other directions, and vice versa.

The calibration is that of a GoPro HERO4 Session (gyroflow/lens_profiles, CC0-1.0; an OpenCV fisheye fit).
`--calibrations FILE --camera ID` reads another one from a JSON file:
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


def build_rig(name, calibration, lens):
    """Build a rig with one camera above the windshield, pitched down by 15 degrees."""
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


def load_calibration(options):
    """Load the calibration of the options."""
    if options.calibrations is None:
        return GOPRO
    cameras = {camera["id"]: camera for camera in json.loads(options.calibrations.read_text())["cameras"]}
    if options.camera not in cameras:
        raise SystemExit(f"{options.calibrations}: unknown camera {options.camera!r}; choose from {', '.join(cameras)}")
    return cameras[options.camera]


def main():
    """Compare the two cameras: print the table and plot the maps."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--calibrations", type=Path)
    parser.add_argument("--camera", default=GOPRO["id"])
    parser.add_argument("--num-frames", type=int, default=48)
    parser.add_argument("--out", type=Path, default=Path("out/camera_coverage"))
    options = parser.parse_args()

    calibration = load_calibration(options)
    rigs = {
        "real lens": build_rig("real lens", calibration, calibration["model"]),
        "pinhole": build_rig("pinhole", calibration, "pinhole"),
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
    paths = write_figures(plot_maps(coverages), options.out)
    console.print(f"Wrote {len(paths)} maps to {options.out}")


if __name__ == "__main__":
    main()
