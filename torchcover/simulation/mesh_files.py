"""Reading of mesh files by trimesh in an isolated process.

Nothing that loads torch may be imported here, since the isolated process imports this module.
"""

import gc
import io
import math
import re
import sys
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.files import check_memory, check_regular, run_isolated
from torchcover.recordings.unsupported_formats import find_remedy
from torchcover.simulation.triangulation import find_bad_fans, triangulate


class _MeshPart(NamedTuple):
    """Mesh of a file: vertices in meters, (F, 3) faces, names of object and material, and transparency."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    names: tuple[str, str]
    is_transparent: bool


@run_isolated
def read_mesh_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Read all meshes of a file in any format of trimesh.

    Args:
        path: Mesh file.

    Returns:
        `vertices` (V, 3) float64 and `faces` (F, 3) int64; `part` (F,) int64, the part of each face; for each of the P
        parts `names` (P, 2), object and material, and `is_clear` (P,), True for a partly transparent material.

    Raises:
        ValueError: The format is not supported, or the file is damaged.
        ImportError: The format needs a package that is not installed.
    """
    try:
        parts = list(_read_parts(path))
    except MemoryError:
        raise
    except ModuleNotFoundError as error:
        module = str(error).split("'")[1].partition(".")[0]  # trimesh raises a copy of the error without its name
        packages = {"collada": "'torchcover[urdf]'", "openctm": "python-openctm"}  # names other than the module's
        package = packages.get(module, module)
        raise ImportError(f"{path}: {path.suffix} needs {module}: pip install {package}") from error
    except NotImplementedError as error:
        remedy = find_remedy(path) or "export it as GLB, OBJ, PLY or STL, as by Blender"
        raise ValueError(f"{path.suffix or 'a file without a suffix'} is no mesh that can be read; {remedy}") from error
    except Exception as error:  # trimesh raises whatever the reader of the format raises
        raise ValueError(f"trimesh cannot read it as a mesh ({error})") from error
    first_vertices = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + first for part, first in zip(parts, first_vertices, strict=False)]
    arrays = {
        "vertices": np.concatenate([np.empty((0, 3)), *(part.vertices for part in parts)]),
        "faces": np.concatenate([np.empty((0, 3), dtype=np.int64), *faces]),
        "part": np.repeat(np.arange(len(parts)), [len(part_faces) for part_faces in faces]),
        "names": np.array([part.names for part in parts], dtype=str).reshape(-1, 2),
        "is_clear": np.array([part.is_transparent for part in parts], dtype=bool),
    }
    del parts, faces
    gc.collect()  # a reference cycle holds the source data, four times as large as the mesh
    return arrays


def _read_parts(path: Path) -> Iterator[_MeshPart]:
    """Read the meshes of a file one by one."""
    import trimesh

    file_type = path.suffix.lstrip(".").lower()
    if file_type == "dae":
        with suppress(ImportError):  # trimesh reports that it is missing
            _use_exact_triangulation_in_collada()
    # trimesh asks this module for the encoding of text that is not UTF-8.
    encoding_detector = ModuleType("charset_normalizer")
    vars(encoding_detector)["detect"] = _detect_latin_1
    sys.modules["charset_normalizer"] = encoding_detector
    data = path.read_bytes()
    if file_type == "obj":
        data = _triangulate_obj(data)
    if file_type in ("glb", "gltf"):
        _check_gltf_compression(data)
    unit_m = _read_unit_m(data) if file_type == "dae" else 1.0
    scene = trimesh.load_scene(io.BytesIO(data), file_type=file_type, process=False, resolver=_create_resolver(path))
    for mesh in scene.dump():
        if not isinstance(mesh, trimesh.Trimesh):
            continue
        vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
        if file_type == "ply":
            vertices, faces = _triangulate_ply(mesh, vertices, faces)
        elif file_type == "off":
            faces = triangulate(vertices, list(_read_off_polygons(data.decode("utf-8", "replace"))))
        material = getattr(mesh.visual, "material", None)
        names = str(mesh.metadata.get("name", "")), str(getattr(material, "name", None) or "")
        yield _MeshPart(vertices * unit_m, faces, names, _is_transparent(material))


