"""Reading and writing of a `Coverage` as one `.npz` file.

Arrays have one entry per observed cell; `cell` holds the indices of these cells in the flattened grid of `shape`
(H, Y, X), which the header contains. NumPy alone can rebuild a map: `layer = np.full(shape, nan)`, then
`layer.flat[file["cell"]] = file["radius_m"]`, or another key of a quantity.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcover.coverage.aggregations import Layer
from torchcover.coverage.grid import BevGrid
from torchcover.coverage.redundancy import Redundancy, list_redundancy_quantities
from torchcover.coverage.region_sums import AggregatedNumbers, RegionSums
from torchcover.coverage.regions import Region
from torchcover.coverage.sparse_sums import BlockSums, ObservedCells
from torchcover.estimation import Quantity
from torchcover.files import (
    TooLargeError,
    check_dtype_kind,
    check_memory,
    guard_reader,
    parse_json,
    read_npz,
    write_npz,
)
from torchcover.metrics.blocked_sums import FINE_BLOCKS_PER_BLOCK

Arrays = dict[str, NDArray[Any]]

# Raised whenever a header key, an array name or the meaning of an array changes.
FORMAT_VERSION = 12
# Names of the arrays of each part, in the order of the fields of the class that holds them.
BLOCK_ARRAYS = ("block_frame_counts", "block_cell", "block_observed_frames", "block_sums")
AREA_ARRAYS = ("area_frame_counts", "area_cell", "area_m2", "area_sums")
REGION_ARRAYS = ("region_frame_counts", "region_areas_m2", "region_sums")
AGGREGATED_ARRAYS = ("region_numbers", "region_numbers_jackknife")


def write_coverage(attributes: Mapping[str, Any], further_arrays: Mapping[str, NDArray[Any]], path: Path) -> None:
    """Write a coverage to one compressed file, with the standard errors of its maps for readers without torchcover.

    Args:
        attributes: Attributes of the `Coverage`, with its `sparse_errors`.
        further_arrays: Arrays by name that are not part of the coverage.
        path: File to be written.
    """
    arrays: Arrays = {name: tensor.cpu().numpy() for name, tensor in _collect_tensors(attributes).items()}
    arrays["cell"] = _shrink_indices(arrays["cell"], attributes["grid"].num_cells)
    if attributes["block_sums"] is not None:
        arrays |= _convert_block_sums(attributes["block_sums"], BLOCK_ARRAYS)
    if attributes["area_sums"] is not None:
        arrays |= _convert_block_sums(attributes["area_sums"], AREA_ARRAYS)
    write_npz(path, {"header": np.array(json.dumps(_build_header(attributes))), **arrays, **further_arrays})


def _build_header(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Collect all parts of a coverage that are no arrays, as JSON values."""
    aggregated, redundancy = attributes["aggregated_numbers"], attributes["redundancy"]
    aggregated_quantities = () if aggregated is None else aggregated.quantities
    redundancy_quantities = () if redundancy is None else redundancy.quantities
    return {
        "format": FORMAT_VERSION,
        "grid": asdict(attributes["grid"]),
        "shape": attributes["grid"].shape,
        "thresholds_m": attributes["thresholds_m"],
        "max_radius_m": attributes["max_radius_m"],
        "layers": [layer.quantity._asdict() for layer in attributes["sparse_layers"].values()],
        "counts": attributes["counts"],
        "num_blocks": 1 if attributes["block_sums"] is None else len(attributes["block_sums"].frame_counts),
        "has_area_weights": attributes["area_sums"] is not None,
        "regions": [asdict(region) for region in attributes["regions"]],
        "has_region_sums": attributes["region_sums"] is not None,
        "aggregated_quantities": [quantity._asdict() for quantity in aggregated_quantities],
        "sensor_names": None if redundancy is None else redundancy.sensor_names,
        "redundancy_layers": [quantity._asdict() for quantity in redundancy_quantities],
    }


def _collect_tensors(attributes: Mapping[str, Any]) -> dict[str, Tensor]:
    """Collect the tensors of a coverage by the name of their array, except for sums in blocks."""
    observed = attributes["observed_cells"]
    tensors = {
        "cell": observed.cell_indices,
        "observed_frames": observed.observed_frames,
        "point_counts": observed.point_counts,
    }
    tensors |= {layer.quantity.key: layer.values for layer in attributes["sparse_layers"].values()}
    tensors |= {f"{key}_error": error for key, error in attributes["sparse_errors"].items()}
    if attributes["aggregated_numbers"] is not None:
        tensors |= dict(zip(AGGREGATED_ARRAYS, attributes["aggregated_numbers"][1:], strict=True))
    if attributes["redundancy"] is not None:
        tensors |= {key: layer.values for key, layer in attributes["redundancy"].sparse_layers.items()}
    if attributes["region_sums"] is not None:
        tensors |= dict(zip(REGION_ARRAYS, attributes["region_sums"], strict=True))
    return tensors


