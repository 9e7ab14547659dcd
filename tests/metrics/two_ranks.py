"""Two processes over every case of the contract."""

import os
import signal
import sys
import traceback
import warnings
from datetime import timedelta

import torch
import torch.distributed as dist

from .cases import CASES, flat, shares

LONGEST_S = 120


def in_two_processes(folder):
    """What each of two forks of this process finds."""
    children = []
    for rank in range(2):
        if not (child := os.fork()):
            code = 1
            signal.alarm(LONGEST_S)
            try:
                torch.save(answers_of(rank, folder), folder / f"{rank}.pt")
                code = 0
            except Exception:
                traceback.print_exc()
            finally:
                os._exit(code)
        children.append(child)
    assert [os.waitpid(child, 0)[1] for child in children] == [0, 0]
    return [torch.load(folder / f"{rank}.pt", weights_only=False) for rank in range(2)]


def answers_of(rank, folder):
    """By the names of the cases, what a process finds that has a share of their steps."""
    torch.set_num_threads(1)
    os.environ["GLOO_SOCKET_IFNAME"] = "lo0" if sys.platform == "darwin" else "lo"
    # Metrics that wait for each other in vain are told so after this.
    dist.init_process_group(
        "gloo", init_method=f"file://{folder / 'store'}", rank=rank, world_size=2, timeout=timedelta(seconds=30)
    )
    warnings.filterwarnings("ignore", ".* was called before the ``update`` method")
    answers = {}
    for name, case in CASES.items():
        metric = case.over(shares(case.frames)[rank])
        before = {state: value.clone() for state, value in metric.metric_state.items()}
        answer = answers[name] = {"whole": flat(metric.compute()), "unchanged": True}
        answer["unchanged"] = all(torch.equal(value, before[state]) for state, value in metric.metric_state.items())
        metric.update(**case.frames[0])
        answer["more"] = flat(metric.compute())
        # One rank has seen nothing, not even an empty list.
        answer["alone"] = flat(case.over(case.frames[:5] if rank == 0 else []).compute())
        answer["complaints"] = {
            change: complaint_about(case.over(case.frames[:1], **(changes if rank else {})))
            for change, changes in case.changes.items()
        }
    dist.destroy_process_group()
    return answers


def complaint_about(metric):
    """What `compute` says of the ranks' parameters."""
    try:
        metric.compute()
    except (ValueError, RuntimeError) as error:
        return str(error)
    return None
