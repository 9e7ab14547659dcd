"""Ranks get the result of a single process, and an error of one rank ends all of them."""

import math
import os
import pickle
import signal
import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta

import pytest
import torch
from torch.distributed import FileStore, HashStore, TCPStore

import torchcover
from torchcover.data import BadFrameError, FrameDataset, FrameMetadata, SimulatedFrames
from torchcover.evaluation import Ranks, join_ranks
from torchcover.evaluation.ranks import RanksParams, serialize

TIMEOUT_S = 30.0


class Drive(FrameDataset):
    """Source of frames; the frames with the indices `bad` raise an error."""

    metadata = FrameMetadata(("a", "b"), {"scenario": None, "frames": "drive", "seed": None})

    def __init__(self, frame_of, length=7, bad=(), content="drive", delay_s=0.0):
        self.frame_of, self.length, self.bad, self.content = frame_of, length, bad, content
        self.delay_s = delay_s

    def collect_content(self):
        return {"frames": self.content}

    def __len__(self):
        return self.length

    def __getitem__(self, index):
        time.sleep(self.delay_s)
        if index in self.bad:
            raise BadFrameError(f"f{index} (frame {index}): rubbish")
        return self.frame_of(index)


class NameObserver:
    """Observer that collects the names of frames."""

    def __init__(self):
        self.names = []

    def update(self, frame):
        self.names.append(frame.name)

    def compute(self):
        return sorted(self.names)

    def merge_state(self, other):
        self.names += other.names

    def state_dict(self):
        return {"names": self.names}

    def load_state_dict(self, state):
        self.names = list(state["names"])


def run_in_processes(folder, work, size=2):
    """Call `work(ranks)` in a process per rank and return its result or error, with its duration in seconds."""
    store, children = folder / f"store{time.monotonic_ns()}", []
    for rank in range(size):
        if not (child := os.fork()):
            torch.set_num_threads(1)
            begin_s = time.monotonic()
            try:
                outcome = work(Ranks(FileStore(str(store), size), rank, size))
            except BaseException as error:
                outcome = error
            folder.joinpath(f"{rank}.pickle").write_bytes(pickle.dumps((outcome, time.monotonic() - begin_s)))
            os._exit(0)
        children.append(child)
    deadline_s = time.monotonic() + TIMEOUT_S
    while children and time.monotonic() < deadline_s:
        children = [child for child in children if os.waitpid(child, os.WNOHANG) == (0, 0)]
        time.sleep(0.01)
    for child in children:  # still running after the timeout
        os.kill(child, signal.SIGKILL)
    assert not children
    return [pickle.loads(folder.joinpath(f"{rank}.pickle").read_bytes()) for rank in range(size)]


def measure(source, ranks=None, **settings):
    result = torchcover.evaluate(
        ["a", "b"], frames=source, cell_m=8.0, observers={"names": NameObserver()}, ranks=ranks, **settings
    )
    counts, sums = {}, {}
    for name, coverage in result.coverages.items():
        counts[name] = (
            coverage.counts,
            coverage.point_counts,
            coverage.observed_frames,
            coverage.block_sums.frame_counts,
        )
        sums[name] = (coverage.block_sums.sums, coverage.radius)
    run = (result.run.num_frames, dict(result.run.counts), result.run.skipped_frames, str(result.run.failure))
    return {"counts": (counts, run, result.observer_results), "sums": sums}


def check_equal(actual, expected):
    assert str(actual["counts"]) == str(expected["counts"])
    torch.testing.assert_close(actual["counts"][0], expected["counts"][0], rtol=0, atol=0)
    torch.testing.assert_close(actual["sums"], expected["sums"], rtol=1e-12, atol=0, equal_nan=True)


@pytest.mark.parametrize(("length", "workers", "size"), [(7, 0, 3), (1, 0, 2), (5, 2, 2)])
def test_ranks_get_the_result_of_one_process(frame_of, tmp_path, length, workers, size):
    source = Drive(frame_of, length, bad={4})
    single = measure(source, skip_bad_frames=True)
    for measured, _ in run_in_processes(
        tmp_path, lambda ranks: measure(source, ranks, skip_bad_frames=True, num_workers=workers), size
    ):
        check_equal(measured, single)


def run_in_threads(work, size=3, ranks_class=Ranks, store=None, params=RanksParams()):  # noqa: B008  (immutable)
    """Call `work(ranks)` in a thread per rank and return its results or errors."""
    store = store or HashStore()
    store.set_timeout(timedelta(seconds=TIMEOUT_S / 3))

    def run(rank):
        try:
            return work(ranks_class(store, rank, size, params))
        except Exception as error:
            return error

    with ThreadPoolExecutor(size) as pool:
        return list(pool.map(run, range(size)))


class CountingRanks(Ranks):
    """Ranks that count the messages to themselves."""

    received = 0

    def _receive(self, sender, receiver):
        self.received += receiver == self.rank
        return super()._receive(sender, receiver)


