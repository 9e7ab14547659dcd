"""Record a drive in a running CARLA with a random reference LiDAR: `python examples/carla_recorder.py out/town`.

Needs a CARLA server (0.9.12 or later) and its Python package `carla`. Traffic can be added with CARLA's own
`generate_traffic.py`. Evaluate the recording with `torchcover evaluate --frames out/town`. The example was tested with
an imitation of the package, not with a server.

The simulation is synchronous, and every LiDAR makes one revolution per tick. The reference is that of the paper: in
each frame a new LiDAR at a random pose in the shell around the vehicle, with channels below its horizon.

`--sensors FILE` reads a list as returned by `sensors()` of agents of the CARLA leaderboard: id, type, x, y, z, roll,
pitch, yaw, and attributes of the blueprint. LiDARs and depth cameras are recorded. Output files are `sensors.json`,
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

YAWS_DEG = {"front": 0.0, "right": 90.0, "rear": 180.0, "left": 270.0}
SENSORS = [
    {"id": "roof", "type": LIDAR_TYPES[0], "z": 1.9, "channels": 64, "range": 120.0}
    | {"upper_fov": 10.0, "lower_fov": -30.0, "points_per_second": 1_500_000},
    *(
        {"id": name, "type": DEPTH_TYPE, "z": 1.9, "yaw": yaw, "image_size_x": 800, "image_size_y": 600, "fov": 90.0}
        for name, yaw in YAWS_DEG.items()
    ),
]
# No noise and no drop-out.
EXACT = {"noise_stddev": 0.0, "dropoff_general_rate": 0.0, "dropoff_zero_intensity": 0.0}
# Keys of the sensor list and attributes of the blueprint.
ATTRIBUTES = {"width": "image_size_x", "height": "image_size_y"}
OBJECT_FILTERS = ("vehicle.*", "walker.pedestrian.*")
MAX_OBJECT_DISTANCE_M = 150.0
WAIT_S = 30.0


class Sensor:
    """Sensor on the vehicle with a queue of its measurements."""

    def __init__(self, world, vehicle, entry):
        blueprint = world.get_blueprint_library().find(entry["type"])
        for name, value in entry.items():
            if name not in ("id", "type", *POSE_COLUMNS):
                blueprint.set_attribute(ATTRIBUTES.get(name, name), str(value))
        self.name = entry["id"]
        self._measurements = queue.Queue()
        pose = build_transform([entry.get(name, 0.0) for name in POSE_COLUMNS])
        self._actor = world.spawn_actor(blueprint, pose, attach_to=vehicle)
        self._actor.listen(self._measurements.put)

    def get_measurement(self, frame):
        """Wait for the measurement of a tick; earlier ones are discarded."""
        while True:
            try:
                measurement = self._measurements.get(timeout=WAIT_S)
            except queue.Empty:
                raise SystemExit(f"{self.name} sent nothing for tick {frame} within {WAIT_S:g} s") from None
            if measurement.frame == frame:
                return measurement

    def remove(self):
        """Remove the sensor from the simulation."""
        self._actor.stop()
        self._actor.destroy()


class Folder:
    """Folder of the recording; the row of a frame in `poses.csv` is written last."""

    def __init__(self, path, entries, vehicle):
        self.path = path
        for name in [*(entry["id"] for entry in entries), REFERENCE, "boxes"]:
            (path / name).mkdir(parents=True)
        reference = {"id": REFERENCE, "type": LIDAR_TYPES[0]}
        (path / "sensors.json").write_text(json.dumps([*entries, reference], indent=1))
        (path / "vehicle.json").write_text(vehicle.model_dump_json())
        self._append(path / "poses.csv", ["frame", "time_s", *POSE_COLUMNS])
        self._append(path / REFERENCE / "poses.csv", ["frame", *POSE_COLUMNS])

    def write(self, name, measurements, reference_pose, objects, vehicle_row):
        """Write a frame."""
        for sensor, measurement in measurements.items():
            save_measurement(self.path / sensor / name, measurement)
        self._append(self.path / REFERENCE / "poses.csv", [name, *reference_pose])
        for row in [["id", "category", *POSE_COLUMNS, *EXTENT_COLUMNS, *VELOCITY_COLUMNS], *objects]:
            self._append(self.path / "boxes" / f"{name}.csv", row)
        self._append(self.path / "poses.csv", [name, *vehicle_row])

    def _append(self, path, row):
        with path.open("a", newline="", encoding="utf-8") as file:
            csv.writer(file).writerow(row)


def save_measurement(path, measurement):
    """Save a point cloud (x, y, z, intensity) or the RGB values of a depth image, in CARLA's axes."""
    if hasattr(measurement, "height"):
        bgra = np.frombuffer(measurement.raw_data, np.uint8).reshape(measurement.height, measurement.width, 4)
        Image.fromarray(np.ascontiguousarray(bgra[..., 2::-1])).save(path.with_suffix(".png"))
    else:
        np.save(path.with_suffix(".npy"), np.frombuffer(measurement.raw_data, np.float32).reshape(-1, 4))


def build_transform(pose):
    """Build the `carla.Transform` of x, y, z, roll, pitch, yaw."""
    x, y, z, roll, pitch, yaw = map(float, pose)
    return carla.Transform(carla.Location(x=x, y=y, z=z), carla.Rotation(roll=roll, pitch=pitch, yaw=yaw))


def get_pose(transform):
    """Get x, y, z, roll, pitch, yaw of a `carla.Transform`."""
    location, rotation = transform.location, transform.rotation
    return [location.x, location.y, location.z, rotation.roll, rotation.pitch, rotation.yaw]


