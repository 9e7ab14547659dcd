"""The experiments of "Can You See Me Now?": `python -m examples.paper [experiment ...] --num-frames 256`.

tables       one LiDAR in the grille or on the roof, with 32, 64 or 128 rows: Tables 1 and 2 with the paper's numbers
cameras      three cameras: blind spots within 10 m and 40 m, and Figure 2

Each frame is measured twice: averages over cells with the rays of the paper, and averages over the visible area with
points on the surface. Tables are measured in pieces that are written when they are complete: a run that was
interrupted, or that gets more frames, measures only the missing pieces.
"""

import argparse
from pathlib import Path

from examples.paper import cameras, tables

EXPERIMENTS = {"tables": tables.run, "cameras": cameras.run}


def main():
    """Parse the options and run the experiments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = ", ".join(EXPERIMENTS)
    parser.add_argument("experiments", nargs="*", metavar="experiment", help=f"{names}; all by default")
    parser.add_argument("--num-frames", type=int, default=256)
    parser.add_argument("--piece", type=int, default=16, help="frames per piece; 8 pieces give standard errors")
    parser.add_argument("--frame-interval-s", type=float, default=2.0, help="seconds between frames")
    parser.add_argument("--num-rays", type=int, default=1024 * 1024, help="of the paper's reference sensor, per frame")
    parser.add_argument("--reference-range", type=float, default=250.0, help="of both reference sensors, in meters")
    parser.add_argument("--ego-points", action="store_true", help="keep reference points on the ego vehicle")
    parser.add_argument(
        "--origin",
        type=float,
        default=0.0,
        help="x of the regions: 0 for the center of the ego, -1.36 for its rear axle",
    )
    parser.add_argument(
        "--rigs",
        nargs="+",
        default=["front_{}", "paper_fit_{}"],
        help="sets of LiDARs: names or YAML files, with {} for each of grille_128, roof_128, roof_64, roof_32",
    )
    straight = Path(__file__).with_name("straight.yaml")
    parser.add_argument("--scenario", default=str(straight), help="name or YAML file; a straight city by default")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/paper"))
    options = parser.parse_args()
    if unknown := set(options.experiments) - set(EXPERIMENTS):
        parser.error(f"unknown experiment {', '.join(sorted(unknown))}; use {names}")
    if options.piece < 1 or options.num_frames < 1 or options.num_frames % options.piece:
        parser.error(f"--num-frames: got {options.num_frames}; give a multiple of the piece of {options.piece}")
    for pattern in options.rigs:
        if "{}" not in pattern:
            parser.error(f"--rigs: got {pattern}; put {{}} in place of the name of the LiDAR")
    try:
        for name in dict.fromkeys(options.experiments) or EXPERIMENTS:
            EXPERIMENTS[name](options)
    except (ValueError, FileNotFoundError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
