"""The files of a bag of ROS 1 or 2: which messages there are and when, and single ones of them."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchcover.files import naming, parse_yaml, read_short_text, reads
from torchcover.recordings.bag_files import (
    METADATA,
    ROS1_SUFFIX,
    find_ros1_files,
    name_remedy,
    read_bag_index,
    read_bag_messages,
    read_header_stamps,
)

# Of so many messages the stamps are read, if those were recorded equally late to this time, and so regularly.
SAMPLED = 65
STEADY_NS = 2_000_000
IRREGULAR = 0.5
SUFFIXES = {"sqlite3": ".db3", "mcap": ".mcap"}
# What the standard definitions of ROS 1 lack, and what it was called before.
TREE = "tf2_msgs/msg/TFMessage"
RENAMED = {"tf/msg/tfMessage": TREE}


class Bag:
    """A folder with `metadata.yaml` and `.db3` or `.mcap` files or with `.bag` files of ROS 1, or one such file.

    Needs `torchcover[ros]`. Opening reads the index only. Messages are read as what the standard definitions say of
    their types; those that are in the bag, of which code would be made, are left aside.

    FileNotFoundError: a file is missing. BadFileError: what is no bag, or a part of one; files that are compressed as a
    whole or have no index. ImportError: rosbags is not installed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        files = find_ros1_files(path)
        self._is_ros1 = bool(files)
        if not files and path.is_dir():
            if not (path / METADATA).exists():
                raise FileNotFoundError(
                    f"{path / METADATA}: no such file; `ros2 bag reindex {path}` writes it, or name one file of the bag"
                )
            check_metadata(path / METADATA)
        elif not files:
            check_suffix(path)
        for database in path.glob(f"*{SUFFIXES['sqlite3']}") if path.is_dir() else [path]:
            check_journal(database)
        with naming(path, "a bag"):
            index = read_bag_index(path)
        topics, types = index["topics"].tolist(), index["types"].tolist()
        times_ns = np.split(index["times_ns"], np.cumsum(index["counts"]))
        self.types = {topic: RENAMED.get(name, name) for topic, name in zip(topics, types, strict=True)}
        self._times_ns: dict[str, NDArray[np.int64]] = dict(zip(topics, times_ns, strict=False))

    def times_ns(self, topic: str) -> NDArray[np.int64]:
        """(M,) when the messages of a topic were recorded, ascending."""
        return self._times_ns.get(topic, np.empty(0, np.int64))

    def stamps_ns(self, topic: str) -> NDArray[np.int64]:
        """(M,) when the messages of a topic were made, by their headers, in the order of their recording.

        In a long bag a sample is read; if all of it was recorded equally late, to `STEADY_NS`, so was the rest.
        """
        times_ns = self.times_ns(topic)
        count, steps_ns = len(times_ns), np.diff(times_ns)
        if count > SAMPLED:
            sample_ns = times_ns[np.unique(np.linspace(0, count - 1, SAMPLED).astype(int))]
            late_ns = sample_ns - self._read_stamps(topic, sample_ns)
            is_regular = (np.abs(steps_ns - np.median(steps_ns)) < IRREGULAR * np.median(steps_ns)).all()
            if is_regular and np.ptp(late_ns) <= STEADY_NS:
                return np.asarray(times_ns - np.int64(np.median(late_ns)))
        return self._read_stamps(topic, None)

    def _read_stamps(self, topic: str, times_ns: NDArray[np.int64] | None) -> NDArray[np.int64]:
        with naming(self.path, f"a bag, in {topic}"):
            wanted = None if times_ns is None else times_ns.tolist()
            stamps_ns = read_header_stamps(self.path, topic, wanted)["stamps_ns"]
            recorded = len(self.times_ns(topic) if times_ns is None else times_ns)
            if len(stamps_ns) != recorded:
                raise ValueError(
                    f"{recorded} messages are in the index, {len(stamps_ns)} are there; {name_remedy(self.path)}"
                )
            return np.asarray(stamps_ns)

    def topics(self, *types: str) -> list[str]:
        """Topics of these types that have messages, by name."""
        return sorted(topic for topic, kind in self.types.items() if kind in types and len(self.times_ns(topic)))

    def messages(self, topic: str, start_ns: int | None = None, stop_ns: int | None = None) -> list[Any]:
        """The messages of a topic that were recorded from a time on, until before another."""
        with naming(self.path, f"a bag, in {topic}"), np.errstate(all="ignore"):
            data, ends, types = read_bag_messages(self.path, topic, start_ns, stop_ns).values()
            deserialize = _deserializer(is_ros1=self._is_ros1)
            starts = [0, *ends.tolist()]
            return [
                deserialize(data[start:end].data, RENAMED.get(name, name))
                for start, end, name in zip(starts, ends.tolist(), types.tolist(), strict=False)
            ]

    def message(self, topic: str, time_ns: int) -> Any:  # noqa: ANN401  (of a type that rosbags has made)
        """The message of a topic that was recorded at a time."""
        found = self.messages(topic, time_ns, time_ns + 1)
        if not found:
            with naming(self.path, "a bag"):
                raise ValueError(f"{topic}: the message at {time_ns} is in the index only; {name_remedy(self.path)}")
        return found[0]


@cache
def _deserializer(*, is_ros1: bool) -> Callable[[memoryview, str], Any]:
    """Return the function that makes a message of its bytes and the name of its standard type."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # installed, or no bag would have been read

    types = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    if is_ros1:
        types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TREE))
    deserialize: Callable[[memoryview, str], Any] = types.deserialize_ros1 if is_ros1 else types.deserialize_cdr
    return deserialize


@reads("a bag")
def check_suffix(path: Path) -> None:
    """Whether a file is called as bags are."""
    if path.suffix not in SUFFIXES.values():
        suffixes = ", ".join((*SUFFIXES.values(), ROS1_SUFFIX))
        raise ValueError(f"a folder with {METADATA}, or a file of {suffixes} is needed")


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
