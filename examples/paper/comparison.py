"""The numbers of a run beside the paper's, in the units of its tables.

Results are a dict: name of the LiDARs, measure ("known" or "area") and steps -> `Place` -> `Number`.
"""

import math
from itertools import product

from examples.paper.published import HEIGHTS, LIDARS, QUANTITIES, REGIONS, Place, published
from examples.paper.score import score

HEADINGS = (
    "| region | height | LiDAR | detection (%) | paper | ratio | by area | radius (m) | paper | ratio | by area |"
)
SCORE_HEADINGS = (
    "| LiDARs | measure | steps | detection (points) | radius (factor) | orderings in rows | all orderings | "
    "Spearman, detection | Spearman, radius |"
)
HIGHER_HEADINGS = "| LiDARs | measure | larger at obstacle height | ground within 20 m: grille and roof, 128 rows (m) |"
MEASURE_WORDS = {"known": "known cells", "area": "by area"}


def numbers_of(coverages, regions):
    """`Place` -> number in the unit of the tables.

    Args:
        coverages: Name of the LiDAR in the tables -> `Coverage` with one threshold.
        regions: In their order.
    """
    numbers = {}
    for lidar, coverage in coverages.items():
        for region in regions:
            for height in coverage.grid.heights:
                estimate = coverage.estimate(region, height)
                radius, share = estimate.numbers().values()
                in_percent = {part: 100 * getattr(share, part) for part in ("value", "error", "low", "high")}
                percent = share._replace(**in_percent)
                for quantity, number in zip(QUANTITIES, (percent, radius), strict=True):
                    numbers[Place(quantity, lidar, region.name, height)] = number
    return numbers


def scores_of(results):
    """The score of each of the results."""
    paper = published()
    return {key: score({place: number.value for place, number in run.items()}, paper) for key, run in results.items()}


def as_markdown(results):
    """A table of numbers and a line of scores for each set of LiDARs, then the scores by set, measure and steps."""
    scores = scores_of(results)
    last = max(steps for _, _, steps in results)
    lines = []
    for lidars in dict.fromkeys(lidars for lidars, _, _ in results):
        lines += [
            f"### {lidars}, {last} steps",
            "",
            *_table(results[lidars, "known", last], results[lidars, "area", last]),
        ]
        lines += [f"{MEASURE_WORDS[measure]}: {scores[lidars, measure, last]}.\n" for measure in MEASURE_WORDS]
    lines += ["### Scores", "", SCORE_HEADINGS, f"|{' --- |' * 2}{' ---: |' * 7}"]
    for (lidars, measure, steps), each in scores.items():
        lines.append(
            f"| {lidars} | {MEASURE_WORDS[measure]} | {steps} | {each.points:.1f} | {each.factor:.2f} | "
            f"{each.rows_held} of {each.rows} | {each.pairs_held} of {each.pairs} | "
            f"{each.spearman_detection:.3f} | {each.spearman_radius:.3f} |"
        )
    return "\n".join([*lines, "", "### Radii at obstacle height", "", *_higher_up(results, last), ""])


def as_records(results):
    """The same for JSON."""
    scores = scores_of(results)
    return [
        {
            "lidars": lidars,
            "measure": measure,
            "steps": steps,
            **scores[lidars, measure, steps]._asdict(),
            "numbers": [
                {**place._asdict(), "value": number.value, "error": number.error, "paper": published()[place]}
                for place, number in run.items()
            ],
        }
        for (lidars, measure, steps), run in results.items()
    ]


def _table(known, area):
    """24 rows: what was measured over known cells, the paper's number, their ratio, and what was measured by area."""
    paper = published()
    lines = [HEADINGS, f"|{' --- |' * 3}{' ---: |' * 8}"]
    for region, height, lidar in product(REGIONS, HEIGHTS, LIDARS):
        cells = [region, height, lidar]
        for quantity in QUANTITIES:
            place = Place(quantity, lidar, region, height)
            ratio = known[place]._replace(value=known[place].value / paper[place], low=math.nan)
            cells += [_words(known[place]), f"{paper[place]:.2f}", _words(ratio), _words(area[place])]
        lines.append(f"| {' | '.join(cells)} |")
    return [*lines, ""]


def _higher_up(results, last):
    """In how many of the rows radii are larger at obstacle height than on the ground, as all of the paper's are."""
    lines = [HIGHER_HEADINGS, f"|{' --- |' * 2}{' ---: |' * 2}"]
    for (lidars, measure, steps), run in results.items():
        if steps == last:
            radii = {(lidar, region): _radii(run, lidar, region) for lidar, region in product(LIDARS, REGIONS)}
            larger = sum(obstacle > ground for ground, obstacle in radii.values())
            near = " and ".join(f"{radii[lidar, REGIONS[0]][0]:.2f}" for lidar in ("grille_128", "roof_128"))
            lines.append(f"| {lidars} | {MEASURE_WORDS[measure]} | {larger} of {len(radii)} | {near} |")
    return lines


def _radii(run, lidar, region):
    return [run[Place("radius_m", lidar, region, height)].value for height in HEIGHTS]


def _words(number):
    """Two decimals, as in the paper, and the interval."""
    if math.isnan(number.value):
        return "unknown"
    ends = "" if math.isnan(number.low) else f" [{number.low:.2f}, {number.high:.2f}]"
    return f"{number.value:.2f}{ends}"
