"""Do metrics rank the placements of Place3D as its detectors do: `python -m examples.place3d --num-frames 200 --frame-interval-s 10`.

Its rigs `place3d2024_*` in the same frames, by torchcover's numbers, by those of others, and by the LiDAR occupancy
boards (LOB) of Kim and Park 2020, which hang on the rig alone: a page in Markdown.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from examples.place3d.boards import DISTANCES_M, cells_hit
from examples.place3d.page import page
from examples.place3d.study import agree, agreements
from torchcover.contrib import Ranking, parse_metric_names
from torchcover.estimation import Quantity
from torchcover.simulation import Rig


def with_boards(study):
    """The study with the share of cells hit of boards at several distances, which is the same in all worlds."""
    boards, rigs = [], [Rig.load(rig) for rig in study.scores.rigs]
    for distance_m in DISTANCES_M:
        shares = [float(cells_hit(rig.sensors, distance_m).mean()) for rig in rigs]
        name = f"lob_{distance_m:g}m"
        boards.append(Ranking.from_values(Quantity(name, name, "share", lower_is_better=False), shares, "lob"))
    scores = replace(study.scores, rankings=(*study.scores.rankings, *boards))
    return study._replace(scores=scores, found=agreements(scores))


def main():
    """Measure, rank, print and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="urban", help="name or YAML file")
    parser.add_argument("--metrics", default="all", help="metrics of others, as in `k_cover,point_density`")
    parser.add_argument("--num-frames", type=int, default=64)
    parser.add_argument("--frame-interval-s", type=float, help="seconds between steps")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--num-workers", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/place3d"))
    options = parser.parse_args()
    study = agree(
        scenario=options.scenario,
        metrics=parse_metric_names(options.metrics),
        steps=options.steps,
        seed=options.seed,
        frame_interval_s=options.frame_interval_s,
        workers=options.workers,
        progress=True,
    )
    study = with_boards(study)
    options.out.mkdir(parents=True, exist_ok=True)
    text = page(study)
    (options.out / "agreement.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
