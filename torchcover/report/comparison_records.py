"""The numbers of several rigs in files: the better ones marked, and the differences to the first rig."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from torchcover.coverage import Coverage, Region
from torchcover.report.paired import check_paired, differences
from torchcover.report.quantity import quantities_of
from torchcover.report.records import Record, columns_of, conditions_of, json_record, records_of, write_records


def write_comparison(coverages: Mapping[str, Coverage], regions: Sequence[Region], path: str | Path) -> None:
    """Write a CSV row for each rig, region and band: the columns of `write_csv`, marks, differences to the first rig.

    Args:
        coverages: What `CoverageMetric.compute` returned, by the name of the rig, from the same frames.
        regions: Regions within the grid.
        path: File to write.

    Raises:
        ValueError: As `check_paired`, or as `Coverage.summary`.
    """
    check_paired(coverages)
    first = next(iter(coverages.values()))
    suffixes = ("best", "difference", "difference_error", "difference_significant")
    own = [f"{quantity.column}_{suffix}" for quantity in quantities_of(first.thresholds) for suffix in suffixes]
    write_records(["rig", *columns_of(first), *own], list(_records(coverages, regions)), path)


def comparison_dict(coverages: Mapping[str, Coverage], regions: Sequence[Region]) -> dict[str, Any]:
    """Everything but the maps, for `summary.json`; see `write_comparison`.

    Args:
        coverages: As in `write_comparison`.
        regions: Regions within the grid.

    Returns:
        A dict that `json.dumps(..., allow_nan=False)` takes. A difference is this rig minus the first; an unknown
        number is None, and so is whether it is significant if its error is unknown.

    Raises:
        ValueError: As `write_comparison`.
    """
    check_paired(coverages)
    return {
        **conditions_of(next(iter(coverages.values()))),
        "counts": {name: dict(coverage.counts) for name, coverage in coverages.items()},
        "rows": [json_record(record) for record in _records(coverages, regions)],
    }


def _records(coverages: Mapping[str, Coverage], regions: Sequence[Region]) -> Iterator[Record]:
    first = next(iter(coverages.values()))
    summaries = [coverage.summary(regions) for coverage in coverages.values()]
    found = [differences(coverages, region, height) for region in regions for height in first.grid.heights]
    for rig, (name, coverage) in enumerate(coverages.items()):
        own = zip(records_of(coverage, regions, summaries[rig]), zip(*summaries, strict=True), found, strict=True)
        for record, rows, row_differences in own:
            compared: Record = {}
            for quantity, difference in zip(quantities_of(first.thresholds), row_differences[name], strict=True):
                compared[f"{quantity.column}_best"] = quantity.best(rows)[rig]
                compared[f"{quantity.column}_difference"] = difference.value
                compared[f"{quantity.column}_difference_error"] = difference.error
                compared[f"{quantity.column}_difference_significant"] = difference.significant
            yield {"rig": name, **record, **compared}
