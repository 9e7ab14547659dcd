"""An arm of a search: an optimiser, what it was told, and the candidates that others have to beat."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from torchcover.geometry.arrays import Float64
from torchcover.placement.evaluation import Evaluation
from torchcover.placement.optimisers import Cube, MakesOptimiser, Optimiser
from torchcover.placement.pareto import chebyshev, non_dominated
from torchcover.placement.racing import Prefix, gains

# Of an objective's value at the start, of 1 if that is 0, for each such share that a number which must not be worse has
# lost: so much more than could be gained by it that an optimiser turns away, and no more than it can learn from.
PENALTY = 3.0
# What rounding makes of a difference.
ROUNDING = 1e-9


class Arm:
    """One of the two that share a budget. The start is evaluation 0 of both.

    An optimiser knows one number. Of several objectives, the first numbers of each estimate, it is told the augmented
    Chebyshev value, with other random weights each time (ParEGO, Knowles 2006). `floors` are what all numbers must not
    be worse than; NaN for anything.
    """

    def __init__(
        self, name: str, makes: MakesOptimiser, cube: Cube, seed: int, start: Evaluation, objectives: int,
        floors: Float64,
    ) -> None:  # fmt: skip
        self.name, self._objectives, self._floors = name, objectives, floors
        self._lower = [quantity.lower_is_better for quantity in start.prefixes[-1].estimate.quantities]
        self._makes, self._cube, self._seed = makes, cube, seed
        self._optimiser: Optimiser = makes(cube, seed)
        scale = np.abs(start.prefixes[-1].estimate.value.numpy())
        self._scale = np.where(scale > ROUNDING, scale, 1.0)
        nothing = np.zeros(objectives)
        self._gains, self._lefts, self._lacks = [nothing], [nothing], [self._lacking(start)]
        self.evaluations: list[Evaluation] = [start]

    @property
    def charge(self) -> int:
        """What it has spent of a budget, without the start."""
        return sum(evaluation.charge for evaluation in self.evaluations[1:])

    @property
    def gains(self) -> Float64:
        """(evaluations, objectives) better than the start by, in the objectives' units; NaN for what cannot be."""
        return np.array(self._gains)

    @property
    def left(self) -> Float64:
        """(evaluations, objectives) standard errors of the gains that instants left out have left."""
        return np.array(self._lefts)

    @property
    def lacks(self) -> Float64:
        """(evaluations,) what they lack of what must be kept, in all, each as a share of that."""
        return np.array([sum(each.values()) for each in self._lacks], dtype=np.float64)

    @property
    def least_lack(self) -> float:
        """What the front lacks; inf if nothing can be yet."""
        return min(self.lacks[self.complete], default=math.inf)

    def lacking(self, at: int) -> Mapping[str, float]:
        """What it is that a candidate lacks, by name."""
        return self._lacks[at]

    @property
    def complete(self) -> list[int]:
        """Positions of the candidates that can be, and were scored at all instants."""
        count = self.evaluations[0].instants
        return [at for at, one in enumerate(self.evaluations) if not one.infeasible and one.instants == count]

    @property
    def front(self) -> list[int]:
        """Positions of those among them that no other beats, in order; with one objective the best, and its equals.

        Only of those that lack nothing; if there is none, of those that lack the least.
        """
        lacks = self.lacks[self.complete]
        complete = [at for at, lack in zip(self.complete, lacks, strict=True) if lack <= lacks.min()]
        return [at for at, on in zip(complete, non_dominated(self.gains[complete]).tolist(), strict=True) if on]

    @property
    def best(self) -> int | None:
        """Position of the one with the largest gain; of several objectives, of the front's middle. None: there is none.

        The middle has the largest Chebyshev value with equal weights, each objective in units of the front's extent;
        it is not the start, if anything else is on the front.
        """
        front, several = self.front, len(self._gains[0]) > 1
        if not front:
            return None
        gains = self.gains[front]
        low, extent = gains.min(axis=0), np.ptp(gains, axis=0)
        front = [at for at in front if at] or front if several else front
        scaled = (self.gains[front] - low) / np.where(extent > 0, extent, 1.0)
        return front[int(np.argmax(chebyshev(scaled, np.full(len(low), 1 / len(low)))))]

    @property
    def incumbents(self) -> list[tuple[Prefix, ...]]:
        """What the front scored; nothing if it lacks anything, as what lacks less may gain less."""
        return [] if self.least_lack else [self.evaluations[at].prefixes for at in self.front]

    def ask(self, number: int) -> Float64 | None:
        """Where to look next, (variables,); None when there is nothing left."""
        return (self._optimiser if len(self._gains[0]) == 1 else self._scalarised(number)).ask()

    def tell(self, evaluation: Evaluation) -> None:
        """What became of it."""
        gain, left = self._estimated(evaluation)
        self._lacks.append(self._lacking(evaluation))
        self.evaluations.append(evaluation)
        self._gains.append(gain)
        self._lefts.append(left)
        if len(gain) == 1 and evaluation.unit is not None:
            self._optimiser.tell(evaluation.unit, float(self._told()[-1, 0]), float(left[0]))

    def against_start(self, at: int) -> tuple[Float64, Float64] | None:
        """Gains of a candidate over the start after the instants that it was given, and errors; None if it has none."""
        prefixes = self.evaluations[at].prefixes
        if not prefixes:
            return None
        found = gains(prefixes[-1].estimate, self.evaluations[0].prefixes[len(prefixes) - 1].estimate)
        return found[0][: self._objectives], found[1][: self._objectives]

    def is_worse(self, prefixes: Sequence[Prefix], errors: float) -> bool:
        """Whether a number that must not be worse than at the start is so by some errors, after as many instants."""
        start = self.evaluations[0].prefixes
        gain, error = gains(prefixes[-1].estimate, start[len(prefixes) - 1].estimate)
        kept = start[-1].estimate.value.numpy() == self._floors
        return bool((gain < -errors * error)[kept].any())

    def may_lead(self, prefixes: Sequence[Prefix]) -> bool:
        """Whether all others lack something; or of a rig that was scored at all instants, whether no other beats it."""
        if self.least_lack or prefixes[-1].instants < self.evaluations[0].instants:
            return self.least_lack > 0
        gain = gains(prefixes[-1].estimate, self.evaluations[0].prefixes[-1].estimate)[0]
        return not (self.gains[self.front] >= gain[: self._objectives]).all(axis=1).any()

    def _told(self) -> Float64:
        """(evaluations, objectives) what optimisers are told of: gains, less what the lacks cost."""
        return np.asarray(self.gains - PENALTY * self._scale[: self._objectives] * self.lacks[:, None])

    def _lacking(self, evaluation: Evaluation) -> Mapping[str, float]:
        prefixes = evaluation.prefixes
        if not prefixes:
            return {}
        value = prefixes[-1].estimate.value.numpy()
        if evaluation.number and evaluation.instants < self.evaluations[0].instants:
            # As good as its difference to the start promises.
            value = value - self.evaluations[0].prefixes[len(prefixes) - 1].estimate.value.numpy()
            value = value + self.evaluations[0].prefixes[-1].estimate.value.numpy()
        lost = np.where(self._lower, value - self._floors, self._floors - value) / np.abs(self._floors).clip(ROUNDING)
        lost[np.isnan(lost) & ~np.isnan(self._floors)] = 1.0  # what is unknown is all lost
        lacks = dict(zip((one.key for one in prefixes[-1].estimate.quantities), lost.tolist(), strict=True))
        return {name: share for name, share in lacks.items() if share > ROUNDING} | dict(evaluation.lacks)

    def _estimated(self, evaluation: Evaluation) -> tuple[Float64, Float64]:
        """Gain over the start at all instants, and the error that those have left which it was not scored at.

        It is paired with the best so far, which a candidate that was dropped late is more like than the start.
        """
        prefixes = evaluation.prefixes
        if evaluation.infeasible or not prefixes:
            return np.full(self._objectives, np.nan), np.zeros(self._objectives)
        best = 0 if self.best is None else self.best
        gain, error = gains(prefixes[-1].estimate, self.evaluations[best].prefixes[len(prefixes) - 1].estimate)
        gain, error = gain[: self._objectives], error[: self._objectives]
        left = 1.0 - evaluation.instants / self.evaluations[0].instants
        return gain + self._gains[best], np.nan_to_num(error * np.sqrt(left))

    def _scalarised(self, number: int) -> Optimiser:
        """A new one, that was told all there is in one number."""
        gains, left = self._told(), self.left
        weights = np.random.default_rng([self._seed, number]).dirichlet(np.ones(gains.shape[1]))
        extent = np.ptp(gains[~np.isnan(gains).any(axis=1)], axis=0)
        scale = np.where(extent > 0, extent, 1.0)
        values = chebyshev(gains / scale, weights)
        noise = np.linalg.norm(left / scale * weights, axis=1)
        optimiser = self._makes(self._cube, self._seed)
        for evaluation, value, error in zip(self.evaluations, values, noise, strict=True):
            if evaluation.number and evaluation.unit is not None:
                optimiser.tell(evaluation.unit, float(value), float(error))
        return optimiser
