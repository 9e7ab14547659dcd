"""Aggregations: how radii become maps and numbers of regions. A new one is a class and a line here."""

from dataclasses import fields

from torchcover.coverage.aggregations.aggregation import Aggregation, BinnedStep, Layer, State
from torchcover.coverage.aggregations.maximum import Maximum
from torchcover.coverage.aggregations.means import MeanOfMeans, PooledMean, VisibleArea
from torchcover.coverage.aggregations.quantiles import Quantiles, StepQuantiles

# Those that a metric may have besides the mean of means.
AGGREGATIONS: tuple[type[Aggregation], ...] = (Maximum, Quantiles, StepQuantiles, PooledMean)


def aggregation_named(words: str) -> Aggregation:
    """One of `AGGREGATIONS` by its name, with its levels behind a colon.

    Raises:
        ValueError: There is none of this name; levels that it does not take, or lacks.

    Example:
        >>> aggregation_named("maximum"), aggregation_named("quantiles:0.5,0.9")
        (Maximum(), Quantiles(levels=(0.5, 0.9)))
    """
    name, _, levels = words.partition(":")
    kinds = {kind.name: kind for kind in AGGREGATIONS}
    if name not in kinds:
        raise ValueError(f"aggregation {name}: one of {', '.join(kinds)} is needed")
    kind = kinds[name]
    if not fields(kind):
        if levels:
            raise ValueError(f"aggregation {words}: {name} takes no levels; leave out what is behind the colon")
        return kind()
    try:
        return kind(tuple(map(float, levels.split(","))))  # type: ignore[call-arg]  # each that has a field has levels
    except ValueError as error:
        raise ValueError(f"aggregation {words}: levels are needed, as in {name}:0.5,0.9 ({error})") from error


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
