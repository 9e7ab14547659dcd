"""Which reference points are asked about, and what they count for: a slow twin."""

import numpy as np
import torch

from torchcover.placement import Objective
from torchcover.placement.question_grid import QuestionGrid

OUTLINE_M = np.array([[-2.0, -1.0], [2.0, -1.0], [2.0, 1.0], [-2.0, 1.0]])


def test_points_are_in_the_cells_of_their_questions():
    lane = {"lane": {"x_m": [-7.3, -2.0], "y_m": [-1.2, 1.6]}}
    near = Objective(region="20m", band="obstacle"), Objective(region="20m")
    asked = QuestionGrid.around(OUTLINE_M, {"a": near[0], "b": Objective(region=lane, detection=0.1), "c": near[1]})
    assert [(one.threshold_m, one.band, one.region) for one in asked.questions] == [
        (0.4, "obstacle", "20m"),
        (0.1, "ground", "lane"),
        (0.1, "obstacle", "lane"),
        (0.4, "ground", "20m"),
    ]
    # Cells of half a metre whose centres lie in the lane.
    assert asked.areas == (((0.0, 20.0), (-5.0, 5.0)), ((-7.5, -2.0), (-1.0, 1.5)))
    generator = np.random.default_rng(0)
    points = generator.uniform([-50, -45, -1], [30, 45, 3], (40_000, 3)).astype(np.float32)
    m2 = generator.uniform(0.1, 2.0, len(points)).astype(np.float32)
    kept, found = asked.sorted_in(torch.from_numpy(points), torch.from_numpy(m2))
    boxes = [((0, 20), (-5, 5), (0.5, 2)), *(((-7.5, -2), (-1, 1.5), z) for z in ((-0.5, 0.5), (0.5, 2)))]
    boxes.append(((0, 20), (-5, 5), (-0.5, 0.5)))
    inside = [
        np.logical_and.reduce([(p >= low) & (p < high) for p, (low, high) in zip(points.T, box, strict=True)])
        for box in boxes
    ]
    np.testing.assert_array_equal(kept.numpy(), points[np.logical_or.reduce(inside)])
    assert found.points == len(kept)
    assert 10 < inside[1].sum() < inside[0].sum() < len(points) / 10
    for own, cells in zip(inside, found.cells_of, strict=True):
        places = np.floor(points[own, :2] / 0.5)
        each, cell = np.unique(places, axis=0, return_inverse=True)
        np.testing.assert_allclose(np.sort(found.cell_m2[cells]), np.sort(np.bincount(cell.ravel(), m2[own])))
        assert len(cells) == len(each)
        of = found.of[np.isin(found.cell, cells)]
        np.testing.assert_array_equal(kept.numpy()[np.sort(of)], points[own])
