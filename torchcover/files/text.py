"""Text from files."""

from pathlib import Path

# A calibration has kilobytes; what is parsed slowly must not be long.
MAX_SHORT_BYTES = 1_000_000


def decode(data: bytes) -> str:
    """Decode UTF-8, with or without a byte order mark.

    Raises:
        ValueError: Not UTF-8.
    """
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"not text in UTF-8: byte {error.start} is 0x{data[error.start]:02x}") from error


def read_short_text(path: Path) -> str:
    """Text of a file that people write, or could have written.

    Raises:
        ValueError: More than a megabyte, or not UTF-8.
    """
    size_bytes = path.stat().st_size
    if size_bytes > MAX_SHORT_BYTES:
        raise ValueError(f"{size_bytes} bytes; at most {MAX_SHORT_BYTES} are read of such a file")
    return decode(path.read_bytes())
