"""Rigs side by side: what is marked, what a difference means, and that pictures may be compared by eye."""

import csv
import io
import json
import math
import re

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imread
from rich.console import Console
from scipy import stats

from torchcover.coverage import BevGrid, Coverage, CoverageMetric, Region
from torchcover.report import (
    SensorMark,
    comparison_dict,
    comparison_tables,
    detection_scale,
    difference_scale,
    draw_comparison,
    draw_side_by_side,
    narrowest_width,
    radius_scale,
    write_comparison,
)
from torchcover.report.paired import differences, is_significant, student_t95

GRID = BevGrid(x=(-8.0, 12.0), y=(-5.0, 5.0), cell=1.0)
AROUND = BevGrid(x=(-10.0, 10.0), y=(-10.0, 10.0), cell=0.25)
SQUARE = BevGrid(x=(0.0, 10.0), y=(-5.0, 5.0), cell=1.0)
REGIONS = (Region("near", (0.0, 5.0), (-5.0, 5.0)), Region("behind", (-8.0, -6.0), (-5.0, 5.0)))
EGO = np.array([[1.0, 0.5], [-1.0, 0.5], [-1.0, -0.5], [1.0, -0.5]])


def cloud(count: int, seed: int) -> torch.Tensor:
    """Points in front of x = -5 m, in both bands."""
    unit = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))
    return unit * torch.tensor([17.0, 10.0, 2.4]) + torch.tensor([-5.0, -5.0, -0.45])


def over_steps(sensors: list[torch.Tensor], **options) -> Coverage:
    """One cloud of the rig a step, against reference points of that step."""
    metric = CoverageMetric(GRID, blocks=16, **options)
    for index, sensor in enumerate(sensors):
        metric.update(sensor, cloud(100, 1000 + index), index=index)
    return metric.compute()


def trio(steps: int) -> dict[str, Coverage]:
    """Few points, as many other points, and many more, in every step."""
    few, other, more = (
        [cloud(size, seed * 100 + at) for at in range(steps)] for seed, size in ((1, 20), (2, 20), (3, 300))
    )
    return {"few": over_steps(few), "other": over_steps(other), "many": over_steps(more)}


def coverage(sensor: torch.Tensor, *, grid: BevGrid = GRID, seed: int = 0, **options) -> Coverage:
    metric = CoverageMetric(grid, **options)
    metric.update(sensor, cloud(300, seed))
    return metric.compute()


def pair(**options) -> dict[str, Coverage]:
    """Few points, and the same with many more."""
    few, more = cloud(20, 1), cloud(200, 2)
    return {"few": coverage(few, **options), "many": coverage(torch.cat([few, more]), **options)}


def printed(coverages, width=200, regions=REGIONS) -> str:
    console = Console(file=io.StringIO(), width=width)
    for table in comparison_tables(coverages, regions):
        console.print(table)
    return console.file.getvalue()


def rows(coverages) -> dict[str, list[dict]]:
    by_rig: dict[str, list[dict]] = {}
    for row in json.loads(json.dumps(comparison_dict(coverages, REGIONS), allow_nan=False))["rows"]:
        by_rig.setdefault(row["rig"], []).append(row)
    return by_rig


def pixels(figure: Figure) -> np.ndarray:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3] / 255.0


def panel(figure: Figure, at: int) -> np.ndarray:
    """The pixels of one map, row 0 at the top."""
    everything = pixels(figure)
    (left, bottom), (right, top) = figure.axes[at].get_window_extent().get_points().round().astype(int)
    return everything[len(everything) - top : len(everything) - bottom, left:right]


def test_a_rig_against_itself_differs_nowhere_and_every_known_number_is_marked():
    one = coverage(cloud(50, 1), thresholds=(0.4, 1.0))
    for rig_rows in rows({"a": one, "b": one}).values():
        for row in rig_rows[:2]:
            for name in ("radius_m", "detection_0.4m", "detection_1m"):
                assert row[f"{name}_best"] is True
                assert row[f"{name}_difference"] == 0.0


def test_more_points_are_never_worse_and_win_every_known_row():
    few, many = rows(pair()).values()
    for less, more in zip(few[:2], many[:2], strict=True):
        assert more["radius_m_difference"] < 0 < more["detection_0.4m_difference"]
        assert more["radius_m_difference"] == pytest.approx(more["radius_m"] - less["radius_m"])
        assert (less["radius_m_best"], more["radius_m_best"]) == (False, True)
        assert (less["detection_0.4m_best"], more["detection_0.4m_best"]) == (False, True)
        assert less["radius_m_difference"] == 0.0


