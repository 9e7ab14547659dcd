"""The lens models by name: how many coefficients each takes, in which order, and what it is made of."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchcover.cameras.brown_conrady import BrownConrady, PlaneChart, SensorTilt
from torchcover.cameras.kannala_brandt import AngleChart, KannalaBrandt, ThetaPolynomial
from torchcover.cameras.lens import Distortion, Lens, Scalar
from torchcover.cameras.unified import DoubleSphereChart, ExtendedChart, SphereChart

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


def build_lens(model: str, coefficients: Sequence[Scalar], *, trainable: bool) -> Lens:
    """The lens of a model that `check_model` has passed, without a distortion that does nothing.

    A `trainable` one stays while its coefficients are zero, where its derivatives by them are not.
    """
    return _BUILD[model](coefficients, trainable)


def check_image(name: str, width: int, height: int, intrinsics: Tensor) -> None:
    """Refuse an image or intrinsics that no camera has."""
    for side, size in (("width", width), ("height", height)):
        if isinstance(size, bool) or not isinstance(size, int) or size <= 0:
            raise ValueError(f"{name}: {side} must be a positive integer; got {size!r}")
    if not torch.isfinite(intrinsics).all():
        raise ValueError(f"{name}: fx, fy, cx, cy must be finite; got {intrinsics.tolist()}")
    if not (intrinsics[:2] > 0).all():
        raise ValueError(f"{name}: fx and fy must be positive; got {intrinsics[:2].tolist()}")