@pytest.mark.parametrize("size", [2, 3, 8, 11, 64])
def test_ranks_merge_in_order_within_logarithmic_steps(size):
    def merge_names(rank):
        observer = NameObserver()
        observer.names = [f"{rank.rank}", f"{rank.rank} too"]
        (merged,) = rank.merge([observer])
        return merged.names, rank.received

    outcomes = run_in_threads(merge_names, size, CountingRanks)
    expected = [name for rank in range(size) for name in (f"{rank}", f"{rank} too")]
    assert [names for names, _ in outcomes] == [expected] * size
    assert max(received for _, received in outcomes) == math.ceil(math.log2(size))


@pytest.mark.parametrize("part_bytes", [7, 64, 2**22])
def test_gather_returns_the_values_in_rank_order(part_bytes):
    stores = []

    def work(rank):
        stores.append(rank.store)
        first = rank.gather(torch.full((rank.rank,), float(rank.rank)))
        return first, rank.gather(f"then {rank.rank}")

    for first, then in run_in_threads(work, params=RanksParams(max_part_bytes=part_bytes)):
        torch.testing.assert_close(first, [torch.full((rank,), float(rank)) for rank in range(3)], rtol=0, atol=0)
        assert then == ["then 0", "then 1", "then 2"]
    # A message that has been read by its only receiver is deleted.
    assert not stores[0].check(["1 to 0: 1 0"])


def test_gather_splits_messages_larger_than_the_store_limit():
    store, value = TCPStore("127.0.0.1", 0, is_master=True), torch.arange(2**21, dtype=torch.float64)
    for gathered in run_in_threads(lambda rank: rank.gather(value[rank.rank :])[1], 2, store=store):
        torch.testing.assert_close(gathered, value[1:], rtol=0, atol=0)


@pytest.mark.parametrize(
    ("local", "name", "device"), [("3", "cuda", "cuda:3"), (None, "cuda", "cuda:0"), ("3", "cpu", "cpu")]
)
def test_each_local_rank_has_one_gpu(monkeypatch, local, name, device):
    monkeypatch.delenv("LOCAL_RANK", raising=False)
    if local:
        monkeypatch.setenv("LOCAL_RANK", local)
    assert Ranks(HashStore(), 0, 2).get_device(name) == device


def test_messages_carry_tensors_on_the_cpu():
    assert pickle.loads(serialize({"x": torch.arange(3)}))["x"].tolist() == [0, 1, 2]
    with pytest.raises(NotImplementedError, match="no data"):  # a device that nothing can be copied from
        serialize({"x": torch.empty(3, device="meta")})


def test_gather_raises_if_a_rank_aborts():
    def work(rank):
        if rank.rank == 1:
            rank.report_failure(MemoryError(), is_abort=True)
        else:
            rank.gather("x")

    assert list(map(repr, run_in_threads(work)))[::2] == ["ChildProcessError('rank 1: MemoryError')"] * 2


@pytest.mark.parametrize("late", range(3))
def test_ranks_leave_after_rank_0_has_written(late):
    events, begin_s = [], time.monotonic()

    def work(rank):
        time.sleep(0.3 * (rank.rank == late))
        events.append(("written", "ready", "ready")[rank.rank])
        rank.shut_down()
        events.append(("closed", "left", "left")[rank.rank])

    assert run_in_threads(work, params=RanksParams(shutdown_timeout_s=20.0)) == [None] * 3
    assert events.index("written") < events.index("left")
    assert events.count("ready") == events[: events.index("closed")].count("ready") == 2
    assert time.monotonic() - begin_s < 10.0


def test_rank_0_stops_waiting_after_the_timeout():
    begin_s = time.monotonic()
    Ranks(HashStore(), 0, 2, RanksParams(shutdown_timeout_s=0.3)).shut_down()
    assert 0.3 <= time.monotonic() - begin_s < 3.0


def test_only_the_first_failure_is_reported():
    first, second = (Ranks(store, rank, 2) for store in [HashStore()] for rank in range(2))
    assert first.failure is second.failure is None
    second.report_failure(KeyboardInterrupt())
    first.report_failure(ValueError("too late"))
    assert first.failure == second.failure == "rank 1: KeyboardInterrupt"
    with pytest.raises(ChildProcessError, match=r"^rank 1: KeyboardInterrupt$"):
        first.check_failures()


def test_check_identity_raises_if_rank_0_aborts():
    def work(rank):
        if rank.rank == 0:
            rank.report_failure(MemoryError(), is_abort=True)
        else:
            rank.check_identity({"seed": "1"})

    outcomes = run_in_threads(work)
    assert list(map(repr, outcomes)) == ["None", *["ChildProcessError('rank 0: MemoryError')"] * 2]


@pytest.mark.parametrize("failing", range(3))
def test_an_abort_reaches_all_other_ranks(failing):
    def work(rank):
        try:
            with rank.abort_on_error():
                if rank.rank == failing:
                    raise ValueError("no  such\nthing")
                rank._wait_for(["never"])
        finally:
            rank.shut_down()

    message = f"rank {failing}: ValueError: no such thing"
    for rank, error in enumerate(run_in_threads(work)):
        expected = ValueError("no  such\nthing") if rank == failing else ChildProcessError(message)
        assert repr(error) == repr(expected)


