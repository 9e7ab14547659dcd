"""Read one point cloud from one file, whatever its format; one file a family of formats."""

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

# Suffix -> reader. A reader returns (N, 3) float32 or float64 and raises ValueError without naming the file.
READERS: dict[str, Callable[[Path], Points]] = {
    ".npy": read_npy_cloud,
    ".npz": read_npz_cloud,
    ".bin": partial(read_float32_cloud, num_columns=4),  # KITTI: x y z intensity
    ".pcd.bin": partial(read_float32_cloud, num_columns=5),  # nuScenes: x y z intensity ring; no PCD despite its name
    ".pcd": read_pcd,
    ".ply": read_ply,
    ".csv": read_text,
    ".xyz": read_text,
    ".las": read_las,
    ".laz": read_las,
}


def split_name(name: str, suffixes: Collection[str] | None = None) -> tuple[str, str]:
    """Split a file name into stem and suffix, one that is registered or one of others; empty where it is none of them.

    Example:
        >>> split_name("LIDAR_TOP__15.pcd.bin"), split_name("000007.BIN"), split_name("notes.txt")
        (('LIDAR_TOP__15', '.pcd.bin'), ('000007', '.bin'), ('notes.txt', ''))
    """
    lower, known = name.lower(), READERS if suffixes is None else suffixes
    last = lower.rfind(".")
    for start in (lower.rfind(".", 0, max(last, 0)), last):  # the longer one first
        if start >= 0 and lower[start:] in known:
            return name[:start], lower[start:]
    return name, ""


@guard_reader("a point cloud")
def read_cloud(path: Path) -> Points:
    """Read a point cloud; the suffix says how.

    `.npy`; `.npz` (the array `points`, or the only one, or the only one of shape (N, 3)); `.bin` (KITTI: x y z
    intensity, float32); `.pcd.bin` (nuScenes: x y z intensity ring, float32); `.pcd` (ascii, binary,
    binary_compressed); `.ply` (ascii, binary); `.csv` and `.xyz` (commas or white space; a line above the points may
    name the columns); `.las` and `.laz` (the latter with `torchcover[las]`). In a file without names the first three
    columns are x y z.

    Args:
        path: The file.

    Returns:
        (N, 3) points in metres in the file's own frame, non-finite ones included: float64 where the file stores
        float64 or text, so that UTM-sized coordinates keep their digits, else float32. N may be 0.

    Raises:
        FileNotFoundError: There is no such file.
        IsADirectoryError: A folder.
        ImportError: A `.laz`, and laspy is not installed.
        BadFileError: Not a cloud: an unknown suffix, an empty or truncated file, other content than the suffix says,
            rows of different width, a header that claims more or less than the file holds, another shape or type, more
            memory than `TORCHCOVER_MAX_FILE_GB` allows, or points of which none is finite. `.bin` and `.pcd.bin` have
            no header: only numbers that cannot be coordinates, or bytes left over, give a wrong one away.

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
    # Native byte order, contiguous and the caller's own: readers hand out views of buffers. Axis by axis takes a third
    # of the time.
    own = np.empty(points.shape, points.dtype.newbyteorder("="))
    for axis in range(3):
        own[:, axis] = points[:, axis]
    finite = np.isfinite(own)
    if len(own) and not finite.all() and not finite.all(axis=1).any():
        raise ValueError(f"none of the {len(own)} points is finite; at least one has to be")
    return own
