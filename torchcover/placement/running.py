"""A placement search from its start to the test on held-out worlds, within its budget, with its journal."""

import math
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from torchcover.evaluation.checkpoint import differences
from torchcover.evaluation.progress import Progress, held_back
from torchcover.files import BadFileError, check_memory, lock_folder, reads, write_atomically
from torchcover.placement.plan import distributions_of, import_optuna, run_quietly
from torchcover.placement.result import Finalist, SearchResult
from torchcover.placement.search import RANDOM, START, Evaluation, PlacementSearch
from torchcover.placement.validation import ValidationTest, format_gain, validate

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial

JOURNAL = "search.journal"
STUDY = "placement"
JOURNAL_BYTES_PER_BYTE = 30  # memory of JSON objects that are as small as possible

Clock = Callable[[], float]


def run_search(
    search: PlacementSearch,
    out: Path | None = None,
    *,
    resume: bool = False,
    progress: bool = False,
    clock: Clock = time.monotonic,
) -> SearchResult:
    """Spend the budget of a search, then test its finalists on held-out worlds.

    Args:
        search: A search that has proposed nothing yet.
        out: Folder of its journal: every evaluation is on the disk before the next one begins.
        resume: Whether to continue the journal that is there. With a number of evaluations, the result is that of a
            search without interruption.
        progress: Whether to show a progress bar.
        clock: Returns seconds.

    Raises:
        ValueError: A budget below two evaluations; a start that cannot be scored; a journal of another search.
        BadFileError: A damaged journal.
    """
    if search.evaluations:
        raise ValueError("search: one that has proposed nothing yet is needed; make another one")
    with nullcontext() if out is None else lock_folder(out):
        try:
            return _run(search, out, resume, progress, clock)
        finally:
            if "frames" in vars(search):
                search.frames.close()


def _run(search: PlacementSearch, out: Path | None, resume: bool, progress: bool, clock: Clock) -> SearchResult:
    began_s = clock()
    frame_s = (len(search.frames), clock() - began_s)
    journal = None if out is None else SearchJournal(out / JOURNAL, search)
    if journal is not None and resume:
        journal.resume()
    earlier_s = sum(evaluation.seconds for evaluation in search.evaluations[1:])
    if not search.evaluations:
        start = search.ask()
        assert start is not None  # the first one always is
        search.evaluate(start)
    budget = _Budget(search, clock, began_s - earlier_s, frame_s[1] / frame_s[0])
    budget.check()
    with Progress(budget.expected, search.space.name, done=len(search.evaluations), shown=progress) as bar:
        _spend(search, budget, journal, bar.advance)
    finalists, test, untested = _validate(search, _pick_finalists(search))
    return SearchResult(search, finalists, test, untested, clock() - began_s + earlier_s)


class _Budget:
    """Time that a search with a scored start may still spend; as much is reserved as the test will take.

    Args:
        search: The search.
        clock: Returns seconds.
        began_s: Start of the search by the clock, earlier by the time spent before it was resumed.
        frame_s: Time that it took to make one frame.
    """

    def __init__(self, search: PlacementSearch, clock: Clock, began_s: float, frame_s: float) -> None:
        self._search, self._clock, self._began_s = search, clock, began_s
        plan, objectives = search.plan, len(search.space.objectives)
        rigs = 3 if objectives == 1 else objectives + 2
        held_out = plan.fresh_worlds * plan.per_world * sum(not each.repeats for each in search.space.scenarios)
        self.evaluation_s = search.evaluations[0].seconds
        rigs_s = rigs * self.evaluation_s
        self.test_s = held_out * (frame_s + rigs_s / len(search.frames)) + rigs_s
        self.until_s = math.inf if plan.budget_s is None else began_s + plan.budget_s - self.test_s

    @property
    def expected(self) -> int:
        """Expected number of evaluations in all."""
        plan = self._search.plan
        if plan.evaluations is not None:
            return plan.evaluations + 1
        left_s = max(self.until_s - self._clock(), 0.0)
        return len(self._search.evaluations) + int(left_s / max(self.evaluation_s, 1e-9))

    def check(self) -> None:
        """ValueError: there is no time for two candidates, and there was none before."""
        if len(self._search.evaluations) > 1 or self._clock() + 2 * self.evaluation_s <= self.until_s:
            return
        spent_s = self._clock() - self._began_s
        needed_s = spent_s + 2 * self.evaluation_s + self.test_s
        raise ValueError(
            f"budget: {self._search.plan.budget_s:g} s are less than two evaluations: frames and start took "
            f"{spent_s:.1f} s, a candidate takes up to {self.evaluation_s:.1f} s, and the test on held-out worlds "
            f"about {self.test_s:.1f} s; give {math.ceil(needed_s)} s at the very least"
        )

    def is_left(self) -> bool:
        """Return whether there is time for another candidate."""
        return self._clock() + self.evaluation_s <= self.until_s


