"""Observation loop: all observers receive the same frames in order, also if the run ends early."""

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
from torchcover.evaluation import CoverageObserver, frame_workers, observe, pipeline
from torchcover.evaluation.frame_workers import MAX_FRAMES_PER_TASK, group_by_scene
from torchcover.evaluation.pipeline import MeasuredFrames
from torchcover.evaluation.progress import Progress, handle_termination, show_wait
from torchcover.frames import build_scene_lookup
from torchcover.simulation import PaperReference

GRID = BevGrid(x_m=(0.0, 4.0), y_m=(0.0, 2.0), cell_m=1.0, heights={"all": (-1.0, 1.0)})


class Occupancy:
    """Observer that counts the frames with a sensor point in each voxel of 1 m."""

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


class NameObserver:
    """Observer that collects the names of frames and then calls a function."""

    def __init__(self, then=lambda: None):
        self.names, self.then = [], then

    def update(self, frame):
        self.names.append(frame.name)
        self.then()


class FramesWithErrors:
    """Dataset whose frames with the indices `bad` raise an error."""

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
    """Copy the result of an observer."""
    result = observer.compute()
    return getattr(result, "radius", result).clone()


@pytest.fixture
def frames(frame_of):
    return [frame_of(index) for index in range(6)]


@pytest.mark.parametrize("make", [coverage, Occupancy])
def test_merged_observers_equal_one_of_all_frames(frames, make):
    total, first, second = make(), make(), make()
    observe(frames, [total])
    observe(frames[:2], [first])
    observe(frames[2:], [second])
    before = values(second)
    first.merge_state(second)
    torch.testing.assert_close(values(first), values(total), rtol=1e-12, atol=0, equal_nan=True)
    torch.testing.assert_close(values(second), before, rtol=0, atol=0, equal_nan=True)


def test_coverage_equals_the_metric_with_weights_and_blocks(frames):
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
def test_workers_keep_the_order_of_frames(frames, workers):
    names, occupancy = NameObserver(), Occupancy()
    run = observe(frames, [names, occupancy], num_workers=workers, num_frames=5)
    assert names.names == ["f0", "f1", "f2", "f3", "f4"]
    assert run.num_frames == 5
    assert int(occupancy.compute().max()) <= 5


@pytest.mark.parametrize("further", [(), (Occupancy,)])
def test_workers_send_frames_only_if_observers_need_them(frames, further):
    observers = [coverage("a"), *(make() for make in further), coverage("b")]
    measured = MeasuredFrames(frames, observers, "cpu")[2]
    assert (measured.frame is None, measured.counts) == (not further, frames[2].counts)
    assert set(measured.sums) == {k for k, observer in enumerate(observers) if isinstance(observer, CoverageObserver)}
    assert MeasuredFrames(frames, observers, "cuda")[2].sums == {}
    assert observers[0].metric.num_frames == observers[-1].metric.num_frames == 0, "measuring a frame adds nothing"
    alone = coverage("b")
    for frame in frames:
        alone.update(frame)
    for workers in (0, 2):
        observers = [coverage("a"), *(make() for make in further), coverage("b")]
        observe(frames, observers, num_workers=workers)
        state = observers[-1].state_dict()
        assert all(torch.equal(value, state[name]) for name, value in alone.state_dict().items())


@pytest.mark.parametrize("workers", [0, 2])
def test_errors_of_a_metric_end_the_run(frames, workers):
    """The metric needs area weights, which one frame lacks."""
    observer = CoverageObserver(CoverageMetric(GRID, has_area_weights=True), "a")
    frames[4] = replace(frames[4], reference_weights=None)
    run = observe(frames, [observer], num_workers=workers, keep_partial=True, skip_bad_frames=True)
    assert (run.num_frames, run.skipped_frames, int(observer.metric.num_frames)) == (4, [], 4)
    assert "weights: the area of each reference point in m2 is needed" in str(run.failure)


def test_one_worker_makes_the_frames_of_a_scene():
    spread = SimulatedFrames("urban", "front_roof_32", num_frames=15, frame_interval_s=10.0)
    tasks = list(group_by_scene(range(15), spread.get_scene_id))
    assert tasks == [[*range(7)], [*range(7, 13)], [13, 14]]
    assert [{spread.simulator.get_run_index(index) for index in task} for task in tasks] == [{0}, {1}, {2}]
    dense = list(group_by_scene(range(700), SimulatedFrames("urban", "front_roof_32", num_frames=1000).get_scene_id))
    assert [index for task in dense for index in task] == [*range(700)]
    assert max(map(len, dense)) == MAX_FRAMES_PER_TASK
    static = SimulatedFrames("courtyard", "front_roof_32", num_frames=3)  # every process has its only scene
    for source in (static, []):
        assert list(group_by_scene(range(3), build_scene_lookup(source))) == [[0], [1], [2]]


