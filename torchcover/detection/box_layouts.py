"""How others write boxes down."""

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchcover.geometry.arrays import Float64
from torchcover.geometry.rigid import Matrix, transform


def upright_rows(centre_m: ArrayLike, size_m: ArrayLike, heading: ArrayLike, vehicle_T_source: Matrix | None) -> Tensor:
    """(K, 7) rows of boxes in the vehicle frame; what leans is put upright, its heading, (K, 3) vectors, kept.

    `vehicle_T_source` is where the frame of the centres and headings is; None: it is the vehicle frame.

    ValueError: numbers that are not finite, or shapes that do not fit.
    """
    centre, size, ahead = _rows("centres", centre_m), _rows("sizes", size_m), _rows("headings", heading)
    if not len(centre) == len(size) == len(ahead):
        counts = f"{len(centre)}, {len(size)} and {len(ahead)}"
        raise ValueError(f"boxes: as many centres, sizes and headings are needed; got {counts}")
    if vehicle_T_source is not None:
        centre, ahead = transform(vehicle_T_source, centre), ahead @ vehicle_T_source[:3, :3].T
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
    return torch.from_numpy(np.column_stack([centre, size, yaw])).float()


def _rows(name: str, given: ArrayLike) -> Float64:
    array = np.asarray(given, dtype=np.float64)
    array = array.reshape(0, 3) if array.size == 0 else array
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"{name} of boxes: shape (K, 3) is needed; got {array.shape}")
    if not np.isfinite(array).all():
        bad = int((~np.isfinite(array)).any(axis=1).sum())
        raise ValueError(f"{name} of boxes: {bad} of {len(array)} are not finite")
    return array
