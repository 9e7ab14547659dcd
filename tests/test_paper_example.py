"""`python -m examples.paper`: the paper's tables, how far a run is from them, and runs in pieces that merge."""

import json
import sys
from argparse import Namespace
from importlib import import_module
from itertools import combinations, islice, product
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.image import imread

from torchcover import BevGrid, Coverage, CoverageMetric, Region, forward_regions
from torchcover.data import SimulatedFrames
from torchcover.geometry import build_transform, convert_euler_to_rotation
from torchcover.report import SensorView, write_figures
from torchcover.simulation import PaperReference, Scenario

ROOT = Path(__file__).parents[1]
NAMES = (
    "__main__",
    "cameras",
    "comparison",
    "four_views",
    "measuring",
    "pieces",
    "published",
    "score",
    "tables",
    "thinning",
)


class Example:
    """Its modules, by name."""


@pytest.fixture(scope="module")
def paper():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT)
        example = Example()
        for name in NAMES:
            setattr(example, name, import_module(f"examples.paper.{name}"))
        yield example


@pytest.fixture(scope="module")
def published(paper):
    return paper.published.published()


# The paper's tables


def test_the_tables_have_60_numbers_of_which_12_stand_in_both(paper, published):
    lines = paper.published.TABLES.read_text(encoding="utf-8").splitlines()[1:]
    roof = [line.split(",", 1) for line in lines if ",roof_128," in line]
    assert len(lines) == 60
    assert len(published) == 48
    assert sorted(rest for table, rest in roof if table == "1") == sorted(rest for table, rest in roof if table == "2")
    named = product(
        paper.published.QUANTITIES, paper.published.LIDARS, paper.published.REGIONS, paper.published.HEIGHTS
    )
    assert set(published) == set(map(paper.published.Place._make, named))


def test_what_the_pages_say_of_the_tables_stands_in_them(published):
    def number(quantity, lidar, region, height):
        return next(value for place, value in published.items() if place == (quantity, lidar, region, height))

    of_ground = [place for place in published if place.height == "ground"]
    higher = {place: published[place._replace(height="obstacle")] > published[place] for place in of_ground}
    assert len(higher) == 24
    assert all(higher.values())  # of radii and of detections
    grilles = [place for place in published if place.lidar == "grille_128"]
    better = {
        place: (published[place] > published[place._replace(lidar="roof_128")]) == (place.quantity == "radius_m")
        for place in grilles
    }
    assert [place[2:] for place, roof_is_better in better.items() if not roof_is_better] == [("20m", "ground")]
    assert number("radius_m", "grille_128", "20m", "ground") == 1.41
    assert number("radius_m", "roof_128", "20m", "ground") == 1.93


def test_tables_that_contradict_each_other_are_refused(paper, monkeypatch, tmp_path):
    copy = tmp_path / "tables.csv"
    copy.write_text(
        paper.published.TABLES.read_text().replace(
            "2,roof_128,radius_m,20m,ground,1.93", "2,roof_128,radius_m,20m,ground,1.41"
        )
    )
    monkeypatch.setattr(paper.published, "TABLES", copy)
    with pytest.raises(ValueError, match=r"1.41 and 1.93 for radius_m roof_128 20m ground"):
        paper.published.published.__wrapped__()


# The distance of a run to them


