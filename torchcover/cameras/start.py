"""Where Newton's method starts: the inverse of the radial part, as a table; else the nearest of many images."""

from dataclasses import dataclass

import numpy as np

from torchcover.cameras.lens import Distortion
from torchcover.cameras.valid_region import HORIZON, ValidRegion
from torchcover.geometry.arrays import Float64

_ENTRIES = 4096
# Seeds stop a tenth of a degree short of the horizon of the plane z = 1.
_FARTHEST_SEED = 500.0


@dataclass(frozen=True)
class StartTable:
    """Undistorted radius over distorted radius.

    `step`: distorted radius from one entry to the next; `radii`: (K,) undistorted radii.
    """

    step: float
    radii: Float64

    def __call__(self, distorted: Float64) -> Float64:
        """Undistorted radius, linearly interpolated and held at the end."""
        place = np.minimum(distorted / self.step, len(self.radii) - 1.001)
        low = place.astype(np.int64)
        left = self.radii[low]
        return left + (place - low) * (self.radii[low + 1] - left)


def make_start_table(distortion: Distortion, limit: float, farthest: float) -> StartTable:
    """Tabulate the inverse of the radial part up to its own fold, or as far as the pixels go."""
    fold = _radial_fold(distortion, limit)
    top = _radius_for(distortion, farthest) if np.isinf(fold) else fold
    even = np.linspace(0.0, 1.0, _ENTRIES)
    # Towards a fold the inverse has the slope of a square root; without one the radii run evenly in angle.
    radii = np.tan(even * np.arctan(top)) if np.isinf(fold) else top * (1.0 - (1.0 - even) ** 2)
    with np.errstate(all="ignore"):  # a pole at the very end
        distorted = np.maximum.accumulate(np.nan_to_num(distortion.radial(radii)))
    end = max(min(farthest, float(distorted[-1])), 1e-30)
    table = np.interp(np.linspace(0.0, end, _ENTRIES), distorted, radii)
    return StartTable(end / (_ENTRIES - 1), table)


def _radial_fold(distortion: Distortion, limit: float) -> float:
    """First critical radius after which the radial part does not grow, or comes back from a pole."""
    critical = np.sort(distortion.critical_radii())
    after = np.append((critical[:-1] + critical[1:]) / 2.0, critical[-1:] * 1.01)
    value = distortion.radial(after)
    folds = critical[(value < 0.0) | (distortion.radial(after * (1.0 + 1e-6)) <= value)]
    return min(float(folds[0]) if len(folds) else np.inf, limit)


def _radius_for(distortion: Distortion, distorted: float) -> float:
    """A radius whose image is at least this far out, or the horizon."""
    radius = 1.0
    while radius < HORIZON and not distortion.radial(np.array([radius]))[0] >= distorted:
        radius *= 2.0
    return radius


def nearest_seeds(distortion: Distortion, region: ValidRegion, u: Float64, v: Float64) -> tuple[Float64, Float64]:
    """The second try: of points spread over the valid region, those whose images lie nearest.

    Strong tangential terms bend the region so far from round that Newton's method, coming from the radial part's
    answer, can end in a bay of its edge.
    """
    azimuth = np.linspace(-np.pi, np.pi, 96, endpoint=False)
    cosine, sine = np.cos(azimuth)[:, None], np.sin(azimuth)[:, None]
    edge = np.minimum(0.999 * region.edge(cosine, sine), _FARTHEST_SEED)
    radius = np.tan(np.linspace(0.02, 1.0, 48) * np.arctan(edge))
    seed_a, seed_b = (radius * cosine).ravel(), (radius * sine).ravel()
    image = distortion.linearise(seed_a, seed_b)
    half_square = (image.u**2 + image.v**2) / 2.0
    nearest = np.empty(len(u), dtype=np.int64)
    for start in range(0, len(u), 1024):  # |m|^2 - 2 m.s + |s|^2, less what is the same for all seeds
        part = slice(start, start + 1024)
        nearest[part] = np.argmin(half_square - u[part, None] * image.u - v[part, None] * image.v, axis=1)
    return seed_a[nearest], seed_b[nearest]
