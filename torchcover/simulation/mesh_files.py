"""What trimesh reads, in a process of its own; see `apart`: nothing that loads torch may be imported here."""

import gc
import io
import math
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchcover.files import check_memory, check_regular, run_isolated
from torchcover.recordings.unsupported_formats import find_remedy

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

# Polygons whose corners are held at once.
POLYGONS_AT_ONCE = 1 << 16
# Areas below this share of the squared size of a polygon are rounding.
AREA_TOLERANCE = 1e-9


def triangulate(vertices: Float64, polygons: Sequence[Int64]) -> Int64:
    """Split polygons into triangles that cover exactly their area.

    Args:
        vertices: (V, 3) positions.
        polygons: The vertex indices of each, in order around it; those with fewer than three corners have no triangle.

    Returns:
        (T, 3) vertex indices; the triangles of each polygon are together, in the order of the polygons.

    Raises:
        ValueError: An index that no vertex has.

    Example:
        >>> square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        >>> triangulate(square, [np.arange(4)]).tolist()
        [[0, 1, 2], [0, 2, 3]]
    """
    sizes = np.array([len(polygon) for polygon in polygons], dtype=np.int64)
    starts = np.cumsum([0, *np.maximum(sizes - 2, 0)])
    triangles = np.empty((starts[-1], 3), dtype=np.int64)
    for size in np.unique(sizes[sizes > 2]).tolist():
        of_size = np.flatnonzero(sizes == size)
        for first in range(0, len(of_size), POLYGONS_AT_ONCE):
            numbers = of_size[first : first + POLYGONS_AT_ONCE]
            corners = np.stack([polygons[number] for number in numbers])
            if corners.min() < 0 or corners.max() >= len(vertices):
                raise ValueError(f"faces have vertices {corners.min()} to {corners.max()}; there are {len(vertices)}")
            local = _triangulate_alike(vertices[corners])
            rows = starts[numbers][:, None] + np.arange(size - 2)
            triangles[rows] = np.take_along_axis(corners[:, None], local, axis=2)
    return triangles


def find_bad_fans(corners: Float64) -> NDArray[np.bool_]:
    """(P,) whether the triangles between the first corner and the sides of (P, n, 3) polygons cover more than these."""
    return _turned(corners)[0]


def _turned(corners: Float64) -> tuple[NDArray[np.bool_], Float64, Float64]:
    """Which polygons have a triangle of their fan turned over, (P, 3) unit normals, (P,) areas that are rounding."""
    away = corners - corners[:, :1]
    areas = np.cross(away[:, 1:-1], away[:, 2:])
    normals = areas.sum(axis=1)  # Newell's: of all triangles of the fan, those that are turned over included
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    tolerance = AREA_TOLERANCE * np.linalg.norm(np.ptp(corners, axis=1), axis=1) ** 2
    return ((areas * normals[:, None]).sum(axis=2) < -tolerance[:, None]).any(axis=1), normals, tolerance


def _triangulate_alike(corners: Float64) -> Int64:
    """(P, n - 2, 3) corner numbers of the triangles of (P, n, 3) polygons: a fan where that is right, else ears."""
    polygons, size, _ = corners.shape
    fan = np.stack([np.zeros(size - 2, dtype=np.int64), np.arange(1, size - 1), np.arange(2, size)], axis=1)
    triangles = np.tile(fan, (polygons, 1, 1))
    is_turned, normals, tolerance = _turned(corners)
    for number in np.flatnonzero(is_turned).tolist():
        normal = normals[number]
        first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
        first /= np.linalg.norm(first)
        points = corners[number] @ np.stack([first, np.cross(normal, first)], axis=1)
        triangles[number] = _clip_ears(points - points[0], tolerance[number])
    return triangles


def _clip_ears(points: Float64, tolerance: float) -> list[tuple[int, int, int]]:
    """Corner numbers of the n - 2 triangles of an (n, 2) polygon that runs counterclockwise (Meisters 1975)."""
    triangles = []
    left = list(range(len(points)))
    position = 0
    while len(left) > 3:
        for step in range(len(left)):
            at = (position + step) % len(left)
            ear = left[at - 1], left[at], left[(at + 1) % len(left)]
            if _is_ear(points, ear, left, tolerance):
                break
        else:  # the polygon crosses itself: the flattest corner does the least harm
            areas = [abs(_turn(*points[[left[k - 1], left[k], left[(k + 1) % len(left)]]])) for k in range(len(left))]
            at = int(np.argmin(areas))
            ear = left[at - 1], left[at], left[(at + 1) % len(left)]
        triangles.append(ear)
        del left[at]
        position = at - 1
    a, b, c = left
    return [*triangles, (a, b, c)]


