"""Several processes share a run: one result, that of a single one; and whatever happens to one happens to all."""

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
from torchcover.data import BadFrameError, FrameDataset, SimulatedFrames
from torchcover.evaluation import Ranks, join_ranks
from torchcover.evaluation.ranks import ABORTED, serialize

LONGEST_S = 30.0


class Drive(FrameDataset):
    """A source of frames, some of which may be bad."""

    rigs = ("a", "b")
    sensors = {}  # noqa: RUF012
    ego_outline_m = None
    description = {"scenario": None, "frames": "drive", "seed": None}  # noqa: RUF012
    has_area_weights = False
    reference_record = None
    get_scene_id = staticmethod(int)

    def __init__(self, frame_of, length=7, bad=(), content="drive", delay_s=0.0):
        self.frame_of, self.length, self.bad, self.content = frame_of, length, bad, {"frames": content}
        self.delay_s = delay_s

    def __len__(self):
        return self.length

    def __getitem__(self, index):
        time.sleep(self.delay_s)
        if index in self.bad:
            raise BadFrameError(f"f{index} (frame {index}): rubbish")
        return self.frame_of(index)


class Names:
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


def in_ranks(folder, work, size=2):
    """What `work(ranks)` gives in each of these processes, or raises, and after how many seconds."""
    store, children = folder / f"store{time.monotonic_ns()}", []
    for rank in range(size):
        if not (child := os.fork()):
            torch.set_num_threads(1)
            begin_s = time.monotonic()
            try:
                answer = work(Ranks(FileStore(str(store), size), rank, size))
            except BaseException as error:
                answer = error
            folder.joinpath(f"{rank}.pickle").write_bytes(pickle.dumps((answer, time.monotonic() - begin_s)))
            os._exit(0)
        children.append(child)
    deadline_s = time.monotonic() + LONGEST_S
    while children and time.monotonic() < deadline_s:
        children = [child for child in children if os.waitpid(child, os.WNOHANG) == (0, 0)]
        time.sleep(0.01)
    for child in children:  # it hangs
        os.kill(child, signal.SIGKILL)
    assert not children
    return [pickle.loads(folder.joinpath(f"{rank}.pickle").read_bytes()) for rank in range(size)]


