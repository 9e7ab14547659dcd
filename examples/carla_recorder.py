"""Record a drive in a running CARLA with a random reference LiDAR: `python examples/carla_recorder.py out/town`.

Needs CARLA's server (0.9.12 or later) and its Python package `carla`; traffic is yours to add, as with CARLA's own
`generate_traffic.py`. Then: `torchcover evaluate --frames out/town`. No server was at hand when this was written: it is
tested against a small imitation of the package, which does what CARLA's documentation says.

The simulation is synchronous, and every LiDAR makes a whole turn in a tick. The reference is the paper's: in each frame
another LiDAR, at a random pose in the shell around the vehicle, that looks down from its horizon.

`--sensors FILE` takes a list as agents of CARLA's leaderboard return it from `sensors()`: id, type, x, y, z, roll,
pitch, yaw, and attributes of the blueprint. LiDARs and depth cameras are recorded. Written are `sensors.json`,
`vehicle.json`, `ID/FRAME.npy` or `.png`, `reference/poses.csv`, `boxes/FRAME.csv` and `poses.csv`.
"""

import argparse
import csv
import json
import queue
from pathlib import Path

import carla
import numpy as np
from PIL import Image

from torchcover.geometry import convert_rotation_to_euler, invert
from torchcover.recordings.formats.carla import (
    DEPTH_TYPE,
    EXTENT_COLUMNS,
    LIDAR_TYPES,
    POSE_COLUMNS,
    REFERENCE,
    VELOCITY_COLUMNS,
    CarlaVehicle,
)
from torchcover.simulation import PaperReference

LOOKS = {"front": 0.0, "right": 90.0, "rear": 180.0, "left": 270.0}
SENSORS = [
    {"id": "roof", "type": LIDAR_TYPES[0], "z": 1.9, "channels": 64, "range": 120.0}
    | {"upper_fov": 10.0, "lower_fov": -30.0, "points_per_second": 1_500_000},
    *(
        {"id": name, "type": DEPTH_TYPE, "z": 1.9, "yaw": yaw, "image_size_x": 800, "image_size_y": 600, "fov": 90.0}
        for name, yaw in LOOKS.items()
    ),
]
# Nothing is dropped and nothing is noisy.
EXACT = {"noise_stddev": 0.0, "dropoff_general_rate": 0.0, "dropoff_zero_intensity": 0.0}
# What an agent's list calls them, and a blueprint.
ATTRIBUTES = {"width": "image_size_x", "height": "image_size_y"}
OBJECTS, OBJECTS_WITHIN_M = ("vehicle.*", "walker.pedestrian.*"), 150.0
WAIT_S = 30.0


class Sensor:
    """A sensor on the vehicle, and what it has sent."""

    def __init__(self, world, vehicle, listed):
        blueprint = world.get_blueprint_library().find(listed["type"])
        for name, value in listed.items():
            if name not in ("id", "type", *POSE_COLUMNS):
                blueprint.set_attribute(ATTRIBUTES.get(name, name), str(value))
        self.name = listed["id"]
        self._sent = queue.Queue()
        pose = placed([listed.get(name, 0.0) for name in POSE_COLUMNS])
        self._actor = world.spawn_actor(blueprint, pose, attach_to=vehicle)
        self._actor.listen(self._sent.put)

    def data(self, frame):
        """What it measured in a tick; what it sent before is forgotten."""
        while True:
            try:
                measured = self._sent.get(timeout=WAIT_S)
            except queue.Empty:
                raise SystemExit(f"{self.name} sent nothing for tick {frame} within {WAIT_S:g} s") from None
            if measured.frame == frame:
                return measured

    def remove(self):
        """Take it off the vehicle."""
        self._actor.stop()
        self._actor.destroy()


class Folder:
    """The recording on disk; the row of a frame in `poses.csv` comes last."""

    def __init__(self, path, listed, vehicle):
        self.path = path
        for one in [*listed, {"id": REFERENCE}, {"id": "boxes"}]:
            (path / one["id"]).mkdir(parents=True)
        reference = {"id": REFERENCE, "type": LIDAR_TYPES[0]}
        (path / "sensors.json").write_text(json.dumps([*listed, reference], indent=1))
        (path / "vehicle.json").write_text(vehicle.model_dump_json())
        self._append(path / "poses.csv", ["frame", "time_s", *POSE_COLUMNS])
        self._append(path / REFERENCE / "poses.csv", ["frame", *POSE_COLUMNS])

    def write(self, name, measured, reference_pose, objects, vehicle_row):
        """Write a frame."""
        for sensor, data in measured.items():
            save(self.path / sensor / name, data)
        self._append(self.path / REFERENCE / "poses.csv", [name, *reference_pose])
        for row in [["id", "category", *POSE_COLUMNS, *EXTENT_COLUMNS, *VELOCITY_COLUMNS], *objects]:
            self._append(self.path / "boxes" / f"{name}.csv", row)
        self._append(self.path / "poses.csv", [name, *vehicle_row])

    def _append(self, path, row):
        with path.open("a", newline="", encoding="utf-8") as file:
            csv.writer(file).writerow(row)


def save(path, measured):
    """A cloud, x y z intensity, or the red, green and blue of a depth image; both in CARLA's axes."""
    if hasattr(measured, "height"):
        bgra = np.frombuffer(measured.raw_data, np.uint8).reshape(measured.height, measured.width, 4)
        Image.fromarray(np.ascontiguousarray(bgra[..., 2::-1])).save(path.with_suffix(".png"))
    else:
        np.save(path.with_suffix(".npy"), np.frombuffer(measured.raw_data, np.float32).reshape(-1, 4))


