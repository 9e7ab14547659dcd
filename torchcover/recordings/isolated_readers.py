"""Readers of libraries that are not Python, in a process of their own: nothing that loads torch is imported here."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.files import check_memory, check_regular, guard_reader, report_bad_file, run_isolated
from torchcover.files.bad_file import MAX_REASON_CHARS

ROS1_SUFFIX = ".bag"
METADATA = "metadata.yaml"
# The command that saves the messages of a file that was cut off, as when its recorder was killed.
REMEDIES = {
    ".mcap": "mcap recover {name} -o recovered.mcap",
    ".db3": "sqlite3 {name} .recover | sqlite3 recovered.db3",
    ROS1_SUFFIX: "rosbag reindex {name}",
    ".active": "rosbag reindex {name}",
}
# A message of small fields takes up to 20 times its bytes as Python objects.
OBJECT_BYTES_PER_BYTE = 20
# Bags that stay open, so that a mixture of recordings does not read their indices again and again.
MAX_OPEN_BAGS = 4
# A message index of MCAP: a code, a size, the channel, the size of the entries.
MCAP_INDEX_CODE = 0x07
MCAP_INDEX_HEAD_BYTES = 15
MCAP_INDEX_ENTRY = np.dtype([("time_ns", "<u8"), ("offset", "<u8")])

TimesByTopic = dict[str, NDArray[np.int64]]
# Path, size in bytes and time of the last change of each file of a bag.
FileVersion = tuple[tuple[str, int, int], ...]


class _OpenBag(NamedTuple):
    readers: list[Any]
    is_ros1: bool


def find_ros1_files(path: Path) -> list[Path]:
    """Return the files of ROS 1 at a path: the file itself, or those in a folder that is no bag of ROS 2."""
    if path.is_dir():
        files = [*path.glob(f"*{ROS1_SUFFIX}"), *path.glob(f"*{ROS1_SUFFIX}.active")]
        return [] if (path / METADATA).exists() else sorted(files)
    return [path] if path.name.endswith((ROS1_SUFFIX, f"{ROS1_SUFFIX}.active")) else []


def find_repair_command(path: Path) -> str:
    """Say which command saves the messages of a damaged bag, or of one of its files."""
    name = next((file.name for file in sorted(path.glob("*")) if file.suffix in REMEDIES), path.name)
    command = REMEDIES.get(Path(name).suffix, "ros2 bag reindex {name}").format(name=name)
    return f"if {name} is damaged or cut off, `{command}` saves its messages"


@contextmanager
def _naming_remedy(path: Path) -> Iterator[None]:
    try:
        yield
    except (ValueError, FileNotFoundError, ImportError, MemoryError):
        raise
    except Exception as error:
        reason = " ".join(str(error).split())[:MAX_REASON_CHARS]
        raise ValueError(
            f"not readable as a bag ({type(error).__name__}: {reason}); {find_repair_command(path)}"
        ) from error


@run_isolated
def read_bag_index(path: Path) -> dict[str, NDArray[Any]]:
    """Read which messages a bag has, without the messages themselves.

    Args:
        path: The folder or the file.

    Returns:
        `topics` and `types` (T,) text, `counts` (T,) messages of each, `times_ns` (sum of counts,) int64 times of
        recording, topic by topic, ascending.

    Raises:
        BadFileError: A damaged bag, or one that takes too much memory.
        ImportError: rosbags is not installed.
    """
    with report_bad_file(path, "a bag"), _naming_remedy(path):
        bag = _open(path)
        types = {connection.topic: str(connection.msgtype) for one in bag.readers for connection in one.connections}
        parts = [_times_of_ros1(one) if bag.is_ros1 else _times_of_ros2(one) for one in bag.readers]
        none = np.empty(0, np.int64)
        times_ns = [np.sort(np.concatenate([none, *(part.get(topic, none) for part in parts)])) for topic in types]
        return {
            "topics": np.array(list(types), dtype=str),
            "types": np.array(list(types.values()), dtype=str),
            "counts": np.array([len(times) for times in times_ns], dtype=np.int64),
            "times_ns": np.concatenate([none, *times_ns]),
        }


@run_isolated
def read_bag_messages(path: Path, topic: str, start_ns: int | None, stop_ns: int | None) -> dict[str, NDArray[Any]]:
    """Read the serialized messages of a topic that were recorded within [start_ns, stop_ns).

    Returns:
        `data` uint8 bytes of all messages in the order of their recording, `ends` (M,) where each ends, `types` (M,).

    Raises:
        BadFileError: A damaged bag, or messages that take too much memory.
    """
    with report_bad_file(path, f"a bag, in {topic}"):
        messages: list[tuple[int, str, bytes]] = []
        total_bytes = 0
        for reader in _open(path).readers:
            connections = [one for one in reader.connections if one.topic == topic]
            for connection, time_ns, raw in reader.messages(connections, start_ns, stop_ns) if connections else ():
                total_bytes += len(raw)
                check_memory(OBJECT_BYTES_PER_BYTE * total_bytes)
                messages.append((time_ns, str(connection.msgtype), bytes(raw)))
        messages.sort(key=itemgetter(0))
        return {
            "data": np.frombuffer(b"".join(raw for *_, raw in messages), np.uint8),
            "ends": np.cumsum([len(raw) for *_, raw in messages], dtype=np.int64),
            "types": np.array([kind for _, kind, _ in messages], dtype=str),
        }


@run_isolated
def read_header_stamps(path: Path, topic: str, times_ns: list[int] | None) -> dict[str, NDArray[Any]]:
    """Read the time stamps with which the messages of a topic begin, without the messages.

    Args:
        path: The folder or the file.
        topic: Its messages begin with a `std_msgs/Header`.
        times_ns: When the messages were recorded that are wanted; None: all.

    Returns:
        `stamps_ns` (M,) int64, in the order of their recording.

    Raises:
        BadFileError: A damaged bag.
    """
    with report_bad_file(path, f"a bag, in {topic}"), _naming_remedy(path):
        bag, found = _open(path), list[tuple[int, int]]()
        for start_ns, stop_ns in [(None, None)] if times_ns is None else [(time, time + 1) for time in times_ns]:
            for reader in bag.readers:
                connections = [one for one in reader.connections if one.topic == topic]
                for _, time_ns, raw in reader.messages(connections, start_ns, stop_ns) if connections else ():
                    found.append((time_ns, _stamp_of_raw(bytes(raw[:12]), is_ros1=bag.is_ros1)))
        return {"stamps_ns": np.array([stamp_ns for _, stamp_ns in sorted(found, key=itemgetter(0))], dtype=np.int64)}


def _stamp_of_raw(raw: bytes, *, is_ros1: bool) -> int:
    """The time of a header: behind its number in ROS 1, behind the order of bytes in ROS 2."""
    if len(raw) < 12:
        raise ValueError(f"a message of {len(raw)} bytes has no header")
    order = "<" if is_ros1 or raw[1] & 1 else ">"
    seconds, nanoseconds = np.frombuffer(raw, f"{order}u4", 2, 4).tolist()
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def _open(path: Path) -> _OpenBag:
    files = find_ros1_files(path) or (sorted(path.iterdir()) if path.is_dir() else [path])
    status = [(str(file), file.stat()) for file in files]
    return _open_version(path, tuple((name, one.st_size, one.st_mtime_ns) for name, one in status))


@lru_cache(MAX_OPEN_BAGS)
def _open_version(path: Path, _: FileVersion) -> _OpenBag:
    try:
        from rosbags import rosbag1, rosbag2
    except ImportError as error:
        raise ImportError(f"{path}: bags need rosbags: pip install 'torchcover[ros]'") from error
    files = find_ros1_files(path)
    for file in files:
        check_regular(file, "a bag")
    readers = [rosbag1.Reader(file) for file in files] or [rosbag2.Reader(path)]
    for reader in readers:
        with _naming_remedy(reader.path):
            reader.open()
    return _OpenBag(readers, bool(files))


def _times_of_ros1(reader: Any) -> TimesByTopic:  # noqa: ANN401  (rosbags has no types)
    times: dict[str, list[int]] = {}
    for connection in reader.connections:
        times.setdefault(connection.topic, []).extend(entry.time for entry in reader.indexes[connection.id])
    return {topic: np.array(times_ns, dtype=np.int64) for topic, times_ns in times.items()}


def _times_of_ros2(reader: Any) -> TimesByTopic:  # noqa: ANN401
    parts: dict[str, list[NDArray[np.int64]]] = {}
    for storage in getattr(reader.storage, "storages", [reader.storage]):
        read: Callable[[Any], TimesByTopic] = _times_of_database if storage.path.suffix == ".db3" else _times_of_mcap
        for topic, times_ns in read(storage).items():
            parts.setdefault(topic, []).append(times_ns)
    return {topic: np.concatenate(times_ns) for topic, times_ns in parts.items()}


def _times_of_database(storage: Any) -> TimesByTopic:  # noqa: ANN401
    topics = storage.dbconn.execute("SELECT id, name FROM topics").fetchall()
    rows = storage.dbconn.execute("SELECT topic_id, timestamp FROM messages").fetchall()
    table = np.array(rows, dtype=np.int64).reshape(-1, 2)
    return {str(name): table[table[:, 0] == number, 1] for number, name in topics}


def _times_of_mcap(storage: Any) -> TimesByTopic:  # noqa: ANN401
    topics = {one.id: one.topic for one in storage.connections}
    parts: dict[str, list[NDArray[np.int64]]] = {}
    for chunk in storage.chunks:
        check_memory(chunk.compressed_size + chunk.uncompressed_size)
        for channel, offset in chunk.message_index_offsets.items():
            parts.setdefault(topics[channel], []).append(_read_mcap_index(storage.bio, channel, offset))
    times_ns = {topic: np.concatenate(of_topic) for topic, of_topic in parts.items()}
    counts: Counter[str] = Counter()
    for connection in storage.connections:
        counts[connection.topic] += connection.msgcount
    if any(count != len(times_ns.get(topic, ())) for topic, count in counts.items()):
        raise ValueError("there is no index of its messages, or only of some; `mcap recover` makes one")
    return times_ns


def _read_mcap_index(file: Any, channel: int, offset: int) -> NDArray[np.int64]:  # noqa: ANN401
    file.seek(offset)
    head = file.read(MCAP_INDEX_HEAD_BYTES)
    size_bytes = int.from_bytes(head[11:], "little")
    if head[:1] != bytes([MCAP_INDEX_CODE]) or int.from_bytes(head[9:11], "little") != channel:
        raise ValueError(f"the index of its messages leads to something else at byte {offset}")
    check_memory(size_bytes)
    return np.frombuffer(file.read(size_bytes), MCAP_INDEX_ENTRY)["time_ns"].astype(np.int64)


@guard_reader("a feather table")
@run_isolated
def read_feather(path: Path, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Read columns of a feather table.

    Returns name -> numbers, or text. BadFileError: no such table, a column that is missing or has holes, or no rows.
    ImportError: pyarrow is not installed.
    """
    try:
        from pyarrow import feather
    except ImportError as error:
        raise ImportError(f"{path}: a feather table needs pyarrow: pip install 'torchcover[av2]'") from error
    check_memory(4 * path.stat().st_size)
    table = feather.read_table(path)
    table.validate(full=True)  # pyarrow believes the lengths and places in the file, and reads there
    missing = [name for name in names if name not in table.column_names]
    if missing:
        raise ValueError(f"the columns {', '.join(names)} are needed; {', '.join(missing)} are missing")
    if table.num_rows == 0:
        raise ValueError("a table without rows")
    holes = [name for name in names if table.column(name).null_count]
    if holes:
        raise ValueError(f"the columns {', '.join(holes)} have holes")
    return {name: table.column(name).to_numpy() for name in names}