@guard_reader("a saved coverage")
def read_coverage(path: Path) -> dict[str, Any]:
    """Read a file that `write_coverage` wrote.

    Args:
        path: File to be read; it may come from an untrusted source.

    Returns:
        Keyword arguments of `Coverage`.

    Raises:
        ValueError: The file is no coverage file, is damaged, or has another format version.
        TooLargeError: The content takes more memory than allowed.
    """
    try:
        arrays = read_npz(path, partial(check_dtype_kind, "fiuU"))  # numbers, and the header as text
        header: dict[str, Any] = parse_json(str(arrays.pop("header")))
        version = header.pop("format")
        arguments = _parse_arguments(header, arrays) if version == FORMAT_VERSION else None
    except (TooLargeError, MemoryError):
        raise
    except Exception as error:  # damage shows anywhere: in the zip, zlib, NumPy, JSON, or as a missing part
        reason = str(error) or type(error).__name__
        raise ValueError(f"not a coverage file as Coverage.save writes it ({reason})") from error
    if arguments is None:
        advice = "; evaluate the recording or scenario again" if version in range(FORMAT_VERSION) else ""
        raise ValueError(f"coverage format {version}; this torchcover reads format {FORMAT_VERSION}{advice}")
    return arguments


def _parse_arguments(header: dict[str, Any], arrays: Arrays) -> dict[str, Any]:
    """Parse the keyword arguments of `Coverage` from a header and the arrays of a file."""
    grid = BevGrid(**header["grid"])
    observed_cells = _parse_observed_cells(grid, arrays)
    _check_memory_of_maps(grid, observed_cells, arrays)
    has_blocks, has_redundancy = header["num_blocks"] != 1, header["sensor_names"] is not None
    return {
        "grid": grid,
        "thresholds_m": tuple(header["thresholds_m"]),
        "max_radius_m": header["max_radius_m"],
        "observed_cells": observed_cells,
        "layers": _parse_layers(header["layers"], arrays),
        "counts": header["counts"],
        "block_sums": _parse_block_sums(BLOCK_ARRAYS, header, grid, arrays) if has_blocks else None,
        "area_sums": _parse_block_sums(AREA_ARRAYS, header, grid, arrays) if header["has_area_weights"] else None,
        "regions": [Region.from_record(record) for record in header["regions"]],
        "region_sums": _parse_region_sums(header, grid, arrays) if header["has_region_sums"] else None,
        "aggregated_numbers": _parse_aggregated(header, grid, arrays) if header["aggregated_quantities"] else None,
        "redundancy": _parse_redundancy(header, observed_cells, arrays) if has_redundancy else None,
    }


def _check_memory_of_maps(grid: BevGrid, observed_cells: ObservedCells, arrays: Arrays) -> None:
    """Refuse a small file whose header or blocks would take too much memory once maps and errors are computed."""
    block_counts = [len(arrays[names[0]]) for names in (BLOCK_ARRAYS, AREA_ARRAYS) if names[0] in arrays]
    # One map of all cells exists at a time; errors need three arrays over blocks and observed cells.
    float64_count = grid.num_cells + 3 * max(block_counts, default=0) * len(observed_cells.cell_indices)
    check_memory(8 * float64_count + sum(array.nbytes for array in arrays.values()))


def _parse_aggregated(header: dict[str, Any], grid: BevGrid, arrays: Arrays) -> AggregatedNumbers:
    """Parse the numbers of other aggregations and check their shapes."""
    quantities = tuple(Quantity(**record) for record in header["aggregated_quantities"])
    values, jackknife_values = (torch.from_numpy(arrays[name]) for name in AGGREGATED_ARRAYS)
    num_blocks = 0 if header["num_blocks"] == 1 else header["num_blocks"]
    shape = (len(header["regions"]) * len(grid.heights), len(quantities))
    if (tuple(values.shape), tuple(jackknife_values.shape)) != (shape, (num_blocks, *shape)):
        raise ValueError(f"{AGGREGATED_ARRAYS[0]} has shape {tuple(values.shape)} in {num_blocks} blocks, not {shape}")
    return AggregatedNumbers(quantities, values, jackknife_values)


