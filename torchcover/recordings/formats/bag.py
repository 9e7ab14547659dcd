"""The files of a bag of ROS 1 or 2: which messages there are and when, and single ones of them."""

import os
import sqlite3
import weakref
from collections import Counter
from collections.abc import Callable
from operator import itemgetter
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from torchcover.files import check_memory, naming, parse_yaml, read_short_text, reads

METADATA = "metadata.yaml"
SUFFIXES = {"sqlite3": ".db3", "mcap": ".mcap"}
ROS1 = ".bag"
# What the standard definitions of ROS 1 lack, and what it was called before.
TREE = "tf2_msgs/msg/TFMessage"
RENAMED = {"tf/msg/tfMessage": TREE}
# Of MCAP's records: a code, a size, the channel, the size of the entries.
INDEX_CODE, INDEX_HEAD = 0x07, 15
INDEX_ENTRY = np.dtype([("time_ns", "<u8"), ("offset", "<u8")])


class Bag:
    """A folder with `metadata.yaml` and `.db3` or `.mcap` files or with `.bag` files of ROS 1, or one such file.

    Needs `torchcover[ros]`. Opening reads the index only. Messages are read as what the standard definitions say of
    their types; those that are in the bag, of which code would be made, are left aside.

    FileNotFoundError: a file is missing. BadFileError: what is no bag, or a part of one; files that are compressed as a
    whole or have no index. ImportError: rosbags is not installed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._files = ros1_files(path)
        if not self._files and path.is_dir():
            check_metadata(path / METADATA)
        elif not self._files:
            check_suffix(path)
        for database in path.glob(f"*{SUFFIXES['sqlite3']}") if path.is_dir() else [path]:
            check_journal(database)
        self._opened: tuple[int, list[Any], Callable[..., Any]] | None = None
        with naming(path, "a bag"):
            readers, _ = self._readers()
            self.types = {one.topic: _type(one) for reader in readers for one in reader.connections}
            times_ns = [_times_in_bag(reader) if self._files else _times_ns(reader) for reader in readers]
            self._times_ns = {
                topic: np.sort(np.concatenate([of[topic] for of in times_ns if topic in of]))
                for topic in set().union(*times_ns)
            }

    def __getstate__(self) -> dict[str, object]:
        return {**vars(self), "_opened": None}

    def times_ns(self, topic: str) -> NDArray[np.int64]:
        """(M,) when the messages of a topic were recorded, ascending."""
        return self._times_ns.get(topic, np.empty(0, np.int64))

    def topics(self, *types: str) -> list[str]:
        """Topics of these types that have messages, by name."""
        return sorted(topic for topic, kind in self.types.items() if kind in types and len(self.times_ns(topic)))

    def messages(self, topic: str, start_ns: int | None = None, stop_ns: int | None = None) -> list[Any]:
        """The messages of a topic that were recorded from a time on, until before another."""
        with naming(self.path, f"a bag, in {topic}"), np.errstate(all="ignore"):
            readers, deserialize = self._readers()
            own = [(reader, [one for one in reader.connections if one.topic == topic]) for reader in readers]
            found = [
                (time_ns, deserialize(raw, _type(one)))
                for reader, connections in own
                if connections
                for one, time_ns, raw in reader.messages(connections, start_ns, stop_ns)
            ]
            return [message for _, message in sorted(found, key=itemgetter(0))]

    def message(self, topic: str, time_ns: int) -> Any:  # noqa: ANN401  (of a type that rosbags has made)
        """The message of a topic that was recorded at a time."""
        found = self.messages(topic, time_ns, time_ns + 1)
        if not found:
            with naming(self.path, "a bag"):
                raise ValueError(f"{topic}: the message at {time_ns} is in the index only; is the bag damaged?")
        return found[0]

    def _readers(self) -> tuple[list[Any], Callable[..., Any]]:
        """The files, opened by this process: one that was forked must not share their positions."""
        if self._opened is None or self._opened[0] != os.getpid():
            try:
                from rosbags import rosbag1, rosbag2
                from rosbags.typesys import Stores, get_types_from_msg, get_typestore
            except ImportError as error:
                raise ImportError(f"{self.path}: bags need rosbags: pip install 'torchcover[ros]'") from error
            types = get_typestore(Stores.ROS1_NOETIC if self._files else Stores.ROS2_HUMBLE)
            if self._files:
                types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TREE))
            readers = [rosbag1.Reader(file) for file in self._files] or [rosbag2.Reader(self.path)]
            for reader in readers:
                reader.open()
                weakref.finalize(self, reader.close)
            self._opened = os.getpid(), readers, types.deserialize_ros1 if self._files else types.deserialize_cdr
        return self._opened[1:]


def ros1_files(path: Path) -> list[Path]:
    """The files of ROS 1 at a path: it, or those in a folder that is no bag of ROS 2."""
    if path.is_dir():
        return [] if (path / METADATA).exists() else sorted(path.glob(f"*{ROS1}"))
    return [path] if path.suffix == ROS1 else []


@reads("a bag")
def check_suffix(path: Path) -> None:
    """Whether a file is called as bags are."""
    if path.suffix not in SUFFIXES.values():
        raise ValueError(f"a folder with {METADATA}, or a file of {', '.join((*SUFFIXES.values(), ROS1))} is needed")


@reads("a bag")
def check_journal(path: Path) -> None:
    """Refuse a database with changes in a file beside it, where its recorder was killed or still runs."""
    for ending in ("-wal", "-journal"):
        journal = path.with_name(path.name + ending)
        if journal.exists() and journal.stat().st_size:
            raise ValueError(
                f"some of its messages are in {journal.name} only, since its recorder did not end: copy the files "
                f"beside each other to where you may write, and run `sqlite3 {path.name} 'PRAGMA quick_check'`"
            )


@reads("the metadata of a bag")
def check_metadata(path: Path) -> None:
    """Whether the files that `metadata.yaml` names can be read one message at a time.

    FileNotFoundError: one is missing. BadFileError: other content, files elsewhere, files that are compressed as a
    whole.
    """
    content = parse_yaml(read_short_text(path))
    told = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    names = told.get("relative_file_paths") if isinstance(told, dict) else None
    if not isinstance(told, dict) or not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError("rosbag2_bagfile_information with relative_file_paths is needed")
    suffix = SUFFIXES.get(str(told.get("storage_identifier")))
    if str(told.get("compression_mode", "")).lower() == "file" or suffix is None:
        raise ValueError(
            f"files of {' or '.join(SUFFIXES)} that are not compressed as a whole are needed; got "
            f"{told.get('storage_identifier')!r}, compression {told.get('compression_mode')!r}: use `ros2 bag convert`"
        )
    for name in names:
        if Path(name).name != name or Path(name).suffix != suffix:
            raise ValueError(f"names of {suffix} files beside it are needed; got {name!r}")
        if not (path.parent / name).is_file():
            raise FileNotFoundError(f"{path.parent / name}: no such file; {path} names it")


def _type(connection: Any) -> str:  # noqa: ANN401  (of rosbags, which has no types)
    name = str(connection.msgtype)
    return RENAMED.get(name, name)


def _times_in_bag(reader: Any) -> dict[str, NDArray[np.int64]]:  # noqa: ANN401
    found: dict[str, list[int]] = {}
    for one in reader.connections:
        found.setdefault(one.topic, []).extend(entry.time for entry in reader.indexes[one.id])
    return {topic: np.array(times_ns, dtype=np.int64) for topic, times_ns in found.items()}


def _times_ns(reader: Any) -> dict[str, NDArray[np.int64]]:  # noqa: ANN401
    """Topic -> when its messages were recorded; no message is read."""
    storages = getattr(reader.storage, "storages", [reader.storage])
    found: dict[str, list[NDArray[np.int64]]] = {}
    for storage in storages:
        of_file = _times_in_database(storage.path) if storage.path.suffix == ".db3" else _times_in_mcap(storage)
        for topic, times_ns in of_file.items():
            found.setdefault(topic, []).append(times_ns)
    return {topic: np.concatenate(parts) for topic, parts in found.items()}


def _times_in_database(path: Path) -> dict[str, NDArray[np.int64]]:
    database = sqlite3.connect(f"file:{quote(str(path))}?immutable=1", uri=True)
    try:
        topics = database.execute("SELECT id, name FROM topics").fetchall()
        rows = database.execute("SELECT topic_id, timestamp FROM messages").fetchall()
    finally:
        database.close()
    table = np.array(rows, dtype=np.int64).reshape(-1, 2)
    return {str(name): table[table[:, 0] == number, 1] for number, name in topics}


def _times_in_mcap(storage: Any) -> dict[str, NDArray[np.int64]]:  # noqa: ANN401
    topics = {one.id: one.topic for one in storage.connections}
    found: dict[str, list[NDArray[np.int64]]] = {}
    with storage.path.open("rb") as file:
        for chunk in storage.chunks:
            check_memory(chunk.compressed_size + chunk.uncompressed_size)
            for channel, offset in chunk.message_index_offsets.items():
                file.seek(offset)
                head = file.read(INDEX_HEAD)
                size = int.from_bytes(head[11:], "little")
                if head[:1] != bytes([INDEX_CODE]) or int.from_bytes(head[9:11], "little") != channel:
                    raise ValueError(f"the index of its messages leads to something else at byte {offset}")
                check_memory(size)
                entries = np.frombuffer(file.read(size), INDEX_ENTRY)
                found.setdefault(topics[channel], []).append(entries["time_ns"].astype(np.int64))
    times_ns = {topic: np.concatenate(parts) for topic, parts in found.items()}
    told: Counter[str] = Counter()
    for one in storage.connections:
        told[one.topic] += one.msgcount
    if any(count != len(times_ns.get(topic, ())) for topic, count in told.items()):
        raise ValueError("there is no index of its messages, or only of some; `mcap recover` makes one")
    return times_ns