def sample_reference_pose(vehicle, generator):
    """Sample x, y, z, roll, pitch, yaw of the paper's reference sensor relative to the actor, in CARLA's axes."""
    vehicle_T_reference = PaperReference().sample_pose(vehicle.ego_box, generator)
    actor_T_reference = invert(vehicle.vehicle_T_actor) @ vehicle_T_reference
    yaw, pitch, roll = convert_rotation_to_euler(actor_T_reference[:3, :3])
    x, y, z = actor_T_reference[:3, 3]
    return [float(value) for value in (x, -y, z, roll, -pitch, -yaw)]


def build_object_rows(world, ego):
    """Build the rows of `boxes/FRAME.csv` for the vehicles and pedestrians around the ego vehicle."""
    rows = []
    ego_location = ego.get_transform().location
    actors = [actor for pattern in OBJECT_FILTERS for actor in world.get_actors().filter(pattern)]
    for actor in actors:
        box, transform, velocity = actor.bounding_box, actor.get_transform(), actor.get_velocity()
        extent = [box.extent.x, box.extent.y, box.extent.z]
        distance_m = np.hypot(transform.location.x - ego_location.x, transform.location.y - ego_location.y)
        is_near = distance_m < MAX_OBJECT_DISTANCE_M
        if actor.id == ego.id or not is_near or min(extent) <= 0:  # old versions give two-wheelers empty boxes
            continue
        center = np.array(transform.get_matrix()) @ [box.location.x, box.location.y, box.location.z, 1.0]
        angles = get_pose(transform)[3:]
        rows.append([actor.id, actor.type_id, *center[:3], *angles, *extent, velocity.x, velocity.y])
    return rows


def record(client, options, entries):
    """Drive with autopilot and write the measurements of the sensors."""
    world = client.get_world()
    traffic = client.get_trafficmanager()
    original_settings, settings = world.get_settings(), world.get_settings()
    settings.synchronous_mode, settings.fixed_delta_seconds = True, options.tick_s
    generator = np.random.default_rng(options.seed)
    supported = [entry for entry in entries if entry["type"] in (*LIDAR_TYPES, DEPTH_TYPE)]
    entries = [set_rotation_frequency(entry, options.tick_s) for entry in supported]
    reference_attributes = {
        "type": LIDAR_TYPES[0],
        "channels": options.num_rays,
        "upper_fov": 0.0,
        "lower_fov": -90.0,
        "range": 250.0,
        **EXACT,
    }
    reference_attributes["points_per_second"] = round(options.num_rays**2 / options.tick_s)
    ego, sensors = None, []
    try:
        world.apply_settings(settings)
        traffic.set_synchronous_mode(True)
        blueprint = world.get_blueprint_library().find(options.vehicle)
        spawn_points = world.get_map().get_spawn_points()
        ego = world.spawn_actor(blueprint, spawn_points[generator.integers(len(spawn_points))])
        ego.set_autopilot(True, traffic.get_port())
        box = ego.bounding_box
        location = {"x": box.location.x, "y": box.location.y, "z": box.location.z}
        extent = {"x": box.extent.x, "y": box.extent.y, "z": box.extent.z}
        vehicle = CarlaVehicle.model_validate({"location": location, "extent": extent})
        folder = Folder(options.out, entries, vehicle)
        sensors += [Sensor(world, ego, entry) for entry in entries]
        for index in range(options.frames):
            # A new sensor per frame: the pose of a new sensor is relative to the vehicle in every version of CARLA.
            pose = sample_reference_pose(vehicle, generator)
            reference = {"id": REFERENCE, **dict(zip(POSE_COLUMNS, pose, strict=True)), **reference_attributes}
            sensors.append(Sensor(world, ego, set_rotation_frequency(reference, options.tick_s)))
            for _ in range(options.every):
                tick = world.tick()
            measurements = {sensor.name: sensor.get_measurement(tick) for sensor in sensors}
            time_s = world.get_snapshot().timestamp.elapsed_seconds
            vehicle_row = [time_s, *get_pose(ego.get_transform())]
            folder.write(f"{index:06d}", measurements, pose, build_object_rows(world, ego), vehicle_row)
            sensors.pop().remove()
            print(f"{index + 1} of {options.frames}", end="\r", flush=True)
    finally:
        for sensor in sensors:
            sensor.remove()
        if ego is not None:
            ego.destroy()
        traffic.set_synchronous_mode(False)
        world.apply_settings(original_settings)


def set_rotation_frequency(entry, tick_s):
    """Set the rotation frequency of a LiDAR to one revolution per tick; other sensors are unchanged."""
    return {**entry, "rotation_frequency": 1 / tick_s} if entry["type"] in LIDAR_TYPES else entry


def main(arguments=None):
    """Connect to the server and record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="a new folder")
    parser.add_argument("--sensors", type=Path, help="JSON list; default: a LiDAR and four depth cameras on the roof")
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--every", type=int, default=20, help="ticks between frames, at least 2")
    parser.add_argument("--tick-s", type=float, default=0.05)
    parser.add_argument("--num-rays", type=int, default=1024, help="channels and columns of the reference LiDAR")
    parser.add_argument("--vehicle", default="vehicle.tesla.model3")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--host", default="localhost")
    parser.add_argument("--port", type=int, default=2000)
    options = parser.parse_args(arguments)
    if options.every < 2:  # a new sensor may miss its first tick
        parser.error(f"--every: at least 2 ticks are needed; got {options.every}")
    if options.out.exists():
        parser.error(f"{options.out} exists; choose a new folder")
    client = carla.Client(options.host, options.port)
    client.set_timeout(WAIT_S)
    record(client, options, json.loads(options.sensors.read_text()) if options.sensors else SENSORS)
    print(f"Wrote {options.frames} frames; evaluate them: torchcover evaluate --frames {options.out}")


if __name__ == "__main__":
    main()
