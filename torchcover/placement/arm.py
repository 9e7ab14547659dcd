"""An arm of a search: an optimiser, what it was told, and the candidates that others have to beat."""

import numpy as np

from torchcover.placement.evaluation import Evaluation, Float64, Numbers
from torchcover.placement.optimisers import Cube, MakesOptimiser, Optimiser
from torchcover.placement.pareto import chebyshev, non_dominated
from torchcover.placement.racing import paired


class Arm:
    """One of the two that share a budget. The start is evaluation 0 of both.

    An optimiser knows one number. Of several objectives it is told the augmented Chebyshev value, with other random
    weights each time (ParEGO, Knowles 2006).

    Args:
        name: "optimiser" or "random".
        makes: Of the optimiser.
        cube: What is free.
        seed: Of the optimiser, and of the weights.
        start: Evaluation 0.
        world_of: (instants,) which world each instant is of.
    """

    def __init__(
        self, name: str, makes: MakesOptimiser, cube: Cube, seed: int, start: Evaluation, world_of: Numbers
    ) -> None:
        self.name = name
        self._makes, self._cube, self._seed, self._world_of = makes, cube, seed, world_of
        self._start_scores = start.spread(len(world_of))
        self._optimiser: Optimiser = makes(cube, seed)
        self._gains: list[Float64] = [np.zeros(start.scores.shape[1])]
        self._errors: list[Float64] = [np.zeros(start.scores.shape[1])]
        self.evaluations: list[Evaluation] = [start]

    @property
    def objectives(self) -> int:
        """How many."""
        return len(self._gains[0])

    @property
    def charge(self) -> int:
        """What it has spent of a budget, without the start."""
        return sum(evaluation.charge for evaluation in self.evaluations[1:])

    @property
    def instants_spent(self) -> int:
        """Instants that it has scored rigs at, without the start."""
        return sum(len(evaluation.instants) for evaluation in self.evaluations[1:])

    @property
    def gains(self) -> Float64:
        """(evaluations, objectives) over the start; NaN for what cannot be."""
        return np.array(self._gains)

    @property
    def complete(self) -> list[int]:
        """Positions of the candidates that can be, and were scored at all instants."""
        count = len(self._world_of)
        return [at for at, one in enumerate(self.evaluations) if not one.infeasible and len(one.instants) == count]

    @property
    def front(self) -> list[int]:
        """Positions of those among them that no other beats, in order; with one objective the best, and its equals."""
        complete = self.complete
        return [at for at, on in zip(complete, non_dominated(self.gains[complete]), strict=True) if on]

    @property
    def best(self) -> int | None:
        """Position of the one with the largest gain; of several objectives, of the front's middle. None: there is none.

        The middle has the largest Chebyshev value with equal weights, each objective in units of the front's extent.
        """
        front = self.front
        if not front:
            return None
        gains = self.gains[front]
        low, high = gains.min(axis=0), gains.max(axis=0)
        extent = np.where(high > low, high - low, 1.0)
        return front[int(np.argmax(chebyshev((gains - low) / extent, np.full(len(low), 1 / len(low)))))]

    def ask(self, number: int) -> Float64 | None:
        """Where to look next, (variables,); None when there is nothing left.

        Args:
            number: Of the evaluation.
        """
        return (self._optimiser if self.objectives == 1 else self._scalarised(number)).ask()

    def tell(self, evaluation: Evaluation) -> None:
        """What became of it."""
        gain, error = self._gain(evaluation)
        self.evaluations.append(evaluation)
        self._gains.append(gain)
        self._errors.append(error)
        if self.objectives == 1 and evaluation.unit is not None:
            self._optimiser.tell(evaluation.unit, float(gain[0]), float(error[0]))

    def beaten(self, instants: Numbers, scores: Float64) -> bool:
        """Whether the first scores of a candidate show that one of the front is better in every objective.

        Two standard errors over worlds of the paired difference decide.

        Args:
            instants: (n,) numbers.
            scores: (n, objectives) at them.
        """
        for at in self.front:
            other = self.evaluations[at].spread(len(self._world_of))[instants]
            mean, error = paired(scores - other, self._world_of[instants])
            if (mean < -2 * error).all():
                return True
        return False

    def error_of(self, at: int) -> Float64:
        """(objectives,) standard error over worlds of a gain; NaN of one world."""
        evaluation = self.evaluations[at]
        difference = evaluation.scores - self._start_scores[evaluation.instants]
        return paired(difference, self._world_of[evaluation.instants])[1]

    def _gain(self, evaluation: Evaluation) -> tuple[Float64, Float64]:
        """Over the start at all instants, and the error that those have left which it was not scored at.

        It is paired with the best so far, which a candidate that was dropped late is more like than the start.
        """
        if evaluation.infeasible:
            return np.full(self.objectives, np.nan), np.zeros(self.objectives)
        best = self.best
        other = self._start_scores if best is None else self.evaluations[best].spread(len(self._world_of))
        mean, error = paired(evaluation.scores - other[evaluation.instants], self._world_of[evaluation.instants])
        left = 1.0 - len(evaluation.instants) / len(self._world_of)
        gain: Float64 = mean + (0.0 if best is None else self._gains[best])
        return gain, np.nan_to_num(error * np.sqrt(left))

    def _scalarised(self, number: int) -> Optimiser:
        """A new one, that was told all there is in one number."""
        draws = np.random.default_rng([self._seed, number])
        weights = draws.dirichlet(np.ones(self.objectives))
        gains, errors = self.gains, np.array(self._errors)
        known = gains[~np.isnan(gains).any(axis=1)]
        extent = np.ptp(known, axis=0)
        scale = np.where(extent > 0, extent, 1.0)
        values = chebyshev(gains / scale, weights)
        noise = np.linalg.norm(errors / scale * weights, axis=1)
        optimiser = self._makes(self._cube, self._seed)
        for evaluation, value, error in zip(self.evaluations[1:], values[1:], noise[1:], strict=True):
            assert evaluation.unit is not None  # only a start can be outside
            optimiser.tell(evaluation.unit, float(value), float(error))
        return optimiser
