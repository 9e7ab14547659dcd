"""What a standard error becomes with more steps: one model for what is printed, awaited and studied."""

import math
from typing import NamedTuple


class ErrorModel(NamedTuple):
    """The error of a number after some steps: error^2 = bias^2 + a / steps.

    Args:
        a: Variance of the number times the steps that it comes from, as worlds differ within and among each other.
        bias: What is left after any number of steps: by how much the setting is off, such as fewer rays.

    Example:
        >>> model = ErrorModel.of(error=0.02, steps=64)
        >>> model.error_after(256), model.steps_for(0.01)
        (0.01, 256)
        >>> ErrorModel(a=1.0, bias=0.1).steps_for(0.1) is None
        True
    """

    a: float
    bias: float = 0.0

    @classmethod
    def of(cls, error: float, steps: int, bias: float = 0.0) -> "ErrorModel":
        """From the standard error of a run; of an unknown error nothing is known."""
        return cls(error**2 * steps, bias)

    def error_after(self, steps: int) -> float:
        """The error after so many steps."""
        return math.sqrt(self.bias**2 + self.a / steps)

    def steps_for(self, error: float) -> int | None:
        """The fewest steps after which it is at most this; None if there are none, or that is unknown."""
        room = error**2 - self.bias**2
        if math.isnan(self.a) or not room > 0:
            return None
        return max(1, math.ceil(self.a / room * (1 - 1e-12)))  # which rounding would make one more
