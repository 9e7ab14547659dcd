"""A search space: what values make of a rig, and what of it cannot be."""

import pickle
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh

from torchcover.files import BadFileError, to_yaml
from torchcover.placement import SearchSpace
from torchcover.simulation import Lidar, Pose, Rig

EXAMPLES = sorted(path for path in (Path(__file__).parents[2] / "examples" / "placement").glob("*.yaml"))
SPACES = [path for path in EXAMPLES if "\nfree:" in path.read_text()]
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
NEAR = {"near": {"band": "ground", "region": "20m"}}
LIDAR = {
    "columns": 60,
    "channels": 4,
    "vertical_fov_deg": (-20.0, 5.0),
    "horizontal_fov_deg": 360.0,
    "max_range_m": 80.0,
}


def lidar(name, **mount):
    return Lidar(name=name, mount=Pose(**mount), **LIDAR)


RIGHT = lidar("right", x_m=-0.5, y_m=-0.5, z_m=1.8)
HIGH = {"mount": {"z_m": 1.9}}
PAIR = Rig(
    name="pair",
    vehicle="suv",
    sensors=(lidar("left", x_m=-0.5, y_m=0.5, z_m=1.8), RIGHT),
)


def space(free, start=PAIR, **keys):
    return SearchSpace(name="here", start=start, scenario="courtyard", free=free, objectives=NEAR, **keys)


def drawn(searched, count=20):
    """Values all over a space."""
    for shares in np.random.default_rng(1).random((count, len(searched.variables))).tolist():
        yield {variable.name: variable.get_value(u) for variable, u in zip(searched.variables, shares, strict=True)}


def place(sensor):
    return sensor.mount.to_matrix()[:3, 3]


@pytest.mark.parametrize("path", SPACES, ids=lambda path: path.stem)
def test_example_rigs_survive_saving(path, tmp_path):
    searched = SearchSpace.load(path)
    for values in drawn(searched, 1):
        rig = searched.build_rig(values, "found")
        rig.save(tmp_path / "found.yaml")
        assert Rig.load(tmp_path / "found.yaml") == rig
        assert searched.name in rig.description
        assert searched.start.name in rig.description
        assert rig.vehicle == "suv"


def test_only_free_values_change_within_bounds():
    searched = space({"left": {"x_m": (-1.0, 0.0), "pitch_deg": (-10.0, 10.0), "roll_deg": 3.0}})
    assert [variable.name for variable in searched.variables] == ["left.x_m", "left.pitch_deg"]
    for values in drawn(searched):
        left, right = searched.build_rig(values, "found").sensors
        assert right == PAIR.sensors[1]
        x_m, pitch_deg = values["left.x_m"], values["left.pitch_deg"]
        assert left == lidar("left", x_m=x_m, y_m=0.5, z_m=1.8, pitch_deg=pitch_deg, roll_deg=3.0)
        assert -1.0 <= x_m <= 0.0
        assert -10.0 <= pitch_deg <= 10.0


def test_start_values_reproduce_the_start():
    free = {"left": {"x_m": (-1.0, 0.0), "z_above_body_m": (0.1, 0.3), "yaw_deg": (-90.0, 90.0)}}
    searched = space({**free, "right": {"mirror_of": "left"}}, constraints={"symmetric": True})
    values = searched.get_start_values()
    assert values.keys() == {variable.name for variable in searched.variables}
    assert searched.build_rig(values, "same").sensors == PAIR.sensors
    assert searched.find_violations(PAIR) == ()


def test_quaternion_remains_unless_an_angle_is_free():
    half = np.sqrt(0.5)
    start = PAIR.model_copy(update={"sensors": (lidar("left", z_m=1.8, quaternion_wxyz=(half, 0.0, 0.0, half)),)})
    moved = space({"left": {"x_m": (-1.0, 0.0)}}, start).build_rig({"left.x_m": -0.5}, "moved").sensors[0]
    turned = (
        space({"left": {"pitch_deg": (-10.0, 10.0)}}, start).build_rig({"left.pitch_deg": 5.0}, "turned").sensors[0]
    )
    assert moved.mount == Pose(x_m=-0.5, z_m=1.8, quaternion_wxyz=(half, 0.0, 0.0, half))
    assert turned.mount == Pose(z_m=1.8, yaw_deg=90.0, pitch_deg=5.0)


