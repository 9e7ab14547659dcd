"""A search from its start to the test on fresh worlds, within its budget, with a checkpoint to go on from."""

import math
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchcover.evaluation import Checkpoint
from torchcover.evaluation.checkpoint import Journal
from torchcover.evaluation.pipeline import Run
from torchcover.evaluation.progress import Progress, held_back
from torchcover.files import BadFileError, lock_folder
from torchcover.placement.evaluation import OPTIMISER, RANDOM
from torchcover.placement.fresh import FreshTest, amount, fresh_test
from torchcover.placement.result import Pick, SearchResult
from torchcover.placement.search import PlacementSearch

# What a search goes on from, in its folder.
CHECKPOINT = "checkpoint.npz"

Clock = Callable[[], float]


def run_search(
    search: PlacementSearch,
    out: Path | None = None,
    *,
    resume: bool = False,
    progress: bool = False,
    clock: Clock = time.monotonic,
) -> SearchResult:
    """Spend the budget of a search, then test what it found.

    Args:
        search: It, of which nothing was asked yet.
        out: Folder of its checkpoint: every evaluation is on the disk before the next one begins.
        resume: Whether to go on from the checkpoint that is there. With a number of evaluations, what comes of it is
            what would have come of it without the end between.
        progress: Whether to show a bar.
        clock: Seconds.

    Raises:
        ValueError: A budget below one evaluation of each arm; a start that cannot be scored.
        BadFileError: A checkpoint of another search.
    """
    if search.evaluations:
        raise ValueError("search: one of which nothing was asked yet is needed; make another one")
    with nullcontext() if out is None else lock_folder(out):
        try:
            return _run(search, out, resume, progress, clock)
        finally:
            if "instants" in vars(search):
                search.instants.close()


def _run(search: PlacementSearch, out: Path | None, resume: bool, progress: bool, clock: Clock) -> SearchResult:
    began = clock()
    count = len(search.instants)
    build_s = (clock() - began) / count
    journal = None if out is None else _Journal(search, Checkpoint(out / CHECKPOINT, resume))
    if journal is not None:
        journal.restore()
    earlier_s = sum(evaluation.seconds for evaluation in search.evaluations[1:])
    if not search.evaluations:
        start = search.ask()
        assert start is not None  # there always is one
        search.evaluate(start)
    budget = _Budget(search, clock, began - earlier_s, build_s)
    budget.check()
    with Progress(budget.expected, search.space.name, done=len(search.evaluations), shown=progress) as bar:
        _spend(search, budget, journal, bar.advance)
    picks, test, untested = _tested(search, _picks(search))
    return SearchResult(search, picks, test, untested, clock() - began + earlier_s)


class _Journal:
    """The checkpoint of a search, as that of a run whose steps are its evaluations."""

    def __init__(self, search: PlacementSearch, checkpoint: Checkpoint) -> None:
        settings = search.plan.settings(search.space)
        identity = {name: str(value) for name, value in settings.items()}
        self._search, self._path = search, checkpoint.path
        self._journal = Journal(checkpoint, identity, {"search": search})

    def restore(self) -> None:
        """Go on from what is there. ValueError or BadFileError: it is of another search, or start."""
        self._journal.restore(Run())
        if not self._search.evaluations:
            return
        *_, now = self._search.instants.prefixes(self._search.space.start)
        earlier = self._search.evaluations[0].prefixes[-1]
        if not torch.equal(now.estimate.value, earlier.estimate.value):
            raise BadFileError(
                f"{self._path}: the start scores something else than it did: another version of a package, or a file "
                "that the space names has changed; begin anew, without --resume"
            )

    def write(self) -> None:
        """Put all evaluations on the disk."""
        evaluations = self._search.evaluations
        with held_back():
            self._journal.write(Run(steps=len(evaluations), seconds=sum(one.seconds for one in evaluations)))


