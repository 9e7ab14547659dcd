"""Two processes over every case of the contract: `python -m tests.metrics.two_ranks FOLDER`."""

import os
import sys
import warnings
from datetime import timedelta
from pathlib import Path

import torch
import torch.distributed as dist

from .cases import CASES, flat, shares

folder = Path(sys.argv[1])
# Everything is imported: the second process costs nothing more.
child = os.fork()
rank = 0 if child else 1
# Metrics that wait for each other in vain are told so after this.
dist.init_process_group(
    "gloo", init_method=f"file://{folder / 'store'}", rank=rank, world_size=2, timeout=timedelta(seconds=30)
)
warnings.filterwarnings("ignore", ".* was called before the ``update`` method")


def complaint_about(metric):
    """What `compute` says of the ranks' parameters."""
    try:
        metric.compute()
    except (ValueError, RuntimeError) as error:
        return str(error)
    return None


answers = {}
for name, case in CASES.items():
    metric = case.over(shares(case.steps)[rank])
    before = {state: value.clone() for state, value in metric.metric_state.items()}
    answer = answers[name] = {"whole": flat(metric.compute()), "unchanged": True}
    answer["unchanged"] = all(torch.equal(value, before[state]) for state, value in metric.metric_state.items())
    metric.update(**case.steps[0])
    answer["more"] = flat(metric.compute())
    # One rank has seen nothing, not even an empty list.
    answer["alone"] = flat(case.over(case.steps[:5] if rank == 0 else []).compute())
    answer["complaints"] = {
        change: complaint_about(case.over(case.steps[:2], **(changes if rank else {})))
        for change, changes in case.changes.items()
    }
torch.save(answers, folder / f"{rank}.pt")
dist.destroy_process_group()
if child:
    sys.exit(os.waitpid(child, 0)[1])
