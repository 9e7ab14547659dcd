"""The experiments of "Can You See Me Now?": `python -m examples.paper [experiment ...] --num-frames 256`.

tables       one LiDAR in the grille or on the roof, with 32, 64 or 128 rows: Tables 1 and 2, beside the paper's numbers
cameras      three cameras: blind spots within 10 m and 40 m, and Figure 2

Everything is measured twice at the same instants: over known cells with the paper's rays, and over the visible square
metres with points on the surface. Tables are measured in pieces, each of which is written when it is complete: after
an interruption, or with more steps, only the missing ones are measured.
"""

import argparse
from pathlib import Path

from examples.paper import cameras, tables

STRAIGHT = Path(__file__).with_name("straight.yaml")
EXPERIMENTS = {"tables": tables.run, "cameras": cameras.run}


def main():
    """Read the options and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "experiments", nargs="*", metavar="experiment", help=f"of {', '.join(EXPERIMENTS)}; all if none"
    )
    parser.add_argument("--num-frames", type=int, default=256)
    parser.add_argument("--piece", type=int, default=16, help="steps in a piece; from 8 pieces on there are errors")
    parser.add_argument("--every", type=float, default=2.0, help="seconds between steps")
    parser.add_argument("--num-rays", type=int, default=1024 * 1024, help="of the paper's reference at each step")
    parser.add_argument("--reference-range", type=float, default=250.0, help="of both references, in metres")
    parser.add_argument("--ego-points", action="store_true", help="the paper's reference keeps its points on the ego")
    parser.add_argument(
        "--origin", type=float, default=0.0, help="where x begins: 0 is the ego's centre, -1.36 its rear axle"
    )
    parser.add_argument(
        "--rigs",
        nargs="+",
        default=["front_{}", "paper_fit_{}"],
        help="sets of LiDARs: names or YAML files, {} for each of grille_128, roof_128, roof_64, roof_32",
    )
    parser.add_argument("--scenario", default=str(STRAIGHT), help="name or YAML file; a straight city if not given")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/paper"))
    options = parser.parse_args()
    if unknown := set(options.experiments) - set(EXPERIMENTS):
        parser.error(f"no experiment {', '.join(sorted(unknown))}; there are {', '.join(EXPERIMENTS)}")
    if options.piece < 1 or options.steps < 1 or options.steps % options.piece:
        parser.error(f"steps: a multiple of the piece of {options.piece} is needed; got {options.steps}")
    if same := [pattern for pattern in options.rigs if "{}" not in pattern]:
        parser.error(f"rigs: {{}} must stand where the LiDARs differ; got {', '.join(same)}")
    try:
        for name in dict.fromkeys(options.experiments) or EXPERIMENTS:
            EXPERIMENTS[name](options)
    except (ValueError, FileNotFoundError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
