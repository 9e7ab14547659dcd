"""Readers that call native libraries in an isolated process; this module must not import torch."""

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
# Suffix of a damaged file, as after a crash of its recorder, and the command that recovers its messages.
REPAIR_COMMANDS = {
    ".mcap": "mcap recover {name} -o recovered.mcap",
    ".db3": "sqlite3 {name} .recover | sqlite3 recovered.db3",
    ROS1_SUFFIX: "rosbag reindex {name}",
    ".active": "rosbag reindex {name}",
}

TimesByTopic = dict[str, NDArray[np.int64]]
FileVersion = tuple[tuple[str, int, int], ...]  # path, size in bytes and modification time of each file of a bag


class _OpenBag(NamedTuple):
    """Open readers of rosbags, one per ROS 1 file or one for a ROS 2 bag."""

    readers: list[Any]
    is_ros1: bool


def find_ros1_files(path: Path) -> list[Path]:
    """Find the ROS 1 bag files of a path.

    Args:
        path: File or folder.

    Returns:
        The file itself, or the sorted files in a folder that is not a ROS 2 bag; empty if there are none.
    """
    if path.is_dir():
        files = [*path.glob(f"*{ROS1_SUFFIX}"), *path.glob(f"*{ROS1_SUFFIX}.active")]
        return [] if (path / METADATA).exists() else sorted(files)
    return [path] if path.name.endswith((ROS1_SUFFIX, f"{ROS1_SUFFIX}.active")) else []


def find_repair_command(path: Path) -> str:
    """Find the command that recovers the messages of a damaged bag.

    Args:
        path: Bag, as a folder or a file.

    Returns:
        A sentence with the command.
    """
    names = [file.name for file in sorted(path.glob("*")) if file.suffix in REPAIR_COMMANDS]
    name = names[0] if names else path.name
    command = REPAIR_COMMANDS.get(Path(name).suffix, "ros2 bag reindex {name}").format(name=name)
    return f"if {name} is damaged or cut off, `{command}` saves its messages"


@contextmanager
def _suggest_repair(path: Path) -> Iterator[None]:
    """Add the repair command to errors of rosbags."""
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
    """Read the topics of a bag and the log times of their messages, without the messages.

    Args:
        path: Bag, as a folder or a file.

    Returns:
        `topics` and `types` (T,) text, `counts` (T,) number of messages, `times_ns` (sum of counts,) int64 log times,
        topic by topic, ascending.

    Raises:
        BadFileError: The bag is damaged or needs too much memory.
        ImportError: rosbags is not installed.
    """
    with report_bad_file(path, "a bag"), _suggest_repair(path):
        bag = _open_bag(path)
        empty = np.empty(0, np.int64)
        types: dict[str, str] = {}
        parts_ns: dict[str, list[NDArray[np.int64]]] = {}
        for reader in bag.readers:
            for connection in reader.connections:
                types[connection.topic] = str(connection.msgtype)
            for topic, part_ns in (_index_ros1_bag(reader) if bag.is_ros1 else _index_ros2_bag(reader)).items():
                parts_ns.setdefault(topic, []).append(part_ns)
        times_ns = [np.sort(np.concatenate([empty, *parts_ns.get(topic, ())])) for topic in types]
        return {
            "topics": np.array(list(types), dtype=str),
            "types": np.array(list(types.values()), dtype=str),
            "counts": np.array([len(times) for times in times_ns], dtype=np.int64),
            "times_ns": np.concatenate([empty, *times_ns]),
        }


@run_isolated
def read_bag_messages(path: Path, topic: str, start_ns: int | None, stop_ns: int | None) -> dict[str, NDArray[Any]]:
    """Read the serialized messages of a topic with a log time in [start_ns, stop_ns).

    Args:
        path: Bag, as a folder or a file.
        topic: Topic of the messages.
        start_ns: First log time; None for the beginning.
        stop_ns: Log time after the last one; None for the end.

    Returns:
        `data` uint8 bytes of all messages ordered by log time, `ends` (M,) end of each message, `types` (M,) text.

    Raises:
        BadFileError: The bag is damaged, or its messages need too much memory.
    """
    with report_bad_file(path, f"a bag, in {topic}"):
        messages: list[tuple[int, str, bytes]] = []
        total_bytes = 0
        object_bytes_per_byte = 20  # a message of small fields takes up to 20 times its bytes as Python objects
        for connection, time_ns, raw in _iterate_messages(_open_bag(path), topic, start_ns, stop_ns):
            total_bytes += len(raw)
            check_memory(object_bytes_per_byte * total_bytes)
            messages.append((time_ns, str(connection.msgtype), bytes(raw)))
        messages.sort(key=itemgetter(0))
        return {
            "data": np.frombuffer(b"".join(raw for *_, raw in messages), np.uint8),
            "ends": np.cumsum([len(raw) for *_, raw in messages], dtype=np.int64),
            "types": np.array([type_name for _, type_name, _ in messages], dtype=str),
        }