def measured(source, ranks=None, **settings):
    result = torchcover.evaluate(
        ["a", "b"], frames=source, cell_m=8.0, observers={"names": Names()}, ranks=ranks, **settings
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


def check_equal(found, single):
    assert str(found["counts"]) == str(single["counts"])
    torch.testing.assert_close(found["counts"][0], single["counts"][0], rtol=0, atol=0)
    torch.testing.assert_close(found["sums"], single["sums"], rtol=1e-12, atol=0, equal_nan=True)


@pytest.mark.parametrize(("length", "workers", "size"), [(7, 0, 3), (1, 0, 2), (5, 2, 2)])
def test_all_get_the_result_of_a_single_process(frame_of, tmp_path, length, workers, size):
    source = Drive(frame_of, length, bad={4})
    single = measured(source, skip_bad_frames=True)
    for found, _ in in_ranks(
        tmp_path, lambda ranks: measured(source, ranks, skip_bad_frames=True, num_workers=workers), size
    ):
        check_equal(found, single)


def in_threads(work, size=3, kind=Ranks, store=None):
    """What `work(ranks)` gives or raises in ranks that have no more in common than a store."""
    store = store or HashStore()
    store.set_timeout(timedelta(seconds=LONGEST_S / 3))

    def outcome(rank):
        try:
            return work(kind(store, rank, size))
        except Exception as error:
            return error

    with ThreadPoolExecutor(size) as pool:
        return list(pool.map(outcome, range(size)))


class Counting(Ranks):
    """Counts what it merges."""

    received = 0

    def _receive(self, rank, to=None):
        self.received += to is None
        return super()._receive(rank, to)


@pytest.mark.parametrize("size", [2, 3, 8, 11, 64])
def test_ranks_merge_in_order_and_none_of_them_many(size):
    def merged(rank):
        observer = Names()
        observer.names = [f"{rank.rank}", f"{rank.rank} too"]
        (whole,) = rank.merge([observer])
        return whole.names, rank.received

    found = in_threads(merged, size, Counting)
    assert [names for names, _ in found] == [
        [name for rank in range(size) for name in (f"{rank}", f"{rank} too")]
    ] * size
    assert max(received for _, received in found) == math.ceil(math.log2(size))


@pytest.mark.parametrize("part_bytes", [7, 64, 2**22])
def test_ranks_get_what_others_have_in_order_and_in_parts(monkeypatch, part_bytes):
    monkeypatch.setattr("torchcover.evaluation.ranks.PART_BYTES", part_bytes)
    stores = []

    def work(rank):
        stores.append(rank.store)
        first = rank.gather(torch.full((rank.rank,), float(rank.rank)))
        return first, rank.gather(f"then {rank.rank}")

    for first, then in in_threads(work):
        torch.testing.assert_close(first, [torch.full((rank,), float(rank)) for rank in range(3)], rtol=0, atol=0)
        assert then == ["then 0", "then 1", "then 2"]
    # What everybody has read from everybody is not kept.
    assert not stores[0].check(["1 to 0: 1 0"])


def test_more_than_the_store_of_torchrun_takes_at_once_gets_through():
    store, value = TCPStore("127.0.0.1", 0, is_master=True), torch.arange(2**21, dtype=torch.float64)
    for found in in_threads(lambda rank: rank.gather(value[rank.rank :])[1], 2, store=store):
        torch.testing.assert_close(found, value[1:], rtol=0, atol=0)


@pytest.mark.parametrize(
    ("local", "name", "device"), [("3", "cuda", "cuda:3"), (None, "cuda", "cuda:0"), ("3", "cpu", "cpu")]
)
def test_each_rank_of_a_machine_has_a_gpu_of_its_own(monkeypatch, local, name, device):
    monkeypatch.delenv("LOCAL_RANK", raising=False)
    if local:
        monkeypatch.setenv("LOCAL_RANK", local)
    assert Ranks(HashStore(), 0, 2).get_device(name) == device


def test_what_travels_is_on_the_cpu():
    assert pickle.loads(serialize({"x": torch.arange(3)}))["x"].tolist() == [0, 1, 2]
    with pytest.raises(NotImplementedError, match="no data"):  # a device that nothing can be copied from
        serialize({"x": torch.empty(3, device="meta")})


def test_who_waits_for_what_others_have_seen_learns_that_one_has_ended():
    def work(rank):
        if rank.rank == 1:
            rank.report_failure(MemoryError(), ABORTED)
        else:
            rank.gather("x")

    assert list(map(repr, in_threads(work)))[::2] == ["ChildProcessError('rank 1: MemoryError')"] * 2


@pytest.mark.parametrize("late", range(3))
def test_ranks_leave_when_all_is_written_and_rank_0_as_the_last_one(monkeypatch, late):
    monkeypatch.setattr("torchcover.evaluation.ranks.PARTING_S", 20.0)
    happened, begin_s = [], time.monotonic()

    def work(rank):
        time.sleep(0.3 * (rank.rank == late))
        happened.append(("written", "ready", "ready")[rank.rank])
        rank.shut_down()
        happened.append(("closed", "left", "left")[rank.rank])

    assert in_threads(work) == [None] * 3
    assert happened.index("written") < happened.index("left")
    assert happened.count("ready") == happened[: happened.index("closed")].count("ready") == 2
    assert time.monotonic() - begin_s < 10.0


def test_rank_0_waits_for_one_that_is_gone_for_a_while_only(monkeypatch):
    monkeypatch.setattr("torchcover.evaluation.ranks.PARTING_S", 0.3)
    begin_s = time.monotonic()
    Ranks(HashStore(), 0, 2).shut_down()
    assert 0.3 <= time.monotonic() - begin_s < 3.0


def test_the_first_failure_is_the_one_that_is_told_of():
    first, second = (Ranks(store, rank, 2) for store in [HashStore()] for rank in range(2))
    assert first.failure is second.failure is None
    second.report_failure(KeyboardInterrupt())
    first.report_failure(ValueError("too late"))
    assert first.failure == second.failure == "rank 1: KeyboardInterrupt"
    with pytest.raises(ChildProcessError, match=r"^rank 1: KeyboardInterrupt$"):
        first.check_failures()


def test_who_waits_for_what_rank_0_is_about_learns_that_it_has_ended():
    def work(rank):
        if rank.rank == 0:
            rank.report_failure(MemoryError(), ABORTED)
        else:
            rank.check_identity({"seed": "1"})

    found = in_threads(work)
    assert list(map(repr, found)) == ["None", *["ChildProcessError('rank 0: MemoryError')"] * 2]


@pytest.mark.parametrize("failing", range(3))
def test_who_ends_all_ends_with_its_own_error_and_the_others_with_words_of_it(failing):
    def work(rank):
        try:
            with rank.abort_on_error():
                if rank.rank == failing:
                    raise ValueError("no  such\nthing")
                rank._wait_for(["never"])
        finally:
            rank.shut_down()

    words = f"rank {failing}: ValueError: no such thing"
    for rank, error in enumerate(in_threads(work)):
        expected = ValueError("no  such\nthing") if rank == failing else ChildProcessError(words)
        assert repr(error) == repr(expected)


def test_a_run_over_ranks_goes_on_from_its_checkpoints(frame_of, tmp_path):
    path = tmp_path / "out" / "checkpoint.npz"
    in_ranks(tmp_path, lambda ranks: measured(Drive(frame_of), ranks, num_frames=3, checkpoint=path))
    assert sorted(file.name for file in path.parent.iterdir()) == ["checkpoint.npz", "checkpoint_rank1.npz"]
    done = {0, 1, 2}
    for found, _ in in_ranks(tmp_path, lambda ranks: measured(Drive(frame_of, bad=done), ranks, checkpoint=path)):
        check_equal(found, measured(Drive(frame_of)))
    with pytest.raises(ValueError, match=r"a checkpoint of another run: ranks \(2 there, 1 here\)"):
        measured(Drive(frame_of), checkpoint=path)


def test_an_error_of_one_ends_all_and_what_there_is_is_kept(frame_of, tmp_path):
    source = Drive(frame_of, 400, bad={5}, delay_s=0.01)

    def cut_short(ranks):
        with pytest.warns(RuntimeWarning, match="The run was cut short after"):
            return measured(source, ranks)

    (first, first_s), (second, second_s) = in_ranks(tmp_path, cut_short)
    steps, _, _, failure = first["counts"][1]
    assert 3 <= steps < 300
    assert len(first["counts"][2]["names"]) == steps
    assert failure == "rank 1: BadFrameError: f5 (frame 5): rubbish"
    assert second["counts"][1][3] == "f5 (frame 5): rubbish"
    assert max(first_s, second_s) < 10.0


def test_an_error_before_the_first_step_ends_all(frame_of, tmp_path):
    def work(ranks):
        return measured(Drive(frame_of, 400, content=f"that of {ranks.rank}", delay_s=0.01), ranks)

    (first, first_s), (second, second_s) = in_ranks(tmp_path, work)
    assert isinstance(second, ValueError)
    assert str(second) == (
        'rank 1 is about another run than rank 0: frames ("that of 0" there, "that of 1" here); start all with the same'
    )
    assert isinstance(first, ChildProcessError)
    assert str(first) == f"rank 1: ValueError: {second}"
    assert max(first_s, second_s) < 10.0
    for error, _ in in_ranks(tmp_path, lambda ranks: measured(Drive(frame_of), ranks, target_error="1%")):
        assert "target error: a rank only has its share of the frames" in str(error)


def test_who_waits_for_a_rank_that_is_gone_can_be_ended(frame_of, tmp_path):
    def work(ranks):
        if ranks.rank == 1:
            ranks.check_identity = lambda _: os._exit(0)
        else:
            threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT)).start()
        try:
            return measured(Drive(frame_of), ranks)
        finally:
            signal.signal(signal.SIGINT, signal.SIG_IGN)

    tmp_path.joinpath("1.pickle").write_bytes(pickle.dumps((None, 0.0)))
    (first, first_s), _ = in_ranks(tmp_path, work)
    assert isinstance(first, KeyboardInterrupt)
    assert first_s < 10.0


