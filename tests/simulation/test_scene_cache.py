"""Scene cache: cached scenes equal built scenes, whatever happens to the disk."""

import dataclasses
import json
import os
import warnings

import numpy as np
import pytest

from torchcover.files import BadFileError
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation import PaperReference, Rig, Scenario, Simulator, scene_cache
from torchcover.simulation.scene import Actor, Scene
from torchcover.simulation.scene_cache import SceneCache, encode_scene, read_scene
from torchcover.simulation.shapes import Box
from torchcover.simulation.traffic import HighwayTraffic, ParkingTraffic, UrbanTraffic
from torchcover.simulation.traffic.fleet import load_bodies

EGO = {"shape": {"type": "box", "size_m": [4, 2, 1.5]}}
LOT = {"type": "parking", "duration_s": 1.0, "time_step_s": 0.2, "crossings_per_aisle": 0, "parked_share": 0.1}


def create_lot(ego=EGO, **keys):
    return Scenario.model_validate({"name": "lot", "ego": ego, "traffic": {**LOT, **keys}})


@pytest.fixture(autouse=True)
def disk(monkeypatch, tmp_path):
    """Provide an empty cache folder: a function that lists its files, and the runs that were built."""
    monkeypatch.setenv("TORCHCOVER_CACHE_GB", "1")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    built, world = [], Scenario.build_scene

    def counted(self, seed=0, run_index=0, ego_mesh=None):
        built.append(run_index)
        return world(self, seed, run_index, ego_mesh)

    monkeypatch.setattr(Scenario, "build_scene", counted)
    return lambda: sorted((tmp_path / "cache" / "torchcover" / "scenes").glob("*")), built


def world_of(scenario, run=0, seed=0, **keys):
    return SceneCache(scenario, seed, **keys).build(run, scenario.build_ego_mesh())


def same(first, second):
    if isinstance(first, np.ndarray):
        return (first.dtype, first.shape, first.tobytes()) == (second.dtype, second.shape, second.tobytes())
    if dataclasses.is_dataclass(first):
        names = [field.name for field in dataclasses.fields(first)]
        return type(first) is type(second) and all(same(getattr(first, name), getattr(second, name)) for name in names)
    if isinstance(first, tuple):
        return type(first) is type(second) and len(first) == len(second) and all(map(same, first, second))
    return type(first) is type(second) and first == second


@pytest.mark.parametrize(
    "traffic",
    [
        UrbanTraffic(duration_s=2.0, traffic_per_km=5.0, people_per_km=4.0),
        HighwayTraffic(duration_s=2.0),
        ParkingTraffic(duration_s=2.0),
    ],
    ids=lambda traffic: traffic.type,
)
def test_cached_scenes_equal_built_scenes(disk, traffic):
    files, built = disk
    scenario = Scenario(name="drawn", traffic=traffic)
    cache, ego = SceneCache(scenario, 5), scenario.build_ego_mesh()
    first, cached = cache.build(2, ego), cache.build(2, ego)
    assert built == [2]
    assert len(files()) == 1
    assert same(first, cached)
    bodies = {id(mesh) for mesh in load_bodies().values()} | {id(ego)}
    assert {id(actor.mesh) for actor in (cached.ego, *cached.objects)} <= bodies
    shared = [{id(actor.trajectory.times_s) for actor in world.actors} for world in (first, cached)]
    assert len(shared[1]) <= len(shared[0])


def test_actors_that_share_a_mesh_share_it_again(tmp_path):
    mesh, trajectory = Box(type="box", size_m=(4, 2, 1.5)).build_mesh(), Trajectory.create_static([9.0, 0.0, 0.0])
    ego, *actors = (Actor(name, "car", mesh, trajectory) for name in ("ego", "a", "b"))
    world = Scene((), ego, tuple(actors))
    np.savez(tmp_path / "a.npz", **encode_scene("a", world, {}))
    cached = read_scene(tmp_path / "a.npz", {})
    assert same(world, cached)
    assert cached.ego.mesh is cached.actors[0].mesh is cached.actors[1].mesh


def test_frames_are_the_same_to_the_bit(disk):
    rigs, reference = {"roof": Rig.load("front_roof_128")}, PaperReference(64, 64)
    observations = [
        Simulator(create_lot(), rigs, reference, no_cache=no_cache).simulate_frame(8)
        for no_cache in (True, False, False)
    ]
    assert disk[1] == [1, 1]
    for other in observations[1:]:
        np.testing.assert_array_equal(other.clouds["roof"], observations[0].clouds["roof"])
        np.testing.assert_array_equal(other.reference, observations[0].reference)


