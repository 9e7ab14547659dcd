"""Aggregations: how radii become maps and numbers of regions. A new one is a class and a line here."""

from torchcover.coverage.aggregations.aggregation import Aggregation as Aggregation
from torchcover.coverage.aggregations.aggregation import BinnedStep as BinnedStep
from torchcover.coverage.aggregations.aggregation import Layer as Layer
from torchcover.coverage.aggregations.aggregation import State as State
from torchcover.coverage.aggregations.maximum import Maximum as Maximum
from torchcover.coverage.aggregations.means import MeanOfMeans as MeanOfMeans
from torchcover.coverage.aggregations.means import PooledMean as PooledMean
from torchcover.coverage.aggregations.means import VisibleArea as VisibleArea
from torchcover.coverage.aggregations.quantiles import Quantiles as Quantiles
from torchcover.coverage.aggregations.quantiles import StepQuantiles as StepQuantiles

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
