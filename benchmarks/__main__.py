"""Run benchmarks and print their tables: `python -m benchmarks [name ...]`; without names, those of speed."""

import importlib
import sys

from torchcover.evaluation.cores import set_threads

# Of speed and memory, which docs/measured/performance.md is made of; the others have pages of their own.
PERFORMANCE = ("run", "raycasting", "reading", "omissions")
BENCHMARKS = (
    *PERFORMANCE,
    "search",
    "afternoon",
    "stability",
    "trade_offs",
    "heights",
    "settings",
    "imperfections",
    "ray_budget",
    "recorded_measure",
    "accumulated_reference",
    "calibration",
    "training_overhead",
    "known_boxes",
    "hostile_documents",
    "kills",
    "resumes",
    "scaling",
    "mutated_files",
    "targets",
    "kinds",
    "towns",
    "pairing",
    "placement",
    "optimisers",
    "choices",
    "nothing",
    "published",
    "voxels",
    "streets",
    "gpu",
)


def main(names):
    set_threads()  # as the command line does
    unknown = set(names) - set(BENCHMARKS)
    if unknown:
        sys.exit(f"no benchmark {', '.join(sorted(unknown))}; there are {', '.join(BENCHMARKS)}")
    for name in names or PERFORMANCE:
        module = importlib.import_module(f"benchmarks.{name}")
        if len(names) != 1:
            print(f"## {name}: {module.__doc__.splitlines()[0]}\n", flush=True)
        module.main()
        print(flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
