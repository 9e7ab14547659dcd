"""Boxes in a table that people write; see `read_boxes`."""

from pathlib import Path

from torchcover.simulation.recorded.track import Recording, only_one_scene
from torchcover.simulation.tracks import read_box_tracks


def files(path: Path) -> list[Path] | None:
    """The table; None if it is none."""
    return [path] if path.suffix == ".csv" else None


def read(path: Path, scene: str | None) -> Recording:
    """Read it; it has no ego of its own.

    Raises:
        BadFileError: Another content.
        FileNotFoundError: No such file.
    """
    only_one_scene(scene, "a table of boxes")
    return Recording(read_box_tracks(path))