def test_a_pair_is_symmetric_whatever_its_values():
    free = {"x_m": (-1.0, 0.0), "y_m": (0.3, 0.6), "yaw_deg": (-180.0, 180.0), "roll_deg": (-30.0, 30.0)}
    free |= {"pitch_deg": (-30.0, 30.0), "model": ("velodyne_vlp16", "velodyne_vlp32c"), "present": (True, False)}
    third = Rig(name="third", vehicle="suv", sensors=(*PAIR.sensors, lidar("middle", x_m=-1.4, z_m=2.0)))
    searched = space({"left": free, "right": {"mirror_of": "left"}}, third, constraints={"symmetric": True})
    counts = set()
    for values in drawn(searched, 12):
        *pair, middle = searched.build_rig(values, "found").sensors
        assert middle == third.sensors[2]
        counts.add(len(pair))
        assert bool(pair) == values["left.present"]
        if pair:
            left, right = (sensor.mount.to_matrix() for sensor in pair)
            assert right == pytest.approx(MIRROR @ left @ MIRROR, abs=1e-7)
            assert [sensor.name for sensor in pair] == ["left", "right"]
            assert {sensor.model for sensor in pair} == {values["left.model"]}
        assert searched.find_violations(searched.build_rig(values, "found")) == ()
    assert counts == {0, 2}


def test_a_height_above_the_body_is_that():
    searched = space({"left": {"x_m": (-2.0, 1.8), "y_m": (-0.8, 0.8), "z_above_body_m": (0.1, 0.3)}})
    body = searched.scenarios[0].build_ego_mesh()
    triangles = body.vertices_m[body.faces]
    for values in drawn(searched):
        at = place(searched.build_rig(values, "found").sensors[0])
        below = at - [0.0, 0.0, values["left.z_above_body_m"]]
        nearest = trimesh.triangles.closest_point(triangles, np.broadcast_to(below, (len(triangles), 3)))
        assert np.linalg.norm(nearest - below, axis=1).min() < 1e-6


def test_region_mount_keeps_its_height_above_surface():
    regions = ("roof", "grille", "front_bumper", "rear_bumper", "fender_left", "mirror_right")
    searched = space({"left": {"region": regions, "height_m": (0.02, 0.06), "yaw_deg": (-30.0, 30.0)}})
    body, faced = (
        searched.scenarios[0].build_ego_mesh(),
        {"rear_bumper": 180.0, "fender_left": 90.0, "mirror_right": -90.0},
    )
    triangles, seen = body.vertices_m[body.faces], set()
    for values in drawn(searched, 40):
        sensor = searched.build_rig(values, "found").sensors[0]
        nearest = trimesh.triangles.closest_point(triangles, np.broadcast_to(place(sensor), (len(triangles), 3)))
        assert np.linalg.norm(nearest - place(sensor), axis=1).min() == pytest.approx(values["left.height_m"], abs=2e-6)
        assert sensor.mount.yaw_deg == pytest.approx(faced.get(values["left.region"], 0.0) + values["left.yaw_deg"])
        assert (sensor.mount.pitch_deg, sensor.mount.roll_deg) == (0.0, 0.0)
        seen.add(values["left.region"])
    assert seen == set(regions)
    assert searched.get_start_values() == {}


def test_a_model_brings_its_whole_pattern():
    keys = {"name": "left", "model": "velodyne_vlp16"}
    start = PAIR.model_copy(update={"sensors": (Lidar.model_validate(keys | HIGH),)})
    searched = space({"left": {"model": ("velodyne_vlp16", "velodyne_vlp32c")}}, start)
    for model in ("velodyne_vlp16", "velodyne_vlp32c"):
        sensor = searched.build_rig({"left.model": model}, "found").sensors[0]
        assert sensor == Lidar.model_validate({"name": "left", "mount": start.sensors[0].mount, "model": model})
    assert searched.get_start_values() == {"left.model": "velodyne_vlp16"}


