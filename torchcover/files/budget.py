"""How much memory reading one file may take."""

import math
import os

VARIABLE = "TORCHCOVER_MAX_FILE_GB"
# A scan takes megabytes; a saved result with eight thresholds in the command line's grid, which is much, twice a
# thousand of them.
DEFAULT_GB = 2.0


class TooLargeError(ValueError):
    """Reading a file takes more memory than one may take."""


def check_memory(needed_bytes: int) -> None:
    """Refuse to read a file that needs more memory than one may take, before any of it is reserved.

    Args:
        needed_bytes: What reading it takes at its largest, the file's own bytes included where they are held.

    Raises:
        TooLargeError: More than 2 GB, or than the environment variable TORCHCOVER_MAX_FILE_GB says.

    Example:
        >>> check_memory(16 * 100_000)  # a scan
    """
    allowed_gb = _allowed_gb()
    if needed_bytes > allowed_gb * 1e9:
        needed_gb = f"{needed_bytes / 1e9:.3g}" if needed_bytes < 10**300 else "endless"
        raise TooLargeError(
            f"reading it takes {needed_gb} GB of memory, more than the {allowed_gb:g} GB that one file may take; "
            f"use a smaller one, or set the environment variable {VARIABLE}"
        )


def _allowed_gb() -> float:
    given = os.environ.get(VARIABLE)
    try:
        allowed_gb = DEFAULT_GB if given is None else float(given)
    except ValueError:
        allowed_gb = math.nan
    if not allowed_gb > 0:
        raise ValueError(f"the environment variable {VARIABLE} has to be a number of gigabytes; got {given!r}")
    return allowed_gb
