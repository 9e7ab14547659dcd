"""Checkpoints: a run saves its sums to a file at intervals, and an interrupted run continues from there.

The file is an `.npz` with the states of all observers and a header that identifies the run.
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
from torchcover.files import (
    check_dtype_kind,
    check_memory,
    guard_reader,
    parse_json,
    read_npz,
    report_bad_file,
    write_atomically,
)

FORMAT_VERSION = 3
HEADER = "header"
# Kinds of NumPy types that a state may contain: float, int, uint, bool.
DTYPE_KINDS = "fiub"
# Attributes of the run that the header contains.
RUN_KEYS = ("num_frames", "counts", "skipped_frames", "duration_s")

Array = NDArray[Any]
State = Mapping[str, Any]


class RunState(Protocol):
    """Attributes of a `Run` that a checkpoint stores.

    Args:
        num_frames: Frames that were evaluated.
        counts: Counts of the run by name.
        skipped_frames: Messages about frames that could not be read.
        duration_s: Run time.
    """

    num_frames: int
    counts: Counter[str]
    skipped_frames: list[str]
    duration_s: float


@dataclass(frozen=True)
class Checkpoint:
    """File to which a run is saved every minute and at its end, and from which an interrupted run continues.

    Args:
        path: The file, in a folder that no other run writes to.
        resume: Continue from an existing file; otherwise the run starts at its first frame and replaces the file.
        keep: Save a complete run too, so that it can continue with more frames; otherwise only an interrupted one.
    """

    path: Path
    resume: bool = True
    keep: bool = True

    def for_rank(self, rank: int) -> Self:
        """Return the checkpoint of one process of a distributed run; rank 0 has the original file."""
        return replace(self, path=self.path.with_stem(f"{self.path.stem}_rank{rank}")) if rank else self

    def in_folder(self, folder: str) -> Self:
        """Return the checkpoint of one of several runs whose results go to subfolders; kept until all are complete."""
        return replace(self, path=self.path.parent / folder / self.path.name, keep=True)


@dataclass(frozen=True)
class CheckpointParams:
    """Intervals at which a checkpoint is written.

    Args:
        interval_s: Minimum time between two writes.
        max_time_share: Maximum share of the run time for writing, which may take seconds.
    """

    interval_s: float = 60.0
    max_time_share: float = 0.05


class CheckpointManager:
    """Reads and writes the checkpoint of one run.

    Args:
        checkpoint: File and mode.
        identity: Name -> value of all settings that define the run, from `build_run_identity`.
        states: Name -> observer or rule whose state depends on the frames.

    Raises:
        TypeError: The state of an object cannot be saved.
    """

    params = CheckpointParams()

    def __init__(self, checkpoint: Checkpoint, identity: Mapping[str, str], states: Mapping[str, object]) -> None:
        self.path = checkpoint.path
        self.resume = checkpoint.resume
        self.keep = checkpoint.keep
        self.identity = dict(identity)
        self._states: dict[str, Stateful] = {name: _check_state(name, item) for name, item in states.items()}
        self._due_s = time.monotonic() + self.params.interval_s
        self._has_warned = False

    def restore(self, run: RunState) -> None:
        """Continue from the file if it exists and `resume` is set.

        Args:
            run: The run, whose attributes are set.

        Raises:
            ValueError: The checkpoint belongs to another run; the message lists the differences.
            BadFileError: The file is damaged.
        """
        if not self.resume or not self.path.exists():
            return
        header = read_header(self.path)
        if differences := describe_differences(self.identity, header["identity"]):
            raise ValueError(
                f"{self.path}: a checkpoint of another run: {differences}; resume with the settings of that run, or "
                "choose another folder"
            )
        for name, stateful in self._states.items():
            with report_bad_file(self.path, "a checkpoint"):
                stateful.load_state_dict(read_state(self.path, header, name))
        saved = header["run"]
        run.num_frames = saved["num_frames"]
        run.skipped_frames = saved["skipped_frames"]
        run.duration_s = saved["duration_s"]
        run.counts.update(saved["counts"])

    def write_if_due(self, run: RunState) -> None:
        """Write the checkpoint if the last write is long enough ago."""
        if time.monotonic() >= self._due_s:
            self.write(run)

    def write(self, run: RunState) -> None:
        """Write the checkpoint; on a full disk, warn once and keep the previous file."""
        start_s = time.monotonic()
        run_record = {name: getattr(run, name) for name in RUN_KEYS}
        try:
            states = {name: stateful.state_dict() for name, stateful in self._states.items()}
            write_checkpoint(self.path, {"identity": self.identity, "run": run_record}, states)
        except (OSError, MemoryError) as error:
            if not self._has_warned:
                warnings.warn(f"{self.path}: no checkpoint was written ({error}); the run goes on", stacklevel=2)
            self._has_warned = True
        # The share of the time for writing is limited on slow disks.
        end_s = time.monotonic()
        self._due_s = end_s + max(self.params.interval_s, (end_s - start_s) / self.params.max_time_share)


def _check_state(name: str, item: object) -> Stateful:
    """Check that an object has a state and that it can be saved."""
    if not isinstance(item, Stateful):
        raise TypeError(
            f"{name}: a {type(item).__name__} without state_dict and load_state_dict, which a checkpoint needs; "
            "implement both, or run without a checkpoint"
        )
    if isinstance(item, CoverageObserver):  # always possible, and its sums are large
        return item
    try:
        write_states(io.BytesIO(), {}, {name: item.state_dict()})
    except TypeError as error:
        raise TypeError(f"{name}: its state_dict cannot be saved in a checkpoint: {error}") from error
    return item


def describe_differences(current: Mapping[str, str], saved: Mapping[str, str]) -> str:
    """Describe the settings in which two runs differ.

    Args:
        current: Name -> value of the settings of this run; a value with # in front is a hash.
        saved: The same of the other run.

    Returns:
        The differences, separated by commas; empty if there are none.

    Example:
        >>> describe_differences({"seed": "0", "scenario": "#17"}, {"seed": "1", "scenario": "#4"})
        'scenario (other content), seed (1 there, 0 here)'
    """
    differences = []
    for name in sorted(current.keys() | saved.keys()):
        current_value, saved_value = current.get(name, "none"), saved.get(name, "none")
        if current_value != saved_value:
            is_hash = current_value.startswith("#") or saved_value.startswith("#")
            change = "other content" if is_hash else f"{saved_value} there, {current_value} here"
            differences.append(f"{name} ({change})")
    return ", ".join(differences)


def write_checkpoint(path: Path, header: Mapping[str, Any], states: Mapping[str, State]) -> None:
    """Write a checkpoint in place of the previous one; see `write_atomically`.

    Args:
        path: The file.
        header: Content for JSON: `identity`, and `run` with `RUN_KEYS`.
        states: Name -> state: tensors, numbers, texts, None, and lists and dicts of them.

    Raises:
        TypeError: A state contains something else.
        OSError: The disk is full.
    """
    write_atomically(path, partial(write_states, header=header, states=states))


@guard_reader("a checkpoint")
def read_header(path: Path) -> dict[str, Any]:
    """Read the header of a checkpoint.

    Args:
        path: The file.

    Returns:
        `identity`, `run`, and `states` with a description of every state.

    Raises:
        FileNotFoundError: No such file.
        BadFileError: Not a checkpoint, a damaged one, or one of another version.
    """
    text = str(_read_array(path, HEADER))
    header: dict[str, Any] = parse_json(text)
    if header.get("format") != FORMAT_VERSION:
        raise ValueError(
            f"checkpoint format {header.get('format')}; this torchcover reads format {FORMAT_VERSION}; start again"
        )
    with zipfile.ZipFile(path) as archive:
        if archive.comment != _compute_checksum(archive):
            raise ValueError("wrong checksum: the file was edited or is damaged; start again")
    for name, keys in (("identity", ()), ("run", RUN_KEYS), ("states", ())):
        if not isinstance(header.get(name), dict) or not set(keys) <= header[name].keys():
            raise ValueError(f"incomplete checkpoint: {name} is missing, or parts of it")
    _check_value_types(header)
    return header


def _check_value_types(header: Mapping[str, Any]) -> None:
    """Check the values of a header, which may come from an edited file with a correct checksum."""
    run = header["run"]
    is_valid = isinstance(run["skipped_frames"], list) and isinstance(run["counts"], dict)
    if is_valid:
        for text in (*header["identity"].values(), *run["skipped_frames"]):
            is_valid &= isinstance(text, str)
        for number in (run["num_frames"], run["duration_s"], *run["counts"].values()):
            is_valid &= type(number) in (int, float) and 0 <= number < 2**63
    if not (is_valid and isinstance(run["num_frames"], int)):
        raise ValueError("the identity or the run has values of other types than written; start again")


@guard_reader("a checkpoint")
def read_state(path: Path, header: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Read one of the states, identical to the last bit.

    Args:
        path: The file.
        header: Its header.
        name: Name of the state.

    Returns:
        The state; its tensors are on the CPU.

    Raises:
        BadFileError: The file is damaged, or needs more memory than `TORCHCOVER_MAX_FILE_GB` allows.
    """
    node = header["states"][name]
    check_memory(_count_bytes(node))
    state: dict[str, Any] = _unpack(node, path)
    return state


