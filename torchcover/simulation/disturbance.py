"""What keeps a measured cloud from being exact."""

import numpy as np
from numpy.typing import NDArray


def disturb(
    points_m: NDArray[np.float32],
    origin_m: NDArray[np.float64],
    range_noise_m: float,
    dropout: float,
    generator: np.random.Generator,
) -> NDArray[np.float32]:
    """Apply the noise of the range and the drop-out of a sensor.

    Args:
        points_m: (N, 3) exact points.
        origin_m: (3,) where their rays start.
        range_noise_m: Standard deviation of the range, along the ray.
        dropout: Probability that a ray gives no point.
        generator: Source of the random numbers; not touched if there is neither noise nor drop-out.

    Returns:
        (K, 3) points; the very array if there is neither.

    Example:
        >>> points = np.ones((100, 3), dtype=np.float32)
        >>> 50 < len(disturb(points, np.zeros(3), 0.0, 0.3, np.random.default_rng(0))) < 90
        True
    """
    if range_noise_m > 0:
        rays = points_m.astype(np.float64) - origin_m
        range_m = np.linalg.norm(rays, axis=1, keepdims=True)
        noise_m = generator.normal(0.0, range_noise_m, size=range_m.shape)
        points_m = (points_m + rays * (noise_m / range_m)).astype(np.float32)
    if dropout > 0:
        points_m = points_m[generator.random(len(points_m)) >= dropout]
    return points_m
