"""Every block of code in the documentation runs, each on its own; commands and documents are those that exist."""

import doctest
import json
import re
import shlex
from functools import partial
from itertools import takewhile
from pathlib import Path

import numpy as np
import pytest
import torch
import typer
from torch.utils.data import DataLoader
from typer.main import get_command

import torchcover
from tests.recordings.drives import Drive
from tests.recordings.layouts import argoverse2_log, kitti_raw
from torchcover import BevGrid
from torchcover.cli.app import app
from torchcover.data import RegionsOfInterest, SimulatedFrames, collate_frames
from torchcover.encounters import EncounterSet
from torchcover.evaluation import Requirements
from torchcover.placement import SearchSpace, SelectionSpace
from torchcover.recordings.formats import FORMATS
from torchcover.recordings.formats.folder import read_folder_settings
from torchcover.simulation import Rig, Scenario
from torchcover.simulation.bodies import Vehicle

ROOT = Path(__file__).parent.parent
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
BLOCK = re.compile(r"^(?P<indent> *)```(?P<language>\w+)\n(?P<code>.*?)^ *```", re.MULTILINE | re.DOTALL)


def blocks(language):
    """Each block with its place, without the indentation of a list."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for block in BLOCK.finditer(text):
            if block["language"] == language:
                line = text.count("\n", 0, block.start()) + 1
                code = re.sub(rf"(?m)^{block['indent']}", "", block["code"])
                yield pytest.param(code, id=f"{page.relative_to(ROOT)}:{line}")


@pytest.mark.parametrize("code", [each for each in blocks("python") if ">>>" in each.values[0]])
def test_an_example_prints_what_it_says(code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = []
    example = doctest.DocTestParser().get_doctest(code, {"__name__": "example"}, "example", None, 0)
    assert doctest.DocTestRunner(verbose=False).run(example, out=said.append).failed == 0, "".join(said)


@pytest.fixture
def stage(tmp_path, monkeypatch):
    """What the other examples take as given: names of a user's own, his files, and less to compute."""
    monkeypatch.chdir(tmp_path)
    argoverse2_log(Drive(), tmp_path / "av2" / "LOG")
    kitti_raw(Drive(), tmp_path).rename(tmp_path / "2011_09_26" / "2011_09_26_drive_0005_sync")
    write_calibrations(tmp_path)
    small = {"steps": 1, "workers": 0, "progress": False, "rays": 256, "cell_m": 8.0}
    monkeypatch.setattr(torchcover, "evaluate", partial(measured_less, torchcover.evaluate, small))
    frames = SimulatedFrames("courtyard", "front_roof_32", num_frames=1, boxes=True)
    grid = BevGrid(x_m=(0.0, 40.0), y_m=(-10.0, 10.0), cell_m=0.5, band_frame="ground")
    return {
        "torchcover": torchcover,
        "Camera": torchcover.Camera,
        "forward_regions": torchcover.forward_regions,
        "K": np.array([[520.0, 0.0, 318.0], [0.0, 510.0, 242.0], [0.0, 0.0, 1.0]]),
        "frames": frames,
        "loader": DataLoader(frames, collate_fn=collate_frames),
        "grid": grid,
        "metric": torchcover.CoverageMetric(grid, max_radius=50.0),
        "detector": lambda cloud: (torch.zeros(1, 7), torch.ones(1)),
    }


def measured_less(real, less, *arguments, frames=None, **settings):
    """With few steps, rays and cells, and of a recording with what it has."""
    if frames is not None:
        return real(*arguments, frames=frames, **settings, cell_m=less["cell_m"])
    return real(*arguments, **{**settings, **less})


