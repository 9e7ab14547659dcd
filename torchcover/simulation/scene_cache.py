"""Disk cache of generated scenes, in torchcover/scenes of $XDG_CACHE_HOME or ~/.cache: one npz file per scene."""

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
from torchcover.files import BadFileError, check_dtype_kind, guard_reader, parse_json, read_limit_gb, read_npz
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation.builtin import hash_builtin_documents, list_builtin_names
from torchcover.simulation.scenario import ActorDescription, Scenario
from torchcover.simulation.scene import Actor, Scene
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.sumo.simulating import find_sumo_home
from torchcover.simulation.traffic.fleet import load_bodies

# Types in the JSON of a cached scene, by name.
ENCODED_TYPES: dict[str, Any] = {encoded.__name__: encoded for encoded in (Scene, Actor, Trajectory, Mesh)}


class SceneCache:
    """Cache of the scenes of a scenario with generated traffic.

    New scenes are written until the cache has TORCHCOVER_CACHE_GB (1 by default); then the oldest are deleted.

    Args:
        scenario: Scenario.
        seed: Seed of the traffic.
        no_cache: True to neither read nor write files.
    """

    def __init__(self, scenario: Scenario, seed: int, *, no_cache: bool = False) -> None:
        self._scenario, self._seed = scenario, seed
        # Traffic of other packages is not cached, since its code is not part of the hash.
        is_cacheable = not scenario.is_repeating and type(scenario.traffic).__module__.startswith("torchcover.")
        self._limit_bytes = 1e9 * read_limit_gb("TORCHCOVER_CACHE_GB", 1.0) if is_cacheable and not no_cache else 0.0
        self._folder = _open_folder() if self._limit_bytes else None

    def build(self, run_index: int, ego_mesh: Mesh | None) -> Scene:
        """Build the scene of a run, or read it from the cache; both are equal to the last bit.

        Args:
            run_index: Index of the run through the scenario, see `Scenario.build_scene`.
            ego_mesh: Mesh of the ego vehicle that scenes share; None for a scenario without traffic.
        """
        if self._folder is None or ego_mesh is None:
            return self._scenario.build_scene(self._seed, run_index, ego_mesh)
        key = hashlib.sha256(f"{_hash_sources(self._scenario)} {self._seed} {run_index}".encode()).hexdigest()
        path, bodies = self._folder / f"{key}.npz", {**load_bodies(), "ego": ego_mesh}
        try:
            if _get_status_of_own_file(path):
                scene = read_scene(path, bodies)
                with suppress(OSError):  # the file may be read-only
                    os.utime(path)
                return scene
        except (BadFileError, FileNotFoundError) as error:
            warnings.warn(f"a cached scene is not used ({error})", stacklevel=2)
        with warnings.catch_warnings(record=True) as raised:
            warnings.simplefilter("always")
            scene = self._scenario.build_scene(self._seed, run_index, ego_mesh)
        for warning in raised:
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
        # A scene with warnings is not cached, since a reader would not see them.
        if not any(issubclass(warning.category, UserWarning) for warning in raised):
            self._write(path, encode_scene(key, scene, bodies))
        return scene

    def _write(self, path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Write a scene after deleting the oldest files until there is room; warn and stop caching on errors."""
        room_bytes = self._limit_bytes - sum(array.nbytes for array in arrays.values())
        if room_bytes < 0:
            return
        temporary_path = path.with_suffix(f".{uuid4().hex}")
        try:
            files = []
            for file_path in path.parent.iterdir():
                if status := _get_status_of_own_file(file_path):
                    files.append((status, file_path))
            for status, file_path in sorted(files, key=lambda file: -file[0].st_mtime_ns):
                room_bytes -= status.st_size
                if room_bytes < 0:
                    file_path.unlink(missing_ok=True)
            with temporary_path.open("xb") as file:
                np.savez(file, **arrays)  # type: ignore[arg-type]  # keys are never other keywords
            os.replace(temporary_path, path)
        except OSError as error:
            with suppress(OSError):
                temporary_path.unlink()
            self._folder = None
            _warn_about_missing_cache(OSError(error.errno, error.strerror, str(path.parent)))


def _get_status_of_own_file(path: Path) -> os.stat_result | None:
    """Get the status of a file of this cache: by name a scene or a temporary file of one, regular, without hard links.

    Returns:
        None for all other files, which are neither read nor deleted.
    """
    with suppress(OSError):
        status = path.lstat()
        is_own = S_ISREG(status.st_mode) and status.st_uid == os.getuid() and status.st_nlink == 1
        return status if is_own and re.fullmatch(r"[0-9a-f]{64}\.(npz|[0-9a-f]{32})", path.name) else None
    return None


def _open_folder() -> Path | None:
    """Create the cache folder; None, with a warning, if it is a link, or other users can write to it."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    try:
        folder = Path(base if os.path.isabs(base) else Path.home() / ".cache", "torchcover", "scenes")
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        for status in (folder.lstat(), folder.parent.lstat()):
            if not S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o022:
                raise OSError(f"{folder}: it is a link, or others may write to it")
        if not os.access(folder, os.W_OK):
            raise OSError(f"{folder}: it may not be written to")
    except (OSError, RuntimeError) as error:  # RuntimeError: the user has no home folder
        _warn_about_missing_cache(error)
        return None
    return folder


def _warn_about_missing_cache(error: Exception) -> None:
    remedy = "--set no_cache=true, or TORCHCOVER_CACHE_GB=0, asks for none"
    warnings.warn(f"scenes are not cached ({error}); {remedy}", stacklevel=3)


def _hash_sources(scenario: Scenario) -> str:
    """Hash everything that determines scenes except seed and run: traffic, ego vehicle, code, and libraries.

    Sensors, weather and names of the scenario do not affect scenes.
    """
    assert scenario.traffic is not None
    sources: list[object] = [
        __version__,
        _hash_code(),
        np.__version__,
        np.show_config(mode="dicts")["SIMD Extensions"],
        shapely.__version__,
        shapely.geos_version_string,
        list_builtin_names("materials"),
        hash_builtin_documents("road_users"),
        type(scenario.traffic).__name__,
        scenario.traffic.collect_content(),
        (scenario.ego or ActorDescription()).collect_content(),
    ]
    with suppress(ImportError, OSError):  # SUMO is not installed
        sources.append((find_sumo_home() / "bin" / "sumo").stat().st_mtime_ns)
    return hashlib.sha256(json.dumps(sources, sort_keys=True, default=repr).encode()).hexdigest()


@cache
def _hash_code() -> str:
    """Hash the code that builds scenes."""
    package, digest = Path(__file__).parents[1], hashlib.sha256()
    paths: list[Path] = []
    for folder in ("files", "geometry", "simulation"):
        paths += (package / folder).rglob("*.py")
    for path in sorted(paths):
        digest.update(f"{path.relative_to(package)} {path.stat().st_size} ".encode() + path.read_bytes())
    return digest.hexdigest()


def encode_scene(key: str, scene: Scene, bodies: Mapping[str, Mesh]) -> dict[str, NDArray[Any]]:
    """Encode a scene as arrays; repeated arrays are stored once.

    Args:
        key: Key of the scene, the stem of its file name.
        scene: Scene.
        bodies: Meshes that scenes share, by name; only the names are stored.

    Returns:
        Arrays by number, and `scene`: JSON of the key and the scene as (bytes,) uint8.
    """
    body_names = {id(mesh): name for name, mesh in bodies.items()}
    arrays: dict[str, Any] = {}
    array_numbers: dict[object, str] = {}

    def encode(value: Any) -> Any:  # noqa: ANN401
        if isinstance(value, np.ndarray):
            memory = value.__array_interface__["data"], value.shape, value.strides, value.dtype.str
            number = array_numbers.setdefault(memory, str(len(array_numbers)))
            arrays[number] = value
            return {"array": number}
        if id(value) in body_names:
            return {"body": body_names[id(value)]}
        if type(value).__name__ in ENCODED_TYPES:
            items = value if isinstance(value, Mesh) else [getattr(value, field.name) for field in fields(value)]
            return {type(value).__name__: [encode(item) for item in items]}
        return [encode(item) for item in value] if isinstance(value, tuple) else value

    text = json.dumps([key, encode(scene)], default=np.generic.item).encode()
    return {"scene": np.frombuffer(text, np.uint8), **arrays}


@guard_reader("a scene")
def read_scene(path: Path, bodies: Mapping[str, Mesh]) -> Scene:
    """Read a scene without executing code of the file; its arrays are read-only.

    Args:
        path: File whose stem is the key of the scene.
        bodies: Meshes that scenes share, by name.

    Raises:
        BadFileError: The file is damaged, or has another scene.
        FileNotFoundError: There is no such file.
    """
    arrays = read_npz(path, partial(check_dtype_kind, "biuf"))
    for array in arrays.values():
        array.flags.writeable = False
    key, encoded_scene = parse_json(arrays["scene"].tobytes().decode())
    if key != path.stem:
        raise ValueError("it holds another scene")
    meshes: dict[str, Mesh] = {}

    def decode(value: Any) -> Any:  # noqa: ANN401
        if not isinstance(value, dict):
            return tuple(decode(item) for item in value) if isinstance(value, list) else value
        ((kind, items),) = value.items()
        if kind in ("array", "body"):
            return arrays[items] if kind == "array" else bodies[items]
        decoded = ENCODED_TYPES[kind](*[decode(item) for item in items])
        return meshes.setdefault(str(items), decoded) if kind == "Mesh" else decoded  # actors share meshes

    scene: Scene = decode(encoded_scene)
    return scene
