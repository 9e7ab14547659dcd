"""Readers of point cloud files; each module reads one family of formats."""

from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path

import numpy as np

from torchcover.files import guard_reader
from torchcover.recordings.clouds.arrays import Points, read_float32_cloud, read_npy_cloud, read_npz_cloud
from torchcover.recordings.clouds.las import read_las
from torchcover.recordings.clouds.pcd import read_pcd
from torchcover.recordings.clouds.ply import read_ply
from torchcover.recordings.clouds.text import read_text

# Suffix and reader, which returns (N, 3) float32 or float64 and raises ValueError without the name of the file.
READERS: dict[str, Callable[[Path], Points]] = {
    ".npy": read_npy_cloud,
    ".npz": read_npz_cloud,
    ".bin": partial(read_float32_cloud, num_columns=4),  # KITTI: x y z intensity
    ".pcd.bin": partial(read_float32_cloud, num_columns=5),  # nuScenes: x y z intensity ring, not PCD despite the name
    ".pcd": read_pcd,
    ".ply": read_ply,
    ".csv": read_text,
    ".xyz": read_text,
    ".las": read_las,
    ".laz": read_las,
}


def split_name(name: str, suffixes: Collection[str] | None = None) -> tuple[str, str]:
    """Split a file name into stem and suffix.

    Args:
        name: File name.
        suffixes: Accepted suffixes in lower case; None for those of `READERS`.

    Returns:
        Stem and suffix in lower case; the suffix is empty if it is not accepted.

    Example:
        >>> split_name("LIDAR_TOP__15.pcd.bin"), split_name("000007.BIN"), split_name("notes.txt")
        (('LIDAR_TOP__15', '.pcd.bin'), ('000007', '.bin'), ('notes.txt', ''))
    """
    lower = name.lower()
    accepted = READERS if suffixes is None else suffixes
    last = lower.rfind(".")
    for start in (lower.rfind(".", 0, max(last, 0)), last):  # the longer suffix first
        if start >= 0 and lower[start:] in accepted:
            return name[:start], lower[start:]
    return name, ""


@guard_reader("a point cloud")
def read_cloud(path: Path) -> Points:
    """Read a point cloud in the format of its suffix.

    `.npy`; `.npz` (the array `points`, or the only one, or the only one of shape (N, 3)); `.bin` (KITTI: x y z
    intensity, float32); `.pcd.bin` (nuScenes: x y z intensity ring, float32); `.pcd` (ascii, binary,
    binary_compressed); `.ply` (ascii, binary); `.csv` and `.xyz` (commas or white space; the first line may
    name the columns); `.las` and `.laz` (the latter with `torchcover[las]`). In a file without names the first three
    columns are x y z.

    Args:
        path: File.

    Returns:
        (N, 3) points in meters in the frame of the file, including points that are not finite: float64 if the file
        stores float64 or text, so that UTM coordinates keep their digits, else float32. N may be 0.

    Raises:
        FileNotFoundError: The file does not exist.
        IsADirectoryError: The path is a folder.
        ImportError: laspy is not installed and the file is a `.laz`.
        BadFileError: The file is no cloud: its suffix is unknown, it is empty or truncated, its content does not match
            its suffix or header, it needs more memory than `TORCHCOVER_MAX_FILE_GB` allows, or no point is finite.
            `.bin` and `.pcd.bin` have no header; errors are found only by implausible numbers and leftover bytes.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "frame.xyz")
        ...     _ = path.write_text("513248.125 5403655.25 12.5")
        ...     read_cloud(path).tolist()
        [[513248.125, 5403655.25, 12.5]]
    """
    _, suffix = split_name(path.name)
    if not suffix:
        raise ValueError(f"no reader for this suffix; allowed are {', '.join(READERS)}")
    points = READERS[suffix](path)
    # Readers return views of buffers; callers get a contiguous copy in native byte order. A copy axis by axis takes a
    # third of the time.
    copy = np.empty(points.shape, points.dtype.newbyteorder("="))
    for axis in range(3):
        copy[:, axis] = points[:, axis]
    is_finite = np.isfinite(copy)
    if len(copy) and not is_finite.all() and not is_finite.all(axis=1).any():
        raise ValueError(f"none of the {len(copy)} points is finite; at least one has to be")
    return copy
