"""Choice of the ego vehicle: `vehicle`, the ego of the scenario, the vehicle of the rig, or an SUV, in this order."""

import numpy as np
import pytest

from torchcover.data import SimulatedFrames
from torchcover.simulation import PaperReference, Rig, Scenario, Simulator, set_ego

SENSOR = {"name": "top", "mount": {"z_m": 3.5}, "channels": 4, "columns": 8, "vertical_fov_deg": [-30, 0]}
PATTERN = {"horizontal_fov_deg": 360.0, "max_range_m": 50.0}
GROUND = {"name": "ground", "shape": {"type": "plane", "size_m": [200, 200]}}
BOX = {"type": "box", "size_m": [6, 2.5, 3]}
SMALL = PaperReference(rows=4, columns=4)
CART = "name: cart\nparts: [{name: bed, shape: {type: box, size_m: [3, 1.5, 1]}, poses: [{z_m: 0.2}]}]\n"


def rig(vehicle=None, name="r"):
    return Rig.model_validate({"name": name, "vehicle": vehicle, "sensors": [{**SENSOR, **PATTERN}]})


def create_scenario(**ego):
    return Scenario.model_validate({"name": "s", "ego": ego, "bodies": [GROUND]})


def create_traffic_scenario(**ego):
    return Scenario.model_validate({"name": "s", "traffic": {"type": "parking", "duration_s": 1.0}, "ego": ego or None})


def length_m(scenario, *rigs, vehicle=None):
    rigs_by_name = {str(k): item for k, item in enumerate(rigs)}
    if vehicle is not None:
        scenario = set_ego(scenario, rigs_by_name, vehicle)
    simulator = Simulator(scenario, rigs_by_name, SMALL)
    box = simulator.scenario.compute_ego_box()
    assert scenario.traffic is not None or simulator.get_scene_geometry(0)[0].ego_box == box
    return box.size_m[0]


@pytest.mark.parametrize("create", [create_scenario, create_traffic_scenario])
def test_the_first_specified_vehicle_is_the_ego(create):
    assert length_m(create(), rig()) == pytest.approx(4.90)
    assert length_m(create(), rig("sedan")) == pytest.approx(4.77)
    assert length_m(create(shape=BOX), rig("sedan")) == pytest.approx(6.0)
    assert length_m(create(shape=BOX), rig("sedan"), vehicle="van") == pytest.approx(5.93)
    assert length_m(create(), rig("sedan"), vehicle="van") == pytest.approx(5.93)


@pytest.mark.parametrize("name", ["courtyard", "urban", "highway", "parking"])
def test_built_in_scenarios_use_the_vehicle_of_rigs(name):
    zoe = set_ego(Scenario.load(name), {"nuscenes": Rig.load("nuscenes")})
    assert (zoe.ego_name, zoe.compute_ego_box().size_m[0]) == ("renault_zoe", pytest.approx(4.084))
    assert set_ego(Scenario.load(name), {"a": rig()}).ego_name == Scenario.load(name).ego_name == "suv"


def test_rigs_of_different_vehicles_need_a_common_one():
    two = (rig("sedan"), rig("van"))
    with pytest.raises(ValueError, match=r"different vehicles \(0 sedan, 1 van\), .* one ego: choose it by --vehicle"):
        length_m(create_scenario(), *two)
    assert length_m(create_scenario(), *two, vehicle="suv") == pytest.approx(4.90)
    assert length_m(create_scenario(shape=BOX), *two) == pytest.approx(6.0)
    # Equal vehicles, and a rig without a vehicle, do not conflict.
    assert length_m(create_scenario(), rig("sedan"), rig("sedan"), rig()) == pytest.approx(4.77)


def test_vehicle_paths_are_relative_to_their_document(tmp_path, monkeypatch):
    (tmp_path / "own").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "own" / "cart.yaml").write_text(CART)
    (tmp_path / "own" / "rig.yaml").write_text(
        "name: r\nvehicle: cart.yaml\n"
        "sensors: [{name: a, mount: {z_m: 5}, channels: 4, columns: 8, vertical_fov_deg: [-30, 0],"
        " horizontal_fov_deg: 360, max_range_m: 50}]\n"
    )
    (tmp_path / "own" / "scene.yaml").write_text(
        "name: s\nego: {shape: {type: vehicle, vehicle: cart.yaml}}\n"
        "bodies: [{name: ground, shape: {type: plane, size_m: [9, 9]}}]\n"
    )
    monkeypatch.chdir(tmp_path / "elsewhere")
    of_rig = set_ego(create_scenario(), {"r": Rig.load("../own/rig.yaml")})
    assert (of_rig.ego_name, of_rig.compute_ego_box().size_m) == ("cart.yaml", (3.0, 1.5, 1.0))
    assert Scenario.load("../own/scene.yaml").compute_ego_box().size_m == (3.0, 1.5, 1.0)
    # The path of an option is relative to the working directory.
    with pytest.raises(FileNotFoundError, match=r"vehicle: cart\.yaml: no such file"):
        set_ego(create_scenario(), {"r": rig()}, "cart.yaml")
    assert set_ego(create_scenario(), {"r": rig()}, "../own/cart.yaml").ego_name == "cart.yaml"


def test_unknown_vehicles_are_reported_with_their_rig():
    with pytest.raises(FileNotFoundError, match=r"rig 'top': vehicle: 'tank' is neither .* built-in vehicles; is "):
        set_ego(create_scenario(), {"top": rig("tank")})


def test_frames_depend_on_the_vehicle_and_name_it():
    scenario = create_scenario()
    frames = [SimulatedFrames(scenario, rig(), num_frames=1, reference_sensor=SMALL, vehicle=v) for v in (None, "van")]
    assert [item.metadata.description["vehicle"] for item in frames] == ["suv", "van"]
    assert frames[0].collect_content()["scenario"] != frames[1].collect_content()["scenario"]
    np.testing.assert_allclose(np.ptp(frames[1].metadata.ego_outline_m, axis=0), [5.93, 2.02])
    # The vehicle that a rig names does not matter if another one is chosen, not even for checkpoints.
    named = SimulatedFrames(scenario, rig("sedan"), num_frames=1, reference_sensor=SMALL, vehicle="van")
    assert named.collect_content() == frames[1].collect_content()
