"""How far some numbers are from the paper's, in a line."""

from typing import NamedTuple

import numpy as np

from examples.paper.published import QUANTITIES


class Score(NamedTuple):
    """Distance to the paper's tables.

    Args:
        points: Root mean square of the differences of detection, in percentage points.
        factor: Radii: exp of the root mean square of log(run / paper). 1 is perfect.
        rows_held: Pairs of LiDARs in the same row of a table whose order is the paper's,
        rows: of so many whose numbers differ in the paper. Four LiDARs make 6 pairs in each of 12 rows.
        pairs_held: Pairs of any two numbers of the same quantity, likewise,
        pairs: of so many. Two quantities with 24 numbers each make 552.
        spearman_detection: Rank correlation of the numbers of detection,
        spearman_radius: and of the radii.
        unknown: Numbers that the run does not know. With any, distances and correlations are NaN, and pairs with an
            unknown number are not held.
    """

    points: float
    factor: float
    rows_held: int
    rows: int
    pairs_held: int
    pairs: int
    spearman_detection: float
    spearman_radius: float
    unknown: int

    def __str__(self):
        text = (
            f"{self.points:.1f} points and a factor of {self.factor:.2f} from the paper; "
            f"{self.rows_held} of {self.rows} orderings within rows hold, {self.pairs_held} of {self.pairs} of all; "
            f"Spearman {self.spearman_detection:.3f} (detection), {self.spearman_radius:.3f} (radius)"
        )
        return f"{text}; {self.unknown} numbers are unknown" if self.unknown else text


def score(run, paper):
    """Compare.

    Args:
        run: `Place` -> number, NaN if it is unknown.
        paper: The same places -> number of the paper.
    """
    detection, radius = (_arrays(run, paper, quantity) for quantity in QUANTITIES)
    orderings = [_orderings(*arrays) for arrays in (detection, radius)]
    rows_held, rows, pairs_held, pairs = map(sum, zip(*orderings, strict=True))
    with np.errstate(divide="ignore"):  # a radius of 0 is infinitely far
        log_ratio = np.log(radius[0]) - np.log(radius[1])
    return Score(
        points=_rms(detection[0] - detection[1]),
        factor=float(np.exp(_rms(log_ratio))),
        rows_held=rows_held,
        rows=rows,
        pairs_held=pairs_held,
        pairs=pairs,
        spearman_detection=_spearman(*detection[:2]),
        spearman_radius=_spearman(*radius[:2]),
        unknown=int(np.isnan([*detection[0], *radius[0]]).sum()),
    )


def _arrays(run, paper, quantity):
    """(N,) numbers of the run, of the paper, and of the row of the table in which they stand."""
    places = [place for place in paper if place.quantity == quantity]
    _, row = np.unique([f"{place.region} {place.height}" for place in places], return_inverse=True)
    return np.array([run[place] for place in places]), np.array([paper[place] for place in places]), row


def _orderings(run, paper, row):
    """Pairs that are held and that there are: in the same row, then all."""
    one, other = np.triu_indices(len(paper), k=1)
    wanted = np.sign(paper[one] - paper[other])
    held = (np.sign(run[one] - run[other]) == wanted) & (wanted != 0)  # NaN is equal to nothing
    same_row = row[one] == row[other]
    return [int(count.sum()) for count in (held & same_row, (wanted != 0) & same_row, held, wanted != 0)]


def _rms(differences):
    return float(np.sqrt(np.mean(differences**2)))


def _spearman(run, paper):
    """Correlation of the ranks; those that are equal share the mean of their ranks."""
    if np.isnan(run).any():
        return float("nan")
    ranks = [np.searchsorted(np.sort(x), x, "left") + np.searchsorted(np.sort(x), x, "right") for x in (run, paper)]
    centred = [rank - rank.mean() for rank in ranks]
    spread = np.sqrt(np.prod([np.sum(rank**2) for rank in centred]))
    return float(np.sum(np.prod(centred, axis=0)) / spread) if spread > 0 else float("nan")
