"""The best selection of sensors among candidates, found and proven by HiGHS as a mixed-integer linear program.

A reference point is covered by a selection that has at least one sensor that observes it. Points that the same
candidates observe form a group, and each group is one continuous variable, bounded by the number of selected sensors
that observe it (maximum coverage; Nemhauser, Wolsey and Fisher 1978).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from torchcover.geometry.arrays import Bools, Float64


@dataclass(frozen=True)
class SolverParams:
    """Tolerances and limits of the solver.

    Args:
        tolerance: Shares closer than this are equal, and the price decides: a ten-thousandth of a percentage point.
        sensor_eur: Cost of each sensor besides its price, so that of equal selections the one with fewer is taken.
        cent_eur: Rounding of prices in EUR.
        shortfall_weight: Weight of a missed minimum: it is never traded for the objective.
        secondary_weight: Weight of the other objectives where one is optimized: they decide between equals.
        objective_scale: Factor of the objective; HiGHS stops at 1e-6 of its own units, and a price must be more than that.
        time_limit_s: After this time, HiGHS returns its best selection with a bound.
        bisection_steps: Steps to the selection between the best of several objectives.
    """

    tolerance: float = 1e-6
    sensor_eur: float = 1.0
    cent_eur: float = 0.01
    shortfall_weight: float = 1e4
    secondary_weight: float = 1e-5
    objective_scale: float = 1e3
    time_limit_s: float = 60.0
    bisection_steps: int = 7


PARAMS = SolverParams()


@dataclass(frozen=True)
class SelectionLimits:
    """Limits of a selection.

    Args:
        max_sensors: Number of sensors at most.
        prices_eur: Price of each candidate; empty without prices.
        max_cost_eur: Total price at most.
        compatible: (C, C) whether two candidates may both be selected; all may if not given.
        min_values: Least values of the rows of `CandidateCoverage.worth`; -inf where anything is allowed.
    """

    max_sensors: int
    prices_eur: Sequence[float] = ()
    max_cost_eur: float = np.inf
    compatible: Bools | None = None
    min_values: Sequence[float] | Float64 | None = None

    def compute_price_eur(self, selected: Sequence[int]) -> float:
        """Return the total price of a selection in EUR."""
        return float(sum(self.prices_eur[index] for index in selected)) if self.prices_eur else 0.0

    def can_add(self, selected: Sequence[int], candidate: int) -> bool:
        """Return whether a candidate may be added to a selection, whatever `minimum` is."""
        if len(selected) >= self.max_sensors or candidate in selected:
            return False
        if self.compatible is not None and not all(self.compatible[candidate, index] for index in selected):
            return False
        return self.compute_price_eur([*selected, candidate]) <= self.max_cost_eur + PARAMS.cent_eur / 2


class SensorSelection(NamedTuple):
    """Selected candidates and their value together with the sensors that are always there.

    Args:
        selected: Indices of the candidates, ascending.
        values: Value of each row of `CandidateCoverage.worth`.
        gap: No selection within the limits has an objective that is better by more than this.
        shortfall: Sum of what is missing to `SelectionLimits.minimum`.
    """

    selected: tuple[int, ...]
    values: tuple[float, ...]
    gap: float = np.inf
    shortfall: float = 0.0

    @property
    def is_proven(self) -> bool:
        """Whether no selection is better."""
        return self.gap <= PARAMS.tolerance


@dataclass(frozen=True, eq=False)
class CandidateCoverage:
    """Reference points, grouped by the candidates that observe them.

    Args:
        observes: (G, C) bool, which candidates observe a group; all rows differ.
        group_values: (Q, G) float64, value of the points of each group, one row for each number.
        base_values: (Q,) value of what is observed without any candidate.
    """

    observes: Bools
    group_values: Float64
    base_values: Float64

    @classmethod
    def from_points(cls, point_values: ArrayLike, observed: Sequence[Bools], base_mask: Bools) -> Self:
        """Group points by the candidates that observe them.

        Args:
            point_values: (Q, P) value of each point.
            observed: For each candidate (P,) bool.
            base_mask: (P,) whether a point is observed without any candidate.
        """
        point_values = np.asarray(point_values, dtype=np.float64)
        packed = np.packbits(np.stack(observed), axis=0)  # eight candidates a byte
        used = ~base_mask & packed.any(axis=0) & point_values.any(axis=0)
        groups, group_of = np.unique(packed[:, used].T, axis=0, return_inverse=True)
        sums = [np.bincount(group_of.reshape(-1), row, len(groups)) for row in point_values[:, used]]
        observes = np.unpackbits(groups, axis=1, count=len(observed)).astype(bool)
        return cls(observes, np.stack(sums).astype(np.float64), point_values[:, base_mask].sum(axis=1))

    def compute_values(self, selected: Sequence[int]) -> Float64:
        """Return the (Q,) values of a selection."""
        return self.base_values + self.group_values @ self.observes[:, list(selected)].any(axis=1)

    def compute_failure_effects(self, selected: Sequence[int]) -> Float64:
        """Return the (selected, Q) loss of value when each selected sensor fails."""
        remaining = [[other for other in selected if other != index] for index in selected]
        return np.array([self.compute_values(selected) - self.compute_values(others) for others in remaining])


def select_sensors(
    coverage: CandidateCoverage,
    limits: SelectionLimits,
    weights: Sequence[float] | Float64 = (1.0,),
    *,
    time_limit_s: float = PARAMS.time_limit_s,
) -> SensorSelection:
    """Return the best selection, and of equal ones the cheapest.

    Args:
        coverage: What the candidates observe.
        limits: What a selection must keep to; where none reaches `minimum`, the total shortfall is minimized.
        weights: Weights of the first numbers of `coverage.worth`, whose sum is maximized.
        time_limit_s: After this time HiGHS returns its best selection, with a bound.
    """
    count = coverage.observes.shape[1]
    row_weights = np.zeros(len(coverage.group_values))
    row_weights[: len(weights)] = weights
    minimum = np.resize(-np.inf if limits.min_values is None else limits.min_values, len(coverage.group_values))
    prices = np.array(limits.prices_eur or np.zeros(count)) + PARAMS.sensor_eur
    # No difference in price weighs as much as the tolerance.
    largest = min(float(np.sort(prices)[-limits.max_sensors :].sum()), limits.max_cost_eur + PARAMS.sensor_eur * count)
    costs = PARAMS.tolerance * prices / largest
    selected, gap = _solve(coverage, limits, row_weights, minimum, costs, time_limit_s)
    values = coverage.compute_values(selected)
    return SensorSelection(selected, tuple(values.tolist()), gap, float((minimum - values).clip(0.0).sum()))


def _solve(
    coverage: CandidateCoverage,
    limits: SelectionLimits,
    weights: Float64,
    minimum: Float64,
    costs: Float64,
    time_limit_s: float,
) -> tuple[tuple[int, ...], float]:
    """Solve the program whose variables are candidates (0 or 1), covered shares of groups, and shortfalls.

    Returns:
        Indices of the selected candidates, and the gap to the bound.
    """
    from scipy.optimize import Bounds, LinearConstraint, milp
    from scipy.sparse import csr_array, eye_array, hstack

    (groups, count), bounded = coverage.observes.shape, np.flatnonzero(np.isfinite(minimum))

    def row(candidates: ArrayLike, covered: ArrayLike = 0.0, shortfalls: ArrayLike = 0.0) -> Float64:
        parts = (candidates, count), (covered, groups), (shortfalls, len(bounded))
        return np.concatenate([np.broadcast_to(np.asarray(part, dtype=np.float64), size) for part, size in parts])

    rows, upper = [row(1.0)], [float(limits.max_sensors)]
    if limits.prices_eur and np.isfinite(limits.max_cost_eur):
        rows, upper = [*rows, row(limits.prices_eur)], [*upper, limits.max_cost_eur + PARAMS.cent_eur / 2]
    for clique in () if limits.compatible is None else _incompatible_cliques(limits.compatible):
        rows, upper = [*rows, row(np.isin(range(count), clique))], [*upper, 1.0]
    for position, number in enumerate(bounded):
        rows.append(row(0.0, -coverage.group_values[number], -np.eye(len(bounded))[position]))
        upper.append(coverage.base_values[number] - minimum[number])
    objective = row(-costs, weights @ coverage.group_values, -PARAMS.shortfall_weight)
    observed = hstack(
        [csr_array(-coverage.observes.astype(float)), eye_array(groups), csr_array((groups, len(bounded)))]
    )
    solution = milp(
        -PARAMS.objective_scale * objective,
        integrality=row(1.0),
        bounds=Bounds(0.0, row(1.0, 1.0, np.inf)),
        constraints=[LinearConstraint(observed, ub=0.0), LinearConstraint(csr_array(np.array(rows)), ub=upper)],
        options={"mip_rel_gap": 0.0, "time_limit": time_limit_s},
    )
    if solution.x is None:  # no time for even one selection
        return (), np.inf
    selected = tuple(np.flatnonzero(solution.x[:count] > 0.5).tolist())
    bound = solution.fun if solution.mip_dual_bound is None else solution.mip_dual_bound
    return selected, max((solution.fun - bound) / PARAMS.objective_scale, 0.0)


def _incompatible_cliques(compatible: Bools) -> Iterator[list[int]]:
    """Yield sets of pairwise incompatible candidates that together contain every incompatible pair."""
    remaining = np.triu(~compatible, 1)
    while remaining.any():
        clique = np.argwhere(remaining)[0].tolist()
        for index in range(len(compatible)):
            if index not in clique and not compatible[index, clique].any():
                clique.append(index)
        remaining[np.ix_(clique, clique)] = False
        yield clique


def select_for_objectives(
    coverage: CandidateCoverage, limits: SelectionLimits, num_objectives: int
) -> list[SensorSelection]:
    """Return the best selection of one objective, or of several a compromise and then the best of each.

    The compromise maximizes the smallest objective, each scaled to the span between the best of it and the worst that
    the best selections of the others leave.

    Args:
        coverage: What the candidates observe; the first rows of its `worth` are the objectives.
        limits: What a selection must keep to.
        num_objectives: Number of objectives.
    """
    if num_objectives == 1:
        return [select_sensors(coverage, limits)]
    rows = np.arange(num_objectives)
    ends = [select_sensors(coverage, limits, np.where(rows == row, 1.0, PARAMS.secondary_weight)) for row in rows]
    values = np.array([end.values[:num_objectives] for end in ends])
    low, span = values.min(axis=0), np.ptp(values, axis=0)
    weights = 1.0 / np.where(span > PARAMS.tolerance, span, 1.0)
    minimum = np.resize(-np.inf if limits.min_values is None else limits.min_values, len(coverage.group_values)).astype(
        float
    )
    compromise, share, step = select_sensors(coverage, limits, weights), 0.0, 0.5
    for _ in range(PARAMS.bisection_steps):
        raised = minimum.copy()
        raised[:num_objectives] = np.maximum(raised[:num_objectives], low + (share + step) * span - PARAMS.tolerance)
        selection = select_sensors(coverage, replace(limits, min_values=raised), weights)
        if selection.shortfall <= compromise.shortfall + PARAMS.tolerance:
            compromise, share = selection, share + step
        step /= 2
    return [compromise, *ends]


def sample_selections(
    coverage: CandidateCoverage, limits: SelectionLimits, count: int, seed: int
) -> list[SensorSelection]:
    """Sample selections as a control: candidates in random order, each added if the limits allow it."""
    generator, selections = np.random.default_rng(seed), []
    for _ in range(count):
        selected: list[int] = []
        for index in generator.permutation(coverage.observes.shape[1]).tolist():
            if limits.can_add(selected, index):
                selected.append(index)
        selections.append(SensorSelection(tuple(selected), tuple(coverage.compute_values(selected).tolist())))
    return selections
