"""Files of frames in a folder: one a frame, in natural order."""

import os
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from torchcover.recordings.clouds.readers import READERS, split_name

MAX_NAMES_SHOWN = 5
CLOUDS = f"a cloud; allowed are files ending in {', '.join(READERS)}"


def frame_files(
    folder: Path, like: Sequence[str] | None = None, beside: Collection[str] = (), *, images: bool = False
) -> dict[str, Path]:
    """The clouds, or depth images in PNG, by the names of their frames in natural order (frame2 before frame10).

    There have to be those of `like`, and no others; files `beside` them are no clouds. ValueError: a file that is no
    cloud, two files of one name, no files, or other names than `like`.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder; clouds are needed in it, one a frame")
    clouds: dict[str, Path] = {}
    with os.scandir(folder) as entries:
        found = sorted((entry.name, entry.is_dir()) for entry in entries)
    for file, is_folder in found:
        if file in beside or file.startswith("."):  # what file managers and version control leave behind
            continue
        name, suffix = split_name(file, (".png",)) if images else split_name(file)
        if not suffix or is_folder:
            wanted = "a depth image; allowed are files ending in .png" if images else CLOUDS
            raise ValueError(f"{folder / file}: not {wanted}")
        if name in clouds:
            raise ValueError(f"{folder}: two files for the frame {name}: {clouds[name].name} and {file}")
        clouds[name] = folder / file
    if like is not None:
        check_same_names(folder.parent, {folder.name: clouds, "the others": dict.fromkeys(like)})
    numbers = all(map(str.isdecimal, clouds))  # which need not be taken apart
    return {name: clouds[name] for name in sorted(clouds, key=_number if numbers else natural)}


def check_same_names(folder: Path, files: Mapping[str, Mapping[str, object]]) -> None:
    """Whether all places have the same frames."""
    places = " and ".join(f"{place}/" for place in files)
    anywhere = set[str]().union(*files.values())
    if not anywhere:
        raise ValueError(f"{folder}: no frames; {places} are empty")
    complaints = [
        f"{len(gaps)} missing in {place}/ ({some_of(gaps)})"
        for place, clouds in files.items()
        if (gaps := sorted(anywhere - clouds.keys(), key=natural))
    ]
    if complaints:
        raise ValueError(f"{folder}: every frame needs a file in {places}; {' and '.join(complaints)}")


def check_frames(frames: Sequence[str], names: Sequence[str]) -> list[int]:
    """Which row of a table belongs to each frame."""
    there, wanted = set(frames), set(names)
    doubled = [frame for frame, count in Counter(frames).items() if count > 1]
    missing, unknown = [name for name in names if name not in there], sorted(there - wanted)
    for what, which in (("missing", missing), ("doubled", doubled), ("unknown", unknown)):
        if which:
            raise ValueError(f"one row for every frame is needed; {len(which)} {what} ({some_of(which)})")
    row_of = {frame: row for row, frame in enumerate(frames)}
    return [row_of[name] for name in names]


def natural(name: str) -> tuple[list[str | int], str]:
    """A key to sort names by, numbers in them by their values."""
    # Text and number alternate, starting with text, so that two keys always compare; the name itself breaks a tie.
    parts = re.split(r"(\d+)", name)
    return [int(part) if position % 2 else part for position, part in enumerate(parts)], name


def _number(name: str) -> tuple[int, str]:
    return int(name), name


def some_of(names: Sequence[str]) -> str:
    """The first of many names, for a message."""
    return ", ".join([*names[:MAX_NAMES_SHOWN], *["..."] * (len(names) > MAX_NAMES_SHOWN)])
