"""The one loop: every observer has seen the same frames, however it ends."""

import multiprocessing
import os
import signal
import threading
import time
import tracemalloc
from dataclasses import replace
from traceback import format_exception

import pytest
import torch
from torch.utils.data import Subset

from torchcover import BevGrid, CoverageMetric, Scenario, evaluate
from torchcover.data import BadFrameError, RigSubset, SimulatedFrames
from torchcover.evaluation import CoverageObserver, observe, pipeline
from torchcover.evaluation.pipeline import MAX_FRAMES_PER_TASK, MeasuredFrames, group_by_scene
from torchcover.evaluation.progress import Progress, handle_termination, show_wait
from torchcover.frames import build_scene_lookup
from torchcover.simulation import PaperReference

GRID = BevGrid(x_m=(0.0, 4.0), y_m=(0.0, 2.0), cell_m=1.0, heights={"all": (-1.0, 1.0)})


class Occupancy:
    """How often each voxel of 1 m had a sensor point in it: a second observer, in one place."""

    def __init__(self, size=4):
        self.steps = torch.zeros(size, size, size, dtype=torch.int64)

    def update(self, frame):
        points = torch.cat(list(frame.clouds.values()))
        hit = torch.zeros_like(self.steps, dtype=torch.bool)
        hit[tuple(points.long().clamp(max=3).T)] = True
        self.steps += hit

    def compute(self):
        return self.steps

    def merge_state(self, other):
        self.steps += other.steps


class Names:
    def __init__(self, then=lambda: None):
        self.names, self.then = [], then

    def update(self, frame):
        self.names.append(frame.name)
        self.then()


class Spoiled:
    """A dataset in which some frames are bad."""

    def __init__(self, frames, bad):
        self.frames, self.bad = frames, bad

    def __len__(self):
        return len(self.frames)

    def get_scene_id(self, index):
        return index

    def __getitem__(self, index):
        if index in self.bad:
            raise BadFrameError(f"f{index} (frame {index}): rubbish")
        return self.frames[index]


def coverage(rig="a"):
    return CoverageObserver(CoverageMetric(GRID, num_blocks=16), rig)


def values(observer):
    """A copy of what an observer has found."""
    found = observer.compute()
    return getattr(found, "radius", found).clone()


@pytest.fixture
def frames(frame_of):
    return [frame_of(index) for index in range(6)]


@pytest.mark.parametrize("make", [coverage, Occupancy])
def test_observers_of_parts_merge_into_one_of_the_whole(frames, make):
    whole, first, rest = make(), make(), make()
    observe(frames, [whole])
    observe(frames[:2], [first])
    observe(frames[2:], [rest])
    before = values(rest)
    first.merge_state(rest)
    torch.testing.assert_close(values(first), values(whole), rtol=1e-12, atol=0, equal_nan=True)
    torch.testing.assert_close(values(rest), before, rtol=0, atol=0, equal_nan=True)


def test_coverage_is_that_of_the_metric_with_weights_and_places_in_time(frames):
    observers = {rig: coverage(rig) for rig in ("a", "b")}
    run = observe(frames, observers.values())
    for rig, observer in observers.items():
        metric = CoverageMetric(GRID, num_blocks=16)
        for frame in frames:
            metric.update(frame.clouds[rig], frame.reference, weights=frame.reference_weights, block_index=frame.index)
        assert torch.equal(observer.compute().radius, metric.compute().radius)
        assert torch.equal(observer.compute().block_sums.sums, metric.compute().block_sums.sums)
    assert (run.num_frames, dict(run.counts), run.is_complete) == (6, {"seen": 15}, True)


@pytest.mark.parametrize("workers", [0, 2])
def test_workers_change_nothing_and_frames_come_in_order(frames, workers):
    names, occupancy = Names(), Occupancy()
    run = observe(frames, [names, occupancy], num_workers=workers, num_frames=5)
    assert names.names == ["f0", "f1", "f2", "f3", "f4"]
    assert run.num_frames == 5
    assert int(occupancy.compute().max()) <= 5


