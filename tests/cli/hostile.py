"""Hostile documents and options: each must end quickly with an exit code and one line."""

from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import NamedTuple

RIG = """name: r
sensors:
  - name: top
    mount: {x_m: 1.0, z_m: 2.0}
    channels: 4
    vertical_fov_deg: [-30, 10]
    horizontal_fov_deg: 360
    columns: 8
    max_range_m: 50
"""
CAMERA = """name: c
sensors:
  - type: camera
    name: front
    mount: {x_m: 1.0, z_m: 2.0}
    width: 32
    height: 24
    fx: 20
    fy: 20
    cx: 16
    cy: 12
    lens: kannala_brandt
    coefficients: [0.01, 0.0, 0.0, 0.0]
    max_range_m: 50
"""
YARD = """name: s
ego: {shape: {type: box, size_m: [4, 2, 1.5]}, pose: {x_m: 0, yaw_deg: 10}}
bodies:
  - {name: ground, shape: {type: plane, size_m: [400, 400]}, poses: [{x_m: 0}]}
  - {name: post, shape: {type: cylinder, radius_m: 0.2, height_m: 3, sides: 8}, poses: [{x_m: 9}]}
actors:
  - {name: a, category: car, shape: {type: box, size_m: [4, 2, 1]}, pose: {x_m: 20}}
time_step_s: 0.1
duration_s: 1.0
"""
TOWN = """name: t
traffic:
  type: urban
  duration_s: 3.0
  time_step_s: 0.5
  speed_mps: 10
  traffic_per_km: 5
  people_per_km: 5
"""
BASES = {"rig": RIG, "camera": CAMERA, "yard": YARD, "town": TOWN}

# Values instead of a number: other types, interpretations of YAML 1.1, and numbers out of range.
VALUES = (
    "true", "'60'", "0100", "1:40", "1_000", "~", "[]", "{}", "abc", ".nan", "-.inf", "1e400", "-1e300", "-1", "1e-320",
    "99999999999999999999", "1000000000", "9" * 5000, "[[[[1]]]]", "2020-01-01", "!!python/object:os.system x",
)  # fmt: skip

BILLION_LAUGHS = "x0: &x0 [1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"x{k}: &x{k} [{', '.join([f'*x{k - 1}'] * 9)}]\n" for k in range(1, 15)
)
# Few enough values to be read, but many more once aliases are expanded.
SMALLER_LAUGHS = "x0: &x0 [1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"x{k}: &x{k} [{', '.join([f'*x{k - 1}'] * 9)}]\n" for k in range(1, 4)
)


class Case(NamedTuple):
    """Call of the command line.

    Args:
        name: Name for reports.
        arguments: Arguments of the command; paths are relative to its folder.
        files: Name -> content of files that are written into the folder before.
        prepare: Further preparation of the folder.
    """

    name: str
    arguments: tuple[str, ...]
    files: dict[str, str] = {}  # noqa: RUF012  (a NamedTuple that is not changed)
    prepare: Callable[[Path], object] = lambda folder: None


def list_cases() -> Iterator[Case]:
    """List all cases, more than 400."""
    return chain(list_documents(), list_values(), list_options())


def list_documents() -> Iterator[Case]:
    """List documents that are invalid as a whole."""
    broken = {
        "empty": "", "list": "- 1\n- 2\n", "text": "abc", "tab": "\t", "open": "name: [1", "nul": "name: \x00",
        "two documents": "name: a\n---\nname: b\n", "tag": "!!python/object:os.system x", "merge of nothing": "<<: 3\n",
        "deep list": "name: " + "[" * 500 + "]" * 500, "deep mapping": "{a: " * 500 + "1" + "}" * 500,
        "endless depth": "[" * 5_000, "laughs": BILLION_LAUGHS, "an anchor in itself": "name: &a [*a]",
        "long": "name: " + "x" * 2_000_000, "keys that are lists": "? [1, 2]\n: 3\n",
        "numbers as keys": "1: 2\n3: 4\n",
    }  # fmt: skip
    for (title, content), base in ((item, base) for item in broken.items() for base in ("rig", "yard")):
        yield _case(f"{base}: {title}", {base: content})
    for base, content in BASES.items():
        yield _case(f"{base}: a key twice", {base: content + f"name: {base}\n"})
        yield _case(f"{base}: a wrong key", {base: content + "colour: red\n"})
        yield _case(f"{base}: hundreds of wrong keys", {base: content + "".join(f"key_{k}: {k}\n" for k in range(200))})
        yield _case(f"{base}: anchors of anchors", {base: content + SMALLER_LAUGHS})
    recursive = "name: v\nparts: [{name: p, shape: {type: vehicle, vehicle: v.yaml}}]\n"
    ego = YARD.replace("{type: box, size_m: [4, 2, 1.5]}", "{type: vehicle, vehicle: v.yaml}")
    yield _case("a vehicle that contains itself", {"yard": ego, "v": recursive})
    yield _case("a missing vehicle", {"yard": ego})
    yield _case("a missing model", {"rig": RIG.replace("columns: 8", "model: none.yaml")})
    yield _case(
        "a model with a key twice", {"rig": RIG.replace("columns: 8", "model: m.yaml"), "m": "name: m\nname: n\n"}
    )
    yield _case("below the ground", {"rig": RIG.replace("z_m: 2.0", "z_m: -1.73")})
    yield _case("in the ego vehicle", {"rig": RIG.replace("z_m: 2.0", "z_m: 0.7")})
    yield _case("in a post", {"rig": RIG.replace("x_m: 1.0, z", "x_m: 8.86, y_m: -1.56, z")})
    yield _case("an actor in the ego vehicle", {"yard": YARD.replace("pose: {x_m: 20}", "pose: {x_m: 1}")})
    trajectory = "\n".join(["t,x,y,z,roll,pitch,yaw", "0,20,0,0,0,0,0", "1,0,0,0,0,0,0"])
    colliding = YARD.replace("pose: {x_m: 20}", "trajectory: a.csv")
    write = lambda folder: (folder / "a.csv").write_text(trajectory)  # noqa: E731
    yield _case("an actor that enters the ego vehicle", {"yard": colliding}, prepare=write, steps=11)


