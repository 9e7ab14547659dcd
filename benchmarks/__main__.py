"""Run every benchmark and print its table: `python -m benchmarks [name ...]`."""

import importlib
import sys

BENCHMARKS = (
    "nearest",
    "search",
    "crossover",
    "raycasting",
    "paper_step",
    "memory",
    "imports",
    "stability",
    "trade_offs",
    "moving_actors",
    "urban_throughput",
    "heights",
    "settings",
    "imperfections",
    "five_rigs",
    "omissions",
    "metric_omissions",
    "ray_budget",
    "recorded_measure",
    "reading",
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
    "published",
    "voxels",
    "cities",
    "streets",
)


def main(names):
    unknown = set(names) - set(BENCHMARKS)
    if unknown:
        sys.exit(f"no benchmark {', '.join(sorted(unknown))}; there are {', '.join(BENCHMARKS)}")
    for name in names or BENCHMARKS:
        module = importlib.import_module(f"benchmarks.{name}")
        print(f"## {name}: {module.__doc__.splitlines()[0]}\n", flush=True)
        module.main()
        print(flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
