"""Compare the numbers of two checkouts: `python -m benchmarks.side_by_side OLD [NEW] [@FILE]`.

Runs short commands of each checkout and compares every value of `summary.json`, every array of the `.npz` files, the
bytes of written recordings and scenarios, and every tensor of the first frames of each kind of source. Numbers must be
equal to the last bit. Durations, versions and hashes of files are not compared.

Renames between the checkouts are given by options, one per line in FILE: `--called=NEW=>OLD` replaces a text in the
commands of OLD, `--renamed=OLD=NEW` renames parts of keys and texts, or the end of a key if OLD has a `/`. `*` in OLD
stands for any text and, in ends of keys, `#` for an index; `*` in NEW alone stacks all arrays that match.
"""

import argparse
import hashlib
import json
import math
import os
import re
import subprocess
import sys
import tempfile
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
# CHECKOUT is the folder of the checkout that runs; RECORDING is written here, DRIVE by each checkout.
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
    "simulated_frames": "data.SimulatedFrames('urban', rigs={'kitti': 'kitti'}, num_frames=4)",
    "rigs": "data.SimulatedFrames('courtyard', rigs={'a': 'kitti', 'b': 'waymo'}, num_frames=4, vehicle='suv')",
    "recorded_frames": "data.RecordedFrames('RECORDING')",
    "accumulated_frames": "data.RecordedFrames('DRIVE', reference=data.AccumulatedReference(1.0))",
}
# Exit codes of runs that end with a result: requirements that are not met or not decided have codes of their own.
RESULT_CODES = (0, 1, 3)
# Keys of summary.json that depend on time, versions or paths.
IGNORED_KEYS = (
    "duration_s",
    "torchcover",
    "omissions",
    "complete",
    "frames",
    "files",
    "options",
    "journal",
    "space_sha256",
)
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
        yield name, value if isinstance(value, (bool, int, float)) else repr(value)

