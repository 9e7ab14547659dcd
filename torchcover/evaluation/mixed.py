"""Rigs in several kinds of world, and in a mixture of them."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from torchcover.coverage import Coverage, Mixture
from torchcover.evaluation.checkpoint import Checkpoint
from torchcover.evaluation.measuring import measured
from torchcover.evaluation.result import Result
from torchcover.evaluation.settings import FILES, Settings, wanted_files
from torchcover.evaluation.task import task_of
from torchcover.files import Publication, csv_text
from torchcover.report import RENDERERS, CoverageTable, file_stems, table_dict
from torchcover.report.renderers.records import records_of

MIXTURE = "mixture"


@dataclass(frozen=True, eq=False, repr=False)
class MixedResult(Result):
    """What `evaluate` and `compare` return of several scenarios: the numbers of their mixture.

    Coverages, maps and pages are of one kind of world each: those of `worlds`.

    Args:
        worlds: By the name of the scenario, what was measured there: the same rigs in all of them.
        weights: By the same names, how much each counts in the mixture; they sum to 1.
    """

    worlds: Mapping[str, Result] = field(default_factory=dict)
    weights: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, worlds: Mapping[str, Result], weights: Mapping[str, float]) -> "MixedResult":
        """Mix results.

        Raises:
            ValueError: They were not asked about the same.
        """
        first = next(iter(worlds.values()))
        source = {**dict.fromkeys(first.source), "scenario": dict(weights)}
        mixed = cls(
            coverages={},
            regions=first.regions,
            run=None,
            rigs=first.rigs,
            source=source,
            reference_record=None,
            device=first.device,
            worlds=worlds,
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
        raise ValueError(f"a mixture has no maps: use worlds[name].coverage, of {', '.join(self.worlds)}")

    @cached_property
    def mixtures(self) -> Mapping[str, Mixture]:
        """Name of each rig -> its numbers, for any region, with what they become without one block after the other."""
        counted = [(weight, self.worlds[name]) for name, weight in self.weights.items() if weight > 0.0]
        rigs = counted[0][1].coverages
        return {rig: Mixture([(weight, world.coverages[rig]) for weight, world in counted]) for rig in rigs}

    @cached_property
    def table(self) -> CoverageTable:
        """The numbers of the mixture, with errors, differences and marks."""
        shares = ", ".join(f"{name} {weight:.3g}" for name, weight in self.weights.items())
        note = (
            f"Weighted means over kinds of world: {shares}. These are given, not drawn: intervals are about chance "
            "within each of them, and say nothing of other kinds or other weights."
        )
        return CoverageTable.of(self.mixtures, self.regions, [note])

    @property
    def record(self) -> dict[str, Any]:
        """What stands in `summary.json`: the numbers of the mixture, and under `worlds` the record of each."""
        complete = all(world.run is None or world.run.complete for world in self.worlds.values())
        worlds = {name: {"weight": self.weights[name], **world.record} for name, world in self.worlds.items()}
        return {"complete": complete, "worlds": worlds, "measure": self.table.measure, **table_dict(self.table)}

    def maps(self, *, errors: bool = False) -> Iterator[tuple[str, Figure]]:
        """Those of each kind of world; its name is the first part of the stems."""
        for name, world in self.worlds.items():
            yield from ((f"{name}/{stem}", figure) for stem, figure in world.maps(errors=errors))

    def save(self, folder: str | Path, *, files: str | Iterable[str] = FILES, error_maps: bool = False) -> list[Path]:
        """Write the files of each kind of world to a folder of its own, as `Result.save`, and those of the mixture.

        Args:
            folder: Where to write: `NAME/...`; `summary.csv`, with the rows of all worlds and of the mixture, and
                `summary.json`.
            files: As in `Result.save`.
            error_maps: Likewise.

        Returns:
            The files.
        """
        record, folders = self.record, file_stems(list(self.worlds))
        each = zip(folders, self.worlds.values(), strict=True)
        parts = [world.save(Path(folder) / name, files=files, error_maps=error_maps) for name, world in each]
        with Publication(Path(folder)) as written:
            if "numbers" in wanted_files(files):
                written.add_text("summary.csv", self._csv())
            written.publish(record)
        return [*chain.from_iterable(parts), *written.paths]

    def _csv(self) -> str:
        tables = {**{name: world.table for name, world in self.worlds.items()}, MIXTURE: self.table}
        rows = [{"world": name, **row} for name, table in tables.items() for row in records_of(table)]
        columns = list(dict.fromkeys(chain.from_iterable(rows)))
        return csv_text([columns, *([row.get(column, "") for column in columns] for row in rows)])

    def __repr__(self) -> str:
        tables = {**{name: world.table for name, world in self.worlds.items()}, MIXTURE: self.table}
        return "\n".join(f"{name}\n{RENDERERS['text'](table)}" for name, table in tables.items())


def measured_in_each(settings: Settings) -> MixedResult:
    """Measure in one kind of world after the other.

    Args:
        settings: Of `evaluate`, with several scenarios.

    Raises:
        ValueError: A recording among them, other regions in one than in another, processes that share the run, or
            observers; as `evaluate`.
    """
    assert settings.mixture is not None  # as its caller knows
    if settings.frames is not None:
        raise ValueError("scenario and frames exclude each other: a recording is measured apart")
    if settings.ranks or settings.observers:
        raise ValueError("several scenarios: observers, and processes that share a run, are for one at a time")
    tasks = {}
    for (name, (scenario, _)), stem in zip(settings.mixture.items(), file_stems(list(settings.mixture)), strict=True):
        checkpoint = settings.checkpoint
        if checkpoint is not None:
            checkpoint = checkpoint if isinstance(checkpoint, Checkpoint) else Checkpoint(Path(checkpoint))
            checkpoint = checkpoint.within(stem)
        of_one = replace(settings, scenario=scenario, checkpoint=checkpoint)
        tasks[name] = task_of(of_one), of_one  # all of them before the first is measured, which may take hours
    asked = [tasks[name][0].asked.regions for name, (_, weight) in settings.mixture.items() if weight > 0.0]
    if any(regions != asked[0] for regions in asked):
        raise ValueError(
            f"{', '.join(tasks)} cannot be mixed: the regions around their egos differ; give `vehicle`, or ask about "
            "the same"
        )
    worlds = {}
    for name in settings.mixture:
        worlds[name] = measured(*tasks.pop(name))
        if (run := worlds[name].run) is not None:
            run.raise_failure()
    return MixedResult.of(worlds, {name: weight for name, (_, weight) in settings.mixture.items()})
