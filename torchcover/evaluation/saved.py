"""Compare results that were saved: what `Coverage.save` keeps is all that a comparison needs."""

from collections.abc import Sequence
from pathlib import Path

from torchcover.coverage import Coverage
from torchcover.evaluation.result import Result
from torchcover.evaluation.rig_names import AnyRig, distinct

SUFFIX = ".npz"
# What `evaluate` calls its file in any folder, so that the folder tells more.
USUAL_STEM = "coverage"


def saved_among(rigs: Sequence[AnyRig]) -> list[str]:
    """Those that are named by coverage files."""
    return [str(rig) for rig in rigs if isinstance(rig, str | Path) and Path(rig).suffix == SUFFIX]


def compare_saved(files: Sequence[str | Path]) -> Result:
    """Compare saved coverages; the others are compared with the first.

    Args:
        files: Two or more `.npz` files of `Coverage.save`, of rigs that were measured in the same frames: by one
            `compare`, or by several `evaluate` of the same scenario, steps, seed and reference sensor.

    Returns:
        As `compare`, but nobody knows how the runs went: `Result.run` is None.

    Raises:
        FileNotFoundError: No such file.
        ValueError: Not a coverage file, fewer than two, or two that are not paired: other steps, reference points,
            grids or thresholds.
    """
    names = distinct([_name(Path(file)) for file in files])
    if len(names) < 2:
        raise ValueError(f"a comparison needs at least two coverage files; got {files[0]} only")
    coverages = {name: Coverage.load(file) for name, file in zip(names, files, strict=True)}
    first = next(iter(coverages.values()))
    return Result(
        coverages=coverages,
        regions=first.regions,
        run=None,
        rigs={name: str(file) for name, file in zip(names, files, strict=True)},
        source={"scenario": None, "vehicle": None, "frames": None, "seed": None},
        reference_record=None,
        device=None,
        inputs=[Path(file) for file in files],
    )


def _name(file: Path) -> str:
    """The folder's name where the file's own says nothing."""
    return file.absolute().parent.name if file.stem == USUAL_STEM else file.stem
