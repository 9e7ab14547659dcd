"""What defines a run: two of the same identity give the same numbers, to the last bit."""

import hashlib
import json
from collections.abc import Mapping

from torchcover import __version__
from torchcover.evaluation.observers import AnyObserver
from torchcover.evaluation.settings import Settings
from torchcover.evaluation.task import Task
from torchcover.simulation import Asked

# Longer ones are told by their hash.
MAX_TOLD = 40


def run_identity(task: Task, settings: Settings, others: Mapping[str, AnyObserver], ranks: int = 1) -> dict[str, str]:
    """All that the result of a run depends on, by name: not the steps, of which there may be more later, nor who works.

    Args:
        task: What is measured.
        settings: How.
        others: The user's own observers.
        ranks: How many processes share the run; each has its own part of it.

    Returns:
        Name -> what it is, or a hash of it.

    Raises:
        FileNotFoundError: A file that a document names is missing.
    """
    kinds = {name: f"{type(one).__module__}.{type(one).__qualname__}" for name, one in others.items()}
    everything = {
        "torchcover": __version__,
        **task.frames.content,
        "rigs": task.rigs,
        **_asked(task.asked),
        "thresholds": settings.thresholds,
        "aggregations": settings.aggregations,
        "estimate": settings.estimate,
        "redundancy": settings.redundancy,
        "target_error": settings.target_error,
        "observers": kinds,
        "ranks": ranks,
    }
    return {name: _told(value) for name, value in everything.items()}


def differences(here: Mapping[str, str], there: Mapping[str, str]) -> str:
    """What two runs differ in, in words; empty where they do not.

    Example:
        >>> differences({"seed": "0", "scenario": "#17"}, {"seed": "1", "scenario": "#4"})
        'scenario (other content), seed (1 there, 0 here)'
    """
    names = [name for name in sorted(here.keys() | there.keys()) if here.get(name) != there.get(name)]
    return ", ".join(f"{name} {_change(here.get(name, 'none'), there.get(name, 'none'))}" for name in names)


def _asked(asked: Asked) -> dict[str, object]:
    grid = asked.grid
    return {
        "cell_m": grid.cell,
        "grid": [grid.x, grid.y],
        "heights": list(grid.heights.items()),
        "regions": [[region.name, region.x, region.y, region.corners_m] for region in asked.regions],
    }


def _change(here: str, there: str) -> str:
    return "(other content)" if "#" in (here[0], there[0]) else f"({there} there, {here} here)"


def _told(value: object) -> str:
    text = json.dumps(value, sort_keys=True, default=repr)
    return text if len(text) <= MAX_TOLD else f"#{hashlib.sha256(text.encode()).hexdigest()}"
