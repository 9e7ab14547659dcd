"""Rank the placements of Place3D by metrics and by its detectors: `python -m examples.place3d --num-frames 200`.

Scores its rigs `place3d2024_*` in the same frames by the numbers of torchcover, by published metrics, and by LiDAR
occupancy boards (LOB, Kim and Park 2020), which depend on the rig alone, and writes a page in Markdown.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from examples.place3d.boards import DISTANCES_M, find_hit_cells
from examples.place3d.page import format_page
from examples.place3d.study import compute_agreements, run_study
from torchcover.contrib import Ranking, parse_metric_names
from torchcover.estimation import Quantity
from torchcover.simulation import Rig


def add_boards(study):
    """Add the share of hit cells of boards at several distances to a study.

    Args:
        study: `Study`.

    Returns:
        `Study` with a ranking for each distance.
    """
    rankings, rigs = [], [Rig.load(rig) for rig in study.scores.rigs]
    for distance_m in DISTANCES_M:
        shares = [float(find_hit_cells(rig.sensors, distance_m).mean()) for rig in rigs]
        name = f"lob_{distance_m:g}m"
        rankings.append(Ranking.from_values(Quantity(name, name, "share", lower_is_better=False), shares, "lob"))
    scores = replace(study.scores, rankings=(*study.scores.rankings, *rankings))
    return study._replace(scores=scores, agreements=compute_agreements(scores))


def main():
    """Measure, rank, print and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="urban", help="name or YAML file")
    parser.add_argument("--metrics", default="all", help="published metrics, for example `k_cover,point_density`")
    parser.add_argument("--num-frames", type=int, default=64)
    parser.add_argument("--frame-interval-s", type=float, help="seconds between frames")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--num-workers", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/place3d"))
    options = parser.parse_args()
    study = run_study(
        scenario=options.scenario,
        metrics=parse_metric_names(options.metrics),
        num_frames=options.num_frames,
        seed=options.seed,
        frame_interval_s=options.frame_interval_s,
        num_workers=options.num_workers,
        progress=True,
    )
    text = format_page(add_boards(study))
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "agreement.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