def _detect_latin_1(data: bytes) -> dict[str, Any]:
    """Report Latin-1, which decodes any bytes, in place of `charset_normalizer.detect`."""
    return {"encoding": "latin-1", "confidence": 0.0}


def _check_gltf_compression(data: bytes) -> None:
    """Refuse compressed glTF that cannot be decompressed: trimesh would read its placeholder arrays."""
    pattern = rb'"extensionsRequired"\s*:\s*\[[^\]]*"(KHR_draco_mesh|(?:EXT|KHR)_meshopt)_compression"'
    compression = re.search(pattern, data)
    if compression is None:
        return
    if b"draco" not in compression[1]:
        raise ValueError(f"it is compressed by {compression[1].decode()}_compression; export it without")
    import_module("DracoPy")


def _read_unit_m(data: bytes) -> float:
    """Read the unit of a COLLADA file in meters; trimesh ignores it."""
    unit = re.search(rb"<unit\b[^>]*\bmeter\s*=\s*[\"']([^\"']+)", data[:100_000])
    unit_m = float(unit[1]) if unit else 1.0
    if not 0.0 < unit_m < math.inf:
        raise ValueError(f"its unit of {unit_m:g} m is no positive number")
    return unit_m


def _is_transparent(material: object) -> bool:
    """Return True if a glTF material blends with its background, or an MTL material is not opaque."""
    mtl_keys = getattr(material, "kwargs", None) or {}
    opacity = 1.0
    if "d" in mtl_keys:
        opacity = float(mtl_keys["d"][-1])
    elif "tr" in mtl_keys:
        opacity = 1.0 - float(mtl_keys["tr"][0])
    return getattr(material, "alphaMode", None) == "BLEND" or opacity < 1.0


def _triangulate_obj(data: bytes) -> bytes:
    """Replace polygons of an OBJ file that a fan does not cover by triangles, and make vertex indices positive."""
    data = data.replace(b"\r\n", b"\n").replace(b"\\\n", b"")
    has_negative_indices = re.search(rb"^[ \t]*f[^\n#]*[\s/]-", data, re.MULTILINE)
    has_polygons = re.search(rb"^[ \t]*f(?:[ \t]+[^\s#]+){4}", data, re.MULTILINE)
    if not has_negative_indices and not has_polygons:
        return data
    lines = [line.lstrip() for line in data.split(b"\n")]
    if has_negative_indices:
        _make_obj_indices_positive(lines)
    # Numbers go straight into arrays: lists of words would take several times the memory of the text.
    coordinates = (float(word) for line in lines if line.startswith(b"v ") for word in line.split()[1:4])
    positions = np.fromiter(coordinates, dtype=np.float64).reshape(-1, 3)
    face_lines = np.array([number for number, line in enumerate(lines) if line.startswith((b"f ", b"f\t"))])
    sizes = np.array([len(_split_corners(lines[number])) for number in face_lines])
    for size in np.unique(sizes[sizes > 3]).tolist():
        polygon_lines = face_lines[sizes == size]
        words = b" ".join(b" ".join(_split_corners(lines[number])) for number in polygon_lines)
        # The index of the position stands before the first slash.
        position_indices = re.sub(rb"/\S*", b"", words)
        polygons = np.fromstring(position_indices, dtype=np.int64, sep=" ").reshape(-1, size) - 1
        if polygons.min() < 0 or polygons.max() >= len(positions):
            raise ValueError(f"faces have vertices up to {polygons.max() + 1}; there are {len(positions)}")
        for polygon in np.flatnonzero(find_bad_fans(positions[polygons])).tolist():
            corners = _split_corners(lines[polygon_lines[polygon]])
            triangles = triangulate(positions[polygons[polygon]], [np.arange(size)])
            triangle_lines = [b"f %s %s %s" % (corners[a], corners[b], corners[c]) for a, b, c in triangles.tolist()]
            lines[polygon_lines[polygon]] = b"\n".join(triangle_lines)
    return b"\n".join(lines)


