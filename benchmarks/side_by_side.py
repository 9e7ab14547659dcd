"""Do two checkouts give the same numbers? `python -m benchmarks.side_by_side OLD [NEW]`.

Short runs of `evaluate` and `compare` in the courtyard, in traffic and over a recording. Every number of summary.json
and every array of the coverage files of OLD has to be in NEW, the same to the last bit; `--renamed OLD=NEW` says what
a key or an array is called now. A name of NEW with a `*` stands for all arrays like it, one on top of the other:
`--renamed 'detection=detection_*m'`. `--called thresholds-m=threshold`: what OLD calls an option.
Times, versions and what was left out are not compared.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
RUNS = {
    "courtyard": ["evaluate", "front_roof_128", "--scenario", "courtyard", "--steps", "9"],
    "paper_pattern": ["evaluate", "front_grille_128", "--steps", "2", "--reference", "paper", "--rays", "65536"],
    "urban": ["evaluate", "front_roof_32", "--scenario", "urban", "--steps", "10", "--thresholds-m", "1"],
    "workers": ["evaluate", "nuscenes_cameras", "--scenario", "highway", "--steps", "2", "--workers", "2"],
    "recording": ["evaluate", "--frames", "recording"],
    "comparison": ["compare", "front_roof_32", "front_grille_128", "--scenario", "urban", "--steps", "9"],
    "thresholds": ["compare", "kitti", "hu2022_line", "--steps", "8", "--thresholds-m", "0.4", "--thresholds-m", "0.1"],
}
NOT_COMPARED = ("seconds", "torchcover", "left_out", "complete", "frames")
# What the whole program starts with, in either checkout.
PROGRAM = "from torchcover.cli.app import main; main()"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path, nargs="?", default=ROOT)
    parser.add_argument("--renamed", action="append", default=[], metavar="OLD=NEW")
    parser.add_argument("--called", action="append", default=[], metavar="NEW=OLD")
    parser.add_argument("--runs", nargs="+", choices=RUNS, default=list(RUNS))
    options = parser.parse_args()
    renamed = dict(pair.split("=") for pair in options.renamed)
    called = {f"--{new}": f"--{old}" for new, old in (pair.split("=") for pair in options.called)}
    different = 0
    with tempfile.TemporaryDirectory() as folder:
        record(Path(folder, "recording"))
        for name in options.runs:
            outs = [Path(folder, side, name) for side in ("old", "new")]
            of_old = [called.get(word, word) for word in RUNS[name]]
            for checkout, words, out in zip((options.old, options.new), (of_old, RUNS[name]), outs, strict=True):
                run(checkout.resolve(), [*words, "--out", str(out)], folder)
            compared, complaints = compare(*outs, renamed)
            different += len(complaints)
            print(f"{name}: {compared:,} numbers compared, {len(complaints)} complaints", flush=True)
            for complaint in complaints[:20]:
                print(f"  {complaint}")
    sys.exit(different > 0)


def run(checkout, arguments, folder):
    """One command of one checkout."""
    environment = {**os.environ, "PYTHONPATH": str(checkout), "OMP_WAIT_POLICY": "passive"}
    command = [sys.executable, "-c", PROGRAM, *arguments]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{checkout}: {' '.join(arguments)} ended with {done.returncode}\n{done.stdout}{done.stderr}")


def record(folder):
    """A recording of twelve frames, some of them odd: no sensor point, points that are not finite."""
    generator = np.random.default_rng(5)
    for source, count in (("sensor", 4000), ("reference", 6000)):
        (folder / source).mkdir(parents=True)
        for frame in range(12):
            points = generator.uniform((-40, -40, -0.6), (165, 40, 2.1), size=(count + 10 * frame, 3))
            points[::1000] = np.nan
            kept = points[:0] if source == "sensor" and frame == 4 else points
            np.save(folder / source / f"frame{frame}.npy", kept.astype(np.float32))


def compare(old, new, renamed):
    """How many numbers are in both, and what differs or is missing."""
    complaints, compared = [], 0
    before, after = ({key: value for key, value in leaves(read(out)) if not ignored(key)} for out in (old, new))
    for key, value in before.items():
        other = after.get("/".join(renamed.get(part, part) for part in key.split("/")), "missing")
        compared += 1
        if value != other:
            complaints.append(f"{key}: {value} and {other}")
    for path in sorted(old.rglob("*.npz")):
        with np.load(path) as first, np.load(new / path.relative_to(old)) as second:
            for name in set(first.files) - {"header"}:
                compared += first[name].size
                other = array_called(renamed.get(name, name), second)
                if other is None or not np.array_equal(first[name], other, equal_nan=True):
                    complaints.append(f"{path.name}, {name}: missing or different")
    return compared, complaints


def array_called(name, arrays):
    """An array of a coverage file, or all whose names fit the pattern, in the order of the file; None for none."""
    if "*" not in name:
        return arrays[name] if name in arrays.files else None
    fitting = [arrays[other] for other in arrays.files if fnmatchcase(other, name)]
    return np.stack(fitting) if fitting else None


def read(out):
    """summary.json, its rows by what they are about; of a single rig without its name."""
    content = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    rows = content.pop("rows")
    several = len({row.get("rig") for row in rows}) > 1
    named = {f"{row['rig'] if several else ''} {row['region']} {row['height']}": row for row in rows}
    for row in rows:
        row.pop("rig", None)
    return {**content, "rows": named}


def leaves(content, prefix=""):
    """(path, value) of everything that is no mapping."""
    for key, value in content.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{key}/")
        else:
            yield f"{prefix}{key}", value


def ignored(key):
    """Whether a path is about the run, not about its numbers."""
    return key.split("/")[0] in NOT_COMPARED


if __name__ == "__main__":
    main()