@run_isolated
def read_laz_points(path: Path, num_points: int) -> dict[str, NDArray[Any]]:
    """(N, 3) int32 `xyz` as they are written in a LAZ file, of so many points."""
    try:
        import laspy
        import lazrs  # noqa: F401  (which laspy decompresses with)
    except ImportError as error:
        raise ImportError(f"{path}: LAZ needs laspy: pip install 'torchcover[las]'") from error
    with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False) as reader:
        found = reader.read_points(num_points)
    if len(found) != num_points:
        raise ValueError(f"the header claims {num_points} points; {len(found)} are there")
    return {"xyz": np.column_stack([found.X, found.Y, found.Z])}


@run_isolated
def decompress_lzf_block(
    path: Path, start_byte: int, compressed_bytes: int, uncompressed_bytes: int
) -> dict[str, NDArray[Any]]:
    """Decompress the block of a file that begins at the byte `start_byte`, into `plain` (plain_bytes,) uint8."""
    import lzf

    with path.open("rb") as file:
        file.seek(start_byte)
        plain = lzf.decompress(file.read(compressed_bytes), uncompressed_bytes)
    if plain is None or len(plain) != uncompressed_bytes:
        raise ValueError(f"the compressed block does not grow to the {uncompressed_bytes} bytes that it claims")
    return {"plain": np.frombuffer(plain, np.uint8)}
