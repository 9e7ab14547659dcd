"""Single numbers of a coverage by their column name in `summary.csv`."""

from collections.abc import Callable
from dataclasses import replace
from difflib import get_close_matches

from torchcover.coverage.quantities import make_cells_quantity
from torchcover.coverage.regions import Region
from torchcover.coverage.result import Coverage
from torchcover.estimation import Estimate, Quantity

Estimator = Callable[[Region, str], Estimate]


def estimate_number(coverage: Coverage, quantity_key: str, region: Region, band: str) -> Estimate:
    """Estimate a single number by its column name in `summary.csv`.

    Args:
        coverage: Result of a metric.
        quantity_key: "radius_m" or "detection_0.4m"; "cells_detection_0.4m" over observed cells in a result by area;
            "radius_maximum_m" of an aggregation; "radius_m_without_roof" and "detected_by_two_0.4m" of redundancy.
        region: Region within the grid.
        band: Name of the height band.

    Raises:
        ValueError: The number does not exist, or as in `Coverage.estimate`.
    """
    for quantities, estimate in _list_estimators(coverage):
        for index, quantity in enumerate(quantities):
            if quantity.key == quantity_key:
                return replace(estimate(region, band)[index : index + 1], quantities=(quantity,))
    available = list_number_keys(coverage)
    suggestions = get_close_matches(quantity_key, available, n=1) or available
    raise ValueError(f"{quantity_key}: the result has no such number; it has {', '.join(suggestions)}")


def list_number_keys(coverage: Coverage) -> list[str]:
    """List the keys of all numbers that `estimate_number` can estimate, each once.

    Args:
        coverage: Result of a metric.
    """
    keys: dict[str, None] = {}
    for quantities, _ in _list_estimators(coverage):
        keys |= dict.fromkeys(quantity.key for quantity in quantities)
    return list(keys)


def _list_estimators(coverage: Coverage) -> list[tuple[tuple[Quantity, ...], Estimator]]:
    """List the methods that estimate numbers, with the quantities of their results."""
    means = coverage.quantities
    estimators: list[tuple[tuple[Quantity, ...], Estimator]] = [(means, coverage.estimate)]
    if coverage.aggregated_numbers is not None:
        estimators.append((coverage.aggregated_numbers.quantities, coverage.estimate_aggregated))
    if coverage.average == "area":
        estimators.append((tuple(make_cells_quantity(quantity) for quantity in means), coverage.paper_mean))
    if coverage.redundancy is not None:
        estimators.append(((*means, *coverage.redundancy.quantities), coverage.estimate_redundancy))
    return estimators