def write_states(file: Path | IO[bytes], header: Mapping[str, Any], states: Mapping[str, State]) -> None:
    """Write the content of a checkpoint.

    Args:
        file: Path or open file.
        header: Content for JSON.
        states: Name -> state.
    """
    # Arrays are written one by one: copies of all together would double the memory of the states.
    with zipfile.ZipFile(file, "w") as archive:
        numbers = count()
        nodes = {name: _pack(state, archive, numbers) for name, state in states.items()}
        _add_array(archive, HEADER, np.array(json.dumps({"format": FORMAT_VERSION, **header, "states": nodes})))
        archive.comment = _compute_checksum(archive)


def _compute_checksum(archive: zipfile.ZipFile) -> bytes:
    """Compute a checksum of the names, sizes and checksums of all members; reading a member verifies its own."""
    members = [(member.filename, member.file_size, member.CRC) for member in archive.infolist()]
    return hashlib.sha256(repr(members).encode()).hexdigest().encode()


def _add_array(archive: zipfile.ZipFile, name: str, array: Array) -> None:
    """Add an array to the archive as a member in the format of `numpy.save`."""
    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
        np.lib.format.write_array(member, array, allow_pickle=False)


def _pack(value: Any, archive: zipfile.ZipFile, numbers: Iterator[int]) -> Any:  # noqa: ANN401  (a tree)
    """Convert a state to a tree for JSON; its tensors become numbered members of the archive."""
    if isinstance(value, Tensor):
        return {"tensor": _add_tensor(value, archive, f"{next(numbers)}")}
    if isinstance(value, Mapping):
        # JSON would convert other keys to texts, which would not come back.
        for key in value:
            if not isinstance(key, str):
                raise TypeError(f"a state with names as keys is needed; got the key {key!r}")
        return {"dict": {key: _pack(item, archive, numbers) for key, item in value.items()}}
    if isinstance(value, list | tuple):
        return {"list": [_pack(item, archive, numbers) for item in value]}
    if value is None or type(value) in (bool, int, float, str):
        return value
    raise TypeError(f"a state of tensors, numbers, texts, lists and dicts is needed; got {type(value).__name__} in it")


