"""Results as files: everything that a `Coverage` has, in one `.npz`.

Maps are arrays over the whole grid under the key of their quantity, for NumPy users; the blocks, most of whose cells
no step of theirs has probed, are lists of what was probed.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcover.coverage.blocks import AreaSums, Blocks
from torchcover.coverage.grid import BevGrid
from torchcover.coverage.layer import Layer
from torchcover.coverage.quantity import Quantity

FORMAT_VERSION = 3
Arrays = dict[str, NDArray[Any]]


class CoverageParts(TypedDict):
    """What a `Coverage` is made of: the arguments of its constructor."""

    grid: BevGrid
    thresholds: Sequence[float]
    max_radius: float
    probed_steps: Tensor
    points: Tensor
    layers: Sequence[Layer]
    counts: Mapping[str, int]
    blocks: Blocks | None
    area: AreaSums | None


def write_coverage(parts: CoverageParts, errors: Mapping[str, Tensor], path: Path) -> None:
    """Write a coverage to one compressed file.

    Args:
        parts: All that is read again.
        errors: Maps of standard errors by the key of their quantity, for NumPy users.
        path: The file.
    """
    grid, blocks, area = parts["grid"], parts["blocks"], parts["area"]
    header = {
        "format": FORMAT_VERSION,
        "grid": {"x": grid.x, "y": grid.y, "cell": grid.cell, "heights": dict(grid.heights)},
        "thresholds": parts["thresholds"],
        "max_radius": parts["max_radius"],
        "layers": [asdict(layer.quantity) for layer in parts["layers"]],
        "counts": parts["counts"],
        "blocks": 1 if blocks is None else len(blocks.steps),
        "square_metres": area is not None,
    }
    tensors = {"probed_steps": parts["probed_steps"], "points": parts["points"]}
    tensors |= {layer.quantity.key: layer.values for layer in parts["layers"]}
    tensors |= {f"{key}_error": error for key, error in errors.items()}
    arrays: dict[str, Any] = {name: tensor.cpu().numpy() for name, tensor in tensors.items()}
    arrays |= {} if blocks is None else _listed(blocks)
    arrays |= {} if area is None else _listed_area(area)
    with path.open("wb") as file:
        np.savez_compressed(file, header=np.array(json.dumps(header)), **arrays)


def read_coverage(path: Path) -> CoverageParts:
    """Read what `write_coverage` wrote.

    Raises:
        FileNotFoundError: No such file.
        ValueError: Not a coverage file, a damaged one, or one of another version.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such coverage file")
    try:
        header, arrays = _read_npz(path)
        version = header.pop("format")
        parts = _parts(header, arrays) if version == FORMAT_VERSION else None
    except Exception as error:  # damage shows anywhere: in the zip, zlib, NumPy, JSON, or as a missing part
        reason = str(error) or type(error).__name__
        raise ValueError(f"{path}: not a coverage file as Coverage.save writes it ({reason})") from error
    if parts is None:
        raise ValueError(f"{path}: coverage format {version}; this torchcover reads format {FORMAT_VERSION}")
    return parts


def _parts(header: dict[str, Any], arrays: Arrays) -> CoverageParts:
    stored = header["grid"]
    heights = {name: (band[0], band[1]) for name, band in stored["heights"].items()}
    grid = BevGrid(x=tuple(stored["x"]), y=tuple(stored["y"]), cell=stored["cell"], heights=heights)
    quantities = [Quantity(**quantity) for quantity in header["layers"]]
    for name in ("probed_steps", "points", *(quantity.key for quantity in quantities)):
        if arrays[name].shape != grid.shape:
            raise ValueError(f"{name} has shape {arrays[name].shape}, the grid {grid.shape}")
    return {
        "grid": grid,
        "thresholds": tuple(header["thresholds"]),
        "max_radius": header["max_radius"],
        "probed_steps": torch.from_numpy(arrays["probed_steps"]),
        "points": torch.from_numpy(arrays["points"]),
        "layers": [Layer(quantity, torch.from_numpy(arrays[quantity.key])) for quantity in quantities],
        "counts": header["counts"],
        "blocks": None if header["blocks"] == 1 else _blocks(header, grid, arrays),
        "area": _area(header, grid, arrays) if header["square_metres"] else None,
    }


def _listed(blocks: Blocks) -> Arrays:
    """The entries of the blocks that are not empty, and where they are."""
    where = blocks.probed_steps.flatten().nonzero().squeeze(1)
    sums = blocks.sums.movedim(1, 0).flatten(1)  # (Q, B * H * Y * X)
    return {
        "block_steps": blocks.steps.cpu().numpy(),
        "block_cell": where.cpu().numpy().astype(np.uint32 if blocks.probed_steps.numel() < 2**32 else np.int64),
        "block_probed_steps": blocks.probed_steps.flatten()[where].cpu().numpy(),
        "block_sums": sums[:, where].cpu().numpy(),
    }


def _blocks(header: dict[str, Any], grid: BevGrid, arrays: Arrays) -> Blocks:
    shape = (header["blocks"], *grid.shape)
    where = torch.from_numpy(arrays["block_cell"].astype(np.int64))
    listed = torch.from_numpy(arrays["block_sums"])
    probed_steps = torch.zeros(shape, dtype=torch.int64)
    probed_steps.view(-1)[where] = torch.from_numpy(arrays["block_probed_steps"])
    sums = torch.zeros((len(listed), *shape), dtype=torch.float64)
    sums.view(len(listed), -1)[:, where] = listed
    return Blocks(torch.from_numpy(arrays["block_steps"]), probed_steps, sums.movedim(0, 1))


def _listed_area(area: AreaSums) -> Arrays:
    """The entries of the sums over the surface that are not empty, and where they are."""
    where = area.m2.flatten().nonzero().squeeze(1)
    return {
        "area_steps": area.steps.cpu().numpy(),
        "area_cell": where.cpu().numpy(),
        "area_m2": area.m2.flatten()[where].cpu().numpy(),
        "area_sums": area.sums.movedim(1, 0).flatten(1)[:, where].cpu().numpy(),
    }


def _area(header: dict[str, Any], grid: BevGrid, arrays: Arrays) -> AreaSums:
    shape = (header["blocks"], *grid.shape)
    where, listed = torch.from_numpy(arrays["area_cell"]), torch.from_numpy(arrays["area_sums"])
    m2, sums = (torch.zeros(size, dtype=torch.float64) for size in (shape, (len(listed), *shape)))
    m2.view(-1)[where] = torch.from_numpy(arrays["area_m2"])
    sums.view(len(listed), -1)[:, where] = listed
    return AreaSums(torch.from_numpy(arrays["area_steps"]), m2, sums.movedim(0, 1))


def _read_npz(path: Path) -> tuple[dict[str, Any], Arrays]:
    with path.open("rb") as file, np.load(file, allow_pickle=False) as parts:
        arrays = dict(parts)
    header: dict[str, Any] = json.loads(str(arrays.pop("header")))
    return header, arrays
