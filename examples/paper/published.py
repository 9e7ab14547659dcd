"""Tables 1 and 2 of the paper, and the distance of other numbers from them."""

import csv
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

TABLES = Path(__file__).with_name("tables.csv")
LIDARS = ("grille_128", "roof_128", "roof_64", "roof_32")  # mounting position and number of rows
REGIONS = ("20m", "80m", "160m")
BANDS = ("ground", "obstacle")
QUANTITIES = ("detection_percent", "radius_m")


class TableKey(NamedTuple):
    """Key of a number of the tables: one of `QUANTITIES`, `LIDARS`, `REGIONS` and `BANDS`."""

    quantity: str
    lidar: str
    region: str
    band: str


@lru_cache
def read_published():
    """Read the numbers of both tables.

    Returns:
        `TableKey` -> number. Both tables have the roof LiDAR with 128 rows, so that 60 numbers have 48 keys.

    Raises:
        ValueError: The tables have two different numbers for one key.
    """
    numbers = {}
    with TABLES.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            key, value = TableKey(*(row[name] for name in TableKey._fields)), float(row["value"])
            if numbers.setdefault(key, value) != value:
                raise ValueError(f"{TABLES}: {value} and {numbers[key]} for {' '.join(key)}")
    return numbers


class Score(NamedTuple):
    """Distance of a run from the tables of the paper.

    Args:
        rms_points: Root mean square of the differences of detection, in percentage points.
        radius_factor: exp of the root mean square of log(run / paper) of the radii; 1 if all are equal.
        agreeing_rows: Pairs of LiDARs in one row of a table that have the same order in the run and in the paper.
        row_pairs: Number of such pairs that differ in the paper, at most 6 pairs in each of 12 rows.
        agreeing_pairs: Pairs of any two numbers of one quantity that have the same order in the run and in the paper.
        pairs: Number of such pairs that differ in the paper, at most 552.
        spearman_detection: Spearman's rank correlation of the numbers of detection.
        spearman_radius: Spearman's rank correlation of the radii.
        missing: Numbers that are NaN in the run: then distances and correlations are NaN, and pairs with them do not
            agree.
    """

    rms_points: float
    radius_factor: float
    agreeing_rows: int
    row_pairs: int
    agreeing_pairs: int
    pairs: int
    spearman_detection: float
    spearman_radius: float
    missing: int

    def __str__(self):
        text = (
            f"{self.rms_points:.1f} points and a factor of {self.radius_factor:.2f} from the paper; same order of "
            f"{self.agreeing_rows} of {self.row_pairs} pairs in rows and {self.agreeing_pairs} of {self.pairs} of all; "
            f"Spearman {self.spearman_detection:.3f} (detection), {self.spearman_radius:.3f} (radius)"
        )
        return f"{text}; {self.missing} numbers are missing" if self.missing else text


def compute_score(run, paper):
    """Compare a run with the paper.

    Args:
        run: `TableKey` -> number; NaN where there is none.
        paper: `TableKey` -> number of the paper, with the same keys.
    """
    detection, radius = (_build_arrays(run, paper, quantity) for quantity in QUANTITIES)
    counts = np.add(_count_agreeing_pairs(*detection), _count_agreeing_pairs(*radius)).tolist()
    with np.errstate(divide="ignore"):  # the logarithm of a radius of 0 is -inf
        log_ratio = np.log(radius[0]) - np.log(radius[1])
    return Score(
        _compute_rms(detection[0] - detection[1]),
        float(np.exp(_compute_rms(log_ratio))),
        *counts,
        spearman_detection=_compute_spearman(*detection[:2]),
        spearman_radius=_compute_spearman(*radius[:2]),
        missing=int(np.isnan([*detection[0], *radius[0]]).sum()),
    )


def _build_arrays(run, paper, quantity):
    """Build (N,) numbers of the run, of the paper, and the index of the row of the table."""
    keys = [key for key in paper if key.quantity == quantity]
    _, row = np.unique([f"{key.region} {key.band}" for key in keys], return_inverse=True)
    return np.array([run[key] for key in keys]), np.array([paper[key] for key in keys]), row


def _count_agreeing_pairs(run, paper, row):
    """Count agreeing and all pairs within rows, then agreeing and all pairs."""
    first, second = np.triu_indices(len(paper), k=1)
    order = np.sign(paper[first] - paper[second])
    differs = order != 0
    agrees = (np.sign(run[first] - run[second]) == order) & differs  # NaN is equal to nothing
    in_row = row[first] == row[second]
    return [int(np.count_nonzero(pairs)) for pairs in (agrees & in_row, differs & in_row, agrees, differs)]


def _compute_rms(differences):
    return float(np.sqrt(np.mean(differences**2)))


def _compute_spearman(run, paper):
    """Compute the correlation of ranks; equal numbers share the mean of their ranks."""
    if np.isnan(run).any():
        return float("nan")
    centered = []
    for values in (run, paper):
        ordered = np.sort(values)
        rank = np.searchsorted(ordered, values, "left") + np.searchsorted(ordered, values, "right")
        centered.append(rank - rank.mean())
    scale = np.sqrt(np.prod([np.sum(rank**2) for rank in centered]))
    return float(np.sum(centered[0] * centered[1]) / scale) if scale > 0 else float("nan")
