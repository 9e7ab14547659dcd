"""Tables 1 and 2: one LiDAR in the grille or on the roof, with 32, 64 or 128 rows, measured in pieces."""

import json

from examples.paper.comparison import as_markdown, as_records, numbers_of
from examples.paper.measuring import Measurement
from examples.paper.pieces import check_conditions, load_merged, save_piece
from examples.paper.published import LIDARS
from torchcover import BevGrid, Region, forward_regions
from torchcover.evaluation import build_sensor_views
from torchcover.report import plot_maps, write_figures

MEASURES = ("known", "area")
# Pieces are of one run if these options agree; there may be more pieces, or fewer.
CONDITIONS = ("rigs", "scenario", "seed", "every", "piece", "rays", "reference_range", "ego_points", "origin")
MAPPED = ("grille_128", "roof_128")


def run(options):
    """Measure the pieces that are missing; print and write what all of them say."""
    sets = {pattern: {lidar: pattern.replace("{}", lidar) for lidar in LIDARS} for pattern in options.rigs}
    x0_m = options.origin
    grid = BevGrid(x_m=(x0_m, x0_m + 160.0), y_m=(-40.0, 40.0), cell_m=0.25)
    regions = [Region(each.name, (x0_m, x0_m + each.x_m[1]), each.y_m) for each in forward_regions()]
    measurement = Measurement({rig: rig for rigs in sets.values() for rig in rigs.values()}, grid, regions, options)
    pieces = measured_pieces(measurement, options)
    results = {
        (pattern, measure, count * options.piece): numbers_of(
            {lidar: load_merged(pieces[:count], rig, measure) for lidar, rig in rigs.items()}, regions
        )
        for pattern, rigs in sets.items()
        for measure in MEASURES
        for count in growing(len(pieces))
    }
    text = as_markdown(results)
    print(text)
    (options.out / "tables.md").write_text(text, encoding="utf-8")
    records = {"options": {name: getattr(options, name) for name in CONDITIONS}, "results": as_records(results)}
    (options.out / "tables.json").write_text(json.dumps(records, indent=2) + "\n", encoding="utf-8")
    for rigs in sets.values():
        coverages = {rigs[lidar]: load_merged(pieces, rigs[lidar], "known") for lidar in MAPPED}
        sensors = {rig: build_sensor_views(measurement.frames.sensors[rig]) for rig in coverages}
        figures = plot_maps(coverages, ego_outline_m=measurement.frames.ego_outline_m, sensors=sensors)
        write_figures(figures, options.out / "maps" / "_".join(coverages).replace("/", "-"))


def measured_pieces(measurement, options):
    """The folders of all pieces, once each of them is there."""
    pieces = options.out / "pieces"
    check_conditions(pieces, {name: getattr(options, name) for name in CONDITIONS})
    folders = [pieces / f"{first:05d}" for first in range(0, options.steps, options.piece)]
    for folder in folders:
        if not folder.is_dir():
            first = int(folder.name)
            save_piece(folder, measurement.run(range(first, first + options.piece)))
    return folders


def growing(pieces):
    """How many of the first pieces a score is given for: four times as many each time, then all."""
    counts = [4**k for k in range(pieces.bit_length())]
    return [count for count in counts if count < pieces] + [pieces]
