"""Rigid transforms of tensors.

Importing this module initializes the math functions of torch in a single thread. On CPUs torch calls Intel MKL, which
selects one of its variants at the first call; if several threads make that call together, some may get a much less
exact variant (github.com/pytorch/pytorch/issues/188792), and the first rays of a camera would differ between processes.
"""

import torch
from torch import Tensor

from torchcover.devices import run_with_float64
from torchcover.geometry.rigid import Matrix

for _function in (torch.sqrt, torch.sin, torch.cos, torch.exp, torch.log):
    for _dtype in (torch.float32, torch.float64):
        _function(torch.ones(1, dtype=_dtype, device="cpu"))


@run_with_float64
def transform_points_tensor(destination_T_source: Matrix | Tensor, points_m: Tensor) -> Tensor:
    """Transform points from the source frame to the destination frame.

    Args:
        destination_T_source: (4, 4) rigid transform.
        points_m: (N, 3) floating-point points in meters.

    Returns:
        (N, 3) on the device and of the dtype of `points_m`. Computed in float64, since autocast or TF32 would cause
        errors of decimeters.

    Example:
        >>> import numpy as np
        >>> vehicle_T_sensor = np.eye(4)
        >>> vehicle_T_sensor[2, 3] = 1.5
        >>> transform_points_tensor(vehicle_T_sensor, torch.zeros(1, 3))
        tensor([[0.0000, 0.0000, 1.5000]])
    """
    transform = torch.as_tensor(destination_T_source, dtype=torch.float64, device=points_m.device)
    return (points_m.double() @ transform[:3, :3].T + transform[:3, 3]).to(points_m.dtype)
