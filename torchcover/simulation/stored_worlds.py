"""Worlds that were drawn before, read from disk: to build one takes twenty times as long, and more.

What lies there are numbers and words, never code: to read it runs none, whoever wrote it. It is believed in a folder of
the user's own only, to which nobody else may write.
"""

import hashlib
import json
import os
import shutil
import time
import warnings
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import shapely

from torchcover import __version__
from torchcover.files import BadFileError, check_memory, reads, said_gb
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation.builtin import builtin_names
from torchcover.simulation.documents import builtin_hashes
from torchcover.simulation.scenario import Mover, Scenario
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.sumo.simulating import home
from torchcover.simulation.traffic.fleet import load_bodies
from torchcover.simulation.world import Actor, World

# What all worlds on disk may take: the environment variable, and gigabytes without it. 0: there are none.
BUDGET, USUAL_GB = "TORCHCOVER_CACHE_GB", 1.0
# On a disk that is as good as full nothing is tried.
LEAST_FREE_BYTES = 100e6
# What a world is made of.
KINDS: dict[str, Callable[..., Any]] = {kind.__name__: kind for kind in (World, Actor, Trajectory, Mesh)}
# Whose code draws worlds.
ROOMS = ("files", "geometry", "simulation")
NOT_KEPT = f"worlds are not kept on disk for later runs; --set no_cache=true, or {BUDGET}=0, asks for none"

_said: set[str] = set()


class StoredWorlds:
    """The worlds of a scenario. Those that are drawn are kept in torchcover/worlds of $XDG_CACHE_HOME or ~/.cache.

    Where they take more than the budget, those go that were not asked for longest, but none of this run: else a long
    one would leave nothing to the next. With `no_cache` every world is built.
    """

    def __init__(self, scenario: Scenario, seed: int, *, no_cache: bool = False) -> None:
        self._scenario, self._seed = scenario, seed
        self._began_s = time.time() - 1.0  # the clock that files are dated by is another one
        # A kind of traffic from elsewhere may have changed, and nothing here would tell.
        draws = not scenario.repeats and type(scenario.traffic).__module__.startswith("torchcover.")
        self._budget_bytes = 1e9 * said_gb(BUDGET, USUAL_GB) if draws and not no_cache else 0.0
        self._folder = _own_folder() if self._budget_bytes else None
        self._drawn_from = ""

    def world(self, run: int, ego: Mesh | None) -> World:
        """That of one run, see `Scenario.locate`, to the bit as `Scenario.world` builds it with an ego in traffic."""
        if self._folder is None or ego is None:
            return self._scenario.world(self._seed, run, ego)
        self._drawn_from = self._drawn_from or _drawn_from(self._scenario)
        key = hashlib.sha256(f"{self._drawn_from} {self._seed} {run}".encode()).hexdigest()
        path, bodies = self._folder / f"{key}.world", {**load_bodies(), "ego": ego}
        try:
            with suppress(FileNotFoundError):
                world = _read(path, key, bodies)
                with suppress(OSError):  # it may be read-only by now
                    os.utime(path)
                return world
        except BadFileError as error:
            _say("a world on disk is damaged, and built anew", error)
        with warnings.catch_warnings(record=True) as doubts:
            warnings.simplefilter("always")
            world = self._scenario.world(self._seed, run, ego)
        for doubt in doubts:
            warnings.warn_explicit(doubt.message, doubt.category, doubt.filename, doubt.lineno)
        if not any(issubclass(doubt.category, UserWarning) for doubt in doubts):  # whoever reads it would not be told
            self._keep(path, _packed(world, key, bodies))
        return world

    def _keep(self, path: Path, content: Sequence[bytes | memoryview]) -> None:
        # Other runs may be writing the same; what a kill leaves is too old one day, as all else is.
        aside = path.with_name(uuid4().hex)
        try:
            if _has_room(path.parent, self._budget_bytes - sum(map(len, content)), self._began_s):
                with aside.open("wb") as file:
                    file.writelines(content)
                os.replace(aside, path)
        except OSError as error:
            with suppress(OSError):
                aside.unlink()
            self._folder = None
            _say(NOT_KEPT, error)


def _own_folder() -> Path | None:
    """Where worlds lie; None if nothing can be written there, or by others, too. Said here, not by each worker."""
    given = os.environ.get("XDG_CACHE_HOME", "")
    try:
        folder = Path(given if os.path.isabs(given) else Path.home() / ".cache", "torchcover", "worlds")
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        about = folder.stat()
        if hasattr(os, "getuid") and (about.st_uid != os.getuid() or about.st_mode & 0o022):
            raise OSError(f"{folder} may be written to by others")
        if not os.access(folder, os.W_OK) or shutil.disk_usage(folder).free < LEAST_FREE_BYTES:
            raise OSError(f"{folder} may not be written to, or its disk is full")
        return folder
    except (OSError, RuntimeError) as error:  # or there is no home
        _say(NOT_KEPT, error)
        return None


