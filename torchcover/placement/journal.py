"""The evaluations of a search, written down one by one: what a search that was ended goes on from."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from torchcover.files import BadFileError, reads, write_durably
from torchcover.placement.evaluation import Evaluation
from torchcover.placement.scores import Scores

NAME = "evaluations.jsonl"


class Journal:
    """A file of JSON lines: first the settings of the search, then an evaluation each, on the disk before the next one.

    A line without an end was being written when the process was killed: it does not count.

    Args:
        path: The file; begun anew.
        settings: All that decides what is asked for.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any]) -> None:
        self.path = path
        text = json.dumps(dict(settings), allow_nan=False) + "\n"
        write_durably(path, lambda aside: aside.write_text(text, encoding="utf-8"))

    @classmethod
    def resumed(cls, path: Path, settings: Mapping[str, Any], like: Scores) -> tuple[Self, list[Evaluation]]:
        """Go on in a file.

        Args:
            path: The file.
            settings: Those of this search, which must be those of the file.
            like: What any rig scored at all instants.

        Raises:
            FileNotFoundError: No such file.
            BadFileError: Of another search, or not written by this class.
        """
        evaluations, length = _read(path, settings, like)
        journal = cls.__new__(cls)
        journal.path = path
        os.truncate(path, length)
        return journal, evaluations

    def add(self, evaluation: Evaluation) -> None:
        """Write one down; it is on the disk when this returns."""
        line = json.dumps(evaluation.record(), allow_nan=False) + "\n"
        with self.path.open("ab") as file:
            file.write(line.encode())
            file.flush()
            os.fsync(file.fileno())


@reads("the evaluations of a search")
def _read(path: Path, settings: Mapping[str, Any], like: Scores) -> tuple[list[Evaluation], int]:
    """The evaluations, and how many bytes hold them."""
    whole = path.read_bytes()
    whole = whole[: whole.rfind(b"\n") + 1]
    first, *lines = whole.decode().splitlines() or [""]
    _check_same(path, json.loads(first), settings)
    evaluations = [Evaluation.of_record(json.loads(line), like) for line in lines]
    if [one.number for one in evaluations] != list(range(len(evaluations))):
        raise ValueError("an evaluation is missing")
    return evaluations, len(whole)


def _check_same(path: Path, found: Mapping[str, Any], settings: Mapping[str, Any]) -> None:
    others = [
        f"{name} {found.get(name)!r}, not {value!r}" for name, value in settings.items() if found.get(name) != value
    ]
    if others:
        raise BadFileError(f"{path}: of another search: {'; '.join(others)}; choose another folder, or begin anew")
