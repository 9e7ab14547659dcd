"""Clouds with impossible rows, sizes or numbers."""

import io
import re
import struct
import tracemalloc
import zipfile

import lzf
import numpy as np
import pytest

from torchcover.data import read_cloud
from torchcover.files import BadFileError

CLOUD = np.random.default_rng(0).uniform([-60, -60, -2, 0], [60, 60, 5, 0.99], (100, 4)).astype("<f4")
RINGS = np.c_[CLOUD[:, :3], 255 * CLOUD[:, 3], np.arange(100) % 32].astype("<f4")
# Rows with a time and other fields of drivers, for which there is no suffix.
SIX, SEVEN = np.c_[RINGS, CLOUD[:, 3]], np.c_[RINGS, CLOUD[:, 3], CLOUD[:, 3]]
EIGHT = np.c_[SEVEN, np.zeros(100, "<f4")]


def refused(tmp_path, name, data):
    """The message without the file's name, which it has to begin with."""
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(BadFileError) as caught:
        read_cloud(path)
    assert str(caught.value).startswith(f"{path}: ")
    return str(caught.value).removeprefix(f"{path}: ")


PCD = (
    b"FIELDS id x y z\nSIZE 4 4 4 4\nTYPE U F F F\nCOUNT 1 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA ascii\n"
    b"1 2 3 4\n2 5 6 7\n"
)
PLY = b"ply\nformat ascii 1.0\nelement vertex 2\n" + b"".join(b"property float %c\n" % name for name in b"ixyz")
PLY += b"end_header\n1 2 3 4\n2 5 6 7\n"


@pytest.mark.parametrize(
    ("name", "good", "rows"),
    [
        ("a.csv", b"id,x,y,z,i\n", [b"1,2,3,4,5\n", b"1,2,3,9\n"]),
        ("b.csv", b"id,x,y,z\n", [b"1,2,3,4\n", b"1,2,3,4,5\n"]),
        ("c.csv", b"", [b"1,2,3,4\n", b"1,2,3\n"]),
        ("d.csv", b"x,y,z\n", [b"1,2,3\n", b"1,5,2,5,3,5\n"]),
        ("e.xyz", b"i x y z\n", [b"1 2 3 4\n", b"2 3 4\n"]),
        ("g.xyz", b"", [b"1 2 3\n", b"1 2 3 4\n"]),
    ],
)
def test_rows_of_another_width_are_refused(tmp_path, name, good, rows):
    path = tmp_path / name
    path.write_bytes(good + rows[0] * 3)
    assert len(read_cloud(path)) == 3
    assert "columns where" in refused(tmp_path, name, good + rows[0] + rows[1] + rows[0])
    assert refused(tmp_path, name, good + rows[1] + rows[0])


@pytest.mark.parametrize(("name", "data"), [("a.pcd", PCD), ("a.ply", PLY)])
def test_ascii_rows_need_the_columns_of_their_header(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    np.testing.assert_array_equal(read_cloud(tmp_path / name), [[2, 3, 4], [5, 6, 7]])
    assert "row 2 has 3 columns where 4 are needed: '2 6 7'" in refused(tmp_path, name, data.replace(b"2 5 6", b"2 6"))
    assert "row 1 has 5 columns" in refused(tmp_path, name, data.replace(b"1 2 3", b"1 2 2 3"))
    assert "not three numbers in every row" in refused(tmp_path, name, data.replace(b"2 5 6 7", b"2 1,5 6 7"))
    assert "3 rows follow" in refused(tmp_path, name, data + b"3 8 9 10\n")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"# columns: x y z\n1 2 3\n", "row 1 has 3 columns where 4 are needed"),
        (b"x y z i\n1,5 2,5 3,5\n", "not three numbers in every row"),
        (b"x y z\n1,5 2,5 3,5\n", "row 1 has 4 columns where 3 are needed"),
        (b"x,y,z,x\n1,2,3,4\n", "x, y and z name one column each; got x, y, z, x"),
        (b"1,5;2,5;3,5\n", "numbers have a decimal point"),
        (b"1,5\t2,5\t3,5\n", "numbers have a decimal point"),
    ],
)
def test_names_and_decimal_commas(tmp_path, data, message):
    assert message in refused(tmp_path, "a.xyz", data)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"WIDTH 2", b"WIDTH 3", "WIDTH 3 times HEIGHT 1 of the PCD header is not POINTS 2"),
        (b"HEIGHT 1", b"HEIGHT 0", "WIDTH 2 times HEIGHT 0 of the PCD header is not POINTS 2"),
        (b"WIDTH 2", b"WIDTH two", "WIDTH of the PCD header has to be a whole number; got 'two'"),
        (b"POINTS 2", b"POINTS 2\nPOINTS 1", "the PCD header has two lines POINTS"),
        (b"id x", b"x x", "x, y and z name one field each; got the fields x x y z"),
        (b"POINTS 2", b"POINTS " + b"9" * 5000, "POINTS of the PCD header has to be a whole number; got '9999"),
    ],
)
def test_inconsistent_pcd_headers_are_refused(tmp_path, old, new, message):
    assert message in refused(tmp_path, "a.pcd", PCD.replace(old, new))