def _split_corners(line: bytes) -> list[bytes]:
    """Split the line of an OBJ face into its words `v/vt/vn`."""
    return line.partition(b"#")[0].split()[1:]


def _make_obj_indices_positive(lines: list[bytes]) -> None:
    """Replace negative indices of OBJ faces, which count back from the previous vertex, in place."""
    counts = {b"v": 0, b"vt": 0, b"vn": 0}
    for number, line in enumerate(lines):
        key, *words = line.partition(b"#")[0].split() or [b""]
        if key in counts:
            counts[key] += 1
        elif key == b"f":
            corners = []
            for word in words:
                indices = word.split(b"/")
                for position, (index, count) in enumerate(zip(indices, counts.values(), strict=False)):
                    if index.startswith(b"-"):
                        indices[position] = b"%d" % (int(index) + count + 1)
                corners.append(b"/".join(indices[: len(counts)]))
            lines[number] = b"f " + b" ".join(corners)


def _triangulate_ply(
    mesh: Any,  # noqa: ANN401  (trimesh has no types)
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Triangulate the polygons of a PLY file from its raw content, since trimesh makes fans of them.

    Returns:
        Vertices and triangles; the arguments themselves if the file has triangles only.
    """
    raw = mesh.metadata.get("_ply_raw", {})
    raw_faces, raw_vertices = (raw.get(key, {}).get("data") for key in ("face", "vertex"))
    names = raw_faces.keys() if isinstance(raw_faces, dict) else getattr(raw_faces.dtype, "names", None) or ()
    if name := next((name for name in ("vertex_index", "vertex_indices") if name in names), None):
        polygon_lists = raw_faces[name]
    elif isinstance(raw_faces, np.ndarray) and raw_faces.ndim == 2:
        polygon_lists = raw_faces
    else:
        return vertices, faces
    if getattr(getattr(polygon_lists, "dtype", None), "names", None):
        polygon_lists = polygon_lists["f1"]
    if isinstance(polygon_lists, np.ndarray) and polygon_lists.shape[1:] == (3,):
        return vertices, faces
    polygons = [np.asarray(corners, dtype=np.int64).ravel() for corners in polygon_lists]
    if all(len(polygon) == 3 for polygon in polygons):
        return vertices, faces
    vertices = np.column_stack([raw_vertices[axis] for axis in "xyz"]).astype(np.float64)
    return vertices, triangulate(vertices, polygons)


def _read_off_polygons(text: str) -> Iterator[NDArray[np.int64]]:
    """Read the vertex indices of each face of an OFF file that trimesh has accepted."""
    text = re.split("C?OFF", text, maxsplit=1)[1]
    rows = [line.partition("#")[0].split() for line in text.splitlines()]
    rows = [words for words in rows if words]
    num_vertices, num_faces = int(rows[0][0]), int(rows[0][1])
    for words in rows[num_vertices + 1 : num_vertices + num_faces + 1]:
        yield np.array(words[1 : int(words[0]) + 1], dtype=np.int64)


def _use_exact_triangulation_in_collada() -> None:
    """Replace the fans of pycollada by `triangulate`; this process reads meshes and nothing else."""
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


def _create_resolver(path: Path) -> object:
    """Create a trimesh resolver that reads only regular files of limited size below the folder of the mesh."""
    from trimesh.resolvers import FilePathResolver

    class FolderResolver(FilePathResolver):  # type: ignore[misc]  # trimesh has no types
        def get(self, name: str) -> bytes:
            part_path = (path.parent / name.strip()).resolve()
            if not part_path.is_relative_to(path.parent.resolve()):
                raise ValueError(f"it refers to {name}, outside of its folder")
            check_regular(part_path, "a part of a mesh")
            check_memory(part_path.stat().st_size)
            return part_path.read_bytes()

    return FolderResolver(path)
