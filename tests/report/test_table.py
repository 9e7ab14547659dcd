import csv
import io
import json
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from torchcover.coverage import BevGrid, Coverage, CoverageMetric, Region
from torchcover.report.table import coverage_table, summary_dict, write_csv
from torchcover.report.wording import percent

NEAR = Region("near", x=(0.0, 2.0), y=(0.0, 2.0))
FAR = Region("far", x=(2.0, 4.0), y=(0.0, 2.0))
ORIGIN = torch.zeros(1, 3)


def metric(thresholds=(0.4, 1.0), **options) -> CoverageMetric:
    grid = BevGrid(x=(0.0, 4.0), y=(0.0, 2.0), cell=1.0, heights={"ground": (-0.5, 0.5)})
    return CoverageMetric(grid, thresholds=thresholds, **options)


def one_cell_known() -> Coverage:
    """One of the four near cells: radii 0.2 and 0.6, so mean 0.4, half of them within 0.4 m. No far cell."""
    coverage = metric()
    coverage.update(ORIGIN, torch.tensor([[0.2, 0.0, 0.0], [0.6, 0.0, 0.0]]))
    return coverage.compute()


def text_of(coverage: Coverage, *regions: Region) -> str:
    console = Console(width=140, file=io.StringIO())
    console.print(coverage_table(coverage, regions))
    return console.file.getvalue()


def cells_of(text: str, region: str) -> list[str]:
    (line,) = [line for line in text.splitlines() if line.startswith(f"│ {region} ")]
    return [cell.strip() for cell in line.strip("│").split("│")]


def test_a_row_shows_metres_percent_and_the_share_of_known_cells():
    assert cells_of(text_of(one_cell_known(), NEAR, FAR), "near") == ["near", "ground", "0.40", "50.0", "100", "25.0"]


def test_an_unknown_number_is_called_unknown():
    text = text_of(one_cell_known(), NEAR, FAR)
    assert cells_of(text, "far") == ["far", "ground", "unknown", "unknown", "unknown", "0"]
    assert "nan" not in text.lower()


def test_a_blind_step_without_limit_is_called_infinite():
    coverage = metric()
    coverage.update(torch.zeros(0, 3), ORIGIN)
    assert cells_of(text_of(coverage.compute(), NEAR), "near")[2] == "infinite"


def test_units_cell_size_steps_and_bands_are_told():
    text = text_of(one_cell_known(), NEAR)
    head = text[: text.index("near")]
    assert (head.count("(m)"), head.count("(%)")) == (1, 3)
    for words in ("0.4 m (%)", "1 m (%)", "1 step, cells of 1 m", "ground z -0.5 to 0.5 m"):
        assert words in text


def test_trouble_is_told_in_words_with_its_count():
    coverage = metric(thresholds=(0.4,), max_radius=0.5)
    reference = torch.tensor([[0.2, 0.0, 0.0], [0.6, 0.0, 0.0], [-9.0, 0.0, 0.0]])
    coverage.update([ORIGIN, torch.zeros(0, 3), ORIGIN], [reference, reference, torch.zeros(0, 3)])
    text = text_of(coverage.compute(), NEAR)
    assert "1 of 3 steps had no sensor point" in text
    assert "1 of 3 steps had no reference point" in text
    assert "3 of 4 reference points count as 0.5 m far, the limit" in text
    assert "2 of 6 reference points lie outside the grid" in text


def test_without_trouble_none_is_told():
    coverage = metric()
    everywhere = torch.cartesian_prod(torch.arange(4) + 0.5, torch.arange(2) + 0.5, torch.zeros(1))
    coverage.update(ORIGIN, everywhere)
    text = text_of(coverage.compute(), NEAR)
    assert not any(words in text for words in (" of 1 step", "reference point", "known cells only"))


def test_names_that_look_like_markup_are_shown_as_they_are():
    assert "│ [bold]:car: " in text_of(one_cell_known(), Region("[bold]:car:", x=(0.0, 2.0), y=(0.0, 2.0)))


def test_without_regions_the_table_says_so():
    assert "No region" in text_of(one_cell_known())


def test_csv_reads_back_as_the_summary(tmp_path):
    coverage = one_cell_known()
    write_csv(coverage, [NEAR, FAR], tmp_path / "summary.csv")
    with (tmp_path / "summary.csv").open(newline="", encoding="utf-8") as file:
        near, far = csv.DictReader(file)
    (row,) = coverage.summary([NEAR])
    assert (near["region"], near["height"]) == ("near", "ground")
    assert float(near["radius_m"]) == row.radius_m
    assert [float(near[f"detection_{threshold}m"]) for threshold in ("0.4", "1")] == [0.5, 1.0]
    assert (near["known_share"], near["known_cells"], near["cells"]) == ("0.25", "1", "4")
    assert (near["cell_m"], near["steps"]) == ("1.0", "1")
    bounds = [float(far[f"{axis}_{end}_m"]) for axis in "xyz" for end in ("min", "max")]
    assert bounds == [2.0, 4.0, 0.0, 2.0, -0.5, 0.5]
    assert (far["radius_m"], far["detection_0.4m"], far["known_share"]) == ("", "", "0.0")


def test_csv_without_regions_still_has_its_header(tmp_path):
    write_csv(one_cell_known(), [], tmp_path / "summary.csv")
    assert (tmp_path / "summary.csv").read_text().startswith("region,height,radius_m,")


def strict_round_trip(value: object) -> dict:
    def forbid(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(json.dumps(value, allow_nan=False), parse_constant=forbid)


def test_json_is_strict_and_an_unknown_number_is_null():
    summary = strict_round_trip(summary_dict(one_cell_known(), [NEAR, FAR]))
    near, far = summary["rows"]
    assert (near["radius_m"], near["detection_0.4m"]) == (pytest.approx(0.4), 0.5)
    assert (far["radius_m"], far["detection_0.4m"], far["known_cells"]) == (None, None, 0)


def test_json_holds_the_conditions():
    summary = strict_round_trip(summary_dict(one_cell_known(), [NEAR]))
    assert summary["grid"] == {
        "x_m": [0.0, 4.0],
        "y_m": [0.0, 2.0],
        "cell_m": 1.0,
        "heights_m": {"ground": [-0.5, 0.5]},
    }
    assert summary["thresholds_m"] == [0.4, 1.0]
    assert summary["counts"] == one_cell_known().counts


def test_infinity_survives_json_and_is_not_unknown():
    coverage = metric()
    coverage.update(torch.zeros(0, 3), ORIGIN)
    summary = strict_round_trip(summary_dict(coverage.compute(), [NEAR]))
    assert float(summary["max_radius_m"]) == float(summary["rows"][0]["radius_m"]) == math.inf


def test_a_region_beyond_the_grid_is_refused():
    with pytest.raises(ValueError, match="beyond the grid's"):
        coverage_table(one_cell_known(), [Region("wide", x=(0.0, 9.0), y=(0.0, 2.0))])


@given(st.floats(0.0, 1.0))
def test_only_nothing_is_0_percent_and_only_all_is_100(share):
    assert (percent(share) in ("0", "0.0")) == (share == 0.0)
    assert (percent(share) in ("100", "100.0")) == (share == 1.0)
    assert abs(float(percent(share).strip("<>")) - 100 * share) <= 0.1
