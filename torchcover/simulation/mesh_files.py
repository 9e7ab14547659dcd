"""What trimesh reads, in a process of its own; see `apart`: nothing that loads torch may be imported here."""

import gc
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchcover.files import apart, check_memory, check_regular


@apart
def mesh_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """(V, 3) float64 `vertices` and (F, 3) int64 `faces` of all that a file of any format of trimesh's has."""
    import trimesh

    try:
        with path.open("rb") as file:
            kind = path.suffix.lstrip(".")
            loaded = trimesh.load_mesh(file, file_type=kind, process=False, resolver=_parts_of(path))
    except MemoryError:
        raise
    except Exception as error:  # trimesh raises whatever the reader of the format raises
        raise ValueError(f"trimesh cannot read it as a mesh ({error})") from error
    arrays = {
        "vertices": np.asarray(getattr(loaded, "vertices", ()), dtype=np.float64),
        "faces": np.asarray(getattr(loaded, "faces", ()), dtype=np.int64),
    }
    del loaded
    gc.collect()  # it stands in a circle with what it was read from, four times as large as the mesh
    return arrays


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
