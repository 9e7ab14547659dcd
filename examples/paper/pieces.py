"""A long run in pieces: each is written when it is complete, and pieces merge into one coverage.

A piece is a folder with two coverage files for each rig, `RIG_known.npz` and `RIG_area.npz`. It is a block of
contiguous steps: standard errors follow from how pieces differ.
"""

import json

import torch

from torchcover import Coverage
from torchcover.coverage import Layer
from torchcover.coverage.blocks import AreaSums, Blocks
from torchcover.coverage.region_sums import PlaceSums


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
    first = pieces[0]
    probed_steps = torch.stack([piece.probed_steps for piece in pieces])
    means = torch.stack([torch.cat([piece.radius[None], piece.detection]) for piece in pieces])
    sums = (means * probed_steps[:, None]).where(probed_steps[:, None] > 0, 0.0)  # (B, Q, H, Y, X)
    steps = torch.tensor([piece.counts["steps"] for piece in pieces])
    whole = sums.sum(dim=0) / probed_steps.sum(dim=0)  # 0 / 0, which is NaN, where no step had a point
    return Coverage(
        grid=first.grid,
        thresholds=first.thresholds,
        max_radius=first.max_radius,
        probed_steps=probed_steps.sum(dim=0),
        points=torch.stack([piece.points for piece in pieces]).sum(dim=0),
        layers=map(Layer, first.quantities, whole),
        counts={name: sum(piece.counts[name] for piece in pieces) for name in Coverage.COUNTS},
        blocks=Blocks.of(steps, probed_steps, sums),
        area=_merged([piece.area for piece in pieces], steps, AreaSums.of),
        regions=first.regions,
        places=_merged([piece.places for piece in pieces], steps, PlaceSums),
    )


def _merged(pieces, steps, of):
    if pieces[0] is None:
        return None
    return of(steps, torch.cat([piece.m2 for piece in pieces]), torch.cat([piece.sums for piece in pieces]))