def _spend(
    search: PlacementSearch, budget: _Budget, journal: "SearchJournal | None", advance: Callable[[int, str], Any]
) -> None:
    search.until_s = budget.until_s
    if journal is not None:
        journal.write()
    while budget.is_left() and (candidate := search.ask()) is not None:
        search.evaluate(candidate)
        if journal is not None:
            journal.write()
        advance(budget.expected, _describe_best(search))
    if journal is not None:  # the infeasible candidates of the last `ask`
        journal.write()


def _describe_best(search: PlacementSearch) -> str:
    best = search.pick_compromise(search.best_of())
    start = search.evaluations[0].estimate
    if best is None or start is None:
        return "no possible rig yet"
    pairs = zip(start.quantities, search.gains[best].tolist(), strict=False)  # the objectives come first
    return "  ".join(f"{quantity.key} {format_gain(gain, quantity.unit)}" for quantity, gain in pairs)


def _pick_finalists(search: PlacementSearch) -> list[Finalist]:
    """Return the rigs to test: the best, of several objectives the ends of the front, and the best random one."""
    front, several = search.best_of(), len(search.space.objectives) > 1
    best = search.pick_compromise(front)
    if best is None:
        return []
    roles = {"compromise" if several else "best": best}
    if several:
        columns = zip(search.space.objectives, search.gains[front].T, strict=True)
        roles |= {name: front[int(np.argmax(column))] for name, column in columns}
    else:
        random = search.pick_compromise(search.best_of((START, RANDOM)))
        roles |= {RANDOM: best if random is None else random}
    finalists = []
    for role, at in roles.items():
        evaluation, rig = search.evaluations[at], search.space.start
        if at:
            rig = search.space.rig(evaluation.values, f"{search.space.name}_{role}")
        finalists.append(Finalist(role, evaluation, rig))
    return finalists


def _validate(search: PlacementSearch, finalists: list[Finalist]) -> tuple[list[Finalist], ValidationTest | None, str]:
    """Return the finalists with their gains on held-out worlds, the test, and the reason why there is none."""
    moved = {finalist.role: finalist.rig for finalist in finalists if not finalist.is_start}
    if not moved:
        return finalists, None, ""
    plan = search.plan
    try:
        test = validate(moved, search.space.start, search.frames, test_seed=plan.seed_of_test, worlds=plan.fresh_worlds)
    except ValueError as error:
        return finalists, None, str(error)
    tested = [replace(finalist, gains=test.gains.get(finalist.role, ())) for finalist in finalists]
    return tested, test, ""


