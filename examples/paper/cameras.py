"""Three cameras: blind spots within 10 m and 40 m, and Figure 2, one rig seen in four ways."""

import torch
from rich.console import Console

from examples.paper.four_views import draw_four_views
from examples.paper.measuring import Measurement
from torchcover import BevGrid, Region
from torchcover.evaluation import build_sensor_views
from torchcover.report import RENDERERS, CoverageTable, plot_maps, print_table, write_figures

RIG = "three_cameras"
GRID = BevGrid(x_m=(-40.0, 40.0), y_m=(-40.0, 40.0), cell_m=0.25)
REGIONS = (Region("10m around", (-10.0, 10.0), (-10.0, 10.0)), Region("40m around", (-40.0, 40.0), (-40.0, 40.0)))
# Figure 2 shows the part within 20 m.
NEARBY = BevGrid(x_m=(-20.0, 20.0), y_m=(-20.0, 20.0), cell_m=GRID.cell_m)
BLOCKS = 16  # for standard errors
# One band that holds every point of a rig.
ANY_HEIGHT = {"any": (-100.0, 100.0)}


def run(options):
    """Measure; print and write tables, coverages and maps, and draw the figure."""
    out = options.out / "cameras"
    measurement = Measurement({RIG: RIG}, GRID, REGIONS, options)
    points = PointCount()
    coverages = measurement.run(range(options.steps), blocks=BLOCKS, also=[points])
    views = build_sensor_views(measurement.frames.sensors[RIG])
    texts = []
    for (_, measure), coverage in coverages.items():
        table = CoverageTable.from_coverages({RIG: coverage}, REGIONS)
        print_table(table, Console())
        texts.append(RENDERERS["markdown"](table))
        figures = plot_maps({RIG: coverage}, ego_outline_m=measurement.frames.ego_outline_m, sensors={RIG: views})
        write_figures(figures, out / "maps" / measure)
        coverage.save(out / f"{RIG}_{measure}.npz")
    (out / "table.md").write_text("\n".join(texts), encoding="utf-8")
    near = Region("nearby", NEARBY.x_m, NEARBY.y_m).mask_cells(GRID)
    figure = draw_four_views(
        coverages[RIG, "known"].radius[:, near].reshape(NEARBY.shape),
        points.counts.reshape(GRID.shape[1:])[near].reshape(NEARBY.shape[1:]),
        NEARBY,
        steps=options.steps,
        title=f"{RIG}, four ways to look at it",
        ego_outline_m=measurement.frames.ego_outline_m,
        sensors=views,
    )
    figure.savefig(out / "figure_2.png", dpi=figure.dpi)


class PointCount:
    """How many points of the rig lie in each cell, at any height."""

    def __init__(self):
        self.grid = BevGrid(GRID.x_m, GRID.y_m, GRID.cell_m, ANY_HEIGHT)
        self.counts = torch.zeros(self.grid.num_cells, dtype=torch.int64)

    def update(self, frame):
        cells = self.grid.find_cells(frame.cloud_of(RIG))
        self.counts += torch.bincount(cells[cells >= 0], minlength=self.grid.num_cells)
