"""KITTI's `tracklet_labels.xml`: boxes of objects over the frames of a drive."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import torch

from torchcover.detection.boxes import Boxes
from torchcover.files import parse_xml, reads
from torchcover.geometry.rigid import Matrix, euler_from_rotation, rotation_from_euler, transform


@reads("KITTI tracklets")
def read_tracklets(path: Path, vehicle_T_velodyne: Matrix) -> dict[int, Boxes]:
    """Read the boxes of every frame that has any.

    The origin of a tracklet is the middle of the bottom of its box, in the frame of the LiDAR. Its name is its number
    in the file.

    Args:
        path: The file.
        vehicle_T_velodyne: (4, 4) where the LiDAR is; its z axis is upright.

    Raises:
        BadFileError: Not such a file, or numbers that are no boxes.
    """
    root = parse_xml(path)
    frames: dict[int, list[tuple[list[float], str, str]]] = {}
    for number, item in enumerate(root.findall("./tracklets/item")):
        category = (item.findtext("objectType") or "").strip().lower()
        length, width, height = (_number(item, name) for name in "lwh")
        start = int(_number(item, "first_frame"))
        for step, pose in enumerate(item.findall("./poses/item")):
            x, y, z = (_number(pose, f"t{axis}") for axis in "xyz")
            row = [x, y, z + height / 2, length, width, height, _number(pose, "rz")]
            frames.setdefault(start + step, []).append((row, str(number), category))
    return {frame: _boxes(found, vehicle_T_velodyne) for frame, found in frames.items()}


def _boxes(found: list[tuple[list[float], str, str]], vehicle_T_velodyne: Matrix) -> Boxes:
    rows = np.array([row for row, _, _ in found])
    rows[:, :3] = transform(vehicle_T_velodyne, rows[:, :3])
    turned = [vehicle_T_velodyne[:3, :3] @ rotation_from_euler(np.rad2deg(yaw), 0.0, 0.0) for yaw in rows[:, 6]]
    rows[:, 6] = np.deg2rad(euler_from_rotation(np.stack(turned))[:, 0])
    return Boxes.from_rows(
        torch.from_numpy(rows).float(),
        ids=tuple(name for _, name, _ in found),
        categories=tuple(category for _, _, category in found),
    )


def _number(element: ElementTree.Element, name: str) -> float:
    text = element.findtext(name)
    if text is None:
        raise ValueError(f"a tracklet without <{name}>")
    return float(text)
