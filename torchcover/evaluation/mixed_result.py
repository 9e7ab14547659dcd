"""Rigs in several kinds of world, and in a mixture of them."""

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from torchcover.coverage import Coverage, CoverageMixture
from torchcover.evaluation.checkpoint import Checkpoint
from torchcover.evaluation.measurement import measure_coverage
from torchcover.evaluation.progress import defer_signals
from torchcover.evaluation.result import Result
from torchcover.evaluation.result_page import build_result_tables
from torchcover.evaluation.settings import FILES, Settings, parse_file_kinds
from torchcover.evaluation.task import build_task
from torchcover.files import SUMMARY, AtomicOutput, format_csv
from torchcover.report import RENDERERS, CoverageTable, PageTable, build_file_stems, merge_notes, render_page
from torchcover.report.records import build_records

MIXTURE = "mixture"


@dataclass(frozen=True, eq=False, repr=False)
class MixedResult(Result):
    """What `evaluate` and `compare` return of several scenarios: the numbers of their mixture.

    Coverages, maps, and metrics of others are of one kind of world each: those of `scenario_results`.

    Args:
        scenario_results: By the name of the scenario, what was measured there: the same rigs in all of them.
        weights: By the same names, how much each counts in the mixture; they sum to 1.
    """

    scenario_results: Mapping[str, Result] = field(default_factory=dict)
    weights: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def from_results(cls, scenario_results: Mapping[str, Result], weights: Mapping[str, float]) -> "MixedResult":
        """Mix results.

        Raises:
            ValueError: They were not asked about the same.
        """
        first = next(iter(scenario_results.values()))
        told = {
            key: _agreed({name: world.source.get(key) for name, world in scenario_results.items()})
            for key in first.source
        }
        mixed = cls(
            coverages={},
            regions=first.regions,
            run=None,
            rigs=first.rigs,
            source={**told, "scenario": dict(weights)},
            reference_record=None,
            device=first.device,
            sensors=first.sensors,
            ego_outline_m=first.ego_outline_m if told["vehicle"] == first.source["vehicle"] else None,
            scenario_results=scenario_results,
            weights=weights,
        )
        _ = mixed.table  # what cannot be mixed is refused now
        return mixed

    @property
    def coverage(self) -> Coverage:
        """None.

        Raises:
            ValueError: Always: a mixture has numbers only.
        """
        raise ValueError(f"a mixture has no maps: use worlds[name].coverage, of {', '.join(self.scenario_results)}")

    @cached_property
    def mixtures(self) -> Mapping[str, CoverageMixture]:
        """Name of each rig -> its numbers, for any region, with what they become without one block after the other."""
        counted = [(name, weight, self.scenario_results[name]) for name, weight in self.weights.items() if weight > 0.0]
        rigs = counted[0][2].coverages
        return {
            rig: CoverageMixture({name: (weight, of.coverages[rig]) for name, weight, of in counted}) for rig in rigs
        }

    @cached_property
    def table(self) -> CoverageTable:
        """The numbers of the mixture, with errors, differences and marks."""
        shares = ", ".join(f"{name} {weight:.3g}" for name, weight in self.weights.items())
        note = (
            f"Weighted means over kinds of world: {shares}. These are given, not drawn: intervals are about chance "
            "within each of them, and say nothing of other kinds or other weights. What is unknown in one of them is "
            "unknown; maps are of one of them each."
        )
        of_kinds = merge_notes({name: world.notes for name, world in self.scenario_results.items()})
        return CoverageTable.from_coverages(self.mixtures, self.regions, [note, *of_kinds], self.source)

    @property
    def record(self) -> dict[str, Any]:
        """What stands in `summary.json`: the numbers of the mixture, and under `worlds` the record of each."""
        worlds = {name: {"weight": self.weights[name], **world.record} for name, world in self.scenario_results.items()}
        runs = [world.run for world in self.scenario_results.values() if world.run]
        duration_s = round(sum(run.duration_s for run in runs), 3) if runs else None
        skipped = [line for run in runs for line in run.skipped_frames]
        complete = all(run.is_complete for run in runs)
        run = {"duration_s": duration_s, "complete": complete, "skipped_frames": skipped}
        return {**super().record, **run, "scenarios": worlds}

    @property
    def tables(self) -> list[PageTable]:
        """Those of the mixture, then those of each kind of world."""
        each = {
            MIXTURE: build_result_tables(self.table),
            **{name: world.tables for name, world in self.scenario_results.items()},
        }
        return [replace(one, title=f"{name}: {one.title}".rstrip(": ")) for name, of in each.items() for one in of]

    def plot_maps(self, layer: str | None = None) -> Iterator[tuple[str, Figure]]:
        """Those of each kind of world; its name is the first part of the stems."""
        for name, world in self.scenario_results.items():
            yield from ((f"{name}/{stem}", figure) for stem, figure in world.plot_maps(layer))

    def save(self, folder: str | Path, *, file_kinds: str | Iterable[str] = FILES) -> list[Path]:
        """Write the files of each kind of world to a folder of its own, as `Result.save`, and those of the mixture.

        Args:
            folder: Where to write: `NAME/...`; `summary.csv`, with the rows of all worlds and of the mixture,
                `report.html` and `summary.json`.
            file_kinds: As in `Result.save`.
        """
        wanted, record = parse_file_kinds(file_kinds), self.record
        worlds = dict(zip(build_file_stems(list(self.scenario_results)), self.scenario_results.values(), strict=True))
        with AtomicOutput(Path(folder)) as written:
            with defer_signals():  # the numbers are safe before anything ends this
                for stem, world in worlds.items():
                    if "numbers" in wanted:
                        world.add_numbers(written, f"{stem}/")
                    written.add_text(f"{stem}/{SUMMARY}", json.dumps(world.record, indent=2, allow_nan=False) + "\n")
                if "numbers" in wanted:
                    written.add_text("summary.csv", self._csv())
                written.publish(record)
            for stem, world in worlds.items():
                world.add_pictures(written, wanted, f"{stem}/")
            if "page" in wanted:
                written.add_text("report.html", render_page(self.page))
            written.publish(record)
        return written.paths

    def _csv(self) -> str:
        tables = {**{name: world.table for name, world in self.scenario_results.items()}, MIXTURE: self.table}
        rows = [{"scenario": name, **row} for name, table in tables.items() for row in build_records(table)]
        columns = list(dict.fromkeys(chain.from_iterable(rows)))
        return format_csv([columns, *([row.get(column, "") for column in columns] for row in rows)])

    @property
    def _about(self) -> str:
        return f"Mixture of {', '.join(self.scenario_results)}: {', '.join(self.rigs)}"

    def __str__(self) -> str:
        tables = {**{name: world.table for name, world in self.scenario_results.items()}, MIXTURE: self.table}
        return "\n".join(f"{name}\n{RENDERERS['text'](table)}" for name, table in tables.items())


