"""The formats in which tracks are recorded."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from torchcover.simulation.recorded import argoverse2, commonroad, nuscenes, tables
from torchcover.simulation.recorded.track import Recording


class TrackFormat(NamedTuple):
    """A format.

    Args:
        layout: What it consists of, for messages.
        files: The files of a path that would be read; None if it is of another format.
        read: From the path and the name of a scene, or None, to what was recorded.
    """

    layout: str
    files: Callable[[Path], list[Path] | None]
    read: Callable[[Path, str | None], Recording]


FORMATS = (
    TrackFormat("a log of Argoverse 2 (a folder with annotations.feather)", argoverse2.files, argoverse2.read),
    TrackFormat("tables of nuScenes (a folder with sample_annotation.json)", nuscenes.files, nuscenes.read),
    TrackFormat("a scenario of CommonRoad (.xml)", commonroad.files, commonroad.read),
    TrackFormat("a table of boxes (.csv)", tables.files, tables.read),
)


def format_of(path: Path) -> TrackFormat:
    """The format of a path.

    Raises:
        FileNotFoundError: No such path.
        ValueError: None of them.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder; recorded tracks are needed")
    for one in FORMATS:
        if one.files(path) is not None:
            return one
    raise ValueError(f"{path}: recorded tracks are {'; '.join(one.layout for one in FORMATS)}")
