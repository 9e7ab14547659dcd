"""One of two processes of a distributed run: `python one_rank.py RANK FOLDER`, on steps in FOLDER/steps.pt."""

import sys
from datetime import timedelta
from pathlib import Path

import torch
import torch.distributed as dist

from torchcover import BevGrid, CoverageMetric

rank, folder = int(sys.argv[1]), Path(sys.argv[2])
dist.init_process_group(
    "gloo", init_method=f"file://{folder / 'store'}", rank=rank, world_size=2, timeout=timedelta(seconds=60)
)
job = torch.load(folder / "steps.pt")
metric = CoverageMetric(BevGrid(**job["grid"]), **job["options"])
mine = job["steps"][rank::2]
for sensor, reference in mine:
    metric.update(sensor, reference)
metric.compute().save(folder / f"{rank}.npz")
assert int(metric.steps) == len(mine), "the sum over the ranks stayed in the state of one of them"
metric.update(*job["extra"])
metric.compute().save(folder / f"{rank}_extra.npz")
dist.destroy_process_group()
