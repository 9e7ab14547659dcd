"""Peak memory: it does not grow with steps, and the brute-force search stays inside its budget."""

import subprocess
import sys

from benchmarks.timing import table

STEPS = """
import resource, torch
from torchcover import BevGrid, CoverageMetric
from torchcover.data import SimulatedFrames
from torchcover.evaluation import CoverageObserver, observe
from torchcover.simulation import PaperReference
sensor = PaperReference(rows=256, columns=256)
frames = SimulatedFrames("courtyard", "front_roof_128", steps={0}, reference_sensor=sensor)
metric = CoverageMetric(BevGrid(x=(-40.0, 160.0), y=(-40.0, 40.0), cell=0.25), max_radius=220.0)
observe(frames, [CoverageObserver(metric)])
metric.compute()
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""
SEARCH = """
import resource, torch
from torchcover import nearest
query, points = torch.rand({0}, 3) * 100, torch.rand(200_000, 3) * 100
nearest(query[:10], points[:10], backend="cdist")
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
nearest(query, points, backend="cdist", memory_mb={1})
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 / 1e6)
"""


def measured(program):
    """What a program of its own process prints as its last number."""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def main():
    """Print peak memory."""
    few, many = measured(STEPS.format(64)), measured(STEPS.format(512))
    table(("steps", "peak (MiB)", "over 64 steps"), [(64, few, 1.0), (512, many, many / few)])
    print()
    slices = [(20_000, budget, measured(SEARCH.format(20_000, budget))) for budget in (32, 64, 256)]
    table(("queries x 200,000 points", "budget (MB)", "grown by (MB)"), slices)


if __name__ == "__main__":
    main()
