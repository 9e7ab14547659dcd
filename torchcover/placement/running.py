"""Run of a placement search: budget, journal, and validation of the finalists on held-out scenes."""

import math
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from torchcover.evaluation.checkpoint import describe_differences
from torchcover.evaluation.progress import Progress, defer_signals
from torchcover.files import BadFileError, check_memory, guard_reader, lock_folder, write_atomically
from torchcover.placement.plan import build_distributions, import_optuna, run_quietly
from torchcover.placement.result import Finalist, SearchResult
from torchcover.placement.search import RANDOM, START, Evaluation, PlacementSearch
from torchcover.placement.validation import ValidationResult, format_improvement, validate

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial

JOURNAL = "search.journal"
STUDY = "placement"

Clock = Callable[[], float]


def run_search(
    search: PlacementSearch,
    out_dir: Path | None = None,
    *,
    resume: bool = False,
    progress: bool = False,
    clock: Clock = time.monotonic,
) -> SearchResult:
    """Run a search until its budget is spent, then validate its finalists on held-out scenes.

    Args:
        search: A search without evaluations.
        out_dir: Folder of the journal, which stores every evaluation before the next one begins; None writes none.
        resume: Whether to continue an existing journal. With `num_evaluations`, the result equals that of a search
            without interruption.
        progress: Whether to show a progress bar.
        clock: Function that returns seconds.

    Raises:
        ValueError: The budget is below two evaluations, the start cannot be scored, or the journal belongs to another
            search.
        BadFileError: The journal is damaged.
    """
    if search.evaluations:
        raise ValueError(f"search: got one with {len(search.evaluations)} evaluations; create a new one")
    with nullcontext() if out_dir is None else lock_folder(out_dir):
        try:
            return _run(search, out_dir, resume, progress, clock)
        finally:
            if "frames" in vars(search):
                search.frames.close()


def _run(search: PlacementSearch, out_dir: Path | None, resume: bool, progress: bool, clock: Clock) -> SearchResult:
    """Run a search: build the frames, evaluate candidates within the budget, and validate the finalists."""
    start_s = clock()
    num_frames = len(search.frames)  # builds the frames
    frame_duration_s = (clock() - start_s) / num_frames
    journal = None if out_dir is None else SearchJournal(out_dir / JOURNAL, search)
    if journal is not None and resume:
        journal.resume()
    earlier_s = sum(evaluation.duration_s for evaluation in search.evaluations[1:])
    if not search.evaluations:
        start = search.ask()
        assert start is not None  # the start is always proposed
        search.evaluate(start)
    budget = _Budget(search, clock, start_s - earlier_s, frame_duration_s)
    budget.check()
    num_done = len(search.evaluations)
    with Progress(budget.expected_evaluations, search.space.name, num_done=num_done, is_shown=progress) as bar:
        _evaluate_candidates(search, budget, journal, bar.advance)
    finalists, test, no_test_reason = _validate_finalists(search, _select_finalists(search))
    return SearchResult(search, finalists, test, no_test_reason, clock() - start_s + earlier_s)


class _Budget:
    """Time budget of a search with a scored start, from which the duration of the validation is reserved.

    Args:
        search: The search.
        clock: Function that returns seconds.
        start_s: Start of the search by the clock, earlier by the time spent before it was resumed.
        frame_duration_s: Time to build one frame.
    """

    def __init__(self, search: PlacementSearch, clock: Clock, start_s: float, frame_duration_s: float) -> None:
        self._search, self._clock, self._start_s = search, clock, start_s
        plan, num_objectives = search.plan, len(search.space.objectives)
        num_rigs = 3 if num_objectives == 1 else num_objectives + 2
        num_scenarios = sum(not scenario.is_repeating for scenario in search.space.scenarios)
        num_frames = plan.num_held_out_scenes * plan.frames_per_scene * num_scenarios
        self.evaluation_s = search.evaluations[0].duration_s
        rigs_s = num_rigs * self.evaluation_s
        self.validation_s = num_frames * (frame_duration_s + rigs_s / len(search.frames)) + rigs_s
        self.deadline_s = math.inf if plan.budget_s is None else start_s + plan.budget_s - self.validation_s

    @property
    def expected_evaluations(self) -> int:
        """Expected total number of evaluations."""
        plan = self._search.plan
        if plan.num_evaluations is not None:
            return plan.num_evaluations + 1
        left_s = max(self.deadline_s - self._clock(), 0.0)
        return len(self._search.evaluations) + int(left_s / max(self.evaluation_s, 1e-9))

    def check(self) -> None:
        """Raise ValueError if there is no time for two candidates in a search without candidates."""
        if len(self._search.evaluations) > 1 or self._clock() + 2 * self.evaluation_s <= self.deadline_s:
            return
        spent_s = self._clock() - self._start_s
        needed_s = spent_s + 2 * self.evaluation_s + self.validation_s
        raise ValueError(
            f"budget: {self._search.plan.budget_s:g} s is too short for two evaluations: frames and start took "
            f"{spent_s:.1f} s, a candidate takes up to {self.evaluation_s:.1f} s, and the validation on held-out "
            f"scenes about {self.validation_s:.1f} s; give at least {math.ceil(needed_s)} s"
        )

    def is_left(self) -> bool:
        """Return whether there is time for another candidate."""
        return self._clock() + self.evaluation_s <= self.deadline_s