@pytest.mark.parametrize("others", [(), (Occupancy,)])
def test_frames_are_measured_where_they_are_made_and_travel_only_if_somebody_else_looks_at_them(frames, others):
    apart = [coverage("a"), *(make() for make in others), coverage("b")]
    seen = MeasuredFrames(frames, apart, "cpu")[2]
    assert (seen.frame is None, seen.counts) == (not others, frames[2].counts)
    assert set(seen.sums) == {number for number, one in enumerate(apart) if isinstance(one, CoverageObserver)}
    assert MeasuredFrames(frames, apart, "cuda")[2].sums == {}
    assert all(one.metric.num_frames == 0 for one in (apart[0], apart[-1])), "what is measured apart adds nothing"
    alone = coverage("b")
    for frame in frames:
        alone.update(frame)
    for workers in (0, 2):
        together = [coverage("a"), *(make() for make in others), coverage("b")]
        observe(frames, together, num_workers=workers)
        state = together[-1].state_dict()
        assert all(torch.equal(value, state[name]) for name, value in alone.state_dict().items())


@pytest.mark.parametrize("workers", [0, 2])
def test_what_cannot_be_measured_ends_the_run_with_what_was_seen_before(frames, workers):
    """The metric wants square metres, which one frame lacks."""
    observer = CoverageObserver(CoverageMetric(GRID, has_area_weights=True), "a")
    frames[4] = replace(frames[4], reference_weights=None)
    run = observe(frames, [observer], num_workers=workers, keep_partial=True, skip_bad_frames=True)
    assert (run.num_frames, run.skipped_frames, int(observer.metric.num_frames)) == (4, [], 4)
    assert "weights: the area of each reference point in m2 is needed" in str(run.failure)


def test_of_several_workers_one_makes_the_frames_of_a_world_and_all_come_in_order():
    spread = SimulatedFrames("urban", "front_roof_32", num_frames=15, frame_interval_s=10.0)
    tasks = list(group_by_scene(range(15), spread.get_scene_id))
    assert tasks == [[*range(7)], [*range(7, 13)], [13, 14]]
    assert [{spread.simulator.get_run_index(index) for index in task} for task in tasks] == [{0}, {1}, {2}]
    dense = list(group_by_scene(range(700), SimulatedFrames("urban", "front_roof_32", num_frames=1000).get_scene_id))
    assert [index for task in dense for index in task] == [*range(700)]
    assert max(map(len, dense)) == MAX_FRAMES_PER_TASK
    still = SimulatedFrames("courtyard", "front_roof_32", num_frames=3)  # of which every process has the whole
    for alone in (still, []):
        assert list(group_by_scene(range(3), build_scene_lookup(alone))) == [[0], [1], [2]]


class Wrapped:
    """Frames of another source, in a user's own class."""

    def __init__(self, frames):
        self.frames = frames

    def __len__(self):
        return len(self.frames)

    def __getitem__(self, index):
        return self.frames[index]


class Told(Wrapped):
    """And says all that the other one says."""

    def __getattr__(self, name):
        return getattr(self.frames, name)


def test_whoever_wraps_frames_keeps_their_worlds():
    frames = SimulatedFrames("urban", "front_roof_32", num_frames=15, frame_interval_s=10.0)
    chosen, told = RigSubset(frames, {"mine": "front_roof_32"}), Told(frames)
    part = Subset(Told(chosen), [14, 0, 6, 7])
    worlds = [frames.get_scene_id(index) for index in range(15)]
    assert [build_scene_lookup(chosen)(index) for index in range(15)] == worlds == [0] * 7 + [1] * 6 + [2] * 2
    assert [build_scene_lookup(told)(index) for index in range(15)] == worlds
    assert [build_scene_lookup(part)(index) for index in range(4)] == [2, 0, 0, 1]


def test_each_world_is_built_by_one_worker_whoever_gives_the_frames(monkeypatch, tmp_path):
    few = PaperReference(rows=4, columns=4)
    frames = SimulatedFrames("parking", "front_roof_32", num_frames=4, frame_interval_s=35.0, reference_sensor=few)
    build = Scenario.build_scene

    def world(self, seed, run, *rest):
        with (tmp_path / "built").open("a") as file:
            file.write(f"{run}\n")
        return build(self, seed, run, *rest)

    monkeypatch.setattr(Scenario, "build_scene", world)
    evaluate(frames=Told(frames), cell_m=8.0, num_workers=2)
    assert sorted((tmp_path / "built").read_text().split()) == ["0", "1"]