@run_isolated
def read_header_stamps(path: Path, topic: str, times_ns: list[int] | None) -> dict[str, NDArray[Any]]:
    """Read the header stamps of the messages of a topic, without the messages.

    Args:
        path: Bag, as a folder or a file.
        topic: Topic whose messages begin with a `std_msgs/Header`.
        times_ns: Log times of the requested messages; None for all messages.

    Returns:
        `stamps_ns` (M,) int64, ordered by log time.

    Raises:
        BadFileError: The bag is damaged.
    """
    with report_bad_file(path, f"a bag, in {topic}"), _suggest_repair(path):
        bag = _open_bag(path)
        stamps: list[tuple[int, int]] = []  # log time, stamp
        intervals = [(None, None)] if times_ns is None else [(time_ns, time_ns + 1) for time_ns in times_ns]
        for start_ns, stop_ns in intervals:
            for _, time_ns, raw in _iterate_messages(bag, topic, start_ns, stop_ns):
                stamps.append((time_ns, _parse_stamp_ns(bytes(raw[:12]), is_ros1=bag.is_ros1)))
        stamps.sort(key=itemgetter(0))
        return {"stamps_ns": np.array([stamp_ns for _, stamp_ns in stamps], dtype=np.int64)}


def _iterate_messages(
    bag: _OpenBag, topic: str, start_ns: int | None, stop_ns: int | None
) -> Iterator[tuple[Any, int, bytes]]:
    """Iterate over connection, log time and bytes of the messages of a topic."""
    for reader in bag.readers:
        connections = [connection for connection in reader.connections if connection.topic == topic]
        if connections:
            yield from reader.messages(connections, start_ns, stop_ns)


def _parse_stamp_ns(raw: bytes, *, is_ros1: bool) -> int:
    """Parse the stamp of a serialized header, which follows a counter in ROS 1 and the byte order in ROS 2."""
    if len(raw) < 12:
        raise ValueError(f"a message of {len(raw)} bytes has no header")
    byte_order = "<" if is_ros1 or raw[1] & 1 else ">"
    seconds, nanoseconds = np.frombuffer(raw, f"{byte_order}u4", 2, 4).tolist()
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def _open_bag(path: Path) -> _OpenBag:
    """Open a bag, or get it from the cache if its files have not changed."""
    files = find_ros1_files(path) or (sorted(path.iterdir()) if path.is_dir() else [path])
    version = []
    for file in files:
        status = file.stat()
        version.append((str(file), status.st_size, status.st_mtime_ns))
    return _open_version(path, tuple(version))


# Four bags stay open, so that a mixture of recordings does not read their indices again and again.
@lru_cache(4)
def _open_version(path: Path, _: FileVersion) -> _OpenBag:
    """Open a bag; the second argument is only a key of the cache."""
    try:
        from rosbags import rosbag1, rosbag2
    except ImportError as error:
        raise ImportError(f"{path}: bags need rosbags: pip install 'torchcover[ros]'") from error
    files = find_ros1_files(path)
    for file in files:
        check_regular(file, "a bag")
    readers = [rosbag1.Reader(file) for file in files] or [rosbag2.Reader(path)]
    for reader in readers:
        with _suggest_repair(reader.path):
            reader.open()
    return _OpenBag(readers, bool(files))


def _index_ros1_bag(reader: Any) -> TimesByTopic:  # noqa: ANN401  (rosbags has no types)
    """Index log times by topic from the connection records."""
    times: dict[str, list[int]] = {}
    for connection in reader.connections:
        times.setdefault(connection.topic, []).extend(entry.time for entry in reader.indexes[connection.id])
    return {topic: np.array(times_ns, dtype=np.int64) for topic, times_ns in times.items()}


def _index_ros2_bag(reader: Any) -> TimesByTopic:  # noqa: ANN401
    """Index log times by topic over all files of the bag."""
    parts: dict[str, list[NDArray[np.int64]]] = {}
    for storage in getattr(reader.storage, "storages", [reader.storage]):
        index_file: Callable[[Any], TimesByTopic] = _index_database if storage.path.suffix == ".db3" else _index_mcap
        for topic, times_ns in index_file(storage).items():
            parts.setdefault(topic, []).append(times_ns)
    return {topic: np.concatenate(times_ns) for topic, times_ns in parts.items()}


def _index_database(storage: Any) -> TimesByTopic:  # noqa: ANN401
    """Index log times by topic from an SQLite file."""
    topics = storage.dbconn.execute("SELECT id, name FROM topics").fetchall()
    rows = storage.dbconn.execute("SELECT topic_id, timestamp FROM messages").fetchall()
    table = np.array(rows, dtype=np.int64).reshape(-1, 2)
    return {str(name): table[table[:, 0] == topic_id, 1] for topic_id, name in topics}