def slow_score(run, paper):
    """The same, one pair after the other."""
    counted = {"rows": [0, 0], "all": [0, 0]}
    for one, other in combinations(paper, 2):
        if one.quantity != other.quantity or paper[one] == paper[other]:
            continue
        held = run[one] > run[other] if paper[one] > paper[other] else run[one] < run[other]
        counted["all"][0] += held
        counted["all"][1] += 1
        if one[2:] == other[2:]:
            counted["rows"][0] += held
            counted["rows"][1] += 1

    def rank(values, value):
        return sum(each < value for each in values) + sum(each == value for each in values) / 2

    def spearman(quantity):
        pairs = [(run[place], paper[place]) for place in paper if place.quantity == quantity]
        ranks = [[rank(values, value) for value in values] for values in zip(*pairs, strict=True)]
        return np.corrcoef(ranks)[0, 1]

    off = [run[place] - paper[place] for place in paper if place.quantity == "detection_percent"]
    logs = [np.log(run[place] / paper[place]) for place in paper if place.quantity == "radius_m"]
    return (
        np.sqrt(sum(each**2 for each in off) / len(off)),
        np.exp(np.sqrt(sum(each**2 for each in logs) / len(logs))),
        *counted["rows"],
        *counted["all"],
        spearman("detection_percent"),
        spearman("radius_m"),
        0,
    )


@pytest.mark.parametrize("decimals", [6, 0])
def test_the_score_is_that_of_a_slow_twin_with_and_without_ties(paper, published, decimals):
    random = np.random.default_rng(decimals)
    run = {place: max(round(value * random.uniform(0.3, 3.0), decimals), 0.5) for place, value in published.items()}
    rounded = {place: max(round(value, decimals), 0.5) for place, value in published.items()}
    for tables in (published, rounded):
        assert paper.score.score(run, tables) == pytest.approx(slow_score(run, tables), rel=1e-12)


def test_the_paper_agrees_with_itself_in_72_and_552_orderings(paper, published):
    assert paper.score.score(published, published) == (0.0, 1.0, 72, 72, 552, 552, 1.0, 1.0, 0)


def test_what_moves_all_numbers_alike_moves_distances_only(paper, published):
    run = {place: 2 * value if place.quantity == "radius_m" else value - 3 for place, value in published.items()}
    assert paper.score.score(run, published) == pytest.approx((3.0, 2.0, 72, 72, 552, 552, 1.0, 1.0, 0))


def test_numbers_in_the_opposite_order_hold_no_ordering(paper, published):
    run = {place: 1 / value for place, value in published.items()}
    found = paper.score.score(run, published)
    assert (found.rows_held, found.pairs_held) == (0, 0)
    assert (found.spearman_detection, found.spearman_radius) == pytest.approx((-1.0, -1.0))


def test_a_rig_that_is_the_same_everywhere_holds_no_ordering(paper, published):
    found = paper.score.score(dict.fromkeys(published, 5.0), published)
    assert (found.rows_held, found.pairs_held) == (0, 0)
    assert np.isnan([found.spearman_detection, found.spearman_radius]).all()


def test_an_unknown_number_is_no_good_score(paper, published):
    place = next(place for place in published if place.quantity == "radius_m")
    found = paper.score.score({**published, place: float("nan")}, published)
    assert found.unknown == 1
    assert (found.rows_held, found.pairs_held) == (72 - 3, 552 - 23)
    assert np.isnan([found.factor, found.spearman_radius]).all()
    assert (found.points, found.spearman_detection) == (0.0, 1.0)
    assert str(found).endswith("; 1 numbers are unknown")


# Pieces


def test_thinning_keeps_at_most_so_many_points_of_each_cell_and_none_of_another(paper):
    grid = BevGrid(x_m=(0.0, 4.0), y_m=(-2.0, 2.0), cell_m=1.0)
    points = torch.rand((500, 3), generator=torch.Generator().manual_seed(0)) * 6 - torch.tensor([1.0, 3.0, 1.0])
    kept = paper.thinning.thinned(points, grid, 3, seed=1)
    before, after = (
        torch.bincount(cell[cell >= 0], minlength=grid.num_cells) for cell in map(grid.find_cells, (points, kept))
    )
    assert after.equal(before.clamp(max=3))
    assert int(after.sum()) == len(kept)
    assert {tuple(point) for point in kept.tolist()} <= {tuple(point) for point in points.tolist()}
    assert kept.equal(paper.thinning.thinned(points, grid, 3, seed=1))
    assert len(paper.thinning.thinned(points[:0], grid, 3, seed=1)) == 0


