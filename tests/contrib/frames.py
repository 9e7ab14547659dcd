"""Frames for published metrics."""

import torch

from torchcover.data import Frame
from torchcover.detection import Boxes


def frame_of(cloud, reference=(), boxes=(), categories=(), *, index=0, weights=None, sensors=None, block_index=None):
    """Create a frame of one rig named `rig` from lists; `sensors` is the number of points of each sensor."""
    cloud, reference = (torch.tensor(points, dtype=torch.float32).view(-1, 3) for points in (cloud, reference))
    rows = torch.tensor(boxes, dtype=torch.float32).view(-1, 7)
    return Frame(
        {"rig": cloud},
        reference,
        index=index,
        name=f"frame {index}",
        reference_weights=None if weights is None else torch.tensor(weights, dtype=torch.float32),
        boxes=Boxes.from_rows(rows, categories=tuple(categories) or ("",) * len(rows)),
        sensor_point_counts=None if sensors is None else {"rig": sensors},
        block_index=block_index,
    )


def values(metric):
    """Return the numbers of a metric by name."""
    return {number.quantity.key: number.value for number in metric.compute()}
