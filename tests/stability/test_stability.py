"""All cases of docs/measured/stability.md stay within their bounds, with every search backend."""

import numpy as np
import pytest
import torch

from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.shapes import Mesh

from . import faces, ground, lenses, metric, motion, poses, rays, returns, search, sums
from .case import CPU_SEARCHES, CUDA_SEARCHES


def cases_of(*rooms):
    return [case for room in rooms for case in room.CASES if not case.benchmark_only]


BY_THEMSELVES = (rays, faces, ground, lenses, poses, returns, sums, motion)


def each(cases):
    return pytest.mark.parametrize("case", cases, ids=lambda case: case.name)


@each(cases_of(search))
@pytest.mark.parametrize("backend", CPU_SEARCHES, ids=str)
def test_with_every_backend(case, backend):
    assert case.ours(backend) <= case.bound


@pytest.mark.parametrize(
    ("case", "backend"),
    [
        pytest.param(case, backend, id=f"{backend}-{case.name}")
        for case in cases_of(metric)
        for backend in CPU_SEARCHES
        if backend.backend != "warp" and (case.ours is not metric.many_steps or backend.backend == "kdtree")
    ],
)
def test_of_the_metric(case, backend):
    """Without Warp, whose launches take longer on the CPU than the small clouds of many steps: those by one backend."""
    assert case.ours(backend) <= case.bound


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@each(cases_of(search, metric))
@pytest.mark.parametrize("backend", CUDA_SEARCHES, ids=str)
def test_on_cuda(case, backend):
    assert case.ours(backend) <= case.bound


@each(cases_of(*BY_THEMSELVES))
def test_without_a_search(case):
    assert case.ours() <= case.bound


@each([case for case in cases_of(search, metric, *BY_THEMSELVES) if case.naive_fails])
def test_the_naive_way_is_found_out(case):
    """Naive implementations exceed the bounds, so that no bound is too wide."""
    assert case.naive() > case.bound


@pytest.mark.parametrize("coordinate_m", [1e10, 1e300, np.nan])
def test_a_mesh_that_float32_cannot_hold_is_refused(coordinate_m):
    """Embree omits degenerate faces."""
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, coordinate_m, 0.0]])
    with pytest.raises(ValueError, match=r"within 1e.09 m of the origin"):
        RayCaster([Mesh(np.eye(3), np.array([[0, 1, 2]])), Mesh(corners, np.array([[0, 1, 2]]))])
