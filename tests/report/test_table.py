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
from torchcover.report.wording import metres, metres_more, percent, points_more

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


def over_steps(steps: int, **options) -> Coverage:
    """A point with a radius of its own in every step, and so in every cell."""
    coverage = metric(blocks=16, **options)
    radii = torch.rand(steps, generator=torch.Generator().manual_seed(0))
    for index, radius in enumerate(radii):
        place = torch.tensor([[0.5 + index % 2, 0.5 + index // 2 % 2, 0.0]])
        coverage.update(place - torch.tensor([0.0, 0.0, float(radius)]), place, index=index)
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


# Standard errors


def test_every_number_has_its_standard_error_to_two_digits():
    coverage = over_steps(64)
    (row,) = coverage.summary([NEAR])
    assert row.radius_error_m > 0
    _, _, radius, *detection, known = cells_of(text_of(coverage, NEAR), "near")
    assert radius == f"{row.radius_m:.3f} ± {row.radius_error_m:.3f}"
    number, error = (100 * row.detection[0.4], 100 * row.detection_error[0.4])
    assert detection == [f"{number:.1f} ± {error:.1f}", "100 ± 0"]
    assert known == "100"
    assert "± is one standard error, from 16 blocks of up to 4 steps in a row." in text_of(coverage, NEAR)


@pytest.mark.parametrize(("steps", "blocks"), [(1, "1 block"), (7, "7 blocks")])
def test_too_few_steps_for_an_error_are_told_once_and_never_as_0(tmp_path, steps, blocks):
    text = text_of(over_steps(steps), NEAR)
    assert "±" not in text
    assert text.count(f"Not enough steps for errors: {blocks}, 8 are needed.") == 1
    write_csv(over_steps(steps), [NEAR], tmp_path / "summary.csv")
    with (tmp_path / "summary.csv").open(newline="", encoding="utf-8") as file:
        (near,) = csv.DictReader(file)
    assert (near["radius_error_m"], near["detection_0.4m_error"]) == ("", "")
    assert strict_round_trip(summary_dict(over_steps(steps), [NEAR]))["rows"][0]["radius_error_m"] is None


def test_without_blocks_nothing_is_said_about_errors(tmp_path):
    text = text_of(one_cell_known(), NEAR)
    assert "±" not in text
    assert "error" not in text
    (row,) = strict_round_trip(summary_dict(one_cell_known(), [NEAR]))["rows"]
    assert (row["radius_error_m"], row["blocks"], row["steps_per_block"]) == (None, None, None)


def test_files_hold_the_errors_and_the_blocks_they_come_from(tmp_path):
    coverage = over_steps(40)
    (expected,) = coverage.summary([NEAR])
    write_csv(coverage, [NEAR], tmp_path / "summary.csv")
    with (tmp_path / "summary.csv").open(newline="", encoding="utf-8") as file:
        (near,) = csv.DictReader(file)
    summary = strict_round_trip(summary_dict(coverage, [NEAR]))
    for row in (near, summary["rows"][0]):
        assert float(row["radius_error_m"]) == expected.radius_error_m
        assert float(row["detection_0.4m_error"]) == expected.detection_error[0.4]
        assert (int(row["blocks"]), int(row["steps_per_block"])) == (10, 4)
    assert (summary["blocks"], summary["steps_per_block"]) == (10, 4)


def test_a_region_that_one_block_alone_has_probed_has_a_number_without_error():
    coverage = metric(blocks=16)
    for index in range(16):
        x = 2.5 if index == 3 else 0.5
        coverage.update(torch.tensor([[x, 0.5, -0.2]]), torch.tensor([[x, 0.5, 0.0]]), index=index)
    text = text_of(coverage.compute(), NEAR, FAR)
    assert cells_of(text, "near")[2] == "0.20 ± 0"
    assert cells_of(text, "far")[2] == "0.20"
    assert "No ± where one block alone has probed the region." in text


def test_an_infinite_number_has_no_error():
    coverage = metric(blocks=16)
    for index in range(16):
        coverage.update(ORIGIN if index else torch.zeros(0, 3), ORIGIN, index=index)
    assert cells_of(text_of(coverage.compute(), NEAR), "near")[2] == "infinite"


@given(st.floats(0.0, 1e3), st.floats(1e-11, 1e2))
def test_a_number_has_the_decimals_of_its_error(value, error):
    words, error_words = metres(value, error).split(" ± ")
    decimals = [len(number.partition(".")[2]) for number in (words, error_words)]
    assert decimals[0] == decimals[1] <= 4
    if not error_words.startswith("<"):
        assert 0 < float(error_words) == pytest.approx(error, rel=0.051, abs=0.00005 if decimals[0] == 4 else 0.0)
        assert float(words) == pytest.approx(value, abs=0.5001 * 10.0 ** -decimals[0])
        assert len(error_words.replace(".", "").lstrip("0")) <= max(2, len(str(math.ceil(error))))


@given(st.floats(0.0, 1.0))
def test_with_a_tiny_error_only_nothing_is_0_percent_and_only_all_is_100(share):
    words, error_words = percent(share, 1e-9).split(" ± ")
    assert error_words == "<0.001"
    assert (words == "0.000") == (share == 0.0)
    assert (words == "100.000") == (share == 1.0)


@given(st.floats(-2.0, 2.0), st.floats(1e-9, 1.0))
def test_a_difference_has_a_sign_and_none_is_minus_nothing(difference, error):
    words = metres_more(difference, error).split(" ± ")[0]
    assert words[0] == ("-" if float(words) < 0 else "+")
    if float(words):
        assert math.copysign(1, difference) == math.copysign(1, float(words))


def test_what_has_no_error_at_all_is_shown_as_such():
    assert (percent(1.0, 0.0), percent(0.0, 0.0), percent(0.5, 1e-17)) == ("100 ± 0", "0 ± 0", "50.0 ± 0")
    assert (metres(0.2, 0.0), points_more(0.0, 0.0), metres_more(0.0)) == ("0.20 ± 0", "0 ± 0", "0")
    assert points_more(math.inf, 1.0) == "+infinite"
    assert metres(math.nan, 0.1) == points_more(math.nan, 0.1) == "unknown"