class Wrapped:
    """Frames of another source in a class of the user."""

    def __init__(self, frames):
        self.frames = frames

    def __len__(self):
        return len(self.frames)

    def __getitem__(self, index):
        return self.frames[index]


class Forwarding(Wrapped):
    """Wrapper with all attributes of the other source."""

    def __getattr__(self, name):
        return getattr(self.frames, name)


def test_wrapped_frames_keep_their_scenes():
    frames = SimulatedFrames("urban", "front_roof_32", num_frames=15, frame_interval_s=10.0)
    subset, forwarding = RigSubset(frames, {"mine": "front_roof_32"}), Forwarding(frames)
    part = Subset(Forwarding(subset), [14, 0, 6, 7])
    scene_ids = [frames.get_scene_id(index) for index in range(15)]
    assert [build_scene_lookup(subset)(index) for index in range(15)] == scene_ids == [0] * 7 + [1] * 6 + [2] * 2
    assert [build_scene_lookup(forwarding)(index) for index in range(15)] == scene_ids
    assert [build_scene_lookup(part)(index) for index in range(4)] == [2, 0, 0, 1]


def test_each_scene_is_built_by_one_worker(monkeypatch, tmp_path):
    reference = PaperReference(rows=4, columns=4)
    frames = SimulatedFrames(
        "parking", "front_roof_32", num_frames=4, frame_interval_s=35.0, reference_sensor=reference
    )
    build = Scenario.build_scene

    def build_scene(self, seed, run, *args):
        with (tmp_path / "built").open("a") as file:
            file.write(f"{run}\n")
        return build(self, seed, run, *args)

    monkeypatch.setattr(Scenario, "build_scene", build_scene)
    evaluate(frames=frames, cell_m=8.0, num_workers=2)
    assert sorted((tmp_path / "built").read_text().split()) == ["0", "1"]


@pytest.mark.parametrize("frames_of", [Wrapped, lambda frames: Subset(Wrapped(frames), [0, 1])])
def test_several_workers_need_sources_with_scenes(frames, frames_of):
    source = frames_of(Forwarding(frames))
    assert observe(source, [NameObserver()], num_workers=1).num_frames == len(source)
    with pytest.raises(TypeError, match=r"^frames: Wrapped does not name the scene of a frame, so"):
        observe(source, [NameObserver()], num_workers=2, keep_partial=True)


@pytest.mark.parametrize("scenario", ["urban", "courtyard"])
def test_tasks_of_long_runs_need_little_memory(scenario):
    frames = SimulatedFrames(scenario, "front_roof_32", num_frames=20_000)
    tracemalloc.start()
    tasks = group_by_scene(range(20_000), frames.get_scene_id)
    assert sum(map(len, tasks)) == 20_000
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak_bytes < 100_000


class CountingFrames(FramesWithErrors):
    """Dataset that counts in all processes how many frames were made."""

    def __init__(self, frames):
        super().__init__(frames, ())
        self.made = multiprocessing.Value("i", 0)

    def __getitem__(self, index):
        with self.made.get_lock():
            self.made.value += 1
        return super().__getitem__(index)


def test_a_worker_makes_one_task_ahead(frames):
    counting, ahead = CountingFrames(frames), []

    def wait():
        if not ahead:
            time.sleep(0.3)
            ahead.append(counting.made.value)

    observe(counting, [NameObserver(then=wait)], num_workers=1)
    assert ahead[0] <= 2


def test_observers_of_several_rigs_need_a_name(frames):
    with pytest.raises(ValueError, match=r"clouds of 2 rigs \(a, b\): name one"):
        observe(frames, [coverage(rig=None)])
    with pytest.raises(ValueError, match="cannot merge the coverage of rig 'b' into the coverage of 'a'"):
        coverage("a").merge_state(coverage("b"))


def test_a_bad_frame_ends_the_run(frames):
    names = NameObserver()
    run = observe(FramesWithErrors(frames, {3}), [names], keep_partial=True)
    assert (run.num_frames, names.names, run.is_complete) == (3, ["f0", "f1", "f2"], False)
    with pytest.raises(BadFrameError, match="f3"):
        run.raise_failure()


