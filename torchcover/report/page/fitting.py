"""Maps that fit into a page: what is too much is left to `coverage.npz`, and the page says so."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from torchcover.report.page.content import Array, PageMap
from torchcover.report.page.map_content import ERROR_BITS, VALUE_BITS

# Deflated and as base64, at most a quarter more characters.
MOST_BYTES = 3.8e6
# Of maps that are beside those with errors.
MOST_HALVINGS = 2
VALUE_BYTES, ERROR_BYTES = VALUE_BITS // 8, ERROR_BITS // 8
NO_ERRORS = "Errors of single cells are left out, so that this file stays small: the .npz files have them."


def fitted(maps: Sequence[PageMap], most_bytes: float = MOST_BYTES) -> tuple[list[PageMap], list[str]]:
    """Take cells together where maps have no errors beside some that have; leave out errors; take all cells together.

    Args:
        maps: All of a page.
        most_bytes: What they may take.

    Returns:
        The maps, and what was left out in words.
    """
    kept, notes = list(maps), []
    with_errors = [one.errors is not None for one in kept]
    for _ in range(MOST_HALVINGS if any(with_errors) else 0):
        if bytes_of(kept) > most_bytes:
            kept = [one if has else coarser(one) for one, has in zip(kept, with_errors, strict=True)]
    if bytes_of(kept) > most_bytes and any(with_errors):
        kept, notes = [replace(one, errors=None) for one in kept], [NO_ERRORS]
    while bytes_of(kept) > most_bytes:
        kept = [coarser(one) for one in kept]
    sides = {round(one.cell_m / whole.cell_m) for one, whole in zip(kept, maps, strict=True)} - {1}
    if sides:
        words = " or ".join(f"{side} x {side}" for side in sorted(sides))
        notes.append(f"Some maps show {words} cells as one, so that this file stays small: the .npz files have each.")
    return kept, notes


def bytes_of(maps: Sequence[PageMap]) -> int:
    """What their numbers take; weights that several share count once."""
    values = sum(int((~np.isnan(one.values)).sum()) * _width(one) for one in maps)
    weights = {id(one.weights): one.weights for one in maps if one.weights is not None}
    return values + sum(VALUE_BYTES * int((~np.isnan(each)).sum()) for each in weights.values())


def coarser(one: PageMap) -> PageMap:
    """A map with four cells in each, without errors: their mean as the weights say, or all alike.

    Example:
        >>> from torchcover.report.maps.colours import ColourScale
        >>> scale = ColourScale("radius", "m", "viridis_r", 0.0, 4.0)
        >>> cells = np.array([[1.0, 3.0], [np.nan, 2.0]])
        >>> coarser(PageMap("radius", "ground", "rig", (0.0, 2.0), (0.0, 2.0), 1.0, cells, scale)).values
        array([[2.]])
    """
    known = ~np.isnan(one.values)
    weights = known.astype(float) if one.weights is None else np.where(known, one.weights, 0.0)
    base, sums = _sums(weights), _sums(np.where(known, weights * np.where(known, one.values, 0.0), 0.0))
    rows, columns = base.shape
    cell_m = 2 * one.cell_m
    return replace(
        one,
        x=(one.x[0], one.x[0] + columns * cell_m),
        y=(one.y[0], one.y[0] + rows * cell_m),
        cell_m=cell_m,
        values=np.where(base > 0, sums / np.where(base > 0, base, 1.0), np.nan),
        errors=None,
        weights=None if one.weights is None else np.where(base > 0, base, np.nan),
        full_weight=4 * one.full_weight,
        sides=None if one.sides is None else np.maximum(one.sides[::2, ::2] // 2, 1),
    )


def _width(one: PageMap) -> int:
    return VALUE_BYTES + (ERROR_BYTES if one.errors is not None else 0)


def _sums(values: Array) -> Array:
    rows, columns = values.shape
    even = np.pad(values, ((0, rows % 2), (0, columns % 2)))
    added: Array = even.reshape(even.shape[0] // 2, 2, even.shape[1] // 2, 2).sum(axis=(1, 3))
    return added
