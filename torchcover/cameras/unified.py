"""The unified models: MEI's sphere, the extended unified model (EUCM), the double sphere.

All three go back to directions in closed form; only MEI adds a distortion, and that is Brown-Conrady's. Directions
that such a chart cannot show are those at which its own image folds.
"""

from dataclasses import dataclass
from math import inf, sqrt

import torch
from torch import Tensor

from torchcover.cameras.lens import Scalar, number


def _norm(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    return _root(x * x + y * y + z * z)


def _root(value: Tensor) -> Tensor:
    """Square root of what rounding may have pushed below 0 at the rim; its gradient at 0 is 0, not infinite."""
    positive = value > 0
    return torch.where(positive, torch.sqrt(torch.where(positive, value, 1.0)), 0.0)


def _unit(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    norm = _norm(x, y, z)
    return torch.stack((x / norm, y / norm, z / norm), dim=-1)


def _over(x: Tensor, y: Tensor, below: Tensor, shown: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    below = torch.where(shown, below, 1.0)
    return x / below, y / below, shown


@dataclass(frozen=True)
class SphereChart:
    """(x, y) / (z + xi |p|): the unit sphere seen from xi behind its centre (Mei and Rives 2007).

    `xi`: distance of the eye from the centre, at least 0; 0 is the pinhole.
    """

    xi: Scalar

    @property
    def limit(self) -> float:
        """The rim of the sphere as an eye outside of it sees it."""
        xi = number(self.xi)
        return 1.0 / sqrt(xi * xi - 1.0) if xi > 1.0 else inf

    def draw(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Directions on the near side of the rim."""
        xi, norm = number(self.xi), _norm(x, y, z)
        shown = z > -norm * (1.0 / xi if xi > 1.0 else xi)
        return _over(x, y, z + self.xi * norm, shown)

    def lift(self, a: Tensor, b: Tensor) -> Tensor:
        """The nearer of the two points in which the line of sight meets the sphere."""
        s = a * a + b * b
        reach = (self.xi + _root(1.0 + (1.0 - self.xi * self.xi) * s)) / (s + 1.0)
        return _unit(a * reach, b * reach, reach - self.xi)


@dataclass(frozen=True)
class ExtendedChart:
    """(x, y) / (alpha d + (1 - alpha) z), d = sqrt(beta (x^2 + y^2) + z^2) (Khomutenko et al. 2016).

    `alpha`: from 0, the pinhole, to 1; `beta`: above 0; 1 is the sphere.
    """

    alpha: Scalar
    beta: Scalar

    @property
    def limit(self) -> float:
        """Radius at which the image folds; none for alpha up to a half."""
        alpha, beta = number(self.alpha), number(self.beta)
        return 1.0 / sqrt(beta * (2.0 * alpha - 1.0)) if alpha > 0.5 else inf

    def draw(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Directions before the fold."""
        alpha = number(self.alpha)
        d = _root(self.beta * (x * x + y * y) + z * z)
        shown = z > -d * (min(alpha, 1.0 - alpha) / max(alpha, 1.0 - alpha))
        return _over(x, y, self.alpha * d + (1.0 - self.alpha) * z, shown)

    def lift(self, a: Tensor, b: Tensor) -> Tensor:
        """Closed form of the paper."""
        s = self.beta * (a * a + b * b)
        below = self.alpha * _root(1.0 - (2.0 * self.alpha - 1.0) * s) + 1.0 - self.alpha
        return _unit(a, b, (1.0 - self.alpha * self.alpha * s) / below)


@dataclass(frozen=True)
class DoubleSphereChart:
    """(x, y) / (alpha |(x, y, xi d + z)| + (1 - alpha) (xi d + z)), d = |p| (Usenko et al. 2018).

    `xi`: distance between the two centres, from -1 to 1; `alpha`: from 0 to 1.
    """

    xi: Scalar
    alpha: Scalar

    @property
    def limit(self) -> float:
        """Radius at which the image folds; none for alpha up to a half."""
        alpha = number(self.alpha)
        return 1.0 / sqrt(2.0 * alpha - 1.0) if alpha > 0.5 else inf

    def draw(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Directions before the fold."""
        xi, alpha = number(self.xi), number(self.alpha)
        # The image folds where the direction as seen from the second centre has the cosine -w1; w2 is that cosine as
        # seen from the first. (The paper's w2 takes both distances to that point as 1, and ends degrees too early.)
        w1 = min(alpha, 1.0 - alpha) / max(alpha, 1.0 - alpha)
        across = 1.0 - w1 * w1
        w2 = xi * across + w1 * sqrt(1.0 - xi * xi * across)
        norm = _norm(x, y, z)
        second = self.xi * norm + z
        below = self.alpha * _norm(x, y, second) + (1.0 - self.alpha) * second
        return _over(x, y, below, z > -w2 * norm)

    def lift(self, a: Tensor, b: Tensor) -> Tensor:
        """Closed form of the paper."""
        s = a * a + b * b
        below = self.alpha * _root(1.0 - (2.0 * self.alpha - 1.0) * s) + 1.0 - self.alpha
        z = (1.0 - self.alpha * self.alpha * s) / below
        reach = (z * self.xi + _root(z * z + (1.0 - self.xi * self.xi) * s)) / (z * z + s)
        return _unit(a * reach, b * reach, reach * z - self.xi)