def _is_ear(points: Float64, ear: tuple[int, int, int], left: list[int], tolerance: float) -> bool:
    """Whether a corner can be cut off: it is convex, and no other corner lies in its triangle or on its edges."""
    a, b, c = points[list(ear)]
    if _turn(a, b, c) <= tolerance:
        return False
    others = points[left]
    others = others[~((others[:, None] == (a, b, c)).all(axis=2)).any(axis=1)]
    inside = [_turn(start, end, others) >= -tolerance for start, end in ((a, b), (b, c), (c, a))]
    return not np.all(inside, axis=0).any()


def _turn(a: Float64, b: Float64, c: Float64) -> Float64:
    """Twice the signed area of triangles a, b, c; positive if they turn left."""
    return np.asarray((b[0] - a[0]) * (c[..., 1] - a[1]) - (b[1] - a[1]) * (c[..., 0] - a[0]))


# Faces of an OBJ file with four corners or more, those with indices that count back from the last vertex, and what
# follows the index of the position in a corner.
OBJ_POLYGON = re.compile(rb"^[ \t]*f(?:(?:[ \t]+[^\s#]+){4}|[^\n#]*[\s/]-)", re.MULTILINE)
OBJ_BACKWARDS = re.compile(rb"^[ \t]*f[^\n#]*[\s/]-", re.MULTILINE)
OBJ_TEXTURE = re.compile(rb"/\S*")

# Compressed glTF whose uncompressed accessors are placeholders; trimesh would go on with these.
COMPRESSED_GLTF = re.compile(rb'"extensionsRequired"\s*:\s*\[[^\]]*"(KHR_draco_mesh|(?:EXT|KHR)_meshopt)_compression"')
# How to install modules that are called otherwise than their packages.
PACKAGES = {"collada": "'torchcover[urdf]'", "openctm": "python-openctm"}


@run_isolated
def read_mesh_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """All meshes of a file of any format of trimesh's.

    Returns:
        `vertices` (V, 3) float64 and `faces` (F, 3) int64; `part` (F,) int64, which part each face belongs to; of each
        of the P parts `names` (P, 2), those of its object and material, and `is_clear` (P,), whether the material is
        partly transparent.
    """
    try:
        parts = list(_read_parts(path))
    except MemoryError:
        raise
    except ModuleNotFoundError as error:
        module = str(error).split("'")[1].partition(".")[0]  # trimesh raises a copy of the error without its name
        package = PACKAGES.get(module, module)
        raise ImportError(f"{path}: {path.suffix} needs {module}: pip install {package}") from error
    except NotImplementedError as error:
        remedy = find_remedy(path) or "export it as GLB, OBJ, PLY or STL, as by Blender"
        raise ValueError(f"{path.suffix or 'a file without a suffix'} is no mesh that can be read; {remedy}") from error
    except Exception as error:  # trimesh raises whatever the reader of the format raises
        raise ValueError(f"trimesh cannot read it as a mesh ({error})") from error
    offsets = np.cumsum([0, *(len(vertices) for vertices, *_ in parts)])
    faces = [faces + offset for (_, faces, *_), offset in zip(parts, offsets, strict=False)]
    arrays = {
        "vertices": np.concatenate([np.empty((0, 3)), *(vertices for vertices, *_ in parts)]),
        "faces": np.concatenate([np.empty((0, 3), dtype=np.int64), *faces]),
        "part": np.repeat(np.arange(len(parts)), [len(of_part) for of_part in faces]),
        "names": np.array([names for _, _, names, _ in parts], dtype=str).reshape(-1, 2),
        "is_clear": np.array([is_clear for *_, is_clear in parts], dtype=bool),
    }
    del parts, faces
    gc.collect()  # it stands in a circle with what it was read from, four times as large as the mesh
    return arrays


