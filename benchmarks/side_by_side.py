"""Compare the numbers of two checkouts: `python -m benchmarks.side_by_side OLD [NEW]`.

Runs short commands of each checkout and compares every number of `summary.json`, every array of the `.npz` files, the
bytes of recordings and scenarios that are written, and every tensor of the first frames of each kind of source.
Numbers have to be equal to the last bit; `--tolerance KEY=RELATIVE` allows a relative difference for keys that contain
KEY. `--renamed OLD=NEW` names the new name of a key or an array; a `*` in NEW stands for all arrays that match,
stacked. `--called 'NEW=>OLD'` replaces a text in the commands of OLD. `--expected TEXT` names an intended difference:
complaints that contain the text are counted and listed apart. Times, versions and hashes of files are not compared.
"""

import argparse
import hashlib
import json
import math
import os
import subprocess
import sys
import tempfile
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
# `CHECKOUT` is the folder of the checkout that runs, `RECORDING` is made here, `DRIVE` by each checkout.
RUNS = {
    "courtyard": "evaluate front_roof_128 --scenario courtyard --num-frames 9",
    "paper_pattern": "evaluate front_grille_128 --num-frames 2 --reference paper --num-rays 65536",
    "urban": "evaluate front_roof_32 --scenario urban --num-frames 10 --thresholds-m 1",
    "workers": "evaluate nuscenes_cameras --scenario highway --num-frames 2 --num-workers 2",
    "recording": "evaluate --frames RECORDING",
    "comparison": "compare front_roof_32 front_grille_128 --scenario urban --num-frames 9",
    "thresholds": "compare kitti hu2022_line --num-frames 8 --thresholds-m 0.4 --thresholds-m 0.1",
    "redundancy": "evaluate edgar --scenario parking --num-frames 8 --redundancy --set aggregations=maximum",
    "weather": "evaluate front_roof_32 --scenario urban --num-frames 8 --weather fog_50m",
    "mixture": "evaluate front_roof_32 --scenario courtyard,highway --num-frames 4",
    "radars": "evaluate nuscenes_radars --scenario highway --num-frames 2",
    "sumo": "evaluate front_roof_32 --scenario sumo_random --num-frames 2",
    "tracks_table": "evaluate front_roof_32 --scenario tracks_table --num-frames 2",
    "tracks_commonroad": "evaluate front_roof_32 --scenario tracks_commonroad --num-frames 2",
    "tracks_nuscenes": "evaluate front_roof_32 --scenario tracks_nuscenes --num-frames 2",
    "tracks_argoverse2": "evaluate front_roof_32 --scenario tracks_argoverse2 --num-frames 2",
    "accumulated": "evaluate --frames DRIVE --reference accumulated --set recording.window_s=1",
    "targets": "targets edgar --target child --raster -6,6,-6,6,0.5",
    "targets_in_traffic": "targets front_roof_32 --target pole --scenario urban --num-frames 2 --raster -6,6,-6,6,1",
    "encounter_set": "encounter front_roof_128 front_corners_16 --num-start-offsets 2",
    "encounter_traffic": "encounter front_roof_32 --scenario urban --num-scenes 1",
    "check": "check front_roof_128 --requirements reversing_r158_detection --num-frames 2",
    "search": "search CHECKOUT/examples/placement/roof.yaml --num-evaluations 3 --num-scenes 2 --num-held-out-scenes 2",
    "selection": "search CHECKOUT/examples/placement/robot_corners.yaml --num-rays 2048 --frames-per-scene 1",
    "record": "record kitti --scenario urban --num-frames 2",
    "record_kitti": "record kitti --scenario urban --num-frames 2 --format kitti",
    "world": "world DRIVE",
    "rig": "rig --frames DRIVE",
}
SOURCES = {
    "simulated_frames": "data.SimulatedFrames('urban', rigs={'kitti': 'kitti'}, steps=4)",
    "frames_of_rigs": "data.SimulatedFrames('courtyard', rigs={'a': 'kitti', 'b': 'waymo'}, steps=4, vehicle='suv')",
    "recorded_frames": "data.RecordedFrames('RECORDING')",
    "accumulated_frames": "data.RecordedFrames('DRIVE', reference=data.AccumulatedReference(1.0))",
}
# Exit codes of runs that end with an answer: requirements that are not met or not checked have codes of their own.
ANSWERS = (0, 1, 3)
NOT_COMPARED = ("seconds", "torchcover", "left_out", "complete", "frames", "files", "options", "journal")
PROGRAM = "from torchcover.cli.app import main; main()"
FRAMES_PROGRAM = """
import dataclasses, hashlib, json, sys
import numpy as np, torch
from torchcover import data

def visit(value, name):
    if isinstance(value, torch.Tensor):
        array = np.ascontiguousarray(value.numpy())
        yield name, f"{array.dtype} {array.shape} " + hashlib.sha256(array.tobytes()).hexdigest()
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from visit(getattr(value, field.name), f"{name}/{field.name}")
    elif isinstance(value, dict):
        for key in value:
            yield from visit(value[key], f"{name}/{key}")
    elif isinstance(value, (list, tuple)):
        for position, item in enumerate(value):
            yield from visit(item, f"{name}/{position}")
    else:
        yield name, repr(value)

frames = SOURCE
print(json.dumps(dict(pair for index in range(4) for pair in visit(frames[index], f"frame {index}"))))
"""


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path, nargs="?", default=ROOT)
    parser.add_argument("--renamed", action="append", default=[], metavar="OLD=NEW")
    parser.add_argument("--called", action="append", default=[], metavar="NEW=>OLD")
    parser.add_argument("--tolerance", action="append", default=[], metavar="KEY=RELATIVE")
    parser.add_argument("--expected", action="append", default=[], metavar="TEXT")
    parser.add_argument("--runs", nargs="+", choices=[*RUNS, *SOURCES], default=[*RUNS, *SOURCES])
    options = parser.parse_args()
    renamed = dict(pair.split("=") for pair in options.renamed)
    called = dict(pair.split("=>") for pair in options.called)
    tolerances = {key: float(value) for key, value in (pair.split("=") for pair in options.tolerance)}
    unexpected = 0
    with tempfile.TemporaryDirectory() as folder:
        write_recording(Path(folder, "recording"))
        checkouts = {"old": options.old.resolve(), "new": options.new.resolve()}
        for side, checkout in checkouts.items():  # each in its own format
            drive = "record kitti --scenario urban --num-frames 40 --frame-interval-s 0.1"
            run(checkout, [*drive.split(), "--out", f"{folder}/{side}/drive"], folder)
        for name in options.runs:
            results = []
            for side, checkout in checkouts.items():
                places = {"RECORDING": f"{folder}/recording", "DRIVE": f"{folder}/{side}/drive"}
                places["CHECKOUT"] = str(checkout)
                if name in SOURCES:
                    results.append(hash_frames(checkout, substitute(SOURCES[name], places), folder))
                else:
                    text = substitute(RUNS[name], called) if side == "old" else RUNS[name]
                    words = substitute(text, places).split()
                    results.append(run_and_read(name, checkout, words, Path(folder, side, name), folder))
            complaints = list(compare(*results, renamed, tolerances))
            intended = [complaint for complaint in complaints if any(text in complaint for text in options.expected)]
            others = [complaint for complaint in complaints if complaint not in intended]
            unexpected += len(others)
            print(
                f"{name}: {count(results[0]):,} numbers, {len(others)} differ, {len(intended)} as intended", flush=True
            )
            for complaint in [*others[:20], *intended[:5]]:
                print(f"  {complaint}", flush=True)
    sys.exit(unexpected > 0)


