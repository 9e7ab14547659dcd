"""`python -m examples.paper`: one pass for all, and tables that the documentation can take as they are."""

import json
import sys
from importlib import import_module
from itertools import islice
from pathlib import Path

import pytest
from matplotlib.image import imread

from torchcover import Coverage
from torchcover.report import write_figures

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def paper():
    """The example as a module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT)
        yield import_module("examples.paper.__main__")


@pytest.fixture(scope="module")
def out(paper, tmp_path_factory):
    """The folder of a run of two steps; of the maps of each experiment, only the first is drawn."""
    out = tmp_path_factory.mktemp("paper")
    options = ["--steps", "2", "--rays", "64", "--scenario", "courtyard", "--out", str(out)]

    def write_first(figures, folder):
        paths = write_figures(islice(figures, 1), folder)
        assert [path.stat().st_size > 10_000 for path in paths] == [True]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper, "write_figures", write_first)
        patch.setattr(sys, "argv", ["paper", *options])
        paper.main()
    return out


def test_every_experiment_leaves_tables_numbers_coverage_and_maps(out):
    assert sorted(path.name for path in out.iterdir()) == ["cameras", "figure", "mounting", "resolution"]
    for name, rigs in {"cameras": 1, "mounting": 2, "resolution": 3}.items():
        summary = json.loads((out / name / "summary.json").read_text())
        assert summary["options"]["steps"] == 2
        assert len({row["rig"] for row in summary["rows"]}) == len(list((out / name).glob("*.npz"))) == rigs
        assert list((out / name / "maps").glob("*.png"))
    assert min(imread(out / "figure" / "figure_2.png").shape[:2]) > 1000


def test_a_rig_of_two_experiments_is_measured_once(out):
    first, second = (Coverage.load(out / name / "front_roof_128.npz") for name in ("mounting", "resolution"))
    assert first.radius.equal(second.radius) or first.radius.allclose(second.radius, rtol=0, equal_nan=True)
    assert first.counts["steps"] == 2


@pytest.mark.parametrize(("name", "rows"), [("mounting", 6), ("resolution", 6), ("cameras", 4)])
def test_the_tables_are_markdown_with_the_numbers_of_the_summary(out, name, rows):
    lines = (out / name / "table.md").read_text().splitlines()
    start = next(at for at, line in enumerate(lines) if line.startswith("| region"))
    headings, rule, *body = (line.strip("| ").split(" | ") for line in lines[start : start + 2 + rows])
    assert len(headings) == len(rule)
    assert {len(row) for row in body} == {len(headings)}
    assert headings[:2] == ["region", "height"]
    assert headings[-1] == "paper (m)"
    rig = headings[2] if name != "cameras" else "three_cameras"
    numbers = json.loads((out / name / "summary.json").read_text())["rows"]
    for row, record in zip(body, [record for record in numbers if record["rig"] == rig], strict=True):
        assert (row[0], row[1]) == (record["region"], record["height"])
        shown = row[2].strip("*").split()[0]
        assert shown == "unknown" or float(shown) == pytest.approx(record["radius_m"], abs=0.006)
    published = {row[-1] for row in body}
    assert published == ({"grille 1.41, roof 1.93", "–"} if name == "mounting" else {"–"})


def test_an_unknown_experiment_is_a_mistake(paper, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["paper", "moon"])
    with pytest.raises(SystemExit, match="2"):
        paper.main()
    assert "no experiment moon; there are cameras, mounting, resolution, figure" in capsys.readouterr().err