def _agreed(each: Mapping[str, Any]) -> object:
    """What all kinds of world say; else what each of them says."""
    said = list(each.values())
    if all(one == said[0] for one in said):
        return said[0]
    if isinstance(said[0], Mapping):  # of the rigs
        return {rig: _agreed({name: of.get(rig) for name, of in each.items()}) for rig in said[0]}
    return ", ".join(f"{name} {one}" for name, one in each.items())


def measure_scenarios(settings: Settings) -> MixedResult:
    """Measure in one kind of world after the other.

    `settings`: of `evaluate`, with several scenarios. ValueError: a recording among them, other regions in one than in
    another, processes that share the run, or observers; as `evaluate`.
    """
    assert settings.mixture is not None  # as its caller knows
    if settings.frames is not None:
        raise ValueError("scenario and frames exclude each other: a recording is measured apart")
    if settings.ranks or settings.observers:
        raise ValueError("several scenarios: observers, and processes that share a run, are for one at a time")
    tasks = {}
    for (name, (scenario, _)), stem in zip(
        settings.mixture.items(), build_file_stems(list(settings.mixture)), strict=True
    ):
        checkpoint = settings.checkpoint
        if checkpoint is not None:
            checkpoint = checkpoint if isinstance(checkpoint, Checkpoint) else Checkpoint(Path(checkpoint))
            checkpoint = checkpoint.in_folder(stem)
        of_one = replace(settings, scenario=scenario, checkpoint=checkpoint)
        tasks[name] = build_task(of_one), of_one  # all of them before the first is measured, which may take hours
    asked = [tasks[name][0].query_plan.regions for name, (_, weight) in settings.mixture.items() if weight > 0.0]
    if any(regions != asked[0] for regions in asked):
        raise ValueError(
            f"{', '.join(tasks)} cannot be mixed: the regions around their egos differ; give `vehicle`, or ask about "
            "the same"
        )
    worlds = {}
    for name in settings.mixture:
        worlds[name] = measure_coverage(*tasks.pop(name))
        if (run := worlds[name].run) is not None:
            run.raise_failure()
    return MixedResult.from_results(worlds, {name: weight for name, (_, weight) in settings.mixture.items()})
