"""Expected improvement on a Gaussian process: for a few free numbers, and values that cost seconds."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product

import numpy as np
import torch
from torch import Tensor

from torchcover.placement.optimisers.gp_model import GaussianProcess
from torchcover.placement.optimisers.optimiser import Cube, Unit

# Places that are looked at before the first model, at least; one more for every variable.
FIRST = 3
# Of more values, the model has the highest and the last: it costs their third power.
HIGHEST, LAST = 200, 600
SCATTERED, KEPT, AROUND, ROUNDS = 512, 8, 32, 4
FIRST_WIDTH, OTHER_OPTION = 0.1, 0.2
# Of choices. Beyond, a list of all of them would take longer to rank than to scatter places.
MOST_COMBINATIONS = 4096
# How many more values there are when the hyperparameters are learnt again.
GROWTH = 1.2
# From the median down, in units of what the best is above it.
FAR_DOWN = 2.0
# Below, φ(z) + z Φ(z) is φ(z) / z² to five digits, and a difference of the two has none left.
FAR_BELOW = -500.0


class GaussianProcessSearch:
    """Looks where the expected improvement over the best mean so far is largest (Jones et al. 1998).

    Its noise is the squared error that it is told, and a little that it learns. A place where no rig can be counts as
    the lowest value so far, so that little is expected nearby. Where all are choices, each combination comes once.

    `seed`: of the first places and of where improvement is looked for.

    Example:
        >>> search = GaussianProcessSearch(Cube(levels=(0,), start=np.array([0.0])), seed=0)
        >>> for _ in range(12):
        ...     search.tell(unit := search.ask(), -float((unit[0] - 0.3) ** 2) + 0.09, 0.0)
        >>> bool(abs(search.ask()[0] - 0.3) < 0.1)
        True
    """

    def __init__(self, cube: Cube, seed: int) -> None:
        self._cube, self._seed = cube, seed
        self._places: list[Unit] = []
        self._values: list[float] = []
        self._errors: list[float] = []
        self._like: tuple[int, GaussianProcess] | None = None
        if cube.start is not None:
            self._note(cube.snapped(cube.start), 0.0, 0.0)
        self._before = len(self._places)

    def tell(self, unit: Unit, value: float, error: float) -> None:
        """A value more for the model."""
        self._note(unit, value, error)

    def ask(self) -> Unit | None:
        """The place of the largest expected improvement; scattered places first; None when there is none left."""
        turn, width = len(self._places) - self._before, len(self._cube.levels)
        known = np.isfinite(self._values)
        if turn < FIRST + width or not known.any():
            scattered = self._scattered(turn + 1, self._seed)
            left = self._untried(np.vstack([scattered[-1:], self._anywhere(self._seed)]))
            return left[0] if len(left) else None
        with _one_thread(), torch.no_grad():
            return self._best(turn)

    def model(self) -> GaussianProcess | None:
        """What it has learnt; None before the first value. Where no rig can be, the lowest value stands."""
        if not np.isfinite(self._values).any():
            return None
        # To learn the hyperparameters takes most of the time; they hardly change before there is a fifth more to know.
        steps = math.floor(math.log(len(self._values)) / math.log(GROWTH) + 1e-9)
        first = max(math.ceil(GROWTH**steps - 1e-9), int(np.flatnonzero(np.isfinite(self._values))[0]) + 1)
        if self._like is None or self._like[0] != first:
            self._like = first, self._fitted(min(first, len(self._values)), None)
        return self._fitted(len(self._values), self._like[1])

    def _fitted(self, count: int, like: GaussianProcess | None) -> GaussianProcess:
        """Of the first values."""
        values = np.array(self._values[:count])
        values = np.where(np.isnan(values), np.nanmin(values), values)
        # How bad the worst are tells nothing of where the best is, but would be most of what is learnt.
        values = values.clip(np.median(values) - FAR_DOWN * (values.max() - np.median(values)))
        kept = np.union1d(np.argsort(-values, kind="stable")[:HIGHEST], np.arange(len(values))[-LAST:])
        places, errors = (torch.from_numpy(np.array(told)[kept]) for told in (self._places, self._errors))
        with _one_thread():
            return GaussianProcess.fitted(self._cube.levels, places, torch.from_numpy(values[kept]), errors, like)

    def _note(self, unit: Unit, value: float, error: float) -> None:
        self._places.append(np.asarray(unit, dtype=np.float64))
        self._values.append(float(value))
        self._errors.append(float(error) if math.isfinite(error) else 0.0)

    def _scattered(self, count: int, seed: int) -> Unit:
        sobol = torch.quasirandom.SobolEngine(  # type: ignore[no-untyped-call]
            len(self._cube.levels), scramble=True, seed=seed
        )
        return self._cube.snapped(sobol.draw(count, dtype=torch.float64).numpy())

    def _anywhere(self, seed: int) -> Unit:
        """Places all over the cube; of choices all combinations, unless they are very many."""
        count, levels = self._cube.combinations, self._cube.levels
        if count is None or count > MOST_COMBINATIONS:
            return self._scattered(SCATTERED, seed)
        options = (tuple((option + 0.5) / level for option in range(level)) for level in levels)
        every = np.array(list(product(*options)), dtype=np.float64).reshape(count, len(levels))
        return self._cube.snapped(np.random.default_rng(seed).permutation(every))

    def _best(self, turn: int) -> Unit | None:
        model = self.model()
        assert model is not None  # there are values
        means, _ = model.predict(model.places)
        best = float(means.max())
        draws = np.random.default_rng([self._seed, turn])
        tops = model.places[means.argsort(descending=True)[:KEPT]].numpy()
        places = np.vstack([self._anywhere(int(draws.integers(2**31))), self._around(tops, 0, draws)])
        for again in range(ROUNDS + 1):
            places = self._untried(places)
            if not len(places):
                return None
            worth = log_expected_improvement(*model.predict(torch.from_numpy(places)), best, model.scale)
            places = places[worth.argsort(descending=True, stable=True)[:KEPT].numpy()]
            if again < ROUNDS:
                places = np.vstack([places, self._around(places, again, draws)])
        return np.asarray(places[0])

    def _around(self, places: Unit, narrower: int, draws: np.random.Generator) -> Unit:
        """Places near others; some with another option."""
        near = np.repeat(places, AROUND, axis=0)
        moved = near + draws.normal(0.0, FIRST_WIDTH * 0.4**narrower, near.shape)
        other = draws.random(near.shape)
        is_choice, changes = np.array(self._cube.levels) > 0, draws.random(near.shape) < OTHER_OPTION
        return self._cube.snapped(np.where(is_choice, np.where(changes, other, near), moved))

    def _untried(self, places: Unit) -> Unit:
        """Those that nothing is known of, each once; their order stays."""
        tried = {tuple(place) for place in self._places}
        return np.array([place for place in dict.fromkeys(map(tuple, places)) if place not in tried])


def log_expected_improvement(mean: Tensor, deviation: Tensor, best: float, scale: float) -> Tensor:
    """The logarithm of E[max(f - best, 0)] / scale for normally distributed f, without underflow (Ament et al. 2023).

    Means and deviations are (m,); deviations below a trillionth of the scale count as that.
    """
    deviation = (deviation / scale).clamp_min(1e-12)
    z = (mean - best) / scale / deviation
    above = z.clamp_min(-1.0)
    usual = (torch.exp(-0.5 * above.square()) / math.sqrt(2 * math.pi) + above * torch.special.ndtr(above)).log()
    below = z.clamp(FAR_BELOW, 0.0)
    rest = torch.log1p(below * math.sqrt(math.pi / 2) * torch.special.erfcx(-below / math.sqrt(2)))
    rest = torch.where(z < FAR_BELOW, -2.0 * z.clamp_max(FAR_BELOW).neg().log(), rest)
    tail = rest - 0.5 * z.square() - 0.5 * math.log(2 * math.pi)
    return deviation.log() + torch.where(z > -1.0, usual, tail)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Matrices are small, and sums of several threads would depend on their number."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
