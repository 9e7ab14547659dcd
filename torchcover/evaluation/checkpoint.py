"""No run is lost: what it knows is written to a file now and then, and it goes on from there.

The file is an `.npz` of the states of observers, and a header that says of which run they are.
"""

import hashlib
import io
import json
import math
import time
import warnings
import zipfile
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import IO, Any, Protocol, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcover.evaluation.observers import CoverageObserver, Stateful
from torchcover.files import check_dtype_kind, check_memory, guard_reader, parse_json, read_npz, write_atomically

EVERY_S = 60.0
# Writing takes at most this share of the time, though it may take seconds.
MOST_TIME = 0.05
FORMAT_VERSION = 2
HEADER = "header"
# Of NumPy's types: numbers that are real, and truth.
KINDS = "fiub"
# What the header has of the run.
RUN_KEYS = ("num_frames", "counts", "skipped_frames", "duration_s")

Array = NDArray[Any]
State = Mapping[str, Any]


class RunState(Protocol):
    """What a checkpoint keeps of a run itself; a `Run`."""

    num_frames: int
    counts: Counter[str]
    skipped_frames: list[str]
    duration_s: float


@dataclass(frozen=True)
class Checkpoint:
    """A file that a run is saved to every minute and at its end, and from which it goes on after whatever ended it.

    Args:
        path: The file, in a folder that no other run writes to.
        resume: Whether to go on from it, if it is there; else the run starts with its first step, and replaces it.
        keep: Whether a complete run is saved, too, so that it goes on from there with more steps; else only what was
            cut short.
    """

    path: Path
    resume: bool = True
    keep: bool = True

    def for_rank(self, rank: int) -> Self:
        """That of one of several processes that share a run: each has a file of its own."""
        return replace(self, path=self.path.with_stem(f"{self.path.stem}_rank{rank}")) if rank else self

    def in_folder(self, folder: str) -> Self:
        """That of one of several runs whose results go to folders beside each other; kept until all are complete."""
        return replace(self, path=self.path.parent / folder / self.path.name, keep=True)


class CheckpointManager:
    """Keeps the checkpoint of one run.

    `checkpoint`: where; `identity`: what defines the run; see `build_run_identity`; `states`: all that learns from frames, by
    name. TypeError: something whose state cannot be kept.
    """

    def __init__(self, checkpoint: Checkpoint, identity: Mapping[str, str], states: Mapping[str, object]) -> None:
        self.path = checkpoint.path
        self.resume = checkpoint.resume
        self.keep = checkpoint.keep
        self.identity = dict(identity)
        self._states: dict[str, Stateful] = {name: _checked(name, one) for name, one in states.items()}
        self._due_s = time.monotonic() + EVERY_S
        self._complained = False

    def restore(self, run: RunState) -> None:
        """Go on from the file, if there is one and that is wanted.

        ValueError: it is the checkpoint of another run; the message says in what. Or, as `BadFileError`, it is damaged.
        """
        if not self.resume or not self.path.exists():
            return
        header = read_header(self.path)
        if other := describe_differences(self.identity, header["identity"]):
            raise ValueError(
                f"{self.path}: a checkpoint of another run: {other}; resume with the settings of that run, or choose "
                "another folder"
            )
        for name, one in self._states.items():
            one.load_state_dict(read_state(self.path, header, name))
        done = header["run"]
        run.num_frames, run.skipped_frames, run.duration_s = (
            done["num_frames"],
            done["skipped_frames"],
            done["duration_s"],
        )
        run.counts.update(done["counts"])

    def write_if_due(self, run: RunState) -> None:
        """Write, if the last time is long enough ago."""
        if time.monotonic() >= self._due_s:
            self.write(run)

    def write(self, run: RunState) -> None:
        """Write now; where there is no room, say so once, and leave the file that is there."""
        start_s = time.monotonic()
        done = {name: getattr(run, name) for name in RUN_KEYS}
        try:
            states = {name: one.state_dict() for name, one in self._states.items()}
            write_checkpoint(self.path, {"identity": self.identity, "run": done}, states)
        except (OSError, MemoryError) as error:
            if not self._complained:
                warnings.warn(f"{self.path}: no checkpoint was written ({error}); the run goes on", stacklevel=2)
            self._complained = True
        end_s = time.monotonic()
        self._due_s = end_s + max(EVERY_S, (end_s - start_s) / MOST_TIME)


def _checked(name: str, one: object) -> Stateful:
    if not isinstance(one, Stateful):
        raise TypeError(
            f"{name}: a {type(one).__name__} without state_dict and load_state_dict, which a checkpoint needs; give it "
            "both, or leave out the checkpoint"
        )
    if isinstance(one, CoverageObserver):  # whose sums are many
        return one
    try:
        write_states(io.BytesIO(), {}, {name: one.state_dict()})
    except TypeError as error:
        raise TypeError(f"{name}: its state_dict cannot be kept in a checkpoint: {error}") from error
    return one


def describe_differences(current: Mapping[str, str], saved: Mapping[str, str]) -> str:
    """What two runs differ in, in words; empty where they do not.

    Example:
        >>> describe_differences({"seed": "0", "scenario": "#17"}, {"seed": "1", "scenario": "#4"})
        'scenario (other content), seed (1 there, 0 here)'
    """
    names = [name for name in sorted(current.keys() | saved.keys()) if current.get(name) != saved.get(name)]
    return ", ".join(f"{name} {_change(current.get(name, 'none'), saved.get(name, 'none'))}" for name in names)


def _change(here: str, there: str) -> str:
    return "(other content)" if "#" in (here[0], there[0]) else f"({there} there, {here} here)"


