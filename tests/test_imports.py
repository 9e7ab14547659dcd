"""What may import what, and what an import costs."""

import subprocess
import sys
from pathlib import Path

import pytest

import torchcover

ROOT = Path(__file__).parents[1]
HEAVY = {"torch", "torchmetrics", "numpy", "matplotlib", "kornia", "embreex", "trimesh", "pykdtree", "pydantic"}


def python(code):
    """Standard output of a fresh interpreter at the root of the repository."""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_arrows_in_the_house_go_one_way():
    """The contracts of `[tool.importlinter]` in pyproject.toml."""
    report = python("from importlinter.cli import lint_imports; raise SystemExit(lint_imports(no_cache=True))")
    assert "3 kept, 0 broken" in report


def test_importing_torchcover_imports_nothing_heavy():
    loaded = set(python("import sys, torchcover; print(*sys.modules)").split())
    assert "torchcover" in loaded
    assert not loaded & HEAVY


CORE = ["geometry", "files", "neighbors", "metrics", "coverage", "detection", "frames"]
SIMULATING = {"torchcover.simulation", "embreex", "trimesh", "shapely", "pydantic", "numba", "matplotlib"}


@pytest.mark.parametrize(
    "imports",
    [
        "\n".join(f"from torchcover.{room} import *" for room in CORE),
        "from torchcover.training import CoverageCallback",
        "from torchcover.data import RecordedFrames; from torchcover import Camera",
    ],
)
def test_what_measures_needs_nothing_that_simulates_or_draws(imports):
    # torchmetrics imports matplotlib for itself, and is what shall not hide it here.
    code = "import sys, torchmetrics\nfor name in [*sys.modules]:\n    if 'matplotlib' in name: del sys.modules[name]\n"
    assert not set(python(f"{code}{imports}\nprint(*sys.modules)").split()) & SIMULATING


def test_a_name_of_the_door_to_the_data_loads_its_own_room():
    rooms = {f"torchcover.{room}" for room in ("frames", "recordings", "simulation")}
    for name, needed in (("Frame", 1), ("Scan", 2)):
        loaded = set(python(f"import sys; from torchcover.data import {name}; print(*sys.modules)").split())
        assert len(loaded & rooms) <= needed, name
    with pytest.raises(AttributeError, match="no attribute 'frame'"):
        _ = torchcover.data.frame
    assert {name for name in torchcover.data.__all__ if getattr(torchcover.data, name) is None} == set()


def test_searching_imports_neither_the_metric_nor_the_tree_before_they_are_needed():
    search = "torchcover.nearest(*torch.zeros(2, 1, 3), backend='cdist')"
    code = f"import sys, torch, torchcover; {search}; print(*sys.modules)"
    assert not set(python(code).split()) & {"torchmetrics", "pykdtree", "matplotlib", "embreex", "trimesh"}


@pytest.mark.parametrize("command", ["--help", "list", "evaluate --help", "show --help"])
def test_what_only_tells_imports_nothing_heavy(command):
    """Seconds, for an answer that needs none of it."""
    code = f"import sys; sys.argv = 'torchcover {command}'.split()\nfrom torchcover.cli.app import main\n"
    code += "try: main()\nexcept SystemExit as end: print(*sys.modules, 'code', end.code)"
    *loaded, _, status = python(code).splitlines()[-1].split()
    assert status == "0"
    assert "typer" in loaded
    assert not set(loaded) & (HEAVY - {"numpy", "pydantic"})  # typer imports pydantic where there is one


def test_a_run_imports_what_it_needs_only():
    """Of distorted lenses, meshes from files, frameworks and their loggers it may need nothing."""
    loaded = set(python("import sys; from torchcover.evaluation import evaluate; print(*sys.modules)").split())
    assert "torchmetrics" in loaded
    assert not loaded & {"kornia", "trimesh", "networkx", "lightning", "tensorboard", "mmengine", "pandas", "OpenEXR"}


@pytest.mark.parametrize("name", torchcover.__all__)
def test_every_public_name_is_there(name):
    assert getattr(torchcover, name) is not None
    assert name in dir(torchcover)


def test_the_public_names_are_those_of_the_contract():
    assert set(torchcover.__all__) == {
        "BevGrid", "Camera", "Coverage", "CoverageMetric", "Region", "RegionsOfInterest", "Rig", "Scenario",
        "blind_spot_radius", "cameras", "compare", "coverage", "data", "detection", "estimation", "evaluate",
        "evaluation", "forward_regions", "geometry", "metrics",
        "nearest", "neighbors", "placement", "report", "simulation", "survey_target", "targets", "training",
    }  # fmt: skip
    assert torchcover.__all__ == sorted(torchcover.__all__)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="coverage_metric"):
        _ = torchcover.coverage_metric
