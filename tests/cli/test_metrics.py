"""Setting `metrics`: published metrics in addition to the coverage."""

import csv
import json
import shutil

import numpy as np
import pytest

from torchcover import Coverage
from torchcover.evaluation import evaluate


def run(torchcover, scenes, *rigs, command="compare", options=(), out="out", num_frames=2):
    arguments = [
        "--scenario",
        scenes / "yard.yaml",
        "--num-frames",
        num_frames,
        "--set",
        "cell_m=4",
        "--thresholds-m",
        2,
        "--num-rays",
        4096,
    ]
    paths = [scenes / f"{rig}.yaml" for rig in rigs]
    folder = scenes / out
    return *torchcover(command, *paths, *arguments, "--out", folder, *options), folder


def test_three_rigs_have_rank_correlations_in_all_files(torchcover, scenes):
    code, printed, error, out = run(torchcover, scenes, "low", "both", "other/low", options=["--set", "metrics=all"])
    assert (code, error.count("warning")) == (0, 0)
    assert "None of these metrics is validated" in printed
    assert "m_sog: only for ranks" in " ".join(printed.split())
    summary = json.loads((out / "summary.json").read_text())
    numbers = {(row["rig"], row["name"]): row for row in summary["metrics"]["numbers"]}
    assert numbers["both", "points"]["rank"] == 1.0
    assert numbers["both", "k_cover_1_2m"]["value"] >= numbers["low", "k_cover_1_2m"]["value"]
    assert numbers["low", "object_coverage_2m:bus"]["value"] is None
    notes = summary["metrics"]["notes"]
    assert sum(note.startswith("s_mig, s_mig_occluded: S-MIG falls") for note in notes) == 1
    assert sum(note.startswith("m_sog: only for ranks") for note in notes) == 1
    with (out / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(summary["metrics"]["numbers"])
    assert {row["rig"] for row in rows} == {"low", "both", "low_2"}
    with (out / "metrics_rank_correlation.csv").open() as file:
        taus = list(csv.DictReader(file))
    assert len(taus) == len(summary["metrics"]["tau"]) > 50
    assert all(tau["low"] == "" for tau in taus)  # two frames are too few for resampling
    assert {"metrics.csv", "metrics_rank_correlation.csv"} <= set(summary["files"])
    page = (out / "report.html").read_text()
    assert "Published metrics" in page
    assert "tau-b" in page


def test_two_rigs_have_no_rank_correlation(torchcover, scenes):
    _, printed, _, out = run(torchcover, scenes, "low", "both", options=["--set", "metrics=point_density"])
    assert "needs at least three rigs" in " ".join(printed.split())
    assert json.loads((out / "summary.json").read_text())["metrics"]["tau"] == []


def test_metrics_do_not_change_the_coverage(torchcover, scenes):
    code, printed, _, out = run(torchcover, scenes, "both", command="evaluate", options=["--set", "metrics=k_cover"])
    assert code == 0
    assert "k_cover_2_2m" in printed
    *_, plain = run(torchcover, scenes, "both", command="evaluate", out="plain")
    with_metrics, without = (Coverage.load(folder / "coverage.npz") for folder in (out, plain))
    np.testing.assert_array_equal(with_metrics.radius, without.radius)
    np.testing.assert_array_equal(with_metrics.point_counts, without.point_counts)


def test_unknown_metric_lists_all_metrics(torchcover, scenes):
    code, _, error, _ = run(torchcover, scenes, "low", "both", options=["--set", "metrics=nosuch"])
    assert code == 2
    assert error.count("\n") == 1
    assert "k_cover" in error
    assert "'nosuch'" in error


def test_resumed_run_continues_its_metrics(torchcover, scenes):
    options = ["--set", "metrics=all"]
    run(torchcover, scenes, "low", "both", options=options, num_frames=1)
    code, *_, out = run(torchcover, scenes, "low", "both", options=[*options, "--resume"], num_frames=3)
    *_, whole = run(torchcover, scenes, "low", "both", options=options, num_frames=3, out="whole")
    assert code == 0
    assert (out / "metrics.csv").read_text() == (whole / "metrics.csv").read_text()


@pytest.mark.filterwarnings("ignore:.*edited since it was recorded")
def test_recording_without_boxes_has_metrics_without_boxes(torchcover, scenes):
    torchcover(
        "record", scenes / "both.yaml", "--out", scenes / "drive", "--scenario", scenes / "yard.yaml", "--num-frames", 2
    )
    shutil.rmtree(scenes / "drive" / "boxes")
    code, printed, error = torchcover(
        "evaluate",
        "--frames",
        scenes / "drive",
        "--set",
        "metrics=all",
        "--set",
        "cell_m=4",
        "--out",
        scenes / "of",
    )
    assert code == 0, error
    assert "point_density" in printed
    assert "Without false_visible" in " ".join(printed.split())


def test_intervals_of_rank_correlations_are_reproducible(scenes):
    def compute_taus():
        result = evaluate(
            [scenes / f"{rig}.yaml" for rig in ("low", "both", "other/low")],
            scenes / "yard.yaml",
            num_frames=9,
            cell_m=4.0,
            thresholds_m=2.0,
            num_rays=2048,
            metrics="k_cover",
        )
        return [tau for tau in result.metrics.compute_taus() if tau.first == "k_cover_1_2m"]

    first = compute_taus()
    finite = [tau for tau in first if not np.isnan(tau.low)]
    assert finite
    for tau in finite:
        assert -1 <= tau.low <= tau.high <= 1
    assert repr(compute_taus()) == repr(first)


@pytest.mark.parametrize("metrics", ["", ()])
def test_empty_list_of_metrics_computes_none(scenes, metrics):
    result = evaluate(
        [scenes / "low.yaml", scenes / "both.yaml"],
        scenes / "yard.yaml",
        num_frames=1,
        cell_m=4.0,
        num_rays=1024,
        metrics=metrics,
    )
    assert result.metrics is None
    assert "metrics" not in result.record
