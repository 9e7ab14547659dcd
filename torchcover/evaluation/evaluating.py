"""Entry functions for Python and the command line: evaluate rigs, and compare results."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from torchcover.coverage import Coverage, TargetSums
from torchcover.coverage.target_sums import read_target_sums
from torchcover.evaluation.arguments import accept_fields
from torchcover.evaluation.config import DESCRIPTIONS
from torchcover.evaluation.measurement import measure_coverage
from torchcover.evaluation.mixed_result import MixedResult, measure_scenarios
from torchcover.evaluation.result import Result
from torchcover.evaluation.rig_names import make_unique_names
from torchcover.evaluation.settings import Settings
from torchcover.evaluation.task import build_task


@accept_fields(Settings, DESCRIPTIONS)
def evaluate(settings: Settings) -> Result:
    """Measure the coverage of one rig, or of several in the same frames, as `torchcover evaluate` does.

    Returns:
        Numbers, maps, and the outcome of the run; for several rigs also the differences to the first and their
        significance. An error after the first frame, Ctrl-C included, is stored in `result.run.failure` with a
        RuntimeWarning, and the result contains the frames until then. Several scenarios give a `MixedResult` with the
        result of each and the numbers of their mixture.

    Raises:
        ValueError: Invalid or contradictory settings, no usable frame, or a checkpoint of another run.
        FileNotFoundError: Unknown name or file.
        TypeError: Setting of a wrong type, or an observer whose state cannot be saved.

    Example:
        >>> result = evaluate("front_roof_32", num_frames=2, cell_m=1.0, num_rays=1024)
        >>> result.coverage.counts["num_frames"], sorted({row["region"] for row in result.summary})
        (2, ['160m', '20m', '80m', 'front_3m', 'left_3m', 'rear_3m', 'right_3m'])
    """
    if settings.mixture is not None:
        return measure_scenarios(settings)
    return measure_coverage(build_task(settings), settings)


def compare(results: Result | str | Path | Sequence[Result | str | Path]) -> Result:
    """Compare results with the first one, as `torchcover compare` does with saved coverages.

    Args:
        results: Results of `evaluate`, or `.npz` files of `Coverage.save`, of at least two rigs that were measured
            in the same frames: by one call, or by several with the same scenario, number of frames, seed and reference
            sensor.
            Results of several scenarios need the same scenarios and weights.

    Returns:
        The comparison; `Result.run` is None.

    Raises:
        FileNotFoundError: No such file.
        ValueError: Not a coverage file, fewer than two rigs, or different frames, reference points, grids or
            thresholds.
        TypeError: Neither a result nor a file.

    Example:
        >>> rigs = "front_grille_128", "front_roof_128"
        >>> low, high = (evaluate(rig, num_frames=8, cell_m=2.0, num_rays=512) for rig in rigs)
        >>> list(compare([low, high]).coverages)
        ['front_grille_128', 'front_roof_128']
    """
    inputs = [results] if isinstance(results, Result | str | Path) else list(results)
    mixed_results = [result for result in inputs if isinstance(result, MixedResult)]
    if not mixed_results:
        return _compare_single(inputs)
    weights = mixed_results[0].weights
    if len(mixed_results) < len(inputs) or any(result.weights != weights for result in mixed_results):
        raise ValueError("compare: results of the same scenarios with the same weights are needed, or none of several")
    comparisons = {}
    for name in weights:
        comparisons[name] = _compare_single([result.scenario_results[name] for result in mixed_results])
    return MixedResult.from_results(comparisons, weights)


class _MeasuredRig(NamedTuple):
    """Measured rig of a comparison.

    Args:
        name: Name of the rig.
        coverage: Its coverage.
        path: Coverage file, or the name or file of the rig that the user gave.
        source: Source of the frames.
        target_sums: Visibility of test targets; None without them.
    """

    name: str
    coverage: Coverage
    path: str | Path
    source: Mapping[str, Any]
    target_sums: TargetSums | None


def _compare_single(inputs: Sequence[Result | str | Path]) -> Result:
    """Compare rigs of a single scenario or recording."""
    rigs: list[_MeasuredRig] = []
    for item in inputs:
        rigs += _list_measured_rigs(item)
    names = make_unique_names([rig.name for rig in rigs])
    if len(names) < 2:
        raise ValueError(f"a comparison needs at least two measured rigs; got {', '.join(names) or 'none'} only")
    source: dict[str, Any] = {}
    for key in ("scenario", "vehicle", "frames", "seed"):
        value = rigs[0].source.get(key)
        is_shared = all(rig.source.get(key) == value for rig in rigs)
        source[key] = value if is_shared else None
    for key in ("sensor_model", "weather"):
        values = [(rig.source.get(key) or {}).get(rig.name) for rig in rigs]
        source[key] = dict(zip(names, values, strict=True)) if all(values) else None
    return Result(
        coverages={name: rig.coverage for name, rig in zip(names, rigs, strict=True)},
        regions=rigs[0].coverage.regions,
        run=None,
        rigs={name: str(rig.path) for name, rig in zip(names, rigs, strict=True)},
        source=source,
        reference_record=None,
        device=None,
        target_sums={name: rig.target_sums for name, rig in zip(names, rigs, strict=True) if rig.target_sums},
        input_files=[rig.path for rig in rigs if isinstance(rig.path, Path)],
    )


def _list_measured_rigs(item: Result | str | Path) -> list[_MeasuredRig]:
    """List the rigs of a result, or the rig of a coverage file."""
    if isinstance(item, Result):
        return [
            _MeasuredRig(name, coverage, item.rigs[name] or name, item.source, item.target_sums.get(name))
            for name, coverage in item.coverages.items()
        ]
    if not isinstance(item, str | Path):
        raise TypeError(f"compare: results of `evaluate` or coverage files are needed; got {type(item).__name__}")
    file = Path(item)
    if file.suffix != ".npz":
        raise ValueError(f"{item}: not measured; compare takes results and .npz files, and `evaluate` several rigs")
    # `evaluate` names its file `coverage.npz` in any folder, so that the folder is the better name.
    name = file.absolute().parent.name if file.stem == "coverage" else file.stem
    return [_MeasuredRig(name, Coverage.load(file), file, {}, read_target_sums(file))]
