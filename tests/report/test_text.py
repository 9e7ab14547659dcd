"""Tables on a terminal: their words, their marks, and how narrow they may be."""

import io
import re

import pytest
import torch
from rich.console import Console

from torchcover.coverage import BevGrid, Coverage, CoverageMetric, Region
from torchcover.report import CoverageTable, PageTable, TextCell, print_page_tables, print_table
from torchcover.report.records import COLUMNS
from torchcover.report.renderers import build_rich_tables, compute_min_width

NEAR = Region("near", x_m=(0.0, 2.0), y_m=(0.0, 2.0))
FAR = Region("far", x_m=(2.0, 4.0), y_m=(0.0, 2.0))
ORIGIN = torch.zeros(1, 3)


@pytest.fixture(autouse=True)
def no_other_columns(monkeypatch):
    """But how much the numbers are means over: rows are as these tests say whatever else the table has."""
    kept = tuple(column for column in COLUMNS if column.key in ("visible_m2", "observed_share"))
    monkeypatch.setattr("torchcover.report.table_layout.COLUMNS", kept)


def metric(thresholds_m=(0.4, 1.0), **options) -> CoverageMetric:
    grid = BevGrid(x_m=(0.0, 4.0), y_m=(0.0, 2.0), cell_m=1.0, heights={"ground": (-0.5, 0.5)})
    return CoverageMetric(grid, thresholds_m=thresholds_m, **options)


def one_cell_known() -> Coverage:
    """One of the four near cells: radii 0.2 and 0.6, so mean 0.4, half of them within 0.4 m. No far cell."""
    coverage = metric()
    coverage.update(ORIGIN, torch.tensor([[0.2, 0.0, 0.0], [0.6, 0.0, 0.0]]))
    return coverage.compute()