def list_values() -> Iterator[Case]:
    """List documents in which one number is replaced by another type or by a number out of range."""
    numbers = {
        "rig": ("x_m: 1.0", "channels: 4", "columns: 8", "horizontal_fov_deg: 360", "max_range_m: 50"),
        "camera": ("width: 32", "fx: 20", "cx: 16", "max_range_m: 50"),
        "yard": ("radius_m: 0.2", "sides: 8", "time_step_s: 0.1", "duration_s: 1.0", "x_m: 20"),
        "town": ("duration_s: 3.0", "time_step_s: 0.5", "traffic_per_km: 5", "people_per_km: 5"),
    }
    for base, keys in numbers.items():
        for key in keys:
            for value in VALUES:
                name = key.split(":")[0]
                yield _case(f"{base}: {name}: {value[:30]}", {base: BASES[base].replace(key, f"{name}: {value}", 1)})


def list_options() -> Iterator[Case]:
    """List options with invalid or excessive values."""
    invalid = {
        "--set": (
            *(f"cell_m={value}" for value in ("20", "1e-310", "0.001", "nan", "inf", "-1", "1e300", "x")),
            *(f"frame_interval_s={value}" for value in ("1e308", "nan", "inf", "0", "1e-300", "-1")),
            *("average=[/x]", "cells_m=1", "cell_m", "=", "recording.units=km", "recording=1", "seed=true"),
        ),
        "--thresholds-m": ("inf", "nan", "-1", "1e9", "x"),
        "--num-rays": ("99999999999", "9" * 30, "0", "-1", "1e9"),
        "--num-frames": ("9" * 20, "0", "1.5"),
        "--seed": ("-1", "x"),
        "--device": ("meta", "abacus", "cuda:99", ""),
        "--num-workers": ("-1", "1000000", "9" * 20),
        "--target-error": ("0%", "nan%", "infm", "1e400%", "5", ""),
        "--reference": ("", "[/x]"),
        "--scenario": ("", "[/x]", ".", "/", "none.yaml", "x" * 5000),
        "--out": ("link", "file", "file/below"),
    }

    def prepare(folder: Path) -> None:
        (folder / "link").symlink_to(folder / "nothing")
        (folder / "file").write_text("")

    for option, option_values in invalid.items():
        for value in option_values:
            yield Case(f"{option} {value[:30]}", _evaluate("rig.yaml", option, value), _files({}), prepare)
    for rig in ("", "[/x]", ".", "/", "none.yaml", "../rig", "x" * 5000, "\udcff"):
        yield Case(f"evaluate {rig[:30]!r}", _evaluate(rig), _files({}))


def _case(
    name: str, changed: dict[str, str], prepare: Callable[[Path], object] = lambda folder: None, steps: int = 1
) -> Case:
    rig = "camera.yaml" if "camera" in changed else "rig.yaml"
    scenario = ("--scenario", "town.yaml") if "town" in changed else ()
    return Case(name, _evaluate(rig, *scenario, "--num-frames", str(steps)), _files(changed), prepare)


def _files(changed: dict[str, str]) -> dict[str, str]:
    return {f"{name}.yaml": content for name, content in {**BASES, **changed}.items()}


def _evaluate(rig: str, *options: str) -> tuple[str, ...]:
    quick = ("--scenario", "yard.yaml", "--num-frames", "1", "--set", "cell_m=4", "--num-rays", "64", "--out", "out")
    return ("evaluate", rig, *quick, *options)


PLAIN = Case("valid", _evaluate("rig.yaml"), _files({}))
