"""Importing this makes torch's functions as exact in the first call of a process as in any other.

On CPUs torch leaves them to Intel's MKL, which looks for the right one of its variants at the first call. If several
threads make that call together, some may get a much less exact one (github.com/pytorch/pytorch/issues/188792), and the
first rays of a camera differ from process to process. So one thread makes the first calls.
"""

import torch

for _function in (torch.sqrt, torch.sin, torch.cos, torch.exp, torch.log):
    for _dtype in (torch.float32, torch.float64):
        _function(torch.ones(1, dtype=_dtype, device="cpu"))