def over_steps(steps: int) -> Coverage:
    """A point with a radius of its own in every step, and so in every cell."""
    coverage = metric(num_blocks=16)
    radii = torch.rand(steps, generator=torch.Generator().manual_seed(0))
    for index, radius in enumerate(radii):
        place = torch.tensor([[0.5 + index % 2, 0.5 + index // 2 % 2, 0.0]])
        coverage.update(place - torch.tensor([0.0, 0.0, float(radius)]), place, block_index=index)
    return coverage.compute()


def printed(coverages: dict[str, Coverage], regions, width=200, *, terminal=True) -> str:
    console = Console(width=width, file=io.StringIO(), force_terminal=terminal, color_system=None)
    print_table(CoverageTable.from_coverages(coverages, regions), console)
    return re.sub(r"\x1b\[[\d;]*m", "", console.file.getvalue())


def text_of(coverage: Coverage, *regions: Region) -> str:
    return printed({"rig": coverage}, regions, 140)


def cells_of(text: str, region: str) -> list[str]:
    (line,) = [line for line in text.splitlines() if line.startswith(f"│ {region} ")]
    return [cell.strip() for cell in line.strip("│").split("│")]


def test_row_shows_meters_percent_and_observed_share():
    assert cells_of(text_of(one_cell_known(), NEAR, FAR), "near") == ["near", "ground", "0.40", "50.0", "100", "25.0"]


def test_an_unknown_number_is_called_unknown():
    text = text_of(one_cell_known(), NEAR, FAR)
    assert cells_of(text, "far") == ["far", "ground", "unknown", "unknown", "unknown", "0"]
    assert "nan" not in text.lower()


def test_units_cell_size_steps_and_bands_are_told():
    text = text_of(one_cell_known(), NEAR)
    head = text[: text.index("near")]
    assert (head.count("(m)"), head.count("(%)")) == (1, 3)
    for words in ("0.4 m (%)", "1 m (%)", "1 frame, cells of 1 m", "ground z -0.5 to 0.5 m"):
        assert words in text


def test_trouble_is_told_in_words_with_its_count():
    coverage = metric(thresholds_m=(0.4,), max_radius_m=0.5)
    reference = torch.tensor([[0.2, 0.0, 0.0], [0.6, 0.0, 0.0], [-9.0, 0.0, 0.0]])
    coverage.update([ORIGIN, torch.zeros(0, 3), ORIGIN], [reference, reference, torch.zeros(0, 3)])
    text = " ".join(text_of(coverage.compute(), NEAR).split())
    assert "1 of 3 frames had no sensor points" in text
    assert "1 of 3 frames had no reference points" in text
    assert "3 of 4 reference points have no sensor point nearby; their radius is set to the maximum of 0.5 m." in text
    assert "2 of 6 reference points outside the grid are excluded." in text
    assert "z = 0" not in text


def test_a_reference_that_lies_elsewhere_is_doubted():
    coverage = metric()
    coverage.update(ORIGIN, torch.tensor([[0.2, 0.0, 0.0], *[[0.5, 0.5, -1.7]] * 9]))
    assert "9 of 10 reference points outside the grid are excluded. Check that z = 0" in text_of(
        coverage.compute(), NEAR
    )


def test_without_regions_the_table_says_so():
    assert "No region" in text_of(one_cell_known())


def test_intervals_have_the_digits_of_the_error():
    coverage = over_steps(64)
    (row,) = coverage.summary([NEAR])
    near, within = row.numbers["radius_m"], row.numbers["detection_0.4m"]
    assert near.error > 0
    _, _, radius, *detection, known = cells_of(text_of(coverage, NEAR), "near")
    assert radius == f"{near.value:.3f}  [{near.low:.3f}, {near.high:.3f}]"
    assert detection == [f"{100 * within.value:.1f}  [{100 * within.low:.1f}, {100 * within.high:.1f}]", "100"]
    assert known == "100"
    assert "Brackets: 95 % confidence intervals from 16 blocks of up to 4 consecutive frames." in text_of(
        coverage, NEAR
    )


@pytest.mark.parametrize("differ", [False, True])
def test_brackets_are_explained_where_there_are_any(differ):
    coverage, place = metric(num_blocks=16), torch.tensor([[0.5, 0.5, 0.0]])
    for index in range(16):
        radius_m = torch.tensor([0.0, 0.0, 0.1 + 0.05 * index * differ])
        coverage.update(place - radius_m, place, block_index=index)
    text = text_of(coverage.compute(), NEAR)
    assert ("[" in text, "Brackets: 95 % confidence intervals from 16 blocks of one frame." in text) == (differ, differ)
    assert ("Brackets" in text) == differ


def test_single_block_region_has_no_error():
    coverage = metric(num_blocks=16)
    for index in range(16):
        x = 2.5 if index == 3 else 0.5
        coverage.update(torch.tensor([[x, 0.5, -0.2]]), torch.tensor([[x, 0.5, 0.0]]), block_index=index)
    text = text_of(coverage.compute(), NEAR, FAR)
    assert cells_of(text, "near")[2] == "0.20"
    assert cells_of(text, "far")[2] == "0.20"
    assert "Numbers without interval: too few blocks observe the region, or all blocks agree." in text


@pytest.mark.parametrize(("steps", "blocks", "needed"), [(1, "1 block", 11), (7, "7 blocks", 9)])
def test_too_few_frames_are_reported_once(steps, blocks, needed):
    text = text_of(over_steps(steps), NEAR)
    assert "[" not in text
    assert text.count(f"Not enough frames for confidence intervals: got {blocks}, about {needed} are needed.") == 1


def test_without_blocks_nothing_is_said_about_errors():
    text = text_of(one_cell_known(), NEAR)
    assert "[" not in text
    assert "error" not in text


# Several rigs


def test_notes_about_one_rig_name_it(blind, regions):
    text = re.sub(r"\s+", " ", printed(blind, regions))
    assert "[blind]: 1 of 1 frames had no sensor points" in text
    assert "seeing:" not in text


def test_few_frames_give_no_significant_difference(trios, regions):
    text = printed(trios(5), regions)
    assert "[" not in text
    assert (
        " ".join(text.split()).count("Not enough frames for confidence intervals: got 5 blocks, about 9 are needed.")
        == 1
    )
    assert "Difference to few" in text
    assert not re.search(r"│ +! ", text)


def test_the_parts_of_the_table_have_equal_columns(pair, regions):
    borders = [line for line in printed(pair, regions).splitlines() if line.startswith("┏")]
    assert len(borders) == 2
    assert borders[0] == borders[1]


@pytest.mark.parametrize("rigs", [2, 5, 9])
def test_narrow_terminal_folds_only_names(pair, regions, rigs):
    one, other = pair.values()
    named = {f"rig_number_{at}_with_a_long_name": (one, other)[at % 2] for at in range(rigs)}
    narrowest = compute_min_width(build_rich_tables(CoverageTable.from_coverages(named, regions)), list(named))
    assert narrowest == 38 + (len("unknown") + 3) * rigs
    assert_whole(named, regions, narrowest, r"[\d.]+ │|unknown", 8 * rigs)


@pytest.mark.parametrize("steps", [5, 24])
def test_narrow_terminal_keeps_intervals_whole(trios, regions, steps):
    names = ("a_rig_with_quite_a_long_name", "another_rig_with_a_long_name", "and_one_more_of_those")
    named = dict(zip(names, trios(steps).values(), strict=True))
    narrowest = compute_min_width(build_rich_tables(CoverageTable.from_coverages(named, regions), 1), names)
    assert_whole(named, regions, narrowest, r"\[[+-]?[\d.]+, [+-]?[\d.]+\]|unknown", 11)
    assert narrowest < 100


def assert_whole(named, regions, narrowest, pattern, more_than) -> None:
    # On a terminal that is narrower still, lines are longer than it is.
    narrow, wide = (re.split("All rigs|. the best of", printed(named, regions, width))[0] for width in (20, 400))
    assert max(map(len, narrow.splitlines())) == narrowest
    numbers = re.compile(pattern)
    assert len(numbers.findall(wide)) > more_than
    assert numbers.findall(narrow) == numbers.findall(wide)


@pytest.mark.parametrize("rigs", [1, 3])
def test_files_keep_names_whole(trio, regions, rigs):
    named = {f"rig_number_{at}_with_a_long_name": coverage for at, coverage in enumerate(list(trio.values())[:rigs])}
    text = printed(named, regions, 20, terminal=False)
    assert "mean blind spot" in text
    assert "…" not in text
    assert rigs == 1 or all(name in text for name in named)


@pytest.mark.parametrize("rigs", [1, 3, 5])
def test_text_tables_fold_to_eighty_columns(capsys, rigs):
    names, met = [f"rig_number_{at}" for at in range(rigs)], "child from behind a parked car: hatchback"
    times = [[f"{1.5 + speed / 100 + at:.2f} to 9.{speed}, too late" for at in range(rigs)] for speed in (10, 20, 30)]
    rows = [[TextCell(text) for text in (met, str(10 * k), "0.73", *of)] for k, of in enumerate(times, 1)]
    headings = ("encounter", "km/h", "needed\n(s)", *(f"{name}\n(s)" for name in names))
    print_page_tables([PageTable("Time to collision at detection", headings, rows)])
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) == 80
    # Nothing is cut but names in headings, and what is the same as in the row above is not said again.
    words = " ".join(lines).replace("│", " ").split()
    assert words.count("hatchback") == 1
    for of in times:
        assert all(words.count(text.split()[0]) == 1 for text in of)
    assert words.count("late") == 3 * rigs


def test_fitting_text_table_is_not_folded(capsys):
    print_page_tables(
        [PageTable("", ("a b", "c"), [[TextCell("one two"), TextCell("3")], [TextCell("one two"), TextCell("4")]])]
    )
    printed = capsys.readouterr().out
    assert (printed.count("one two"), len(printed.splitlines()[0])) == (2, 15)


def test_many_sensors_have_rows_within_eighty_columns():
    sensors = [f"sensor_number_{at}" for at in range(8)]
    coverage = metric(thresholds_m=(0.4,), num_blocks=16, sensor_names=sensors)
    for index in range(16):
        generator = torch.Generator().manual_seed(index)
        size_m = torch.tensor([4.0, 2.0, 0.2])
        clouds = {name: size_m * torch.rand(4, 3, generator=generator) for name in sensors}
        coverage.update(clouds, size_m * torch.rand(400, 3, generator=generator), block_index=index)
    computed = {"rig": coverage.compute()}
    narrow, wide = (printed(computed, (NEAR, FAR), width).partition("Change of")[2] for width in (80, 400))
    assert max(map(len, narrow.splitlines())) <= 80
    assert max(map(len, wide.splitlines())) > 160
    table = CoverageTable.from_coverages(computed, (NEAR, FAR))
    for row in table.rows["rig"]:
        changes = {
            name: change["detection_0.4m"].value for name, change in row.summary.redundancy.failure_effects.items()
        }
        rows = re.findall(rf"│ {row.summary.region} .*(sensor_number_\d) │ *(?:! )?([+-][\d.]+)", narrow)
        assert {name for name, _ in rows} == {name for name, change in changes.items() if change}
        assert [name for name, _ in rows] == sorted((name for name, _ in rows), key=lambda name: changes[name])
        assert [float(said) for _, said in rows] == pytest.approx([100 * changes[name] for name, _ in rows], abs=0.06)
