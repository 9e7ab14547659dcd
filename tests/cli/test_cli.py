"""Command line: results agree between files, and every user error is one line."""

import csv
import io
import json
import re
import subprocess
import sys
from itertools import count

import numpy as np
import pytest
import torch
from rich.console import Console

from torchcover import Coverage, nearest
from torchcover.coverage import CoverageSums
from torchcover.simulation import REFERENCE_SENSORS, list_builtin_names, load_builtin_documents

SKIPPING = ("--set", "skip_bad_frames=true")
CELL_1M = ("--set", "cell_m=1")
CELL_4M = ("--set", "cell_m=4")


@pytest.fixture
def recording(tmp_path):
    """Recording of four frames with a line of reference points that starts at the only sensor point."""
    folder = tmp_path / "recording"
    for source in ("sensor", "reference"):
        (folder / source).mkdir(parents=True)
    line = np.stack([np.arange(0.125, 10.0, 0.25), np.full(40, 0.125), np.zeros(40)], axis=1)
    for frame in (1, 2, 10, 11):
        np.save(folder / "sensor" / f"f{frame}.npy", np.array([[0.125, 0.125, 0.0]], dtype=np.float32))
        np.save(folder / "reference" / f"f{frame}.npy", line.astype(np.float32))
    return folder


def test_files_of_an_evaluated_recording_agree(drawn_maps, torchcover, recording, tmp_path):
    out = tmp_path / "out"
    code, printed, _ = torchcover(
        "evaluate", "--frames", recording, "--out", out, "--thresholds-m", 0.4, "--thresholds-m", 1
    )
    assert code == 0
    assert str(out) in printed.replace("\n", "")
    coverage = Coverage.load(out / "coverage.npz")
    # Cell k along the line is k cells from the only sensor point.
    row = coverage.radius[0, 160, 160:200]
    np.testing.assert_allclose(row, 0.25 * np.arange(40), atol=1e-6)
    assert coverage.thresholds_m == (0.4, 1.0)
    assert coverage.counts["num_frames"] == 4
    summary = json.loads((out / "summary.json").read_text())
    assert summary["complete"] is True
    assert summary["counts"]["num_frames"] == 4
    first = coverage.summary()[0]
    assert summary["rows"][0]["radius_m"] == pytest.approx(first.numbers["radius_m"].value)
    assert summary["rows"][0]["observed_cells"] == 40
    with (out / "summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 6
    assert sorted(path.name for path in (out / "maps").iterdir()) == [
        "detection_0.4m_ground.png",
        "detection_0.4m_obstacle.png",
        "detection_1m_ground.png",
        "detection_1m_obstacle.png",
        "radius_m_ground.png",
        "radius_m_obstacle.png",
    ]


def test_num_frames_limits_a_recording(torchcover, recording, tmp_path):
    assert torchcover("evaluate", "--frames", recording, "--out", tmp_path / "o", "--num-frames", 3)[0] == 0
    assert Coverage.load(tmp_path / "o" / "coverage.npz").counts["num_frames"] == 3


@pytest.mark.parametrize("workers", [0, 2])
def test_bad_frame_stops_and_keeps_earlier_frames(torchcover, recording, tmp_path, workers):
    (recording / "reference" / "f10.npy").write_bytes(b"rubbish")
    out = tmp_path / "out"
    code, _, error = torchcover("evaluate", "--frames", recording, "--out", out, "--num-workers", workers)
    assert code == 2
    assert "torchcover: f10 (frame 2): " in error
    assert "Traceback" not in error
    assert Coverage.load(out / "coverage.npz").counts["num_frames"] == 2
    assert json.loads((out / "summary.json").read_text())["complete"] is False


@pytest.mark.parametrize("workers", [0, 2])
def test_skipped_bad_frames_are_counted(torchcover, recording, tmp_path, workers):
    (recording / "reference" / "f10.npy").write_bytes(b"rubbish")
    out = tmp_path / "out"
    code, printed, _ = torchcover("evaluate", "--frames", recording, "--out", out, *SKIPPING, "--num-workers", workers)
    assert code == 0
    assert "skipped: f10" in printed
    summary = json.loads((out / "summary.json").read_text())
    assert summary["counts"]["num_frames"] == 3
    assert len(summary["skipped_frames"]) == 1
    assert "f10" in summary["skipped_frames"][0]


def test_recording_without_good_frames_writes_nothing(torchcover, recording, tmp_path):
    for path in (recording / "sensor").iterdir():
        path.write_bytes(b"rubbish")
    code, _, error = torchcover("evaluate", "--frames", recording, "--out", tmp_path / "o", *SKIPPING)
    assert code == 2
    assert "no frame could be used" in error
    assert not (tmp_path / "o").exists()


def test_simulation_is_reproducible(torchcover, tmp_path):
    (tmp_path / "rig.yaml").write_text(
        "name: tiny\nsensors:\n  - {name: top, mount: {z_m: 2.0}, channels: 8, vertical_fov_deg: [-30, 0],"
        " horizontal_fov_deg: 360, columns: 90, max_range_m: 60}\n"
    )
    for out in ("a", "b"):
        arguments = [
            "--num-frames",
            1,
            "--set",
            "cell_m=1",
            "--reference",
            "paper",
            "--num-rays",
            16384,
            "--out",
            tmp_path / out,
        ]
        assert torchcover("evaluate", tmp_path / "rig.yaml", *arguments)[0] == 0
    a, b = (Coverage.load(tmp_path / out / "coverage.npz") for out in "ab")
    np.testing.assert_array_equal(a.radius, b.radius)
    assert a.grid.cell_m == 1.0
    assert a.max_radius_m == pytest.approx(a.grid.diagonal_m)
    assert 0 < a.summary()[0].observed_share <= 1
    summary = json.loads((tmp_path / "a" / "summary.json").read_text())
    assert summary["frame_counts"]["reference_rays"] == 128 * 128
    # The note lists all self hits of the frame by sensor.
    self_hits = summary["frame_counts"]["sensor_self_hits"]
    notes = [f"Rays that end on the own vehicle: top {self_hits} of 720 ({self_hits / 720:.1%})."]
    assert self_hits > 50
    assert summary["reference"] == {
        "sensor": "paper",
        "rays_per_frame": 128 * 128,
        "frame_interval_s": 0.1,
        "notes": notes,
    }


def test_metric_receives_area_weights_of_the_reference(torchcover, scenes, monkeypatch):
    calls = []

    def record_call(self, sensor, reference, **more):
        calls.append((len(reference), more["weights"], more["block_index"]))
        return sums_of(self, sensor, reference, **more)

    sums_of = CoverageSums.compute_sums
    monkeypatch.setattr(CoverageSums, "compute_sums", record_call)
    options = [
        "--scenario",
        scenes / "yard.yaml",
        "--num-frames",
        2,
        "--set",
        "cell_m=4",
        "--num-rays",
        4096,
        "--out",
        scenes / "out",
    ]
    for reference in ("surface", "paper"):
        assert torchcover("evaluate", scenes / "low.yaml", *options, "--reference", reference)[0] == 0
    (points, weights, _), _, (_, no_weights, _), _ = calls
    assert weights.shape == (points,)
    assert float(weights.max() / weights.min()) > 2
    assert no_weights is None
    assert [index for *_, index in calls] == [0, 1, 0, 1]


@pytest.mark.parametrize("name", REFERENCE_SENSORS)
def test_reference_sensors_have_averages_and_are_in_help(torchcover, scenes, name):
    options = [
        "--scenario",
        scenes / "yard.yaml",
        "--num-frames",
        1,
        "--set",
        "cell_m=4",
        "--num-rays",
        1024,
        "--out",
        scenes / "out",
    ]
    assert torchcover("evaluate", scenes / "low.yaml", *options, "--reference", name)[0] == 0
    summary = json.loads((scenes / "out" / "summary.json").read_text())
    by_area = REFERENCE_SENSORS[name].has_area_weights
    assert (summary["reference"]["sensor"], summary["average"]) == (name, "area" if by_area else "cells")
    assert Coverage.load(scenes / "out" / "coverage.npz").average == summary["average"]
    assert name in torchcover("evaluate", "--help")[1]


def test_cell_average_is_equal_in_both_averages(torchcover, scenes):
    options = ["--scenario", scenes / "yard.yaml", "--num-frames", 2, "--set", "cell_m=4", "--num-rays", 1024, "--out"]
    rows = {}
    for average in ("area", "cells"):
        assert (
            torchcover("evaluate", scenes / "low.yaml", *options, scenes / average, "--set", f"average={average}")[0]
            == 0
        )
        summary = json.loads((scenes / average / "summary.json").read_text())
        assert summary["average"] == average
        rows[average] = summary["rows"]
    for area, cells in zip(rows["area"], rows["cells"], strict=True):
        assert area["cells_radius_m"] == cells["radius_m"]
        assert area["observed_share"] == cells["observed_share"]
    assert any(area["radius_m"] != cells["radius_m"] for area, cells in zip(rows["area"], rows["cells"], strict=True))


def test_skipped_frames_keep_their_block_index(torchcover, recording, tmp_path, monkeypatch):
    (recording / "reference" / "f2.npy").write_bytes(b"rubbish")
    sums_of, block_indices = CoverageSums.compute_sums, []
    monkeypatch.setattr(
        CoverageSums,
        "compute_sums",
        lambda self, *clouds, **more: block_indices.append(more["block_index"]) or sums_of(self, *clouds, **more),
    )
    assert torchcover("evaluate", "--frames", recording, *SKIPPING, "--out", tmp_path / "out")[0] == 0
    assert block_indices == [0, 2, 3]


def test_too_few_frames_for_intervals_are_reported(torchcover, recording, tmp_path):
    _, printed, _ = torchcover("evaluate", "--frames", recording, "--out", tmp_path / "out")
    assert "Not enough frames for an answer: 4 frames form 4 blocks, 9 are needed" in printed
    assert "Brackets: 95" not in printed
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["reference"]["sensor"], summary["target_error"]) == ("recorded", None)
    assert (summary["blocks"], summary["frames_per_block"]) == (4, 1)
    assert summary["rows"][0]["radius_m_error"] is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["evaluate"], "which rig?"),
        (["evaluate", "no_such_rig"], "neither a .yaml file nor one of the built-in rigs; is "),
        (["evaluate", "front_rof_128"], "is 'front_roof_128' or "),
        (["evaluate", "front_roof_128", "--scenario", "moon"], "one of the built-in scenarios; is "),
        (["evaluate", "none.yaml"], "none.yaml: no such file"),
        (["evaluate", "--frames", "no_such_folder"], "no_such_folder"),
        (["evaluate", "kitti", "--scenario", "courtyard", "--frames", "recording"], "exclude each other"),
        (["evaluate", "front_roof_128", "--set", "cell_m=0.3"], "not a multiple of the cell of 0.3 m"),
        (
            ["evaluate", "front_roof_128", "--set", "cell_m=20"],
            "region '20m' holds no cell center; use smaller cells than 20 m",
        ),
        (["evaluate", "front_roof_128", "--set", "cell_m=1e-310"], "x_m: inf cells of 1e-310 m, over 100,000,000"),
        (["evaluate", "front_roof_128", "--thresholds-m", "inf"], "thresholds"),
        (
            ["evaluate", "front_roof_128", "--num-rays", "99999999999"],
            "rays per frame (230,400 of the rig's sensors, 99,999",
        ),
        (
            ["evaluate", "front_roof_128", "--num-frames", "9" * 20],
            "num_frames: a number from 1 to 1,000,000,000 is needed",
        ),
        (
            ["evaluate", "front_roof_128", "--num-workers", "1000000"],
            "1,000,000 workers: 3e+05 GB of memory are needed",
        ),
        (["evaluate", "front_roof_128", "--device", "meta"], "device meta: cannot be used here"),
        (["evaluate", "front_roof_128", "--set", "cell_m=-1"], "cell_m: a positive length"),
        (["evaluate", "front_roof_128", "--thresholds-m", "-1"], "thresholds_m: finite distances >= 0"),
        (
            ["evaluate", "front_roof_128", "--num-frames", "0"],
            "--num-frames: a number of at least 1 is needed",
        ),
        (["evaluate", "front_roof_128", "--num-frames", "many"], "--num-frames: an integer is needed; got 'many'"),
        (["evaluate", "front_roof_128", "--seed", "-1"], "--seed: a number of at least 0 is needed; got '-1'"),
        (["evaluate", "front_roof_128", "--thresholds-m", "a"], "--thresholds-m: a number is needed; got 'a'"),
        (["search", "space.yaml", "--average", "mean"], "--average: 'mean' is not one of 'area', 'cells'"),
        (["evaluate", "front_roof_128", "--device", "abacus"], "device abacus: cannot be used here"),
        (["evaluate", "front_roof_128", "--device", "cuda:99"], "device cuda:99: cannot be used here"),
        (["evaluate", "front_roof_128", "--device", "hpu"], "device hpu: cannot be used here"),
        (["evaluate", "front_roof_128", "--colour"], "No such option"),
        (["evaluate", "front_roof_128", "--target-error", "5"], "target error 5: a positive number with its unit"),
        (["evaluate", "front_roof_128", "--target-error", "-1m"], "target error -1m: a positive number"),
        (["evaluate", "front_roof_128", "--target-error", "1m", "--target-error", "2m"], "another number in m"),
        (
            ["evaluate", "front_roof_128", "--reference", "best"],
            f"reference best: {' or '.join(f'`{name}`' for name in REFERENCE_SENSORS)} is needed",
        ),
        (
            ["evaluate", "front_roof_128", "--set", "average=best"],
            "--set average: 'area' or 'cells' is needed; got 'best'",
        ),
        (
            ["evaluate", "front_roof_128", "--reference", "paper", "--set", "average=area"],
            "average area: it needs area weights of the reference points",
        ),
        (["evaluate", "front_roof_128", "--num-rays", "0"], "--num-rays: a number of at least 1 is needed; got '0'"),
        (
            ["evaluate", "--frames", "recording", "--num-rays", "9"],
            "reference, num_rays and frame_interval_s are for simulations",
        ),
        (["evaluate", "--frames", "recording", "--reference", "paper"], "a recording has `recorded` or `accumulated`"),
        (["evaluate", "--frames", "recording", "--reference", "accumulated"], "has no times of its scans"),
        (
            ["evaluate", "--frames", "recording", "--sensors", "roof"],
            "got roof; give sensors of the recording recording: sensor, reference",
        ),
        (
            ["evaluate", "--frames", "recording", "--reference", "recorded", "--set", "recording.window_s=1"],
            "recorded reference has none",
        ),
        (["evaluate", "front_roof_128", "--sensors", "roof"], "--sensors: only for a recording, which --frames names"),
        (
            ["evaluate", "front_roof_128", "--set", "recording.units=mm"],
            "recording.units: only for a recording, which --frames",
        ),
        (
            ["evaluate", "--frames", "recording", "--set", "recording.time_offset_s=3"],
            "--set recording.time_offset_s: at most 1 s of time offset",
        ),
        (
            ["compare", "--frames", "recording", "--set", "recording.pose_convention=wrong"],
            "recording.pose_convention: 'world_T_vehicle', 'vehicle_T_world' or 'swapped_xy' is needed; got 'wrong'",
        ),
        (["average"], "No such command 'average'"),
    ],
)
def test_user_error_is_one_line_with_code_2(torchcover, recording, monkeypatch, arguments, message):
    monkeypatch.chdir(recording.parent)
    code, _, error = torchcover(*arguments)
    assert code == 2
    assert message in error
    assert error.startswith("torchcover: ")
    assert error.count("\n") == 1


