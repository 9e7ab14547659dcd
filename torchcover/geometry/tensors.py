"""Rigid transforms of tensors.

Importing this module makes torch's functions as exact in the first call of a process as in any other. On CPUs torch
leaves them to Intel's MKL, which looks for the right one of its variants at the first call. If several threads make
that call together, some may get a much less exact one (github.com/pytorch/pytorch/issues/188792), and the first rays
of a camera differ from process to process. Therefore one thread makes the first calls.
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
    """Points of the source frame in the destination frame.

    Args:
        destination_T_source: (4, 4) rigid transform.
        points_m: (N, 3) floating-point points in metres.

    Returns:
        (N, 3) on the device and of the type of `points_m`; computed in float64, which neither autocast nor TF32 rounds:
        either would cost decimetres.

    Example:
        >>> import numpy as np
        >>> lifted = np.eye(4)
        >>> lifted[2, 3] = 1.5
        >>> transform_points_tensor(lifted, torch.zeros(1, 3))
        tensor([[0.0000, 0.0000, 1.5000]])
    """
    pose = torch.as_tensor(destination_T_source, dtype=torch.float64, device=points_m.device)
    return (points_m.double() @ pose[:3, :3].T + pose[:3, 3]).to(points_m.dtype)