def test_trailing_bytes_are_padding_or_an_error(tmp_path):
    header = PCD.replace(b"ascii", b"binary").partition(b"1 2 3 4\n")[0]
    ply = PLY.replace(b"ascii", b"binary_little_endian").partition(b"1 2 3 4\n")[0]
    packed = lzf.compress(bytes(32), 100)
    block = struct.pack("<II", len(packed), 32) + packed
    for name, data in (
        ("a.pcd", header + bytes(32)),
        ("b.pcd", header.replace(b"binary", b"binary_compressed") + block),
        ("c.ply", ply + bytes(32)),
    ):
        (tmp_path / name).write_bytes(data + bytes(4000))
        assert read_cloud(tmp_path / name).shape == (2, 3)
        assert "17 bytes follow the points that the header claims" in refused(tmp_path, name, data + bytes(16) + b"1")


def test_huge_unused_fields_allocate_no_memory(tmp_path):
    many = PCD.replace(b"COUNT 1 1 1 1", b"COUNT 1000000000 1 1 1")
    empty = many.replace(b"WIDTH 2", b"WIDTH 0").replace(b"POINTS 2", b"POINTS 0").partition(b"1 2 3 4\n")[0]
    binary = many.replace(b"ascii", b"binary")
    # One that is as wide as the file says is no claim: 4 MB for one point.
    wide = b"FIELDS id x y z\nSIZE 4 4 4 4\nTYPE U F F F\nCOUNT 1000000 1 1 1\nPOINTS 1\nDATA binary\n" + bytes(
        4_000_000
    )
    (tmp_path / "wide.pcd").write_bytes(wide + np.array([1, 2, 3], "<f4").tobytes())
    tracemalloc.start()
    try:
        (tmp_path / "empty.pcd").write_bytes(empty.replace(b"ascii", b"binary"))
        assert read_cloud(tmp_path / "empty.pcd").shape == (0, 3)
        assert "claims 2 points of 4000000012 bytes" in refused(tmp_path, "binary.pcd", binary)
        assert "1000000003 are needed" in refused(tmp_path, "ascii.pcd", many)
        assert read_cloud(tmp_path / "wide.pcd").tolist() == [[1, 2, 3]]
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak_bytes < 10e6


def npz(compression, claimed_bytes=None):
    array, stream = io.BytesIO(), io.BytesIO()
    np.save(array, np.zeros((20_000, 3)))
    with zipfile.ZipFile(stream, "w", compression) as archive:
        archive.writestr("points.npy", array.getvalue())
        archive.infolist()[0].file_size = claimed_bytes or len(array.getvalue())
    return stream.getvalue()