def test_a_rig_costs_its_models_and_its_mounts():
    cost = {"velodyne_vlp16": 3000.0, "velodyne_vlp32c": 9000.0, "right": 500.0, "mount": 100.0}
    free = {"model": ("velodyne_vlp16", "velodyne_vlp32c"), "present": (True, False)}
    with pytest.raises(ValueError, match="'left' of the sensor 'left' has no price"):
        space({"left": free}, prices_eur=cost)
    start = Rig(name="start", sensors=(Lidar.model_validate({"name": "left", "model": "velodyne_vlp16"} | HIGH), RIGHT))
    searched = space({"left": free}, start, prices_eur=cost)
    prices = {
        (model, there): searched.compute_cost_eur(
            searched.build_rig({"left.model": model, "left.present": there}, "found")
        )
        for model in ("velodyne_vlp16", "velodyne_vlp32c")
        for there in (True, False)
    }
    assert prices["velodyne_vlp16", True] == 3000.0 + 500.0 + 200.0
    assert prices["velodyne_vlp32c", True] == 9000.0 + 500.0 + 200.0
    assert prices["velodyne_vlp32c", False] == 500.0 + 100.0
    assert space({"left": {"x_m": (-1.0, 0.0)}}).compute_cost_eur(PAIR) is None


def test_what_a_rig_cannot_be_is_told():
    cost = {"left": 1000.0, "right": 1000.0}
    constraints = {"min_distance_m": 0.3, "symmetric": True, "max_cost_eur": 1500.0}
    keys = {"y_m": (-0.6, 0.6), "z_m": (-1.0, 2.0)}
    with pytest.warns(UserWarning, match=r"'pair' is outside the space \(it costs 2000 EUR"):
        searched = space(
            {"left": keys | {"present": (True, False)}, "right": {"y_m": (-0.6, 0.6)}},
            prices_eur=cost,
            constraints=constraints | {"symmetric": False},
        )
    free = space({"left": keys}, constraints={"min_distance_m": 0.3})
    inside, buried, close = (
        free.build_rig({"left.y_m": y_m, "left.z_m": z_m}, "bad") for y_m, z_m in ((0.5, 1.0), (0.5, -0.5), (-0.3, 1.8))
    )
    assert free.find_violations(inside) == ("left at [-0.5, 0.5, 1.0] m is inside the vehicle's body",)
    assert free.find_violations(buried) == ("left at [-0.5, 0.5, -0.5] m is not above the ground",)
    assert free.find_violations(close) == ("left and right are 0.200 m apart; min_distance_m is 0.3",)
    assert searched.find_violations(PAIR) == ("it costs 2000 EUR; max_cost_eur is 1500",)
    lone = space({"left": {"pitch_deg": (-5.0, 5.0)}, "right": {"mirror_of": "left"}}, constraints={"symmetric": True})
    one = PAIR.model_copy(update={"sensors": PAIR.sensors[:1]})
    assert lone.find_violations(one) == (
        "left has no mirror image on the other side of the vehicle; symmetric is true",
    )


def test_values_that_make_no_rig_are_refused():
    everything = {"present": (True, False)}
    searched = space({"left": everything | {"x_m": (-9.0, 0.0), "z_above_body_m": (0.1, 0.2)}, "right": everything})
    values = {"left.present": True, "left.x_m": -0.5, "left.z_above_body_m": 0.15, "right.present": True}
    for changed, message in (
        ({"left.x_m": -8.0}, r"left: z_above_body_m: suv has no body at x = -8\.000 m, y = 0\.500 m"),
        ({"left.present": False, "right.present": False}, "no sensor is left"),
        ({"left.x_m": 5.0}, r"left\.x_m: got 5\.0; give a number from -9 to 0"),
        ({"left.yaw_deg": 5.0}, r"missing or unknown: left\.yaw_deg"),
    ):
        with pytest.raises(ValueError, match=message):
            searched.build_rig(values | changed, "none")


