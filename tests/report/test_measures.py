"""What the numbers are means over: the known cells, or the surface that the reference sees."""

import csv
import io
import json

import pytest
import torch

from torchcover.coverage import BevGrid, Coverage, CoverageMetric, Region
from torchcover.report import (
    RENDERERS,
    CoverageTable,
    build_page_tables,
    collect_table_notes,
    list_notes,
    plot_band_maps,
    plot_maps,
)
from torchcover.report.records import COLUMNS, build_records

KEYS = ("radius_m", "detection_0.4m")
SURFACE = "Numbers are means over the surface area that the reference observes."
CELLS = "Numbers are means over observed cells only"
WALL = Region("wall", (0.0, 2.0), (0.0, 1.0))
NOTHING = Region("nothing", (2.0, 3.0), (0.0, 1.0))


@pytest.fixture
def table(surface_pair, regions):
    """Of the surface."""
    return CoverageTable.from_coverages(surface_pair, regions)


def two_cells() -> Coverage:
    """3 m2 at a radius of 0 and 1 m2 at one of 1 m, in cells of their own; then a step of nothing."""
    grid = BevGrid(x_m=(0.0, 3.0), y_m=(0.0, 1.0), cell_m=1.0, heights={"all": (-1.0, 1.0)})
    metric = CoverageMetric(grid, has_area_weights=True)
    reference = torch.tensor([[0.5, 0.5, 0.0], [1.5, 0.5, 0.0]])
    metric.update(reference[:1], reference, weights=torch.tensor([3.0, 1.0]))
    metric.update(reference[:1], torch.zeros(0, 3), weights=torch.zeros(0))
    return metric.compute()


def records(table: CoverageTable) -> list[dict]:
    return json.loads(RENDERERS["json"](table))["rows"]


def header(table: CoverageTable) -> list[str]:
    return next(csv.reader(io.StringIO(RENDERERS["csv"](table))))


def test_row_has_mean_and_visible_area():
    (part,) = build_page_tables(CoverageTable.from_coverages({"rig": two_cells()}, [WALL, NOTHING]))
    wall, nothing = [[cell.text for cell in row] for row in part.rows]
    assert wall[:4] == ["wall", "all", "0.25", "75.0"]
    assert nothing[:4] == ["nothing", "all", "unknown", "unknown"]
    surface = part.headings.index("visible surface\n(m2)")
    assert (wall[surface], nothing[surface]) == ("2.0", "0")


@pytest.mark.parametrize("measure", ["area", "cells"])
def test_column_titles_match_file_keys(measure, table, trio, regions):
    table = table if measure == "area" else CoverageTable.from_coverages({"few": trio["few"]}, regions)
    assert len({column.key for column in COLUMNS}) == len(COLUMNS)
    assert {column.key for column in COLUMNS} <= set(header(table))
    shown = [column for column in COLUMNS if column.heading and column.average in (None, measure)]
    part, own = build_page_tables(table)[0], build_records(table)
    assert list(part.headings[-len(shown) :]) == [column.heading for column in shown]
    for column in shown:
        cells = [row[part.headings.index(column.heading)].text for row in part.rows]
        assert cells == [column.format_value(record[column.key]) for record in own[: len(cells)]]


def test_files_have_both_measures_each_under_its_name():
    wall, nothing = records(CoverageTable.from_coverages({"rig": two_cells()}, [WALL, NOTHING]))
    assert (wall["average"], wall["visible_m2"], nothing["visible_m2"]) == ("area", 2.0, 0.0)
    assert (wall["radius_m"], wall["cells_radius_m"]) == (0.25, 0.5)
    assert (wall["detection_0.4m"], wall["cells_detection_0.4m"]) == (0.75, 0.5)
    assert (nothing["radius_m"], nothing["cells_radius_m"]) == (None, None)


@pytest.mark.parametrize("band_frame", ["ground", "vehicle"])
def test_file_rows_name_the_band_frame(band_frame):
    grid = BevGrid(x_m=(0.0, 4.0), y_m=(0.0, 2.0), cell_m=1.0, band_frame=band_frame)
    metric, point = CoverageMetric(grid), torch.tensor([[0.5, 0.5, 0.0]])
    metric.update(point, point, heights_m=torch.zeros(1) if band_frame == "ground" else None)
    table = CoverageTable.from_coverages({"rig": metric.compute()}, [Region("all", grid.x_m, grid.y_m)])
    assert {row["band_frame"] for row in csv.DictReader(io.StringIO(RENDERERS["csv"](table)))} == {band_frame}


def test_records_are_those_of_the_summary(table, surface_pair, regions):
    rows = [row for coverage in surface_pair.values() for row in coverage.summary(regions)]
    for record, row in zip(records(table), rows, strict=True):
        for key in KEYS if row.observed_cells else ():
            assert tuple(record[f"{key}{end}"] for end in ("", "_error", "_low", "_high")) == row.numbers[key][1:5]
            assert (
                tuple(record[f"cells_{key}{end}"] for end in ("", "_error", "_low", "_high"))
                == row.cell_averages[key][1:5]
            )
            assert record[key] != record[f"cells_{key}"]


def test_area_averages_add_only_cell_averages(table, trio, regions):
    known = CoverageTable.from_coverages({name: trio[name] for name in table.rigs}, regions)
    more = {f"cells_{key}{end}" for key in KEYS for end in ("", "_error", "_low", "_high")}
    assert [name for name in header(table) if name not in more] == header(known)
    assert set(header(table)) - set(header(known)) == more


@pytest.mark.parametrize("name", ["text", "markdown"])
def test_readers_are_told_which_measure_it_is(name, table, trio, regions):
    surface, known = RENDERERS[name](table), RENDERERS[name](CoverageTable.from_coverages(trio, regions))
    surface, known = (" ".join(text.split()) for text in (surface, known))  # long notes are wrapped
    assert (SURFACE in surface, CELLS in surface, SURFACE in known, CELLS in known) == (True, False, False, True)
    assert ("visible surface" in surface, "observed cells" in known) == (True, True)


def test_without_a_region_no_measure_is_told(surface_pair):
    table = CoverageTable.from_coverages(surface_pair, ())
    assert {remark.name for remark in collect_table_notes(table, "few")} >= {"no_region"}
    assert SURFACE not in RENDERERS["text"](table)


def test_common_reference_note_names_the_average(table, trio, regions):
    surface, known = list_notes(table)[0], list_notes(CoverageTable.from_coverages(trio, regions))[0]
    assert surface.endswith("so that the visible surface is the same.")
    assert known.endswith("so that the same cells are observed.")


def test_maps_follow_the_average():
    figures = dict(plot_maps({"rig": two_cells()}))
    assert list(figures) == ["radius_area_m_all", "detection_area_0.4m_all"]
    for figure in figures.values():
        (legend,) = [axes.get_legend() for axes in figure.axes if axes.get_legend()]
        assert [text.get_text() for text in legend.get_texts()] == [
            "no visible surface (0 % of the cells)",  # the third one is outside what is shown
            "paler: less visible surface per frame than open ground",
        ]
    title, conditions = (text.get_text() for text in figures["radius_area_m_all"].axes[0].texts)
    assert title == "Mean blind spot radius, by area, all"
    assert conditions == "z -1 to 1 m; 2 frames, cells of 1 m, larger where points are few"
    assert figures["detection_area_0.4m_all"].axes[1].get_ylabel() == "detection within 0.4 m, by area (%)"


def test_band_maps_follow_the_average():
    assert [name for name, _ in plot_band_maps(two_cells())] == ["radius_area_m", "detection_area_0.4m"]