def substitute(text, places):
    for key, place in places.items():
        text = text.replace(key, place)
    return text


def run_python(checkout, program, arguments, folder):
    """Run a program with the package of one checkout."""
    environment = {
        **os.environ,
        "PYTHONPATH": str(checkout),
        "OMP_WAIT_POLICY": "passive",
        "TORCHCOVER_CACHE_GB": "0",
    }
    command = [sys.executable, "-c", program, *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def run(checkout, arguments, folder):
    """Run one command of one checkout and return what it prints."""
    done = run_python(checkout, PROGRAM, arguments, folder)
    if done.returncode not in ANSWERS or "Traceback" in done.stderr:
        sys.exit(f"{checkout}: {' '.join(arguments)} ended with {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


def run_and_read(name, checkout, words, out, folder):
    """Run one command; the values of everything that it writes, or prints if it writes nothing, by key."""
    if name == "rig":
        return {"printed": run(checkout, words, folder).replace(str(out.parent), "")}
    run(checkout, [*words, "--out", str(out)], folder)
    if name.startswith(("record_", "world")) or name == "record":
        paths = sorted(path for path in out.rglob("*") if path.is_file())
        contents = {str(path.relative_to(out)): path.read_bytes() for path in paths}
        side = str(out.parent).encode()
        return {name: hashlib.sha256(content.replace(side, b"")).hexdigest() for name, content in contents.items()}
    values = {key: value for key, value in flatten(read_summary(out)) if is_number_of_rig(key)}
    for path in sorted(out.rglob("*.npz")):
        with np.load(path) as arrays:
            for array in set(arrays.files) - {"header"}:
                values[f"{path.relative_to(out)}/{array}"] = arrays[array]
    return values


def is_number_of_rig(key):
    """Whether a path is about what was measured, not about the run."""
    parts = key.split("/")
    return parts[0] not in NOT_COMPARED and parts[-1] != "seconds"


def hash_frames(checkout, source, folder):
    """A hash of each tensor of the first four frames of a source."""
    done = run_python(checkout, FRAMES_PROGRAM.replace("SOURCE", source), [], folder)
    if done.returncode:
        sys.exit(f"{checkout}: {source} ended with {done.returncode}\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


def write_recording(folder):
    """Write a recording of twelve frames; some have no sensor point or points that are not finite."""
    generator = np.random.default_rng(5)
    for source, points_per_frame in (("sensor", 4000), ("reference", 6000)):
        (folder / source).mkdir(parents=True)
        for frame in range(12):
            points = generator.uniform((-40, -40, -0.6), (165, 40, 2.1), size=(points_per_frame + 10 * frame, 3))
            points[::1000] = np.nan
            written = points[:0] if source == "sensor" and frame == 4 else points
            np.save(folder / source / f"frame{frame}.npy", written.astype(np.float32))


def read_summary(out):
    """Content of summary.json with its rows by what they are about; without the rig's name if there is one rig."""
    content = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    rows = content.pop("rows", None)
    if not isinstance(rows, list) or not all("region" in row for row in rows):
        return {**content, "rows": {str(position): row for position, row in enumerate(rows or [])}}
    several = len({row.get("rig") for row in rows}) > 1
    named = {f"{row['rig'] if several else ''} {row['region']} {row['height']}": row for row in rows}
    for row in rows:
        row.pop("rig", None)
    return {**content, "rows": named}


def flatten(content, prefix=""):
    """Yield (path, value) of everything that is neither a mapping nor a list."""
    items = content.items() if isinstance(content, dict) else enumerate(content)
    for key, value in items:
        if isinstance(value, dict | list):
            yield from flatten(value, f"{prefix}{key}/")
        else:
            yield f"{prefix}{key}", value


def count(values):
    return sum(value.size if isinstance(value, np.ndarray) else 1 for value in values.values())


def compare(old, new, renamed, tolerances):
    """Yield a sentence for each value of `old` that `new` lacks or has otherwise."""
    for key, value in old.items():
        name = "/".join(renamed.get(part, part) for part in key.split("/"))
        other = find_value(name, new)
        allowed = max((relative for text, relative in tolerances.items() if text in key), default=0.0)
        if other is None and value is not None:
            yield f"{key}: missing"
        elif not are_equal(value, other, allowed):
            yield f"{key}: {describe_difference(value, other)}"


def find_value(name, values):
    """The value of a name; for a name with `*`, all values that match, stacked in their order."""
    if "*" not in name:
        return values.get(name)
    matching = [values[other] for other in values if fnmatchcase(other, name)]
    return np.stack(matching) if matching else None


def are_equal(value, other, relative):
    if isinstance(value, np.ndarray):
        if not isinstance(other, np.ndarray) or value.shape != other.shape:
            return False
        numeric = value.dtype.kind in "fc"
        if relative and numeric:
            return np.allclose(value, other, rtol=relative, atol=0, equal_nan=True)
        return np.array_equal(value, other, equal_nan=numeric)
    if relative and isinstance(value, float) and isinstance(other, float):
        return math.isclose(value, other, rel_tol=relative)
    return value == other or (value != value and other != other)


def describe_difference(value, other):
    if not isinstance(value, np.ndarray):
        return f"{value} and {other}"
    if not isinstance(other, np.ndarray) or value.shape != other.shape:
        return f"array of {value.shape} and {getattr(other, 'shape', other)}"
    unequal = (value != other) & ~((value != value) & (other != other))
    return f"{np.count_nonzero(unequal):,} of {value.size:,} elements differ"


if __name__ == "__main__":
    main()
