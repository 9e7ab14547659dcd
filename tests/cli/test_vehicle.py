"""Option `--vehicle`: host vehicle in numbers, files and titles."""

import json
import warnings

import pytest

from torchcover.evaluation import scene_figures

FREE = "name: free\nego: {pose: {}}\nbodies: [{name: ground, shape: {type: plane, size_m: [400, 400]}}]\n"


@pytest.fixture
def free(scenes):
    """Scenario without ego vehicle; rig `low` names a sedan, rig `both` a van."""
    (scenes / "free.yaml").write_text(FREE)
    for name, vehicle in (("low", "sedan"), ("both", "van")):
        path = scenes / f"{name}.yaml"
        path.write_text(f"vehicle: {vehicle}\n{path.read_text()}".replace("2.5", "3.1"))
    return scenes


def run(torchcover, free, command, *arguments):
    settings = (
        "--scenario",
        free / "free.yaml",
        "--num-frames",
        1,
        "--set",
        "cell_m=2",
        "--num-rays",
        64,
        "--out",
        free / "out",
    )
    code, printed, error = torchcover(command, *arguments, *settings)
    return code, printed, error


def test_summary_and_table_name_the_vehicle(torchcover, free):
    for options, vehicle in (([], "sedan"), (["--vehicle", "hatchback"], "hatchback")):
        code, printed, error = run(torchcover, free, "evaluate", free / "low.yaml", *options)
        assert (code, f"Vehicle: {vehicle}." in " ".join(printed.split())) == (0, True), error
        assert json.loads((free / "out" / "summary.json").read_text())["vehicle"] == vehicle
        assert f"on {vehicle}" in (free / "out" / "report.html").read_text()


def test_comparison_needs_one_vehicle_for_all_rigs(torchcover, free):
    rigs = (free / "low.yaml", free / "both.yaml")
    code, _, error = run(torchcover, free, "compare", *rigs)
    assert (code, error.count("\n")) == (2, 1)
    assert "the rigs name different vehicles (low sedan, both van)" in error
    assert "--vehicle" in error
    assert run(torchcover, free, "compare", *rigs, "--vehicle", "sedan")[0] == 0
    assert json.loads((free / "out" / "summary.json").read_text())["vehicle"] == "sedan"


def test_figures_and_recordings_use_the_vehicle(torchcover, free, monkeypatch):
    titles = []
    monkeypatch.setattr(scene_figures, "plot_rig", lambda *_, **options: titles.append(options) or Blank())
    shown = ("show", free / "low.yaml", "--scenario", free / "free.yaml", "--vehicle", "suv", "--out", free)
    assert torchcover(*shown)[0] == 0
    assert titles[0]["subtitle"] == "on suv in free, 4.90 x 1.94 x 1.63 m"
    recorded = ("record", free / "low.yaml", "--scenario", free / "free.yaml", "--num-frames", 1, "--num-rays", 64)
    assert torchcover(*recorded, "--vehicle", "suv", "--out", free / "drive")[0] == 0
    assert '"lower_m": [-2.45' in (free / "drive" / "frames.yaml").read_text()
    dropped = []
    for vehicle in ("suv", "-20,20,-20,20,-1,1"):
        evaluated = ("evaluate", "--frames", free / "drive", f"--vehicle={vehicle}", "--out", free / "out")
        with warnings.catch_warnings(action="always"):
            code, _, error = torchcover(*evaluated, "--files", "numbers")
        assert (code, "front has no point" in error) == (0, vehicle != "suv")
        summary = json.loads((free / "out" / "summary.json").read_text())
        dropped.append(summary["frame_counts"]["sensor_ego_vehicle"])
    assert dropped[1] > 100 > dropped[0] == 0
    code, _, error = torchcover("evaluate", "--frames", free / "drive", "--vehicle", "1,2,3", "--out", free / "out")
    assert (code, "x0,x1,y0,y1,z0,z1 in meters are needed" in error) == (2, True)


class Blank:
    dpi = 100

    def savefig(self, path, dpi):
        path.write_bytes(b"")
