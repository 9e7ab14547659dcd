"""Every test on each version of Python, from the sdist, in a system of its own that comes with that version.

`python -m benchmarks.versions [VERSION ...]`, as in `3.13`, or `lowest`: Python 3.11 with the lowest versions of all
dependencies. It needs Linux, root and debootstrap, 8 GB of disk a version (torch comes with CUDA), and
half an hour each on two cores. Systems stay in `out/versions`, for the next time.
"""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import time
from contextlib import ExitStack
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "out" / "versions"
# Of Ubuntu, whose newer releases and keys Debian's debootstrap does not know.
UBUNTU = ("--no-check-gpg", "--components=main,universe")
# Which release of Debian or Ubuntu comes with which Python, the script of debootstrap's that makes it, and its options.
SYSTEMS = {
    "3.11": ("bookworm", "bookworm", ()),
    "3.12": ("noble", "jammy", UBUNTU),
    "3.13": ("trixie", "trixie", ()),
    "3.14": ("sid", "sid", ()),
}
SCRIPTS = Path("/usr/share/debootstrap/scripts")
LOWEST = "lowest"
PACKAGES = "python3,python3-venv,python3-dev,ca-certificates,gcc,g++,git,libgl1,libgomp1,make"
# What a system needs of the one around it.
MOUNTS = ("proc", "dev", "dev/shm", "dev/pts")
COPIES = ("etc/resolv.conf", "etc/ssl/certs/ca-certificates.crt")
INSTALL = ".venv/bin/python -m pip install --quiet --prefer-binary"
NEWEST = f"{INSTALL} '.[dev]' && .venv/bin/python -m pip check"
# Old packages say of their own use of newer ones what is nobody's concern here.
LOWEST_STEPS = f".venv/bin/python .ci/lowest.py > lowest.txt && {INSTALL} --constraint lowest.txt '.[dev]'"
TESTS = (
    "OMP_NUM_THREADS=1 OMP_WAIT_POLICY=passive .venv/bin/python -m pytest --numprocesses auto --dist worksteal "
    "--tb=short --quiet -p no:cacheprovider"
)
VERSIONS = ".venv/bin/python -c 'import numpy, torch; print(numpy.__version__, torch.__version__)'"
COUNTS = ("passed", "skipped", "failed", "error")


def main(names):
    if unknown := set(names) - {*SYSTEMS, LOWEST}:
        sys.exit(f"no system for {', '.join(sorted(unknown))}; there are {', '.join(SYSTEMS)} and {LOWEST}")
    print("| Python | dependencies | NumPy | torch | passed | skipped | failed | minutes |", flush=True)
    print("|---|---|---|---|---|---|---|---|", flush=True)
    for name in names or (*SYSTEMS, LOWEST):
        print(f"| {' | '.join(tried(name))} |", flush=True)


def tried(name):
    """What came of a version: a row of the table; all that was printed is beside the system, in `tests.txt`."""
    version = "3.11" if name == LOWEST else name
    system = FOLDER / version
    if not (system / "usr/bin/python3").exists():
        release, script, options = SYSTEMS[version]
        system.mkdir(parents=True)
        asked = ("--variant=minbase", f"--include={PACKAGES}", *options)
        run(["debootstrap", *asked, release, str(system), "", str(SCRIPTS / script)])
    for copy in COPIES:
        (system / copy).write_bytes(Path("/", copy).read_bytes())
    source = unpacked(system / "root")
    start_s = time.monotonic()
    with ExitStack() as mounted:
        for place in MOUNTS:
            run(["mount", "--bind", f"/{place}", str(system / place)])
            mounted.callback(run, ["umount", str(system / place)])
        inside = [f"cd /root/{source.name}", "python3 .ci/make_venv.py .venv"]
        inside.append(LOWEST_STEPS if name == LOWEST else NEWEST)
        run(["chroot", str(system), "bash", "-euc", " && ".join(inside)])
        words = run(["chroot", str(system), "bash", "-euc", f"{inside[0]} && {VERSIONS} && .venv/bin/python -V"])
        old = " -W ignore::DeprecationWarning" * (name == LOWEST)
        tests = run(["chroot", str(system), "bash", "-uc", f"{inside[0]} && {TESTS}{old}"], may_fail=True)
    (system / "tests.txt").write_text(tests, encoding="utf-8")
    numpy, torch, _, python = words.split()
    counts = [(re.findall(rf"(\d+) {what}", tests.splitlines()[-1]) or ["0"])[0] for what in COUNTS]
    failed = str(int(counts[2]) + int(counts[3]))
    minutes = f"{(time.monotonic() - start_s) / 60:.0f}"
    return python, "lowest" if name == LOWEST else "newest", numpy, torch, counts[0], counts[1], failed, minutes


def unpacked(folder):
    """The sdist, in a folder inside of a system."""
    run([sys.executable, "-m", "build", "--quiet", "--sdist", "--outdir", str(FOLDER), str(ROOT)])
    (packed,) = FOLDER.glob("*.tar.gz")
    source = folder / packed.name.removesuffix(".tar.gz")
    shutil.rmtree(source, ignore_errors=True)  # that of another commit
    with tarfile.open(packed) as archive:
        archive.extractall(folder, filter="data")
    return source


def run(command, *, may_fail=False):
    """What a command prints."""
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive", "LC_ALL": "C.UTF-8", "HOME": "/root"}
    done = subprocess.run(
        command, check=False, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    if done.returncode and not may_fail:
        sys.exit(f"{' '.join(command)}: exit code {done.returncode}\n{done.stdout[-3000:]}")
    return done.stdout


if __name__ == "__main__":
    main(sys.argv[1:])