@pytest.mark.parametrize("frame_interval_s", [0.1, 10.0, 120.0])
def test_shares_are_whole_worlds_and_more_steps_only_add_to_them(frame_interval_s):
    frames = SimulatedFrames("urban", "front_roof_32", num_frames=5000, frame_interval_s=frame_interval_s)
    get_scene_id, everybody = frames.simulator.get_run_index, [Ranks(None, rank, 3) for rank in range(3)]
    shares = [list(ranks.iterate_share(range(5000), get_scene_id)) for ranks in everybody]
    assert sorted(index for share in shares for index in share) == list(range(5000))
    worlds = [{get_scene_id(index) for index in share} for share in shares]
    assert not (worlds[0] & worlds[1] | worlds[0] & worlds[2] | worlds[1] & worlds[2])
    assert max(map(len, worlds)) - min(map(len, worlds)) <= 1
    for ranks, share in zip(everybody, shares, strict=True):
        fewer = list(ranks.iterate_share(range(1234), get_scene_id))
        assert share[: len(fewer)] == fewer


def test_without_torchrun_there_are_no_ranks(monkeypatch):
    for size in (None, "1"):
        monkeypatch.delenv("WORLD_SIZE", raising=False)
        if size:
            monkeypatch.setenv("WORLD_SIZE", size)
        with join_ranks() as ranks:
            assert ranks is None


def test_torchrun_tells_two_processes_which_they_are(frame_of, tmp_path):
    """Processes of one machine that have its environment alone share a run."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]

    def work(ranks):
        os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": f"{port}", "WORLD_SIZE": "2", "RANK": f"{ranks.rank}"}
        with join_ranks() as joined:
            return (joined.rank, joined.num_ranks), measured(Drive(frame_of), joined)

    single = measured(Drive(frame_of))
    for rank, ((who, found), _) in enumerate(in_ranks(tmp_path, work)):
        assert who == (rank, 2)
        check_equal(found, single)
