"""Result of a check of requirements: verdicts, tables and files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from torchcover import __version__
from torchcover.evaluation.requirements import Requirements
from torchcover.evaluation.verdicts import Verdict
from torchcover.files import AtomicOutput
from torchcover.report import PageTable, build_text_cells, to_json_record

HEADINGS = (
    "requirement",
    "",
    "",
    "worst value",
    "margin",
    "not met",
    "not decided",
    "total",
    "occupied",
    "worst location",
)


NOTE = (
    "A number with a confidence interval meets a bound if its whole 95 % interval does, and does not meet it if no "
    "part of the interval does; otherwise it is not decided, and more frames are needed. An unknown number is never "
    "met. These verdicts are geometry, and no homologation."
)


@dataclass(frozen=True)
class CheckResult:
    """Result of `check`.

    Args:
        requirements: The requirements.
        verdicts: Name of each rig -> its verdicts, in the order of the file.
        settings: Settings of the measurement, for `summary.json`.
    """

    requirements: Requirements
    verdicts: Mapping[str, Sequence[Verdict]]
    settings: Mapping[str, Any]

    @property
    def is_met(self) -> bool:
        """True if every rig meets every requirement; an undecided one is not met."""
        verdicts = chain.from_iterable(self.verdicts.values())
        return all(verdict.state == "met" for verdict in verdicts)

    @property
    def verdict(self) -> tuple[str, ...]:
        """Sentence with the number of requirements that each rig meets."""
        num_bounds, rig_texts = 0, []
        for rig, verdicts in self.verdicts.items():
            states = [verdict.state for verdict in verdicts]
            parts = [f"{rig} meets {states.count('met')}"]
            parts += [f"{states.count(state)} {state}" for state in ("not met", "not decided") if state in states]
            rig_texts.append(", ".join(parts))
            num_bounds = len(verdicts)
        return (f"Of the {num_bounds} bounds of {self.requirements.name}: {'; '.join(rig_texts)}.",)

    def build_tables(self) -> list[PageTable]:
        """Build one table for each rig, with the description of the requirements as a note."""
        scenarios = ", ".join(f"{kind} {name}" for kind, name in self.settings["scenarios"].items())
        notes = [f"Scenarios: {scenarios}.", *self.settings["notes"], NOTE]
        if self.requirements.description:
            notes.insert(0, self.requirements.description)
        tables = []
        for rig, verdicts in self.verdicts.items():
            rows = [build_text_cells(*_format_verdict(verdict)) for verdict in verdicts]
            tables.append(PageTable(f"{rig}: {self.requirements.name}", HEADINGS, rows, notes=notes))
        return tables

    @property
    def record(self) -> dict[str, Any]:
        """Content of `summary.json`."""
        rigs = {}
        for rig, verdicts in self.verdicts.items():
            rigs[rig] = [to_json_record(_build_verdict_record(verdict)) for verdict in verdicts]
        about = {"requirements": self.requirements.name, "torchcover": __version__, **self.settings}
        return {**about, "met": self.is_met, "rigs": rigs}

    @property
    def junit(self) -> str:
        """JUnit XML: a suite for each rig, a case for each bound; not met is a failure, not decided an error."""
        root = ElementTree.Element("testsuites", name=self.requirements.name)
        for rig, verdicts in self.verdicts.items():
            states = [verdict.state for verdict in verdicts]
            counts = {
                "tests": str(len(states)),
                "failures": str(states.count("not met")),
                "errors": str(states.count("not decided")),
            }
            suite = ElementTree.SubElement(root, "testsuite", {"name": rig, **counts})
            for verdict in verdicts:
                _add_junit_case(suite, rig, verdict)
        text = ElementTree.tostring(root, encoding="unicode", xml_declaration=True)
        # XML does not allow control characters, which names of other files may contain.
        return "".join(character if character.isprintable() or character == "\n" else " " for character in text)

    def save(self, folder: str | Path) -> list[Path]:
        """Write `junit.xml` and `summary.json`.

        Args:
            folder: Output folder; created if it does not exist.

        Returns:
            Paths of the files.
        """
        with AtomicOutput(Path(folder)) as output:
            output.add_text("junit.xml", self.junit)
            output.publish(self.record)
        return output.paths


def _add_junit_case(suite: ElementTree.Element, rig: str, verdict: Verdict) -> None:
    """Add the test case of one bound: a failure if it is not met, an error if it is not decided."""
    name = f"{verdict.requirement}: {verdict.bound.text}"
    case = ElementTree.SubElement(suite, "testcase", classname=rig, name=name)
    if verdict.state != "met":
        columns = zip(HEADINGS[3:], _format_verdict(verdict)[3:], strict=True)
        message = "; ".join(f"{heading}: {text}" for heading, text in columns)
        kind = "failure" if verdict.state == "not met" else "error"
        ElementTree.SubElement(case, kind, message=message).text = "\n".join(verdict.worst_locations)


def _build_verdict_record(verdict: Verdict) -> dict[str, Any]:
    """Build the JSON record of one bound."""
    bound_key = "min_value" if verdict.bound.is_minimum else "max_value"
    values = verdict._asdict()
    del values["requirement"], values["bound"]
    return {"requirement": verdict.requirement, "number": verdict.bound.key, bound_key: verdict.bound.value, **values}


def _format_verdict(verdict: Verdict) -> tuple[str, ...]:
    """Format the cells of one row, under `HEADINGS`."""
    interval = ""
    if verdict.high == np.inf:
        interval = " or more"
    elif verdict.low < verdict.high:
        interval = f" ({verdict.low:.4g} to {verdict.high:.4g})"
    value = "-" if np.isnan(verdict.value) else f"{verdict.value:.4g}{interval}"
    margin = "-" if np.isnan(verdict.margin) else f"{verdict.margin:+.4g}"
    location = verdict.worst_locations[0] if verdict.worst_locations else "none"
    return (
        verdict.requirement,
        verdict.bound.text,
        verdict.state,
        value,
        margin,
        str(verdict.not_met_count),
        str(verdict.undecided_count),
        str(verdict.total_count),
        str(verdict.occupied_count),
        location,
    )
