import io
import struct
import sys
import tracemalloc
import zipfile
from inspect import unwrap

import laspy
import lzf
import numpy as np
import pytest

from torchcover.files import BadFileError
from torchcover.recordings import RecordingSettings, open_recording
from torchcover.recordings.clouds import READERS, read_cloud
from torchcover.recordings.isolated_readers import read_laz_points
from torchcover.simulation.mesh_files import read_mesh_arrays

CLOUD = np.array([[1.5, -2.25, 0.125], [-3.0, 4.0, 5.5], [70.0, 0.5, -1.75]], dtype=np.float32)
UTM = np.array([[513248.123, 5403655.456, 260.389], [513414.844, 5403760.001, 337.601]])


def npy_bytes(array):
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def npz_bytes(**arrays):
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def with_columns(array, columns):
    extra = np.full((len(array), columns - 3), 99.0, np.float32)
    return np.hstack([array, extra]).astype("<f4").tobytes()


def rows(array, separator=" "):
    return "".join(separator.join(map(repr, row)) + "\n" for row in array.tolist()).encode()


def pcd_header(points, encoding, fields="x y z", sizes="4 4 4", types="F F F", counts="1 1 1"):
    return (
        f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\n"
        f"COUNT {counts}\nWIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {encoding}\n"
    ).encode()


def pcd_block(columns):
    """A binary_compressed body: every field's values together, then LZF; one that does not shrink is stored."""
    plain = b"".join(np.ascontiguousarray(column).tobytes() for column in columns)
    packed = lzf.compress(plain, 2 * len(plain) + 64)
    return struct.pack("<II", len(packed), len(plain)) + packed


def las_bytes(array, *, compressed=False):
    """A survey to the 1/256 of a metre, which `CLOUD` has exactly."""
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = [2**-8] * 3, [0.0, 1.0, 0.0]
    survey = laspy.LasData(header)
    survey.x, survey.y, survey.z = array.T.astype(np.float64)
    stream = io.BytesIO()
    survey.write(stream, do_compress=compressed)
    return stream.getvalue()


def las_in(*records, **options):
    """A survey whose records say its coordinate system: GeoKeys by key, WKT, or both."""
    keys = dict(record for record in records if isinstance(record, tuple))
    wkt = [record for record in records if isinstance(record, str)]
    header = laspy.LasHeader(point_format=6, version="1.4") if not keys else laspy.LasHeader(point_format=3)
    header.scales, header.offsets = [2**-8] * 3, [0.0, 1.0, 0.0]
    rows = [(1, 1, 0, len(keys)), *((key, 0, 1, value) for key, value in keys.items())]
    stored = [laspy.VLR("LASF_Projection", 34735, "", np.array(rows, "<u2").tobytes())] if keys else []
    stored += [laspy.VLR("LASF_Projection", 2112, "", text.encode() + b"\0") for text in wkt]
    survey = laspy.LasData(header)
    survey.x, survey.y, survey.z = CLOUD.T.astype(np.float64)
    if options.get("extended"):
        survey.evlrs = laspy.vlrs.vlrlist.VLRList(stored)
    else:
        survey.vlrs.extend(stored)
    stream = io.BytesIO()
    survey.write(stream, do_compress=options.get("compressed", False))
    return stream.getvalue()


FTUS, FEET = 1200 / 3937, 0.3048
DEGREES = 'GEOGCS["NAD83",DATUM["NAD",SPHEROID["GRS",6378137,298.25]],PRIMEM["G",0],UNIT["degree",0.0174]]'
STATE_PLANE = f'PROJCS["Georgia [west] (ftUS)",{DEGREES},PROJECTION["TM"],UNIT["US survey foot",{FTUS!r}]]'
WKT2 = (
    'COMPOUNDCRS["a",PROJCRS["b",BASEGEOGCRS["c",DATUM["d",ELLIPSOID["e",1,2,LENGTHUNIT["metre",1]]]],'
    'CONVERSION["f",PARAMETER["g",0,LENGTHUNIT["metre",1]]],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],'
    'LENGTHUNIT["foot",0.3048]],VERTCRS["h",CS[vertical,1],AXIS["z",up],LENGTHUNIT["metre",1]]]'
)


