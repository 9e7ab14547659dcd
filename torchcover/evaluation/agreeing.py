"""Whether metrics rank published sensor placements as the detectors that were trained on them do."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from torchcover.evaluation.placement_scores import PlacementScores, score_placements
from torchcover.published import Agreement, Judged, agreement_of, published_results
from torchcover.published.baselines import mean_height_m
from torchcover.published.ranks import spearman
from torchcover.simulation import Rig, Scenario, builtin_names

PAPER = "place3d2024"
# Quantity and class in `datasets/published/place3d_2024.csv`, and what it is called here.
TRUTHS = {("map", "car"): "car mAP", ("map", "bicycle"): "bicycle mAP", ("map", "pedestrian"): "pedestrian mAP",
          ("miou", ""): "mIoU"}  # fmt: skip
# How the rolls of Table 7 are read, and what the rigs are called at their end.
READINGS = {"radians": "", "degrees": "_degrees"}


@dataclass(frozen=True, eq=False)
class AgreementStudy:
    """What `torchcover agree` gives.

    Args:
        found: What detectors say, and how the rolls are read -> how the metrics rank the same placements.
        scores: What the metrics say of each rig.
        scenario: Where they were measured.
        seed: Seed of the traffic.
        notes: What has to be known before any of it is believed.
    """

    found: Mapping[tuple[str, str], Agreement]
    scores: PlacementScores
    scenario: str
    seed: int
    notes: tuple[str, ...]


def agree(
    paper: str = PAPER,
    scenario: Scenario | str | Path = "urban",
    *,
    metrics: Sequence[str] | None = None,
    steps: int = 64,
    seed: int = 0,
    every_s: float | None = None,
    workers: int = 0,
    progress: bool = False,
) -> AgreementStudy:
    """Rank the placements of Place3D (NeurIPS 2024) by metrics, and by the published results of detectors.

    Args:
        paper: "place3d2024".
        scenario: The world that the metrics are measured in.
        metrics: Those of others, of `torchcover.published.PUBLISHED`; all if not given.
        steps: Steps.
        seed: Seed of the traffic.
        every_s: Time between two steps in seconds; as in `evaluate` if not given.
        workers: Processes that make frames.
        progress: Whether to show a bar.

    Raises:
        ValueError: Another paper, an unknown metric, or as `evaluate`.
        FileNotFoundError: An unknown scenario.
    """
    if paper != PAPER:
        raise ValueError(f"{paper}: no published placements of this name; there is {PAPER}")
    rigs = {name: name for name in builtin_names("rigs") if name.startswith(f"{PAPER}_")}
    scores = score_placements(
        rigs, scenario, metrics=metrics, steps=steps, seed=seed, every_s=every_s, workers=workers, progress=progress
    )
    results = published_results("place3d_2024")
    found = {}
    for key, words in TRUTHS.items():
        judged = results[key]
        for reading, ending in READINGS.items():
            named = [_rig_of(placement, ending, rigs) for placement in judged.placements]
            truth = Judged(words, judged.placements, judged.judges, judged.values)
            found[words, reading] = agreement_of(scores.of(named), truth)
    notes = (_on_heights(results["map", "car"].placements), contradiction(), *_on_rolls(results["map", "car"]))
    return AgreementStudy(found, scores, str(getattr(scenario, "name", scenario)), seed, notes)


def contradiction() -> str:
    """That two papers rank the same placements of LiDARs differently, with the correlation of their car mAP.

    Example:
        >>> contradiction()
        'No metric is validated by this: for cars, Li et al. (ICRA 2024) and Place3D rank the same four placements ...'
    """
    place3d, li = (published_results(name)["map", "car"] for name in ("place3d_2024", "li_2024"))
    both = [name for name in place3d.placements if name in li.placements]
    rho = float(spearman(place3d.of(both).mean, li.of(both).mean))
    count = {3: "three", 4: "four"}.get(len(both), str(len(both)))
    return (
        f"No metric is validated by this: for cars, Li et al. (ICRA 2024) and Place3D rank the same {count} placements "
        f"({', '.join(both)}) with a Spearman correlation of {rho:.2f}, so that no metric can agree with both."
    )


def _rig_of(placement: str, ending: str, rigs: Mapping[str, str]) -> str:
    name = f"{PAPER}_{placement}"
    return f"{name}{ending}" if f"{name}{ending}" in rigs else name


def _on_heights(placements: Sequence[str]) -> str:
    heights = [mean_height_m(Rig.load(f"{PAPER}_{placement}")) for placement in placements]
    shared = max(heights.count(height) for height in heights)
    return (
        f"{len(placements)} placements, {shared} of which have the same mean height and which have {len(set(heights))} "
        "heights in all, cannot separate metrics: whatever grows with the height ranks them much as the detectors do."
    )


def _on_rolls(cars: Judged) -> tuple[str, ...]:
    """What speaks for one reading of the rolls."""
    pyramid, rolled = (float(cars.of([name]).mean[0]) for name in ("pyramid", "pyramid_roll"))
    return (
        "The paper does not say whether rolls are radians or degrees; in degrees pyramid_roll is all but pyramid, as "
        f"in the published car mAP ({rolled:.2f} and {pyramid:.2f}).",
    )