def test_thinning_keeps_the_expectation_of_the_mean_of_a_cell(paper):
    grid = BevGrid(x_m=(0.0, 1.0), y_m=(0.0, 1.0), cell_m=1.0)
    points = torch.linspace(0.0, 0.99, 40)[:, None].expand(-1, 3)
    means = [float(paper.thinning.thinned(points, grid, 4, seed)[:, 0].mean()) for seed in range(400)]
    assert np.mean(means) == pytest.approx(float(points[:, 0].mean()), abs=4 * np.std(means) / 20)


@pytest.mark.parametrize("square_metres", [False, True])
def test_pieces_merge_to_what_one_run_with_a_block_for_each_says(paper, square_metres, tmp_path):
    grid = BevGrid(x_m=(0.0, 4.0), y_m=(-2.0, 2.0), cell_m=1.0)
    random = torch.Generator().manual_seed(0)
    whole = CoverageMetric(grid, max_radius=10.0, blocks=8, square_metres=square_metres)
    pieces = []
    for first in range(0, 16, 2):
        piece = CoverageMetric(grid, max_radius=10.0, square_metres=square_metres)
        for index in range(first, first + 2):
            clouds = [4 * torch.rand((count, 3), generator=random) - torch.tensor([0, 2, 0.5]) for count in (3, 9)]
            weights = torch.rand(9, generator=random) + 0.1
            for metric in (whole, piece):
                metric.update(*clouds, weights=weights, block_index=index)
        folder = tmp_path / f"{first:05d}"
        paper.pieces.save_piece(folder, {("my/rig.yaml", "known"): piece.compute()})
        pieces.append(folder)
    expected, merged = whole.compute(), paper.pieces.load_merged(pieces, "my/rig.yaml", "known")
    assert merged.counts == expected.counts
    assert merged.measure == ("area" if square_metres else "known")
    assert merged.points.equal(expected.point_counts)
    assert merged.radius.allclose(expected.radius, rtol=1e-12, equal_nan=True)
    for region, height in product(
        (Region("all", grid.x_m, grid.y_m), Region("one", (0.0, 1.0), (-2.0, -1.0))), grid.heights
    ):
        one, other = (coverage.estimate(region, height) for coverage in (merged, expected))
        assert one.value.allclose(other.value, rtol=1e-12, equal_nan=True)
        assert one.error.allclose(other.error, rtol=1e-9, equal_nan=True)


def test_a_piece_that_was_interrupted_while_written_is_none(paper, tmp_path):
    class Full:
        def save(self, path):
            raise OSError("no space left")

    with pytest.raises(OSError, match="no space left"):
        paper.pieces.save_piece(tmp_path / "00000", {("rig", "known"): Full()})
    assert not (tmp_path / "00000").exists()


def test_pieces_of_another_run_are_refused(paper, tmp_path):
    paper.pieces.check_conditions(tmp_path / "pieces", {"seed": 1})
    paper.pieces.check_conditions(tmp_path / "pieces", {"seed": 1})
    with pytest.raises(ValueError, match=r"conditions.json says \{'seed': 1\}, this run is \{'seed': 2\}.*--out"):
        paper.pieces.check_conditions(tmp_path / "pieces", {"seed": 2})


@pytest.mark.parametrize(("pieces", "counts"), [(1, [1]), (4, [1, 4]), (16, [1, 4, 16]), (20, [1, 4, 16, 20])])
def test_scores_are_given_for_four_times_as_many_steps_each_time(paper, pieces, counts):
    assert paper.tables.growing(pieces) == counts


# The reference


