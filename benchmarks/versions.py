"""Every test on each version of Python, from the sdist and outside the repository, in an environment of its own.

`python -m benchmarks.versions [VERSION ...]`, as in `3.13`, or `lowest`: Python 3.11 with the lowest versions of all
dependencies, among them a torch that comes with gigabytes for CUDA. Interpreters are those on the PATH and of pyenv,
which makes one that is missing. A quarter of an hour each on two cores; what was printed stays in `out/versions`.
"""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "out" / "versions"
NAMES = ("3.11", "3.12", "3.13", "lowest")
INSTALL = ".venv/bin/python -m pip install --quiet --prefer-binary '.[dev]' --constraint"
# The newest of everything but torch, whose version is that of the other tests: its newest comes with CUDA, too.
NEWEST = f"grep '^torch==' constraints.txt > newest.txt && {INSTALL} newest.txt && .venv/bin/python -m pip check"
# Releases of Rerun need NumPy 2, and its extra is left out.
LOWEST = f".venv/bin/python .ci/lowest.py > lowest.txt && sed -i /rerun-sdk/d pyproject.toml && {INSTALL} lowest.txt"
TESTS = (
    "OMP_NUM_THREADS=1 OMP_WAIT_POLICY=passive .venv/bin/python -m pytest --numprocesses auto --dist worksteal "
    "--tb=short --quiet -p no:cacheprovider"
)
VERSIONS = ".venv/bin/python -c 'import numpy, torch; print(numpy.__version__, torch.__version__)'"
COUNTS = ("passed", "skipped", "failed", "error")


def main(names):
    if unknown := set(names) - set(NAMES):
        sys.exit(f"no version {', '.join(sorted(unknown))}; there are {', '.join(NAMES)}")
    print("| Python | dependencies | NumPy | torch | passed | skipped | failed | minutes |", flush=True)
    print("|---|---|---|---|---|---|---|---|", flush=True)
    for name in names or NAMES:
        print(f"| {' | '.join(tried(name))} |", flush=True)


def tried(name):
    """What came of a version: a row of the table."""
    python = interpreter("3.11" if name == "lowest" else name)
    source = unpacked(FOLDER / name)
    start_s = time.monotonic()
    run([python, ".ci/make_venv.py", ".venv"], source)
    run(["bash", "-euc", LOWEST if name == "lowest" else NEWEST], source)
    words = run(["bash", "-euc", f"{VERSIONS} && .venv/bin/python -V"], source)
    # Old packages say of their own use of newer ones what is nobody's concern here.
    old = " -W ignore::DeprecationWarning -W ignore::FutureWarning" * (name == "lowest")
    tests = run(["bash", "-uc", TESTS + old], source, may_fail=True)
    (FOLDER / f"{name}.txt").write_text(tests, encoding="utf-8")
    numpy, torch, _, version = words.split()
    counts = [(re.findall(rf"(\d+) {what}", tests.splitlines()[-1]) or ["0"])[0] for what in COUNTS]
    failed = str(int(counts[2]) + int(counts[3]))
    minutes = f"{(time.monotonic() - start_s) / 60:.0f}"
    return version, "lowest" if name == "lowest" else "newest", numpy, torch, counts[0], counts[1], failed, minutes


def interpreter(version):
    """The Python of this version."""
    if shutil.which("pyenv"):
        newest = f"pyenv latest {version}"
        script = f"{newest} > /dev/null 2>&1 || pyenv install {version} > /dev/null; pyenv prefix $({newest})"
        return Path(run(["bash", "-euc", script]).strip(), "bin", "python")
    if found := shutil.which(f"python{version}"):
        return Path(found)
    sys.exit(f"no python{version}: put one on the PATH, or install pyenv")


def unpacked(folder):
    """The sdist."""
    shutil.rmtree(folder, ignore_errors=True)  # that of another commit
    run([sys.executable, "-m", "build", "--quiet", "--sdist", "--outdir", str(folder), str(ROOT)])
    (packed,) = folder.glob("*.tar.gz")
    with tarfile.open(packed) as archive:
        archive.extractall(folder, filter="data")
    return folder / packed.name.removesuffix(".tar.gz")


def run(command, folder=ROOT, *, may_fail=False):
    """What a command prints."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "PYTEST"))}
    done = subprocess.run(command, check=False, cwd=folder, env=environment, stdout=subprocess.PIPE,
                          stderr=subprocess.STDOUT, text=True)  # fmt: skip
    if done.returncode and not may_fail:
        sys.exit(f"{' '.join(map(str, command))}: exit code {done.returncode}\n{done.stdout[-3000:]}")
    return done.stdout


if __name__ == "__main__":
    main(sys.argv[1:])