def _read_parts(path: Path) -> Iterator[tuple[NDArray[np.float64], NDArray[np.int64], tuple[str, str], bool]]:
    """Vertices, triangles, names and transparency of each mesh of a file."""
    import trimesh

    kind = path.suffix.lstrip(".").lower()
    if kind == "dae":
        with suppress(ImportError):  # trimesh says that it is missing
            _triangulate_collada()
    # What trimesh asks for the encoding of text that is not UTF-8.
    latin_1 = ModuleType("charset_normalizer")
    vars(latin_1)["detect"] = lambda _: {"encoding": "latin-1", "confidence": 0.0}
    sys.modules["charset_normalizer"] = latin_1
    data = path.read_bytes()
    if kind == "obj":
        data = _obj_with_triangles(data)
    if (compressed := COMPRESSED_GLTF.search(data)) and kind in ("glb", "gltf"):
        if b"draco" not in compressed[1]:
            raise ValueError(f"it is compressed by {compressed[1].decode()}_compression; export it without")
        import_module("DracoPy")
    unit_m = _read_unit_m(data) if kind == "dae" else 1.0
    scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, process=False, resolver=_parts_of(path))
    for mesh in scene.dump():
        if not isinstance(mesh, trimesh.Trimesh):
            continue
        vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
        if kind == "ply":
            vertices, faces = _with_ply_polygons(mesh, vertices, faces)
        elif kind == "off":
            faces = triangulate(vertices, list(_off_polygons(data.decode("utf-8", "replace"))))
        material = getattr(mesh.visual, "material", None)
        names = str(mesh.metadata.get("name", "")), str(getattr(material, "name", None) or "")
        yield vertices * unit_m, faces, names, _is_clear(material)


def _read_unit_m(data: bytes) -> float:
    """Meters of a unit of a COLLADA file, which states it; trimesh ignores it."""
    stated = re.search(rb"<unit\b[^>]*\bmeter\s*=\s*[\"']([^\"']+)", data[:100_000])
    unit_m = float(stated[1]) if stated else 1.0
    if not 0.0 < unit_m < math.inf:
        raise ValueError(f"its unit of {unit_m:g} m is no positive number")
    return unit_m


def _is_clear(material: object) -> bool:
    """Whether a glTF material blends with what is behind it, or an MTL material is not opaque."""
    keys = getattr(material, "kwargs", None) or {}
    opacity = float(keys["d"][-1]) if "d" in keys else 1.0 - float(keys["tr"][0]) if "tr" in keys else 1.0
    return getattr(material, "alphaMode", None) == "BLEND" or opacity < 1.0


def _obj_with_triangles(data: bytes) -> bytes:
    """The text of an OBJ file whose polygons are triangles unless a fan covers them, and whose indices are positive."""
    data = data.replace(b"\r\n", b"\n").replace(b"\\\n", b"")
    if not OBJ_POLYGON.search(data):
        return data
    lines = [line.lstrip() for line in data.split(b"\n")]
    if OBJ_BACKWARDS.search(data):
        _count_from_first(lines)
    # Numbers go straight into arrays: lists of words would take several times the memory of the text.
    coordinates = (float(word) for line in lines if line.startswith(b"v ") for word in line.split()[1:4])
    positions = np.fromiter(coordinates, dtype=np.float64).reshape(-1, 3)
    faces = np.array([k for k, line in enumerate(lines) if line.startswith((b"f ", b"f\t"))])
    sizes = np.array([len(_corners_of(lines[k])) for k in faces])
    for size in np.unique(sizes[sizes > 3]).tolist():
        of_size = faces[sizes == size]
        words = b" ".join(b" ".join(_corners_of(lines[k])) for k in of_size)
        # The index of the position is what stands before the first slash.
        polygons = np.fromstring(OBJ_TEXTURE.sub(b"", words), dtype=np.int64, sep=" ").reshape(-1, size) - 1
        if polygons.min() < 0 or polygons.max() >= len(positions):
            raise ValueError(f"faces have vertices up to {polygons.max() + 1}; there are {len(positions)}")
        for k in np.flatnonzero(find_bad_fans(positions[polygons])).tolist():
            corners = _corners_of(lines[of_size[k]])
            triangles = triangulate(positions[polygons[k]], [np.arange(size)])
            of_face = (b"f " + b" ".join(corners[c] for c in triangle) for triangle in triangles.tolist())
            lines[of_size[k]] = b"\n".join(of_face)
    return b"\n".join(lines)


