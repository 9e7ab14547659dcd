"""Parts of the example that trains a detector: closed forms, and a run on frames of random points."""

import importlib.util
import math
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.stats import spearmanr
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from torchcover.data import Frame
from torchcover.detection import Boxes, RecallByVisibility, find_points_in_boxes

EXAMPLE = Path(__file__).parents[2] / "examples" / "train_detector.py"


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("train_detector", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def cars(count, seed):
    """Sample (N, 7) cars in the region, at least 6 m apart."""
    generator = torch.Generator().manual_seed(seed)
    place = torch.randperm(64, generator=generator)[:count]
    rows = torch.rand(count, 7, generator=generator) * torch.tensor([0.4, 0.4, 1.0, 3.0, 1.0, 1.0, 6.0])
    corner = torch.stack([place % 8 * 6.4 + 3.0, place // 8 * 6.4 - 22.6], dim=1)
    return rows + torch.cat([corner, torch.tensor([[0.5, 2.0, 1.5, 1.0, -3.0]]).expand(count, 5)], dim=1)


def answer_to(example, rows, scores):
    """Create the output of a perfect network: heat map and boxes of one frame."""
    _, _, row, column, expected = example.encode(rows)
    heat, boxes = torch.full((64, 64), -20.0), torch.zeros(8, 64, 64)
    heat[row, column] = scores.logit()
    boxes[:, row, column] = expected
    return heat, boxes


def test_decoding_gives_back_what_was_encoded(example):
    rows, scores = cars(20, seed=0), torch.linspace(0.9, 0.1, 20)
    result, found_scores = example.decode(*answer_to(example, rows, scores))
    torch.testing.assert_close(found_scores, scores)
    torch.testing.assert_close(result[:, :6], rows[:, :6], atol=1e-4, rtol=0)
    torch.testing.assert_close(torch.exp(1j * result[:, 6]), torch.exp(1j * rows[:, 6]))


def test_objects_beyond_the_region_are_not_encoded(example):
    rows = cars(4, seed=1)
    rows[0, 0], rows[1, 1], rows[2, 1] = 52.0, 25.7, -26.5
    assert example.encode(rows)[4].shape == (8, 1)


def test_loss_grows_with_the_error_of_boxes(example):
    rows = cars(10, seed=2)
    heat, boxes = answer_to(example, rows, torch.full((10,), 0.99999))
    assert example.compute_loss(heat[None], boxes[None], [rows]) < 1e-4
    assert example.compute_loss(heat[None], boxes[None] + 0.1, [rows]) == pytest.approx(8 * 0.1 / 2, abs=1e-4)
    assert example.compute_loss(-heat[None], boxes[None], [rows]) > 10
    assert example.compute_loss(torch.full((1, 64, 64), -20.0), boxes[None], [rows[:0]]) < 1e-4


def test_network_is_invariant_to_point_order(example):
    torch.manual_seed(0)
    detector = example.Detector().eval()
    clouds = [
        torch.rand(n, 3) * torch.tensor([60.0, 60.0, 3.0]) - torch.tensor([4.0, 30.0, 0.5]) for n in (900, 0, 500)
    ]
    heat, boxes = detector(clouds)
    assert (heat.shape, boxes.shape) == ((3, 64, 64), (3, 8, 64, 64))
    shuffled, _ = detector([clouds[0][torch.randperm(900)]])
    torch.testing.assert_close(shuffled[0], heat[0], atol=1e-4, rtol=1e-4)
    assert (heat[0] - heat[2]).abs().max() > 1e-3


def measure_average_precision(example, frames):
    metric = RecallByVisibility(score_thresholds=example.SCORES)
    for x_found, scores, x_there in frames:
        result, there = (
            torch.tensor([[x, 0.0, 1.0, 4.0, 2.0, 1.5, 0.0] for x in xs]).view(-1, 7) for xs in (x_found, x_there)
        )
        metric.update(result, Boxes.from_rows(there), torch.ones(len(there)), torch.tensor(scores))
    return example.compute_average_precision(metric.compute())


def test_average_precision_in_closed_form(example):
    assert measure_average_precision(example, [([9.0, 19.0], [0.9, 0.8], [9.0, 19.0])]) == 1.0
    # Half of the objects: recalls 0 to 0.5 of 101.
    assert measure_average_precision(example, [([9.0], [0.9], [9.0, 19.0])]) == pytest.approx(51 / 101)
    # Only false detections, and none at all.
    assert measure_average_precision(example, [([40.0], [0.9], [9.0])]) == 0.0
    assert measure_average_precision(example, [([], [], [9.0])]) == 0.0
    # True, false, true: precision 1 below a recall of 0.5, then from 1/2 in a line to 2/3.
    expected = (50 + 51 * (1 / 2 + 2 / 3) / 2) / 101
    assert measure_average_precision(example, [([9.0, 40.0, 19.0], [0.9, 0.7, 0.5], [9.0, 19.0])]) == pytest.approx(
        expected
    )
    # If the false one comes last, it costs the recall of 1 alone: of equal recalls the last precision counts.
    expected = (100 + 2 / 3) / 101
    assert measure_average_precision(example, [([9.0, 40.0, 19.0], [0.9, 0.3, 0.5], [9.0, 19.0])]) == pytest.approx(
        expected
    )
    assert math.isnan(measure_average_precision(example, [([9.0], [0.9], [])]))


def test_average_precision_is_computed_per_range_bin(example):
    metric = RecallByVisibility(visibility_borders=(0.5,), score_thresholds=example.SCORES)
    there = torch.tensor([[x, 0.0, 1.0, 4.0, 2.0, 1.5, 0.0] for x in (9.0, 19.0, 29.0)])
    # Two detections match both well visible objects; the third object is missed.
    result = there[:2]
    metric.update(result, Boxes.from_rows(there), torch.tensor([0.9, 0.8, 0.1]), torch.tensor([0.9, 0.8]))
    counts = metric.compute()
    assert counts.compute_curve("visibility").bins[:2] == ("0-0.5", "0.5-1")
    assert (example.compute_average_precision(counts, 1), example.compute_average_precision(counts, 0)) == (
        1.0,
        pytest.approx(1 / 101),
    )
    assert math.isnan(example.compute_average_precision(counts, 2))
    assert example.compute_average_precision(counts) == pytest.approx(67 / 101)


def test_changes_are_reported_where_seeds_agree(example, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")
    counts = SimpleNamespace(objects=torch.tensor([[1, 1], [1, 1]]))
    # Of three seeds, in all, below and above a share of 0.5.
    values = np.array([[[0.5, 0.2, 0.8]] * 3, [[0.6, 0.1, 0.8], [0.61, 0.3, 0.9], [0.59, 0.2, 0.7]]])
    example.print_label_comparison(values, ["all", "0-0.5", "0.5-1"], counts, example.Console())
    lines = [line for line in capsys.readouterr().out.splitlines() if "±" in line]
    assert ["not significant" in line for line in lines] == [False, True, True]
    assert "+0.100 ± 0.025" in lines[0]  # 4.30 times 0.01 / sqrt(3)


@pytest.mark.parametrize("levels", [3, 10, 1000])
def test_rank_correlation_is_that_of_scipy(example, levels):
    generator = np.random.default_rng(levels)
    a = generator.integers(levels, size=60).astype(float)
    b = a + generator.integers(levels, size=60)
    assert example.compute_spearman(a, b) == pytest.approx(spearmanr(a, b).statistic, abs=1e-12)
    assert example.compute_spearman(a, -(a**3)) == pytest.approx(-1.0)


def test_what_does_not_vary_has_no_rank_correlation(example):
    assert math.isnan(example.compute_spearman(np.zeros(5), np.arange(5.0)))
    assert math.isnan(example.compute_spearman(np.array([]), np.array([])))


def objects_of(found):
    """Sample 100 cars in 10 drives: drive, x, y, visibility, score."""
    generator = np.random.default_rng(3)
    x, y, visibility = generator.uniform(0, 50, 100), generator.uniform(-25, 25, 100), generator.uniform(size=100)
    return np.column_stack([np.arange(100) // 10, x, y, visibility, found(visibility)])


def test_correlation_over_drives_has_an_interval(example):
    noisy = objects_of(lambda visibility: visibility + np.random.default_rng(4).normal(0, 0.3, 100))
    value, low, high = example.bootstrap_over_drives(noisy, example.correlate_visibility_with_score, num_samples=200)
    assert value == pytest.approx(spearmanr(noisy[:, 3], noisy[:, 4]).statistic)
    assert 0.3 < low < value < high < 1.0
    nothing = objects_of(np.zeros_like)
    for statistic in (example.correlate_visibility_with_score, example.correlate_visibility_with_recall):
        for objects in (nothing, nothing[:0]):
            assert all(
                math.isnan(number) for number in example.bootstrap_over_drives(objects, statistic, num_samples=10)
            )


def test_correlation_over_cells_compares_means_and_recalls(example):
    # Three cells of 6 cars: visible and found more and more.
    cell, k = np.repeat(np.arange(3), 6), np.tile(np.arange(6), 3)
    result = np.where(k < 2 * cell + 1, 0.9, 0.1)
    objects = np.column_stack([np.zeros(18), 6.4 * cell + 1.0, np.ones(18), 0.3 * cell + 0.01 * k, result])
    assert example.correlate_visibility_with_recall(objects) == pytest.approx(1.0)
    assert math.isnan(example.correlate_visibility_with_recall(objects, min_cars=7))


def random_frames(num_frames, seed, reference, name, keep_clouds):
    """Replace the simulation by cars of random points, with more points for one of two rigs."""
    frames = []
    for index in range(num_frames):
        generator = torch.Generator().manual_seed(1000 * seed + index)
        rows = cars(8, seed=1000 * seed + index)
        rows[:, 6] = 0.0
        points = (torch.rand(8, 60, 3, generator=generator) - 0.5) * rows[:, None, 3:6] + rows[:, None, :3]
        sensors = {"front_roof_128": points[:, :40].reshape(-1, 3), "front_roof_32": points[:4, :20].reshape(-1, 3)}
        boxes = Boxes.from_rows(rows, categories=("car",) * 8)
        hits = {
            rig: find_points_in_boxes(cloud, boxes).box_indices.bincount(minlength=8) for rig, cloud in sensors.items()
        }
        boxes = Boxes.from_rows(rows, categories=("car",) * 8, points_in_box=hits)
        clouds = {**sensors, **{f"network {rig}": cloud for rig, cloud in sensors.items()}}
        weights = torch.rand(160, generator=generator) + 0.1
        reference = points[:, 40:].reshape(-1, 3)
        drawn = {"reference_weights": weights, "reference_heights_m": reference[:, 2]}
        frames.append(Frame(clouds, reference, index, "f", **drawn, boxes=boxes))
    return frames


def test_labels_are_compared_from_several_seeds(example, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(example, "simulate", random_frames)
    options = {"--train": 8, "--validate": 8, "--epochs": 1, "--labels": 2, "--out": tmp_path}
    monkeypatch.setattr(sys, "argv", ["train_detector.py", *(str(word) for pair in options.items() for word in pair)])
    monkeypatch.setenv("COLUMNS", "160")
    example.main()
    said = capsys.readouterr().out
    assert "cars are visible" in said
    assert "AP, visible cars" in said


def test_small_run_trains_both_rigs_and_logs(example, tmp_path, monkeypatch, capsys, blank_maps):
    monkeypatch.setattr(example, "simulate", random_frames)
    options = {"--train": 8, "--validate": 16, "--epochs": 2, "--out": tmp_path}
    monkeypatch.setattr(sys, "argv", ["train_detector.py", *(str(word) for pair in options.items() for word in pair)])
    monkeypatch.setenv("COLUMNS", "200")
    example.main()
    said = capsys.readouterr().out
    for rig in example.RIGS:
        assert f"{rig}, all: Spearman" in said
        assert f"{rig}: coverage took" in said
        events = EventAccumulator(str(tmp_path / rig))
        events.Reload()
        tags = {"val/AP", f"coverage/{rig}/val/detection_0.4m/0-51m/body", "val/recall/visibility 0.8-1"}
        tags |= {f"coverage/{rig}/val/detection_0.4m_error/0-51m/body"}
        assert tags <= set(events.Tags()["scalars"])
        assert all(len(events.Scalars(tag)) == 2 for tag in tags)
        assert all(math.isfinite(events.Scalars(tag)[1].value) for tag in tags if "recall" not in tag)
    assert "detected within" in said
    assert (tmp_path / "detector.png").stat().st_size > 20_000
