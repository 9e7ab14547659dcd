"""One of two processes of a distributed run: `python one_recall_rank.py RANK FOLDER`, on frames in FOLDER/frames.pt."""

import sys
from datetime import timedelta
from pathlib import Path

import torch
import torch.distributed as dist

from torchcover.detection import Boxes, RecallByVisibility

rank, folder = int(sys.argv[1]), Path(sys.argv[2])
dist.init_process_group(
    "gloo", init_method=f"file://{folder / 'store'}", rank=rank, world_size=2, timeout=timedelta(seconds=60)
)
metric = RecallByVisibility(score_thresholds=(0.0, 0.5))
for detections, rows, share, scores, own in torch.load(folder / "frames.pt")[rank::2]:
    metric.update(detections, Boxes.from_rows(rows), share, scores, own)
result = metric.compute()
names = ("objects", "found", "detections", "true_detections")
torch.save([getattr(result, name) for name in names], folder / f"{rank}.pt")
dist.destroy_process_group()
