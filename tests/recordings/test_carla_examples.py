"""Examples with CARLA: coverage from four depth images, and the recorder with a stand-in for CARLA's package."""

import importlib
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree

from examples import four_depth_cameras
from tests.recordings.test_carla import carla_matrix, mirrored
from torchcover import Rig
from torchcover.cameras import Camera
from torchcover.data import RecordedFrames, SimulatedFrames, open_recording
from torchcover.geometry import invert, transform_points
from torchcover.simulation import PaperReference

FULL_CODE = 2**24 - 1
HEIGHT_M = 2.8


def encoded(depth_m):
    """Red, green and blue of z-depths: 1000 m are all ones."""
    code = np.where(np.isfinite(depth_m), np.round(depth_m / 1000.0 * FULL_CODE), FULL_CODE).astype(np.int64)
    return (code[..., None] >> np.array([0, 8, 16]) & 255).astype(np.uint8)


@pytest.fixture(scope="module")
def photographed(tmp_path_factory):
    """Four depth images of the courtyard, and the points that their pixels see."""
    folder = tmp_path_factory.mktemp("images")
    sensors = [
        {"type": "camera", "name": name, "mount": {"z_m": HEIGHT_M, "yaw_deg": -yaw_deg}, "width": 50, "height": 40}
        | {"fov_deg": 90.0, "max_range_m": 300.0}
        for name, yaw_deg in four_depth_cameras.YAWS_DEG.items()
    ]
    paths, clouds = [], {}
    for sensor in sensors:
        rig = Rig.model_validate({"name": sensor["name"], "sensors": [sensor]})
        frames = SimulatedFrames("courtyard", rig, num_frames=1, reference_sensor=PaperReference(rows=4, columns=4))
        points = frames[0].sensor
        camera: Camera = rig.sensors[0].build_camera()
        in_camera = camera.to_camera(points)
        pixels, visible = camera.project(in_camera)
        assert visible.all()
        column, row = pixels.round().long().T.numpy()
        depth_m = np.full((40, 50), np.inf)
        depth_m[row, column] = in_camera[:, 2]
        paths.append(folder / f"{sensor['name']}.png")
        Image.fromarray(encoded(depth_m)).save(paths[-1])
        clouds[sensor["name"]] = points.numpy().astype(np.float64)
    return paths, clouds


def test_four_depth_images_form_one_cloud(photographed):
    paths, clouds = photographed
    found = four_depth_cameras.read_clouds(paths, 90.0, [0.0, 0.0, HEIGHT_M])
    assert list(found) == list(clouds)
    for name, cloud in clouds.items():
        assert len(found[name]) == len(cloud) > 500
        assert cKDTree(cloud).query(found[name].numpy())[0].max() < 1e-4  # 1000 m in 24 bits
        assert cKDTree(found[name].numpy()).query(cloud)[0].max() < 1e-4


