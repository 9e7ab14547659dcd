"""Whether metrics rank published sensor placements as the detectors that were trained on them do."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchcover.evaluation.placement_scores import PlacementScores, score_placements
from torchcover.files import Publication, csv_text
from torchcover.published import Agreement, Judged, Ranked, Relation, agreement_of, read_results
from torchcover.published.agreement import kind_of
from torchcover.simulation import Scenario, builtin_folder, builtin_names

PAPER = "place3d2024"
# Quantity and class in `datasets/published/place3d_2024.csv`, and what it is called here.
TRUTHS = {("map", "car"): "car mAP", ("map", "bicycle"): "bicycle mAP", ("map", "pedestrian"): "pedestrian mAP",
          ("miou", ""): "mIoU"}  # fmt: skip
# How the rolls of Table 7 are read, and what the rigs are called at their end.
READINGS = {"radians": "", "degrees": "_degrees"}
# What has to be known before any of it is believed; `examples/place3d` has the tables that say so.
NOTES = (
    "8 placements, 4 of which have the same mean height and which have 4 heights in all, cannot separate metrics: "
    "whatever grows with the height ranks them much as the detectors do.",
    "No metric is validated by this: for cars, Li et al. (ICRA 2024) and Place3D rank the same four placements "
    "(center, line, pyramid, trapezoid) with a Spearman correlation of -0.80, so that no metric can agree with both.",
    "The paper does not say whether rolls are radians or degrees; in degrees pyramid_roll is all but pyramid, as "
    "in the published car mAP (52.12 and 52.17).",
)
COLUMNS = ("truth", "rolls", "metric", "kind", "spearman", "spearman_low", "spearman_high", "kendall", "kendall_low",
           "kendall_high", "p", "interval_over")  # fmt: skip


@dataclass(frozen=True, eq=False)
class AgreementStudy:
    """What `torchcover agree` gives.

    Args:
        found: What detectors say, and how the rolls are read -> how the metrics rank the same placements.
        scores: What the metrics say of each rig.
        scenario: Where they were measured.
        seed: Seed of the traffic.
    """

    found: Mapping[tuple[str, str], Agreement]
    scores: PlacementScores
    scenario: str
    seed: int

    @property
    def record(self) -> dict[str, object]:
        """Everything, as JSON takes it; what is unknown is None."""
        return {
            "scenario": self.scenario,
            "steps": self.scores.steps,
            "seed": self.seed,
            "sensor_model": dict(self.scores.sensor_models),
            "notes": list(NOTES),
            "truths": [
                {
                    "truth": truth,
                    "rolls": reading,
                    "judges": list(found.judged.judges),
                    "placements": dict(zip(found.judged.placements, found.judged.mean.tolist(), strict=True)),
                    "noise_ceiling": _known(found.judged.ceiling),
                    "metrics_looked_at": found.looked_at,
                    "best": found.best,
                    "p_of_the_best": _known(found.best_p),
                    "best_by_chance_95": _known(found.by_chance),
                }
                for (truth, reading), found in self.found.items()
            ],
            "rows": [dict(zip(COLUMNS, row, strict=True)) for row in self.rows],
        }

    @property
    def rows(self) -> list[tuple[object, ...]]:
        """A row of `COLUMNS` for each metric, truth and reading of the rolls."""
        return [
            (truth, reading, row.metric, row.kind, *map(_known, (*row.spearman, *row.kendall, row.p)), _over(row))
            for (truth, reading), one in self.found.items()
            for row in one.ranked
        ]

    def save(self, folder: str | Path) -> list[Path]:
        """Write the files.

        Returns:
            `agreement.csv`, a row for each metric, truth and reading of the rolls; `scores.csv`, what each metric says
            of each rig; `summary.json`, everything.
        """
        scores = [(one.name, kind_of(one), *map(_known, one.gains.tolist())) for one in self.scores.rankings]
        with Publication(Path(folder)) as files:
            files.add_text("agreement.csv", csv_text([COLUMNS, *self.rows]))
            files.add_text("scores.csv", csv_text([("metric", "kind", *self.scores.rigs), *scores]))
            files.publish(self.record)
        return files.paths


def agree(
    paper: str = PAPER,
    scenario: Scenario | str | Path = "urban",
    *,
    seed: int = 0,
    **settings: Any,  # noqa: ANN401  (those of `score_placements`)
) -> AgreementStudy:
    """Rank the placements of Place3D (NeurIPS 2024) by metrics, and by the published results of detectors.

    Args:
        paper: "place3d2024".
        scenario: The world that the metrics are measured in.
        seed: Seed of the traffic.
        settings: Others of `score_placements`: `metrics`, `steps`, `sensor_model`, and of `evaluate`.

    Raises:
        ValueError: Another paper, an unknown metric, or as `evaluate`.
        FileNotFoundError: An unknown scenario.
    """
    if paper != PAPER:
        raise ValueError(f"{paper}: no published placements of this name; there is {PAPER}")
    rigs = {name: name for name in builtin_names("rigs") if name.startswith(f"{PAPER}_")}
    scores = score_placements(rigs, scenario, seed=seed, **settings)
    return AgreementStudy(agreements(scores), scores, str(getattr(scenario, "name", scenario)), seed)


def agreements(scores: PlacementScores) -> dict[tuple[str, str], Agreement]:
    """What detectors say, and how the rolls are read -> how metrics rank the placements of Place3D.

    Args:
        scores: What the metrics say of its rigs, both readings of the rolls among them.
    """
    results = read_results(builtin_folder("published") / "place3d_2024.csv")
    found = {}
    for key, words in TRUTHS.items():
        judged = results[key]
        truth = Judged(words, judged.placements, judged.judges, judged.values)
        for reading, ending in READINGS.items():
            named = [_rig_of(placement, ending, scores.rigs) for placement in judged.placements]
            found[words, reading] = agreement_of(scores.of(named), truth)
    return found


def verdict(truth: str, found: Mapping[str, Agreement]) -> str:
    """What the detectors agree on, and what the best of so many metrics is worth."""
    first = next(iter(found.values()))
    judges = first.judged.judges
    words = (
        f"{len(judges)} networks ({', '.join(judges)}) agree with each other by {first.judged.ceiling:.2f} on {truth}."
    )
    for reading, one in found.items():
        words += (
            f" Rolls in {reading}: of {one.looked_at} metrics the best is `{one.best}`, p = {one.best_p:.3f} as the "
            f"best of so many; one of twenty times chance alone gives the best more than {one.by_chance:.2f}."
        )
    return words


def relation(one: Relation) -> str:
    """A number and its interval.

    Example:
        >>> relation(Relation(0.857, 0.5, 0.95))
        '+0.86 [+0.50, +0.95]'
    """
    if math.isnan(one.value):
        return "-"
    return f"{one.value:+.2f} [{one.low:+.2f}, {one.high:+.2f}]"


def _rig_of(placement: str, ending: str, rigs: Sequence[str]) -> str:
    name = f"{PAPER}_{placement}"
    return f"{name}{ending}" if f"{name}{ending}" in rigs else name


def _over(row: Ranked) -> str:
    return "worlds and networks" if row.over_worlds else "networks"


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value