class SearchJournal:
    """The evaluations of a search in a file: an Optuna study in a journal of JSON lines, one for each evaluation.

    Args:
        path: The file, in a folder that no other search writes to.
        search: The search that it belongs to.
    """

    def __init__(self, path: Path, search: PlacementSearch) -> None:
        self.path = path
        self._search = search
        self._written = 0
        self._study: Any = None
        settings = search.plan.settings(search.space)
        self._settings = {name: str(value) for name, value in settings.items()}

    def resume(self) -> None:
        """Load the evaluations of the file, if there is one.

        Raises:
            ValueError: It belongs to another search.
            BadFileError: It is damaged, or the start has another score today.
        """
        if not self.path.exists():
            return
        search = self._search
        self._study, evaluations, settings = load_study(self.path)
        if other := differences(self._settings, settings):
            raise ValueError(
                f"{self.path}: the journal of another search: {other}; resume with the settings of that search, or "
                "choose another folder"
            )
        earlier = evaluations[0].estimate
        today = search.frames.score(search.space.start).estimate
        if earlier is None or not torch.equal(today.value, earlier.value):
            raise BadFileError(
                f"{self.path}: the start has another score today: the version of a package, or a file that the space "
                "names, has changed; begin anew, without --resume"
            )
        drop_torn_line(self.path)
        search.evaluations[:] = evaluations
        self._written = len(evaluations)

    def write(self) -> None:
        """Append all evaluations that are not in the file yet."""
        with held_back():
            if self._study is None:
                self.path.unlink(missing_ok=True)
                self._study = self._create()
            for evaluation in self._search.evaluations[self._written :]:
                self._study.add_trial(self._trial(evaluation))
                self._written += 1

    def _create(self) -> Any:  # noqa: ANN401  (a study of Optuna)
        optuna = import_optuna()
        directions = ["maximize"] * len(self._search.space.objectives)
        make = optuna.create_study
        study = run_quietly(optuna, lambda: make(storage=_storage(self.path), study_name=STUDY, directions=directions))
        study.set_user_attr("settings", self._settings)
        return study

    def _trial(self, evaluation: Evaluation) -> "FrozenTrial":
        optuna, spans = import_optuna(), distributions_of(self._search.space)
        values = dict(evaluation.values)
        gains = self._search.gains[evaluation.number].tolist()
        state = optuna.trial.TrialState.COMPLETE
        if math.isnan(gains[0]):
            state, gains = optuna.trial.TrialState.FAIL, None
        known = {name: spans[name] for name in values}
        attributes = {"evaluation": evaluation.record()}
        trial: FrozenTrial = optuna.create_trial(
            params=values, distributions=known, values=gains, state=state, user_attrs=attributes
        )
        return trial


class _FolderLock:
    """A lock that does nothing, since the folder is locked; that of Optuna waits for processes that were killed."""

    def acquire(self) -> bool:
        return True

    def release(self) -> None:
        pass


def _storage(path: Path) -> Any:  # noqa: ANN401  (a storage of Optuna)
    journal = import_optuna().storages.journal
    return import_optuna().storages.JournalStorage(journal.JournalFileBackend(str(path), lock_obj=_FolderLock()))


def drop_torn_line(path: Path) -> None:
    """Replace a journal by one without a last line that has no line break, whose process was killed.

    Raises:
        ValueError: The path is a symbolic link.
    """
    data = path.read_bytes()
    write_atomically(path, lambda new: new.write_bytes(data[: data.rfind(b"\n") + 1]))


@reads("the journal of a placement search")
def load_study(path: Path) -> tuple[Any, list[Evaluation], dict[str, str]]:
    """Return the study in a journal, its evaluations and its settings. Only JSON is read; no code is executed."""
    check_memory(JOURNAL_BYTES_PER_BYTE * path.stat().st_size)
    optuna = import_optuna()
    study = run_quietly(optuna, lambda: optuna.load_study(storage=_storage(path), study_name=STUDY))
    settings = study.user_attrs["settings"]
    records = [trial.user_attrs["evaluation"] for trial in study.trials]
    evaluations = [Evaluation.from_record(record) for record in records]
    if not evaluations or [evaluation.number for evaluation in evaluations] != list(range(len(evaluations))):
        raise ValueError("its evaluations are not numbered from 0 on")
    if not all(isinstance(value, str) for value in settings.values()):
        raise ValueError("its settings are not texts")
    return study, evaluations, settings
