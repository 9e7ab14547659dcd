"""The experiments of "Can You See Me Now?": `python -m examples.paper [experiment ...] --steps 256`.

cameras      three cameras: blind spots within 10 m, and detection of an object of 0.4 m close and far
mounting     one LiDAR in the grille or on the roof: the 12 rows of the paper's Table 1
resolution   32, 64 or 128 rows on the roof: the 12 rows of Table 2
"""

import argparse
import json
import time
from pathlib import Path

from rich.console import Console

from examples.paper.paired import coverage_of
from torchcover import BevGrid, Region, forward_regions
from torchcover.report import comparison_tables, draw_comparison, summary_dict

FORWARD = BevGrid(x=(0.0, 160.0), y=(-40.0, 40.0), cell=0.25)
AROUND = BevGrid(x=(-40.0, 40.0), y=(-40.0, 40.0), cell=0.25)
CLOSE_AND_FAR = (Region("10m around", (-10.0, 10.0), (-10.0, 10.0)), Region("40m around", (-40.0, 40.0), (-40.0, 40.0)))

EXPERIMENTS = {
    "cameras": (("three_cameras",), AROUND, CLOSE_AND_FAR),
    "mounting": (("front_grille_128", "front_roof_128"), FORWARD, forward_regions()),
    "resolution": (("front_roof_32", "front_roof_64", "front_roof_128"), FORWARD, forward_regions()),
}


def run(name, options):
    """One experiment: tables on the terminal; maps, coverage and numbers in its folder."""
    rigs, grid, regions = EXPERIMENTS[name]
    out = options.out / name
    out.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    coverages = coverage_of(rigs, grid, options)
    seconds = time.perf_counter() - start
    console = Console()
    console.rule(name)
    for table in comparison_tables(coverages, regions):
        console.print(table)
    for rig, coverage in coverages.items():
        coverage.save(out / f"{rig}.npz")
    draw_comparison(coverages, out / "maps")
    numbers = {rig: summary_dict(coverage, regions) for rig, coverage in coverages.items()}
    conditions = {key: str(value) if isinstance(value, Path) else value for key, value in vars(options).items()}
    text = json.dumps({"seconds": round(seconds), "options": conditions, "rigs": numbers}, indent=2)
    (out / "summary.json").write_text(text + "\n", encoding="utf-8")
    console.print(f"{seconds:.0f} s; wrote {out}")


def main():
    """Read the options and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = ", ".join(EXPERIMENTS)
    parser.add_argument("experiments", nargs="*", metavar="experiment", help=f"of {names}; all if none is given")
    parser.add_argument("--steps", type=int, default=4096)
    parser.add_argument("--rays", type=int, default=1024, help="rows, and columns, of the reference sensor")
    parser.add_argument("--scenario", default="urban")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/paper"))
    options = parser.parse_args()
    unknown = set(options.experiments) - set(EXPERIMENTS)
    if unknown:
        parser.error(f"no experiment {', '.join(sorted(unknown))}; there are {names}")
    for name in options.experiments or EXPERIMENTS:
        run(name, options)


if __name__ == "__main__":
    main()