@pytest.mark.parametrize(
    ("las", "meters"),
    [
        (las_in((1024, 1), (3072, 2240), (3076, 9003)), (FTUS, FTUS, FTUS)),
        (las_in((1024, 1), (3072, 26916), (4099, 9002)), (1.0, 1.0, FEET)),
        (las_in(STATE_PLANE), (FTUS, FTUS, FTUS)),
        (las_in(STATE_PLANE, extended=True), (FTUS, FTUS, FTUS)),
        (las_in(f'COMPD_CS["x",{STATE_PLANE},VERT_CS["NAVD88",UNIT["metre",1]]]', compressed=True), (FTUS, FTUS, 1)),
        (las_in(WKT2), (FEET, FEET, 1.0)),
        (las_in((4099, 9001), STATE_PLANE), (FTUS, FTUS, 1.0)),
    ],
)
def test_las_feet_are_converted_with_a_warning(tmp_path, las, meters):
    suffix = ".laz" if las[104] & 0x80 else ".las"
    with pytest.warns(UserWarning, match=r"converted to meters, as the file says: .* leave out recording.units"):
        cloud = read_cloud(store(tmp_path, suffix, las))
    np.testing.assert_allclose(cloud, CLOUD * meters, rtol=1e-12)


@pytest.mark.filterwarnings("ignore:LAS coordinates are converted")
def test_las_feet_are_converted_once(tmp_path):
    (tmp_path / "sensor").mkdir()
    (tmp_path / "reference").mkdir()
    settings = RecordingSettings(units="ft")
    for folder in ("sensor", "reference"):
        (tmp_path / folder / "a.las").write_bytes(las_in(""))
    cloud = open_recording(tmp_path, settings).read_scan("sensor", 0).points_m
    np.testing.assert_allclose(cloud, CLOUD * FEET)  # the file says no unit
    (tmp_path / "sensor" / "a.las").write_bytes(las_in(STATE_PLANE))
    with pytest.raises(ValueError, match=r"a\.las: it is converted to meters, .* leave out recording\.units=ft"):
        open_recording(tmp_path, settings).read_scan("sensor", 0)


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("stored", [-(2**31), 2**31 - 1])
def test_truncated_las_coordinates_are_refused(tmp_path, stored, compressed):
    """Programs that write without an offset clamp what does not fit into 32 bits."""
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = np.full(3, 0.001), np.zeros(3)
    survey = laspy.LasData(header)
    survey.X, survey.Y, survey.Z = np.array([207_628_825, 207_628_925]), np.array([0, stored]), np.zeros(2, np.int32)
    path = tmp_path / f"a.{'laz' if compressed else 'las'}"
    survey.write(path)
    with pytest.raises(ValueError, match=r"1 of 2 points have coordinates at an end .* export it again with offsets"):
        read_cloud(path)


def test_las_meters_are_unchanged_and_degrees_are_refused(tmp_path):
    for las in (las_in((1024, 1), (3072, 32633)), las_in(STATE_PLANE.replace(repr(FTUS), "1.0")), las_in("")):
        np.testing.assert_array_equal(read_cloud(store(tmp_path, ".las", las)), CLOUD)
    with pytest.warns(UserWarning, match=r"EPSG:2240 without a unit .* --set recording.units=ft"):
        np.testing.assert_array_equal(read_cloud(store(tmp_path, ".las", las_in((1024, 1), (3072, 2240)))), CLOUD)
    for las, message in (
        (las_in((1024, 2), (2048, 4326)), r"x and y are degrees \(GTModelTypeGeoKey 2\); reproject"),
        (las_in(DEGREES), "x and y are degrees .* reproject"),
        (las_in((1024, 1), (3076, 9005)), "unit EPSG:9005 of its GeoKeys is unknown; known are 9001"),
    ):
        with pytest.raises(BadFileError, match=message):
            read_cloud(store(tmp_path, ".las", las))


def ply_header(encoding, *lines):
    return "\n".join(["ply", f"format {encoding} 1.0", *lines, "end_header", ""]).encode()


def xyz_lines(count, kind="float"):
    return [f"element vertex {count}", *(f"property {kind} {axis}" for axis in "xyz")]


