"""Results as files: everything that a `Coverage` has, in one `.npz`.

All are lists over the cells that were probed. `cell` has their indices into the `shape` (H, Y, X) of the header; a map
is `layer = np.full(shape, nan)` and `layer.flat[file["cell"]] = file["radius_m"]`, by the key of its quantity.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcover.coverage.aggregations import Layer
from torchcover.coverage.blocks import BlockSums, KnownCells
from torchcover.coverage.bodies import COLUMNS, BodySums
from torchcover.coverage.grid import BevGrid
from torchcover.coverage.redundancy import Redundancy, redundancy_quantities
from torchcover.coverage.region_sums import PlaceNumbers, PlaceSums
from torchcover.coverage.regions import Region
from torchcover.estimation import Quantity
from torchcover.files import TooLargeError, check_kind, check_memory, parse_json, read_npz, reads, write_npz
from torchcover.metrics.blocks import FINER

if TYPE_CHECKING:
    from torchcover.coverage.result import Coverage

FORMAT_VERSION = 10
Arrays = dict[str, NDArray[Any]]
# Steps, cells, what is divided by, sums.
IN_BLOCKS = ("block_steps", "block_cell", "block_probed_steps", "block_sums")
OVER_AREA = ("area_steps", "area_cell", "area_m2", "area_sums")
OVER_PLACES = ("place_steps", "place_m2", "place_sums")
# Numbers of regions, and what they are without each block.
BODIES = ("body_steps", "body_sums", "body_cells")
AGGREGATED = ("region_numbers", "region_numbers_left_out")


def write_coverage(coverage: "Coverage", path: Path) -> None:
    """Write a coverage to one compressed file, with standard errors by key, for NumPy users."""
    grid, known, blocks, area = coverage.grid, coverage.known, coverage.blocks, coverage.area
    places, aggregated = coverage.places, coverage.aggregated
    redundancy, bodies, layers = coverage.redundancy, coverage.bodies, coverage.listed.values()
    header = {
        "format": FORMAT_VERSION,
        "grid": asdict(grid),
        "shape": grid.shape,
        "thresholds": coverage.thresholds,
        "max_radius": coverage.max_radius,
        "layers": [layer.quantity._asdict() for layer in layers],
        "counts": coverage.counts,
        "blocks": 1 if blocks is None else len(blocks.steps),
        "square_metres": area is not None,
        "regions": [asdict(region) for region in coverage.regions],
        "by_area": places is not None,
        "aggregated": [] if aggregated is None else [quantity._asdict() for quantity in aggregated.quantities],
        "sensors": None if redundancy is None else redundancy.sensors,
        "bodies": None if bodies is None else bodies.stored(),
        "redundancy": [] if redundancy is None else [layer.quantity._asdict() for layer in redundancy.listed.values()],
    }
    tensors = {"cell": known.at, "probed_steps": known.probed_steps, "points": known.points}
    tensors |= {layer.quantity.key: layer.values for layer in layers}
    tensors |= {f"{key}_error": error for key, error in coverage.listed_errors.items()}
    if aggregated is not None:
        tensors |= dict(zip(AGGREGATED, aggregated[1:], strict=True))
    if redundancy is not None:
        tensors |= {key: layer.values for key, layer in redundancy.listed.items()}
    if places is not None:
        tensors |= dict(zip(OVER_PLACES, places, strict=True))
    if bodies is not None:
        tensors |= dict(zip(BODIES, (bodies.steps, bodies.sums, bodies.cells), strict=True))
    arrays: dict[str, Any] = {name: tensor.cpu().numpy() for name, tensor in tensors.items()}
    arrays["cell"] = _short(arrays["cell"], grid.cells)
    arrays |= {} if blocks is None else _listed(blocks, IN_BLOCKS)
    arrays |= {} if area is None else _listed(area, OVER_AREA)
    write_npz(path, {"header": np.array(json.dumps(header)), **arrays})


@reads("a saved coverage")
def read_coverage(path: Path) -> dict[str, Any]:
    """Read what `write_coverage` wrote: the arguments of `Coverage`."""
    try:
        arrays = read_npz(path, partial(check_kind, "fiuU"))  # numbers, and one text: the header
        header: dict[str, Any] = parse_json(str(arrays.pop("header")))
        version = header.pop("format")
        parts = _parts(header, arrays) if version == FORMAT_VERSION else None
    except (TooLargeError, MemoryError):
        raise
    except Exception as error:  # damage shows anywhere: in the zip, zlib, NumPy, JSON, or as a missing part
        reason = str(error) or type(error).__name__
        raise ValueError(f"not a coverage file as Coverage.save writes it ({reason})") from error
    if parts is None:
        older = version in range(FORMAT_VERSION)
        bands = "; height bands of older ones were over z of the vehicle: measure again" if older else ""
        raise ValueError(f"coverage format {version}; this torchcover reads format {FORMAT_VERSION}{bands}")
    return parts


def _parts(header: dict[str, Any], arrays: Arrays) -> dict[str, Any]:
    grid = BevGrid(**header["grid"])
    known = _known(grid, arrays)
    layers = _layers(header["layers"], arrays)
    blocks = max((len(arrays[names[0]]) for names in (IN_BLOCKS, OVER_AREA) if names[0] in arrays), default=0)
    # Of all cells maps are made one at a time, and of the known ones in all blocks errors.
    check_memory(8 * (grid.cells + 3 * blocks * len(known.at)) + sum(array.nbytes for array in arrays.values()))
    return {
        "grid": grid,
        "thresholds": tuple(header["thresholds"]),
        "max_radius": header["max_radius"],
        "known": known,
        "layers": layers,
        "counts": header["counts"],
        "blocks": None if header["blocks"] == 1 else _read_listed(IN_BLOCKS, header, grid, arrays),
        "area": _read_listed(OVER_AREA, header, grid, arrays) if header["square_metres"] else None,
        "regions": [_region(stored) for stored in header["regions"]],
        "places": _places(header, grid, arrays) if header["by_area"] else None,
        "aggregated": _aggregated(header, grid, arrays) if header["aggregated"] else None,
        "redundancy": None if header["sensors"] is None else _redundancy(header, known, arrays),
        "bodies": None if header["bodies"] is None else _bodies(header["bodies"], arrays),
    }


def _bodies(stored: dict[str, Any], arrays: Arrays) -> BodySums:
    grid = BevGrid(**stored.pop("grid"))
    bodies, regions = tuple(stored.pop("bodies")), tuple(map(_region, stored.pop("regions")))
    steps, sums, cells = (torch.from_numpy(arrays[name]) for name in BODIES)
    shapes = (len(steps), len(bodies), len(regions), len(COLUMNS)), (len(bodies), *grid.shape[1:], 2)
    if (tuple(sums.shape), tuple(cells.shape)) != shapes:
        raise ValueError(f"sums of {len(bodies)} bodies of shape {tuple(sums.shape)} and {tuple(cells.shape)}")
    return BodySums(bodies=bodies, regions=regions, grid=grid, steps=steps, sums=sums, cells=cells, **stored)


def _aggregated(header: dict[str, Any], grid: BevGrid, arrays: Arrays) -> PlaceNumbers:
    quantities = tuple(Quantity(**quantity) for quantity in header["aggregated"])
    value, left_out = (torch.from_numpy(arrays[name]) for name in AGGREGATED)
    places = len(header["regions"]) * len(grid.heights)
    blocks = 0 if header["blocks"] == 1 else header["blocks"]
    shape = (places, len(quantities))
    if (tuple(value.shape), tuple(left_out.shape)) != (shape, (blocks, *shape)):
        raise ValueError(f"{AGGREGATED[0]} of shape {tuple(value.shape)} in {blocks} blocks; needed is {shape}")
    return PlaceNumbers(quantities, value, left_out)


def _redundancy(header: dict[str, Any], known: KnownCells, arrays: Arrays) -> Redundancy:
    layers = _layers(header["redundancy"], arrays)
    sensors = tuple(header["sensors"])
    if [layer.quantity for layer in layers] != list(redundancy_quantities(sensors, header["thresholds"])):
        raise ValueError(f"other layers of redundancy than those of the sensors {', '.join(sensors)}")
    return Redundancy(sensors, known, {layer.quantity.key: layer for layer in layers})


def _places(header: dict[str, Any], grid: BevGrid, arrays: Arrays) -> PlaceSums:
    places = PlaceSums(*(torch.from_numpy(arrays[name]) for name in OVER_PLACES))
    blocks, count = header["blocks"], len(header["regions"]) * len(grid.heights)
    blocks *= FINER if blocks > 1 else 1
    values = 1 + len(header["thresholds"]) + len(header["redundancy"])
    if [tuple(one.shape) for one in places] != [(blocks,), (blocks, count), (blocks, values, count)]:
        raise ValueError(f"sums over {count} regions and bands of shape {tuple(places.sums.shape)}")
    return places


def _known(grid: BevGrid, arrays: Arrays) -> KnownCells:
    at = _ascending("cell", arrays, grid.cells)
    return KnownCells(grid.shape, at, *(_of_cells(name, arrays) for name in ("probed_steps", "points")))


def _layers(stored: Sequence[dict[str, Any]], arrays: Arrays) -> list[Layer]:
    quantities = [Quantity(**quantity) for quantity in stored]
    return [Layer(quantity, _of_cells(quantity.key, arrays)) for quantity in quantities]


def _of_cells(name: str, arrays: Arrays) -> Tensor:
    if arrays[name].shape != arrays["cell"].shape:
        raise ValueError(f"{name} has shape {arrays[name].shape}, the cells {arrays['cell'].shape}")
    return torch.from_numpy(arrays[name])


def _ascending(name: str, arrays: Arrays, end: int) -> Tensor:
    at = arrays[name].astype(np.int64)
    if not (at.ndim == 1 and (np.diff(at) > 0).all() and 0 <= at.min(initial=0) <= at.max(initial=0) < max(end, 1)):
        raise ValueError(f"{name}: numbers of cells in ascending order, below {end}, are needed")
    return torch.from_numpy(at)


def _short(at: NDArray[Any], end: int) -> NDArray[Any]:
    return at.astype(np.uint32 if end < 2**32 else np.int64)


def _region(stored: Mapping[str, Any]) -> Region:
    corners = tuple((x, y) for x, y in stored["corners_m"])
    return Region(stored["name"], tuple(stored["x"]), tuple(stored["y"]), corners, tuple(stored["bands"]))


def _listed(blocks: BlockSums, names: Sequence[str]) -> Arrays:
    arrays = [each.cpu().numpy() for each in (blocks.steps, blocks.at, blocks.base, blocks.listed)]
    arrays[1] = _short(arrays[1], math.prod(blocks.shape))
    return dict(zip(names, arrays, strict=True))


def _read_listed(names: Sequence[str], header: dict[str, Any], grid: BevGrid, arrays: Arrays) -> BlockSums:
    steps, _, base, sums = (arrays[name] for name in names)
    if steps.shape != (header["blocks"],):
        raise ValueError(f"the steps of {header['blocks']} blocks have shape {steps.shape}")
    shape = (len(steps), *grid.shape)
    at = _ascending(names[1], arrays, math.prod(shape))
    if not (base.shape == at.shape == sums.shape[1:] and np.isin(at % grid.cells, arrays["cell"]).all()):
        raise ValueError(f"sums of shape {sums.shape} at {tuple(at.shape)} cells do not fit into {shape}")
    return BlockSums(torch.from_numpy(steps), shape, at, *map(torch.from_numpy, (base, sums)))