@pytest.mark.parametrize("frames_of", [Wrapped, lambda frames: Subset(Wrapped(frames), [0, 1])])
def test_a_source_that_does_not_know_its_worlds_is_refused_where_it_matters(frames, frames_of):
    source = frames_of(Told(frames))
    assert observe(source, [Names()], num_workers=1).num_frames == len(source)
    with pytest.raises(TypeError, match=r"^frames: Wrapped does not name the scene of a frame, so"):
        observe(source, [Names()], num_workers=2, keep_partial=True)


@pytest.mark.parametrize("scenario", ["urban", "courtyard"])
def test_no_list_is_made_of_all_the_steps_there_may_be(scenario):
    frames = SimulatedFrames(scenario, "front_roof_32", num_frames=20_000)
    tracemalloc.start()
    tasks = group_by_scene(range(20_000), frames.get_scene_id)
    assert sum(map(len, tasks)) == 20_000
    _, most_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most_bytes < 100_000


class Counted(Spoiled):
    """A dataset that knows, in all processes, how many frames were made."""

    def __init__(self, frames):
        super().__init__(frames, ())
        self.made = multiprocessing.Value("i", 0)

    def __getitem__(self, index):
        with self.made.get_lock():
            self.made.value += 1
        return super().__getitem__(index)


def test_a_worker_makes_one_task_ahead(frames):
    counted, ahead = Counted(frames), []

    def wait():
        if not ahead:
            time.sleep(0.3)
            ahead.append(counted.made.value)

    observe(counted, [Names(then=wait)], num_workers=1)
    assert ahead[0] <= 2


def test_of_two_rigs_none_is_meant_until_it_is_named(frames):
    with pytest.raises(ValueError, match="clouds of 2 rigs .a, b.: name one"):
        observe(frames, [coverage(rig=None)])
    with pytest.raises(ValueError, match="cannot merge the coverage of rig 'b' into that of 'a'"):
        coverage("a").merge_state(coverage("b"))


def test_a_bad_frame_ends_the_run_and_is_noted_for_who_keeps_what_there_is(frames):
    names = Names()
    run = observe(Spoiled(frames, {3}), [names], keep_partial=True)
    assert (run.num_frames, names.names, run.is_complete) == (3, ["f0", "f1", "f2"], False)
    with pytest.raises(BadFrameError, match="f3"):
        run.raise_failure()