def _evaluate_candidates(
    search: PlacementSearch, budget: _Budget, journal: "SearchJournal | None", advance: Callable[[int, str], Any]
) -> None:
    """Evaluate candidates until the budget is used up, and write each to the journal."""
    search.deadline_s = budget.deadline_s
    if journal is not None:
        journal.write()
    while budget.is_left() and (candidate := search.ask()) is not None:
        search.evaluate(candidate)
        if journal is not None:
            journal.write()
        advance(budget.expected_evaluations, _describe_best(search))
    if journal is not None:  # the last `ask` may have recorded infeasible candidates
        journal.write()


def _describe_best(search: PlacementSearch) -> str:
    """Describe the improvement of the best rig so far for the progress bar."""
    best = search.select_compromise(search.find_best())
    start = search.evaluations[0].estimate
    if best is None or start is None:
        return "no possible rig yet"
    improvements = search.improvements[best].tolist()  # of the objectives, which are the first quantities
    pairs = zip(start.quantities, improvements, strict=False)
    return "  ".join(f"{quantity.key} {format_improvement(value, quantity.unit)}" for quantity, value in pairs)


def _select_finalists(search: PlacementSearch) -> list[Finalist]:
    """Select the rigs to validate: of one objective the best and the best random one, of several the front's ends."""
    front = search.find_best()
    has_several_objectives = len(search.space.objectives) > 1
    best = search.select_compromise(front)
    if best is None:
        return []
    roles = {"compromise" if has_several_objectives else "best": best}
    if has_several_objectives:
        columns = zip(search.space.objectives, search.improvements[front].T, strict=True)
        roles |= {name: front[int(np.argmax(column))] for name, column in columns}
    else:
        random = search.select_compromise(search.find_best((START, RANDOM)))
        roles |= {RANDOM: best if random is None else random}
    finalists = []
    for role, number in roles.items():
        evaluation, rig = search.evaluations[number], search.space.start
        if number:
            rig = search.space.build_rig(evaluation.values, f"{search.space.name}_{role}")
        finalists.append(Finalist(role, evaluation, rig))
    return finalists


def _validate_finalists(
    search: PlacementSearch, finalists: list[Finalist]
) -> tuple[list[Finalist], ValidationResult | None, str]:
    """Return the finalists with their improvements on held-out scenes, the test, and the reason if there is none."""
    rigs = {finalist.role: finalist.rig for finalist in finalists if not finalist.is_start}
    if not rigs:
        return finalists, None, ""
    plan = search.plan
    try:
        test = validate(
            rigs, search.space.start, search.frames, test_seed=plan.test_seed, num_scenes=plan.num_held_out_scenes
        )
    except ValueError as error:
        return finalists, None, str(error)
    tested = [replace(finalist, improvements=test.improvements.get(finalist.role, ())) for finalist in finalists]
    return tested, test, ""


