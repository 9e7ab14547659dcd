"""What papers report of detectors on sensor placements."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Self

import numpy as np

from torchcover.files import read_csv, reads
from torchcover.published.ranks import Array, spearman
from torchcover.simulation import builtin_folder

COLUMNS = ("placement", "quantity", "model", "class")


@dataclass(frozen=True, eq=False)
class Judged:
    """What several judges, detectors or trainings of one, say of the same placements.

    Args:
        name: What they say: "car mAP".
        placements: Names of the n placements.
        judges: Names of the J judges.
        values: (J, n) what each says of each; more is better.

    Raises:
        ValueError: Values of another shape, or that are not finite.

    Example:
        >>> judged = Judged("AP", ("a", "b", "c"), ("net", "other"), np.array([[1.0, 2.0, 3.0], [2.0, 1.0, 3.0]]))
        >>> judged.mean.tolist(), judged.ceiling
        ([1.5, 1.5, 3.0], 0.5)
    """

    name: str
    placements: tuple[str, ...]
    judges: tuple[str, ...]
    values: Array

    def __post_init__(self) -> None:
        if self.values.shape != (len(self.judges), len(self.placements)) or not np.isfinite(self.values).all():
            raise ValueError(
                f"{self.name}: a finite number of each of {len(self.judges)} judges for each of "
                f"{len(self.placements)} placements is needed; got {self.values.shape}"
            )

    @property
    def mean(self) -> Array:
        """(n,) mean over the judges."""
        return np.asarray(self.values.mean(axis=0))

    @property
    def ceiling(self) -> float:
        """Mean Spearman correlation of each two judges: what they agree on; NaN for a single one.

        A metric cannot be expected to follow them more closely than they follow each other.
        """
        pairs = [spearman(self.values[a], self.values[b]) for a, b in combinations(range(len(self.judges)), 2)]
        return float(np.mean(pairs)) if pairs else float("nan")

    def of(self, placements: Sequence[str]) -> Self:
        """Of some of the placements, in another order.

        Raises:
            ValueError: One that they say nothing of.
        """
        if missing := [name for name in placements if name not in self.placements]:
            raise ValueError(f"{self.name}: nothing is known of {', '.join(missing)}")
        columns = [self.placements.index(name) for name in placements]
        return type(self)(self.name, tuple(placements), self.judges, self.values[:, columns])


def published_results(name: str) -> Mapping[tuple[str, str], Judged]:
    """The results of a paper.

    Args:
        name: "place3d_2024" or "li_2024": a file of `datasets/published`, whose README names the tables.

    Returns:
        Quantity and class -> what each network reached on each placement; the class is "" where a number is of all.

    Example:
        >>> cars = published_results("place3d_2024")["map", "car"]
        >>> cars.judges, round(float(cars.mean[0]), 3), round(cars.ceiling, 2)
        (('PointPillars', 'CenterPoint', 'BEVFusion-L', 'FSTR'), 52.525, 0.85)
    """
    return read_results(builtin_folder("published") / f"{name}.csv")


@reads("a table of published results")
def read_results(path: Path) -> Mapping[tuple[str, str], Judged]:
    """The results of a table in CSV with the columns placement, quantity, model, class and value.

    Raises:
        BadFileError: Not such a table, a number that is there twice or missing.
    """
    table = read_csv(path, numbers=("value",), words=COLUMNS)
    found: dict[tuple[str, str], dict[tuple[str, str], float]] = {}
    words = zip(*(table.words[column] for column in COLUMNS), strict=True)
    for (placement, quantity, model, category), value in zip(words, table.numbers["value"].tolist(), strict=True):
        of_kind = found.setdefault((quantity, category), {})
        if (model, placement) in of_kind:
            raise ValueError(f"{quantity} {category} of {model or 'nobody'} on {placement} is there twice")
        of_kind[model, placement] = value
    return {key: _judged(" ".join(key).strip(), values) for key, values in found.items()}


def _judged(name: str, values: Mapping[tuple[str, str], float]) -> Judged:
    judges, placements = (tuple(dict.fromkeys(words)) for words in zip(*values, strict=True))
    missing = [f"{judge} on {place}" for judge in judges for place in placements if (judge, place) not in values]
    if missing:
        raise ValueError(f"{name}: no value of {', '.join(missing)}")
    array = np.array([[values[judge, place] for place in placements] for judge in judges])
    return Judged(name, placements, judges, array)
