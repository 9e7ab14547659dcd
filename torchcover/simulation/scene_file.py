"""Scenes as arrays and JSON, which no code is run to read."""

import json
from collections.abc import Mapping
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchcover.files import check_kind, read_npz, reads
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.world import Actor, World

KINDS: dict[str, Any] = {kind.__name__: kind for kind in (World, Actor, Trajectory, Mesh)}
ALIGNMENT_BYTES = 8  # of each array in the file


def encode_scene(key: str, scene: World, bodies: Mapping[str, Mesh]) -> dict[str, NDArray[np.uint8]]:
    """Return a scene as bytes: `text`, JSON of its parts, the last of which is the scene, and `numbers`, all arrays.

    What is there several times is written once; of `bodies`, which scenes share, the names only.
    """
    shapes, parts, numbers = list[Any](), list[Any](), list[bytes]()
    known: dict[object, dict[str, Any]] = {id(mesh): {"body": name} for name, mesh in bodies.items()}

    def encode(value: Any) -> Any:  # noqa: ANN401
        if isinstance(value, tuple) and not isinstance(value, Mesh):
            return [encode(item) for item in value]
        if isinstance(value, np.ndarray):
            key: object = (value.__array_interface__["data"], value.shape, value.strides, value.dtype.str)
            if key not in known:
                known[key] = {"array": len(shapes)}
                shapes.append([value.dtype.str, value.shape])
                numbers.append(value.tobytes() + bytes(-value.nbytes % ALIGNMENT_BYTES))
            return known[key]
        if type(value).__name__ not in KINDS:
            return value
        if id(value) not in known:
            items = value if isinstance(value, Mesh) else [getattr(value, field.name) for field in fields(value)]
            parts.append([type(value).__name__, *[encode(item) for item in items]])
            known[id(value)] = {"part": len(parts) - 1}
        return known[id(value)]

    encode(scene)
    text = json.dumps([key, shapes, parts], default=np.generic.item).encode()
    return {"text": np.frombuffer(text, np.uint8), "numbers": np.frombuffer(b"".join(numbers), np.uint8)}


@reads("a scene")
def read_scene(path: Path, bodies: Mapping[str, Mesh]) -> World:
    """Read a scene, whose key is the stem of the path; its arrays are read-only."""
    content = read_npz(path, partial(check_kind, "u"))
    content["numbers"].flags.writeable = False
    key, shapes, parts = json.loads(content["text"].tobytes())
    if key != path.stem:
        raise ValueError("it holds another scene")
    known: dict[str, Any] = {"array": [], "part": [], "body": bodies}
    begin = 0
    for dtype, shape in shapes:
        end = begin + np.dtype(dtype).itemsize * int(np.prod(shape, dtype=np.int64))
        known["array"].append(content["numbers"][begin:end].view(dtype).reshape(shape))
        begin = end + -end % ALIGNMENT_BYTES

    def decode(value: Any) -> Any:  # noqa: ANN401
        if isinstance(value, dict):
            ((kind, index),) = value.items()
            return known[kind][index]
        return tuple(decode(item) for item in value) if isinstance(value, list) else value

    for name, *items in parts:
        known["part"].append(KINDS[name](*[decode(item) for item in items]))
    scene: World = known["part"][-1]
    return scene