def test_the_ego_gives_points_if_they_are_wanted_and_nothing_else_changes():
    frames = SimulatedFrames("courtyard", "front_roof_32", num_frames=1, reference_sensor=PaperReference(32, 32))
    without, with_ego = frames[0], frames.replace_reference_sensor(PaperReference(32, 32, keep_ego_points=True))[0]
    assert len(with_ego.reference) == len(without.reference) + without.counts["reference_self_hits"]
    others = {tuple(point) for point in without.reference.tolist()}
    own = torch.tensor([point for point in with_ego.reference.tolist() if tuple(point) not in others])
    box = Scenario.load("courtyard").compute_ego_box()
    assert len(own) == without.counts["reference_self_hits"] > 50
    assert (own >= torch.tensor(box.lower_m) - 1e-3).all()
    assert (own <= torch.tensor(box.upper_m) + 1e-3).all()


def test_both_references_have_the_range_that_is_asked_for(paper):
    options = Namespace(
        scenario="courtyard", steps=1, seed=0, every=0.1, rays=100, reference_range=120.0, ego_points=True
    )
    asked = paper.measuring.Measurement(
        {"rig": "front_roof_32"}, BevGrid((0, 160), (-40, 40)), forward_regions(), options
    )
    assert asked.frames.reference_sensor == PaperReference(10, 10, max_range_m=120.0, keep_ego_points=True)
    assert asked.surface_frames.reference_sensor.max_range_m == 120.0
    assert asked.surface_frames.reference_sensor.areas == tuple(
        (region.x_m, region.y_m) for region in forward_regions()
    )


# Figure 2


def test_figure_2_is_four_panels_of_one_frame_with_a_colour_bar_for_each_row(paper):
    grid = BevGrid(x_m=(-10.0, 10.0), y_m=(-10.0, 10.0), cell_m=0.5)
    points = torch.ones(grid.shape[1:])
    points[:, :8] = 0.0
    views = [
        SensorView(
            name,
            build_transform(convert_euler_to_rotation(yaw, 0.0, 0.0), (0.0, 0.0, 1.0)),
            90.0,
            (-30.0, 10.0),
            range_m,
        )
        for name, yaw, range_m in (("front", 0.0, float("inf")), ("left", 90.0, 5.0))
    ]
    outline = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0]])
    given = {"steps": 10, "title": "Four", "ego_outline_m": outline, "sensors": views}
    *panels, of_points, of_radius = paper.four_views.draw_four_views(torch.ones(grid.shape), points, grid, **given).axes
    assert [(axes.get_xlim(), axes.get_ylim()) for axes in panels] == [(grid.x_m, grid.y_m)] * 4
    boxes = [axes.get_window_extent() for axes in (*panels, of_points, of_radius)]
    assert len({tuple(box.size.round(6)) for box in boxes[:4]}) == 1
    for panel, bar in ((1, 4), (3, 5)):
        assert boxes[panel].intervaly == pytest.approx(boxes[bar].intervaly)
    assert of_points.get_ylabel().startswith("points in a cell (mean of the steps)")
    assert of_radius.get_ylabel().startswith("mean blind spot radius (m)")
    # Sectors lie where the sensors look, and end at their range.
    wedges = panels[0].patches[:2]
    inside = [[wedge.get_path().contains_point(at, wedge.get_patch_transform()) for wedge in wedges]
              for at in ((9.0, 3.0), (0.0, 4.5), (0.0, 6.5), (-8.0, 0.0))]  # fmt: skip
    assert inside == [[True, False], [False, True], [False, False], [False, False]]
    named = [text.get_text() for text in panels[2].get_legend().get_texts()]
    assert named[:3] == ["field of view: front", "field of view: left", "no point of the rig in any step"]


# The command


@pytest.fixture(scope="module")
def options(tmp_path_factory):
    out = tmp_path_factory.mktemp("paper")
    run = ["--num-frames", "2", "--piece", "1", "--every", "0.1", "--num-rays", "1024", "--scenario", "courtyard"]
    return [*run, "--rigs", "paper_fit_b_{}", "--origin", "-1.4", "--reference-range", "120", "--out", str(out)]


