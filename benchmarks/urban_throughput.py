"""Steps a second in `urban` with two workers, the metric included, and how the time of a step divides."""

import time
from collections import Counter
from contextlib import contextmanager

import torch

from benchmarks.timing import table
from torchcover import BevGrid, CoverageMetric
from torchcover.coverage import metric as metric_module
from torchcover.data import SimulatedFrames
from torchcover.evaluation import CoverageObserver, observe
from torchcover.simulation import PaperReference
from torchcover.simulation.instant import Instant
from torchcover.simulation.scene import Scene
from torchcover.simulation.sight import MountedSensor

RIG = "front_roof_128"
WORKERS = 2
# Both workers have built their world by then, and the queue is full.
FIRST, LAST = 10, 110
STAGE_STEPS = 40
# Where the time of a step goes, by the functions that take it. A reference sensor's scans are not a mounted sensor's.
STAGES = {
    (Scene, "at"): "placing what moves",
    (MountedSensor, "scan"): "rays of the rig",
    (Instant, "buried"): "rays of the reference",
    (Instant, "scan"): "rays of the reference",
    (metric_module, "nearest"): "search",
    (CoverageMetric, "update"): "binning",
}


def main():
    """Print both tables, with 65,536 rays of the paper's reference."""
    reference = PaperReference(rows=256, columns=256)
    frames = SimulatedFrames("urban", RIG, steps=LAST, seed=0, reference_sensor=reference)
    print(f"{steps_a_second(frames):.1f} steps a second, {WORKERS} workers\n")
    start = time.perf_counter()
    frames.simulator.scene_of(0)
    built_s = time.perf_counter() - start
    stages = time_of_stages(frames)
    total_s = sum(stages.values())
    divided = [(stage, 1000 * taken / STAGE_STEPS, taken / total_s) for stage, taken in stages.items()]
    divided.append(("(building 60 s of traffic, once)", 1000 * built_s, ""))
    table(("stage, one thread", "a step (ms)", "share"), divided)


def new_metric():
    """The metric of the command line."""
    grid = BevGrid(x=(-40.0, 160.0), y=(-40.0, 40.0), cell=0.25)
    return CoverageMetric(grid, (0.4,), max_radius=grid.diagonal_m)


class Clock:
    """When each step was done; an observer of frames."""

    def __init__(self):
        self.times_s = []

    def update(self, _):
        self.times_s.append(time.perf_counter())


def steps_a_second(frames):
    """From workers, between the first and the last step that count."""
    clock = Clock()
    observe(frames, [CoverageObserver(new_metric()), clock], workers=WORKERS)
    return (LAST - FIRST - 1) / (clock.times_s[-1] - clock.times_s[FIRST])


def time_of_stages(frames):
    """Seconds of each stage over some steps, in this process and in one thread."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    with stopwatches() as seconds:
        # A metric binds its `update` when it is made.
        observer = CoverageObserver(new_metric())
        observer.update(frames[0])
        seconds.clear()
        start = time.perf_counter()
        for index in range(1, STAGE_STEPS + 1):
            observer.update(frames[index])
        whole_s = time.perf_counter() - start
    torch.set_num_threads(threads)
    return {stage: seconds[stage] for stage in dict.fromkeys(STAGES.values())} | {
        "all else": whole_s - sum(seconds.values())
    }


@contextmanager
def stopwatches():
    """Count the time of the functions in STAGES; one that runs within another counts for itself only."""
    seconds, running, originals = Counter(), [], {}

    def watched(function, stage):
        def call(*args, **kwargs):
            # A mounted sensor scans by the same function as the reference: that is the rig's time.
            inner = running[-1] if running and running[-1] == "rays of the rig" else stage
            start = time.perf_counter()
            running.append(inner)
            try:
                return function(*args, **kwargs)
            finally:
                running.pop()
                taken = time.perf_counter() - start
                seconds[inner] += taken
                if running:
                    seconds[running[-1]] -= taken

        return call

    for (owner, name), stage in STAGES.items():
        originals[owner, name] = getattr(owner, name)
        setattr(owner, name, watched(originals[owner, name], stage))
    try:
        yield seconds
    finally:
        for (owner, name), function in originals.items():
            setattr(owner, name, function)


if __name__ == "__main__":
    main()
