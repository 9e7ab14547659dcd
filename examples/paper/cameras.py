"""Three cameras: blind spots within 10 m and 40 m, and Figure 2, one rig in four views."""

import torch
from rich.console import Console

from examples.paper.four_views import plot_four_views
from examples.paper.measuring import Measurement
from torchcover import BevGrid, Region
from torchcover.evaluation import build_sensor_views
from torchcover.report import RENDERERS, CoverageTable, plot_maps, print_table, write_figures

RIG = "three_cameras"
GRID = BevGrid(x_m=(-40.0, 40.0), y_m=(-40.0, 40.0), cell_m=0.25)
REGIONS = (Region("10m around", (-10.0, 10.0), (-10.0, 10.0)), Region("40m around", (-40.0, 40.0), (-40.0, 40.0)))
FIGURE_GRID = BevGrid(x_m=(-20.0, 20.0), y_m=(-20.0, 20.0), cell_m=GRID.cell_m)  # Figure 2 shows a part of the grid


def run(options):
    """Measure the rig; print and write tables, coverages, maps and the figure.

    Args:
        options: Options of the command line.
    """
    out = options.out / "cameras"
    measurement = Measurement({RIG: RIG}, GRID, REGIONS, options)
    histogram = PointHistogram()
    # 16 blocks give standard errors.
    coverages = measurement.run(range(options.num_frames), num_blocks=16, observers=[histogram])
    views = build_sensor_views(measurement.frames.metadata.sensors[RIG])
    texts = []
    for (_, average), coverage in coverages.items():
        table = CoverageTable.from_coverages({RIG: coverage}, REGIONS)
        print_table(table, Console())
        texts.append(RENDERERS["markdown"](table))
        figures = plot_maps(
            {RIG: coverage}, ego_outline_m=measurement.frames.metadata.ego_outline_m, sensors={RIG: views}
        )
        write_figures(figures, out / "maps" / average)
        coverage.save(out / f"{RIG}_{average}.npz")
    (out / "table.md").write_text("\n".join(texts), encoding="utf-8")
    mask = Region("figure", FIGURE_GRID.x_m, FIGURE_GRID.y_m).mask_cells(GRID)
    figure = plot_four_views(
        coverages[RIG, "cells"].radius[:, mask].reshape(FIGURE_GRID.shape),
        histogram.counts.reshape(GRID.shape[1:])[mask].reshape(FIGURE_GRID.shape[1:]),
        FIGURE_GRID,
        num_frames=options.num_frames,
        title=f"Four views of {RIG}",
        ego_outline_m=measurement.frames.metadata.ego_outline_m,
        sensors=views,
    )
    figure.savefig(out / "figure_2.png", dpi=figure.dpi)


class PointHistogram:
    """Number of points of the rig in each cell, at any height."""

    def __init__(self):
        self.grid = BevGrid(GRID.x_m, GRID.y_m, GRID.cell_m, {"any": (-100.0, 100.0)})
        self.counts = torch.zeros(self.grid.num_cells, dtype=torch.int64)

    def update(self, frame):
        """Add the points of a frame."""
        cells = self.grid.find_cells(frame.get_cloud(RIG))
        self.counts += torch.bincount(cells[cells >= 0], minlength=self.grid.num_cells)
