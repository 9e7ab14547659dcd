"""Where the processor time of the default run goes, beside what nobody can do without: `python -m benchmarks.run`.

`python -m benchmarks.run OTHER` measures another checkout beside it, in turns. Each part counts for itself only: the
search within an update is the search's. The floor is the same rays through bare Embree, those for heights too, the bare
search, and the import of torch; processor time, so that other processes matter little, and the least of some rounds.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from importlib import import_module
from pathlib import Path

ROOT = Path(__file__).parents[1]
COMMAND = ["evaluate", "front_roof_128", "--scenario", "urban", "--num-frames", "64"]
ROUNDS = 2
START, WORLDS, RIG, REFERENCE, MOVING = "start", "worlds", "rig rays", "reference", "what moves"
SEARCH, SUMS, BODIES, MAPS, FILES = "search", "sums", "bodies beside the vehicle", "maps", "other files"
STARTED, AGAIN = "as it is started: processor time", "the same again, with worlds from disk"
EMBREE, BARE_SEARCH, TORCH = "bare Embree", "bare search", "`import torch`"
PARTS = (START, WORLDS, RIG, REFERENCE, MOVING, SEARCH, SUMS, BODIES, MAPS, FILES)
# Function -> what it is part of.
WATCHED = {
    "torchcover.simulation.mounted_rigs:MountedRigStore.get_mounted_rigs": WORLDS,
    "torchcover.simulation.simulator:Simulator._scan": RIG,
    "torchcover.simulation.surface_reference:SurfaceReference.scan": REFERENCE,
    "torchcover.simulation.scene_geometry:SceneGeometry.get_snapshot": MOVING,
    "torchcover.neighbors.query:_search_nearest": SEARCH,
    "torchcover.coverage.sums:CoverageSums.compute_sums": SUMS,
    "torchcover.coverage.sums:CoverageSums.add_sums": SUMS,
    "torchcover.targets.near_field:NearFieldObserver.compute_sums": BODIES,
    "torchcover.report.maps:plot_side_by_side": MAPS,
    "torchcover.files.atomic:AtomicOutput.add_figure": MAPS,
    "torchcover.evaluation.result:Result.save": FILES,
}


def main():
    """Print the table."""
    from benchmarks import table  # the measured process runs this file with the package of another checkout

    checkouts = [Path(name).resolve() for name in sys.argv[1:] if Path(name).is_dir()] + [ROOT]
    found = {checkout: [] for checkout in checkouts}
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(ROUNDS):
            for checkout in checkouts:
                found[checkout].append(measured(checkout, folder))
    least = [{name: min(one[name] for one in found[of]) for name in found[of][0]} for of in checkouts]
    floors = [sum(one[name] for name in (EMBREE, BARE_SEARCH, TORCH)) for one in least]
    names = (*PARTS, "rest", "**in all**", EMBREE, BARE_SEARCH, TORCH)
    rows = [(name, *(f"{one[name]:.2f}" for one in least)) for name in names]
    rows.append(
        ("**in all over the floor**", *(one["**in all**"] / floor for one, floor in zip(least, floors, strict=True)))
    )
    steps = [sum(one[name] for name in (RIG, REFERENCE, MOVING, SEARCH, SUMS)) for one in least]
    bare = [one[EMBREE] + one[BARE_SEARCH] for one in least]
    rows.append(("the steps over bare Embree and search", *(step / one for step, one in zip(steps, bare, strict=True))))
    rows.append(("start over `import torch`", *(one[START] / one[TORCH] for one in least)))
    rows += [(name, *(one[name] for one in least)) for name in (STARTED, AGAIN)]
    rows.append(("as it is started: peak of a process (MB)", *(round(one["peak"]) for one in least)))
    table(
        (f"`torchcover {' '.join(COMMAND)}`", *(("before",) if len(checkouts) > 1 else ()), "processor time (s)"), rows
    )


def measured(checkout, folder):
    """Processor seconds of each part, in one process and on one thread, then those of the run as anybody starts it."""
    said = ("OMP_NUM_THREADS", "OMP_WAIT_POLICY", "OPENBLAS_NUM_THREADS", "PYTHONDONTWRITEBYTECODE")
    said += ("TORCHCOVER_CACHE_GB",)
    plain = {name: value for name, value in os.environ.items() if name not in said} | {"PYTHONPATH": str(checkout)}
    alone = {**plain, "OMP_NUM_THREADS": "1", "TORCHCOVER_CACHE_GB": "0"}
    here = Path(__file__).resolve()
    seconds, _, output = child([sys.executable, here, "parts", folder], alone, folder)
    found = json.loads(output.splitlines()[-1])
    parts = {part: found.get(part, 0.0) for part in (*PARTS, EMBREE, BARE_SEARCH)}
    parts["**in all**"], parts["rest"] = seconds, seconds - sum(parts[part] for part in PARTS)
    parts[TORCH] = child([sys.executable, "-c", "import torch"], alone, folder)[0]
    program = "import sys; from torchcover.cli.app import main; main()"
    started = [sys.executable, "-c", program, *COMMAND, "--out", folder]
    with tempfile.TemporaryDirectory() as cache:
        plain["XDG_CACHE_HOME"] = cache
        parts[STARTED], parts["peak"], _ = child(started, plain, folder)
        parts[AGAIN], _, _ = child(started, plain, folder)
    return parts


def child(command, environment, folder):
    """Processor seconds of a process and its own, the peak of the largest in megabytes, and what it printed."""
    read, write = os.pipe()
    told = subprocess.Popen(command, env=environment, cwd=folder, stdout=write, stderr=subprocess.DEVNULL)
    os.close(write)
    with os.fdopen(read) as stream:
        output = stream.read()
    _, status, usage = os.wait4(told.pid, 0)
    told.returncode = os.waitstatus_to_exitcode(status)
    if told.returncode:
        sys.exit(f"{command} ended with {told.returncode}")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024, output


class Stopwatches:
    """Processor time of parts; one that runs within another counts for itself only."""

    def __init__(self):
        self.seconds, self._running = Counter(), []

    def watch(self, function, part):
        def call(*args, **kwargs):
            start = time.process_time()
            self._running.append(part)
            try:
                return function(*args, **kwargs)
            finally:
                taken = time.process_time() - start
                self._running.pop()
                self.seconds[part] += taken
                if self._running:
                    self.seconds[self._running[-1]] -= taken

        return call

    def watch_all(self):
        for place, part in WATCHED.items():
            owner, name = owner_of(place)
            if hasattr(owner, name):  # in another checkout it may be called otherwise
                setattr(owner, name, self.watch(getattr(owner, name), part))

    def within(self, part):
        return part in self._running


def parts(folder):
    """Run the command here, every part watched, and print their processor seconds."""
    # As the command line does, before torch is loaded.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    from torchcover.cli.app import main as command_line

    watches, bare = Stopwatches(), Counter()
    started = []

    def first(function):
        def call(*args, **kwargs):
            if not started:
                started.append(time.process_time())
            return function(*args, **kwargs)

        return call

    def timed(function, name):
        def call(*args, **kwargs):
            start = time.process_time()
            try:
                return function(*args, **kwargs)
            finally:
                if not watches.within(WORLDS):
                    bare[name] += time.process_time() - start

        return call

    observe = owner_of("torchcover.evaluation.measurement:observe")
    setattr(*observe, first(getattr(*observe)))
    watches.watch_all()
    raycaster = import_module("torchcover.simulation.raycaster")
    choice = import_module("torchcover.neighbors.backend_choice")

    class Scene(raycaster.EmbreeScene):
        run = timed(raycaster.EmbreeScene.run, EMBREE)

    raycaster.EmbreeScene = Scene
    load_search = choice._load_search
    choice._load_search = lambda backend: timed(load_search(backend), BARE_SEARCH)
    sys.argv = ["torchcover", *COMMAND, "--num-workers", "0", "--out", folder]
    try:
        command_line()
    except SystemExit as end:
        if end.code:
            raise
    print(json.dumps({**watches.seconds, START: started[0], EMBREE: bare[EMBREE], BARE_SEARCH: bare[BARE_SEARCH]}))


def owner_of(place):
    """Who has a function, and under which name."""
    module, _, path = place.partition(":")
    *owners, name = path.split(".")
    owner = import_module(module)
    for each in owners:
        owner = getattr(owner, each)
    return owner, name


if __name__ == "__main__":
    parts(sys.argv[2]) if sys.argv[1:2] == ["parts"] else main()
