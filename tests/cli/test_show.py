"""`torchcover show`: it finds what is meant, and draws it where it is."""

import numpy as np
import pytest
from matplotlib.image import imread

from torchcover.cli import show
from torchcover.simulation import Rig
from torchcover.simulation.documents import builtin_names


@pytest.fixture
def drawn(monkeypatch):
    """What was drawn: the arguments of the last call."""
    calls: dict = {}
    for name in ("draw_rig", "draw_scene"):
        draw = getattr(show, name)
        monkeypatch.setattr(
            show, name, lambda *args, draw=draw, **kwargs: calls.update(kwargs, args=args) or draw(*args, **kwargs)
        )
    return calls


def test_a_rig_is_drawn_on_the_ego_of_a_scenario(torchcover, worlds, drawn):
    code, printed, _ = torchcover(
        "show", worlds / "both.yaml", "--scenario", worlds / "yard.yaml", "--out", worlds / "new" / "out"
    )
    assert code == 0
    assert "both.png" in printed
    assert min(imread(worlds / "new" / "out" / "both.png").shape[:2]) > 500
    vertices_m, _, sensors = drawn["args"]
    assert np.ptp(vertices_m, axis=0).tolist() == [4.0, 2.0, 1.0]
    assert [sensor.name for sensor in sensors] == ["front", "rear"]
    assert sensors[1].vertical_fov_deg == pytest.approx((-30.0, 0.0))
    assert (sensors[1].horizontal_fov_deg, sensors[1].range_m) == (90.0, 60.0)
    assert sensors[1].sees(np.array([[-1.0, 0.0, -0.1], [1.0, 0.0, -0.1]])).tolist() == [True, False]


def test_a_scenario_is_drawn_in_the_frame_of_the_ego(torchcover, worlds, drawn):
    code, _, _ = torchcover("show", worlds / "yard.yaml", "--rig", worlds / "low.yaml", "--step", 3, "--out", worlds)
    assert code == 0
    assert min(imread(worlds / "yard.png").shape[:2]) > 500
    ahead, far = drawn["actors"]
    assert (ahead.category, far.category) == ("box", "far")
    np.testing.assert_allclose(sorted(ahead.outline_m[:, 0].round(6)), [18.0, 18.0, 22.0, 22.0])
    np.testing.assert_allclose(sorted(ahead.outline_m[:, 1].round(6)), [4.0, 4.0, 6.0, 6.0])
    assert drawn["title"] == "yard, step 3"
    # The rig saw the actor, where it is drawn.
    sensor = drawn["sensor"]
    on_actor = sensor[sensor[:, 2] > 0.1]
    assert len(on_actor)
    assert (np.abs(on_actor[:, 0] - 20.0) < 2.1).all()
    assert (np.abs(on_actor[:, 1] - 5.0) < 1.1).all()
    assert len(drawn["reference"]) > 1000


@pytest.mark.parametrize("name", builtin_names("rigs"))
def test_every_built_in_rig_has_fields_of_view_within_bounds(name):
    for sensor in map(show._sensor_view, Rig.load(name).sensors):
        low, high = sensor.vertical_fov_deg
        assert -90 <= low < high <= 90
        assert 0 < sensor.horizontal_fov_deg <= 360
        forward = sensor.vehicle_T_sensor[:3, :3] @ [1.0, 0.0, np.tan(np.deg2rad((low + high) / 2))]
        assert sensor.sees(forward[None]).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["moon"], "'moon' is neither a .yaml file nor built in; rigs: argoverse2, "),
        (["moon"], "; scenarios: courtyard, "),
        (["none.yaml"], "none.yaml: no such file"),
        (["kitti", "--rig", "nuscenes", "--step", "1"], "--rig, --step: for a scenario only, and 'kitti' is a rig"),
        (["courtyard", "--scenario", "urban"], "--scenario: for a rig only, and 'courtyard' is a scenario"),
        (["courtyard", "--rig", "moon"], "built-in rigs: argoverse2,"),
        (["kitti", "--scenario", "moon"], "built-in scenarios: courtyard,"),
        (["courtyard", "--step", "-1"], "--step"),
        ([], "Missing argument"),
    ],
)
def test_a_mistake_ends_in_one_line_and_exit_code_2(torchcover, arguments, message, tmp_path):
    code, _, error = torchcover("show", *arguments, "--out", tmp_path / "out")
    assert code == 2
    assert message in error
    assert error.startswith("torchcover: ")
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [("{", "not a YAML file"), ("sensors: 3", "sensors: "), ("name: x", "bodies missing"), ("- 1", "a YAML mapping")],
)
def test_a_file_that_is_neither_says_what_is_wrong(torchcover, tmp_path, content, message):
    (tmp_path / "bad.yaml").write_text(content)
    code, _, error = torchcover("show", tmp_path / "bad.yaml")
    assert code == 2
    assert message in error
    assert error.count("\n") == 1


def test_a_name_of_both_kinds_asks_for_the_file(torchcover, monkeypatch):
    monkeypatch.setattr(show, "builtin_names", lambda kind: ["twin", kind])
    code, _, error = torchcover("show", "twin")
    assert code == 2
    assert "both a rig and a scenario: give the YAML file" in error