def test_what_ended_a_run_is_raised_unless_the_caller_keeps_what_there_is(frames):
    with pytest.raises(BadFrameError, match="f3"):
        observe(Spoiled(frames, {3}), [Names()])
    names = Names(then=lambda: len(names.names) < 3 or os.kill(os.getpid(), signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        observe(frames, [names])
    assert names.names == ["f0", "f1", "f2"]


def test_square_metres_are_not_made_up(frames):
    metric = CoverageMetric(GRID, has_area_weights=True)
    with pytest.raises(ValueError, match="the area of each reference point in m2 is needed"):
        CoverageObserver(metric, "a").update(replace(frames[0], reference_weights=None))
    CoverageObserver(metric, "a").update(frames[0])
    assert metric.compute().average == "area"


@pytest.mark.parametrize("workers", [0, 2])
def test_bad_frames_are_skipped_if_that_is_asked_for(frames, workers):
    names = Names()
    run = observe(Spoiled(frames, {0, 3}), [names], skip_bad_frames=True, num_workers=workers)
    assert names.names == ["f1", "f2", "f4", "f5"]
    assert run.skipped_frames == ["f0 (frame 0): rubbish", "f3 (frame 3): rubbish"]
    assert run.is_complete
    run.raise_failure()


def together(monkeypatch):
    monkeypatch.setattr(pipeline, "group_by_scene", lambda *_: [[0, 1, 2, 3], [4, 5]])


class OddError(ValueError):
    """What cannot be built again from its text alone."""

    def __init__(self, what, where):
        super().__init__(f"{what} at {where}", lambda: what)

    def __str__(self):
        return self.args[0]


class Invalid(Spoiled):
    """A dataset in which some frames are errors that name no frame."""

    def __getitem__(self, index):
        if index in self.bad:
            raise OddError("a sensor in a wall", index)
        return self.frames[index]


@pytest.mark.parametrize("workers", [0, 1, 2])
def test_of_frames_that_are_made_together_a_bad_one_costs_itself_only(frames, workers, monkeypatch):
    together(monkeypatch)
    names = Names()
    run = observe(Spoiled(frames, {1, 4}), [names], skip_bad_frames=True, num_workers=workers)
    assert names.names == ["f0", "f2", "f3", "f5"]
    assert run.skipped_frames == ["f1 (frame 1): rubbish", "f4 (frame 4): rubbish"]


@pytest.mark.parametrize("workers", [0, 1, 2])
@pytest.mark.parametrize(
    ("dataset", "error", "message"),
    [(Spoiled, BadFrameError, "f2 (frame 2): rubbish"), (Invalid, ValueError, "a sensor in a wall at 2")],
)
def test_the_frames_before_a_bad_one_are_kept(frames, workers, dataset, error, message, monkeypatch):
    together(monkeypatch)
    names = Names()
    run = observe(dataset(frames, {2}), [names], keep_partial=True, num_workers=workers)
    assert (run.num_frames, names.names, run.skipped_frames) == (2, ["f0", "f1"], [])
    with pytest.raises(error) as raised:
        run.raise_failure()
    assert str(raised.value) == message
    assert f"raise {'OddError' if dataset is Invalid else 'BadFrameError'}(" in "".join(format_exception(raised.value))


def test_without_a_good_frame_there_is_no_result(frames):
    with pytest.raises(BadFrameError, match="f0"):
        observe(Spoiled(frames, {0}), [Names()])
    with pytest.raises(ValueError, match="no frame could be used"):
        observe(Spoiled(frames, set(range(6))), [Names()], skip_bad_frames=True)


def test_an_error_of_the_last_observer_costs_no_step_of_the_others(frames):
    names = Names()
    run = observe(frames, [names, Names(then=lambda: 1 / (4 - run_so_far(names)))], keep_partial=True)
    assert (run.num_frames, names.names, run.is_complete) == (3, ["f0", "f1", "f2", "f3"], False)
    with pytest.raises(ZeroDivisionError):
        run.raise_failure()
    with pytest.raises(ZeroDivisionError):
        observe(frames, [Names(then=lambda: 1 / 0)], keep_partial=True)  # nothing to keep


def run_so_far(names):
    return len(names.names)


class Deadly(Spoiled):
    """A dataset in which some frames end the process that makes them, as a want of memory would."""

    def __getitem__(self, index):
        if index in self.bad:
            os.kill(os.getpid(), signal.SIGKILL)
        return self.frames[index]


# torch may find out about the worker once more when its iterator is taken down.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_what_there_is_outlives_a_worker_that_is_killed(frames):
    names = Names()
    run = observe(Deadly(frames, {5}), [names], num_workers=1, keep_partial=True)
    assert (run.num_frames, run.is_complete) == (len(names.names), False)
    assert names.names == ["f0", "f1", "f2", "f3", "f4"][: len(names.names)]
    with pytest.raises(
        ChildProcessError, match=rf"a worker was killed after frame {run.num_frames}, .*; use fewer workers"
    ):
        run.raise_failure()


@pytest.mark.parametrize("method", ["spawn", "forkserver"])
def test_workers_may_be_started_in_other_ways_than_by_a_fork(frames, method, monkeypatch):
    monkeypatch.setattr(pipeline, "get_start_method", lambda: method)
    names = Names()
    observe(frames, [names], num_workers=1)
    assert names.names == ["f0", "f1", "f2", "f3", "f4", "f5"]


@pytest.mark.parametrize(("method", "tells"), [("fork", False), ("spawn", True), ("forkserver", True)])
def test_a_program_that_starts_itself_is_told_how_it_should(method, tells, monkeypatch):
    monkeypatch.setattr(multiprocessing, "get_start_method", lambda **_: method)
    died = RuntimeError("DataLoader worker (pid(s) 7) exited unexpectedly")
    assert ("__main__" in str(pipeline.find_killed_worker(died, num_workers=2, num_frames=0))) == tells


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_who_ends_the_workers_too_has_ended_the_run(frames, monkeypatch):
    """A scheduler ends all processes of a job, and a worker may be the first to go."""
    monkeypatch.setattr(pipeline, "clear_frames", lambda _: os.kill(os.getpid(), signal.SIGTERM))
    names = Names()
    with handle_termination(lambda _: None) as signals:
        run = observe(Deadly(frames, {5}), [names], num_workers=1, keep_partial=True)
    assert signals == [signal.SIGTERM]
    assert run.num_frames == len(names.names) > 0
    assert isinstance(run.failure, KeyboardInterrupt)


def test_ctrl_c_within_a_frame_waits_for_all_observers(frames):
    calls = []

    def press():
        calls.append(1)
        if len(calls) == 3:
            os.kill(os.getpid(), signal.SIGINT)

    before, first, last = signal.getsignal(signal.SIGINT), Names(press), Names()
    run = observe(frames, [first, last], keep_partial=True)
    assert first.names == last.names == ["f0", "f1", "f2"]
    assert (run.num_frames, type(run.failure), run.is_complete) == (3, KeyboardInterrupt, False)
    assert signal.getsignal(signal.SIGINT) is before
    with pytest.raises(KeyboardInterrupt):
        run.raise_failure()


def test_it_runs_in_any_thread(frames):
    names = Names()
    thread = threading.Thread(target=observe, args=(frames, [names]))
    thread.start()
    thread.join()
    assert len(names.names) == 6


class AfterThree:
    """A rule that is content after three steps."""

    progress_text = "nearly there"

    def is_reached(self, num_frames):
        return num_frames >= 3

    def estimate_num_frames(self, max_frames):
        return min(max_frames, 3)


@pytest.mark.parametrize("progress", [False, True])
def test_a_rule_ends_the_run_and_a_bar_tells_of_it(frames, progress, capsys):
    run = observe(frames, [Names()], stopping_rule=AfterThree(), show_progress=progress, title="frames")
    assert (run.num_frames, run.is_complete) == (3, True)
    told = capsys.readouterr().err
    assert ("3/3" in told and "nearly there" in told) == progress
    assert bool(told) == progress


@pytest.mark.parametrize(("workers", "threads"), [(0, 2), (1, 1), (2, 1)])
def test_each_worker_is_left_a_core(frame_of, monkeypatch, workers, threads):
    monkeypatch.setattr("torchcover.evaluation.pipeline.count_cores", lambda: 2)
    before, seen = torch.get_num_threads(), []
    torch.set_num_threads(2)
    try:
        names = Names(lambda: seen.append(torch.get_num_threads()))
        observe([frame_of(index) for index in range(3)], [names], num_workers=workers)
        assert (seen, torch.get_num_threads()) == ([threads] * 3, 2)
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("shown", [True, False])
def test_a_wait_without_steps_is_shown_on_a_terminal(capsys, monkeypatch, shown):
    for variable in ("FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
        monkeypatch.setenv(variable, "1")
    with show_wait("preparing the scene", is_shown=shown):
        pass
    assert ("preparing the scene" in capsys.readouterr().err) == shown


def test_rates_count_the_start_and_are_means_over_rounds_of_all_workers(monkeypatch):
    """Four workers start in 8 s; then each round gives four steps at once, every 4 s: a step a second."""
    now_s = 0.0
    monkeypatch.setattr("torchcover.evaluation.progress.time.monotonic", lambda: now_s)
    bar, rates = Progress(100, "run", is_shown=True, num_workers=4), []
    for step in range(60):
        now_s = 8.0 + 4.0 * (step // 4)
        bar.advance(100)
        rates.append(float(bar._bar.tasks[0].fields["rate"].removesuffix("/s")))
    assert rates[0] == pytest.approx(1 / 8, abs=0.01)
    assert max(rates) < 1.35
    assert min(rates[30:]) > 0.75
    assert bar._bar.tasks[0].fields["remaining"].startswith("0:00:")