def test_the_unknown_never_wins():
    for rig_rows in rows(pair()).values():
        for row in rig_rows[2:]:  # nothing was probed behind x = -5 m
            assert row["region"] == "behind"
            assert (row["radius_m"], row["radius_m_difference"], row["radius_m_best"]) == (None, None, False)
            assert row["detection_0.4m_best"] is False
    unknown = [line for line in printed(pair()).splitlines() if "unknown" in line and "behind" in line]
    assert len(unknown) == 4
    assert not any("*" in line for line in unknown)


def test_two_blind_rigs_are_equal_not_unknown():
    blind = coverage(torch.zeros(0, 3))
    seeing = coverage(cloud(50, 1))
    _, also_blind, other = rows({"blind": blind, "also": blind, "seeing": seeing}).values()
    assert also_blind[0]["radius_m"] == "Infinity"
    assert also_blind[0]["radius_m_difference"] == 0.0
    assert other[0]["radius_m_difference"] == "-Infinity"
    assert (also_blind[0]["radius_m_best"], other[0]["radius_m_best"]) == (False, True)


def test_the_table_marks_with_a_sign_that_needs_no_colours():
    text = printed(pair())
    radius, detection = text.split("Detection within 0.4 m (%)")
    for part in (radius, detection):
        lines = [line for line in part.splitlines() if "near" in line]
        assert len(lines) == 2
        for line in lines:
            _, _, _, few, many, known, _ = (cell.strip() for cell in line.split("│"))
            assert not few.startswith("*")
            assert many.startswith("* ")
            assert float(known) == pytest.approx(100, abs=60)
    assert "the best of its row" in text
    assert "they know the same cells" in text


def test_numbers_that_print_the_same_are_all_marked():
    far = [torch.tensor([[-500.0 - shift, 0.0, 0.0]]) for shift in (0.0, 1e-4, 1.0)]
    marked = rows({str(at): coverage(sensor) for at, sensor in enumerate(far)})
    assert [rig_rows[0]["radius_m_best"] for rig_rows in marked.values()] == [True, True, False]


@pytest.mark.parametrize("rigs", [2, 5, 9])
def test_on_a_narrow_terminal_names_fold_but_numbers_stay_whole(rigs):
    one, other = pair().values()
    named = {f"rig_number_{at}_with_a_long_name": (one, other)[at % 2] for at in range(rigs)}
    narrowest = narrowest_width(comparison_tables(named, REGIONS), list(named))
    assert narrowest == 35 + (len("unknown") + 3) * rigs
    narrow, wide = (printed(named, width).split("the best of")[0] for width in (narrowest, 400))
    assert max(map(len, narrow.splitlines())) == narrowest
    numbers = re.compile(r"(?:\* )?[\d.]+ │|unknown")
    assert len(numbers.findall(wide)) > 8 * rigs
    assert numbers.findall(narrow) == numbers.findall(wide)
    assert "known cells" in narrow


def test_the_parts_of_the_table_have_equal_columns():
    console = Console(file=io.StringIO(), width=200)
    for table in comparison_tables(pair(), REGIONS[:1]):
        console.print(table)
    borders = [line for line in console.file.getvalue().splitlines() if line.startswith("┏")]
    assert len(borders) == 2
    assert borders[0] == borders[1]


def test_notes_about_one_rig_name_it():
    text = printed({"seeing": coverage(cloud(9, 1)), "[blind]": coverage(torch.zeros(0, 3))})
    assert "[blind]: 1 of 1 steps had no sensor point" in text
    assert "seeing:" not in text


