"""The lens models by name: how many coefficients each takes, in which order, and what it is made of.

The unified models (MEI's sphere, the extended unified model EUCM, the double sphere) go back to directions in closed
form; only MEI adds a distortion, which is that of Brown-Conrady. Directions that such a chart cannot show are those at
which its own image folds.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf, sqrt

import torch
from torch import Tensor

from torchcover.cameras.lens import (
    AngleChart,
    BrownConrady,
    Distortion,
    KannalaBrandt,
    Lens,
    PlaneChart,
    Scalar,
    SensorTilt,
    ThetaPolynomial,
    to_float,
)


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
        xi = to_float(self.xi)
        return 1.0 / sqrt(xi * xi - 1.0) if xi > 1.0 else inf

    def project(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Directions on the near side of the rim."""
        xi, norm = to_float(self.xi), _norm(x, y, z)
        shown = z > -norm * (1.0 / xi if xi > 1.0 else xi)
        return _over(x, y, z + self.xi * norm, shown)

    def unproject(self, a: Tensor, b: Tensor) -> Tensor:
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
        alpha, beta = to_float(self.alpha), to_float(self.beta)
        return 1.0 / sqrt(beta * (2.0 * alpha - 1.0)) if alpha > 0.5 else inf

    def project(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Directions before the fold."""
        alpha = to_float(self.alpha)
        d = _root(self.beta * (x * x + y * y) + z * z)
        shown = z > -d * (min(alpha, 1.0 - alpha) / max(alpha, 1.0 - alpha))
        return _over(x, y, self.alpha * d + (1.0 - self.alpha) * z, shown)

    def unproject(self, a: Tensor, b: Tensor) -> Tensor:
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
        alpha = to_float(self.alpha)
        return 1.0 / sqrt(2.0 * alpha - 1.0) if alpha > 0.5 else inf

    def project(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Directions before the fold."""
        xi, alpha = to_float(self.xi), to_float(self.alpha)
        # The image folds where the direction as seen from the second centre has the cosine -w1; w2 is that cosine as
        # seen from the first. (The paper's w2 takes both distances to that point as 1, and ends degrees too early.)
        w1 = min(alpha, 1.0 - alpha) / max(alpha, 1.0 - alpha)
        across = 1.0 - w1 * w1
        w2 = xi * across + w1 * sqrt(1.0 - xi * xi * across)
        norm = _norm(x, y, z)
        second = self.xi * norm + z
        below = self.alpha * _norm(x, y, second) + (1.0 - self.alpha) * second
        return _over(x, y, below, z > -w2 * norm)

    def unproject(self, a: Tensor, b: Tensor) -> Tensor:
        """Closed form of the paper."""
        s = a * a + b * b
        below = self.alpha * _root(1.0 - (2.0 * self.alpha - 1.0) * s) + 1.0 - self.alpha
        z = (1.0 - self.alpha * self.alpha * s) / below
        reach = (z * self.xi + _root(z * z + (1.0 - self.xi * self.xi) * s)) / (z * z + s)
        return _unit(a * reach, b * reach, reach * z - self.xi)


# Model -> (allowed numbers of coefficients, their order).
COEFFICIENTS = {
    "pinhole": ((0,), "none"),
    "brown_conrady": ((4, 5, 8, 12, 14), "k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tau_x tau_y]]]]"),
    "kannala_brandt": ((4,), "k1 k2 k3 k4"),
    "theta_polynomial": ((4,), "k1 k2 k3 k4"),
    "mei": ((1, 5), "xi [k1 k2 p1 p2]"),
    "eucm": ((2,), "alpha beta"),
    "double_sphere": ((2,), "xi alpha"),
}


def _brown_conrady(coefficients: Sequence[Scalar], trainable: bool) -> Distortion | None:
    return BrownConrady(coefficients) if trainable or any(coefficients) else None


def _build_brown_conrady(coefficients: Sequence[Scalar], trainable: bool) -> Lens:
    angles = coefficients[12:]
    tilt = SensorTilt(angles[0], angles[1]) if angles and (trainable or any(angles)) else None
    return Lens(PlaneChart(), _brown_conrady(coefficients[:12], trainable), tilt)


_BUILD: dict[str, Callable[[Sequence[Scalar], bool], Lens]] = {
    "pinhole": lambda _, __: Lens(PlaneChart()),
    "brown_conrady": _build_brown_conrady,
    "kannala_brandt": lambda k, trainable: Lens(AngleChart(), KannalaBrandt(k) if trainable or any(k) else None),
    "theta_polynomial": lambda k, _: Lens(AngleChart(), ThetaPolynomial(k)),
    "mei": lambda k, trainable: Lens(SphereChart(k[0]), _brown_conrady(k[1:], trainable) if len(k) > 1 else None),
    "eucm": lambda k, _: Lens(ExtendedChart(k[0], k[1])),
    "double_sphere": lambda k, _: Lens(DoubleSphereChart(k[0], k[1])),
}

# Model -> index of the coefficient, name, smallest and largest value at which the model is defined.
_RANGES = {
    "mei": [(0, "xi", 0.0, float("inf"))],
    "eucm": [(0, "alpha", 0.0, 1.0), (1, "beta", 1e-12, float("inf"))],
    # At xi = -1 the second centre is where the optical axis meets the sphere, which has no pixel then.
    "double_sphere": [(0, "xi", -1.0 + 1e-12, 1.0), (1, "alpha", 0.0, 1.0)],
}


def check_model(model: str, coefficients: Sequence[float]) -> None:
    """Raise unless the model exists and takes these coefficients."""
    if model not in COEFFICIENTS:
        raise ValueError(f"camera model {model!r} is unknown; allowed: {', '.join(COEFFICIENTS)}")
    counts, order = COEFFICIENTS[model]
    if len(coefficients) not in counts:
        allowed = " or ".join(str(count) for count in counts)
        raise ValueError(f"camera model {model!r} takes {allowed} coefficients ({order}); got {len(coefficients)}")
    if not all(abs(value) < float("inf") for value in coefficients):
        raise ValueError(f"camera model {model!r}: coefficients must be finite; got {list(coefficients)}")
    for index, name, low, high in _RANGES.get(model, []):
        if not low <= coefficients[index] <= high:
            raise ValueError(
                f"camera model {model!r}: {name} must lie in [{low:g}, {high:g}]; got {coefficients[index]}"
            )
    if model == "theta_polynomial" and coefficients[0] <= 0:
        raise ValueError(f"camera model {model!r}: k1 must be positive; got {coefficients[0]}")


def build_lens(model: str, coefficients: Sequence[Scalar], *, is_trainable: bool) -> Lens:
    """The lens of a model that `check_model` has passed, without a distortion that does nothing.

    A `is_trainable` one stays while its coefficients are zero, where its derivatives by them are not.
    """
    return _BUILD[model](coefficients, is_trainable)


def check_image(name: str, width: int, height: int, intrinsics: Tensor) -> None:
    """Refuse an image or intrinsics that no camera has."""
    for side, size in (("width", width), ("height", height)):
        if isinstance(size, bool) or not isinstance(size, int) or size <= 0:
            raise ValueError(f"{name}: {side} must be a positive integer; got {size!r}")
    if not torch.isfinite(intrinsics).all():
        raise ValueError(f"{name}: fx, fy, cx, cy must be finite; got {intrinsics.tolist()}")
    if not (intrinsics[:2] > 0).all():
        raise ValueError(f"{name}: fx and fy must be positive; got {intrinsics[:2].tolist()}")
