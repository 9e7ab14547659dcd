"""Numbers of cells in few bytes: known cells only, 16 bits each where a reader reads values, 8 where errors.

A number x is kept as a code on a scale that is even in x, or in log x where the largest is far above the least; 0 and
infinity have codes of their own. With 16 bits an even scale is exact to 1/131,000 of its span, and a logarithmic one to
0.02 % of each number over nine decades.
"""

import base64
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Beyond this ratio of the largest to the least, equal ratios are kept equally well.
WIDE_RATIO = 50.0
DECADES = 9
COMPRESSION = 6


class CellBytes:
    """Collects arrays of cells in one run of bytes; what is the same is kept once."""

    def __init__(self) -> None:
        self.arrays: list[dict[str, Any]] = []
        self._parts: list[bytes] = []
        self._length = 0
        self._at: dict[bytes, int] = {}
        self._known: dict[int, tuple[NDArray[Any], int]] = {}

    def add(self, values: NDArray[Any], bits: int) -> int:
        """Keep an array.

        `values`: (Y, X) numbers; NaN is unknown; `bits`: of each, 8 or 16. Returns its place in `arrays`.
        """
        if id(values) in self._known:  # which stays the same object, for it is held here
            return self._known[id(values)][1]
        flat = np.asarray(values, dtype=np.float64).ravel()
        known = ~np.isnan(flat)
        codes, scale = encoded(flat[known], bits)
        high_bytes, low_bytes = (codes >> 8).astype(np.uint8), (codes & 255).astype(np.uint8)
        planes = low_bytes.tobytes() if bits == 8 else high_bytes.tobytes() + low_bytes.tobytes()
        where, mask = self._place(planes), self._place(np.packbits(known, bitorder="little").tobytes())
        self.arrays.append({"at": where, "mask": mask, "count": int(known.sum()), "bits": bits, **scale})
        self._known[id(values)] = values, len(self.arrays) - 1
        return len(self.arrays) - 1

    def text(self) -> str:
        """All of it, deflated (zlib), as base64."""
        return base64.b64encode(zlib.compress(b"".join(self._parts), COMPRESSION)).decode("ascii")

    def _place(self, content: bytes) -> int:
        if content not in self._at:
            self._at[content] = self._length
            self._parts.append(content)
            self._length += len(content)
        return self._at[content]


def encoded(values: NDArray[np.float64], bits: int) -> tuple[NDArray[np.uint16], Mapping[str, Any]]:
    """Codes of numbers that are not NaN, and what a reader needs to have them back (`cells.js`)."""
    top = 2**bits - 1
    endless, nothing = np.isposinf(values), values == 0
    usual = values[np.isfinite(values) & ~nothing]
    low, high = (float(usual.min()), float(usual.max())) if len(usual) else (0.0, 1.0)
    logarithmic = low > 0 and high > WIDE_RATIO * low
    if logarithmic:
        low = max(low, high * 10.0**-DECADES)
    bend = np.log if logarithmic else np.positive
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (bend(np.clip(values, low, high)) - bend(low)) / ((bend(high) - bend(low)) or 1.0)
    codes = 1 + np.rint((top - 2) * share)
    codes = np.where(endless, top, np.where(nothing, 0, codes)).astype(np.uint16)
    return codes, {"log": bool(logarithmic), "low": low, "high": high}
