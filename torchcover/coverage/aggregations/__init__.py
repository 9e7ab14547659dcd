"""Aggregations: how radii become maps and numbers of regions. A new one is a class and a line here."""

from torchcover.coverage.aggregations.aggregation import Aggregation as Aggregation
from torchcover.coverage.aggregations.aggregation import BinnedFrame as BinnedFrame
from torchcover.coverage.aggregations.aggregation import Layer as Layer
from torchcover.coverage.aggregations.aggregation import SumState as SumState
from torchcover.coverage.aggregations.maximum import Maximum as Maximum
from torchcover.coverage.aggregations.means import AreaAverage as AreaAverage
from torchcover.coverage.aggregations.means import MeanOfMeans as MeanOfMeans
from torchcover.coverage.aggregations.means import PooledMean as PooledMean
from torchcover.coverage.aggregations.quantiles import FrameQuantiles as FrameQuantiles
from torchcover.coverage.aggregations.quantiles import Quantiles as Quantiles

# Those that a metric may have besides the mean of means.
AGGREGATIONS: tuple[type[Aggregation], ...] = (Maximum, Quantiles, FrameQuantiles, PooledMean)


def parse_aggregation(text: str) -> Aggregation:
    """One of `AGGREGATIONS` by its name, with its parameters behind a colon.

    Raises:
        ValueError: There is none of this name; parameters that it does not take, or lacks.

    Example:
        >>> parse_aggregation("maximum"), parse_aggregation("quantiles:0.5,0.9")
        (Maximum(), Quantiles(levels=(0.5, 0.9)))
    """
    name, _, parameters = text.partition(":")
    kind = next((kind for kind in AGGREGATIONS if kind.name == name), None)
    if kind is None:
        forms = (f"{kind.name}{':' * bool(kind.example)}{kind.example}" for kind in AGGREGATIONS)
        raise ValueError(f"aggregation {name}: one of {' or '.join(forms)} is needed")
    try:
        return kind.parse(parameters)
    except ValueError as error:
        raise ValueError(f"aggregation {text}: {error}") from error
