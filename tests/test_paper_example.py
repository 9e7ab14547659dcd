"""Tests of `python -m examples.paper`: the published tables, the score of a run, and pieces that merge."""

import json
import sys
from argparse import Namespace
from functools import partial
from importlib import import_module
from itertools import combinations, islice, product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from matplotlib.image import imread

from torchcover import BevGrid, Coverage, CoverageMetric, Region, forward_regions
from torchcover.data import SimulatedFrames
from torchcover.geometry import build_transform, convert_euler_to_rotation
from torchcover.report import SensorView, write_figures
from torchcover.report.plot_layout import create_sheets
from torchcover.simulation import PaperReference, Scenario

ROOT = Path(__file__).parents[1]
MODULES = ("__main__", "cameras", "comparison", "four_views", "measuring", "pieces", "published", "tables")


@pytest.fixture(scope="module")
def paper():
    """Modules of the example by name."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT)
        yield SimpleNamespace(**{name: import_module(f"examples.paper.{name}") for name in MODULES})


@pytest.fixture(scope="module")
def published(paper):
    return paper.published.read_published()


# Published tables


def test_tables_share_12_of_60_numbers(paper, published):
    lines = paper.published.TABLES.read_text(encoding="utf-8").splitlines()[1:]
    assert len(lines) == 60
    assert len(published) == 48
    roof = {"1": [], "2": []}
    for line in lines:
        table, _, row = line.partition(",")
        if row.startswith("roof_128,"):
            roof[table].append(row)
    assert sorted(roof["1"]) == sorted(roof["2"])
    keys = product(paper.published.QUANTITIES, paper.published.LIDARS, paper.published.REGIONS, paper.published.BANDS)
    assert set(published) == {paper.published.TableKey(*key) for key in keys}


def test_documented_statements_about_the_tables_hold(paper, published):
    ground = [key for key in published if key.band == "ground"]
    assert len(ground) == 24
    for key in ground:  # both radii and detections are larger at obstacle height
        assert published[key._replace(band="obstacle")] > published[key]
    grille_is_better = set()
    for key in published:
        if key.lidar == "grille_128":
            is_larger = published[key] > published[key._replace(lidar="roof_128")]
            if is_larger == (key.quantity == "detection_percent"):
                grille_is_better.add(key)
    assert {(key.region, key.band) for key in grille_is_better} == {("20m", "ground")}
    near = partial(paper.published.TableKey, "radius_m", region="20m", band="ground")
    assert (published[near("grille_128")], published[near("roof_128")]) == (1.41, 1.93)


def test_contradictory_tables_are_refused(paper, monkeypatch, tmp_path):
    copy = tmp_path / "tables.csv"
    row = "2,roof_128,radius_m,20m,ground,"
    copy.write_text(paper.published.TABLES.read_text().replace(f"{row}1.93", f"{row}1.41"))
    monkeypatch.setattr(paper.published, "TABLES", copy)
    with pytest.raises(ValueError, match=r"1.41 and 1.93 for radius_m roof_128 20m ground"):
        paper.published.read_published.__wrapped__()


# Score of a run


def compute_slow_score(run, paper):
    """Compute the same score pair by pair."""
    agreeing, all_pairs = [0, 0], [0, 0]
    for first, second in combinations(paper, 2):
        if first.quantity != second.quantity or paper[first] == paper[second]:
            continue
        is_larger = paper[first] > paper[second]
        agrees = run[first] > run[second] if is_larger else run[first] < run[second]
        for index, counts in enumerate(((first.region, first.band) == (second.region, second.band), True)):
            agreeing[index] += agrees and counts
            all_pairs[index] += counts

    def compute_rank(values, value):
        return sum(smaller < value for smaller in values) + sum(equal == value for equal in values) / 2

    def compute_spearman(quantity):
        keys = [key for key in paper if key.quantity == quantity]
        ranks = []
        for numbers in (run, paper):
            values = [numbers[key] for key in keys]
            ranks.append([compute_rank(values, value) for value in values])
        return np.corrcoef(ranks)[0, 1]

    differences = [run[key] - paper[key] for key in paper if key.quantity == "detection_percent"]
    log_ratios = [np.log(run[key] / paper[key]) for key in paper if key.quantity == "radius_m"]
    return (
        np.sqrt(np.mean(np.square(differences))),
        np.exp(np.sqrt(np.mean(np.square(log_ratios)))),
        agreeing[0],
        all_pairs[0],
        agreeing[1],
        all_pairs[1],
        compute_spearman("detection_percent"),
        compute_spearman("radius_m"),
        0,
    )


@pytest.mark.parametrize("decimals", [6, 0])
def test_score_equals_a_loop_over_pairs(paper, published, decimals):
    random = np.random.default_rng(decimals)
    run, rounded = {}, {}
    for key, value in published.items():
        run[key] = max(round(value * random.uniform(0.3, 3.0), decimals), 0.5)
        rounded[key] = max(round(value, decimals), 0.5)
    for tables in (published, rounded):
        assert paper.published.compute_score(run, tables) == pytest.approx(compute_slow_score(run, tables), rel=1e-12)


def test_paper_agrees_with_itself(paper, published):
    assert paper.published.compute_score(published, published) == (0.0, 1.0, 72, 72, 552, 552, 1.0, 1.0, 0)


def test_common_shifts_change_only_distances(paper, published):
    run = {key: 2 * value if key.quantity == "radius_m" else value - 3 for key, value in published.items()}
    score = paper.published.compute_score(run, published)
    assert score == pytest.approx((3.0, 2.0, 72, 72, 552, 552, 1.0, 1.0, 0))


def test_reversed_order_agrees_in_no_pair(paper, published):
    run = {key: 1 / value for key, value in published.items()}
    score = paper.published.compute_score(run, published)
    assert (score.agreeing_rows, score.agreeing_pairs) == (0, 0)
    assert (score.spearman_detection, score.spearman_radius) == pytest.approx((-1.0, -1.0))


def test_constant_run_agrees_in_no_pair(paper, published):
    score = paper.published.compute_score(dict.fromkeys(published, 5.0), published)
    assert (score.agreeing_rows, score.agreeing_pairs) == (0, 0)
    assert np.isnan([score.spearman_detection, score.spearman_radius]).all()


def test_missing_number_makes_distances_nan(paper, published):
    key = next(key for key in published if key.quantity == "radius_m")
    score = paper.published.compute_score({**published, key: float("nan")}, published)
    assert score.missing == 1
    assert (score.agreeing_rows, score.agreeing_pairs) == (72 - 3, 552 - 23)
    assert np.isnan([score.radius_factor, score.spearman_radius]).all()
    assert (score.rms_points, score.spearman_detection) == (0.0, 1.0)
    assert str(score).endswith("; 1 numbers are missing")


# Pieces


def test_thinning_caps_the_points_per_cell(paper):
    grid = BevGrid(x_m=(0.0, 4.0), y_m=(-2.0, 2.0), cell_m=1.0)
    points = torch.rand((500, 3), generator=torch.Generator().manual_seed(0)) * 6 - torch.tensor([1.0, 3.0, 1.0])
    thinned = paper.measuring.thin_points(points, grid, 3, seed=1)
    counts = []
    for cloud in (points, thinned):
        cells = grid.find_cells(cloud)
        counts.append(torch.bincount(cells[cells >= 0], minlength=grid.num_cells))
    assert counts[1].equal(counts[0].clamp(max=3))
    assert int(counts[1].sum()) == len(thinned)
    assert {tuple(point) for point in thinned.tolist()} <= {tuple(point) for point in points.tolist()}
    assert thinned.equal(paper.measuring.thin_points(points, grid, 3, seed=1))
    assert len(paper.measuring.thin_points(points[:0], grid, 3, seed=1)) == 0


def test_thinning_preserves_the_expected_cell_mean(paper):
    grid = BevGrid(x_m=(0.0, 1.0), y_m=(0.0, 1.0), cell_m=1.0)
    points = torch.linspace(0.0, 0.99, 40)[:, None].expand(-1, 3)
    means = [float(paper.measuring.thin_points(points, grid, 4, seed)[:, 0].mean()) for seed in range(400)]
    assert np.mean(means) == pytest.approx(float(points[:, 0].mean()), abs=4 * np.std(means) / 20)


@pytest.mark.parametrize("average", ["cells", "area"])
def test_pieces_merge_to_one_run_with_blocks(paper, average, tmp_path):
    grid = BevGrid(x_m=(0.0, 4.0), y_m=(-2.0, 2.0), cell_m=1.0)
    random = torch.Generator().manual_seed(0)
    settings = {"max_radius_m": 10.0, "has_area_weights": average == "area"}
    single_run = CoverageMetric(grid, num_blocks=8, **settings)
    pieces = []
    for first in range(0, 16, 2):
        piece = CoverageMetric(grid, **settings)
        for index in range(first, first + 2):
            clouds = [4 * torch.rand((count, 3), generator=random) - torch.tensor([0, 2, 0.5]) for count in (3, 9)]
            weights = torch.rand(9, generator=random) + 0.1
            for metric in (single_run, piece):
                metric.update(*clouds, weights=weights, block_index=index)
        folder = tmp_path / f"{first:05d}"
        paper.pieces.save_piece(folder, {("my/rig.yaml", average): piece.compute()})
        pieces.append(folder)
    expected, merged = single_run.compute(), paper.pieces.load_merged(pieces, "my/rig.yaml", average)
    assert merged.counts == expected.counts
    assert merged.average == average
    assert merged.point_counts.equal(expected.point_counts)
    assert merged.radius.allclose(expected.radius, rtol=1e-12, equal_nan=True)
    regions = (Region("all", grid.x_m, grid.y_m), Region("corner", (0.0, 1.0), (-2.0, -1.0)))
    for region, band in product(regions, grid.heights):
        merged_estimate, expected_estimate = merged.estimate(region, band), expected.estimate(region, band)
        assert merged_estimate.value.allclose(expected_estimate.value, rtol=1e-12, equal_nan=True)
        assert merged_estimate.error.allclose(expected_estimate.error, rtol=1e-9, equal_nan=True)


def test_interrupted_piece_does_not_exist(paper, tmp_path):
    class FullDisk:
        def save(self, path):
            raise OSError("no space left")

    with pytest.raises(OSError, match="no space left"):
        paper.pieces.save_piece(tmp_path / "00000", {("rig", "cells"): FullDisk()})
    assert not (tmp_path / "00000").exists()


def test_pieces_of_another_run_are_refused(paper, tmp_path):
    paper.pieces.check_conditions(tmp_path / "pieces", {"seed": 1})
    paper.pieces.check_conditions(tmp_path / "pieces", {"seed": 1})
    with pytest.raises(ValueError, match=r"conditions.json: got \{'seed': 2\}, the pieces have \{'seed': 1\}.*--out"):
        paper.pieces.check_conditions(tmp_path / "pieces", {"seed": 2})


@pytest.mark.parametrize(("pieces", "counts"), [(1, [1]), (4, [1, 4]), (16, [1, 4, 16]), (20, [1, 4, 16, 20])])
def test_scores_are_listed_for_powers_of_four(paper, pieces, counts):
    assert paper.tables.list_piece_counts(pieces) == counts


# Reference sensors


def test_ego_points_only_add_points(paper):
    frames = SimulatedFrames("courtyard", "front_roof_32", num_frames=1, reference_sensor=PaperReference(32, 32))
    without, with_ego = frames[0], frames.replace_reference_sensor(PaperReference(32, 32, keep_ego_points=True))[0]
    self_hits = without.counts["reference_self_hits"]
    assert len(with_ego.reference) == len(without.reference) + self_hits
    points = {tuple(point) for point in without.reference.tolist()}
    ego_points = torch.tensor([point for point in with_ego.reference.tolist() if tuple(point) not in points])
    ego_box = Scenario.load("courtyard").compute_ego_box()
    assert len(ego_points) == self_hits > 50
    assert (ego_points >= torch.tensor(ego_box.lower_m) - 1e-3).all()
    assert (ego_points <= torch.tensor(ego_box.upper_m) + 1e-3).all()


def test_both_reference_sensors_have_the_given_range(paper):
    options = Namespace(
        scenario="courtyard",
        num_frames=1,
        seed=0,
        frame_interval_s=0.1,
        num_rays=100,
        reference_range=120.0,
        ego_points=True,
    )
    measurement = paper.measuring.Measurement(
        {"rig": "front_roof_32"}, BevGrid((0, 160), (-40, 40)), forward_regions(), options
    )
    expected = PaperReference(10, 10, max_range_m=120.0, keep_ego_points=True)
    assert measurement.frames.simulator.reference_sensor == expected
    surface_reference = measurement.surface_frames.simulator.reference_sensor
    assert surface_reference.max_range_m == 120.0
    assert surface_reference.areas == tuple((region.x_m, region.y_m) for region in forward_regions())


# Figure 2


def test_figure_2_has_four_equal_panels(paper):
    grid = BevGrid(x_m=(-10.0, 10.0), y_m=(-10.0, 10.0), cell_m=0.5)
    points = torch.ones(grid.shape[1:])
    points[:, :8] = 0.0
    views = []
    for name, yaw_deg, range_m in (("front", 0.0, float("inf")), ("left", 90.0, 5.0)):
        vehicle_T_sensor = build_transform(convert_euler_to_rotation(yaw_deg, 0.0, 0.0), (0.0, 0.0, 1.0))
        views.append(SensorView(name, vehicle_T_sensor, 90.0, (-30.0, 10.0), range_m))
    outline_m = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0]])
    figure = paper.four_views.plot_four_views(
        torch.ones(grid.shape), points, grid, num_frames=10, title="Four", ego_outline_m=outline_m, sensors=views
    )
    *panels, points_bar, radius_bar = figure.axes
    boxes = [axes.get_window_extent() for axes in panels]
    assert len(panels) == 4
    for axes, box in zip(panels, boxes, strict=True):
        assert (axes.get_xlim(), axes.get_ylim()) == (grid.x_m, grid.y_m)
        assert box.size == pytest.approx(boxes[0].size)
    for panel_box, color_bar in ((boxes[1], points_bar), (boxes[3], radius_bar)):
        assert panel_box.intervaly == pytest.approx(color_bar.get_window_extent().intervaly)
    assert points_bar.get_ylabel().startswith("points in a cell (mean of the frames)")
    assert radius_bar.get_ylabel().startswith("mean blind spot radius (m)")
    legend = [text.get_text() for text in panels[2].get_legend().get_texts()]
    assert legend[:3] == ["field of view: front", "field of view: left", "no point of the rig in any frame"]


def test_fields_of_view_end_at_the_range(paper):
    grid = BevGrid(x_m=(-10.0, 10.0), y_m=(-10.0, 10.0), cell_m=0.5)
    (sheet,) = create_sheets(grid)
    views = [SensorView("front", np.eye(4), 90.0, (-30.0, 10.0), float("inf"))]
    vehicle_T_left = build_transform(convert_euler_to_rotation(90.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    views.append(SensorView("left", vehicle_T_left, 90.0, (-30.0, 10.0), 5.0))
    paper.four_views._plot_fields_of_view(sheet, views)
    is_inside = []
    for position in ((9.0, 3.0), (0.0, 4.5), (0.0, 6.5), (-8.0, 0.0)):
        wedges = sheet.axes.patches
        is_inside.append([wedge.get_path().contains_point(position, wedge.get_patch_transform()) for wedge in wedges])
    assert is_inside == [[True, False], [False, True], [False, False], [False, False]]


# Command line


@pytest.fixture(scope="module")
def options(tmp_path_factory):
    out = tmp_path_factory.mktemp("paper")
    run = ["--num-frames", "2", "--piece", "1", "--frame-interval-s", "0.1", "--num-rays", "1024"]
    scene = ["--scenario", "courtyard", "--rigs", "paper_fit_b_{}", "--origin", "-1.4", "--reference-range", "120"]
    return [*run, *scene, "--out", str(out)]


@pytest.fixture(scope="module")
def out(paper, options):
    """Folder of a run of two frames that renders only the first map of the tables, and builds one of the cameras."""

    def write_first(figures, folder):
        paths = write_figures(islice(figures, 1), folder)
        assert [path.stat().st_size > 10_000 for path in paths] == [True]

    def build_first(figures, folder):
        folder.mkdir(parents=True)
        next(figures)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper.tables, "write_figures", write_first)
        patch.setattr(paper.cameras, "write_figures", build_first)
        patch.setattr(sys, "argv", ["paper", *options])
        paper.__main__.main()
    return Path(options[-1])


def test_run_writes_tables_coverages_and_maps(out):
    record = json.loads((out / "tables.json").read_text())
    assert record["options"]["origin"] == -1.4
    runs = [(result["average"], result["num_frames"]) for result in record["results"]]
    assert runs == [("cells", 1), ("cells", 2), ("area", 1), ("area", 2)]
    assert {len(result["numbers"]) for result in record["results"]} == {48}
    assert len(list((out / "maps").glob("*/*.png"))) == 1
    pieces = list((out / "pieces").glob("0000[01]/*_*.npz"))
    assert len(pieces) == 2 * 4 * 2
    assert {Coverage.load(piece).grid.x_m for piece in pieces} == {(-1.4, 158.6)}
    assert sorted(path.name for path in (out / "cameras").iterdir()) == [
        "figure_2.png",
        "maps",
        "table.md",
        "three_cameras_area.npz",
        "three_cameras_cells.npz",
    ]
    assert min(imread(out / "cameras" / "figure_2.png").shape[:2]) > 1000


def test_markdown_tables_have_the_json_numbers(out):
    lines = (out / "tables.md").read_text().splitlines()
    headings, rule, *rows = (line.strip("| ").split(" | ") for line in lines if line.startswith("|"))
    assert len(headings) == len(rule)
    assert {len(row) for row in rows[:24]} == {len(headings)}
    numbers = {}
    for result in json.loads((out / "tables.json").read_text())["results"]:
        if result["num_frames"] == 2:
            for number in result["numbers"]:
                key = (number["quantity"], number["region"], number["band"], number["lidar"])
                numbers[result["average"], *key] = number
    for row in rows[:24]:
        for quantity, cells in (("detection_percent", row[3:7]), ("radius_m", row[7:11])):
            number, by_area = numbers["cells", quantity, *row[:3]], numbers["area", quantity, *row[:3]]
            expected = [number["value"], number["paper"], number["value"] / number["paper"], by_area["value"]]
            values = [float("nan") if cell == "unknown" else float(cell.split()[0]) for cell in cells]
            assert values == pytest.approx(expected, abs=0.0051, nan_ok=True)
    assert sum(line.startswith(("by cells: ", "by area: ")) for line in lines) == 2


def test_existing_pieces_are_not_measured_again(paper, out, options, monkeypatch):
    measured = []
    monkeypatch.setattr(paper.measuring.Measurement, "run", lambda self, frames: measured.append(frames) or {})
    monkeypatch.setattr(paper.tables, "write_figures", lambda figures, folder: None)
    monkeypatch.setattr(sys, "argv", ["paper", "tables", *options])
    paper.__main__.main()
    assert measured == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["moon"], "unknown experiment moon; use tables, cameras"),
        (["--num-frames", "10"], "--num-frames: got 10; give a multiple of the piece of 16"),
        (["--rigs", "mine"], "--rigs: got mine; put {} in place of the name of the LiDAR"),
        (["--rigs", "mine_{}"], "'mine_grille_128' is neither a .yaml file nor one of the built-in rigs"),
        (["--num-rays", "-1"], "nonnegative"),
        (["--frame-interval-s", "0.15"], "frame_interval_s: a positive multiple of the time step"),
    ],
)
def test_invalid_option_ends_with_one_message(paper, monkeypatch, capsys, arguments, message):
    monkeypatch.setattr(sys, "argv", ["paper", *arguments])
    with pytest.raises(SystemExit, match="2"):
        paper.__main__.main()
    assert message in capsys.readouterr().err