MISTAKES = [
    ({"free": {}}, "free: "),
    ({"free": {"rof": {"x_m": [0, 1]}}}, "free.rof: 'front_roof_32' has no such sensor; it has roof"),
    ({"free": {"roof": {}}}, "free.roof: nothing is free"),
    ({"free": {"roof": {"x_m": 0.5}}}, "free: all numbers are fixed"),
    ({"free": {"roof": {"x_cm": [0, 1]}}}, "free.roof.x_cm: "),
    ({"free": {"roof": {"x_m": [1, 1]}}}, "free.roof.x_m: got (1, 1); the first value must be below the second"),
    ({"free": {"roof": {"x_m": [2, 1]}}}, "free.roof.x_m: got (2, 1); the first value must be below"),
    ({"free": {"roof": {"x_m": [0, float("nan")]}}}, "free.roof.x_m: got (0, nan); give values from -1e+09 to 1e+09"),
    ({"free": {"roof": {"x_m": [0, 1, 2]}}}, "free.roof.x_m: got (0, 1, 2); give a number, or [smallest, largest]"),
    ({"free": {"roof": {"x_m": True}}}, "free.roof.x_m: got True; give a number"),
    ({"free": {"roof": {"z_m": [1.7, 1.8], "z_above_body_m": [0, 1]}}}, "z_m, z_above_body_m: got both"),
    ({"free": {"roof": {"z_m": [-2.0, -1.0]}}}, "free.roof: none of 256 sampled positions is possible: roof at"),
    ({"free": {"roof": {"x_m": [-0.5, 0.0], "z_m": [0.7, 1.4]}}}, "is inside the vehicle's body"),
    ({"free": {"roof": {"x_m": [5.0, 6.0], "z_above_body_m": [0.1, 0.2]}}}, "z_above_body_m: suv has no body at"),
    ({"free": {"roof": {"u": [0, 1]}}}, "free.roof: u: there is no region"),
    ({"free": {"roof": {"region": "roof", "x_m": [0, 1]}}}, "free.roof: x_m: a region defines the position"),
    ({"free": {"roof": {"region": "spoiler"}}}, "free.roof.region: suv has no 'spoiler'; it has roof, hood, grille"),
    ({"free": {"roof": {"region": "roof"}}, "vehicle": "cyclist"}, "cyclist has no 'roof'; it has none"),
    ({"free": {"roof": {"region": ["roof"]}}}, "free.roof: region: got roof; give at least two different options"),
    ({"free": {"roof": {"region": "roof", "u": [0.5, 1.5]}}}, "free.roof.u: got (0.5, 1.5); give values from 0 to 1"),
    (
        {"free": {"roof": {"region": "roof", "height_m": [-0.1, 0.5]}}},
        "free.roof.height_m: got (-0.1, 0.5); give values from 0.001 to 10",
    ),
    ({"free": {"roof": {"model": ["velodyne_vlp16"]}}}, "free.roof.model: "),
    (
        {"free": {"roof": {"model": ["velodyne_vlp16", "velodyne_vlp16"]}}},
        "model: got velodyne_vlp16, velodyne_vlp16; give at least two different options",
    ),
    ({"free": {"roof": {"model": ["velodyne_vlp16", "velodine"]}}}, "built-in lidars; is "),
    ({"free": {"roof": {"present": [True, True]}}}, "free.roof: present: got [True, True]; give [true, false]"),
    (
        {"free": {"roof": {"mirror_of": "left"}}},
        "free.roof.mirror_of: got 'left'; give a free sensor, one of none",
    ),
    ({"free": {"roof": {"mirror_of": "roof"}}}, "free.roof.mirror_of: got 'roof'; give a free sensor"),
    ({"free": {"roof": {"mirror_of": "left", "x_m": [0, 1]}}}, "mirror_of: a mirror image has no other keys"),
    ({"constraints": {"max_cost_eur": 100}}, "constraints.max_cost_eur: there are no prices"),
    ({"constraints": {"max_cost_eur": 100}, "prices_eur": {"roof": 200}}, "the cheapest rig of the space costs 200"),
    ({"prices_eur": {"velodyne_vlp16": 200}}, "prices_eur: 'roof' of the sensor 'roof' has no price"),
    ({"prices_eur": {"roof": 200, "rof": 200}}, "prices_eur: rof is no LiDAR model, no sensor"),
    ({"constraints": {"min_distance": 1}}, "constraints.min_distance: "),
    (
        {"constraints": {"symmetric": True}, "free": {"roof": {"yaw_deg": [5, 9]}}},
        "constraints: none of 256 sampled candidates",
    ),
    ({"objectives": {}}, "objectives: "),
    ({"objectives": {name: {"region": "20m"} for name in "abcd"}}, "objectives: "),
    ({"objectives": {"near": {"region": "21m"}}}, "objective 'near': region '21m': give one of 20m, 80m, 160m"),
    ({"objectives": {"near": {"region": "20m", "band": "sky"}}}, "objective 'near': "),
    ({"scenario": []}, "scenario: "),
    ({"scenario": "nowhere"}, "'nowhere' is neither a .yaml file nor one of the built-in scenarios"),
    ({"vehicle": "spaceship"}, "vehicle: 'spaceship' is neither a .yaml file nor one of the built-in vehicles"),
    ({"vehicle": "body.ply"}, "vehicle: got 'body.ply'; give the name of a vehicle or the path of its YAML file"),
    ({"start": "none"}, "start: 'none' is neither a .yaml file nor one of the built-in rigs"),
    ({"start": 3}, "start: a mapping is needed; got 3"),
]


