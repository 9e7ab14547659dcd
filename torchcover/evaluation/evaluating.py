"""Evaluate rigs, or compare results: what a notebook calls, and the command line too."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchcover.coverage import Coverage
from torchcover.evaluation.arguments import accept_fields
from torchcover.evaluation.config import DESCRIPTIONS
from torchcover.evaluation.measurement import measure_coverage
from torchcover.evaluation.mixed_result import MixedResult, measure_scenarios
from torchcover.evaluation.result import Result
from torchcover.evaluation.settings import Settings
from torchcover.evaluation.task import build_task, make_unique_names

SAVED = ".npz"
# What `evaluate` calls its file in any folder, so that the folder tells more.
USUAL_STEM = "coverage"


@accept_fields(Settings, DESCRIPTIONS)
def evaluate(settings: Settings) -> Result:
    """Measure the coverage of a rig, or of several in the same frames, as `torchcover evaluate` does.

    Returns:
        Numbers, maps, and how the run went; of several rigs also the differences to the first, and whether they are
        more than chance. Whatever ends it after the first step, a bad frame, Ctrl-C or an error, is noted in
        `result.run.failure`, with a RuntimeWarning, and what was measured until then is there. Of several scenarios a
        `MixedResult`: that of each, and the numbers of their mixture.

    Raises:
        ValueError: Settings that make no sense, not a single good frame, or a checkpoint of another run.
        FileNotFoundError: An unknown name or file.
        TypeError: A setting of a wrong kind, or an observer whose state cannot be saved.

    Example:
        >>> result = evaluate("front_roof_32", steps=2, cell_m=1.0, rays=1024)
        >>> result.coverage.counts["num_frames"], sorted({row["region"] for row in result.summary})
        (2, ['160m', '20m', '80m', 'front_3m', 'left_3m', 'rear_3m', 'right_3m'])
    """
    if settings.mixture is not None:
        return measure_scenarios(settings)
    return measure_coverage(build_task(settings), settings)


def compare(results: Result | str | Path | Sequence[Result | str | Path]) -> Result:
    """Compare what is measured already: the others with the first, as `torchcover compare` does with saved coverages.

    Args:
        results: Results of `evaluate`, or `.npz` files of `Coverage.save`: two or more rigs that were measured in the
            same frames, by one call or by several of the same scenario, steps, seed and reference sensor. One result
            of several rigs is enough. Of several scenarios, all of the same and with the same weights.

    Returns:
        As of `evaluate`, but how the runs went is unknown: `Result.run` is None.

    Raises:
        FileNotFoundError: No such file.
        ValueError: Not a coverage file, fewer than two rigs, or two that are not paired: other steps, reference points,
            grids or thresholds.
        TypeError: Neither of the two.

    Example:
        >>> low, high = (evaluate(rig, steps=8, cell_m=2.0, rays=512) for rig in ("front_grille_128", "front_roof_128"))
        >>> list(compare([low, high]).coverages)
        ['front_grille_128', 'front_roof_128']
    """
    each = [results] if isinstance(results, Result | str | Path) else list(results)
    if mixed := [one for one in each if isinstance(one, MixedResult)]:
        weights = mixed[0].weights
        if len(mixed) < len(each) or any(one.weights != weights for one in mixed):
            raise ValueError(
                "compare: results of the same scenarios with the same weights are needed, or none of several"
            )
        return MixedResult.from_results(
            {name: _compared([one.scenario_results[name] for one in mixed]) for name in weights}, weights
        )
    return _compared(each)


def _compared(each: Sequence[Result | str | Path]) -> Result:
    measured_already = [one for given in each for one in _coverages(given)]
    names = make_unique_names([name for name, *_ in measured_already])
    if len(names) < 2:
        raise ValueError(f"a comparison needs at least two measured rigs; got {', '.join(names) or 'none'} only")
    coverages = {name: coverage for name, (_, coverage, *_) in zip(names, measured_already, strict=True)}
    given_as, sources = [given for _, _, given, _ in measured_already], [source for *_, source in measured_already]
    source = {key: sources[0].get(key) for key in ("scenario", "vehicle", "frames", "seed")}
    source = {key: told if all(one.get(key) == told for one in sources) else None for key, told in source.items()}
    for key in ("sensor_model", "weather"):
        told = [(of.get(key) or {}).get(rig) for rig, *_, of in measured_already]
        source[key] = dict(zip(names, told, strict=True)) if all(told) else None
    return Result(
        coverages=coverages,
        regions=next(iter(coverages.values())).regions,
        run=None,
        rigs={name: str(given) for name, given in zip(names, given_as, strict=True)},
        source=source,
        reference_record=None,
        device=None,
        input_files=[given for given in given_as if isinstance(given, Path)],
    )


def _coverages(given: Result | str | Path) -> list[tuple[str, Coverage, str | Path, Mapping[str, Any]]]:
    """Name, coverage, what it was called, and where its frames came from, of each rig."""
    if isinstance(given, Result):
        return [(name, of, given.rigs[name] or name, given.source) for name, of in given.coverages.items()]
    if not isinstance(given, str | Path):
        raise TypeError(f"compare: results of `evaluate` or coverage files are needed; got {type(given).__name__}")
    file = Path(given)
    if file.suffix != SAVED:
        raise ValueError(f"{given}: not measured; compare takes results and .npz files, and `evaluate` several rigs")
    name = file.absolute().parent.name if file.stem == USUAL_STEM else file.stem
    return [(name, Coverage.load(file), file, {})]