def test_output_folder_below_a_file_is_rejected(torchcover, recording, tmp_path):
    (tmp_path / "file").write_text("")
    code, _, error = torchcover("evaluate", "--frames", recording, "--out", tmp_path / "file")
    assert code == 2
    assert "file" in error


def test_invalid_output_folder_is_rejected_before_the_run(torchcover, recording, tmp_path, monkeypatch):
    monkeypatch.setattr("torchcover.evaluation.measurement.observe", lambda *_, **__: pytest.fail("the run started"))
    (tmp_path / "file").write_text("")
    (tmp_path / "link").symlink_to(tmp_path / "nothing")
    for out in (tmp_path / "file", tmp_path / "file" / "below", tmp_path / "link", tmp_path / "link" / "below"):
        code, _, error = torchcover("evaluate", "--frames", recording, "--out", out)
        assert code == 2
        assert f"--out {out}: " in error


def test_folder_names_are_not_markup(torchcover, recording, monkeypatch):
    monkeypatch.chdir(recording.parent)
    code, printed, _ = torchcover("evaluate", "--frames", recording, "--out", "[/x]")
    assert code == 0
    assert "summary.json to [/x]" in printed


def test_characters_outside_the_encoding_become_question_marks(torchcover, monkeypatch):
    buffer = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(buffer, encoding="ascii"))
    monkeypatch.setattr("torchcover.cli.listing.print_builtin", lambda word: Console().print("0.3 – 0.1"))
    assert torchcover("list")[0] == 0
    assert buffer.getvalue() == b"0.3 ? 0.1\n"


