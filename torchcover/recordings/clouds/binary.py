"""What can be known about numbers that no header describes."""

import string

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry.rigid import blocks

# Beyond, float32 does not resolve a centimetre; no sensor reaches as far.
MAX_COORDINATE_M = 1e5
SMALLEST_NORMAL = float(np.finfo(np.float32).tiny)
FIRST_NORMAL = np.uint32(0x0080_0000)  # its bits
# Largest shares of points in a cloud. A few coordinates are lost alone, and a few points lie on the diagonal.
MAX_PARTLY_FINITE = 0.05
MAX_DIAGONAL = 0.1
# Fewer points are no statistics.
MIN_POINTS = 16
MIN_STATISTICS = 100
MAX_INTENSITY, MAX_RING = 255, 255
# A column in which more than a share lies this far on either side of 0 holds coordinates.
FAR_M, MIN_FAR = 2.0, 0.05
PRINTABLE = string.printable.encode()
SIGNATURES = {
    b"\x93NUMPY": "a .npy",
    b"PK\x03\x04": "a .npz (or another ZIP archive)",
    b"ply\n": "a .ply",
    b"ply\r": "a .ply",
    b"# .PCD": "a .pcd",
    b"VERSION": "a .pcd",
    b"LASF": "a LAS file",
    b"\x89PNG": "a PNG image",
    b"\x1f\x8b": "a gzip file",
}
# Layouts with a suffix of their own, by their number of columns.
SUFFIXES = {4: ".bin (x y z intensity)", 5: ".pcd.bin (x y z intensity ring)"}


def check_records(data: bytes, columns: int) -> NDArray[np.float32]:
    """(N, columns) little-endian float32, x y z first, if the bytes may be such.

    ValueError: bytes are left over, or the numbers are no coordinates.
    """
    known = next((name for start, name in SIGNATURES.items() if data.startswith(start)), None)
    if known is None and all(byte in PRINTABLE for byte in data[:1024]):
        known = "text (.csv or .xyz?)"
    if known is not None:
        raise ValueError(f"the content is {known}, not {columns} float32 a point; give it the suffix of its format")
    record_bytes = 4 * columns
    if len(data) % record_bytes:
        raise ValueError(
            f"{len(data)} bytes are no whole number of {record_bytes}-byte points ({columns} float32 each), "
            f"{len(data) % record_bytes} bytes are left over: truncated, or of another format"
        )
    records = np.frombuffer(data, "<f4").reshape(-1, columns)
    if not any(data):
        raise ValueError(f"all of its {len(data)} bytes are zero: it was never written")
    coordinates = _plainly_coordinates(records)
    complaint = (None if coordinates else _complaint(records[:, :3])) or _of_other_columns(records)
    if complaint:
        others = " or ".join(suffix for width, suffix in SUFFIXES.items() if width != columns)
        raise ValueError(
            f"{complaint}, so it holds no {SUFFIXES[columns]} of little-endian float32: give it the suffix of its "
            f"format, as {others}, or write its points as .npy (N, 3 or more)"
        )
    return records


def check_rest(rest: bytes) -> None:
    """Refuse bytes behind the points that no header speaks of; zeros and line ends are padding."""
    if rest.strip(b"\0\r\n"):
        raise ValueError(f"{len(rest)} bytes follow the points that the header claims, and they are not all zero")


def _complaint(points: NDArray[np.float32]) -> str | None:
    """Why numbers cannot be coordinates, as the bits of other types are not."""
    size = np.abs(points)
    finite = np.isfinite(points)
    whole = finite.all(axis=1)
    far = ((size > MAX_COORDINATE_M) & finite).any(axis=1)
    denormal = ((size > 0) & (size < SMALLEST_NORMAL)).any(axis=1)
    partly = finite.any(axis=1) & ~whole
    diagonal = (points == points[:, :1]).all(axis=1) & (points[:, 0] != 0)
    of_all = f"of {len(points)} points"
    if far.any():
        return f"{far.sum()} {of_all} lie beyond {MAX_COORDINATE_M:g} m, the first at {points[far][0].tolist()}"
    if denormal.any():
        return f"{denormal.sum()} {of_all} have denormal coordinates, the first {points[denormal][0].tolist()}"
    if partly.sum() > MAX_PARTLY_FINITE * len(points):
        return f"{partly.sum()} {of_all} are finite in one coordinate and not in another"
    if len(points) >= MIN_POINTS and diagonal.sum() > MAX_DIAGONAL * len(points):
        return f"{diagonal.sum()} {of_all} have x = y = z"
    return None


def _plainly_coordinates(records: NDArray[np.float32]) -> bool:
    """Whether there is nothing to complain of; in a fraction of the time, for numbers are looked at side by side."""
    diagonal = 0
    for rows in blocks(len(records)):
        part = records[rows]
        if not (part.max() <= MAX_COORDINATE_M and part.min() >= -MAX_COORDINATE_M):
            return False  # NaN is neither
        magnitude = part.view("<u4") & np.uint32(0x7FFF_FFFF)
        if (magnitude - np.uint32(1)).min() < FIRST_NORMAL - 1:  # 0 becomes the largest
            return False
        alike = part[np.flatnonzero(part[:, 0] == part[:, 1])]
        diagonal += int(np.count_nonzero((alike[:, 0] == alike[:, 2]) & (alike[:, 0] != 0)))
    return diagonal <= MAX_DIAGONAL * len(records)


def _of_other_columns(records: NDArray[np.float32]) -> str | None:
    """Why the rows have another number of columns; only where they lack what theirs would have."""
    columns = records.shape[1]
    numbers = records.ravel()
    if len(records) < MIN_POINTS:
        return None
    if numbers.size % (9 - columns):
        return _of_unknown_columns(records)
    as_four, as_five = (numbers[: numbers.size // width * width].reshape(-1, width) for width in (4, 5))
    if columns == 4 and not _is_intensity(as_four[:, 3]) and _is_ring(as_five[:, 4]):
        return "every fourth number is no intensity, and every fifth is a ring"
    if columns == 5 and not _is_ring(as_five[:, 4]) and _is_intensity(as_four[:, 3]):
        return "every fifth number is no ring, and every fourth is an intensity"
    return _of_unknown_columns(records)


def _of_unknown_columns(records: NDArray[np.float32]) -> str | None:
    """Why the rows are of columns that no suffix stands for."""
    last, name = records[:, -1], {4: "an intensity", 5: "a ring"}[records.shape[1]]
    if len(records) < MIN_STATISTICS:
        return None
    if _share(last < -FAR_M) > MIN_FAR and _share(last > FAR_M) > MIN_FAR:
        return f"its last column is not {name} but has coordinates in it"
    if records.shape[1] == 4:  # rows of eight, cut in halves
        signs = [min(_share(records[side::2, axis] < 0) for axis in (1, 2)) for side in (0, 1)]
        if min(signs) == 0 and max(signs) > MIN_FAR:
            return "every second point has no negative y or z, and the others have"
    return None


def _share(which: NDArray[np.bool_]) -> float:
    return np.count_nonzero(which) / len(which)


def _is_intensity(values: NDArray[np.float32]) -> bool:
    return bool(((values >= 0) & (values <= MAX_INTENSITY)).all())


def _is_ring(values: NDArray[np.float32]) -> bool:
    return bool(((values >= 0) & (values <= MAX_RING) & (values == np.round(values))).all())