def write_calibrations(folder):
    matrix = "[520., 0., 318., 0., 510., 242., 0., 0., 1.]"
    size = "image_width: 640\nimage_height: 480\n"
    (folder / "head_camera.yaml").write_text(
        f"{size}camera_name: head\ncamera_matrix: {{rows: 3, cols: 3, data: {matrix}}}\n"
        "distortion_model: plumb_bob\ndistortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}\n"
    )
    opencv = "{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: {data}\n"
    (folder / "left.yml").write_text(
        f"%YAML:1.0\n---\n{size}"
        + opencv.format(name="camera_matrix", rows=3, columns=3, data=matrix)
        + opencv.format(name="distortion_coefficients", rows=4, columns=1, data="[0., 0., 0., 0.]")
    )
    (folder / "000007.txt").write_text(
        "P2: 520 0 318 0 0 510 242 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"
    )
    camera = {"token": "a", "sensor_token": "s", "translation": [1.7, 0.0, 1.5], "rotation": [0.5, -0.5, 0.5, -0.5]}
    intrinsic = [[520.0, 0.0, 318.0], [0.0, 510.0, 242.0], [0.0, 0.0, 1.0]]
    (folder / "v1.0-mini").mkdir()
    (folder / "v1.0-mini" / "sensor.json").write_text(json.dumps([{"token": "s", "channel": "CAM_FRONT"}]))
    (folder / "v1.0-mini" / "calibrated_sensor.json").write_text(
        json.dumps([{**camera, "camera_intrinsic": intrinsic}])
    )


@pytest.mark.filterwarnings("ignore")  # a drive of a few points is as suspicious as it looks
@pytest.mark.parametrize("code", [each for each in blocks("python") if ">>>" not in each.values[0]])
def test_an_example_without_output_runs(code, stage, blank_maps):
    if "results/coverage.npz" in code:
        torchcover.evaluate("front_roof_32", "courtyard").save("results")
    exec(compile(code, "example", "exec"), stage)


def commands():
    for parameter in blocks("console"):
        for line in re.sub(r"\\\n", " ", parameter.values[0]).splitlines():
            if line.startswith("$ "):
                words = list(takewhile(lambda word: word not in (">", "|"), shlex.split(line[2:], comments=True)))
                yield pytest.param(words, id=f"{parameter.id} {' '.join(words)}"[:80])


@pytest.mark.parametrize("words", list(commands()))
def test_a_command_can_be_given(words):
    """Its options exist and take such values; what it would measure, others measure."""
    if "torchcover" in words:
        group = get_command(app)
        context = typer.Context(group, info_name="torchcover")
        name, command, rest = group.resolve_command(context, words[words.index("torchcover") + 1 :])
        command.make_context(name, list(rest), parent=context)
    elif words[:2] == ["make", *words[1:2]]:
        assert re.search(rf"(?m)^{words[1]}:", (ROOT / "Makefile").read_text())
    elif words[:2] == ["python", "-m"]:
        module = words[2].replace(".", "/")
        assert (ROOT / f"{module}.py").exists() or (ROOT / module / "__main__.py").exists()
    elif words[0] == "python":
        assert (ROOT / words[1]).exists()
    else:
        assert words[0] in ("pip", "uv", "git", "cd", "sudo", "bash"), words


# Whatever reads a document of YAML.
READERS = (
    Rig.load,
    Scenario.load,
    Vehicle.load,
    RegionsOfInterest.load,
    Requirements.load,
    EncounterSet.load,
    SearchSpace.load,
    SelectionSpace.load,
    read_folder_settings,
)


@pytest.mark.parametrize("text", list(blocks("yaml")))
def test_a_document_is_valid_for_one_of_its_readers(text, tmp_path):
    path = tmp_path / "document.yaml"
    path.write_text(text, encoding="utf-8")
    refusals = []
    for read in READERS:
        try:
            read(path)
            return
        except ValueError as error:
            refusals.append(str(error))
    pytest.fail("\n".join(refusals))


def test_make_targets_formats_of_recordings_and_imports_of_scripts_exist():
    pages = "\n".join(page.read_text(encoding="utf-8") for page in (*PAGES, ROOT / "CONTRIBUTING.md"))
    targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    lines = re.findall(r"(?:`|\$ )make ((?:[a-z]+\b ?)+)", pages)
    assert {name for line in lines for name in line.split()} <= set(targets)
    table = (ROOT / "docs" / "recordings.md").read_text(encoding="utf-8").partition("| format |")[2]
    assert set(re.findall(r"^\| `(\w+)`", table.partition("\n\n")[0], re.MULTILINE)) == set(FORMATS)
    for line in re.findall(r"^from torchcover.*", (ROOT / ".ci" / "smoke").read_text(encoding="utf-8"), re.MULTILINE):
        exec(line, {})