def test_four_depth_images_match_an_independent_computation(photographed, capsys):
    paths, _ = photographed
    clouds = {
        name: cloud.numpy() for name, cloud in four_depth_cameras.read_clouds(paths, 90.0, [0.0, 0.0, HEIGHT_M]).items()
    }
    merged = np.concatenate(list(clouds.values()))
    near = cKDTree(clouds["front"]).query(merged)[0] <= 0.4
    cells = {}
    for (x, y, z), hit in zip(merged, near, strict=True):
        if -20 <= x < 20 and -20 <= y < 20 and -0.5 <= z < 0.5:
            cells.setdefault((x // 0.25, y // 0.25), []).append(hit)
    expected = np.mean([np.mean(hits) for hits in cells.values()])
    four_depth_cameras.main([*map(str, paths), "--height", str(HEIGHT_M)])
    _, front, *_ = capsys.readouterr().out.splitlines()
    assert front.startswith(f"front: ground {expected:.1%}")
    assert 0.1 < expected < 0.9


# Scene of the stand-in, right-handed in the world; the ground is z = 0.
UNDER_THE_MIDDLE_M = np.array([-0.1, 0.05, 0.0])
WORLD = np.random.default_rng(0).uniform([-30, -30, 0.5], [30, 30, 4], (60, 3))
BOX = SimpleNamespace(location=SimpleNamespace(x=0.1, y=0.05, z=0.75), extent=SimpleNamespace(x=2.3, y=1.0, z=0.75))


class Transform:
    """As `carla.Transform`, left-handed."""

    def __init__(self, location, rotation):
        self.location, self.rotation = location, rotation

    def get_matrix(self):
        place, turn = self.location, self.rotation
        return carla_matrix(place.x, place.y, place.z, turn.roll, turn.pitch, turn.yaw).tolist()


class Actor:
    def __init__(self, number, kind, pose, attributes=(), parent=None):
        self.id, self.type_id, self.bounding_box = number, kind, BOX
        self.pose, self.attributes, self.parent, self.heard = pose, dict(attributes), parent, None
        self.alive = True

    def get_transform(self):
        return self.pose

    def get_velocity(self):
        return SimpleNamespace(x=1.0, y=2.0, z=0.0)

    def set_autopilot(self, on, port):
        assert (on, port) == (True, 8000)

    def listen(self, heard):
        self.heard = heard

    def stop(self):
        self.heard = None

    def destroy(self):
        self.alive = False

    def measure(self, tick):
        """What a LiDAR, or a depth camera, sends; it sees all of the world, and the flat ground."""
        place = np.array(self.parent.pose.get_matrix()) @ np.array(self.pose.get_matrix())
        if self.type_id == "sensor.lidar.ray_cast":
            assert float(self.attributes["rotation_frequency"]) == 20.0
            seen = transform_points(invert(place), mirrored(WORLD))
            return SimpleNamespace(frame=tick, raw_data=np.c_[seen, np.ones(len(seen))].astype(np.float32).tobytes())
        width, height, fov = (int(float(self.attributes[name])) for name in ("image_size_x", "image_size_y", "fov"))
        focal = width / (2 * np.tan(np.deg2rad(fov) / 2))
        column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        ray = np.stack([np.ones_like(row), (column - width / 2) / focal, -(row - height / 2) / focal], axis=-1)
        down = -(ray @ place[:3, :3].T)[..., 2]
        depth_m = np.where(down > 0.02, place[2, 3] / np.maximum(down, 0.02), np.inf)
        bgra = np.concatenate([encoded(depth_m)[..., ::-1], np.full((height, width, 1), 255, np.uint8)], axis=2)
        return SimpleNamespace(frame=tick, raw_data=bgra.tobytes(), height=height, width=width)


class World:
    """One car that drives on and turns, another that stands; every tick all sensors send."""

    def __init__(self):
        self.settings = SimpleNamespace(synchronous_mode=False, fixed_delta_seconds=None)
        self.actors, self.tick_number, self.late = [], 100, set()
        other = Transform(SimpleNamespace(x=12.0, y=-3.0, z=0.0), SimpleNamespace(roll=0.0, pitch=0.0, yaw=30.0))
        self.other = Actor(7, "vehicle.audi.tt", other)
        self.actors.append(self.other)

    def get_settings(self):
        return SimpleNamespace(**vars(self.settings))

    def apply_settings(self, settings):
        self.settings = settings

    def get_blueprint_library(self):
        def find(kind):
            blueprint = SimpleNamespace(kind=kind, attributes={})
            blueprint.set_attribute = lambda name, value: blueprint.attributes.__setitem__(name, value + "")
            return blueprint

        return SimpleNamespace(find=find)

    def get_map(self):
        start = Transform(SimpleNamespace(x=1.0, y=2.0, z=0.0), SimpleNamespace(roll=0.0, pitch=0.0, yaw=10.0))
        return SimpleNamespace(get_spawn_points=lambda: [start])

    def spawn_actor(self, blueprint, pose, attach_to=None):
        actor = Actor(len(self.actors) + 20, blueprint.kind, pose, blueprint.attributes, attach_to)
        self.actors.append(actor)
        return actor

    def get_actors(self):
        def filtered(pattern):
            return [actor for actor in self.actors if actor.alive and actor.type_id.startswith(pattern.rstrip("*"))]

        return SimpleNamespace(filter=filtered)

    def get_snapshot(self):
        return SimpleNamespace(timestamp=SimpleNamespace(elapsed_seconds=0.05 * self.tick_number))

    def tick(self):
        assert self.settings.synchronous_mode
        assert self.settings.fixed_delta_seconds == 0.05
        self.tick_number += 1
        ego = self.get_actors().filter("vehicle.tesla")[0]
        ego.pose.location.x += 0.5
        ego.pose.rotation.yaw += 4.0
        for actor in self.actors:
            if actor.heard is not None:
                actor.heard(actor.measure(self.tick_number))
        return self.tick_number


@pytest.fixture
def recorder(monkeypatch):
    """The example with the imitation, and its world."""
    world, carla = World(), ModuleType("carla")
    carla.Location = carla.Rotation = SimpleNamespace
    carla.Transform = Transform
    traffic = SimpleNamespace(set_synchronous_mode=lambda on: None, get_port=lambda: 8000)
    client = SimpleNamespace(
        set_timeout=lambda seconds: None, get_world=lambda: world, get_trafficmanager=lambda: traffic
    )
    carla.Client = lambda host, port: client
    monkeypatch.setitem(sys.modules, "carla", carla)
    sys.modules.pop("examples.carla_recorder", None)
    yield importlib.import_module("examples.carla_recorder"), world
    del sys.modules["examples.carla_recorder"]


def test_recorder_output_is_read_with_true_coordinates(recorder, tmp_path, capsys):
    carla_recorder, world = recorder
    sensors = [
        {"id": "roof", "type": "sensor.lidar.ray_cast", "x": 0.3, "y": 0.2, "z": 1.9, "pitch": 5.0, "yaw": 20.0},
        {"id": "right", "type": "sensor.camera.depth", "z": 1.9, "yaw": 90.0, "width": 20, "height": 15, "fov": 80},
        {"id": "rgb", "type": "sensor.camera.rgb", "width": 20, "height": 15, "fov": 80},
    ]
    (tmp_path / "sensors.json").write_text(str(sensors).replace("'", '"'))
    out = tmp_path / "drive"
    arguments = [
        str(out),
        "--sensors",
        str(tmp_path / "sensors.json"),
        "--frames",
        "3",
        "--every",
        "2",
        "--num-rays",
        "8",
    ]
    carla_recorder.main(arguments)
    assert "torchcover evaluate --frames" in capsys.readouterr().out
    assert not world.settings.synchronous_mode
    assert [actor.type_id for actor in world.actors if actor.alive] == ["vehicle.audi.tt"]
    references = [actor for actor in world.actors if actor.attributes.get("lower_fov") == "-90.0"]
    assert len(references) == 3
    assert references[0].attributes["points_per_second"] == str(8 * 8 * 20)

    recording = open_recording(out)
    assert (recording.frame_names, recording.sensors) == (("000000", "000001", "000002"), ("roof", "right"))
    np.testing.assert_allclose(recording.times_s, [5.1, 5.2, 5.3])
    assert recording.ego_box.size_m == pytest.approx((4.6, 2.0, 1.45))
    roof, right = (RecordedFrames(recording, rigs={name: [name]}) for name in ("roof", "right"))
    places_m = []
    for index in range(3):
        ticks = 2 * index + 2
        world_T_actor = carla_matrix(1.0 + 0.5 * ticks, 2.0, 0.0, 0.0, 0.0, 10.0 + 4.0 * ticks)
        seen = mirrored(transform_points(invert(world_T_actor), mirrored(WORLD))) + UNDER_THE_MIDDLE_M
        own = (np.abs(seen[:, :2]) < [2.3, 1.0]).all(axis=1) & (seen[:, 2] < 1.5)
        for cloud in (roof[index].sensor, roof[index].reference):
            np.testing.assert_allclose(cloud, seen[~own], atol=1e-4)
        heights = right[index].sensor[:, 2]
        assert len(heights) > 100
        assert heights.abs().max() < 0.01  # the ground, of pixels that look down by a degree and more
        (box,) = recording.read_boxes(index).rows
        assert recording.read_boxes(index).categories == ("vehicle.audi.tt",)
        centre = transform_points(np.array(world.other.pose.get_matrix()), np.array([[0.1, 0.05, 0.75]]))
        expected = mirrored(transform_points(invert(world_T_actor), centre)) + UNDER_THE_MIDDLE_M
        np.testing.assert_allclose(box[:3], expected[0], atol=1e-5)
        np.testing.assert_allclose(box[3:], [4.6, 2.0, 1.5, np.deg2rad(-30 + 10 + 4.0 * ticks)], atol=1e-5)
        places_m.append(recording.read_scan("reference", index).vehicle_T_sensor[:3, 3])
    assert np.linalg.norm(np.diff(places_m, axis=0), axis=1).min() > 0.01  # another place every time
    outside = np.abs(places_m) - [2.3, 1.0, 1.5]
    assert ((outside > 0).any(axis=1) & (outside < 0.5).all(axis=1)).all()  # in the shell around the box


def test_silent_sensor_ends_recording_and_restores_server(recorder, tmp_path, monkeypatch):
    carla_recorder, world = recorder
    monkeypatch.setattr(carla_recorder, "WAIT_S", 0.01)
    monkeypatch.setattr(Actor, "measure", lambda actor, tick: SimpleNamespace(frame=0))
    with pytest.raises(SystemExit, match=r"roof sent nothing for tick 120 within 0\.01 s"):
        carla_recorder.main([str(tmp_path / "drive")])
    assert not world.settings.synchronous_mode
    assert [actor.type_id for actor in world.actors if actor.alive] == ["vehicle.audi.tt"]