def test_the_csv_has_a_row_for_each_rig_region_and_band(tmp_path):
    write_comparison(pair(), REGIONS, tmp_path / "summary.csv")
    with (tmp_path / "summary.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [row["rig"] for row in table] == ["few"] * 4 + ["many"] * 4
    assert table[4]["radius_m_best"] == "True"
    assert float(table[4]["radius_m_difference"]) == pytest.approx(
        float(table[4]["radius_m"]) - float(table[0]["radius_m"])
    )
    assert table[7]["radius_m"] == ""


# Standard errors


@pytest.mark.parametrize("freedom", [7, 8, 9, 11, 15, 31, 200, 10_000])
def test_students_t_is_that_of_scipy_and_decides(freedom):
    limit = float(stats.t.ppf(0.975, freedom))
    assert student_t95(freedom) == pytest.approx(limit, abs=1e-4)
    for sign in (-1, 1):
        assert is_significant(sign * 1.001 * limit * 0.2, 0.2, freedom) is True
        assert is_significant(sign * 0.999 * limit * 0.2, 0.2, freedom) is False
    assert is_significant(1e-17, 0.0, freedom) is False
    assert is_significant(1.0, math.nan, freedom) is None


@pytest.mark.parametrize("shift", [0.0, 0.05, 0.1, 0.3])
@pytest.mark.parametrize("seed", range(4))
def test_significant_is_what_a_paired_t_test_calls_so(shift, seed):
    """One step a block and one cell: radii whose differences are `shift` and noise."""
    random = np.random.default_rng(seed)
    shared = 1 + random.random(16)
    radii = {"a": shared, "b": shared + shift + 0.2 * random.standard_normal(16)}
    coverages = {}
    for name, own in radii.items():
        metric = CoverageMetric(SQUARE, blocks=16)
        for at, radius in enumerate(own.tolist()):
            metric.update(torch.tensor([[0.5, 0.5, -radius]]), torch.tensor([[0.5, 0.5, 0.0]]), index=at)
        coverages[name] = metric.compute()
    itself, (found, _) = differences(coverages, REGIONS[0], "ground").values()
    test = stats.ttest_rel(radii["b"], radii["a"])
    assert found.value == pytest.approx(radii["b"].mean() - radii["a"].mean(), abs=1e-6)
    assert abs(found.value) / found.error == pytest.approx(abs(test.statistic), rel=1e-4)
    assert found.significant is bool(test.pvalue < 0.05)
    assert itself[0] == (0.0, 0.0, False)


def test_differences_have_a_part_of_their_own_and_what_is_no_chance_is_marked():
    coverages = trio(24)
    text = printed(coverages)
    parts = re.split(
        r"Difference to few: (?:mean blind spot radius \(m\)|detection within 0.4 m \(percentage points\))", text
    )
    assert len(parts) == 3
    for part, sign in zip(parts[1:], "-+", strict=True):
        for line in [line for line in part.splitlines() if "│ near " in line]:
            _, _, _, other, many, _, _ = (cell.strip() for cell in line.split("│"))
            assert re.fullmatch(r"(! )?[+-][\d.]+ ± [\d.]+", other)
            assert re.fullmatch(rf"! \{sign}[\d.]+ ± [\d.]+", many)
        unknown = [line for line in part.splitlines() if "│ behind" in line]
        assert len(unknown) == 2
        assert all(line.count("unknown") == 2 and "!" not in line for line in unknown)
    assert "of 20 rows without a difference, one is marked" in re.sub(r"\s+", " ", text)
    values = parts[0].splitlines()
    assert any(re.search(r"│ +[\d.]+ ± [\d.]+ │ +[\d.]+ ± [\d.]+ │ +\* [\d.]+ ± [\d.]+ │", line) for line in values)


def test_files_say_how_sure_a_difference_is(tmp_path):
    coverages = trio(24)
    few, other, many = rows(coverages).values()
    for row in many[:2]:
        assert row["radius_m_difference_significant"] is row["detection_0.4m_difference_significant"] is True
        assert 0 < row["radius_m_difference_error"] < abs(row["radius_m_difference"])
    for row in few[:2]:
        assert (row["radius_m_difference_error"], row["radius_m_difference_significant"]) == (0.0, False)
    expected = differences(coverages, REGIONS[0], "ground")["other"][0]
    assert other[0]["radius_m_difference_error"] == expected.error
    assert other[0]["radius_m_difference_significant"] is expected.significant
    for row in (few[2], many[3]):
        assert (row["radius_m_difference_error"], row["radius_m_difference_significant"]) == (None, None)
    write_comparison(coverages, REGIONS, tmp_path / "summary.csv")
    with (tmp_path / "summary.csv").open() as file:
        table = list(csv.DictReader(file))
    assert (table[8]["rig"], table[8]["radius_m_difference_significant"]) == ("many", "True")
    assert float(table[8]["radius_m_difference_error"]) == many[0]["radius_m_difference_error"]
    assert table[11]["radius_m_difference_significant"] == ""


def test_from_too_few_steps_no_difference_is_called_significant():
    text = printed(trio(5))
    assert "±" not in text
    assert text.count("Not enough steps for errors: 5 blocks, 8 are needed.") == 1
    assert "Difference to few" in text
    for rig_rows in rows(trio(5)).values():
        for row in rig_rows:
            assert row["radius_m_difference_error"] is None
            assert row["detection_0.4m_difference_significant"] is None


@pytest.mark.parametrize("steps", [5, 24])
def test_on_a_narrow_terminal_numbers_with_errors_stay_whole(steps):
    one, two, three = trio(steps).values()
    named = {"a_rig_with_quite_a_long_name": one, "another_rig_with_a_long_name": two, "and_one_more_of_those": three}
    tables = comparison_tables(named, REGIONS)
    narrowest = narrowest_width(tables, list(named))
    narrow, wide = (re.split("the best of", printed(named, width))[0] for width in (narrowest, 400))
    assert max(map(len, narrow.splitlines())) == narrowest
    numbers = re.compile(r"(?:[*!] )?[+-]?[\d.]+(?: ± [\d.]+)? │|unknown")
    assert len(numbers.findall(wide)) > 20
    assert numbers.findall(narrow) == numbers.findall(wide)


def test_without_regions_the_tables_say_so():
    assert "No region" in printed(trio(9), regions=())


@pytest.mark.parametrize("errors", [False, True])
def test_errors_are_drawn_side_by_side_if_asked_for_and_never_as_differences(tmp_path, errors):
    names = {path.name for path in draw_comparison(trio(12), tmp_path, errors=errors)}
    drawn = {name for name in names if "error" in name}
    expected = {
        f"{quantity}_error_{band}.png" for quantity in ("radius", "detection_0.4m") for band in ("ground", "obstacle")
    }
    assert drawn == (expected if errors else set())


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"seed": 7}, "different reference points"),
        ({"thresholds": (0.5,)}, "differ in their thresholds"),
        ({"max_radius": 9.0}, "differ in their max_radius"),
        ({"grid": SQUARE}, "differ in their grid"),
    ],
)
def test_coverages_that_are_not_paired_are_refused(tmp_path, other, message):
    sensor = cloud(9, 1)
    unpaired = {"a": coverage(sensor), "b": coverage(sensor, **other)}
    for function in (comparison_tables, comparison_dict):
        with pytest.raises(ValueError, match=f"'a' and 'b' cannot be compared: .*{message}"):
            function(unpaired, REGIONS)
    with pytest.raises(ValueError, match=message):
        draw_comparison(unpaired, tmp_path / "maps")
    assert not (tmp_path / "maps").exists()


