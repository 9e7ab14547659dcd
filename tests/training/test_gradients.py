"""Mean radius as a loss function of points."""

import runpy
import sys
from pathlib import Path

import torch

from torchcover import blind_spot_radius

EXAMPLE = Path(__file__).parents[2] / "examples" / "optimize_points.py"


def test_gradients_pull_points_to_their_reference_points():
    reference = torch.tensor([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [9.0, 0.0, 0.0]])
    points = torch.tensor([[0.0, 0.0, 0.0], [9.0, 0.0, 1.0], [0.0, -5.0, 0.0]], requires_grad=True)
    blind_spot_radius(points, reference).sum().backward()
    # Downhill is along the unit vectors towards the reference points: (1, 0, 0) + (0, 1, 0), and (0, 0, -1).
    assert torch.equal(-points.grad, torch.tensor([[1.0, 1.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]]))


def test_optimized_points_converge_to_the_median():
    """On a line, the point with the smallest mean distance to 0, 1 and 5 is the median 1, not the mean 2."""
    reference = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    point = torch.tensor([[4.0, 0.3, 0.0]], requires_grad=True)
    descent = torch.optim.SGD([point])
    for step in range(200):
        descent.param_groups[0]["lr"] = 0.5 / (1 + step / 10)
        descent.zero_grad()
        blind_spot_radius(point, reference).mean().backward()
        descent.step()
    assert (point.detach() - torch.tensor([[1.0, 0.0, 0.0]])).norm() < 0.05


def test_example_lowers_the_mean_radius(tmp_path, monkeypatch, capsys):
    picture = tmp_path / "points.png"
    monkeypatch.setattr(
        sys, "argv", ["optimize_points.py", "--points", "60", "--num-steps", "15", "--out", str(picture)]
    )
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    said = capsys.readouterr().out
    before, after = (float(said.split(f"{when}: mean radius ")[1].split(" m")[0]) for when in ("before", "after"))
    assert after < 0.9 * before
    assert picture.stat().st_size > 20_000
