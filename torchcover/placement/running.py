"""A search from its start to the test on fresh worlds, within its budget, in files that it can go on from."""

import math
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from torchcover.evaluation import claimed
from torchcover.evaluation.progress import held_back, progress_of
from torchcover.files import BadFileError
from torchcover.placement.evaluation import OPTIMISER, RANDOM, START, Evaluation
from torchcover.placement.fresh import FreshTest, fresh_test
from torchcover.placement.journal import NAME, Journal
from torchcover.placement.result import Pick, SearchResult
from torchcover.placement.search import PlacementSearch

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
        out: Folder of its journal: every evaluation is on the disk before the next one begins.
        resume: Whether to go on from the journal that is there. With a number of evaluations, what comes of it is what
            would have come of it without the end between.
        progress: Whether to show a bar.
        clock: Seconds.

    Raises:
        ValueError: A budget below one evaluation of each arm; a start that cannot be scored.
        BadFileError: A journal of another search.
    """
    if search.evaluations:
        raise ValueError("search: one of which nothing was asked yet is needed; make another one")
    with nullcontext() if out is None else claimed(out):
        try:
            return _run(search, out, resume, progress, clock)
        finally:
            if "instants" in vars(search):
                search.instants.close()


def _run(search: PlacementSearch, out: Path | None, resume: bool, progress: bool, clock: Clock) -> SearchResult:
    began = clock()
    count = len(search.instants)
    build_s = (clock() - began) / count
    start = search.ask()
    assert start is not None  # there always is one
    search.evaluate(start)
    journal = None if out is None or not resume else _resumed(search, out / NAME)
    earlier_s = sum(evaluation.seconds for evaluation in search.evaluations[1:])
    budget = _Budget(search, clock, began - earlier_s, build_s)
    budget.check()
    if out is not None and journal is None:  # an earlier one is lost only now
        journal = Journal(out / NAME, search.plan.settings(search.space))
        journal.add(search.evaluations[0])
    with progress_of(budget.expected, search.space.name, done=len(search.evaluations), shown=progress) as bar:
        _spend(search, budget, journal, bar.advance)
    picks, untested = _tested(search, _picks(search))
    return SearchResult(search, picks, untested, clock() - began + earlier_s)


def _resumed(search: PlacementSearch, path: Path) -> Journal | None:
    """The journal that is there, with the search where it ended; None if there is none."""
    if not path.exists():
        return None
    start = search.evaluations[0]
    assert start.scores is not None  # it was scored just now
    journal, evaluations = Journal.resumed(path, search.plan.settings(search.space), start.scores)
    if not evaluations:
        journal.add(start)
    elif _differs(start, evaluations[0]):
        raise BadFileError(
            f"{path}: the start scores something else than it did: another version of a package, or a file that the "
            "space names has changed; begin anew, without --resume"
        )
    search.replay(evaluations[1:])
    return journal


def _differs(start: Evaluation, earlier: Evaluation) -> bool:
    if start.scores is None or earlier.scores is None:
        return True
    earlier_scores = earlier.scores.at(start.scores.instants)
    return not np.array_equal(start.scores.seen_m2, earlier_scores.seen_m2)


class _Budget:
    """What a search may still spend. Of seconds, as many are kept as the test will take.

    Args:
        search: It, with the start scored.
        clock: Seconds.
        began: When, by that clock; earlier, by what a search that is resumed has spent.
        build_s: Seconds that each of its instants took.
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
        """Evaluations in all, as far as anybody knows."""
        plan = self._search.plan
        if plan.evaluations is not None:
            return plan.evaluations + 1
        left_s = max(self.until - self._clock(), 0.0)
        return len(self._search.evaluations) + int(left_s / max(self.one_s, 1e-9))

    def check(self) -> None:
        """Find out whether there is time for a candidate of each arm, if there was none before.

        Raises:
            ValueError: There is not.
        """
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
    search: PlacementSearch, budget: _Budget, journal: Journal | None, advance: Callable[[int, str], Any]
) -> None:
    written = len(search.evaluations)
    search.until = budget.until
    while budget.is_left() and (candidate := search.ask()) is not None:
        search.evaluate(candidate)
        with held_back():
            written = _write(search, journal, written)
        advance(budget.expected, _standing(search))
    _write(search, journal, written)


def _write(search: PlacementSearch, journal: Journal | None, written: int) -> int:
    """All that is not written yet: candidates that keep to no constraint are noted while another is asked for."""
    for evaluation in search.evaluations[written:] if journal is not None else ():
        journal.add(evaluation)  # type: ignore[union-attr]  # there is one
    return len(search.evaluations)


def _standing(search: PlacementSearch) -> str:
    arm = search.arms[OPTIMISER]
    if arm.best is None:
        return "nothing that can be yet"
    gains = zip(search.space.objectives, arm.gains[arm.best].tolist(), strict=True)
    return "  ".join(f"{name} {100 * gain:+.2f}" for name, gain in gains)


def _picks(search: PlacementSearch) -> list[Pick]:
    """What is tested: of each arm the best, and of several objectives the best of each and the middle of the front."""
    picks = []
    for name in (OPTIMISER, RANDOM):
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


def _tested(search: PlacementSearch, picks: Sequence[Pick]) -> tuple[Sequence[Pick], str]:
    """Those that are not the start, on fresh worlds; and why not, if not."""
    moved = {f"{at}": pick.rig for at, pick in enumerate(picks) if pick.evaluation.arm != START}
    if not moved:
        return picks, ""
    try:
        tests: dict[str, FreshTest] = fresh_test(
            moved,
            search.space.start,
            search.instants,
            test_seed=search.plan.seed_of_test,
            worlds=search.plan.fresh_worlds,
        )
    except ValueError as error:
        return picks, str(error)
    return [pick.tested(tests.get(f"{at}")) for at, pick in enumerate(picks)], ""
