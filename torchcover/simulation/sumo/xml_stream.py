"""Parser of large XML files, tag by tag: SUMO's files may be larger than memory."""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NoReturn
from xml.parsers import expat

XmlAttributes = dict[str, str]


def read_chunks(path: Path, chunk_bytes: int = 1 << 18) -> Iterator[bytes]:
    """Yield the content of a file in chunks, for `parse_xml_stream`."""
    with path.open("rb") as file:
        while chunk := file.read(chunk_bytes):
            yield chunk


def parse_xml_stream(
    chunks: Iterable[bytes], on_start: Callable[[str, list[str]], None], on_end: Callable[[str], None] | None = None
) -> None:
    """Parse XML of any length without storing it.

    Args:
        chunks: Content of the file.
        on_start: Function that is called with the name of each element and with its attributes: name, value, name,
            value and so on. An exception ends the parsing.
        on_end: Function that is called with the name at the end of each element.

    Raises:
        ValueError: The content is not XML, or declares entities.

    Example:
        >>> parse_xml_stream([b"<a x='1'", b"><b/></a>"], lambda name, attributes: print(name, attributes))
        a ['x', '1']
        b []
    """

    # Entities may expand to any size or name other files.
    def reject_entity(*_: object) -> NoReturn:
        raise ValueError("an XML file without entities is needed")

    parser = expat.ParserCreate()
    parser.ordered_attributes = True
    parser.EntityDeclHandler = reject_entity
    parser.StartElementHandler = on_start
    parser.EndElementHandler = on_end
    try:
        for chunk in chunks:
            parser.Parse(chunk)
        parser.Parse(b"", True)
    except expat.ExpatError as error:
        raise ValueError(f"not XML ({error})") from error


def pair_attributes(attributes: list[str]) -> XmlAttributes:
    """Convert attributes from `parse_xml_stream` to a dict."""
    return dict(zip(attributes[::2], attributes[1::2], strict=True))
