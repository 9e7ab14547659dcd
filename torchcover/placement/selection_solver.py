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
        tolerance: Shares that differ by less are equal, and the price decides: a ten-thousandth of a percentage point.
        sensor_eur: Additional cost of each sensor in EUR, so that fewer sensors win among equal selections.
        shortfall_weight: Weight of the shortfall below a minimum, so large that it is never traded for the objective.
        secondary_weight: Weight of the other objectives when one is optimized, so small that they decide only ties.
        objective_scale: Factor of the objective, which raises price differences above the tolerance of HiGHS, 1e-6.
        time_limit_s: Time in seconds after which HiGHS returns its best selection with a bound.
        bisection_steps: Number of bisection steps of the compromise between several objectives.
    """

    tolerance: float = 1e-6
    sensor_eur: float = 1.0
    shortfall_weight: float = 1e4
    secondary_weight: float = 1e-5
    objective_scale: float = 1e3
    time_limit_s: float = 60.0
    bisection_steps: int = 7


@dataclass(frozen=True)
class SelectionLimits:
    """Limits of a selection.

    Args:
        max_sensors: Maximum number of sensors.
        prices_eur: Price of each candidate in EUR; empty without prices.
        max_cost_eur: Maximum total price in EUR.
        compatible: (C, C) bool, whether two candidates may both be selected; None allows all pairs.
        min_values: Minimum value of each row of `CandidateCoverage.group_values`; -inf without a minimum.
    """

    max_sensors: int
    prices_eur: Sequence[float] = ()
    max_cost_eur: float = np.inf
    compatible: Bools | None = None
    min_values: Sequence[float] | Float64 | None = None

    @property
    def rounded_max_cost_eur(self) -> float:
        """Maximum total price plus half a cent, which absorbs rounding errors of sums."""
        return self.max_cost_eur + 0.005

    def compute_price_eur(self, selected: Sequence[int]) -> float:
        """Compute the total price of a selection in EUR; 0 without prices.

        Args:
            selected: Indices of the candidates.
        """
        return float(sum(self.prices_eur[index] for index in selected)) if self.prices_eur else 0.0

    def can_add(self, selected: Sequence[int], candidate: int) -> bool:
        """Return whether a candidate may be added to a selection; minimum values are not checked.

        Args:
            selected: Indices of the selected candidates.
            candidate: Index of the candidate to add.
        """
        if len(selected) >= self.max_sensors or candidate in selected:
            return False
        if self.compatible is not None and not self.compatible[candidate, list(selected)].all():
            return False
        return self.compute_price_eur([*selected, candidate]) <= self.rounded_max_cost_eur

    def get_minimum(self, count: int) -> Float64:
        """Return the minimum values; -inf where there is none.

        Args:
            count: Number of rows of `CandidateCoverage.group_values`.
        """
        return np.resize(-np.inf if self.min_values is None else self.min_values, count).astype(np.float64)


class SensorSelection(NamedTuple):
    """Selected candidates and their value together with the fixed sensors.

    Args:
        selected: Indices of the candidates, ascending.
        values: Value of each row of `CandidateCoverage.group_values`.
        gap: Upper bound of the improvement that any other selection within the limits has in the objective.
        shortfall: Sum of the shortfalls below `SelectionLimits.min_values`.
    """

    selected: tuple[int, ...]
    values: tuple[float, ...]
    gap: float = np.inf
    shortfall: float = 0.0

    @property
    def is_proven(self) -> bool:
        """True if no selection is better."""
        return self.gap <= SolverParams.tolerance


@dataclass(frozen=True, eq=False)
class CandidateCoverage:
    """Reference points, grouped by the candidates that observe them.

    Args:
        observes: (G, C) bool, whether a candidate observes a group; all rows differ.
        group_values: (Q, G) float64, value of the points of each group, one row for each number.
        base_values: (Q,) float64, value of the points that the fixed sensors observe.
    """

    observes: Bools
    group_values: Float64
    base_values: Float64

    @classmethod
    def from_points(cls, point_values: ArrayLike, observed: Sequence[Bools], base_mask: Bools) -> Self:
        """Group points by the candidates that observe them.

        Args:
            point_values: (Q, P) value of each point, one row for each number.
            observed: For each candidate (P,) bool, whether it observes a point.
            base_mask: (P,) bool, whether the fixed sensors observe a point.
        """
        point_values = np.asarray(point_values, dtype=np.float64)
        packed = np.packbits(np.stack(observed), axis=0)  # eight candidates per byte
        is_relevant = ~base_mask & packed.any(axis=0) & point_values.any(axis=0)
        groups, group_index = np.unique(packed[:, is_relevant].T, axis=0, return_inverse=True)
        sums = [np.bincount(group_index.reshape(-1), row, len(groups)) for row in point_values[:, is_relevant]]
        observes = np.unpackbits(groups, axis=1, count=len(observed)).astype(bool)
        return cls(observes, np.stack(sums).astype(np.float64), point_values[:, base_mask].sum(axis=1))

    def compute_values(self, selected: Sequence[int]) -> Float64:
        """Compute the values of a selection together with the fixed sensors.

        Args:
            selected: Indices of the candidates.

        Returns:
            (Q,) float64.
        """
        return self.base_values + self.group_values @ self.observes[:, list(selected)].any(axis=1)

    def compute_failure_effects(self, selected: Sequence[int]) -> Float64:
        """Compute the loss of value when each selected sensor fails.

        Args:
            selected: Indices of the candidates.

        Returns:
            (len(selected), Q) float64.
        """
        values = self.compute_values(selected)
        effects = []
        for failed in selected:
            effects.append(values - self.compute_values([index for index in selected if index != failed]))
        return np.array(effects)


def select_sensors(
    coverage: CandidateCoverage,
    limits: SelectionLimits,
    weights: Sequence[float] | Float64 = (1.0,),
    params: SolverParams = SolverParams(),
) -> SensorSelection:
    """Find the best selection, and the cheapest among equal ones.

    Args:
        coverage: Coverage of the candidates.
        limits: Limits of the selection; if none reaches `min_values`, the total shortfall is minimized.
        weights: Weights of the first rows of `coverage.group_values`, whose sum is maximized.
        params: Tolerances and time limit.
    """
    count = coverage.observes.shape[1]
    row_weights = np.zeros(len(coverage.group_values))
    row_weights[: len(weights)] = weights
    minimum = limits.get_minimum(len(coverage.group_values))
    prices = np.array(limits.prices_eur or np.zeros(count)) + params.sensor_eur
    # Costs are scaled so that the highest possible total cost equals the tolerance of values.
    highest_cost_eur = float(np.sort(prices)[-limits.max_sensors :].sum())
    highest_cost_eur = min(highest_cost_eur, limits.max_cost_eur + params.sensor_eur * count)
    costs = params.tolerance * prices / highest_cost_eur
    selected, gap = _solve(coverage, limits, row_weights, minimum, costs, params)
    values = coverage.compute_values(selected)
    return SensorSelection(selected, tuple(values.tolist()), gap, float((minimum - values).clip(0.0).sum()))


def _solve(
    coverage: CandidateCoverage,
    limits: SelectionLimits,
    weights: Float64,
    minimum: Float64,
    costs: Float64,
    params: SolverParams,
) -> tuple[tuple[int, ...], float]:
    """Solve the program whose variables are candidates (0 or 1), covered shares of groups, and shortfalls.

    Returns:
        Indices of the selected candidates, and the gap to the bound.
    """
    from scipy.optimize import Bounds, LinearConstraint, milp
    from scipy.sparse import csr_array, eye_array, hstack

    group_count, count = coverage.observes.shape
    bounded = np.flatnonzero(np.isfinite(minimum))

    def build_row(candidates: ArrayLike, covered: ArrayLike = 0.0, shortfalls: ArrayLike = 0.0) -> Float64:
        """Build a row of the constraint matrix from coefficients of candidates, groups and shortfalls."""
        parts = (candidates, count), (covered, group_count), (shortfalls, len(bounded))
        return np.concatenate([np.broadcast_to(np.asarray(part, dtype=np.float64), size) for part, size in parts])

    rows, upper = [build_row(1.0)], [float(limits.max_sensors)]
    if limits.prices_eur and np.isfinite(limits.max_cost_eur):
        rows.append(build_row(limits.prices_eur))
        upper.append(limits.rounded_max_cost_eur)
    for clique in () if limits.compatible is None else _find_incompatible_cliques(limits.compatible):
        rows.append(build_row(np.isin(range(count), clique)))
        upper.append(1.0)
    for position, number in enumerate(bounded):
        rows.append(build_row(0.0, -coverage.group_values[number], -np.eye(len(bounded))[position]))
        upper.append(coverage.base_values[number] - minimum[number])
    objective = build_row(-costs, weights @ coverage.group_values, -params.shortfall_weight)
    observed = hstack(
        [csr_array(-coverage.observes.astype(float)), eye_array(group_count), csr_array((group_count, len(bounded)))]
    )
    solution = milp(
        -params.objective_scale * objective,
        integrality=build_row(1.0),
        bounds=Bounds(0.0, build_row(1.0, 1.0, np.inf)),
        constraints=[LinearConstraint(observed, ub=0.0), LinearConstraint(csr_array(np.array(rows)), ub=upper)],
        options={"mip_rel_gap": 0.0, "time_limit": params.time_limit_s},
    )
    if solution.x is None:  # the time limit was too short for any selection
        return (), np.inf
    selected = tuple(np.flatnonzero(solution.x[:count] > 0.5).tolist())
    bound = solution.fun if solution.mip_dual_bound is None else solution.mip_dual_bound
    return selected, max((solution.fun - bound) / params.objective_scale, 0.0)


def _find_incompatible_cliques(compatible: Bools) -> Iterator[list[int]]:
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
    coverage: CandidateCoverage,
    limits: SelectionLimits,
    num_objectives: int,
    params: SolverParams = SolverParams(),
) -> list[SensorSelection]:
    """Find the best selection of one objective, or of several a compromise and then the best of each.

    The compromise maximizes the smallest objective. Each objective is scaled to the range from the worst value among
    the best selections of the others to its best value.

    Args:
        coverage: Coverage of the candidates; the first rows of its `group_values` are the objectives.
        limits: Limits of a selection.
        num_objectives: Number of objectives.
        params: Tolerances and time limit.
    """
    if num_objectives == 1:
        return [select_sensors(coverage, limits, params=params)]
    rows = np.arange(num_objectives)
    best = []
    for row in rows:
        weights = np.where(rows == row, 1.0, params.secondary_weight)
        best.append(select_sensors(coverage, limits, weights, params))
    values = np.array([selection.values[:num_objectives] for selection in best])
    low, span = values.min(axis=0), np.ptp(values, axis=0)
    weights = 1.0 / np.where(span > params.tolerance, span, 1.0)
    minimum = limits.get_minimum(len(coverage.group_values))
    compromise, fraction, step = select_sensors(coverage, limits, weights, params), 0.0, 0.5
    for _ in range(params.bisection_steps):
        raised = minimum.copy()
        raised_objectives = low + (fraction + step) * span - params.tolerance
        raised[:num_objectives] = np.maximum(raised[:num_objectives], raised_objectives)
        selection = select_sensors(coverage, replace(limits, min_values=raised), weights, params)
        if selection.shortfall <= compromise.shortfall + params.tolerance:
            compromise, fraction = selection, fraction + step
        step /= 2
    return [compromise, *best]


def sample_selections(
    coverage: CandidateCoverage, limits: SelectionLimits, count: int, seed: int
) -> list[SensorSelection]:
    """Sample selections as a control: candidates in random order, each added if the limits allow it.

    Args:
        coverage: Coverage of the candidates.
        limits: Limits of a selection.
        count: Number of selections.
        seed: Seed of the random order.
    """
    generator, selections = np.random.default_rng(seed), []
    for _ in range(count):
        selected: list[int] = []
        for index in generator.permutation(coverage.observes.shape[1]).tolist():
            if limits.can_add(selected, index):
                selected.append(index)
        selections.append(SensorSelection(tuple(selected), tuple(coverage.compute_values(selected).tolist())))
    return selections