class SearchJournal:
    """Journal of a search: a file with an Optuna study as JSON lines, one for each evaluation.

    Args:
        path: The file, in a folder that no other search writes to.
        search: The search.
    """

    def __init__(self, path: Path, search: PlacementSearch) -> None:
        self.path = path
        self._search = search
        self._num_written = 0
        self._study: Any = None
        settings = search.plan.collect_settings(search.space)
        self._settings = {name: str(value) for name, value in settings.items()}

    def resume(self) -> None:
        """Load the evaluations of the file, if there is one.

        Raises:
            ValueError: The file belongs to another search.
            BadFileError: The file is damaged, or the start has a different score now.
        """
        if not self.path.exists():
            return
        search = self._search
        self._study, evaluations, settings = load_study(self.path)
        if differences := describe_differences(self._settings, settings):
            raise ValueError(
                f"{self.path}: the journal belongs to another search: {differences}; resume with the settings of that "
                "search, or choose another folder"
            )
        stored = evaluations[0].estimate
        current = search.frames.score(search.space.start).estimate
        if stored is None or not torch.equal(current.value, stored.value):
            raise BadFileError(
                f"{self.path}: the start has a different score now, because a package or a file of the space has "
                "changed; start again without --resume"
            )
        drop_torn_line(self.path)
        search.evaluations[:] = evaluations
        self._num_written = len(evaluations)

    def write(self) -> None:
        """Append all evaluations that are not in the file yet."""
        with defer_signals():
            if self._study is None:
                self.path.unlink(missing_ok=True)
                self._study = self._create_study()
            for evaluation in self._search.evaluations[self._num_written :]:
                self._study.add_trial(self._create_trial(evaluation))
                self._num_written += 1

    def _create_study(self) -> Any:  # noqa: ANN401  (a study of Optuna)
        """Create the study with a direction for each objective and the settings of the search."""
        optuna = import_optuna()
        directions = ["maximize"] * len(self._search.space.objectives)
        storage = _open_storage(self.path)
        study = run_quietly(optuna, optuna.create_study, storage=storage, study_name=STUDY, directions=directions)
        study.set_user_attr("settings", self._settings)
        return study

    def _create_trial(self, evaluation: Evaluation) -> "FrozenTrial":
        """Convert an evaluation to a trial of Optuna; unknown improvements make it a failed trial."""
        optuna, distributions = import_optuna(), build_distributions(self._search.space)
        improvements = self._search.improvements[evaluation.number].tolist()
        state = optuna.trial.TrialState.COMPLETE
        if math.isnan(improvements[0]):
            state, improvements = optuna.trial.TrialState.FAIL, None
        trial: FrozenTrial = optuna.create_trial(
            params=dict(evaluation.values),
            distributions={name: distributions[name] for name in evaluation.values},
            values=improvements,
            state=state,
            user_attrs={"evaluation": evaluation.to_record()},
        )
        return trial


class _FolderLock:
    """Lock without effect, since the folder is locked already; the lock of Optuna waits for killed processes."""

    def acquire(self) -> bool:
        return True

    def release(self) -> None:
        pass


def _open_storage(path: Path) -> Any:  # noqa: ANN401  (a storage of Optuna)
    """Open a journal as a storage of Optuna, with a lock that does not wait for dead processes."""
    storages = import_optuna().storages
    return storages.JournalStorage(storages.journal.JournalFileBackend(str(path), lock_obj=_FolderLock()))


def drop_torn_line(path: Path) -> None:
    """Remove an incomplete last line, which a process was writing when it was killed.

    Args:
        path: The journal.

    Raises:
        ValueError: The path is a symbolic link.
    """
    data = path.read_bytes()
    write_atomically(path, partial(Path.write_bytes, data=data[: data.rfind(b"\n") + 1]))


@guard_reader("the journal of a placement search")
def load_study(path: Path) -> tuple[Any, list[Evaluation], dict[str, str]]:
    """Load the study of a journal, its evaluations and its settings. Only JSON is read; no code is executed.

    Args:
        path: The journal.
    """
    check_memory(30 * path.stat().st_size)  # the smallest JSON objects take 30 bytes of memory per byte
    optuna = import_optuna()
    study = run_quietly(optuna, optuna.load_study, storage=_open_storage(path), study_name=STUDY)
    settings = study.user_attrs["settings"]
    records = [trial.user_attrs["evaluation"] for trial in study.trials]
    evaluations = [Evaluation.from_record(record) for record in records]
    if not evaluations or [evaluation.number for evaluation in evaluations] != list(range(len(evaluations))):
        raise ValueError("the evaluations are not numbered from 0")
    if not all(isinstance(value, str) for value in settings.values()):
        raise ValueError("a setting is not a string")
    return study, evaluations, settings