class _Budget:
    """What a search, whose start is scored, may still spend. Of seconds, as many are kept as the test will take.

    `began` is when, by the clock, and earlier, by what a search that is resumed has spent; `build_s` what each of its
    instants took.
    """

    def __init__(self, search: PlacementSearch, clock: Clock, began: float, build_s: float) -> None:
        self._search, self._clock, self._began = search, clock, began
        plan = search.plan
        one = search.evaluations[0].seconds
        rigs = 1 + 2 * (1 if len(search.space.objectives) == 1 else len(search.space.objectives) + 1)
        fresh = plan.fresh_worlds * plan.per_world * sum(not each.repeats for each in search.space.scenarios)
        # Of the fresh instants, and of those of the search, for the optimism.
        self.one_s, self.test_s = one, fresh * (build_s + rigs * one / len(search.instants)) + rigs * one
        self.until = math.inf if plan.budget_s is None else began + plan.budget_s - self.test_s

    @property
    def expected(self) -> int:
        """Evaluations in all, as far as is known."""
        plan = self._search.plan
        if plan.evaluations is not None:
            return plan.evaluations + 1
        left_s = max(self.until - self._clock(), 0.0)
        return len(self._search.evaluations) + int(left_s / max(self.one_s, 1e-9))

    def check(self) -> None:
        """ValueError: there is no time for a candidate of each arm, and there was none before."""
        if len(self._search.evaluations) > 1 or self._clock() + 2 * self.one_s <= self.until:
            return
        spent_s = self._clock() - self._began
        needed_s = spent_s + 2 * self.one_s + self.test_s
        raise ValueError(
            f"budget: {self._search.plan.budget_s:g} s are less than one evaluation: instants and start took "
            f"{spent_s:.1f} s, a candidate takes up to {self.one_s:.1f} s for each of the two arms, and the test on "
            f"fresh worlds about {self.test_s:.1f} s; give {math.ceil(needed_s)} s at the very least"
        )

    def is_left(self) -> bool:
        """Whether there is time for another candidate."""
        return self._clock() + self.one_s <= self.until


def _spend(
    search: PlacementSearch, budget: _Budget, journal: _Journal | None, advance: Callable[[int, str], Any]
) -> None:
    search.until = budget.until
    while budget.is_left() and (candidate := search.ask()) is not None:
        search.evaluate(candidate)
        if journal is not None:
            journal.write()
        advance(budget.expected, _standing(search))
    if journal is not None:  # what was refused while the last was asked for
        journal.write()


def _standing(search: PlacementSearch) -> str:
    arm = search.leader
    if arm.best is None:
        return "nothing that can be yet"
    quantities = search.evaluations[0].prefixes[-1].estimate.quantities
    gains = zip(quantities, arm.gains[arm.best].tolist(), strict=False)  # of the objectives alone
    return "  ".join(f"{quantity.key} {amount(gain, quantity.unit)}" for quantity, gain in gains)


def _picks(search: PlacementSearch) -> list[Pick]:
    """What is tested, the leader's first: the best of each arm; of several objectives a front's middle and its ends."""
    picks = []
    for name in sorted((OPTIMISER, RANDOM), key=lambda name: name != search.leader.name):
        arm = search.arms[name]
        if arm.best is None:
            continue
        front = arm.front
        places = {"": arm.best}
        if len(search.space.objectives) > 1:
            columns = zip(search.space.objectives, arm.gains[front].T, strict=True)
            places = {"middle": arm.best, **{key: front[int(np.argmax(column))] for key, column in columns}}
        for role, at in places.items():
            evaluation = arm.evaluations[at]
            rig = search.space.start
            if evaluation.number:
                called = "_".join(filter(None, (search.space.name, "" if name == OPTIMISER else name, role or "best")))
                rig = search.space.rig(evaluation.values, called)
            picks.append(Pick(name, role, evaluation, rig))
    return picks


def _tested(search: PlacementSearch, picks: Sequence[Pick]) -> tuple[Sequence[Pick], FreshTest | None, str]:
    """Those that are not the start, on fresh worlds; and why not, if not."""
    moved = {f"{at}": pick.rig for at, pick in enumerate(picks) if not pick.is_start}
    if not moved:
        return picks, None, ""
    plan = search.plan
    try:
        test = fresh_test(
            moved, search.space.start, search.instants, test_seed=plan.seed_of_test, worlds=plan.fresh_worlds
        )
    except ValueError as error:
        return picks, None, str(error)
    return [replace(pick, gains=test.gains.get(f"{at}", ())) for at, pick in enumerate(picks)], test, ""