def test_errors_are_raised_unless_partial_results_are_kept(frames):
    with pytest.raises(BadFrameError, match="f3"):
        observe(FramesWithErrors(frames, {3}), [NameObserver()])
    names = NameObserver(then=lambda: len(names.names) < 3 or os.kill(os.getpid(), signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        observe(frames, [names])
    assert names.names == ["f0", "f1", "f2"]


def test_area_average_needs_area_weights(frames):
    metric = CoverageMetric(GRID, has_area_weights=True)
    with pytest.raises(ValueError, match="the area of each reference point in m2 is needed"):
        CoverageObserver(metric, "a").update(replace(frames[0], reference_weights=None))
    CoverageObserver(metric, "a").update(frames[0])
    assert metric.compute().average == "area"


@pytest.mark.parametrize("workers", [0, 2])
def test_bad_frames_are_skipped_on_request(frames, workers):
    names = NameObserver()
    run = observe(FramesWithErrors(frames, {0, 3}), [names], skip_bad_frames=True, num_workers=workers)
    assert names.names == ["f1", "f2", "f4", "f5"]
    assert run.skipped_frames == ["f0 (frame 0): rubbish", "f3 (frame 3): rubbish"]
    assert run.is_complete
    run.raise_failure()


def group_in_tasks(monkeypatch):
    monkeypatch.setattr(pipeline, "group_by_scene", lambda *_: [[0, 1, 2, 3], [4, 5]])


class OddError(ValueError):
    """Error that cannot be built from its text alone."""

    def __init__(self, what, where):
        super().__init__(f"{what} at {where}", lambda: what)

    def __str__(self):
        return self.args[0]


class FramesWithOddErrors(FramesWithErrors):
    """Dataset whose bad frames raise an error without their name."""

    def __getitem__(self, index):
        if index in self.bad:
            raise OddError("a sensor in a wall", index)
        return self.frames[index]


@pytest.mark.parametrize("workers", [0, 1, 2])
def test_other_frames_of_a_task_survive_bad_ones(frames, workers, monkeypatch):
    group_in_tasks(monkeypatch)
    names = NameObserver()
    run = observe(FramesWithErrors(frames, {1, 4}), [names], skip_bad_frames=True, num_workers=workers)
    assert names.names == ["f0", "f2", "f3", "f5"]
    assert run.skipped_frames == ["f1 (frame 1): rubbish", "f4 (frame 4): rubbish"]


@pytest.mark.parametrize("workers", [0, 1, 2])
@pytest.mark.parametrize(
    ("dataset", "error", "message"),
    [
        (FramesWithErrors, BadFrameError, "f2 (frame 2): rubbish"),
        (FramesWithOddErrors, ValueError, "a sensor in a wall at 2"),
    ],
)
def test_frames_before_a_bad_one_are_kept(frames, workers, dataset, error, message, monkeypatch):
    group_in_tasks(monkeypatch)
    names = NameObserver()
    run = observe(dataset(frames, {2}), [names], keep_partial=True, num_workers=workers)
    assert (run.num_frames, names.names, run.skipped_frames) == (2, ["f0", "f1"], [])
    with pytest.raises(error) as raised:
        run.raise_failure()
    assert str(raised.value) == message
    assert f"raise {'OddError' if dataset is FramesWithOddErrors else 'BadFrameError'}(" in "".join(
        format_exception(raised.value)
    )


def test_without_a_good_frame_there_is_no_result(frames):
    with pytest.raises(BadFrameError, match="f0"):
        observe(FramesWithErrors(frames, {0}), [NameObserver()])
    with pytest.raises(ValueError, match="no frame could be used"):
        observe(FramesWithErrors(frames, set(range(6))), [NameObserver()], skip_bad_frames=True)


def test_errors_of_one_observer_keep_earlier_frames(frames):
    names = NameObserver()
    run = observe(frames, [names, NameObserver(then=lambda: 1 / (4 - len(names.names)))], keep_partial=True)
    assert (run.num_frames, names.names, run.is_complete) == (3, ["f0", "f1", "f2", "f3"], False)
    with pytest.raises(ZeroDivisionError):
        run.raise_failure()
    with pytest.raises(ZeroDivisionError):
        observe(frames, [NameObserver(then=lambda: 1 / 0)], keep_partial=True)  # nothing to keep


class KillingFrames(FramesWithErrors):
    """Dataset whose bad frames kill the process that makes them, as a lack of memory does."""

    def __getitem__(self, index):
        if index in self.bad:
            os.kill(os.getpid(), signal.SIGKILL)
        return self.frames[index]


# torch may report the worker again when its iterator is deleted.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_results_survive_a_killed_worker(frames):
    names = NameObserver()
    run = observe(KillingFrames(frames, {5}), [names], num_workers=1, keep_partial=True)
    assert (run.num_frames, run.is_complete) == (len(names.names), False)
    assert names.names == ["f0", "f1", "f2", "f3", "f4"][: len(names.names)]
    with pytest.raises(
        ChildProcessError, match=rf"a worker was killed after frame {run.num_frames}, .*; use fewer workers"
    ):
        run.raise_failure()


@pytest.mark.parametrize("method", ["spawn", "forkserver"])
def test_workers_support_all_start_methods(frames, method, monkeypatch):
    monkeypatch.setattr(pipeline, "get_start_method", lambda: method)
    names = NameObserver()
    observe(frames, [names], num_workers=1)
    assert names.names == ["f0", "f1", "f2", "f3", "f4", "f5"]


@pytest.mark.parametrize(("method", "has_advice"), [("fork", False), ("spawn", True), ("forkserver", True)])
def test_programs_without_main_guard_get_advice(method, has_advice, monkeypatch):
    monkeypatch.setattr(multiprocessing, "get_start_method", lambda **_: method)
    error = RuntimeError("DataLoader worker (pid(s) 7) exited unexpectedly")
    assert ("__main__" in str(frame_workers.find_killed_worker(error, num_workers=2, num_frames=0))) == has_advice


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_signals_to_workers_end_the_run(frames, monkeypatch):
    """A scheduler ends all processes of a job, and a worker may end first."""
    monkeypatch.setattr(pipeline, "clear_frames", lambda _: os.kill(os.getpid(), signal.SIGTERM))
    names = NameObserver()
    with handle_termination(lambda _: None) as signals:
        run = observe(KillingFrames(frames, {5}), [names], num_workers=1, keep_partial=True)
    assert signals == [signal.SIGTERM]
    assert run.num_frames == len(names.names) > 0
    assert isinstance(run.failure, KeyboardInterrupt)


def test_ctrl_c_waits_for_all_observers(frames):
    calls = []

    def press():
        calls.append(1)
        if len(calls) == 3:
            os.kill(os.getpid(), signal.SIGINT)

    before, first, last = signal.getsignal(signal.SIGINT), NameObserver(press), NameObserver()
    run = observe(frames, [first, last], keep_partial=True)
    assert first.names == last.names == ["f0", "f1", "f2"]
    assert (run.num_frames, type(run.failure), run.is_complete) == (3, KeyboardInterrupt, False)
    assert signal.getsignal(signal.SIGINT) is before
    with pytest.raises(KeyboardInterrupt):
        run.raise_failure()


def test_observe_runs_in_any_thread(frames):
    names = NameObserver()
    thread = threading.Thread(target=observe, args=(frames, [names]))
    thread.start()
    thread.join()
    assert len(names.names) == 6


class AfterThree:
    """Rule that is reached after three frames."""

    progress_text = "nearly there"

    def is_reached(self, num_frames):
        return num_frames >= 3

    def estimate_num_frames(self, max_frames):
        return min(max_frames, 3)


@pytest.mark.parametrize("progress", [False, True])
def test_stopping_rules_end_the_run(frames, progress, capsys):
    run = observe(frames, [NameObserver()], stopping_rule=AfterThree(), show_progress=progress, title="frames")
    assert (run.num_frames, run.is_complete) == (3, True)
    output = capsys.readouterr().err
    assert ("3/3" in output and "nearly there" in output) == progress
    assert bool(output) == progress


@pytest.mark.parametrize(("workers", "threads"), [(0, 2), (1, 1), (2, 1)])
def test_observers_leave_cores_to_workers(frame_of, monkeypatch, workers, threads):
    monkeypatch.setattr("torchcover.evaluation.frame_workers.count_cores", lambda: 2)
    before, thread_counts = torch.get_num_threads(), []
    torch.set_num_threads(2)
    try:
        names = NameObserver(lambda: thread_counts.append(torch.get_num_threads()))
        observe([frame_of(index) for index in range(3)], [names], num_workers=workers)
        assert (thread_counts, torch.get_num_threads()) == ([threads] * 3, 2)
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("shown", [True, False])
def test_waits_are_shown_on_terminals(capsys, monkeypatch, shown):
    for variable in ("FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
        monkeypatch.setenv(variable, "1")
    with show_wait("preparing the scene", is_shown=shown):
        pass
    assert ("preparing the scene" in capsys.readouterr().err) == shown


def test_rates_are_means_over_rounds_of_workers(monkeypatch):
    """Four workers start in 8 s; then each round gives four frames every 4 s: one frame per second."""
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
