"""The pictures of a search."""

from collections.abc import Iterator

import numpy as np
import torch
from matplotlib.figure import Figure

from torchcover.geometry.arrays import Float64
from torchcover.placement.arm import Arm
from torchcover.placement.evaluation import Evaluation
from torchcover.placement.fresh import unit_words
from torchcover.placement.optimisers.gp_model import GaussianProcess
from torchcover.placement.pareto import hypervolume
from torchcover.placement.plan import levels_of
from torchcover.placement.search import PlacementSearch
from torchcover.placement.variables import FreeChoice
from torchcover.report import Slice, draw_fronts, draw_progress, draw_slices
from torchcover.report.wording import shown_unit

PLACES = 65
# Beyond, a picture would take longer than the search.
MOST_VALUES, MOST_SLICES = 1000, 12


def search_pictures(search: PlacementSearch, best: Evaluation | None) -> Iterator[tuple[str, str, Figure]]:
    """How the search went, what each variable does to each objective, and what objectives cost each other.

    Each is the stem of its file, what it shows, and a figure of its own, outside pyplot.
    """
    names, title = list(search.space.objectives), search.space.name
    quantities = search.evaluations[0].prefixes[-1].estimate.quantities[: len(names)]
    factors = np.array([shown_unit(each.unit).factor for each in quantities])
    labels = [f"gain in {each.key} ({unit_words(each.unit)})" for each in quantities]
    lines = {name: _progress(arm, search, factors) for name, arm in search.arms.items()}
    yield (
        "progress",
        "The best so far over the instants spent, by both arms",
        draw_progress(lines, label=labels[0] if len(names) == 1 else "hypervolume of the front", title=title),
    )
    for at, name in enumerate(names):
        slices = _slices(search, best, at, float(factors[at]))
        if slices:
            stem = "objective" if len(names) == 1 else f"objective_{at + 1}"
            what = f"Gain in {name} over each variable, with the others as they are in the best"
            yield stem, what, draw_slices(slices, label=labels[at], title=title)
    if len(names) > 1:
        every = {name: factors * arm.gains[arm.complete] for name, arm in search.arms.items()}
        fronts = {name: factors * arm.gains[arm.front] for name, arm in search.arms.items()}
        yield "pareto", "What objectives cost each other", draw_fronts(labels, every, fronts, title=title)


def _progress(arm: Arm, search: PlacementSearch, factors: Float64) -> Float64:
    """(k, 2) instants spent, and the best gain or hypervolume then, in the units that are shown."""
    gains, complete = factors * arm.gains, set(arm.complete)
    reference = factors * np.nanmin(np.vstack([other.gains for other in search.arms.values()]), axis=0)
    spent, best, steps = 0, np.zeros((0, gains.shape[1])), []
    for at, evaluation in enumerate(arm.evaluations):
        spent += evaluation.instants if at else 0
        best = np.vstack([best, gains[at : at + 1]]) if at in complete else best
        if len(best):
            steps.append((spent, float(best.max()) if gains.shape[1] == 1 else hypervolume(best, reference)))
    return np.array(steps).reshape(-1, 2)


def _slices(search: PlacementSearch, best: Evaluation | None, objective: int, factor: float) -> list[Slice]:
    """None where there is nothing to learn from."""
    if best is None or best.unit is None:
        return []
    told = [
        (arm, at)
        for arm in search.arms.values()
        for at, one in enumerate(arm.evaluations)
        if one.unit is not None and not np.isnan(arm.gains[at, objective]) and (one.number or arm.name == "optimiser")
    ][:MOST_VALUES]
    places = torch.from_numpy(np.array([arm.evaluations[at].unit for arm, at in told]))
    values = torch.from_numpy(np.array([factor * arm.gains[at, objective] for arm, at in told]))
    left = torch.from_numpy(np.array([factor * arm.left[at, objective] for arm, at in told]))
    model = GaussianProcess.fitted(levels_of(search.space), places, values, left)
    slices = []
    for column, variable in enumerate(search.space.variables[:MOST_SLICES]):
        is_choice = isinstance(variable, FreeChoice)
        count = len(variable.options) if isinstance(variable, FreeChoice) else PLACES
        shares = (np.arange(count) + 0.5) / count if is_choice else np.linspace(0.0, 1.0, count)
        along = np.tile(best.unit, (count, 1))
        along[:, column] = shares
        mean, deviation = model.predict(torch.from_numpy(along))
        points = {
            arm.name: np.array(
                [
                    (_shown(variable, one.unit[column]), factor * arm.gains[at, objective])
                    for at, one in enumerate(arm.evaluations)
                    if one.unit is not None
                ]
            ).reshape(-1, 2)
            for arm in search.arms.values()
        }
        slices.append(
            Slice(
                name=variable.name,
                x=np.array([_shown(variable, share) for share in shares]),
                mean=mean.numpy(),
                deviation=deviation.numpy(),
                points=points,
                best=_shown(variable, best.unit[column]),
                options=[str(option) for option in variable.options] if isinstance(variable, FreeChoice) else (),
            )
        )
    return slices


def _shown(variable: object, share: float) -> float:
    """Where a share of the way is drawn: the value of a number, the number of an option."""
    if isinstance(variable, FreeChoice):
        return float(min(int(share * len(variable.options)), len(variable.options) - 1))
    value: float = variable.at(float(share))  # type: ignore[attr-defined]  # a number
    return value
