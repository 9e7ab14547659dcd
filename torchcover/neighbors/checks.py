"""What comes in where tensors are needed, checked at the door."""

import numpy as np
from torch import Tensor


def check_tensor(given: object, name: str, *, floating: bool = False) -> None:
    """Raise unless what arrived is a tensor.

    Args:
        given: What arrived.
        name: What the caller calls it, for the message.
        floating: Whether it has to be of a floating-point type.

    Raises:
        TypeError: It is none; of an array of NumPy's the message says how it becomes one.

    Example:
        >>> check_tensor(np.zeros((2, 3)), "sensor")
        Traceback (most recent call last):
        TypeError: sensor: a torch tensor is needed; got a NumPy array of float64; torch.from_numpy(array) makes it one
    """
    if isinstance(given, Tensor) and (given.is_floating_point() or not floating):
        return
    wanted = "a floating-point torch tensor" if floating else "a torch tensor"
    if isinstance(given, np.ndarray):
        makes = "torch.from_numpy(array)" + (".float()" if floating and given.dtype.kind != "f" else "")
        raise TypeError(f"{name}: {wanted} is needed; got a NumPy array of {given.dtype}; {makes} makes it one")
    arrived = given.dtype if isinstance(given, Tensor) else type(given).__name__
    raise TypeError(f"{name}: {wanted} is needed; got {arrived}")


def check_cloud(cloud: Tensor, name: str) -> None:
    """Raise unless `cloud` is a floating-point tensor of shape (N, 3) with finite coordinates.

    Args:
        cloud: What arrived.
        name: What the caller calls it, for the message.

    Raises:
        TypeError: Not a tensor of a floating-point type.
        ValueError: Another shape, or NaN or infinite coordinates (the message says how many points have them).
    """
    check_tensor(cloud, name, floating=True)
    if cloud.ndim != 2 or cloud.shape[1] != 3:
        raise ValueError(f"{name}: shape (N, 3) is needed; got {tuple(cloud.shape)}")
    # A sum is finite only if all its terms are; one that overflows is looked at term by term.
    if not cloud.detach().sum().isfinite() and not cloud.isfinite().all():
        bad = int((~cloud.detach().isfinite()).any(dim=1).sum())
        raise ValueError(f"{name}: {bad} of {len(cloud)} points have NaN or infinite coordinates; drop them first")
