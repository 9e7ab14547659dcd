"""Reduce the mean blind spot radius by gradient descent: `python examples/optimize_points.py`.

The radius is differentiable in the sensor points: the gradient of the radius of a reference point moves its nearest
sensor point towards it. Sampled points of a rig in one frame of city traffic follow this gradient (Adam).

The points are not constrained to rays and cannot be occluded. The effect of a mounting position on occlusion is not
differentiable; see docs/training.md.
"""

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # before pyplot: no display is needed
import matplotlib.pyplot as plt
import torch
from rich.console import Console
from rich.progress import track

from torchcover import blind_spot_radius
from torchcover.data import SimulatedFrames

X_M = (2.5, 42.5)
Y_M = (-12.0, 12.0)
Z_M = (-0.5, 2.0)
THRESHOLD_M = 0.4


def crop_to_region(cloud):
    """Select the (N, 3) points inside the region."""
    x, y, z = cloud.T
    return cloud[(x >= X_M[0]) & (x < X_M[1]) & (y >= Y_M[0]) & (y < Y_M[1]) & (z >= Z_M[0]) & (z < Z_M[1])]


def sample_points(cloud, count, generator):
    """Sample points without replacement; all points if there are fewer."""
    return cloud[torch.randperm(len(cloud), generator=generator)[:count]]


def plot_radii(reference, before, after, path):
    """Plot the reference points colored by their radius, with the sensor points, before and after."""
    figure, axes = plt.subplots(2, 1, figsize=(9.0, 11.0), layout="constrained")
    for ax, points, title in zip(axes, (before, after), ("before", "after"), strict=True):
        radius = blind_spot_radius(points, reference)
        dots = ax.scatter(*reference[:, :2].T, c=radius, s=3, cmap="viridis_r", vmin=0.0, vmax=3.0, linewidths=0)
        ax.plot(*points[:, :2].T, "r.", markersize=3)
        ax.set(title=f"{title}: mean radius {radius.mean():.2f} m", xlabel="x in m", ylabel="y in m", aspect="equal")
    figure.colorbar(dots, ax=axes, label="blind spot radius of the reference points in m", extend="max", shrink=0.6)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def main():
    """Optimize the points, print the numbers and plot the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=400, help="number of optimized points")
    parser.add_argument("--num-steps", type=int, default=200, help="steps of gradient descent")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/optimize_points.png"))
    options = parser.parse_args()

    console = Console()
    generator = torch.Generator().manual_seed(options.seed)
    frame = SimulatedFrames("urban", "front_roof_32", num_frames=1, seed=options.seed)[0]
    reference = sample_points(crop_to_region(frame.reference), 20_000, generator)
    before = sample_points(crop_to_region(frame.sensor), options.points, generator)

    points = before.clone().requires_grad_()
    optimizer = torch.optim.Adam([points], lr=0.1)
    for _ in track(range(options.num_steps), description="gradient steps", console=console):
        optimizer.zero_grad()
        blind_spot_radius(points, reference).mean().backward()
        optimizer.step()

    after = points.detach()
    for name, cloud in (("before", before), ("after", after)):
        radius = blind_spot_radius(cloud, reference)
        detected = (radius <= THRESHOLD_M).float().mean()
        console.print(
            f"{name}: mean radius {radius.mean():.3f} m, {detected:.1%} of the reference within {THRESHOLD_M} m"
        )
    plot_radii(reference, before, after, options.out)
    console.print(f"Wrote {options.out}")


if __name__ == "__main__":
    main()
