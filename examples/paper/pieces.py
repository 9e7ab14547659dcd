"""A long run in pieces: each is written when it is complete, and pieces merge into one coverage.

A piece is a folder with two coverage files for each rig, `RIG_known.npz` and `RIG_area.npz`. It is a block of
contiguous steps: standard errors follow from how pieces differ.
"""

import json

import torch

from torchcover import Coverage
from torchcover.coverage import Layer
from torchcover.coverage.region_sums import RegionSums
from torchcover.coverage.sparse_sums import BlockSums, ObservedCells
from torchcover.metrics import sum_rows


def check_conditions(folder, conditions):
    """Pieces of one folder are of one run.

    Raises:
        ValueError: The folder has pieces that were made under other conditions.
    """
    path = folder / "conditions.json"
    if not path.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(conditions, indent=2) + "\n", encoding="utf-8")
    elif (found := json.loads(path.read_text(encoding="utf-8"))) != conditions:
        raise ValueError(f"{path} says {found}, this run is {conditions}: choose another folder by --out")


def save_piece(folder, coverages):
    """Write a piece; a folder that has its name is complete.

    Args:
        folder: Its name.
        coverages: Rig and measure -> `Coverage`.
    """
    unfinished = folder.with_name(f"{folder.name}.part")
    unfinished.mkdir(parents=True, exist_ok=True)
    for (rig, measure), coverage in coverages.items():
        coverage.save(_file(unfinished, rig, measure))
    unfinished.rename(folder)


def load_merged(folders, rig, measure):
    """One coverage of all steps of some pieces."""
    return merged([Coverage.load(_file(folder, rig, measure)) for folder in folders])


def _file(folder, rig, measure):
    return folder / f"{rig.replace('/', '-')}_{measure}.npz"


def merged(pieces):
    """One coverage of all steps; each piece is a block of it.

    Args:
        pieces: Coverages of the same grid over different steps, without blocks of their own.
    """
    first, steps = pieces[0], torch.tensor([piece.counts["num_frames"] for piece in pieces])
    every = [piece.known for piece in pieces]
    counts = [torch.stack([known.at, known.points, known.probed_steps], dim=1).double() for known in every]
    means = [torch.stack([piece.listed[one.key].values for one in first.quantities]) for piece in pieces]
    sums = [known.probed_steps * own for known, own in zip(every, means, strict=True)]
    whole = sum_rows(torch.cat([torch.cat([one, own.T], dim=1) for one, own in zip(counts, sums, strict=True)])).T
    at, points, probed_steps = whole[:3].long()
    blocks = [
        BlockSums(steps[:1], (1, *first.grid.shape), known.at, known.probed_steps, own)
        for known, own in zip(every, sums, strict=True)
    ]
    return Coverage(
        grid=first.grid,
        thresholds_m=first.thresholds,
        max_radius_m=first.max_radius,
        observed_cells=ObservedCells(first.grid.shape, at, probed_steps, points),
        layers=map(Layer, first.quantities, whole[3:] / probed_steps),
        counts={name: sum(piece.counts[name] for piece in pieces) for name in Coverage.COUNTS},
        block_sums=_side_by_side(blocks, steps),
        area_sums=None if first.area is None else _side_by_side([piece.area for piece in pieces], steps),
        regions=first.regions,
        region_sums=None
        if first.places is None
        else RegionSums(steps, *map(torch.cat, zip(*(piece.places[1:] for piece in pieces), strict=True))),
    )


def _side_by_side(pieces, steps):
    """Sums in one block each, as blocks of one run."""
    cells = torch.Size(pieces[0].shape[1:])
    at = [piece.at + number * cells.numel() for number, piece in enumerate(pieces)]
    base, listed = [piece.base for piece in pieces], [piece.listed for piece in pieces]
    return BlockSums(steps, (len(pieces), *cells), torch.cat(at), torch.cat(base), torch.cat(listed, dim=1))