def test_list_prints_all_built_in_names_and_properties(torchcover):
    code, printed, _ = torchcover("list")
    assert code == 0
    assert len(printed.splitlines()) < 60
    assert max(map(len, printed.splitlines())) <= 100
    named, properties = set(re.split(r"[\s,]+", printed)), {}
    for kind in ("rigs", "scenarios", "lidars", "vehicles", "requirements"):
        assert set(list_builtin_names(kind)) <= named
        assert f"{kind} ({len(list_builtin_names(kind))})" in printed.splitlines()
        lines = [line.split(maxsplit=1) for line in torchcover("list", kind)[1].splitlines()]
        of_kind = {name: rest[0] for name, *rest in filter(None, lines) if rest}
        assert set(list_builtin_names(kind)) <= set(of_kind)
        assert not properties.keys() & of_kind.keys()
        properties |= of_kind
    assert properties["nuscenes_cameras"].startswith("6 cameras  The six cameras of the nuScenes cars (Renault Zoe)")
    assert properties["velodyne_vlp16"].startswith("16 channels, 100 m   Velodyne VLP-16.")
    assert properties["courtyard"].startswith("static")


def test_list_finds_text_and_prints_complete_descriptions(torchcover):
    code, printed, _ = torchcover("list", "PANDAR64")
    assert (code, "hesai_pandar64" in printed, "velodyne_vlp16" in printed) == (0, True, False)
    assert " ".join(load_builtin_documents("lidars")["hesai_pandar64"]["description"].split()) in printed
    code, _, stderr = torchcover("list", "no such thing")
    assert (code, stderr) == (
        2,
        "torchcover: nothing built in contains 'no such thing'; `torchcover list` prints all names\n",
    )