def write_checkpoint(path: Path, header: Mapping[str, Any], states: Mapping[str, State]) -> None:
    """Write it in the place of the one that is there; see `write_atomically`.

    The header is for JSON: `identity`, and `run` with `RUN_KEYS`. States are of tensors, numbers, texts, None, and
    lists and dicts of them. TypeError: a state holds something else. OSError: there is no room.
    """
    write_atomically(path, partial(write_states, header=header, states=states))


@guard_reader("a checkpoint")
def read_header(path: Path) -> dict[str, Any]:
    """The header.

    FileNotFoundError: no such file. BadFileError: not a checkpoint, a damaged one, or one of another version.
    """
    text = str(_read(path, HEADER))
    header: dict[str, Any] = parse_json(text)
    if header.get("format") != FORMAT_VERSION:
        raise ValueError(f"checkpoint format {header.get('format')}; this torchcover reads format {FORMAT_VERSION}")
    with zipfile.ZipFile(path) as archive:
        if archive.comment != _seal(archive):
            raise ValueError("its checksum is that of another content: it was edited, or is damaged; begin anew")
    for name, keys in (("identity", ()), ("run", RUN_KEYS), ("states", ())):
        if not isinstance(header.get(name), dict) or not set(keys) <= header[name].keys():
            raise ValueError(f"not a whole checkpoint: {name} is missing, or parts of it")
    return header


@guard_reader("a checkpoint")
def read_state(path: Path, header: Mapping[str, Any], name: str) -> dict[str, Any]:
    """One of the states, bit for bit.

    BadFileError: it is damaged, or takes more memory than `TORCHCOVER_MAX_FILE_GB` allows.
    """
    node = header["states"][name]
    check_memory(_count_bytes(node))
    state: dict[str, Any] = _unpacked(node, path)
    return state


def write_states(file: Path | IO[bytes], header: Mapping[str, Any], states: Mapping[str, State]) -> None:
    """The content of the file."""
    # One array after the other: together they would take as much memory again as the states.
    with zipfile.ZipFile(file, "w") as archive:
        numbers = count()
        packed = {name: _packed(state, archive, numbers) for name, state in states.items()}
        _add(archive, HEADER, np.array(json.dumps({"format": FORMAT_VERSION, **header, "states": packed})))
        archive.comment = _seal(archive)


def _seal(archive: zipfile.ZipFile) -> bytes:
    """A checksum of all members, whose own checksums are looked at when they are read."""
    members = [(one.filename, one.file_size, one.CRC) for one in archive.infolist()]
    return hashlib.sha256(repr(members).encode()).hexdigest().encode()


def _add(archive: zipfile.ZipFile, name: str, array: Array) -> None:
    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
        np.lib.format.write_array(member, array, allow_pickle=False)


def _packed(value: Any, archive: zipfile.ZipFile, numbers: Iterator[int]) -> Any:  # noqa: ANN401  (a tree)
    if isinstance(value, Tensor):
        return {"tensor": _add_tensor(value, archive, f"{next(numbers)}")}
    if isinstance(value, Mapping):
        return {"dict": {_key(key): _packed(each, archive, numbers) for key, each in value.items()}}
    if isinstance(value, list | tuple):
        return {"list": [_packed(each, archive, numbers) for each in value]}
    if value is None or type(value) in (bool, int, float, str):
        return value
    raise TypeError(f"a state of tensors, numbers, texts, lists and dicts is needed; got {type(value).__name__} in it")


def _key(key: Any) -> str:  # noqa: ANN401
    if not isinstance(key, str):
        raise TypeError(f"a state is a dict by names; got the key {key!r}")
    return key


def _add_tensor(tensor: Tensor, archive: zipfile.ZipFile, name: str) -> dict[str, Any]:
    array = tensor.detach().cpu().numpy()
    if array.dtype.kind not in KINDS:
        raise TypeError(f"a state of real numbers is needed; got a tensor of {tensor.dtype}")
    # As bits: of a number that is none there are several, and all are kept.
    _add(archive, name, np.ascontiguousarray(array).reshape(-1).view(np.uint8))
    return {"name": name, "dtype": array.dtype.str, "shape": list(tensor.shape)}


def _unpacked(node: Any, path: Path) -> Any:  # noqa: ANN401  (a tree)
    if not isinstance(node, dict):
        return node
    ((kind, content),) = node.items()
    if kind == "dict":
        return {key: _unpacked(each, path) for key, each in content.items()}
    if kind == "list":
        return [_unpacked(each, path) for each in content]
    return torch.from_numpy(_array(content, path))


def _count_bytes(node: Any) -> int:  # noqa: ANN401
    """Return the size of all tensors of a state together, as the header claims it; the same array may be listed often.

    Raises:
        ValueError: A tensor of another type, or with a negative size.
    """
    if not isinstance(node, dict):
        return 0
    ((kind, content),) = node.items()
    if kind != "tensor":
        return sum(map(_count_bytes, content.values() if kind == "dict" else content))
    dtype, shape = np.dtype(content["dtype"]), tuple(content["shape"])
    if dtype.kind not in KINDS or min(shape, default=0) < 0:
        raise ValueError(f"an array of {dtype} and the shape {shape}")
    return int(math.prod(shape) * dtype.itemsize)


def _array(content: Mapping[str, Any], path: Path) -> Array:
    array: Array = _read(path, content["name"]).view(content["dtype"]).reshape(content["shape"])
    return array


def _read(path: Path, name: str) -> Array:
    return read_npz(path, partial(check_dtype_kind, "uU"), lambda _: [name])[name]  # bytes, and one text: the header
