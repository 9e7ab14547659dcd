"""Radars on the command line: coverage, failure, targets, search and user errors."""

import numpy as np
import pytest

from torchcover import Rig, evaluate

RADAR = (
    "horizontal_fov_deg: 90, vertical_fov_deg: [-20, 5], azimuth_cell_deg: 5, range_cell_m: 0.5, "
    "max_range_m: 40, ray_spacing_m: 1.0"
)
FRONT = f"  - {{type: radar, name: front, mount: {{x_m: 2.05, z_m: 0.6}}, {RADAR}}}\n"
REAR = f"  - {{type: radar, name: rear, mount: {{x_m: -2.05, z_m: 0.6, yaw_deg: 180}}, {RADAR}}}\n"
SMALL = ("--num-frames", 3, "--set", "cell_m=0.5", "--num-rays", 2048, "--redundancy")


@pytest.fixture
def rigs(scenes):
    """Folder with rig `radars` of two radars and rig `alone` of the rear one."""
    (scenes / "radars.yaml").write_text(f"name: radars\nsensors:\n{FRONT}{REAR}")
    (scenes / "alone.yaml").write_text(f"name: alone\nsensors:\n{REAR}")
    return scenes


def test_failure_of_a_radar_leaves_the_other_alone(torchcover, rigs):
    code, printed, _ = torchcover("evaluate", rigs / "radars.yaml", "--scenario", rigs / "yard.yaml", *SMALL)
    assert code == 0
    assert "when one sensor fails" in printed
    settings = {"num_frames": 3, "cell_m": 0.5, "num_rays": 2048}
    both = evaluate(rigs / "radars.yaml", rigs / "yard.yaml", redundancy=True, **settings)
    alone = evaluate(rigs / "alone.yaml", rigs / "yard.yaml", **settings)
    for row, rest in zip(both.coverage.summary(), alone.coverage.summary(), strict=True):
        for key, number in rest.numbers.items():
            assert row.redundancy.failure_numbers["front"][key].value == pytest.approx(
                number.value, rel=1e-12, nan_ok=True
            )
    rates = [result.coverage.summary()[0].numbers["detection_0.4m"].value for result in (both, alone)]
    assert rates[0] > rates[1]


def test_search_moves_a_radar(torchcover, rigs):
    (rigs / "space.yaml").write_text(
        "name: nose\nstart: radars.yaml\nscenario: yard.yaml\nobjectives: {near: {region: 20m}}\n"
        "free: {front: {z_m: [0.3, 0.9], pitch_deg: [-10, 10]}}\n"
    )
    assert torchcover("search", rigs / "space.yaml", "--num-evaluations", 4, "--out", rigs / "found")[0] == 0
    start, best = Rig.load(rigs / "radars.yaml"), Rig.load(rigs / "found" / "best.yaml")
    assert best.sensors[1] == start.sensors[1]
    assert best.sensors[0].model_copy(update={"mount": start.sensors[0].mount}) == start.sensors[0]
    assert best.sensors[0].type == "radar"


def test_targets_count_radar_points_not_rays(torchcover, rigs):
    place = ("--scenario", rigs / "yard.yaml", "--target", "adult", "--raster=4,6,-1,1,1", "--num-frames", 1)
    for rays_m in (1.0, 0.05):
        rig = f"name: fine\nsensors:\n{FRONT.replace('ray_spacing_m: 1.0', f'ray_spacing_m: {rays_m}')}"
        (rigs / "fine.yaml").write_text(rig)
        assert torchcover("targets", rigs / "fine.yaml", *place, "--out", rigs / "out")[0] == 0
        points = np.load(rigs / "out" / "targets.npz")["sensor_points"]
        # No deeper than a cell of range, and no wider than 3 of azimuth.
        assert points.min() >= 1
        assert points.max() <= 2 * 3


@pytest.mark.parametrize(
    ("was", "cell", "message"),
    [
        (
            "azimuth_cell_deg: 5",
            "azimuth_cell_deg: 91",
            "azimuth_cell_deg: a cell within the opening is needed, at most",
        ),
        (
            "range_cell_m: 0.5",
            "range_cell_m: 40.5",
            "range_cell_m: a cell within the opening is needed, at most max_ran",
        ),
    ],
)
def test_radar_cell_beyond_fov_names_the_key(torchcover, rigs, was, cell, message):
    (rigs / "radars.yaml").write_text(f"name: radars\nsensors:\n{FRONT.replace(was, cell)}")
    code, printed, error = torchcover("evaluate", rigs / "radars.yaml")
    assert (code, printed, error.count("\n")) == (2, "", 1)
    assert f"radars.yaml: sensors.0: {message}" in error
