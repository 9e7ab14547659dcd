"""Documentation tests: every code block runs on its own; commands, options and YAML documents are valid."""

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


def iterate_blocks(language):
    """Yield the code blocks of a language, without the indentation of lists, as test parameters."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for block in BLOCK.finditer(text):
            if block["language"] == language:
                line = text.count("\n", 0, block.start()) + 1
                code = re.sub(rf"(?m)^{block['indent']}", "", block["code"])
                yield pytest.param(code, id=f"{page.relative_to(ROOT)}:{line}")


def list_python_blocks(*, has_prompts):
    """List the Python blocks with (doctests) or without prompts."""
    return [block for block in iterate_blocks("python") if (">>>" in block.values[0]) == has_prompts]


@pytest.mark.parametrize("code", list_python_blocks(has_prompts=True))
def test_doctests_print_the_documented_output(code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    report = []
    example = doctest.DocTestParser().get_doctest(code, {"__name__": "example"}, "example", None, 0)
    assert doctest.DocTestRunner(verbose=False).run(example, out=report.append).failed == 0, "".join(report)


@pytest.fixture
def namespace(tmp_path, monkeypatch):
    """Names and files that the examples without prompts assume; `evaluate` computes less."""
    monkeypatch.chdir(tmp_path)
    argoverse2_log(Drive(), tmp_path / "av2" / "LOG")
    kitti_raw(Drive(), tmp_path).rename(tmp_path / "2011_09_26" / "2011_09_26_drive_0005_sync")
    write_calibrations(tmp_path)
    small = {"num_frames": 1, "num_workers": 0, "progress": False, "num_rays": 256, "cell_m": 8.0}
    monkeypatch.setattr(torchcover, "evaluate", partial(evaluate_with_less, torchcover.evaluate, small))
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
        "metric": torchcover.CoverageMetric(grid, max_radius_m=50.0),
        "detector": lambda cloud: (torch.zeros(1, 7), torch.ones(1)),
    }


def evaluate_with_less(evaluate, overrides, *arguments, frames=None, **settings):
    """Call `evaluate` with few frames, rays and cells; a recording keeps its frames."""
    if frames is not None:
        return evaluate(*arguments, frames=frames, **settings, cell_m=overrides["cell_m"])
    return evaluate(*arguments, **{**settings, **overrides})


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


@pytest.mark.filterwarnings("ignore")  # the data checks warn about a recording of a few points
@pytest.mark.parametrize("code", list_python_blocks(has_prompts=False))
def test_examples_without_output_run(code, namespace, blank_maps):
    if "results/coverage.npz" in code:
        torchcover.evaluate("front_roof_32", "courtyard").save("results")
    exec(compile(code, "example", "exec"), namespace)


def iterate_commands():
    """Yield the words of every shell command, up to the first redirection, as test parameters."""
    for page in PAGES:
        for command in re.findall(r"`(torchcover [^`]+)`", page.read_text(encoding="utf-8")):
            words = shlex.split(command.partition("\\|")[0])
            if len(words) > 2 and "--help" not in words and not words[1].startswith("--"):
                yield pytest.param(words, id=f"{page.name} {' '.join(words)}"[:80])
    for block in iterate_blocks("console"):
        for line in re.sub(r"\\\n", " ", block.values[0]).splitlines():
            if line.startswith("$ "):
                words = list(takewhile(lambda word: word not in (">", "|"), shlex.split(line[2:], comments=True)))
                yield pytest.param(words, id=f"{block.id} {' '.join(words)}"[:80])


@pytest.mark.parametrize("words", list(iterate_commands()))
def test_commands_and_options_exist(words):
    if "torchcover" in words:
        check_torchcover_command(words[words.index("torchcover") + 1 :])
    elif words[:2] == ["make", *words[1:2]]:
        assert re.search(rf"(?m)^{words[1]}:", (ROOT / "Makefile").read_text())
    elif words[:2] == ["python", "-m"]:
        module = words[2].replace(".", "/")
        assert (ROOT / f"{module}.py").exists() or (ROOT / module / "__main__.py").exists()
    elif words[0] == "python":
        assert (ROOT / words[1]).exists()
    else:
        assert words[0] in ("pip", "uv", "git", "cd", "sudo", "bash"), words


def check_torchcover_command(arguments):
    """Parse the arguments of a command without running it."""
    group = get_command(app)
    context = typer.Context(group, info_name="torchcover")
    name, command, remaining = group.resolve_command(context, arguments)
    command.make_context(name, list(remaining), parent=context)


def test_options_in_running_text_exist():
    group = get_command(app)
    context = typer.Context(group, info_name="torchcover")
    options = {"--ages", "--constraint", "--help", "--labels"}  # of benchmarks, pip, typer and an example
    for name in group.list_commands(context):
        for parameter in group.get_command(context, name).params:
            options.update(parameter.opts)
    options.update(option for parameter in group.params for option in parameter.opts)
    for page in PAGES:
        if page.name == "renamed.md":  # its left column has the old names
            continue
        inline_code = " ".join(re.findall(r"`([^`\n]+)`", page.read_text(encoding="utf-8")))
        assert set(re.findall(r"(?<!\S)--[a-z][a-z0-9-]+", inline_code)) <= options, page.name


# Every function that reads a YAML document.
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


@pytest.mark.parametrize("text", list(iterate_blocks("yaml")))
def test_a_reader_accepts_each_yaml_block(text, tmp_path):
    path = tmp_path / "document.yaml"
    path.write_text(text, encoding="utf-8")
    errors = []
    for read in READERS:
        try:
            read(path)
            return
        except ValueError as error:
            errors.append(str(error))
    pytest.fail("\n".join(errors))


def test_make_targets_formats_and_smoke_imports_exist():
    pages = "\n".join(page.read_text(encoding="utf-8") for page in (*PAGES, ROOT / "CONTRIBUTING.md"))
    targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    lines = re.findall(r"(?:`|\$ )make ((?:[a-z]+\b ?)+)", pages)
    assert {name for line in lines for name in line.split()} <= set(targets)
    table = (ROOT / "docs" / "recordings.md").read_text(encoding="utf-8").partition("| format |")[2]
    assert set(re.findall(r"^\| `(\w+)`", table.partition("\n\n")[0], re.MULTILINE)) == set(FORMATS)
    for line in re.findall(r"^from torchcover.*", (ROOT / ".ci" / "smoke").read_text(encoding="utf-8"), re.MULTILINE):
        exec(line, {})


def test_contributing_names_existing_files_and_definitions():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").partition("## Extend the package")[2]
    source = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "torchcover").rglob("*.py"))
    source += (ROOT / "tests" / "metrics" / "cases.py").read_text(encoding="utf-8")
    source += (ROOT / "tests" / "simulation" / "test_protocols.py").read_text(encoding="utf-8")
    for name in re.findall(r"`([\w/]+\.(?:py|pyi))`", text):
        folders = (ROOT, ROOT / "torchcover", ROOT / "tests")
        assert "NAME" in name or "/" not in name or any((folder / name).exists() for folder in folders), name
    for name in re.findall(r"`([A-Z]\w+)`", text):
        assert name == "XxxParams" or re.search(rf"(?m)^ *(class )?{name}\b ?[:=(\[]", source), name


def test_links_lead_to_existing_headings():
    for page in PAGES:
        text = re.sub(r"```.*?```|`[^`\n]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        for target, anchor in re.findall(r"\]\((?!https?:)([^)#\s]*)#?([^)\s]*)\)", text):
            path = (page.parent / target) if target else page
            assert path.exists(), f"{page.name}: {target}"
            if anchor:
                assert anchor in list_anchors(path), f"{page.name}: {target}#{anchor}"


def test_documentation_is_short_enough():
    pages = [page for page in PAGES if page.name not in ("renamed.md", "glossary.md")]
    words = "".join(page.read_text(encoding="utf-8") for page in pages).replace("|", "").split()
    assert len(words) <= 14_000


def list_anchors(path):
    """List the anchors of the headings of a Markdown page, as GitHub and MkDocs build them."""
    headings = re.findall(r"(?m)^#+ (.+)$", path.read_text(encoding="utf-8"))
    return [re.sub(r"[^\w\- ]", "", heading).strip().lower().replace(" ", "-") for heading in headings]