def _has_room(folder: Path, most_bytes: float, began_s: float) -> bool:
    """Whether worlds take so much at most, once those are gone that have to, and that nobody asked for since a time."""
    found = list[tuple[float, int, Path]]()
    for path in folder.iterdir():
        with suppress(FileNotFoundError):  # another run makes room, too
            found.append((path.stat().st_mtime, path.stat().st_size, path))
    taken_bytes = sum(size for _, size, _ in found)
    for asked_s, size, path in sorted(found):
        if taken_bytes > most_bytes and asked_s < began_s:
            path.unlink(missing_ok=True)
            taken_bytes -= size
    return taken_bytes <= most_bytes


def _drawn_from(scenario: Scenario) -> str:
    """All that its worlds follow from, but the seed and the run: no sensors, weather or names are among it."""
    assert scenario.traffic is not None  # it draws
    told: list[object] = [__version__, _code(), np.__version__, np.show_config(mode="dicts")["SIMD Extensions"]]
    told += [shapely.__version__, shapely.geos_version_string, builtin_names("materials"), builtin_hashes("road_users")]
    told += [type(scenario.traffic).__name__, scenario.traffic.content(), (scenario.ego or Mover()).content()]
    with suppress(ImportError, OSError):  # there is no SUMO
        told.append((home() / "bin" / "sumo").stat().st_mtime_ns)
    return hashlib.sha256(json.dumps(told, sort_keys=True, default=repr).encode()).hexdigest()


@cache
def _code() -> str:
    """A hash of the code that draws worlds."""
    package, found = Path(__file__).parents[1], hashlib.sha256()
    for path in sorted(path for room in ROOMS for path in (package / room).rglob("*.py")):
        found.update(f"{path.relative_to(package)} {path.stat().st_size} ".encode() + path.read_bytes())
    return found.hexdigest()


def _packed(world: World, key: str, bodies: Mapping[str, Mesh]) -> Sequence[bytes | memoryview]:
    """A world as a file: checksum, length of the text, text, numbers; of bodies that worlds share, the names only.

    The text has types and shapes of all arrays, and kinds and fields of all parts, of which the last is the world.
    """
    arrays, parts, numbers = list[Any](), list[Any](), list[bytes | memoryview]()
    # By where it is in memory: views of the same numbers are one array.
    known: dict[object, dict[str, Any]] = {id(mesh): {"body": name} for name, mesh in bodies.items()}

    def told(value: Any) -> Any:  # noqa: ANN401  (whatever a world is made of)
        if isinstance(value, np.ndarray):
            place = value.__array_interface__["data"], value.shape, value.strides, value.dtype.str
            if place not in known:
                known[place] = {"array": len(arrays)}
                arrays.append((value.dtype.str, value.shape))
                numbers.append(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data)
                numbers.append(bytes(-value.nbytes % 8))
            return known[place]
        if type(value).__name__ in KINDS:
            if id(value) not in known:
                each = value if isinstance(value, Mesh) else (getattr(value, one.name) for one in fields(value))
                parts.append([type(value).__name__, *map(told, each)])
                known[id(value)] = {"part": len(parts) - 1}
            return known[id(value)]
        return list(map(told, value)) if isinstance(value, tuple) else value

    told(world)
    text = json.dumps([arrays, parts], default=np.generic.item).encode()
    text += b" " * (-len(text) % 8)
    content, checksum = [len(text).to_bytes(8, "little"), text, *numbers], zlib.crc32(key.encode())
    for part in content:
        checksum = zlib.crc32(part, checksum)
    return [checksum.to_bytes(8, "little"), *content]


@reads("a world")
def _read(path: Path, key: str, bodies: Mapping[str, Mesh]) -> World:
    """A world from a file, into whose arrays nobody may write."""
    check_memory(2 * path.stat().st_size)
    content = np.fromfile(path, np.uint8)
    content.flags.writeable = False
    if zlib.crc32(content[8:].data, zlib.crc32(key.encode())) != int.from_bytes(content[:8].tobytes(), "little"):
        raise ValueError("its checksum is wrong")
    first = 16 + int.from_bytes(content[8:16].tobytes(), "little")
    told, parts = json.loads(content[16:first].tobytes())
    arrays, made = list[Any](), list[Any]()
    for kind, shape in told:
        size = np.dtype(kind).itemsize * int(np.prod(shape, dtype=np.int64))
        arrays.append(content[first : first + size].view(kind).reshape(shape))
        first += size + -size % 8
    known: dict[str, Any] = {"array": arrays, "part": made, "body": bodies}

    def meant(value: Any) -> Any:  # noqa: ANN401  (whatever a world is made of)
        if isinstance(value, dict):
            ((kind, number),) = value.items()
            return known[kind][number]
        return tuple(map(meant, value)) if isinstance(value, list) else value

    for name, *each in parts:
        made.append(KINDS[name](*map(meant, each)))
    world: World = made[-1]
    return world


def _say(what: str, why: Exception) -> None:
    """Warn, once however many worlds it is about."""
    if what not in _said:
        _said.add(what)
        warnings.warn(f"{what} ({why})", stacklevel=2)