FORMATS = {
    "npy": (".npy", npy_bytes(CLOUD)),
    "npy_big_endian": (".npy", npy_bytes(CLOUD.astype(">f4"))),
    "npy_fortran_order": (".npy", npy_bytes(np.asfortranarray(CLOUD))),
    "npy_float64": (".npy", npy_bytes(CLOUD.astype(np.float64))),
    "npy_more_columns": (".npy", npy_bytes(np.hstack([CLOUD, CLOUD]))),
    "npy_python2": (".npy", npy_bytes(CLOUD).replace(b"(3, 3), }  ", b"(3L, 3L), }")),
    "npz_points": (".npz", npz_bytes(points=CLOUD, pose=np.eye(4))),
    "npz_single": (".npz", npz_bytes(cloud=CLOUD)),
    "npz_only_one_of_three_columns": (".npz", npz_bytes(cloud=CLOUD, pose=np.eye(4), ring=np.arange(3))),
    "npy_float16": (".npy", npy_bytes(CLOUD.astype(np.float16))),
    "kitti": (".bin", with_columns(CLOUD, 4)),
    "nuscenes": (".pcd.bin", with_columns(CLOUD, 5)),
    "pcd_ascii": (".pcd", pcd_header(3, "ascii") + rows(CLOUD)),
    "pcd_binary": (".pcd", pcd_header(3, "binary") + CLOUD.tobytes()),
    "pcd_compressed": (".pcd", pcd_header(3, "binary_compressed") + pcd_block(CLOUD.T)),
    "ply_ascii": (".ply", ply_header("ascii", *xyz_lines(3)) + rows(CLOUD)),
    "ply_binary": (".ply", ply_header("binary_little_endian", *xyz_lines(3)) + CLOUD.tobytes()),
    "ply_big_endian": (".ply", ply_header("binary_big_endian", *xyz_lines(3)) + CLOUD.astype(">f4").tobytes()),
    "ply_carla": (".ply", ply_header("ascii", *xyz_lines(3, "float32")) + rows(CLOUD)),
    "csv": (".csv", b"x,y,z\n" + rows(CLOUD, ",")),
    "xyz": (".xyz", rows(CLOUD)),
    "las": (".las", las_bytes(CLOUD)),
    "laz": (".laz", las_bytes(CLOUD, compressed=True)),
}
OF_FLOAT64 = {"npy_float64", "pcd_ascii", "ply_ascii", "ply_carla", "csv", "xyz", "las", "laz"}


def store(folder, suffix, data):
    path = folder / f"cloud{suffix}"
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_same_cloud(tmp_path, name):
    cloud = read_cloud(store(tmp_path, *FORMATS[name]))
    np.testing.assert_array_equal(cloud, CLOUD)
    assert cloud.dtype == (np.float64 if name in OF_FLOAT64 else np.float32)
    assert cloud.dtype.isnative
    assert cloud.flags.c_contiguous
    assert cloud.flags.writeable


def test_every_registered_suffix_has_a_format_here():
    assert {suffix for suffix, _ in FORMATS.values()} == set(READERS)


@pytest.mark.parametrize(
    ("suffix", "data"),
    [
        (".npy", npy_bytes(UTM)),
        (".npz", npz_bytes(points=UTM)),
        (".csv", rows(UTM, ",")),
        (".pcd", pcd_header(2, "ascii") + rows(UTM)),
        (".pcd", pcd_header(2, "binary", sizes="8 8 8") + UTM.tobytes()),
        (".pcd", pcd_header(2, "binary_compressed", sizes="8 8 8") + pcd_block(UTM.T)),
        (".ply", ply_header("ascii", *xyz_lines(2)) + rows(UTM)),
        (".ply", ply_header("binary_little_endian", *xyz_lines(2, "double")) + UTM.tobytes()),
    ],
)
def test_utm_coordinates_keep_every_digit(tmp_path, suffix, data):
    np.testing.assert_array_equal(read_cloud(store(tmp_path, suffix, data)), UTM)