def test_one_rig_is_no_comparison():
    with pytest.raises(ValueError, match="at least two rigs; got few"):
        comparison_tables({"few": pair()["few"]}, REGIONS)


def test_a_picture_for_each_metric_and_band_and_a_difference_for_each_rig_but_the_first(tmp_path):
    three = {**pair(), "a/b": coverage(cloud(40, 5))}
    paths = draw_comparison(three, tmp_path, ego_outline_m=EGO)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert sorted(path.name for path in paths) == names
    stems = [f"{metric}_{band}" for metric in ("radius", "detection_0.4m") for band in ("ground", "obstacle")]
    expected = [f"{stem}.png" for stem in stems]
    expected += [f"difference_{stem}_{rig}_minus_few.png" for stem in stems for rig in ("many", "a_b")]
    assert names == sorted(expected)


def test_a_worse_place_is_red_and_a_better_one_blue_whatever_is_measured(tmp_path):
    """The second rig sees at the front left only, the first at the rear right only."""
    front_left, rear_right = torch.tensor([[11.0, 4.0, 0.0]]), torch.tensor([[-4.0, -4.0, 0.0]])
    rigs = {"first": coverage(rear_right, thresholds=(5.0,)), "second": coverage(front_left, thresholds=(5.0,))}
    for path in draw_comparison(rigs, tmp_path):
        if path.name.startswith("difference"):
            red, _, blue = np.moveaxis(imread(path)[..., :3].astype(float), 2, 0)
            is_blue, is_red = blue - red > 0.2, red - blue > 0.2
            width = red.shape[1]
            # Left of the colour bar, which has both colours.
            (blue_y, blue_x), (red_y, red_x) = (np.argwhere(c[:, : int(0.85 * width)]).T for c in (is_blue, is_red))
            assert blue_x.mean() > red_x.mean() + 0.2 * width
            assert blue_y.mean() < red_y.mean()


def test_a_difference_says_which_minus_which_and_what_is_better(tmp_path, monkeypatch):
    words = []
    monkeypatch.setattr(
        Figure, "savefig", lambda self, *_, **__: words.append([t.get_text() for t in self.axes[0].texts])
    )
    draw_comparison(pair(), tmp_path)
    differences = [texts for texts in words if "minus" in texts[0]]
    assert [texts[0] for texts in differences] == [
        "many minus few: mean blind spot radius, ground",
        "many minus few: mean blind spot radius, obstacle",
        "many minus few: detection within 0.4 m, ground",
        "many minus few: detection within 0.4 m, obstacle",
    ]
    for texts in differences:
        assert texts[1].startswith("blue: many is better, red: few is better; z ")


