"""Aggregations: how radii become maps and numbers of regions. A new one is a class and a line here."""

from torchcover.coverage.aggregations.aggregation import Aggregation, BinnedStep, Layer, State
from torchcover.coverage.aggregations.maximum import Maximum
from torchcover.coverage.aggregations.means import MeanOfMeans, PooledMean, VisibleArea
from torchcover.coverage.aggregations.quantiles import Quantiles, StepQuantiles

# Those that a metric may have besides the mean of means.
AGGREGATIONS: tuple[type[Aggregation], ...] = (Maximum, Quantiles, StepQuantiles, PooledMean)


def aggregation_named(words: str) -> Aggregation:
    """One of `AGGREGATIONS` by its name, with its parameters behind a colon.

    Raises:
        ValueError: There is none of this name; parameters that it does not take, or lacks.

    Example:
        >>> aggregation_named("maximum"), aggregation_named("quantiles:0.5,0.9")
        (Maximum(), Quantiles(levels=(0.5, 0.9)))
    """
    name, _, parameters = words.partition(":")
    kind = next((kind for kind in AGGREGATIONS if kind.name == name), None)
    if kind is None:
        forms = (f"{kind.name}{':' * bool(kind.example)}{kind.example}" for kind in AGGREGATIONS)
        raise ValueError(f"aggregation {name}: one of {' or '.join(forms)} is needed")
    try:
        return kind.parse(parameters)
    except ValueError as error:
        raise ValueError(f"aggregation {words}: {error}") from error


__all__ = [
    "AGGREGATIONS",
    "Aggregation",
    "BinnedStep",
    "Layer",
    "Maximum",
    "MeanOfMeans",
    "PooledMean",
    "Quantiles",
    "State",
    "StepQuantiles",
    "VisibleArea",
    "aggregation_named",
]