@pytest.mark.parametrize(
    ("suffix", "data"),
    [
        (".npy", npy_bytes(CLOUD[:0])),
        (".npz", npz_bytes(points=CLOUD[:0])),
        (".pcd", pcd_header(0, "ascii")),
        (".pcd", pcd_header(0, "binary")),
        (".pcd", pcd_header(0, "binary_compressed")),
        (".ply", ply_header("ascii", *xyz_lines(0))),
        (".ply", ply_header("binary_little_endian", *xyz_lines(0))),
        (".csv", b"x,y,z\n"),
        (".xyz", b"# x y z\n"),
        (".las", las_bytes(CLOUD[:0])),
        (".laz", las_bytes(CLOUD[:0], compressed=True)),
    ],
)
def test_a_header_without_points_is_an_empty_cloud(tmp_path, suffix, data):
    assert read_cloud(store(tmp_path, suffix, data)).shape == (0, 3)


@pytest.mark.parametrize("name", ["KITTI.BIN", "a.b.Bin", "sweep.PCD.bin"])
def test_suffix_ignores_case_and_longest_one_counts(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(with_columns(CLOUD, 5 if "PCD" in name else 4))
    np.testing.assert_array_equal(read_cloud(path), CLOUD)


@pytest.mark.parametrize(
    "data",
    [
        b"1,2,3\n4,5,6\n",
        b"1  2   3\n4\t5 6",
        b"1,2,3\r\n4,5,6\r\n",
        b" 1 , 2 , 3 ,9\n4,5,6,9\n",
        b"\xef\xbb\xbfx,y,z\n1,2,3\n4,5,6\n",
        b"# made by hand\n\n1 2 3 0.5\n# in between\n4 5 6 0.5\n\n",
        b"//X Y Z I\n1 2 3 9\n4 5 6 9\n",
        b'"t","Z","y","X"\n0,3,2,1\n0,6,5,4\n',
        b"# t,x,y,z\n0,1,2,3\n0,4,5,6\n",
        b"intensity x y z\n0,1,2,3\n0,4,5,6\n",
    ],
)
def test_text_allows_commas_spaces_comments_and_headers(tmp_path, data):
    np.testing.assert_array_equal(read_cloud(store(tmp_path, ".csv", data)), [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize("word", ["-nan", "NaN", "-nan(ind)", "nan(snan)", "-1.#IND", "1.#QNAN0", "-1.#INF", "1.#R"])
def test_nan_may_be_spelled_as_windows_does(tmp_path, word):
    lines = f"4 5 6\n{word} 0 1\n1 2 3\n"
    pcd = read_cloud(store(tmp_path, ".pcd", pcd_header(3, "ascii") + lines.encode()))
    text = read_cloud(store(tmp_path, ".csv", lines.replace(" ", ",").encode()))
    for cloud in (pcd, text):
        np.testing.assert_array_equal(cloud, [[4, 5, 6], [np.nan, 0, 1], [1, 2, 3]])


def test_pcd_viewpoint_is_ignored_with_a_warning(tmp_path):
    header = pcd_header(3, "ascii").replace(b"VIEWPOINT 0 0 0", b"VIEWPOINT 1 2 0")
    with pytest.warns(UserWarning, match="VIEWPOINT 1 2 0 1 0 0 0 of PCD files is not applied"):
        np.testing.assert_array_equal(read_cloud(store(tmp_path, ".pcd", header + rows(CLOUD))), CLOUD)


MIXED = np.array(
    [(2.0, 7, (8, 9), 1.0, 3, 3.0), (5.0, 7, (8, 9), 4.0, 3, 6.0)],
    dtype=[("y", "<f8"), ("rgb", "<u4"), ("pair", "<i2", 2), ("x", "<f4"), ("_", "u1"), ("z", "<f4")],
)
MIXED_HEADER = {
    "fields": "y rgb pair x _ z",
    "sizes": "8 4 2 4 1 4",
    "types": "F U I F U F",
    "counts": "1 1 2 1 1 1",
}


@pytest.mark.parametrize(
    ("encoding", "body"),
    [
        ("ascii", b"2 7 8 9 1 3 3\n5 7 8 9 4 3 6\n"),
        ("binary", MIXED.tobytes()),
        ("binary_compressed", pcd_block([MIXED[name] for name in MIXED.dtype.names])),
    ],
)
def test_pcd_finds_coordinates_among_other_fields(tmp_path, encoding, body):
    path = store(tmp_path, ".pcd", pcd_header(2, encoding, **MIXED_HEADER) + body)
    np.testing.assert_array_equal(read_cloud(path), [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize(
    "data",
    [
        (pcd_header(3, "ascii") + rows(CLOUD, "   ")).replace(b"\n", b"\r\n"),
        pcd_header(3, "ascii").replace(b"COUNT 1 1 1\n", b"") + rows(CLOUD),
        pcd_header(3, "binary").replace(b"COUNT 1 1 1\n", b"").replace(b"0.7", b".6") + CLOUD.tobytes(),
        pcd_header(3, "binary") + CLOUD.tobytes() + bytes(4096),
        pcd_header(3, "binary_compressed") + pcd_block(CLOUD.T) + bytes(4096),
        (pcd_header(3, "binary").replace(b"\n", b"\r\n")) + CLOUD.tobytes(),
        pcd_header(3, "ascii", "x y z _", "4 4 4 1", "F F F U", "1 1 1 0") + rows(CLOUD),
        pcd_header(3, "binary", "x y z _", "4 4 4 1", "F F F U", "1 1 1 0") + CLOUD.tobytes(),
        pcd_header(3, "ascii").replace(b"FIELDS", b"COLUMNS").replace(b"POINTS 3\n", b"") + rows(CLOUD),
    ],
)
def test_pcd_variants_found_in_the_wild(tmp_path, data):
    np.testing.assert_array_equal(read_cloud(store(tmp_path, ".pcd", data)), CLOUD)


FACES = struct.pack("<B3i", 3, 0, 1, 2) + struct.pack("<B4i", 4, 0, 1, 2, 0)
FACE_LINES = ["element face 2", "property list uchar int vertex_indices"]
GRID_LINES = ["element grid 1", "property uchar rows", "property double scale"]


@pytest.mark.parametrize(
    "data",
    [
        ply_header("binary_little_endian", *xyz_lines(3), *FACE_LINES) + CLOUD.tobytes() + FACES,
        ply_header("binary_little_endian", *GRID_LINES, *xyz_lines(3)) + struct.pack("<Bd", 1, 2.0) + CLOUD.tobytes(),
        ply_header("ascii", *FACE_LINES, *xyz_lines(3)) + b"3 0 1 2\n4 0 1 2 0\n" + rows(CLOUD),
        ply_header("ascii", "comment end_header element x", "obj_info a", *xyz_lines(3)).replace(b"\n", b"\r\n")
        + rows(CLOUD, "  "),
        ply_header(
            "binary_little_endian",
            "element vertex 3",
            "property uchar red",
            "property float x",
            "property float y",
            "property float z",
        )
        + b"".join(b"\x07" + row.tobytes() for row in CLOUD),
    ],
)
def test_ply_finds_the_vertices_among_other_elements(tmp_path, data):
    np.testing.assert_array_equal(read_cloud(store(tmp_path, ".ply", data)), CLOUD)


def test_laz_without_laspy_names_the_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(ImportError, match=r"cloud\.laz: LAZ needs laspy: pip install 'torchcover\[las\]'"):
        unwrap(read_laz_points)(store(tmp_path, *FORMATS["laz"]), 3)
    np.testing.assert_array_equal(read_cloud(store(tmp_path, *FORMATS["las"])), CLOUD)


PNG = b"\x89PNG\r\n\x1a\n" + bytes(range(1, 100))
BINARY_PLY = ply_header("binary_little_endian", *xyz_lines(3)) + CLOUD.tobytes()


def mislabelled_member():
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("points.npy", PNG)
    return stream.getvalue()


def test_laz_files_are_read_after_meshes(tmp_path):
    """Libraries look into all loaded modules, among them the one that stands in for a detector of encodings."""
    mesh = tmp_path / "triangle.obj"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert len(read_mesh_arrays(mesh)["faces"]) == 1
    assert len(read_cloud(store(tmp_path, *FORMATS["laz"]))) == len(CLOUD)


@pytest.mark.parametrize(
    ("suffix", "data", "message"),
    [
        *((suffix, b"", r"an empty file \(0 bytes\)") for suffix in READERS),
        # .npy and .npz
        (".npy", PNG, r"not a readable \.npy header \(.*magic"),
        (".npy", npy_bytes(CLOUD)[:-1], r"claims \(3, 3\) float32 = 36 bytes; 35 bytes follow it"),
        (".npy", npy_bytes(CLOUD) + b"\0", r"= 36 bytes; 37 bytes follow it"),
        (".npy", npy_bytes(np.array([[{}, 1, 2]], dtype=object)), r"is needed; got pickled Python objects"),
        (".npy", npy_bytes(CLOUD.astype(np.int32)), r"float32 or float64 is needed; got int32"),
        (".npy", npy_bytes(CLOUD[:, :2]), r"shape \(N, 3\).* is needed; got \(3, 2\)"),
        (".npy", npy_bytes(CLOUD[0]), r"is needed; got \(3,\)"),
        (".npy", npy_bytes(CLOUD[None]), r"is needed; got \(1, 3, 3\)"),
        (".npy", npy_bytes(np.zeros((3, 17))), r"up to \(N, 16\) .* is needed; got \(3, 17\)"),
        (".npz", PNG, r"not a readable \.npz archive \(File is not a zip file\)"),
        (".npz", npz_bytes(points=CLOUD)[:-30], r"not a readable \.npz archive"),
        (".npz", mislabelled_member(), r"not a readable \.npy header"),
        (".npz", npz_bytes(a=CLOUD, b=CLOUD), r"of shape \(N, 3\) is needed; got 2 arrays: a, b$"),
        (".npz", npz_bytes(a=np.eye(4), b=np.ones(3)), r"of shape \(N, 3\) is needed; got 2 arrays: a, b$"),
        (".las", b"LAS!" + las_bytes(CLOUD)[4:], r"not a LAS file: it starts with b'LAS!'"),
        (".las", las_bytes(CLOUD)[:100], r"a header of 227 bytes is needed; the file has 100"),
        (".las", las_bytes(CLOUD)[:-1], r"the header claims 3 points of 34 bytes from byte 227 on; the file has 328"),
        (
            ".laz",
            las_bytes(CLOUD, compressed=True)[:-20],
            r"of chunks is claimed at byte 395; the file has 38",
        ),
        (".laz", las_bytes(CLOUD, compressed=True)[:399] + b"\xff" * 9, r"3 points, the table of chunks 4294967295 "),
        (".npz", npz_bytes(), r"got 0 arrays: none$"),
        (".npz", npz_bytes(points=np.array([None])), r"got pickled Python objects"),
        # records
        (".bin", with_columns(CLOUD, 4)[:-3], r"45 bytes are no whole number of 16-byte points .* 13 bytes are left"),
        (".bin", b"1.0 2.0 3.0\n4.0 5.0 6.0\n", r"the content is text \(\.csv or \.xyz\?\), not 4 float32 a point"),
        (".pcd.bin", with_columns(CLOUD, 4), r"48 bytes are no whole number of 20-byte points"),
        # text
        (".csv", PNG, r"not text in UTF-8: there is a byte 0x89"),
        (".csv", b"1,2\n3,4\n", r"not three numbers in every row"),
        (".csv", b"1,2,3\n4,five,6\n", r"not three numbers in every row .*five"),
        (".csv", b"1,2,3\n4,,6\n", r"not three numbers in every row"),
        (".xyz", b"1 2 3\n4 5", r"not three numbers in every row"),
        (".csv", b"east,north,up\n1,2,3\n", r"has to name the columns x, y and z; got 'east,north,up'"),
        (".csv", b"1;2;3\n", r"has to name the columns x, y and z; got '1;2;3'"),
        # .pcd
        (".pcd", PNG, r"not a PCD file: no line DATA ends the header; it starts with b'.x89PNG"),
        (".pcd", b"VERSION .7\nFIEL", r"not a PCD file: no line DATA"),
        (".pcd", b"FIELDS x y z\nDATA ascii\n", r"lacks SIZE, TYPE, POINTS; it has FIELDS, DATA"),
        (".pcd", pcd_header(2, "ascii", fields="x y i") + b"1 2 3\n" * 2, r"no field z among the fields x y i"),
        (".pcd", pcd_header(2, "ascii", types="F F I"), r"field z is TYPE I SIZE 4 COUNT 1; TYPE F"),
        (".pcd", pcd_header(2, "ascii", counts="2 1 1"), r"field x is TYPE F SIZE 4 COUNT 2"),
        (
            ".pcd",
            pcd_header(2, "ascii", counts="1 1"),
            r"differ in length; got 3, 3, 3, 2; give each",
        ),
        (".pcd", pcd_header(2, "ascii", counts="1 1 0"), r"field z is TYPE F SIZE 4 COUNT 0; .* COUNT 1 is needed"),
        (".pcd", pcd_header(-1, "ascii"), r"WIDTH of the PCD header has to be a whole number; got '-1'"),
        (".pcd", pcd_header(1, "zstd"), r"DATA is 'zstd'; allowed are ascii, binary, binary_compressed"),
        (".pcd", pcd_header(3, "ascii") + rows(CLOUD[:2]), r"claims 3 points; 2 rows follow it"),
        (".pcd", pcd_header(2, "ascii") + rows(CLOUD), r"claims 2 points; 3 rows follow it"),
        (".pcd", pcd_header(1, "ascii") + b"1 2\n", r"not three numbers in every row"),
        (".pcd", pcd_header(3, "binary") + CLOUD.tobytes()[:-1], r"truncated or too long: .* = 36 bytes; there are 35"),
        (".pcd", pcd_header(3, "binary_compressed") + b"1234", r"truncated: the sizes .* missing; 4 bytes follow"),
        (".pcd", pcd_header(3, "binary_compressed") + pcd_block(CLOUD.T)[:-1], r"truncated: the compressed block"),
        (".pcd", pcd_header(4, "binary_compressed") + pcd_block(CLOUD.T), r"= 48 bytes; there are 36"),
        (
            ".pcd",
            pcd_header(3, "binary_compressed") + struct.pack("<II", 30, 36) + b"\xff" * 30,
            r"the compressed block does not decompress to the 36 bytes that it claims",
        ),
        (
            ".pcd",
            pcd_header(1, "binary", "x y z i", "4 4 4 4", "F F F G", "1 1 1 1") + bytes(16),
            r"TYPE of the PCD header is one of F, U, I; got G",
        ),
        (".pcd", b"# log\n" * 20_000 + pcd_header(0, "ascii"), r"not a PCD file: no line DATA"),
        # .ply
        (".ply", ply_header("ascii", *["comment x"] * 10_000, *xyz_lines(0)), r"a line end_header is missing"),
        (".ply", PNG, r"not a PLY file: it starts with b'.x89PNG"),
        (".ply", b"ply\nformat ascii 1.0\nelement vertex 1\n", r"a line end_header is missing"),
        (".ply", ply_header("ascii"), r"no element vertex among the elements: none"),
        (".ply", ply_header("ascii", *FACE_LINES), r"no element vertex among the elements: face"),
        (".ply", ply_header("base64", *xyz_lines(1)), r"the PLY format is 'base64'; allowed are ascii,"),
        (".ply", ply_header("ascii", "property float x"), r"not a line of a PLY header: 'property float x'"),
        (".ply", ply_header("ascii", "element vertex -1"), r"not a line of a PLY header: 'element vertex -1'"),
        (".ply", ply_header("ascii", "element vertex 1", "property real x"), r"property 'real x' is .* no known type"),
        (".ply", ply_header("ascii", *xyz_lines(1), "property float x"), r"property 'float x' is repeated"),
        (".ply", ply_header("ascii", *xyz_lines(1)[:-1]), r"the vertices have no z; got x, y"),
        (".ply", ply_header("ascii", *xyz_lines(1, "int")), r"x y z have to be float or double; got i4"),
        (".ply", ply_header("ascii", *xyz_lines(1), "property list uchar int i"), r"vertices have a list property"),
        (".ply", ply_header("ascii", *xyz_lines(4)) + rows(CLOUD), r"truncated: .* 4 of vertex.*; 3 rows follow"),
        (".ply", ply_header("ascii", *xyz_lines(1)) + b"1 2\n", r"not three numbers in every row"),
        (".ply", BINARY_PLY[:-1], r"truncated: .* 3 of vertex, at least 36 bytes; 35 bytes follow it"),
        (
            ".ply",
            ply_header("binary_little_endian", *FACE_LINES, *xyz_lines(3)) + FACES + CLOUD.tobytes(),
            r"an? .*element with a list stands before the vertices",
        ),
        # values
        (".npy", npy_bytes(np.full((4, 3), np.nan)), r"none of the 4 points is finite"),
        (".xyz", b"nan 1 2\n1 inf 2\n", r"none of the 2 points is finite"),
    ],
)
def test_bad_clouds_raise_one_line_with_file_name(tmp_path, suffix, data, message):
    path = store(tmp_path, suffix, data)
    with pytest.raises(ValueError, match=message) as caught:
        read_cloud(path)
    assert type(caught.value) is BadFileError
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def huge_npy(shape):
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".ljust(117).encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + CLOUD.tobytes()


def npz_member(data, claimed_bytes=None):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", data)
        if claimed_bytes is not None:
            archive.infolist()[0].file_size = claimed_bytes
    return stream.getvalue()


@pytest.mark.parametrize(
    ("suffix", "data", "message"),
    [
        (".npy", huge_npy((10**12, 3)), r"= 12000000000000 bytes; 36 bytes follow it"),
        (".npz", npz_member(huge_npy((10**12, 3))), r"= 12000000000000 bytes; 36 bytes follow it"),
        (
            ".npz",
            npz_member(huge_npy((10**8, 3)), 10 + 118 + 12 * 10**8),
            r"points.npy claims 1200000128 bytes out of 104 compressed ones; at most 107328 are possible",
        ),
        (".pcd", pcd_header(10**12, "ascii") + rows(CLOUD), r"claims 1000000000000 points; 3 rows"),
        (".pcd", pcd_header(10**12, "binary") + CLOUD.tobytes(), r"= 12000000000000 bytes; there are 36"),
        (".pcd", pcd_header(10**12, "binary_compressed") + pcd_block(CLOUD.T), r"12000000000000 bytes; there are 36"),
        (
            ".pcd",
            pcd_header(10**8, "binary_compressed") + struct.pack("<II", 9, 12 * 10**8) + bytes(9),
            r"claims 9 bytes that grow to 1200000000 \(at most 88 times is possible\)",
        ),
        (".ply", ply_header("ascii", *xyz_lines(10**12)) + rows(CLOUD), r"1000000000000 of vertex"),
        (".ply", ply_header("binary_big_endian", *xyz_lines(10**12)) + CLOUD.tobytes(), r"1000000000000 of vertex"),
        (
            ".ply",
            ply_header("binary_little_endian", *xyz_lines(3), "element face 1000000000000", FACE_LINES[1])
            + CLOUD.tobytes(),
            r"1000000000000 of face, at least 1000000000036 bytes",
        ),
    ],
)
def test_false_header_sizes_allocate_no_memory(tmp_path, suffix, data, message):
    path = store(tmp_path, suffix, data)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=message):
            read_cloud(path)
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak_bytes < 2e6


def test_long_library_messages_are_cut(tmp_path):
    damaged = bytearray(npz_bytes(points=np.random.default_rng(0).random((200, 3))))
    damaged[26:28] = struct.pack("<H", 2000)  # the length of the member's name
    with pytest.raises(ValueError, match=r"not a readable \.npz archive \(File name in directory") as caught:
        read_cloud(store(tmp_path, ".npz", bytes(damaged)))
    assert len(str(caught.value)) < 1000


def test_missing_files_folders_and_unknown_suffixes_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"gone\.npy: no such file; a point cloud is needed$"):
        read_cloud(tmp_path / "gone.npy")
    (tmp_path / "folder.npy").mkdir()
    with pytest.raises(IsADirectoryError, match=r"folder\.npy: a folder; a point cloud is one file$"):
        read_cloud(tmp_path / "folder.npy")
    (tmp_path / "cloud.e57").write_bytes(b"ASTM-E57")
    with pytest.raises(ValueError, match=r"cloud\.e57: no reader for this suffix; allowed are \.npy, .*\.xyz"):
        read_cloud(str(tmp_path / "cloud.e57"))