def _add_tensor(tensor: Tensor, archive: zipfile.ZipFile, name: str) -> dict[str, Any]:
    """Add a tensor to the archive and describe it."""
    array = tensor.detach().cpu().numpy()
    if array.dtype.kind not in DTYPE_KINDS:
        raise TypeError(f"a state of real numbers is needed; got a tensor of {tensor.dtype}")
    # Stored as bytes because NaN has several bit patterns, all of which have to survive.
    _add_array(archive, name, np.ascontiguousarray(array).reshape(-1).view(np.uint8))
    return {"name": name, "dtype": array.dtype.str, "shape": list(tensor.shape)}


def _unpack(node: Any, path: Path) -> Any:  # noqa: ANN401  (a tree)
    """Read the state that a node of the tree describes."""
    if not isinstance(node, dict):
        return node
    ((kind, content),) = node.items()
    if kind == "dict":
        return {key: _unpack(item, path) for key, item in content.items()}
    if kind == "list":
        return [_unpack(item, path) for item in content]
    data = _read_array(path, content["name"])
    return torch.from_numpy(data.view(content["dtype"]).reshape(content["shape"]))


def _count_bytes(node: Any) -> int:  # noqa: ANN401  (a tree)
    """Count the bytes of all tensors of a state as its header claims them; an array that is listed twice counts twice.

    Raises:
        ValueError: A tensor has an invalid type or a negative size.
    """
    if not isinstance(node, dict):
        return 0
    ((kind, content),) = node.items()
    if kind != "tensor":
        return sum(_count_bytes(item) for item in (content.values() if kind == "dict" else content))
    dtype, shape = np.dtype(content["dtype"]), tuple(content["shape"])
    if dtype.kind not in DTYPE_KINDS or min(shape, default=0) < 0:
        raise ValueError(f"an array of {dtype} and the shape {shape}")
    return int(math.prod(shape) * dtype.itemsize)


def _read_array(path: Path, name: str) -> Array:
    """Read one array of the archive, within the memory limit."""
    # Types: bytes of a tensor, and the text of the header.
    return read_npz(path, partial(check_dtype_kind, "uU"), lambda _: [name])[name]