def _corners_of(line: bytes) -> list[bytes]:
    """The words `v/vt/vn` of a face."""
    return line.partition(b"#")[0].split()[1:]


def _count_from_first(lines: list[bytes]) -> None:
    """Let the indices of all faces count from the first vertex; negative ones count back from the last one so far."""
    counts = {b"v": 0, b"vt": 0, b"vn": 0}
    for number, line in enumerate(lines):
        key, *words = line.partition(b"#")[0].split() or [b""]
        if key in counts:
            counts[key] += 1
        elif key == b"f":
            lasts = tuple(counts.values())
            corners = [
                b"/".join(
                    b"%d" % (int(index) + last + 1) if index.startswith(b"-") else index
                    for index, last in zip(word.split(b"/"), lasts, strict=False)
                )
                for word in words
            ]
            lines[number] = b"f " + b" ".join(corners)


def _with_ply_polygons(
    mesh: Any,  # noqa: ANN401  (trimesh has no types)
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices and triangles of a PLY file from what it holds, if that is polygons, of which trimesh makes fans."""
    raw = mesh.metadata.get("_ply_raw", {})
    of_faces, of_vertices = (raw.get(key, {}).get("data") for key in ("face", "vertex"))
    names = of_faces.keys() if isinstance(of_faces, dict) else getattr(of_faces.dtype, "names", None) or ()
    name = next((name for name in ("vertex_index", "vertex_indices") if name in names), None)
    if name is None and not (isinstance(of_faces, np.ndarray) and of_faces.ndim == 2):
        return vertices, faces
    lists: Iterable[Any] = of_faces if name is None else of_faces[name]
    if getattr(getattr(lists, "dtype", None), "names", None):
        lists = of_faces[name]["f1"]
    if isinstance(lists, np.ndarray) and lists.shape[1:] == (3,):
        return vertices, faces
    polygons = [np.asarray(corners, dtype=np.int64).ravel() for corners in lists]
    if all(len(polygon) == 3 for polygon in polygons):
        return vertices, faces
    vertices = np.column_stack([of_vertices[axis] for axis in "xyz"]).astype(np.float64)
    return vertices, triangulate(vertices, polygons)


def _off_polygons(text: str) -> Iterator[NDArray[np.int64]]:
    """The vertex indices of each face of an OFF file, which trimesh has found to be one."""
    text = re.split("C?OFF", text, maxsplit=1)[1]
    rows = [words for line in text.splitlines() if (words := line.partition("#")[0].split())]
    vertices, faces = int(rows[0][0]), int(rows[0][1])
    for words in rows[vertices + 1 : vertices + faces + 1]:
        yield np.array(words[1 : int(words[0]) + 1], dtype=np.int64)


def _triangulate_collada() -> None:
    """Let pycollada triangulate polygons as here, in place of fans; this process reads meshes and nothing else."""
    from collada.polylist import Polylist
    from collada.triangleset import TriangleSet

    def triangleset(polylist: Any) -> Any:  # noqa: ANN401  (pycollada has no types)
        if polylist._triangleset is None:
            polygons = [np.arange(*ends) for ends in polylist.polyindex.tolist()]
            corners = triangulate(polylist.vertex[polylist.vertex_index].astype(np.float64), polygons)
            indices = polylist.index[corners].flatten()
            polylist._triangleset = TriangleSet(polylist.sources, polylist.material, indices, polylist.xmlnode)
        return polylist._triangleset

    Polylist.triangleset = triangleset


def _parts_of(path: Path) -> object:
    """Where a mesh finds what it refers to, such as its buffers: regular files below its folder, and not too large."""
    from trimesh.resolvers import FilePathResolver

    class Parts(FilePathResolver):  # type: ignore[misc]  # trimesh has no types
        def get(self, name: str) -> bytes:
            place = (path.parent / name.strip()).resolve()
            if not place.is_relative_to(path.parent.resolve()):
                raise ValueError(f"it refers to {name}, outside of its folder")
            check_regular(place, "a part of a mesh")
            check_memory(place.stat().st_size)
            return place.read_bytes()

    return Parts(path)
