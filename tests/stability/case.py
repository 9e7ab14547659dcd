"""Stability cases: an extreme input, its correct result, our error, and the error of a naive implementation."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
import torch

from torchcover import CoverageMetric, nearest
from torchcover.neighbors import BACKENDS


@dataclass(frozen=True)
class Case:
    """One row of the table.

    Args:
        name: What is extreme.
        expected: Where the right answer comes from.
        unit: Of the errors and of the bound.
        bound: Largest error that passes.
        ours: Our error; in the rooms that search, as a function of the `Search`.
        naive_way: How one writes it first.
        naive: The error of that.
        naive_fails: Whether the naive error must be over the bound, on any machine.
        benchmark_only: Too large for the tests.
    """

    name: str
    expected: str
    unit: str
    bound: float
    ours: Callable[..., float]
    naive_way: str
    naive: Callable[[], float]
    naive_fails: bool = True
    benchmark_only: bool = False


@dataclass(frozen=True)
class Search:
    """A backend of `nearest` on a device. With little memory brute force goes another way: by differences alone."""

    backend: str
    device: str = "cpu"
    memory_mb: float = 256.0

    def __str__(self):
        memory = "" if self.memory_mb == 256.0 else f", {self.memory_mb:g} MB"
        return f"{self.backend}{memory}" + ("" if self.device == "cpu" else f" on {self.device}")

    def distance(self, reference, sensor, **options):
        """(N,) distances of numpy or torch clouds, in the type that `nearest` gives."""
        clouds = (torch.as_tensor(cloud).to(self.device) for cloud in (reference, sensor))
        result = nearest(*clouds, backend=self.backend, memory_mb=self.memory_mb, **options)
        return result.distance.cpu().numpy()

    def metric(self, grid, **options):
        return CoverageMetric(grid, backend=self.backend, memory_mb=self.memory_mb, **options).to(self.device)

    def cloud(self, rows, dtype=torch.float32):
        return torch.as_tensor(np.asarray(rows)).to(device=self.device, dtype=dtype).reshape(-1, 3)


CPU_ONLY = ("kdtree", "packets")
LIBRARIES = {"packets": "numba", "warp": "warp"}
INSTALLED = sorted(name for name in BACKENDS if name not in LIBRARIES or find_spec(LIBRARIES[name]))
CPU_SEARCHES = (*(Search(backend) for backend in INSTALLED), Search("cdist", memory_mb=8.0))
CUDA_SEARCHES = tuple(
    Search(backend, "cuda") for backend in ("auto", "cdist", "warp") if backend in ("auto", *INSTALLED)
)


def longdouble_distance(reference, sensor):
    """Compute (N,) distances to the nearest point by brute force in the widest type of NumPy."""
    reference, sensor = (np.asarray(cloud).astype(np.longdouble) for cloud in (reference, sensor))
    chunks = np.array_split(reference, max(1, len(reference) * len(sensor) // 1_000_000))
    return np.concatenate([np.sqrt(((q[:, None] - sensor) ** 2).sum(axis=2)).min(axis=1) for q in chunks])


def most(error):
    """Return the largest absolute entry; infinite if any is NaN."""
    error = np.asarray(error)
    return float(np.where(np.isnan(error), np.inf, np.abs(error)).max())


def ulps(found, expected):
    """Return the largest error in units in the last place of `found`; 0.5 is correct rounding."""
    step = np.spacing(np.abs(expected).astype(found.dtype)).astype(np.longdouble)
    with np.errstate(invalid="ignore"):
        return most((found.astype(np.longdouble) - expected) / step)


def relative(found, expected):
    """Largest relative error."""
    return most((np.asarray(found) - expected) / expected)