@pytest.mark.filterwarnings("ignore:.*is outside the space")
@pytest.mark.parametrize(("changed", "message"), MISTAKES)
def test_invalid_spaces_are_refused(changed, message, tmp_path):
    keys = {"name": "here", "start": "front_roof_32", "scenario": "courtyard", "objectives": NEAR}
    keys["free"] = {"roof": {"pitch_deg": [-5, 5]}}
    path = tmp_path / "space.yaml"
    path.write_text(to_yaml(keys | changed), encoding="utf-8")
    with pytest.raises(BadFileError) as refused:
        SearchSpace.load(path)
    assert str(refused.value).startswith(f"{path}: ")
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_scenarios_with_different_egos_need_a_vehicle(tmp_path):
    own = "name: own\nego: {shape: {type: vehicle, vehicle: van}}\ntraffic: {type: urban}\n"
    (tmp_path / "own.yaml").write_text(own)
    keys = {"name": "here", "start": PAIR, "scenario": ["courtyard", str(tmp_path / "own.yaml")], "objectives": NEAR}
    keys["free"] = {"left": {"z_m": (3.0, 3.5)}}
    with warnings.catch_warnings(action="ignore"):
        with pytest.raises(ValueError, match=r"the ego vehicles differ \(courtyard suv, own van\)"):
            SearchSpace(**keys)
        assert SearchSpace(**keys, vehicle="bus").scenarios[1].ego_name == "bus"


def test_start_outside_the_space_is_reported():
    with pytest.warns(UserWarning, match=r"'pair' is outside the space \(left\.x_m is -0\.5\)"):
        searched = space({"left": {"x_m": (0.0, 0.1), "yaw_deg": (-5.0, 5.0)}})
    assert searched.get_start_values() == {"left.yaw_deg": 0.0}


def test_a_space_can_be_sent_to_another_process():
    searched = space({"left": {"region": "roof"}})
    assert searched.find_violations(PAIR) == ()
    again = pickle.loads(pickle.dumps(searched))
    assert again == searched
    values = next(drawn(searched))
    assert again.build_rig(values, "found") == searched.build_rig(values, "found")


def test_written_rigs_contain_referenced_files(tmp_path):
    model = (EXAMPLES[0].parents[2] / "datasets" / "lidars" / "velodyne_vlp16.yaml").read_text()
    (tmp_path / "mine.yaml").write_text(model)
    (tmp_path / "there").mkdir()
    rig = Rig(
        name="mine",
        vehicle=str(EXAMPLES[0].parents[1] / "robot" / "robot.yaml"),
        sensors=(Lidar.model_validate({"name": "a", "model": str(tmp_path / "mine.yaml"), "columns": 900}),),
    )
    rig.save(tmp_path / "there" / "rig.yaml")
    (tmp_path / "mine.yaml").unlink()
    again = Rig.load(tmp_path / "there" / "rig.yaml")
    assert again.vehicle == rig.vehicle
    assert (again.sensors[0].compute_directions() == rig.sensors[0].compute_directions()).all()
