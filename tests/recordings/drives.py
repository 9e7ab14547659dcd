"""Recordings in memory, of a scene that is known exactly."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from torchcover.data import Scan
from torchcover.detection import Boxes
from torchcover.geometry import BoundingBox, build_transform, convert_euler_to_rotation, invert, transform_points
from torchcover.recordings.recording import Recording

CAR_SIZE_M = (4.0, 2.0, 1.5)


@dataclass
class Drive(Recording):
    """Straight drive past a wall, behind a faster car. Points lie on the wall and on the rear of the car.

    Sensor `left` observes the wall at negative x of the vehicle frame, `right` the whole wall and the car.
    """

    steps: int = 5
    labelled: bool = True
    named: bool = True
    origin_m: tuple = (0.0, 0.0, 0.0)
    ego_box: BoundingBox | None = None
    sensors = ("left", "right")
    path = Path("drive")

    def __post_init__(self):
        self.frame_names = [f"f{step}" for step in range(self.steps)]
        self.key_frames = range(self.steps)
        self.times_s = 0.1 * np.arange(self.steps)
        self.rigs = {"both": self.sensors}
        x, z = np.meshgrid(np.arange(-20.0, 40.0, 0.5) + 0.01, np.arange(0.11, 3.0, 0.5))
        self.wall_m = np.stack([x.ravel(), np.full(x.size, 5.01), z.ravel()], axis=1) + self.origin_m
        y, z = np.meshgrid(np.arange(-0.88, 1.0, 0.2), np.arange(-0.58, 0.7, 0.2))
        self.back_m = np.stack([np.full(y.size, -1.98), y.ravel(), z.ravel()], axis=1)  # in the frame of its box

    def get_world_T_vehicle(self, index):
        return build_transform(
            convert_euler_to_rotation(10.0 * index, 0.0, 0.0), self.origin_m + np.array([1.5 * index, 0.0, 0.0])
        )

    def world_T_car(self, index):
        place_m = self.origin_m + np.array([10.0 + 2.0 * index, 0.0, 0.75])
        return build_transform(convert_euler_to_rotation(5.0 * index, 0.0, 0.0), place_m)

    def vehicle_T_sensor(self, sensor):
        return build_transform(convert_euler_to_rotation(0.0, 3.0, 0.0), [0.5, 0.3 if sensor == "left" else -0.3, 1.7])

    def read_scan(self, sensor, index):
        seen_m = transform_points(invert(self.get_world_T_vehicle(index)), self.wall_m)
        if sensor == "left":
            seen_m = seen_m[seen_m[:, 0] < 0]
        else:
            vehicle_T_car = invert(self.get_world_T_vehicle(index)) @ self.world_T_car(index)
            seen_m = np.concatenate([seen_m, transform_points(vehicle_T_car, self.back_m)])
        return Scan(
            transform_points(invert(self.vehicle_T_sensor(sensor)), seen_m), self.vehicle_T_sensor(sensor), sensor
        )

    def read_boxes(self, index):
        if not self.labelled:
            return None
        vehicle_T_car = invert(self.get_world_T_vehicle(index)) @ self.world_T_car(index)
        yaw = np.arctan2(vehicle_T_car[1, 0], vehicle_T_car[0, 0])
        row = torch.tensor([[*vehicle_T_car[:3, 3], *CAR_SIZE_M, yaw]], dtype=torch.float32)
        return Boxes.from_rows(row, ids=("car",) if self.named else ("",))