def test_cache_keys_depend_on_all_inputs_only(disk, tmp_path):
    files, _ = disk
    body = tmp_path / "ego.yaml"
    parts = "name: ego\nparts: [{{name: all, shape: {{type: box, size_m: [4, 2, {height}]}}}}]\n"
    body.write_text(parts.format(height=1.5))
    ego_keys = {"shape": {"type": "vehicle", "vehicle": str(body)}}
    makes = [
        lambda: world_of(create_lot()),
        lambda: world_of(create_lot(), run=1),
        lambda: world_of(create_lot(), seed=1),
        lambda: world_of(create_lot(parked_share=0.2)),
        lambda: world_of(create_lot(ego=ego_keys)),
        lambda: (body.write_text(parts.format(height=1.6)), world_of(create_lot(ego=ego_keys))),
    ]
    for count, make in enumerate(makes, 1):
        make()
        assert len(files()) == count
    foggy = create_lot().model_copy(update={"name": "other", "description": "words"})
    world_of(foggy)
    assert len(files()) == len(makes)


@pytest.mark.parametrize("change", ["code", "library"])
def test_other_code_or_libraries_invalidate_the_cache(disk, monkeypatch, change):
    world_of(create_lot())
    if change == "code":
        monkeypatch.setattr(scene_cache, "_hash_code", lambda: "other")
    else:
        monkeypatch.setattr(np, "__version__", "0")
    world_of(create_lot())
    assert disk[1] == [0, 0]