def placed(pose):
    """`carla.Transform` of x, y, z, roll, pitch, yaw."""
    x, y, z, roll, pitch, yaw = map(float, pose)
    return carla.Transform(carla.Location(x=x, y=y, z=z), carla.Rotation(roll=roll, pitch=pitch, yaw=yaw))


def pose_of(transform):
    """x, y, z, roll, pitch, yaw of a `carla.Transform`."""
    place, turn = transform.location, transform.rotation
    return [place.x, place.y, place.z, turn.roll, turn.pitch, turn.yaw]


def random_pose(vehicle, generator):
    """x, y, z, roll, pitch, yaw of the paper's reference sensor on the actor, in CARLA's axes."""
    drawn = PaperReference().sample_pose(vehicle.ego_box, generator)
    actor_T_reference = invert(vehicle.vehicle_T_actor) @ drawn
    yaw, pitch, roll = convert_rotation_to_euler(actor_T_reference[:3, :3])
    x, y, z = actor_T_reference[:3, 3]
    return [float(number) for number in (x, -y, z, roll, -pitch, -yaw)]


def objects_in(world, ego):
    """Rows of the vehicles and walkers around, as the reader has them."""
    rows = []
    here = ego.get_transform().location
    for actor in (actor for kind in OBJECTS for actor in world.get_actors().filter(kind)):
        box, pose, speed = actor.bounding_box, actor.get_transform(), actor.get_velocity()
        half = [box.extent.x, box.extent.y, box.extent.z]
        near = np.hypot(pose.location.x - here.x, pose.location.y - here.y) < OBJECTS_WITHIN_M
        if actor.id == ego.id or not near or min(half) <= 0:  # two-wheelers of old versions have boxes without size
            continue
        centre = np.array(pose.get_matrix()) @ [box.location.x, box.location.y, box.location.z, 1.0]
        rows.append([actor.id, actor.type_id, *centre[:3], *pose_of(pose)[3:], *half, speed.x, speed.y])
    return rows


def record(client, options, listed):
    """Drive, and write what the sensors see."""
    world = client.get_world()
    traffic = client.get_trafficmanager()
    before, settings = world.get_settings(), world.get_settings()
    settings.synchronous_mode, settings.fixed_delta_seconds = True, options.tick_s
    generator = np.random.default_rng(options.seed)
    listed = [at_each_tick(one, options.tick_s) for one in listed if one["type"] in (*LIDAR_TYPES, DEPTH_TYPE)]
    best_case = {
        "type": LIDAR_TYPES[0],
        "channels": options.num_rays,
        "upper_fov": 0.0,
        "lower_fov": -90.0,
        "range": 250.0,
        **EXACT,
    }
    best_case["points_per_second"] = round(options.num_rays**2 / options.tick_s)
    ego, sensors = None, []
    try:
        world.apply_settings(settings)
        traffic.set_synchronous_mode(True)
        blueprint = world.get_blueprint_library().find(options.vehicle)
        places = world.get_map().get_spawn_points()
        ego = world.spawn_actor(blueprint, places[generator.integers(len(places))])
        ego.set_autopilot(True, traffic.get_port())
        box = ego.bounding_box
        point = {"x": box.location.x, "y": box.location.y, "z": box.location.z}
        half = {"x": box.extent.x, "y": box.extent.y, "z": box.extent.z}
        vehicle = CarlaVehicle.model_validate({"location": point, "extent": half})
        folder = Folder(options.out, listed, vehicle)
        sensors += [Sensor(world, ego, one) for one in listed]
        for number in range(options.frames):
            # Another sensor every time: where a new one is attached counts from the vehicle in every version.
            pose = random_pose(vehicle, generator)
            reference = {"id": REFERENCE, **dict(zip(POSE_COLUMNS, pose, strict=True)), **best_case}
            sensors.append(Sensor(world, ego, at_each_tick(reference, options.tick_s)))
            for _ in range(options.every):
                tick = world.tick()
            measured = {sensor.name: sensor.data(tick) for sensor in sensors}
            time_s = world.get_snapshot().timestamp.elapsed_seconds
            driven = [time_s, *pose_of(ego.get_transform())]
            folder.write(f"{number:06d}", measured, pose, objects_in(world, ego), driven)
            sensors.pop().remove()
            print(f"{number + 1} of {options.frames}", end="\r", flush=True)
    finally:
        for sensor in sensors:
            sensor.remove()
        if ego is not None:
            ego.destroy()
        traffic.set_synchronous_mode(False)
        world.apply_settings(before)


def at_each_tick(listed, tick_s):
    """A LiDAR that makes a whole turn in a tick."""
    return {**listed, "rotation_frequency": 1 / tick_s} if listed["type"] in LIDAR_TYPES else listed


def main(arguments=None):
    """Connect and record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="a new folder")
    parser.add_argument("--sensors", type=Path, help="JSON; a LiDAR and four depth cameras on the roof if not given")
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--every", type=int, default=20, help="ticks from a frame to the next, at least 2")
    parser.add_argument("--tick-s", type=float, default=0.05)
    parser.add_argument("--num-rays", type=int, default=1024, help="rows, and columns, of the reference LiDAR")
    parser.add_argument("--vehicle", default="vehicle.tesla.model3")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--host", default="localhost")
    parser.add_argument("--port", type=int, default=2000)
    options = parser.parse_args(arguments)
    if options.every < 2:  # a new sensor may miss its first tick
        parser.error(f"--every: at least 2 ticks are needed; got {options.every}")
    if options.out.exists():
        parser.error(f"{options.out} is there already; a new folder is needed")
    client = carla.Client(options.host, options.port)
    client.set_timeout(WAIT_S)
    record(client, options, json.loads(options.sensors.read_text()) if options.sensors else SENSORS)
    print(f"Wrote {options.frames} frames; read them with: torchcover evaluate --frames {options.out}")


if __name__ == "__main__":
    main()
