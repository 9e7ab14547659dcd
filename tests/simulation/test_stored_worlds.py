"""Worlds on disk: the same to the bit as those that are built, whatever has become of the disk meanwhile."""

import dataclasses
import os
import warnings
import zlib

import numpy as np
import pytest

from torchcover.simulation import PaperReference, Rig, Scenario, Simulator, stored_worlds
from torchcover.simulation.stored_worlds import BUDGET, StoredWorlds
from torchcover.simulation.traffic import Highway, Parking, Urban
from torchcover.simulation.traffic.fleet import load_bodies

EGO = {"shape": {"type": "box", "size_m": [4, 2, 1.5]}}
LOT = {"type": "parking", "duration_s": 1.0, "time_step_s": 0.2, "crossings": 0, "parked_share": 0.1}


def lot(ego=EGO, **keys):
    return Scenario.model_validate({"name": "lot", "ego": ego, "traffic": {**LOT, **keys}})


@pytest.fixture(autouse=True)
def disk(monkeypatch, tmp_path):
    """A disk for worlds, and nothing said so far: the files on it, and how often a world was built."""
    monkeypatch.setenv(BUDGET, "1")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(stored_worlds, "_said", set())
    built, world = [], Scenario.world

    def counted(self, seed=0, episode=0, ego=None):
        built.append(episode)
        return world(self, seed, episode, ego)

    monkeypatch.setattr(Scenario, "world", counted)
    return lambda: sorted((tmp_path / "cache" / "torchcover" / "worlds").glob("*")), built


def world_of(scenario, run=0, seed=0, **keys):
    return StoredWorlds(scenario, seed, **keys).world(run, scenario.ego_mesh())


def same(one, other):
    if isinstance(one, np.ndarray):
        return (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())
    if dataclasses.is_dataclass(one):
        names = [field.name for field in dataclasses.fields(one)]
        return type(one) is type(other) and all(same(getattr(one, name), getattr(other, name)) for name in names)
    if isinstance(one, tuple):
        return type(one) is type(other) and len(one) == len(other) and all(map(same, one, other))
    return type(one) is type(other) and one == other


@pytest.mark.parametrize(
    "traffic",
    [Urban(duration_s=2.0, traffic_per_km=5.0, people_per_km=4.0), Highway(duration_s=2.0), Parking(duration_s=2.0)],
    ids=lambda traffic: traffic.type,
)
def test_a_world_from_disk_is_the_one_that_was_built_and_shares_its_bodies(disk, traffic):
    files, built = disk
    scenario = Scenario(name="drawn", traffic=traffic)
    worlds, ego = StoredWorlds(scenario, 5), scenario.ego_mesh()
    first, again = worlds.world(2, ego), worlds.world(2, ego)
    assert built == [2]
    assert len(files()) == 1
    assert same(first, again)
    bodies = {id(mesh) for mesh in load_bodies().values()} | {id(ego)}
    assert {id(actor.mesh) for actor in (again.ego, *again.objects)} <= bodies
    shared = [{id(actor.trajectory.times_s) for actor in world.actors} for world in (first, again)]
    assert len(shared[1]) <= len(shared[0])


def test_frames_are_the_same_to_the_bit(disk):
    rigs, reference = {"roof": Rig.load("front_roof_128")}, PaperReference(64, 64)
    seen = [Simulator(lot(), rigs, reference, no_cache=no_cache).step(8) for no_cache in (True, False, False)]
    assert disk[1] == [1, 1]
    for other in seen[1:]:
        np.testing.assert_array_equal(other.clouds["roof"], seen[0].clouds["roof"])
        np.testing.assert_array_equal(other.reference, seen[0].reference)


def test_a_world_is_found_by_all_that_it_is_drawn_from_and_by_nothing_else(disk, tmp_path):
    files, _ = disk
    body = tmp_path / "ego.yaml"
    parts = "name: ego\nparts: [{{name: all, shape: {{type: box, size_m: [4, 2, {height}]}}}}]\n"
    body.write_text(parts.format(height=1.5))
    own = {"shape": {"type": "vehicle", "vehicle": str(body)}}
    makes = [
        lambda: world_of(lot()),
        lambda: world_of(lot(), run=1),
        lambda: world_of(lot(), seed=1),
        lambda: world_of(lot(parked_share=0.2)),
        lambda: world_of(lot(ego=own)),
        lambda: (body.write_text(parts.format(height=1.6)), world_of(lot(ego=own))),
    ]
    for count, make in enumerate(makes, 1):
        make()
        assert len(files()) == count
    foggy = lot().model_copy(update={"name": "other", "description": "words"})
    world_of(foggy)
    assert len(files()) == len(makes)


@pytest.mark.parametrize("change", ["code", "library"])
def test_other_code_or_another_library_draws_anew(disk, monkeypatch, change):
    world_of(lot())
    if change == "code":
        monkeypatch.setattr(stored_worlds, "_code", lambda: "other")
    else:
        monkeypatch.setattr(np, "__version__", "0")
    world_of(lot())
    assert disk[1] == [0, 0]


def harm(content, how):
    if how == "cut short":
        return content[: len(content) // 2]
    if how == "empty":
        return b""
    if how == "not ours":
        return b"torchcover" * 99
    at = {"a number": len(content) - 100, "a word": 40, "the length": 9}[how]
    return content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]