def _index_mcap(storage: Any) -> TimesByTopic:  # noqa: ANN401
    """Index log times by topic from the message indices of an MCAP file."""
    topics = {connection.id: connection.topic for connection in storage.connections}
    parts: dict[str, list[NDArray[np.int64]]] = {}
    for chunk in storage.chunks:
        check_memory(chunk.compressed_size + chunk.uncompressed_size)
        for channel, offset in chunk.message_index_offsets.items():
            parts.setdefault(topics[channel], []).append(_read_mcap_index(storage.bio, channel, offset))
    times_ns = {topic: np.concatenate(times_ns) for topic, times_ns in parts.items()}
    counts: Counter[str] = Counter()
    for connection in storage.connections:
        counts[connection.topic] += connection.msgcount
    for topic, count in counts.items():
        if count != len(times_ns.get(topic, ())):
            raise ValueError("the index of its messages is missing or incomplete; `mcap recover` creates one")
    return times_ns


def _read_mcap_index(file: Any, channel: int, offset: int) -> NDArray[np.int64]:  # noqa: ANN401
    """Read the log times of one message index record of MCAP."""
    file.seek(offset)
    head = file.read(15)  # opcode (1 byte), record size (8), channel (2), size of the entries (4)
    size_bytes = int.from_bytes(head[11:], "little")
    is_message_index = head[:1] == b"\x07"
    if not is_message_index or int.from_bytes(head[9:11], "little") != channel:
        raise ValueError(f"the index of its messages points to another record at byte {offset}")
    check_memory(size_bytes)
    entry = np.dtype([("time_ns", "<u8"), ("offset", "<u8")])
    return np.frombuffer(file.read(size_bytes), entry)["time_ns"].astype(np.int64)


@guard_reader("a feather table")
@run_isolated
def read_feather(path: Path, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Read columns of a feather table.

    Args:
        path: File.
        names: Columns to read.

    Returns:
        Name of each column and its numbers or text.

    Raises:
        BadFileError: The file is no such table, a column is missing or has empty cells, or there are no rows.
        ImportError: pyarrow is not installed.
    """
    try:
        from pyarrow import feather
    except ImportError as error:
        raise ImportError(f"{path}: a feather table needs pyarrow: pip install 'torchcover[av2]'") from error
    check_memory(4 * path.stat().st_size)
    table = feather.read_table(path)
    table.validate(full=True)  # pyarrow trusts lengths and offsets in the file
    missing = [name for name in names if name not in table.column_names]
    if missing:
        raise ValueError(f"the columns {', '.join(names)} are needed; {', '.join(missing)} are missing")
    if table.num_rows == 0:
        raise ValueError("a table without rows")
    incomplete = [name for name in names if table.column(name).null_count]
    if incomplete:
        raise ValueError(f"the columns {', '.join(incomplete)} have empty cells")
    return {name: table.column(name).to_numpy() for name in names}


@run_isolated
def read_laz_points(path: Path, num_points: int) -> dict[str, NDArray[Any]]:
    """Read the stored integer coordinates of a LAZ file.

    Args:
        path: File.
        num_points: Number of points that the header claims.

    Returns:
        `xyz` (N, 3) int32 coordinates before scale and offset.

    Raises:
        ValueError: The file has another number of points.
        ImportError: laspy is not installed.
    """
    try:
        import laspy
        import lazrs  # noqa: F401  (laspy decompresses with it)
    except ImportError as error:
        raise ImportError(f"{path}: LAZ needs laspy: pip install 'torchcover[las]'") from error
    with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False) as reader:
        points = reader.read_points(num_points)
    if len(points) != num_points:
        raise ValueError(f"the header claims {num_points} points; {len(points)} are there")
    return {"xyz": np.column_stack([points.X, points.Y, points.Z])}


@run_isolated
def decompress_lzf_block(
    path: Path, start_byte: int, compressed_bytes: int, uncompressed_bytes: int
) -> dict[str, NDArray[Any]]:
    """Decompress an LZF block of a file.

    Args:
        path: File.
        start_byte: Offset of the block.
        compressed_bytes: Size of the block in the file.
        uncompressed_bytes: Size after decompression that the file claims.

    Returns:
        `plain` (uncompressed_bytes,) uint8 content.

    Raises:
        ValueError: The block is damaged or has another size.
    """
    import lzf

    with path.open("rb") as file:
        file.seek(start_byte)
        plain = lzf.decompress(file.read(compressed_bytes), uncompressed_bytes)
    if plain is None or len(plain) != uncompressed_bytes:
        raise ValueError(f"the compressed block does not decompress to the {uncompressed_bytes} bytes that it claims")
    return {"plain": np.frombuffer(plain, np.uint8)}
