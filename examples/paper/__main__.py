"""The experiments of "Can You See Me Now?": `python -m examples.paper [experiment ...] --steps 256`.

cameras      three cameras: blind spots within 10 m, and detection of an object of 0.4 m close and far
mounting     one LiDAR in the grille or on the roof: the 12 rows of the paper's Table 1
resolution   32, 64 or 128 rows on the roof: the 12 rows of Table 2
figure       Figure 2: one rig as sectors, as a histogram of its points, and as radius maps

All that are asked for share one pass over the scenario: the reference is cast once a step, each rig too. A folder for
each gets table.md, summary.json, the coverage and the maps.
"""

import argparse
import json
from pathlib import Path
from typing import NamedTuple

from rich.console import Console

from examples.paper.one_pass import one_pass
from examples.paper.published import with_published
from torchcover import BevGrid, Region, forward_regions
from torchcover.report import CoverageTable, draw_four_views, map_figures, print_table, table_dict, write_figures

FORWARD = BevGrid(x=(0.0, 160.0), y=(-40.0, 40.0), cell=0.25)
AROUND = BevGrid(x=(-40.0, 40.0), y=(-40.0, 40.0), cell=0.25)
CLOSE_AND_FAR = (Region("10m around", (-10.0, 10.0), (-10.0, 10.0)), Region("40m around", (-40.0, 40.0), (-40.0, 40.0)))


class Experiment(NamedTuple):
    """Which rigs are measured where."""

    rigs: tuple[str, ...]
    grid: BevGrid
    regions: tuple[Region, ...]


EXPERIMENTS = {
    "cameras": Experiment(("three_cameras",), AROUND, CLOSE_AND_FAR),
    "mounting": Experiment(("front_grille_128", "front_roof_128"), FORWARD, forward_regions()),
    "resolution": Experiment(("front_roof_32", "front_roof_64", "front_roof_128"), FORWARD, forward_regions()),
}
# Figure 2 shows the part within 20 m of what the first experiment measures.
FIGURE = ("three_cameras", AROUND)
NEARBY = BevGrid(x=(-20.0, 20.0), y=(-20.0, 20.0), cell=AROUND.cell)
NAMES = (*EXPERIMENTS, "figure")


def run(names, options):
    """One pass, and what each experiment says of it."""
    measured = [
        (rig, EXPERIMENTS[name].grid) for name in names if name in EXPERIMENTS for rig in EXPERIMENTS[name].rigs
    ]
    counted = [FIGURE] if "figure" in names else []
    wanted = [region for name in names for region in EXPERIMENTS.get(name, EXPERIMENTS["cameras"]).regions]
    done = one_pass(measured + counted, counted, wanted, options)
    for name in names:
        out = options.out / name
        out.mkdir(parents=True, exist_ok=True)
        if name == "figure":
            draw_figure(done, options, out)
        else:
            report(name, done, options, out)
    Console().print(f"{done.seconds:.0f} s for {options.steps} steps of {', '.join(names)}; wrote {options.out}")


def report(name, done, options, out):
    """Tables on the terminal; maps, coverage and numbers in the folder of the experiment."""
    rigs, grid, regions = EXPERIMENTS[name]
    coverages = {rig: done.coverages[rig, grid] for rig in rigs}
    table = CoverageTable.of(coverages, regions)
    console = Console()
    console.rule(name)
    print_table(table, console)
    write_figures(map_figures(coverages, ego_outline_m=done.ego_outline_m, sensors=done.sensors), out / "maps")
    (out / "table.md").write_text(with_published(name, table), encoding="utf-8")
    for rig, coverage in coverages.items():
        coverage.save(out / f"{rig}.npz")
    conditions = {key: str(value) if isinstance(value, Path) else value for key, value in vars(options).items()}
    text = json.dumps({"seconds": round(done.seconds), "options": conditions, **table_dict(table)}, indent=2)
    (out / "summary.json").write_text(text + "\n", encoding="utf-8")


def draw_figure(done, options, out):
    """Figure 2."""
    rig, grid = FIGURE
    near = Region("nearby", NEARBY.x, NEARBY.y).mask(grid)
    figure = draw_four_views(
        done.coverages[FIGURE].radius[:, near].reshape(NEARBY.shape),
        done.points[FIGURE][near].reshape(NEARBY.shape[1:]),
        NEARBY,
        steps=options.steps,
        title=f"{rig}, four ways to look at it",
        ego_outline_m=done.ego_outline_m,
        sensors=done.sensors[rig],
    )
    figure.savefig(out / "figure_2.png", dpi=figure.dpi)


def main():
    """Read the options and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "experiments", nargs="*", metavar="experiment", help=f"of {', '.join(NAMES)}; all if none is given"
    )
    parser.add_argument("--steps", type=int, default=4096)
    parser.add_argument(
        "--every", type=float, default=2.0, help="seconds between steps; the scenario's own step is 0.1"
    )
    parser.add_argument(
        "--reference", choices=("even", "paper"), default="even", help="pattern of the reference sensor"
    )
    parser.add_argument("--rays", type=int, default=16_384, help="its rays at each step (the paper's: 1048576)")
    parser.add_argument("--scenario", default="urban")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/paper"))
    options = parser.parse_args()
    unknown = set(options.experiments) - set(NAMES)
    if unknown:
        parser.error(f"no experiment {', '.join(sorted(unknown))}; there are {', '.join(NAMES)}")
    run(tuple(dict.fromkeys(options.experiments)) or NAMES, options)


if __name__ == "__main__":
    main()
