"""What keeps a measured cloud from being exact."""

import numpy as np
from numpy.typing import NDArray

from torchcover.simulation.instant import Scan


def disturb(
    scan: Scan,
    origin_m: NDArray[np.float64],
    range_noise_m: float,
    dropout: float,
    generator: np.random.Generator,
) -> Scan:
    """Apply the noise of the range and the drop-out of a sensor.

    Args:
        scan: What it would see exactly.
        origin_m: (3,) where its rays start.
        range_noise_m: Standard deviation of the range, along the ray.
        dropout: Probability that a ray gives no point.
        generator: Source of the random numbers; not touched if there is neither noise nor drop-out.

    Returns:
        What it sees; the very scan if there is neither.

    Example:
        >>> exact = Scan(np.ones((100, 3), dtype=np.float32), np.arange(100), rays=100, self_hits=0)
        >>> 50 < len(disturb(exact, np.zeros(3), 0.0, 0.3, np.random.default_rng(0)).points) < 90
        True
    """
    if range_noise_m > 0:
        rays = scan.points.astype(np.float64) - origin_m
        range_m = np.linalg.norm(rays, axis=1, keepdims=True)
        noise_m = generator.normal(0.0, range_noise_m, size=range_m.shape)
        scan = scan._replace(points=(scan.points + rays * (noise_m / range_m)).astype(np.float32))
    if dropout > 0:
        kept = generator.random(len(scan.points)) >= dropout
        scan = scan._replace(points=scan.points[kept], ray=scan.ray[kept])
    return scan
