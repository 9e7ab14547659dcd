"""A long run in pieces: each is written when it is complete, and all of them merge into one coverage.

A piece is a folder with two coverage files per rig, `RIG_cells.npz` and `RIG_area.npz`. It is one block of contiguous
frames: standard errors follow from the differences between pieces.
"""

import json

import torch

from torchcover import Coverage
from torchcover.coverage import Layer
from torchcover.coverage.region_sums import RegionSums
from torchcover.coverage.sparse_sums import BlockSums, ObservedCells
from torchcover.metrics import sum_rows


def check_conditions(folder, conditions):
    """Check that all pieces of a folder belong to one run.

    Args:
        folder: Folder of the pieces; it is created with a file of the conditions if it is missing.
        conditions: Options that the pieces depend on.

    Raises:
        ValueError: The folder has pieces that were measured under other conditions.
    """
    path = folder / "conditions.json"
    if not path.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(conditions, indent=2) + "\n", encoding="utf-8")
        return
    saved = json.loads(path.read_text(encoding="utf-8"))
    if saved != conditions:
        raise ValueError(f"{path}: got {conditions}, the pieces have {saved}; choose another folder with --out")


def save_piece(folder, coverages):
    """Write a piece; a folder with the final name is complete.

    Args:
        folder: Final folder of the piece.
        coverages: (rig, average) -> `Coverage`.
    """
    unfinished = folder.with_name(f"{folder.name}.part")
    unfinished.mkdir(parents=True, exist_ok=True)
    for (rig, average), coverage in coverages.items():
        coverage.save(_get_path(unfinished, rig, average))
    unfinished.rename(folder)


def load_merged(folders, rig, average):
    """Load the coverage of all frames of some pieces.

    Args:
        folders: Folders of the pieces, in the order of their frames.
        rig: Name of the rig.
        average: "cells" or "area".
    """
    return merge_pieces([Coverage.load(_get_path(folder, rig, average)) for folder in folders])


def _get_path(folder, rig, average):
    return folder / f"{rig.replace('/', '-')}_{average}.npz"


def merge_pieces(pieces):
    """Merge coverages of different frames into one, with one block per piece.

    Args:
        pieces: Coverages over the same grid without blocks.
    """
    first = pieces[0]
    frame_counts = torch.tensor([piece.counts["num_frames"] for piece in pieces])
    cell_rows, blocks = [], []
    for piece in pieces:
        cells = piece.observed_cells
        means = torch.stack([piece.sparse_layers[quantity.key].values for quantity in first.quantities])
        sums = cells.observed_frames * means
        counts = torch.stack([cells.cell_indices, cells.point_counts, cells.observed_frames], dim=1).double()
        cell_rows.append(torch.cat([counts, sums.T], dim=1))
        block_shape = (1, *first.grid.shape)
        blocks.append(BlockSums(frame_counts[:1], block_shape, cells.cell_indices, cells.observed_frames, sums))
    merged = sum_rows(torch.cat(cell_rows)).T
    cell_indices, point_counts, observed_frames = merged[:3].long()
    layers = []
    for quantity, sums in zip(first.quantities, merged[3:], strict=True):
        layers.append(Layer(quantity, sums / observed_frames))
    has_area = first.area_sums is not None
    region_sums = None
    if first.region_sums is not None:
        areas_m2 = torch.cat([piece.region_sums.areas_m2 for piece in pieces])
        region_sums = RegionSums(frame_counts, areas_m2, torch.cat([piece.region_sums.sums for piece in pieces]))
    return Coverage(
        grid=first.grid,
        thresholds_m=first.thresholds_m,
        max_radius_m=first.max_radius_m,
        observed_cells=ObservedCells(first.grid.shape, cell_indices, observed_frames, point_counts),
        layers=layers,
        counts={name: sum(piece.counts[name] for piece in pieces) for name in Coverage.COUNTS},
        block_sums=_concatenate_blocks(blocks, frame_counts),
        area_sums=_concatenate_blocks([piece.area_sums for piece in pieces], frame_counts) if has_area else None,
        regions=first.regions,
        region_sums=region_sums,
    )


def _concatenate_blocks(pieces, frame_counts):
    """Concatenate sums in one block each to the blocks of one run."""
    shape = torch.Size(pieces[0].shape[1:])
    return BlockSums(
        frame_counts,
        (len(pieces), *shape),
        torch.cat([piece.cell_indices + index * shape.numel() for index, piece in enumerate(pieces)]),
        torch.cat([piece.denominators for piece in pieces]),
        torch.cat([piece.sums for piece in pieces], dim=1),
    )
