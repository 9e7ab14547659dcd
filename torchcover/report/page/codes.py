"""Numbers of cells in few bytes: known cells only, 16 bits each where a reader reads values, 8 where errors.

A number x is kept as a code on a scale that is even in x, or in log x where the largest is far above the least; 0 and
infinity have codes of their own. With 16 bits an even scale is exact to 1/131,000 of its span, and a logarithmic one to
0.02 % of each number over nine decades.
"""

import base64
import zlib
from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

# Beyond this ratio of the largest to the least, equal ratios are kept equally well.
WIDE_RATIO = 50.0
DECADES = 9
COMPRESSION = 6

# The array, its codes, which cells are known, and the scale, by which array it is and its bits.
Codes: TypeAlias = dict[tuple[int, int], tuple[NDArray[Any], bytes, bytes, Mapping[str, Any]]]


class CellBytes:
    """Collects arrays of cells in one run of bytes; what is the same is kept once.

    Args:
        codes: What arrays were encoded to already, for another choice of them; more is added.
    """

    def __init__(self, codes: Codes | None = None) -> None:
        self.arrays: list[dict[str, Any]] = []
        self._codes: Codes = {} if codes is None else codes
        self._parts: list[bytes] = []
        self._length = 0
        self._at: dict[bytes, int] = {}
        self._kept: dict[int, int] = {}
        self._text = ""

    def add(self, values: NDArray[Any], bits: int) -> int:
        """Keep an array.

        `values`: (Y, X) numbers; NaN is unknown; `bits`: of each, 8 or 16. Returns its place in `arrays`.
        """
        if id(values) in self._kept:
            return self._kept[id(values)]
        key = id(values), bits
        if key not in self._codes:
            self._codes[key] = values, *packed(values, bits)  # held, so that no other object is at its place
        _, planes, mask, scale = self._codes[key]
        where = {"at": self._place(planes), "mask": self._place(mask)}
        self.arrays.append({**where, "count": 8 * len(planes) // bits, "bits": bits, **scale})
        self._kept[id(values)] = len(self.arrays) - 1
        return len(self.arrays) - 1

    @property
    def text(self) -> str:
        """All of it, deflated (zlib), as base64."""
        if not self._text:
            self._text = base64.b64encode(zlib.compress(b"".join(self._parts), COMPRESSION)).decode("ascii")
        return self._text

    def _place(self, content: bytes) -> int:
        if content not in self._at:
            self._at[content] = self._length
            self._parts.append(content)
            self._length += len(content)
            self._text = ""
        return self._at[content]


def packed(values: NDArray[Any], bits: int) -> tuple[bytes, bytes, Mapping[str, Any]]:
    """The codes of known cells, high bytes first; which are known, a bit each; and the scale of the codes."""
    flat = np.asarray(values, dtype=np.float64).ravel()
    known = ~np.isnan(flat)
    codes, scale = encoded(flat[known], bits)
    planes = (codes & 255).astype(np.uint8).tobytes()
    if bits > 8:
        planes = (codes >> 8).astype(np.uint8).tobytes() + planes
    return planes, np.packbits(known, bitorder="little").tobytes(), scale


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
