"""KITTI's 3D object benchmark: single instants with calibration and labels."""

import os
from pathlib import Path
from typing import ClassVar

import numpy as np

from torchcover.cameras.calibration import read_kitti
from torchcover.detection.boxes import Boxes
from torchcover.geometry import BoundingBox, invert
from torchcover.recordings.clouds.readers import read_cloud
from torchcover.recordings.formats.file_names import check_same_names, frame_files
from torchcover.recordings.formats.kitti_files import (
    BODY,
    IMAGE_SIZE,
    png_size,
    read_calibration,
    read_labels,
    transform_of,
    vehicle_T_velodyne,
)
from torchcover.recordings.recording import Layout, Scan, SensorCalibrations


class KittiObject(Layout):
    """A folder with `velodyne/FRAME.bin`, `calib/FRAME.txt`, and `label_2/FRAME.txt` where there are labels.

    The data set has no reference, and neighbours in the list are not neighbours in time: a reference has to be in a
    folder `reference/FRAME.*` beside them, in the frame of the LiDAR.

    `path`: `training`, `testing`, or the folder that holds `training`.
    """

    layout: ClassVar[str] = "velodyne/FRAME.bin, calib/FRAME.txt, label_2/FRAME.txt"
    sensors = ("velodyne",)
    times_s = None
    body: BoundingBox | None = BODY

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = _split(Path(path))
        self._clouds = frame_files(self.path / "velodyne")
        check_same_names(self.path, {"velodyne": self._clouds})
        self.names = tuple(self._clouds)
        self.rigs = {"kitti": self.sensors}
        self.reference_sensors = ("reference",) if (self.path / "reference").is_dir() else ()
        self._references = frame_files(self.path / "reference", like=self.names) if self.reference_sensors else {}

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether it has clouds and calibrations."""
        return all((_split(path) / place).is_dir() for place in ("velodyne", "calib"))

    def scan(self, sensor: str, index: int) -> Scan:
        """Read a cloud."""
        path = (self._references if sensor == "reference" else self._clouds)[self.names[index]]
        return Scan(read_cloud(path), vehicle_T_velodyne, str(path))

    def world_T_vehicle(self, index: int) -> None:
        """Unknown."""

    def calibrations(self) -> SensorCalibrations:
        """The rectified cameras of the first frame; their sizes are known only where there are images."""
        name = self.names[0]
        calibration = self.path / "calib" / f"{name}.txt"
        images = [path for number in range(4) if (path := self.path / f"image_{number}" / f"{name}.png").exists()]
        width, height = png_size(images[0]) if images else IMAGE_SIZE
        cameras = [
            read_kitti(calibration, number, width=width, height=height, vehicle_T_lidar=vehicle_T_velodyne)
            for number in range(4)
        ]
        told = f"{images[0].parent.name}/{name}.png" if images else "the data set's usual ones, for there are no images"
        source = f"calib/{name}.txt, the LiDAR where KITTI's is, sizes of images {width} x {height} ({told})"
        return SensorCalibrations(source, {"velodyne": vehicle_T_velodyne}, tuple(cameras))

    def boxes(self, index: int) -> Boxes | None:
        """The labels, if there are any files of them."""
        if not (self.path / "label_2").is_dir():
            return None
        name = f"{self.names[index]}.txt"
        calibration = read_calibration(self.path / "calib" / name)
        camera_T_velodyne = transform_of(calibration, "R0_rect", self.path / "calib" / name) @ transform_of(
            calibration, "Tr_velo_to_cam", self.path / "calib" / name
        )
        labels = read_labels(self.path / "label_2" / name)
        numbers = np.array([row for _, row in labels]).reshape(-1, 14)
        return Boxes.from_kitti_label(
            numbers,
            vehicle_T_velodyne @ invert(camera_T_velodyne),
            categories=tuple(category for category, _ in labels),
        )


def _split(path: Path) -> Path:
    return path / "training" if (path / "training" / "velodyne").is_dir() else path
