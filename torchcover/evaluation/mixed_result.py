"""Results of rigs in several scenarios, and in the weighted mixture of them."""

import json
from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from torchcover.coverage import Coverage, CoverageMixture
from torchcover.coverage.target_sums import TargetMixture
from torchcover.evaluation.checkpoint import Checkpoint
from torchcover.evaluation.measurement import measure_coverage
from torchcover.evaluation.result import Result
from torchcover.evaluation.result_page import build_result_tables
from torchcover.evaluation.settings import Settings
from torchcover.evaluation.task import build_task
from torchcover.files import SUMMARY, AtomicOutput, format_csv
from torchcover.report import RENDERERS, CoverageTable, PageTable, build_file_stems, merge_notes, render_page
from torchcover.report.records import build_records

# Name of the mixture in tables and in the column `scenario`.
MIXTURE = "mixture"


@dataclass(frozen=True, eq=False, repr=False)
class MixedResult(Result):
    """Result of `evaluate` and `compare` for several scenarios: the numbers of their mixture.

    Coverages, maps and published metrics belong to one scenario each; see `scenario_results`. Their files are in a
    folder for each scenario; `summary.csv`, `report.html` and `summary.json` are about the mixture.

    Args:
        scenario_results: Name of each scenario -> its result; all have the same rigs.
        weights: Name of each scenario -> its weight in the mixture; the weights sum to 1.
    """

    scenario_results: Mapping[str, Result] = field(default_factory=dict)
    weights: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def from_results(cls, scenario_results: Mapping[str, Result], weights: Mapping[str, float]) -> "MixedResult":
        """Mix the results of several scenarios.

        Args:
            scenario_results: Name of each scenario -> its result.
            weights: Name of each scenario -> its weight; the weights sum to 1.

        Returns:
            The mixture.

        Raises:
            ValueError: The results have different regions, thresholds or averages.
        """
        first = next(iter(scenario_results.values()))
        source = {}
        for key in first.source:
            source[key] = _merge_values({name: result.source.get(key) for name, result in scenario_results.items()})
        mixed = cls(
            coverages={},
            regions=first.regions,
            run=None,
            rigs=first.rigs,
            source={**source, "scenario": dict(weights)},
            reference_record=None,
            device=first.device,
            sensors=first.sensors,
            # Maps only show the ego vehicle if all scenarios have the same one.
            ego_outline_m=first.ego_outline_m if source["vehicle"] == first.source["vehicle"] else None,
            scenario_results=scenario_results,
            weights=weights,
        )
        _ = mixed.table  # raises the errors of results that cannot be mixed
        return mixed

    @property
    def coverage(self) -> Coverage:
        """Not available for a mixture.

        Raises:
            ValueError: Always; a mixture only has numbers.
        """
        names = ", ".join(self.scenario_results)
        raise ValueError(f"a mixture has no maps: use scenario_results[name].coverage, with a name of {names}")

    @cached_property
    def mixtures(self) -> Mapping[str, CoverageMixture]:
        """Name of each rig -> its numbers in the mixture, for any region, with their jackknife values."""
        # A scenario without weight is measured and shown, but it cannot make a number unknown.
        names = [name for name, weight in self.weights.items() if weight > 0.0]
        mixtures = {}
        for rig in self.scenario_results[names[0]].coverages:
            parts = {name: (self.weights[name], self.scenario_results[name].coverages[rig]) for name in names}
            mixtures[rig] = CoverageMixture(parts)
        return mixtures

    def _mix_targets(self) -> dict[str, TargetMixture]:
        """Mix the visibility of test targets for each rig with test targets."""
        mixtures = {}
        for rig in self.mixtures:
            parts = []
            for name, weight in self.weights.items():
                if weight > 0.0:
                    parts.append((weight, self.scenario_results[name].target_sums.get(rig)))
            mixture = TargetMixture.from_parts(parts)
            if mixture is not None:
                mixtures[rig] = mixture
        return mixtures

    @cached_property
    def table(self) -> CoverageTable:
        """Numbers of the mixture with standard errors, differences and marks."""
        weights = ", ".join(f"{name} {weight:.3g}" for name, weight in self.weights.items())
        note = (
            f"Weighted means over scenarios: {weights}. The weights are fixed, so confidence intervals cover chance "
            "within the scenarios, but not other scenarios or weights. A number that is unknown in one scenario is "
            "unknown in the mixture; each map shows one scenario."
        )
        scenario_notes = merge_notes({name: result.notes for name, result in self.scenario_results.items()})
        return CoverageTable.from_coverages(
            self.mixtures, self.regions, [note, *scenario_notes], self.source, target_sums=self._mix_targets()
        )

    @property
    def record(self) -> dict[str, Any]:
        """Content of `summary.json`: the numbers of the mixture, and the record of each scenario in `scenarios`."""
        scenarios = {}
        for name, result in self.scenario_results.items():
            scenarios[name] = {"weight": self.weights[name], **result.record}
        runs = [result.run for result in self.scenario_results.values() if result.run]
        skipped_frames: list[str] = []
        for run in runs:
            skipped_frames += run.skipped_frames
        return {
            **super().record,
            "duration_s": round(sum(run.duration_s for run in runs), 3) if runs else None,
            "complete": all(run.is_complete for run in runs),
            "skipped_frames": skipped_frames,
            "scenarios": scenarios,
        }

    @property
    def tables(self) -> list[PageTable]:
        """Tables of the mixture, followed by the tables of each scenario."""
        tables_by_name = {MIXTURE: build_result_tables(self.table)}
        tables_by_name |= {name: result.tables for name, result in self.scenario_results.items()}
        titled = []
        for name, tables in tables_by_name.items():
            titled += [replace(table, title=f"{name}: {table.title}".rstrip(": ")) for table in tables]
        return titled

    def plot_maps(self, layer: str | None = None) -> Iterator[tuple[str, Figure]]:
        """Plot the maps of each scenario one after the other.

        Args:
            layer: Key of the only quantity to plot; all quantities by default.

        Returns:
            Stem of the file name, which begins with the name of the scenario, and a figure outside pyplot.
        """
        for name, result in self.scenario_results.items():
            for stem, figure in result.plot_maps(layer):
                yield f"{name}/{stem}", figure

    def add_numbers(self, output: AtomicOutput, file_kinds: Container[str], folder: str = "") -> None:
        """Write the numbers of each scenario into its folder, and the numbers of the mixture, if requested.

        Args:
            output: Output folder.
            file_kinds: Requested files; `NAME/summary.json` is always written.
            folder: Prefix of the file names; it ends with a slash.
        """
        for stem, result in self._get_results_by_stem().items():
            result.add_numbers(output, file_kinds, f"{folder}{stem}/")
            text = json.dumps(result.record, indent=2, allow_nan=False) + "\n"
            output.add_text(f"{folder}{stem}/{SUMMARY}", text)
        if "numbers" in file_kinds:
            output.add_text(f"{folder}summary.csv", self._format_csv())

    def add_page_and_maps(self, output: AtomicOutput, file_kinds: Container[str], folder: str = "") -> None:
        """Write the page and the maps of each scenario into its folder, and the page of the mixture, if requested.

        Args:
            output: Output folder.
            file_kinds: Requested files.
            folder: Prefix of the file names; it ends with a slash.

        Raises:
            ValueError: There is not enough memory.
        """
        for stem, result in self._get_results_by_stem().items():
            result.add_page_and_maps(output, file_kinds, f"{folder}{stem}/")
        if "page" in file_kinds:
            output.add_text(f"{folder}report.html", render_page(self.page))

    def _get_results_by_stem(self) -> dict[str, Result]:
        """Return the result of each scenario by the name of its folder."""
        return dict(zip(build_file_stems(list(self.scenario_results)), self.scenario_results.values(), strict=True))

    @property
    def _tables_by_name(self) -> dict[str, CoverageTable]:
        """Coverage table of each scenario, and of the mixture."""
        return {**{name: result.table for name, result in self.scenario_results.items()}, MIXTURE: self.table}

    def _format_csv(self) -> str:
        """Format the rows of all scenarios and of the mixture; a scenario may lack columns of another."""
        rows: list[dict[str, object]] = []
        columns: dict[str, None] = {}
        for name, table in self._tables_by_name.items():
            for record in build_records(table):
                row = {"scenario": name, **record}
                rows.append(row)
                columns |= dict.fromkeys(row)
        lines = [list[object](columns)]
        for row in rows:
            lines.append([row.get(column, "") for column in columns])
        return format_csv(lines)

    @property
    def _title(self) -> str:
        """First line of texts about the result."""
        return f"Mixture of {', '.join(self.scenario_results)}: {', '.join(self.rigs)}"

    def __str__(self) -> str:
        """Format all coverage tables as text."""
        return "\n".join([f"{name}\n{RENDERERS['text'](table)}" for name, table in self._tables_by_name.items()])