def test_a_run_over_ranks_resumes_from_checkpoints(frame_of, tmp_path):
    path = tmp_path / "out" / "checkpoint.npz"
    run_in_processes(tmp_path, lambda ranks: measure(Drive(frame_of), ranks, num_frames=3, checkpoint=path))
    assert sorted(file.name for file in path.parent.iterdir()) == ["checkpoint.npz", "checkpoint_rank1.npz"]
    done = {0, 1, 2}
    for measured, _ in run_in_processes(
        tmp_path, lambda ranks: measure(Drive(frame_of, bad=done), ranks, checkpoint=path)
    ):
        check_equal(measured, measure(Drive(frame_of)))
    with pytest.raises(ValueError, match=r"a checkpoint of another run: ranks \(2 there, 1 here\)"):
        measure(Drive(frame_of), checkpoint=path)


def test_an_error_of_one_rank_keeps_measured_frames(frame_of, tmp_path):
    source = Drive(frame_of, 400, bad={5}, delay_s=0.01)

    def measure_partially(ranks):
        with pytest.warns(RuntimeWarning, match="The run was cut short after"):
            return measure(source, ranks)

    (first, first_s), (second, second_s) = run_in_processes(tmp_path, measure_partially)
    num_frames, _, _, failure = first["counts"][1]
    assert 3 <= num_frames < 300
    assert len(first["counts"][2]["names"]) == num_frames
    assert failure == "rank 1: BadFrameError: f5 (frame 5): rubbish"
    assert second["counts"][1][3] == "f5 (frame 5): rubbish"
    assert max(first_s, second_s) < 10.0


def test_an_error_before_the_first_frame_ends_all(frame_of, tmp_path):
    def work(ranks):
        return measure(Drive(frame_of, 400, content=f"content of {ranks.rank}", delay_s=0.01), ranks)

    (first, first_s), (second, second_s) = run_in_processes(tmp_path, work)
    assert isinstance(second, ValueError)
    assert str(second) == (
        'rank 1 has other settings than rank 0: frames ("content of 0" there, "content of 1" here); '
        "start all ranks with the same settings"
    )
    assert isinstance(first, ChildProcessError)
    assert str(first) == f"rank 1: ValueError: {second}"
    assert max(first_s, second_s) < 10.0
    for error, _ in run_in_processes(tmp_path, lambda ranks: measure(Drive(frame_of), ranks, target_error="1%")):
        assert "target error: a rank only has its share of the frames" in str(error)


def test_waiting_for_a_dead_rank_can_be_interrupted(frame_of, tmp_path):
    def work(ranks):
        if ranks.rank == 1:
            ranks.check_identity = lambda _: os._exit(0)
        else:
            threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT)).start()
        try:
            return measure(Drive(frame_of), ranks)
        finally:
            signal.signal(signal.SIGINT, signal.SIG_IGN)

    tmp_path.joinpath("1.pickle").write_bytes(pickle.dumps((None, 0.0)))
    (first, first_s), _ = run_in_processes(tmp_path, work)
    assert isinstance(first, KeyboardInterrupt)
    assert first_s < 10.0


@pytest.mark.parametrize("frame_interval_s", [0.1, 10.0, 120.0])
def test_shares_are_whole_scenes_and_only_grow(frame_interval_s):
    frames = SimulatedFrames("urban", "front_roof_32", num_frames=5000, frame_interval_s=frame_interval_s)
    get_scene_id, all_ranks = frames.simulator.get_run_index, [Ranks(None, rank, 3) for rank in range(3)]
    shares = [list(ranks.iterate_share(range(5000), get_scene_id)) for ranks in all_ranks]
    assert sorted(index for share in shares for index in share) == list(range(5000))
    scenes = [{get_scene_id(index) for index in share} for share in shares]
    assert not (scenes[0] & scenes[1] | scenes[0] & scenes[2] | scenes[1] & scenes[2])
    assert max(map(len, scenes)) - min(map(len, scenes)) <= 1
    for ranks, share in zip(all_ranks, shares, strict=True):
        fewer = list(ranks.iterate_share(range(1234), get_scene_id))
        assert share[: len(fewer)] == fewer


def test_without_torchrun_there_are_no_ranks(monkeypatch):
    for size in (None, "1"):
        monkeypatch.delenv("WORLD_SIZE", raising=False)
        if size:
            monkeypatch.setenv("WORLD_SIZE", size)
        with join_ranks() as ranks:
            assert ranks is None


def test_join_ranks_reads_the_environment_of_torchrun(frame_of, tmp_path):
    """Processes that only have the environment of `torchrun` in common share a run."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]

    def work(ranks):
        os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": f"{port}", "WORLD_SIZE": "2", "RANK": f"{ranks.rank}"}
        with join_ranks() as joined:
            return (joined.rank, joined.num_ranks), measure(Drive(frame_of), joined)

    single = measure(Drive(frame_of))
    for rank, ((rank_and_size, measured), _) in enumerate(run_in_processes(tmp_path, work)):
        assert rank_and_size == (rank, 2)
        check_equal(measured, single)