@pytest.fixture(scope="module")
def out(paper, options):
    """The folder of a run of two steps; of the maps, only the first is drawn, and the first of the cameras is made."""

    def write_first(figures, folder):
        paths = write_figures(islice(figures, 1), folder)
        assert [path.stat().st_size > 10_000 for path in paths] == [True]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper.tables, "write_figures", write_first)
        patch.setattr(
            paper.cameras, "write_figures", lambda figures, folder: folder.mkdir(parents=True) or next(figures)
        )
        patch.setattr(sys, "argv", ["paper", *options])
        paper.__main__.main()
    return Path(options[-1])


def test_a_run_leaves_tables_scores_coverage_and_maps(out):
    found = json.loads((out / "tables.json").read_text())
    assert found["options"]["origin"] == -1.4
    assert [(each["measure"], each["steps"]) for each in found["results"]] == [
        (measure, steps) for measure in ("known", "area") for steps in (1, 2)
    ]
    assert {len(each["numbers"]) for each in found["results"]} == {48}
    assert len(list((out / "maps").glob("*/*.png"))) == 1
    pieces = list((out / "pieces").glob("0000[01]/*_*.npz"))
    assert len(pieces) == 2 * 4 * 2
    assert {Coverage.load(piece).grid.x_m for piece in pieces} == {(-1.4, 158.6)}
    assert sorted(path.name for path in (out / "cameras").iterdir()) == [
        "figure_2.png",
        "maps",
        "table.md",
        "three_cameras_area.npz",
        "three_cameras_known.npz",
    ]
    assert min(imread(out / "cameras" / "figure_2.png").shape[:2]) > 1000


def test_the_tables_are_markdown_with_the_numbers_of_the_json(out):
    lines = (out / "tables.md").read_text().splitlines()
    headings, rule, *body = (line.strip("| ").split(" | ") for line in lines if line.startswith("|"))
    assert len(headings) == len(rule)
    assert {len(row) for row in body[:24]} == {len(headings)}
    known, area = (
        {
            (number["quantity"], number["region"], number["height"], number["lidar"]): number
            for number in each["numbers"]
        }
        for each in json.loads((out / "tables.json").read_text())["results"]
        if each["steps"] == 2
    )
    for row in body[:24]:
        for quantity, shown in (("detection_percent", row[3:7]), ("radius_m", row[7:11])):
            one = known[quantity, *row[:3]]
            expected = [one["value"], one["paper"], one["value"] / one["paper"], area[quantity, *row[:3]]["value"]]
            numbers = [float("nan") if cell == "unknown" else float(cell.split()[0]) for cell in shown]
            assert numbers == pytest.approx(expected, abs=0.0051, nan_ok=True)
    assert sum(line.startswith(("known cells: ", "by area: ")) for line in lines) == 2


def test_pieces_that_are_there_are_not_measured_again(paper, out, options, monkeypatch):
    measured = []
    monkeypatch.setattr(paper.measuring.Measurement, "run", lambda self, steps: measured.append(steps) or {})
    monkeypatch.setattr(paper.tables, "write_figures", lambda figures, folder: None)
    monkeypatch.setattr(sys, "argv", ["paper", "tables", *options])
    paper.__main__.main()
    assert measured == []


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["moon"], "no experiment moon; there are tables, cameras"),
        (["--num-frames", "10"], "steps: a multiple of the piece of 16 is needed; got 10"),
        (["--rigs", "mine"], "rigs: {} must stand where the LiDARs differ; got mine"),
        (["--rigs", "mine_{}"], "'mine_grille_128' is neither a .yaml file nor one of the built-in rigs"),
        (["--num-rays", "-1"], "nonnegative"),
        (["--every", "0.15"], "frame_interval_s: a positive multiple of the time step"),
    ],
)
def test_a_mistake_is_said_in_a_line(paper, monkeypatch, capsys, given, message):
    monkeypatch.setattr(sys, "argv", ["paper", *given])
    with pytest.raises(SystemExit, match="2"):
        paper.__main__.main()
    assert message in capsys.readouterr().err
