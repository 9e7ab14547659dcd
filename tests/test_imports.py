"""What may import what, and what an import costs."""

import ast
import subprocess
import sys
from pathlib import Path
from textwrap import indent

import pytest

import torchcover

ROOT = Path(__file__).parents[1]
HEAVY = {"torch", "torchmetrics", "numpy", "matplotlib", "kornia", "embreex", "trimesh", "pykdtree", "pydantic"}


CORE = ["geometry", "files", "neighbors", "metrics", "coverage", "detection", "frames"]
SIMULATING = {"torchcover.simulation", "embreex", "trimesh", "shapely", "pydantic", "numba", "matplotlib"}
# In one interpreter (the run in a fork), one after the other: what a later one may not load, no earlier one may either.
STAGES = {
    "torchcover": "import torchcover",
    "search": "import torch; torchcover.nearest(*torch.zeros(2, 1, 3), backend='cdist')",
    "Frame": "from torchcover.data import Frame",
    "Scan": "from torchcover.data import Scan",
    # torchmetrics imports matplotlib for itself, and is what shall not hide it here.
    "torchmetrics": "import torchmetrics; [modules.pop(name) for name in [*modules] if 'matplotlib' in name]",
    "core": "\n".join(f"from torchcover.{room} import *" for room in CORE),
    "data": "from torchcover.data import RecordedFrames; from torchcover import Camera",
    "run": "from torchcover.evaluation import evaluate",
    "callback": "from torchcover.training import CoverageCallback",
}
COMMANDS = ["--help", "list", "evaluate --help", "show --help"]
ASKED = """
import sys
from torchcover.cli.app import main
for command in sys.argv[1:]:
    sys.argv = ["torchcover", *command.split()]
    try:
        main()
    except SystemExit as end:
        assert not end.code
print(*sys.modules)
"""


def python(code, *arguments):
    """Standard output of a fresh interpreter at the root of the repository."""
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def loaded():
    """By stage, the modules that are loaded after it."""
    lines = ["import os, sys; modules = sys.modules"]
    for stage, code in STAGES.items():
        told = f"{code}\nprint(*modules, flush=True)"
        forked = f"if not os.fork():\n{indent(told, ' ')}\n os._exit(0)\nos.wait()"
        lines.append(forked if stage == "run" else told)
    return dict(zip(STAGES, (set(line.split()) for line in python("\n".join(lines)).splitlines()), strict=True))


def test_arrows_in_the_house_go_one_way():
    """The contracts of `[tool.importlinter]` in pyproject.toml."""
    report = python("from importlinter.cli import lint_imports; raise SystemExit(lint_imports(no_cache=True))")
    assert "4 kept, 0 broken" in report


FACTORIES = {
    "arange", "as_tensor", "asarray", "empty", "eye", "full", "linspace", "logspace", "ones", "rand", "randint",
    "randn", "randperm", "scalar_tensor", "tensor", "zeros",
}  # fmt: skip


def test_tensors_are_created_on_an_explicit_device():
    """Else `torch.set_default_device` would mix devices."""
    missing = []
    for path in (ROOT / "torchcover").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in FACTORIES:
                of_torch = isinstance(node.func.value, ast.Name) and node.func.value.id == "torch"
                if of_torch and "device" not in [keyword.arg for keyword in node.keywords]:
                    missing.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert missing == []


def test_importing_torchcover_imports_nothing_heavy(loaded):
    assert "torchcover" in loaded["torchcover"]
    assert not loaded["torchcover"] & HEAVY


@pytest.mark.parametrize("stage", ["core", "data", "callback"])
def test_what_measures_needs_nothing_that_simulates_or_draws(loaded, stage):
    assert not loaded[stage] & SIMULATING


def test_data_names_load_only_their_package(loaded):
    rooms = {f"torchcover.{room}" for room in ("frames", "recordings", "simulation")}
    for name, needed in (("Frame", 1), ("Scan", 2)):
        assert len(loaded[name] & rooms) <= needed, name
    with pytest.raises(AttributeError, match="no attribute 'frame'"):
        _ = torchcover.data.frame
    assert {name for name in torchcover.data.__all__ if getattr(torchcover.data, name) is None} == set()


def test_nearest_search_imports_no_metric_or_tree(loaded):
    assert not loaded["search"] & {"torchmetrics", "pykdtree", "matplotlib", "embreex", "trimesh"}


def test_what_only_tells_imports_nothing_heavy():
    """Seconds, for an answer that needs none of it."""
    loaded = set(python(ASKED, *COMMANDS).splitlines()[-1].split())
    assert "typer" in loaded
    assert not loaded & (HEAVY - {"numpy", "pydantic"})  # typer imports pydantic where there is one


def test_a_run_imports_what_it_needs_only(loaded):
    """Of distorted lenses, meshes from files, frameworks and their loggers it may need nothing."""
    optional = {"kornia", "trimesh", "networkx", "lightning", "tensorboard", "mmengine", "pandas", "OpenEXR"}
    assert not loaded["run"] & optional


def test_the_command_line_never_loads_torchmetrics(tmp_path):
    """Which takes as much processor time as torch does."""
    options = "--set metrics=object_coverage,k_cover --redundancy --num-frames 2 --num-rays 512 --set cell_m=1"
    run = f"evaluate front_roof_32 {options} --out {tmp_path}/result"
    loaded = set(python(ASKED, run).splitlines()[-1].split())
    assert "torchcover.coverage.sums" in loaded
    assert not loaded & {"torchmetrics", "scipy.signal"}


def test_every_public_name_is_there():
    assert {name for name in torchcover.__all__ if getattr(torchcover, name) is None} == set()
    assert set(torchcover.__all__) <= set(dir(torchcover))


def test_the_public_names_are_those_of_the_contract():
    assert set(torchcover.__all__) == {
        "BevGrid", "Camera", "Coverage", "CoverageMetric", "Region", "RegionsOfInterest", "Rig", "Scenario",
        "blind_spot_radius", "cameras", "check", "compare", "coverage", "data", "detection", "encounters", "estimation",
        "evaluate", "evaluate_encounters", "evaluation", "forward_regions", "geometry", "map_target_visibility",
        "metrics", "nearest", "neighbors", "placement", "report", "simulation", "targets", "training",
    }  # fmt: skip
    assert torchcover.__all__ == sorted(torchcover.__all__)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="coverage_metric"):
        _ = torchcover.coverage_metric
