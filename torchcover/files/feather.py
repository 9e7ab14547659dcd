"""Feather tables, for which pyarrow is needed."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from torchcover.files.bad_file import check_memory, reads


@reads("a feather table")
def read_feather(path: Path, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Read columns of a feather table.

    Args:
        path: The file.
        names: The columns.

    Raises:
        BadFileError: No such table, a column that is missing or has holes, or no rows.
        ImportError: pyarrow is not installed.
    """
    try:
        from pyarrow import feather
    except ImportError as error:
        raise ImportError(f"{path}: a feather table needs pyarrow: pip install 'torchcover[av2]'") from error
    check_memory(4 * path.stat().st_size)
    table = feather.read_table(path)
    table.validate(full=True)  # pyarrow believes the lengths and places in the file, and reads there
    missing = [name for name in names if name not in table.column_names]
    if missing:
        raise ValueError(f"the columns {', '.join(names)} are needed; {', '.join(missing)} are missing")
    if table.num_rows == 0:
        raise ValueError("a table without rows")
    holes = [name for name in names if table.column(name).null_count]
    if holes:
        raise ValueError(f"the columns {', '.join(holes)} have holes")
    return {name: table.column(name).to_numpy() for name in names}