frames = SOURCE
print(json.dumps(dict(pair for index in range(4) for pair in visit(frames[index], f"frame {index}"))))
"""


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, fromfile_prefix_chars="@"
    )
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path, nargs="?", default=ROOT)
    parser.add_argument("--renamed", action="append", default=[], metavar="OLD=NEW")
    parser.add_argument("--called", action="append", default=[], metavar="NEW=>OLD")
    parser.add_argument(
        "--tolerance", action="append", default=[], metavar="KEY=RELATIVE", help="for keys that contain KEY"
    )
    parser.add_argument(
        "--expected", action="append", default=[], metavar="TEXT", help="count complaints with this text separately"
    )
    parser.add_argument("--ignore-texts", action="store_true", help="do not compare texts in summary.json")
    parser.add_argument("--runs", nargs="+", choices=[*RUNS, *SOURCES], default=[*RUNS, *SOURCES])
    options = parser.parse_args()
    renamed = dict(pair.split("=") for pair in options.renamed)
    called = dict(pair.split("=>") for pair in options.called)
    tolerances = {}
    for pair in options.tolerance:
        key, _, relative = pair.partition("=")
        tolerances[key] = float(relative)
    unexpected_count = 0
    with tempfile.TemporaryDirectory() as folder:
        write_recording(Path(folder, "recording"))
        checkouts = {"old": options.old.resolve(), "new": options.new.resolve()}
        for side, checkout in checkouts.items():  # each in its own format
            drive = "record kitti --scenario urban --num-frames 40 --frame-interval-s 0.1"
            drive = substitute(drive, called) if side == "old" else drive
            run(checkout, [*drive.split(), "--out", f"{folder}/{side}/drive"], folder)
        for name in options.runs:
            results = []
            for side, checkout in checkouts.items():
                replacements = dict(called) if side == "old" else {}
                replacements |= {"RECORDING": f"{folder}/recording", "DRIVE": f"{folder}/{side}/drive"}
                replacements["CHECKOUT"] = str(checkout)
                results.append(read_values(name, checkout, replacements, Path(folder, side, name), folder))
            if options.ignore_texts:
                results = [remove_texts(values) for values in results]
            complaints = list(compare(*results, renamed, tolerances))
            expected = [complaint for complaint in complaints if any(text in complaint for text in options.expected)]
            unexpected = [complaint for complaint in complaints if complaint not in expected]
            unexpected_count += len(unexpected)
            count = count_values(results[0])
            print(f"{name}: {count:,} values, {len(unexpected)} differ, {len(expected)} as expected", flush=True)
            for complaint in [*unexpected[:20], *expected[:5]]:
                print(f"  {complaint}", flush=True)
    sys.exit(unexpected_count > 0)


def substitute(text, replacements):
    for key, replacement in replacements.items():
        text = text.replace(key, replacement)
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
    """Run one command of one checkout and return its output."""
    done = run_python(checkout, PROGRAM, arguments, folder)
    if done.returncode not in RESULT_CODES or "Traceback" in done.stderr:
        sys.exit(f"{checkout}: {' '.join(arguments)} ended with {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


def read_values(name, checkout, replacements, out, folder):
    """Run one command, or read frames of one source, and return the values by key."""
    if name in SOURCES:
        return hash_frames(checkout, substitute(SOURCES[name], replacements), folder)
    arguments = substitute(RUNS[name], replacements).split()
    if name == "rig":
        printed = run(checkout, arguments, folder).replace(str(out.parent), "")
        return {"printed": hashlib.sha256(printed.encode()).hexdigest()}
    run(checkout, [*arguments, "--out", str(out)], folder)
    if name.startswith(("record_", "world")) or name == "record":
        hashes, side = {}, str(out.parent).encode()
        for path in sorted(path for path in out.rglob("*") if path.is_file()):
            content = path.read_bytes().replace(side, b"")
            if path.suffix == ".csv":  # without the names of its columns
                content = content.partition(b"\n")[2]
            hashes[str(path.relative_to(out))] = hashlib.sha256(content).hexdigest()
        return hashes
    values = dict(flatten(read_summary(out)))
    if (out / "search.json").is_file():
        values |= flatten(json.loads((out / "search.json").read_text(encoding="utf-8")), "search.json/")
    for path in sorted(out.rglob("*.npz")):
        with np.load(path) as arrays:
            for array in set(arrays.files) - {"header"}:
                values[f"{path.relative_to(out)}/{array}"] = arrays[array]
    return values


def hash_frames(checkout, source, folder):
    """Compute a hash of each tensor of the first four frames of a source."""
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
    """Read summary.json with its rows by rig, region and band; without the name of the rig if there is one rig."""
    content = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    rows = content.pop("rows", None)
    if not isinstance(rows, list) or not all("region" in row for row in rows):
        return {**content, "rows": {str(index): row for index, row in enumerate(rows or [])}}
    has_rigs = len({row.get("rig") for row in rows}) > 1
    named = {}
    for row in rows:
        rig = row.pop("rig", "") if has_rigs else row.pop("rig", "") * 0
        band = row.get("band", row.get("height"))  # its name before the renames of 0.1.0
        named[f"{rig} {row['region']} {band}"] = row
    return {**content, "rows": named}


def flatten(content, prefix=""):
    """Yield (path, value) of all values that are neither a mapping nor a list."""
    items = content.items() if isinstance(content, dict) else enumerate(content)
    for key, value in items:
        if isinstance(value, dict | list):
            yield from flatten(value, f"{prefix}{key}/")
        else:
            yield f"{prefix}{key}", value


def remove_texts(values):
    """Remove texts, but not hashes of tensors and files."""
    hash_pattern = re.compile(r"(\S+ \(.*\) )?[0-9a-f]{64}")
    numbers = {}
    for key, value in values.items():
        is_text = isinstance(value, str) and not hash_pattern.fullmatch(value)
        if not is_text and not (isinstance(value, np.ndarray) and value.dtype.kind == "U"):
            numbers[key] = value
    return numbers


def count_values(values):
    return sum(value.size if isinstance(value, np.ndarray) else 1 for value in values.values())


def compare(old, new, renamed, tolerances):
    """Yield a sentence for each value of `old` that is missing or different in `new`.

    Args:
        old: Key -> value.
        new: Key -> value.
        renamed: Old part of a key, or old text -> new one.
        tolerances: Part of a key -> relative tolerance.
    """
    for key, value in old.items():
        parts = rename_key(key, renamed)
        if not set(IGNORED_KEYS).isdisjoint(parts):
            continue
        name = "/".join(parts)
        new_value = find_value(name, new)
        relative = max((relative for text, relative in tolerances.items() if text in key), default=0.0)
        expected = rename(value, renamed) if isinstance(value, str) else value
        if new_value is None and value is not None:
            yield f"{key}: missing"
        elif not are_equal(expected, new_value, relative):
            yield f"{key}: {describe_difference(value, new_value)}"


def rename_key(key, renamed):
    """Rename a key: its end by the first matching rule with `/`, all other parts one by one.

    Returns:
        Parts of the new key.
    """
    for end, replacement in renamed.items():
        pattern = re.escape(end).replace(r"\#", r"(\d+)").replace(r"\*", r"([^/]*)")
        if "/" in end and (match := re.search(f"(?:^|/)(?P<end>{pattern})$", key)):
            beginning = key[: match.start("end")].split("/")[:-1]
            new_end = replacement
            for text in match.groups()[1:]:
                new_end = re.sub(r"[#*]", text, new_end, count=1)
            return [*(rename(part, renamed) for part in beginning), *new_end.split("/")]
    return [rename(part, renamed) for part in key.split("/")]


def rename(text, renamed):
    """Rename a part of a key or a text by the first matching rule; `*` on both sides stands for the same text."""
    if text in renamed:
        return renamed[text]
    for pattern, replacement in renamed.items():
        if "*" in pattern and fnmatchcase(text, pattern):
            prefix, suffix = pattern.split("*")
            return replacement.replace("*", text[len(prefix) : len(text) - len(suffix)])
    return text


def find_value(name, values):
    """Find the value of a name; for a name with `*`, all values that match, stacked in their order."""
    if "*" not in name:
        return values.get(name)
    matching = [values[key] for key in values if fnmatchcase(key, name)]
    return np.stack(matching) if matching else None


def are_equal(old, new, relative):
    if isinstance(old, np.ndarray):
        if not isinstance(new, np.ndarray) or old.shape != new.shape:
            return False
        is_numeric = old.dtype.kind in "fc"
        if relative and is_numeric:
            return np.allclose(old, new, rtol=relative, atol=0, equal_nan=True)
        return np.array_equal(old, new, equal_nan=is_numeric)
    if relative and isinstance(old, float) and isinstance(new, float):
        return math.isclose(old, new, rel_tol=relative)
    return old == new or (old != old and new != new)


def describe_difference(old, new):
    if not isinstance(old, np.ndarray):
        return f"{old} and {new}"
    if not isinstance(new, np.ndarray) or old.shape != new.shape:
        return f"array of {old.shape} and {getattr(new, 'shape', new)}"
    is_different = (old != new) & ~((old != old) & (new != new))
    return f"{np.count_nonzero(is_different):,} of {old.size:,} elements differ"


if __name__ == "__main__":
    main()