@pytest.mark.parametrize("compression", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_archives_grow_up_to_the_memory_limit(tmp_path, monkeypatch, compression):
    (tmp_path / "a.npz").write_bytes(npz(compression))
    assert read_cloud(tmp_path / "a.npz").shape == (20_000, 3)
    monkeypatch.setenv("TORCHCOVER_MAX_FILE_GB", "0.0004")
    assert "more than the 0.0004 GB that one file may take" in refused(tmp_path, "a.npz", npz(compression))
    assert "claims 900000000 bytes out of" in refused(tmp_path, "a.npz", npz(compression, 900_000_000))


@pytest.mark.parametrize("compression", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_archives_beyond_the_memory_limit_are_refused(tmp_path, compression):
    """4.7 kB of bzip2 became 12 GB."""
    assert "otherwise than NumPy does it; use numpy.savez" in refused(tmp_path, "a.npz", npz(compression))


@pytest.mark.parametrize("before", ["", "x,y,z\n1,2,3\n", "# x,y,z\n", "// "])
def test_very_long_lines_are_refused_before_splitting(tmp_path, before):
    """Millions of words take fifty times the memory of the file."""
    (path := tmp_path / "a.csv").write_text(before + "1," * 600_000 + "1\n")
    with pytest.raises(BadFileError, match=r"a line of 12000[0-9]{2} characters; at most 1000000 are allowed"):
        read_cloud(path)


def test_text_stays_within_the_memory_limit(tmp_path, monkeypatch):
    data = b"1 2 3\n" * 10_000
    (tmp_path / "a.xyz").write_bytes(data)
    assert len(read_cloud(tmp_path / "a.xyz")) == 10_000
    monkeypatch.setenv("TORCHCOVER_MAX_FILE_GB", "0.0005")
    assert "reading it takes 0.0006 GB of memory" in refused(tmp_path, "a.xyz", data)


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("a.bin", RINGS.tobytes(), "every fifth is a ring, so it holds no .bin .*suffix of its format, as .pcd.bin"),
        ("a.pcd.bin", CLOUD.tobytes(), "every fourth is an intensity, so it holds no .pcd.bin .*, as .bin"),
        ("a.bin", SIX.tobytes(), "not an intensity but has coordinates in it.*write its points as .npy"),
        ("a.pcd.bin", SIX[:-10].tobytes(), "not a ring but has coordinates"),
        ("a.bin", SEVEN.tobytes(), "not an intensity but has coordinates in it"),
        ("a.bin", EIGHT.tobytes(), "every second point has no negative y or z"),
        (
            "a.bin",
            np.tile(CLOUD[:, :3], (2, 1)).tobytes(),
            "not an intensity but has coordinates in it, so it holds no .bin",
        ),
        ("a.bin", CLOUD.astype("<f8").tobytes(), "of 200 points lie beyond 100000 m.*of little-endian float32"),
        ("a.bin", CLOUD.astype(">f4").tobytes(), "denormal|lie beyond"),
        ("a.bin", (1000 * CLOUD).astype("<i4").tobytes(), "denormal|finite in one coordinate"),
        ("a.bin", (100 * CLOUD).astype("<i2").tobytes(), "denormal|lie beyond"),
        ("a.bin", np.full((20, 4), 7.0, "<f4").tobytes(), "20 of 20 points have x = y = z"),
        ("a.pcd.bin", bytes(200), "all of its 200 bytes are zero: it was never written"),
        ("a.bin", b"VERSION 0.7\nFIELDS x y z\n" + bytes(7), "the content is a .pcd, not 4 float32 a point"),
        ("a.bin", b"\x93NUMPY" + bytes(26), "the content is a .npy, not 4 float32 a point"),
        ("a.bin", b"1.0 2.0 3.0\n" * 4, "the content is text"),
    ],
)
def test_implausible_headerless_numbers_are_refused(tmp_path, name, data, message):
    assert re.search(message, refused(tmp_path, name, data))


@pytest.mark.parametrize("columns", [4, 5])
@pytest.mark.parametrize("seed", range(20))
def test_typical_sensor_clouds_are_plausible(tmp_path, columns, seed):
    """With no-returns at the origin and as NaN, far and near ones, and any number of points."""
    random = np.random.default_rng(seed)
    points = random.normal(0, random.choice([0.1, 30, 5000]), (random.integers(1, 3000), 5)).astype("<f4")
    points[:, 3] = random.choice([1, 255]) * random.random(len(points))
    points[:, 4] = random.integers(0, 128, len(points))
    points[random.random(len(points)) < random.choice([0, 0.6]), :3] = random.choice([0, np.nan])
    points[0, :3] = 1.5
    path = tmp_path / ("a.bin" if columns == 4 else "a.pcd.bin")
    points[:, :columns].tofile(path)
    np.testing.assert_array_equal(read_cloud(path), points[:, :3])