def _merge_values(values: Mapping[str, Any]) -> object:
    """Merge the values of a setting: the common value, or a text with the value of each scenario.

    Args:
        values: Name of each scenario -> its value; a mapping has a value for each rig.
    """
    first = next(iter(values.values()))
    if all(value == first for value in values.values()):
        return first
    if isinstance(first, Mapping):
        merged = {}
        for rig in first:
            merged[rig] = _merge_values({name: value.get(rig) for name, value in values.items()})
        return merged
    return ", ".join(f"{name} {value}" for name, value in values.items())


def measure_scenarios(settings: Settings) -> MixedResult:
    """Measure the rigs in several scenarios, one after the other.

    Args:
        settings: Settings of `evaluate` with several scenarios.

    Returns:
        Numbers of the mixture, with the result of each scenario.

    Raises:
        ValueError: The settings also have a recording, ranks or observers, or the regions of the scenarios differ; and
            as in `evaluate`.
    """
    assert settings.mixture is not None  # checked by the caller
    if settings.frames is not None:
        raise ValueError("scenario and frames exclude each other: evaluate the recording separately")
    if settings.ranks or settings.observers:
        raise ValueError("several scenarios: observers and torchrun need a single scenario")
    weights = {name: weight for name, (_, weight) in settings.mixture.items()}
    stems = build_file_stems(list(settings.mixture))
    tasks = {}
    for (name, (scenario, _)), stem in zip(settings.mixture.items(), stems, strict=True):
        checkpoint = settings.checkpoint
        if checkpoint is not None:
            checkpoint = checkpoint if isinstance(checkpoint, Checkpoint) else Checkpoint(Path(checkpoint))
            checkpoint = checkpoint.in_folder(stem)
        scenario_settings = replace(settings, scenario=scenario, checkpoint=checkpoint)
        # Tasks are built before the first measurement, since one measurement may take hours.
        tasks[name] = build_task(scenario_settings), scenario_settings
    regions = [tasks[name][0].query_plan.regions for name, weight in weights.items() if weight > 0.0]
    if any(scenario_regions != regions[0] for scenario_regions in regions):
        raise ValueError(
            f"{', '.join(tasks)} cannot be mixed: the regions around their ego vehicles differ; set `vehicle` or "
            "`regions`"
        )
    results = {}
    for name in weights:
        result = measure_coverage(*tasks.pop(name))
        if result.run is not None:
            result.run.raise_failure()
        results[name] = result
    return MixedResult.from_results(results, weights)