@pytest.mark.parametrize("how", ["a number", "a word", "the length", "cut short", "empty", "not ours"])
def test_a_damaged_world_is_built_anew_and_said_once(disk, how):
    files, built = disk
    whole = [world_of(lot(), run) for run in (0, 1)]
    for path in files():
        path.write_bytes(harm(path.read_bytes(), how))
    with pytest.warns(UserWarning, match=r"^a world on disk is damaged, and built anew \(.*\.world: ") as said:
        again = [world_of(lot(), run) for run in (0, 1)]
    assert len(said) == 1
    assert built == [0, 1, 0, 1]
    assert same(again[0], whole[0])
    assert same(again[1], whole[1])
    world_of(lot())
    assert len(built) == 4


def test_the_file_of_another_world_is_none(disk):
    files, built = disk
    world_of(lot())
    [first] = files()
    world_of(lot(), 1)
    [second] = set(files()) - {first}
    second.write_bytes(first.read_bytes())
    with pytest.warns(UserWarning, match="checksum"):
        world_of(lot(), 1)
    assert built == [0, 1, 1]


def test_what_others_wrote_runs_no_code(disk):
    files, _ = disk
    world_of(lot())
    [path] = files()
    for kind in ("|O", "<f8"):
        text = f'[[["{kind}", [1]]], [["system", "true"]]]'.encode()
        content = len(text).to_bytes(8, "little") + text + bytes(8)
        path.write_bytes(zlib.crc32(content, zlib.crc32(path.stem.encode())).to_bytes(8, "little") + content)
        with pytest.raises(ValueError, match=r"\.world: "):
            stored_worlds._read(path, path.stem, {})


def _age(files):
    for age, path in enumerate(sorted(files, key=lambda path: path.stat().st_mtime)):
        os.utime(path, (age, age))


def test_those_that_nobody_asked_for_longest_go_but_none_of_this_run(disk, monkeypatch):
    files, built = disk
    for run in range(4):
        world_of(lot(), run)
    size = max(path.stat().st_size for path in files())
    _age(files())
    world_of(lot(), 0)  # the oldest has been asked for again
    monkeypatch.setenv(BUDGET, str(4.1 * size / 1e9))
    world_of(lot(), 4)
    assert len(files()) == 4
    _age(files())
    built.clear()
    monkeypatch.setenv(BUDGET, str(2.1 * size / 1e9))
    one_run = StoredWorlds(lot(), 0)
    for run in (0, 7, 8, 9, 0, 7, 8):
        one_run.world(run, lot().ego_mesh())
    assert built == [7, 8, 9, 8]
    assert len(files()) == 2


def test_without_a_budget_nothing_lies_there(disk, monkeypatch):
    world_of(lot(), no_cache=True)
    monkeypatch.setenv(BUDGET, "0")
    world_of(lot())
    assert disk[0]() == []
    for wrong in ("much", "-1", "nan"):
        monkeypatch.setenv(BUDGET, wrong)
        with pytest.raises(ValueError, match=BUDGET):
            world_of(lot())


def no_home(monkeypatch, tmp_path):
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.delenv("HOME", raising=False)

    def nobody(path):
        return path

    monkeypatch.setattr(os.path, "expanduser", nobody)  # as of a user whom the system does not know


def a_file(monkeypatch, tmp_path):
    (tmp_path / "cache").write_text("in the way")


def read_only(monkeypatch, tmp_path):
    monkeypatch.setattr(stored_worlds.os, "access", lambda *_: False)


def full_from_the_start(monkeypatch, tmp_path):
    monkeypatch.setattr(stored_worlds, "LEAST_FREE_BYTES", 1e30)


def full_at_once(monkeypatch, tmp_path):
    def full(aside, _):
        raise OSError(28, "No space left on device", str(aside))

    monkeypatch.setattr(stored_worlds.os, "replace", full)


def of_others(monkeypatch, tmp_path):
    (tmp_path / "cache" / "torchcover" / "worlds").mkdir(parents=True)
    (tmp_path / "cache" / "torchcover" / "worlds").chmod(0o777)


@pytest.mark.parametrize("lacks", [no_home, a_file, read_only, full_from_the_start, full_at_once, of_others])
def test_without_a_disk_the_run_goes_on_with_one_remark(disk, monkeypatch, tmp_path, lacks):
    lacks(monkeypatch, tmp_path)

    def run():
        worlds = StoredWorlds(lot(), 0)
        for number in (0, 1, 0):
            worlds.world(number, lot().ego_mesh())
        world_of(lot())

    with pytest.warns(UserWarning, match=r"worlds are not kept on disk .* --set no_cache=true") as said:
        run()
    assert len(said) == 1
    assert disk[1] == [0, 1, 0, 0]
    assert disk[0]() == []


def test_two_runs_write_the_same_world(disk, monkeypatch):
    files, built = disk
    replace, meanwhile = os.replace, []

    def late(source, target):
        monkeypatch.setattr(stored_worlds.os, "replace", replace)
        meanwhile.append(world_of(lot()))
        replace(source, target)

    monkeypatch.setattr(stored_worlds.os, "replace", late)
    world_of(lot())
    assert built == [0, 0]
    assert len(files()) == 1
    assert same(world_of(lot()), meanwhile[0])
    assert built == [0, 0]


def test_a_world_with_doubts_is_not_kept_but_doubted_each_time(disk, monkeypatch):
    world = Scenario.world

    def doubtful(self, *args):
        warnings.warn("three lorries left out", stacklevel=2)
        return world(self, *args)

    monkeypatch.setattr(Scenario, "world", doubtful)
    for _ in range(2):
        with pytest.warns(UserWarning, match="three lorries"):
            world_of(lot())
    assert disk[0]() == []


def test_traffic_from_elsewhere_is_not_kept(disk):
    class Elsewhere(Parking):
        """Whose code nobody hashes."""

    world_of(lot().model_copy(update={"traffic": Elsewhere(**LOT)}))
    assert disk[0]() == []
