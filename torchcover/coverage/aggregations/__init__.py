"""Aggregations of radii to maps and numbers of regions. A new aggregation is a class and an entry in `AGGREGATIONS`."""

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

# Aggregations that a metric may have in addition to the mean of means.
AGGREGATIONS: tuple[type[Aggregation], ...] = (Maximum, Quantiles, FrameQuantiles, PooledMean)


def parse_aggregation(text: str) -> Aggregation:
    """Create an aggregation from its name, with its parameters after a colon.

    Args:
        text: Name, or name:parameters, such as "quantiles:0.5,0.9".

    Raises:
        ValueError: No aggregation has this name, or the parameters are invalid or missing.

    Example:
        >>> parse_aggregation("maximum"), parse_aggregation("quantiles:0.5,0.9")
        (Maximum(), Quantiles(levels=(0.5, 0.9)))
    """
    name, _, parameters = text.partition(":")
    classes = {aggregation.name: aggregation for aggregation in AGGREGATIONS}
    if name not in classes:
        forms = [f"{kind.name}:{kind.example}" if kind.example else kind.name for kind in AGGREGATIONS]
        raise ValueError(f"aggregation {name}: one of {' or '.join(forms)} is needed")
    try:
        return classes[name].parse(parameters)
    except ValueError as error:
        raise ValueError(f"aggregation {text}: {error}") from error