def test_version_and_help_are_printed(torchcover):
    code, printed, _ = torchcover("--version")
    assert (code, printed.strip()) == (0, "0.1.0")
    code, printed, _ = torchcover("evaluate", "--help")
    assert code == 0
    assert "--set" in printed


def test_help_of_evaluate_fits_on_one_screen(torchcover, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    lines = torchcover("evaluate", "--help")[1].splitlines()
    assert len(lines) <= 50
    assert max(len(line) for line in lines) <= 120


def test_package_runs_as_a_module():
    command = [sys.executable, "-m", "torchcover", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "0.1.0"


def test_help_imports_no_heavy_library():
    program = (
        "import sys; sys.argv = ['torchcover', '--help']\n"
        "from torchcover.cli.app import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "print(sorted({'torch', 'matplotlib', 'trimesh', 'embreex', 'scipy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip().splitlines()[-1] == "[]"


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (MemoryError("cuda:0: the search among 7 points"), "(cuda:0: the search among 7 points); reduce the size"),
        (torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 7.00 GiB.\nGPU 0 ..."), "GiB.); reduce"),
    ],
)
def test_out_of_memory_keeps_earlier_frames(torchcover, recording, tmp_path, monkeypatch, error, message):
    def search(*arguments, **options):
        if next(calls) == 2:
            raise error
        return nearest(*arguments, **options)

    calls = count()
    monkeypatch.setattr("torchcover.coverage.sums.nearest", search)
    code, _, stderr = torchcover("evaluate", "--frames", recording, "--set", "cell_m=4", "--out", tmp_path / "out")
    assert code == 2
    assert stderr.splitlines()[-1].startswith("torchcover: not enough memory (")
    assert message in stderr.splitlines()[-1]
    assert Coverage.load(tmp_path / "out" / "coverage.npz").counts["num_frames"] == 2
