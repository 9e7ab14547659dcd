"""XML without its traps: entities, which may name other files or grow without end, are refused."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NoReturn
from xml.etree import ElementTree
from xml.parsers import expat

from torchcover.files.bad_file import check_memory, decode

# A tree of elements takes about so many times the bytes of its text.
TREE_PER_BYTE = 20


def parse_xml(path: Path) -> ElementTree.Element:
    """The tree of an XML file.

    ValueError: not XML in UTF-8, it declares entities, or its tree would not fit into memory.
    """
    check_memory(TREE_PER_BYTE * path.stat().st_size)
    text = decode(path.read_bytes())
    if "<!ENTITY" in text:
        raise ValueError("an XML file without entities is needed")
    return ElementTree.fromstring(text)  # which resolves nothing that lies outside


def feed_xml(
    pieces: Iterable[bytes], start: Callable[[str, list[str]], None], end: Callable[[str], None] | None = None
) -> None:
    """Read XML that may be of any length, one tag after the other; nothing of it is kept.

    `start`: called with the name of each element, and with the names and values of its attributes in turn; what it
    raises ends the reading. `end`: called with the name at its end. ValueError: not XML, or it declares entities.

    Example:
        >>> feed_xml([b"<a x='1'", b"><b/></a>"], lambda name, attributes: print(name, attributes))
        a ['x', '1']
        b []
    """

    def refuse(*_: object) -> NoReturn:
        raise ValueError("an XML file without entities is needed")

    parser = expat.ParserCreate()
    parser.ordered_attributes = True
    parser.EntityDeclHandler = refuse
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    try:
        for piece in pieces:
            parser.Parse(piece)
        parser.Parse(b"", True)
    except expat.ExpatError as error:
        raise ValueError(f"not XML ({error})") from error