def test_the_difference_scale_is_symmetric_and_robust_and_turns_with_what_is_better():
    difference = torch.cat([torch.linspace(-1.0, 0.5, 1000), torch.tensor([900.0, math.nan, math.inf])])
    radius = radius_scale("radius", torch.ones(3))
    scale = difference_scale(radius, difference, lower_is_better=True)
    assert scale.low == -scale.high
    assert 0.9 <= scale.high <= 1.0
    assert (scale.colormap, scale.unit) == ("RdBu_r", "m")
    detection = difference_scale(detection_scale("detected"), difference, lower_is_better=False)
    assert (detection.colormap, detection.unit) == ("RdBu", "percentage points")
    assert difference_scale(radius, torch.zeros(9), lower_is_better=True).high > 0


def side_by_side(grid: BevGrid, arrays: dict[str, torch.Tensor], **options) -> Figure:
    return draw_side_by_side(arrays, grid, radius_scale("radius", torch.ones(2)), title="Title", **options)


def test_the_same_value_has_the_same_colour_in_every_panel():
    values = torch.full(GRID.shape[1:], 0.5)
    figure = side_by_side(GRID, {"a": values, "b": values * torch.linspace(0.0, 2.0, 20)})
    first, second = panel(figure, 0), panel(figure, 1)
    middle = len(first) // 2
    assert (abs(second - first[middle, middle]).max(axis=2) < 0.06).any()
    assert abs(second[middle, 10] - second[middle, -10]).max() > 0.5
    assert len(figure.axes) == 3  # two maps, one colour bar


def test_long_maps_lie_below_each_other_and_square_ones_beside_each_other():
    long = BevGrid(x=(0.0, 50.0), y=(-10.0, 10.0), cell=1.0)
    for grid, stacked in ((long, True), (SQUARE, False)):
        for names in ("ab", "abc"):
            figure = side_by_side(grid, {name: torch.zeros(grid.shape[1:]) for name in names})
            a, *others = (axes.get_position() for axes in figure.axes[:-1])
            for other in others:
                assert bool(a.x0 == pytest.approx(other.x0)) is stacked
                assert bool(a.y0 == pytest.approx(other.y0)) is not stacked
                assert a.width == pytest.approx(other.width)


@pytest.mark.parametrize("count", [2, 3, 5])
@pytest.mark.parametrize("grid", [GRID, AROUND, BevGrid(x=(0.0, 200.0), y=(-40.0, 40.0), cell=0.5)])
def test_every_panel_has_whole_pixels_for_each_cell_and_overlaps_no_other(count, grid):
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(grid.shape[1:], generator=generator)
    figure = side_by_side(grid, {f"rig {k}": values for k in range(count)}, subtitle="where")
    _, rows_, columns = grid.shape
    shown = [panel(figure, at) for at in range(count)]
    for one in shown:
        assert one.shape == shown[0].shape
        assert (one.shape[0] % rows_, one.shape[1] % columns) == (0, 0)
        np.testing.assert_array_equal(one[3:-3, 3:-3], shown[0][3:-3, 3:-3])
    corners = [axes.get_window_extent().get_points() for axes in figure.axes[:-1]]
    np.testing.assert_allclose(corners, np.round(corners), atol=1e-3)
    boxes = [axes.get_tightbbox() for axes in figure.axes]
    for at, one in enumerate(boxes):
        assert not any(one.overlaps(other) for other in boxes[at + 1 :])
    border = pixels(figure)
    for edge in (border[:5], border[-5:], border[:, :5], border[:, -5:]):
        assert (edge == 1.0).all()


def test_every_panel_is_headed_and_the_legend_says_everything_once():
    sensor = SensorMark("lidar", 0.0, 0.0, 0.0, 90.0, 5.0)
    arrays = {"$a": torch.zeros(GRID.shape[1:]), "b": torch.full(GRID.shape[1:], math.inf)}
    figure = side_by_side(GRID, arrays, ego_outline_m=EGO, sensors={"$a": [sensor], "b": [sensor]})
    assert [axes.texts[0].get_text() for axes in figure.axes[:2]] == ["$a", "b"]
    (legend,) = [axes.get_legend() for axes in figure.axes if axes.get_legend()]
    entries = [text.get_text() for text in legend.get_texts()]
    assert entries == [
        "unknown: never probed (0 % of the cells)",
        "infinite: a step saw nothing (50.0 % of the cells)",
        "ego",
        "sensor, with its direction",
        "field of view, up to its range",
    ]