def write_damage(content, how):
    if how == "cut short":
        return content[: len(content) // 2]
    if how == "empty":
        return b""
    if how == "not ours":
        return b"torchcover" * 99
    offset = {"a number": 3 * len(content) // 4, "a word": 400}[how]
    return content[:offset] + bytes([content[offset] ^ 1]) + content[offset + 1 :]


@pytest.mark.parametrize("how", ["a number", "a word", "cut short", "empty", "not ours", "another scene"])
def test_damaged_scenes_are_rebuilt_with_a_warning(disk, how):
    files, built = disk
    scene = world_of(create_lot())
    [path] = files()
    if how == "another scene":
        world_of(create_lot(), 1)
        [other] = set(files()) - {path}
        path.write_bytes(other.read_bytes())
    else:
        path.write_bytes(write_damage(path.read_bytes(), how))
    built.clear()
    with pytest.warns(UserWarning, match=r"a cached scene is not used \(.*\.npz: "):
        assert same(world_of(create_lot()), scene)
    world_of(create_lot())
    assert built == [0]


def test_a_scene_file_runs_no_code(disk, tmp_path):
    text = np.frombuffer(json.dumps(["a", {"system": ["true"]}]).encode(), np.uint8)
    for numbers in (np.zeros(8), np.array([print], object)):
        np.savez(tmp_path / "a.npz", scene=text, numbers=numbers)
        with pytest.raises(BadFileError, match=r"a\.npz: "):
            read_scene(tmp_path / "a.npz", {})


def create_special_file(path, kind, target):
    """Create a foreign file, link or folder at a path of the cache."""
    if kind == "link":
        path.symlink_to(target)
    elif kind == "hard link":
        path.hardlink_to(target)
    elif kind == "FIFO":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        path.write_bytes(bytes(100))


NAMES = {"link": "a" * 64 + ".npz", "hard link": "b" * 64 + ".npz", "FIFO": "c" * 64 + ".npz",
         "folder": "d" * 64 + ".npz", "file": "mine.npz", "longer": "e" * 65 + ".npz"}  # fmt: skip


def test_foreign_files_stay_and_do_not_interfere(disk, monkeypatch, tmp_path):
    files, built = disk
    world_of(create_lot())
    [path] = files()
    target = tmp_path / "target"
    target.write_bytes(bytes(10_000_000))
    for kind, name in NAMES.items():
        create_special_file(path.with_name(name), kind, target)
        os.utime(path.with_name(name), (0, 0), follow_symlinks=False)
    before = [
        (file_path.lstat().st_ino, file_path.lstat().st_mtime)
        for file_path in sorted(path.parent.glob("*"))
        if file_path != path
    ]
    monkeypatch.setenv("TORCHCOVER_CACHE_GB", str(2.5 * path.stat().st_size / 1e9))
    for run in range(4):
        world_of(create_lot(), run)
    after = [(file_path.lstat().st_ino, file_path.lstat().st_mtime) for file_path in sorted(path.parent.glob("*"))]
    assert set(before) <= set(after)
    assert len(after) == len(before) + 2
    assert (built, target.stat().st_size) == ([0, 1, 2, 3], 10_000_000)


@pytest.mark.parametrize("kind", ["link", "hard link", "FIFO", "folder"])
def test_links_in_place_of_scenes_are_ignored(disk, tmp_path, kind):
    files, built = disk
    scene = world_of(create_lot())
    [path] = files()
    path.rename(tmp_path / "target")
    create_special_file(path, kind, tmp_path / "target")
    content, stamp = (tmp_path / "target").read_bytes(), (tmp_path / "target").stat().st_mtime_ns
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a folder cannot be replaced
        assert same(world_of(create_lot()), scene)
    assert built == [0, 0]
    assert ((tmp_path / "target").read_bytes(), (tmp_path / "target").stat().st_mtime_ns) == (content, stamp)


def _age(files):
    for age, path in enumerate(sorted(files, key=lambda path: path.stat().st_mtime)):
        os.utime(path, (age, age))


def test_the_oldest_scenes_are_deleted_for_new_ones(disk, monkeypatch):
    files, built = disk
    for run in range(4):
        world_of(create_lot(), run)
    size = max(path.stat().st_size for path in files())
    _age(files())
    world_of(create_lot(), 0)  # now it is the newest file
    built.clear()
    monkeypatch.setenv("TORCHCOVER_CACHE_GB", str(3.1 * size / 1e9))
    world_of(create_lot(), 4)
    assert len(files()) == 3
    for run in (0, 3, 4):
        world_of(create_lot(), run)
    assert built == [4]
    monkeypatch.setenv("TORCHCOVER_CACHE_GB", str(0.5 * size / 1e9))
    world_of(create_lot(), 5)
    assert len(files()) == 3  # it does not fit, and nothing is deleted for it


def test_without_a_budget_nothing_is_written(disk, monkeypatch):
    world_of(create_lot(), no_cache=True)
    monkeypatch.setenv("TORCHCOVER_CACHE_GB", "0")
    world_of(create_lot())
    assert disk[0]() == []
    for wrong in ("much", "-1", "nan"):
        monkeypatch.setenv("TORCHCOVER_CACHE_GB", wrong)
        with pytest.raises(ValueError, match="TORCHCOVER_CACHE_GB"):
            world_of(create_lot())


def no_home(monkeypatch, tmp_path):
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.delenv("HOME", raising=False)

    def nobody(path):
        return path

    monkeypatch.setattr(os.path, "expanduser", nobody)  # a user without a home folder


def a_file(monkeypatch, tmp_path):
    (tmp_path / "cache").write_text("in the way")


def read_only(monkeypatch, tmp_path):
    monkeypatch.setattr(scene_cache.os, "access", lambda *_: False)


def full_at_once(monkeypatch, tmp_path):
    def full(aside, _):
        raise OSError(28, "No space left on device", str(aside))

    monkeypatch.setattr(scene_cache.os, "replace", full)


def of_others(monkeypatch, tmp_path):
    (tmp_path / "cache" / "torchcover" / "scenes").mkdir(parents=True)
    (tmp_path / "cache" / "torchcover" / "scenes").chmod(0o777)


def a_link(monkeypatch, tmp_path):
    (tmp_path / "cache" / "torchcover").mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "cache" / "torchcover" / "scenes").symlink_to(tmp_path / "elsewhere")


@pytest.mark.parametrize("lacks", [no_home, a_file, read_only, full_at_once, of_others, a_link])
def test_without_a_disk_runs_continue_with_one_warning(disk, monkeypatch, tmp_path, lacks):
    lacks(monkeypatch, tmp_path)

    def run():
        cache = SceneCache(create_lot(), 0)
        for number in (0, 1, 0):
            cache.build(number, create_lot().build_ego_mesh())
        world_of(create_lot())

    with pytest.warns(UserWarning, match=r"scenes are not cached .* --set no_cache=true") as caught:
        run()
    assert len({str(warning.message) for warning in caught}) == 1
    assert disk[1] == [0, 1, 0, 0]
    assert disk[0]() == []


def test_concurrent_runs_write_the_same_scene(disk, monkeypatch):
    files, built = disk
    replace, meanwhile = os.replace, []

    def late(source, target):
        monkeypatch.setattr(scene_cache.os, "replace", replace)
        meanwhile.append(world_of(create_lot()))
        replace(source, target)

    monkeypatch.setattr(scene_cache.os, "replace", late)
    world_of(create_lot())
    assert built == [0, 0]
    assert len(files()) == 1
    assert same(world_of(create_lot()), meanwhile[0])
    assert built == [0, 0]


def test_scenes_with_warnings_are_not_cached(disk, monkeypatch):
    world = Scenario.build_scene

    def doubtful(self, *args):
        warnings.warn("three lorries left out", stacklevel=2)
        return world(self, *args)

    monkeypatch.setattr(Scenario, "build_scene", doubtful)
    for _ in range(2):
        with pytest.warns(UserWarning, match="three lorries"):
            world_of(create_lot())
    assert disk[0]() == []


def test_traffic_of_other_packages_is_not_cached(disk):
    class Elsewhere(ParkingTraffic):
        """Traffic whose code is not hashed."""

    world_of(create_lot().model_copy(update={"traffic": Elsewhere(**LOT)}))
    assert disk[0]() == []