def _parse_redundancy(header: dict[str, Any], observed_cells: ObservedCells, arrays: Arrays) -> Redundancy:
    """Parse the layers of redundancy and check their quantities."""
    layers = _parse_layers(header["redundancy_layers"], arrays)
    sensor_names = tuple(header["sensor_names"])
    expected_quantities = list_redundancy_quantities(sensor_names, header["thresholds_m"])
    if tuple(layer.quantity for layer in layers) != expected_quantities:
        raise ValueError(f"the redundancy layers are not those of the sensors {', '.join(sensor_names)}")
    return Redundancy(sensor_names, observed_cells, {layer.quantity.key: layer for layer in layers})


def _parse_region_sums(header: dict[str, Any], grid: BevGrid, arrays: Arrays) -> RegionSums:
    """Parse the sums over regions and check their shapes."""
    region_sums = RegionSums(*(torch.from_numpy(arrays[name]) for name in REGION_ARRAYS))
    num_blocks = header["num_blocks"] * (FINE_BLOCKS_PER_BLOCK if header["num_blocks"] > 1 else 1)
    num_region_bands = len(header["regions"]) * len(grid.heights)
    num_values = 1 + len(header["thresholds_m"]) + len(header["redundancy_layers"])
    expected = [(num_blocks,), (num_blocks, num_region_bands), (num_blocks, num_values, num_region_bands)]
    if [tuple(tensor.shape) for tensor in region_sums] != expected:
        raise ValueError(f"sums over {num_region_bands} regions and bands have shape {tuple(region_sums.sums.shape)}")
    return region_sums


def _parse_observed_cells(grid: BevGrid, arrays: Arrays) -> ObservedCells:
    cell_indices = _check_ascending_indices("cell", arrays, grid.num_cells)
    observed_frames = _get_cell_array("observed_frames", arrays)
    return ObservedCells(grid.shape, cell_indices, observed_frames, _get_cell_array("point_counts", arrays))


def _parse_layers(records: Sequence[dict[str, Any]], arrays: Arrays) -> list[Layer]:
    quantities = [Quantity(**record) for record in records]
    return [Layer(quantity, _get_cell_array(quantity.key, arrays)) for quantity in quantities]


def _parse_block_sums(names: Sequence[str], header: dict[str, Any], grid: BevGrid, arrays: Arrays) -> BlockSums:
    """Parse the sums in blocks and check shapes and cells."""
    frame_counts, _, denominators, sums = (arrays[name] for name in names)
    if frame_counts.shape != (header["num_blocks"],):
        raise ValueError(f"the frame counts of {header['num_blocks']} blocks have shape {frame_counts.shape}")
    shape = (len(frame_counts), *grid.shape)
    indices = _check_ascending_indices(names[1], arrays, math.prod(shape))
    has_equal_lengths = denominators.shape == indices.shape == sums.shape[1:]
    if not (has_equal_lengths and np.isin(indices % grid.num_cells, arrays["cell"]).all()):
        raise ValueError(f"sums of shape {sums.shape} at {tuple(indices.shape)} cells do not fit into {shape}")
    return BlockSums(
        torch.from_numpy(frame_counts), shape, indices, torch.from_numpy(denominators), torch.from_numpy(sums)
    )


def _convert_block_sums(block_sums: BlockSums, names: Sequence[str]) -> Arrays:
    """Convert sums in blocks to arrays by name."""
    tensors = (block_sums.frame_counts, block_sums.cell_indices, block_sums.denominators, block_sums.sums)
    arrays = {name: tensor.cpu().numpy() for name, tensor in zip(names, tensors, strict=True)}
    arrays[names[1]] = _shrink_indices(arrays[names[1]], math.prod(block_sums.shape))
    return arrays


def _get_cell_array(name: str, arrays: Arrays) -> Tensor:
    """Return an array with one entry per observed cell."""
    if arrays[name].shape != arrays["cell"].shape:
        raise ValueError(f"{name} has shape {arrays[name].shape}, the cells {arrays['cell'].shape}")
    return torch.from_numpy(arrays[name])


def _check_ascending_indices(name: str, arrays: Arrays, end: int) -> Tensor:
    """Return an array of indices as int64 if it ascends within [0, end), else raise ValueError."""
    indices = arrays[name].astype(np.int64)
    is_ascending = indices.ndim == 1 and bool((np.diff(indices) > 0).all())
    if not (is_ascending and 0 <= indices.min(initial=0) <= indices.max(initial=0) < max(end, 1)):
        raise ValueError(f"{name}: cell indices in ascending order, below {end}, are needed")
    return torch.from_numpy(indices)


def _shrink_indices(indices: NDArray[Any], end: int) -> NDArray[Any]:
    """Store indices in 4 bytes where the largest one fits."""
    return indices.astype(np.uint32 if end < 2**32 else np.int64)
