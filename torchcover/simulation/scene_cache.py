"""A cache of scenes on disk, in torchcover/scenes of $XDG_CACHE_HOME or ~/.cache: one file of arrays and JSON each."""

import hashlib
import json
import os
import re
import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields
from functools import cache, partial
from pathlib import Path
from stat import S_ISDIR, S_ISREG
from typing import Any
from uuid import uuid4

import numpy as np
import shapely
from numpy.typing import NDArray

from torchcover import __version__
from torchcover.files import BadFileError, check_kind, parse_json, read_npz, reads, said_gb
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation.builtin import builtin_names
from torchcover.simulation.documents import builtin_hashes
from torchcover.simulation.scenario import Mover, Scenario
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.sumo.simulating import home
from torchcover.simulation.traffic.fleet import load_bodies
from torchcover.simulation.world import Actor, World

OWN_NAME = re.compile(r"[0-9a-f]{64}\.(npz|[0-9a-f]{32})")  # scenes, and temporary files of them; all others stay
KINDS: dict[str, Any] = {kind.__name__: kind for kind in (World, Actor, Trajectory, Mesh)}


class SceneCache:
    """The scenes of a scenario; those that are built are kept, up to TORCHCOVER_CACHE_GB (1), the oldest go first."""

    def __init__(self, scenario: Scenario, seed: int, *, no_cache: bool = False) -> None:
        self._scenario, self._seed = scenario, seed
        # The code of other packages may change unnoticed.
        is_known = not scenario.repeats and type(scenario.traffic).__module__.startswith("torchcover.")
        self._limit_bytes = 1e9 * said_gb("TORCHCOVER_CACHE_GB", 1.0) if is_known and not no_cache else 0.0
        self._folder = _open_folder() if self._limit_bytes else None

    def build(self, run: int, ego: Mesh | None) -> World:
        """Return the scene of a run, as `Scenario.world` builds it, to the bit; one of traffic is cached."""
        if self._folder is None or ego is None:
            return self._scenario.world(self._seed, run, ego)
        key = hashlib.sha256(f"{_hash_sources(self._scenario)} {self._seed} {run}".encode()).hexdigest()
        path, bodies = self._folder / f"{key}.npz", {**load_bodies(), "ego": ego}
        try:
            if _stat_own(path):
                scene = read_scene(path, bodies)
                with suppress(OSError):  # it may be read-only
                    os.utime(path)
                return scene
        except (BadFileError, FileNotFoundError) as error:
            warnings.warn(f"a cached scene is not used ({error})", stacklevel=2)
        with warnings.catch_warnings(record=True) as raised:
            warnings.simplefilter("always")
            scene = self._scenario.world(self._seed, run, ego)
        for warning in raised:
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
        if not any(issubclass(warning.category, UserWarning) for warning in raised):  # which a reader would not get
            self._write(path, encode_scene(key, scene, bodies))
        return scene

    def _write(self, path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Write a scene; before it, delete the oldest until there is room."""
        temporary, room_bytes = (
            path.with_suffix(f".{uuid4().hex}"),
            self._limit_bytes - sum(array.nbytes for array in arrays.values()),
        )
        if room_bytes < 0:
            return
        try:
            files = [(status, place) for place in path.parent.iterdir() if (status := _stat_own(place))]
            for status, place in sorted(files, key=lambda file: -file[0].st_mtime_ns):
                room_bytes -= status.st_size
                if room_bytes < 0:
                    place.unlink(missing_ok=True)
            with temporary.open("xb") as file:
                np.savez(file, **arrays)  # type: ignore[arg-type]  # of no other keyword
            os.replace(temporary, path)
        except OSError as error:
            with suppress(OSError):
                temporary.unlink()
            self._folder = None
            _warn_without(OSError(error.errno, error.strerror, str(path.parent)))


def _stat_own(path: Path) -> os.stat_result | None:
    """Return the status of a file of this cache: by its name, regular, of this user, without other names; else None."""
    with suppress(OSError):
        status = path.lstat()
        is_own = S_ISREG(status.st_mode) and status.st_uid == os.getuid() and status.st_nlink == 1
        return status if is_own and OWN_NAME.fullmatch(path.name) else None
    return None


def _open_folder() -> Path | None:
    """Return the folder of scenes; None, with a warning, if it is a link, or others may write to it."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    try:
        folder = Path(base if os.path.isabs(base) else Path.home() / ".cache", "torchcover", "scenes")
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        for status in (folder.lstat(), folder.parent.lstat()):
            if not S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o022:
                raise OSError(f"{folder}: it is a link, or others may write to it")
        if not os.access(folder, os.W_OK):
            raise OSError(f"{folder}: it may not be written to")
    except (OSError, RuntimeError) as error:  # RuntimeError: there is no home
        _warn_without(error)
        return None
    return folder


def _warn_without(error: Exception) -> None:
    remedy = "--set no_cache=true, or TORCHCOVER_CACHE_GB=0, asks for none"
    warnings.warn(f"scenes are not cached ({error}); {remedy}", stacklevel=3)


def _hash_sources(scenario: Scenario) -> str:
    """Hash what scenes follow from but seed and run: traffic and ego, code, libraries; no sensors, weather or names."""
    assert scenario.traffic is not None
    sources: list[object] = [__version__, _hash_code(), np.__version__, np.show_config(mode="dicts")["SIMD Extensions"]]
    sources += [shapely.__version__, shapely.geos_version_string, builtin_names("materials")]
    sources += [builtin_hashes("road_users"), type(scenario.traffic).__name__, scenario.traffic.content()]
    sources.append((scenario.ego or Mover()).content())
    with suppress(ImportError, OSError):  # SUMO is not installed
        sources.append((home() / "bin" / "sumo").stat().st_mtime_ns)
    return hashlib.sha256(json.dumps(sources, sort_keys=True, default=repr).encode()).hexdigest()


@cache
def _hash_code() -> str:
    package, digest = Path(__file__).parents[1], hashlib.sha256()
    for path in sorted(path for room in ("files", "geometry", "simulation") for path in (package / room).rglob("*.py")):
        digest.update(f"{path.relative_to(package)} {path.stat().st_size} ".encode() + path.read_bytes())
    return digest.hexdigest()


def encode_scene(key: str, scene: World, bodies: Mapping[str, Mesh]) -> dict[str, NDArray[Any]]:
    """Return a scene as arrays by number, and `scene`: the JSON of its key and of itself, in bytes.

    An array that is there several times is written once; of `bodies`, which scenes share, the names only.
    """
    names, arrays, number_of = {id(mesh): name for name, mesh in bodies.items()}, dict[str, Any](), dict[object, str]()

    def encode(value: Any) -> Any:  # noqa: ANN401
        if isinstance(value, np.ndarray):
            memory = value.__array_interface__["data"], value.shape, value.strides, value.dtype.str
            number = number_of.setdefault(memory, str(len(number_of)))
            arrays[number] = value
            return {"array": number}
        if id(value) in names:
            return {"body": names[id(value)]}
        if type(value).__name__ in KINDS:
            items = value if isinstance(value, Mesh) else [getattr(value, field.name) for field in fields(value)]
            return {type(value).__name__: [encode(item) for item in items]}
        return [encode(item) for item in value] if isinstance(value, tuple) else value

    text = json.dumps([key, encode(scene)], default=np.generic.item).encode()
    return {"scene": np.frombuffer(text, np.uint8), **arrays}


@reads("a scene")
def read_scene(path: Path, bodies: Mapping[str, Mesh]) -> World:
    """Read a scene, whose key is the stem of the path, without running code of it; its arrays are read-only."""
    arrays, meshes = read_npz(path, partial(check_kind, "biuf")), dict[str, Mesh]()
    for array in arrays.values():
        array.flags.writeable = False
    key, scene = parse_json(arrays["scene"].tobytes().decode())
    if key != path.stem:
        raise ValueError("it holds another scene")

    def decode(value: Any) -> Any:  # noqa: ANN401
        if not isinstance(value, dict):
            return tuple(map(decode, value)) if isinstance(value, list) else value
        ((kind, items),) = value.items()
        if kind in ("array", "body"):
            return arrays[items] if kind == "array" else bodies[items]
        part = KINDS[kind](*map(decode, items))
        return meshes.setdefault(str(items), part) if kind == "Mesh" else part  # actors share meshes

    world: World = decode(scene)
    return world
