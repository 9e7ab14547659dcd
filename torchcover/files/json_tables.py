"""Tables of a data set that is written as JSON: lists of rows with tokens."""

import json
from pathlib import Path
from typing import Any, NamedTuple

from torchcover.files.bad_file import check_memory, decode, reads

# Python's objects take about so many times the bytes of their text.
OBJECTS_PER_BYTE = 8


class JsonTable(NamedTuple):
    """A table. `rows`: as they were written; `by_token`: the same by their `token`."""

    path: Path
    rows: list[dict[str, Any]]
    by_token: dict[str, dict[str, Any]]

    def row(self, token: str) -> dict[str, Any]:
        """The row of a token."""
        if token not in self.by_token:
            raise ValueError(f"{self.path}: no row has the token {str(token)[:40]!r}, which another table names")
        return self.by_token[token]


@reads("a table of rows")
def read_json_table(path: Path) -> JsonTable:
    """Read a JSON list of objects. BadFileError: another content."""
    check_memory(OBJECTS_PER_BYTE * path.stat().st_size)
    rows = json.loads(decode(path.read_bytes()))
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise ValueError(f"a list of objects is needed; got {type(rows).__name__}")
    return JsonTable(path, rows, {row["token"]: row for row in rows if "token" in row})
