"""Tables 1 and 2: one LiDAR in the grille or on the roof, with 32, 64 or 128 rows, measured in pieces."""

import json

from examples.paper.comparison import AVERAGE_TITLES, build_records, extract_numbers, format_markdown
from examples.paper.measuring import Measurement
from examples.paper.pieces import check_conditions, load_merged, save_piece
from examples.paper.published import LIDARS
from torchcover import BevGrid, Region, forward_regions
from torchcover.evaluation import build_sensor_views
from torchcover.report import plot_maps, write_figures

# Pieces can be merged if these options agree.
CONDITIONS = (
    "rigs",
    "scenario",
    "seed",
    "frame_interval_s",
    "piece",
    "num_rays",
    "reference_range",
    "ego_points",
    "origin",
)
MAPPED_LIDARS = ("grille_128", "roof_128")


def run(options):
    """Measure the missing pieces; print and write the tables and maps of all pieces.

    Args:
        options: Options of the command line.
    """
    rig_sets = {pattern: {lidar: pattern.replace("{}", lidar) for lidar in LIDARS} for pattern in options.rigs}
    x0_m = options.origin
    grid = BevGrid(x_m=(x0_m, x0_m + 160.0), y_m=(-40.0, 40.0), cell_m=0.25)
    regions = [Region(region.name, (x0_m, x0_m + region.x_m[1]), region.y_m) for region in forward_regions()]
    rigs = {}
    for rig_set in rig_sets.values():
        rigs |= {rig: rig for rig in rig_set.values()}
    measurement = Measurement(rigs, grid, regions, options)
    pieces = measure_pieces(measurement, options)
    results = {}
    for pattern, rig_set in rig_sets.items():
        for average in AVERAGE_TITLES:
            for count in list_piece_counts(len(pieces)):
                coverages = {lidar: load_merged(pieces[:count], rig, average) for lidar, rig in rig_set.items()}
                results[pattern, average, count * options.piece] = extract_numbers(coverages, regions)
    text = format_markdown(results)
    print(text)
    (options.out / "tables.md").write_text(text, encoding="utf-8")
    record = {"options": {name: getattr(options, name) for name in CONDITIONS}, "results": build_records(results)}
    (options.out / "tables.json").write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    for rig_set in rig_sets.values():
        coverages = {rig_set[lidar]: load_merged(pieces, rig_set[lidar], "cells") for lidar in MAPPED_LIDARS}
        sensors = {rig: build_sensor_views(measurement.frames.metadata.sensors[rig]) for rig in coverages}
        figures = plot_maps(coverages, ego_outline_m=measurement.frames.metadata.ego_outline_m, sensors=sensors)
        write_figures(figures, options.out / "maps" / "_".join(coverages).replace("/", "-"))


def measure_pieces(measurement, options):
    """Measure the missing pieces.

    Args:
        measurement: `Measurement` of the rigs.
        options: Options of the command line.

    Returns:
        Folders of all pieces.
    """
    pieces = options.out / "pieces"
    check_conditions(pieces, {name: getattr(options, name) for name in CONDITIONS})
    folders = []
    for first in range(0, options.num_frames, options.piece):
        folder = pieces / f"{first:05d}"
        if not folder.is_dir():
            save_piece(folder, measurement.run(range(first, first + options.piece)))
        folders.append(folder)
    return folders


def list_piece_counts(num_pieces):
    """List numbers of pieces for which scores are reported: 1, 4, 16 and so on, and all.

    Args:
        num_pieces: Number of all pieces.
    """
    counts = [4**exponent for exponent in range(num_pieces.bit_length())]
    return [count for count in counts if count < num_pieces] + [num_pieces]
