"""An arm of a search: an optimiser, what it was told, and the candidates that others have to beat."""

import numpy as np

from torchcover.placement.evaluation import Evaluation
from torchcover.placement.optimisers import Cube, MakesOptimiser, Optimiser
from torchcover.placement.pareto import chebyshev, non_dominated
from torchcover.placement.racing import Float64, Prefix, gains


class Arm:
    """One of the two that share a budget. The start is evaluation 0 of both.

    An optimiser knows one number. Of several objectives it is told the augmented Chebyshev value, with other random
    weights each time (ParEGO, Knowles 2006).

    Args:
        name: "optimiser" or "random".
        makes: Of the optimiser.
        cube: What is free.
        seed: Of the optimiser, and of the weights.
        start: Evaluation 0, scored at all instants.
    """

    def __init__(self, name: str, makes: MakesOptimiser, cube: Cube, seed: int, start: Evaluation) -> None:
        self.name = name
        self._makes, self._cube, self._seed = makes, cube, seed
        self._optimiser: Optimiser = makes(cube, seed)
        nothing = np.zeros(len(start.prefixes[-1].estimate.quantities))
        self._gains, self._lefts = [nothing], [nothing]
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
    def complete(self) -> list[int]:
        """Positions of the candidates that can be, and were scored at all instants."""
        count = self.evaluations[0].instants
        return [at for at, one in enumerate(self.evaluations) if not one.infeasible and one.instants == count]

    @property
    def front(self) -> list[int]:
        """Positions of those among them that no other beats, in order; with one objective the best, and its equals."""
        complete = self.complete
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
        """What the front scored."""
        return [self.evaluations[at].prefixes for at in self.front]

    def ask(self, number: int) -> Float64 | None:
        """Where to look next, (variables,); None when there is nothing left."""
        return (self._optimiser if len(self._gains[0]) == 1 else self._scalarised(number)).ask()

    def tell(self, evaluation: Evaluation) -> None:
        """What became of it."""
        gain, left = self._estimated(evaluation)
        self.evaluations.append(evaluation)
        self._gains.append(gain)
        self._lefts.append(left)
        if len(gain) == 1 and evaluation.unit is not None:
            self._optimiser.tell(evaluation.unit, float(gain[0]), float(left[0]))

    def against_start(self, at: int) -> tuple[Float64, Float64] | None:
        """Gains of a candidate over the start after the instants that it was given, and errors; None if it has none."""
        prefixes = self.evaluations[at].prefixes
        if not prefixes:
            return None
        return gains(prefixes[-1].estimate, self.evaluations[0].prefixes[len(prefixes) - 1].estimate)

    def _estimated(self, evaluation: Evaluation) -> tuple[Float64, Float64]:
        """Gain over the start at all instants, and the error that those have left which it was not scored at.

        It is paired with the best so far, which a candidate that was dropped late is more like than the start.
        """
        prefixes = evaluation.prefixes
        if evaluation.infeasible or not prefixes:
            return np.full(len(self._gains[0]), np.nan), np.zeros(len(self._gains[0]))
        best = 0 if self.best is None else self.best
        gain, error = gains(prefixes[-1].estimate, self.evaluations[best].prefixes[len(prefixes) - 1].estimate)
        left = 1.0 - evaluation.instants / self.evaluations[0].instants
        return gain + self._gains[best], np.nan_to_num(error * np.sqrt(left))

    def _scalarised(self, number: int) -> Optimiser:
        """A new one, that was told all there is in one number."""
        gains, left = self.gains, self.left
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
