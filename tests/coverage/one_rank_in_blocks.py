"""One of two processes of a distributed run with blocks: `python one_rank_in_blocks.py RANK FOLDER`."""

import sys
from datetime import timedelta
from pathlib import Path

import torch
import torch.distributed as dist

from torchcover import BevGrid, CoverageMetric

rank, folder = int(sys.argv[1]), Path(sys.argv[2])
dist.init_process_group(
    "gloo", init_method=f"file://{folder / 'store'}", rank=rank, world_size=2, timeout=timedelta(seconds=240)
)
job = torch.load(folder / "job.pt")
metric = CoverageMetric(BevGrid(**job["grid"]), **job["options"])
for clouds, more in job["shares"][rank]:
    metric.update(*clouds, **more)
own_length = int(metric.block_length)
blocks = metric.compute().blocks
assert int(metric.block_length) == own_length, "the blocks of all ranks stayed in the state of one"
torch.save({**vars(blocks), "own_length": own_length}, folder / f"{rank}.pt")
dist.destroy_process_group()
