"""YAML 1.2 without repeated keys and XML without entities, with limits of size and depth."""

import re
from collections.abc import Callable, Hashable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, ClassVar
from xml.etree import ElementTree

import yaml
from yaml.constructor import ConstructorError
from yaml.nodes import MappingNode, Node, ScalarNode

from torchcover.files.bad_file import check_memory, decode_utf8

TAG = "tag:yaml.org,2002:"
# Scalars of YAML 1.2 and JSON by type. YAML 1.1 would read 0100 as 64, 1:40 as 100, 1e-3 as a string and `on` as true.
# Python reads integers of at most 4,300 digits.
SCALAR_PATTERNS = {
    "null": r"~|null|Null|NULL|",
    "bool": r"true|True|TRUE|false|False|FALSE",
    "int": r"[-+]?(?:0|[1-9][0-9]{0,300})",
    "float": r"[-+]?(?:(?:0|[1-9][0-9]{0,300})(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?i:inf)|\.(?i:nan)",
}


def parse_yaml(text: str) -> Any:  # noqa: ANN401  (YAML has no static types)
    r"""Parse a YAML text to dicts, lists, str, int, float, bool and None.

    Scalars follow YAML 1.2; numbers of YAML 1.1 alone are strings. Anchors, aliases and `<<` are supported, and so are
    the matrix tag of OpenCV and its first line, `%YAML:1.0`.

    Args:
        text: One document of at most 1,000,000 characters, 200,000 values and 64 levels.

    Raises:
        ValueError: The text is not YAML, repeats a key, has another tag, is too long or too deep, or grows too large by
            aliases; the message has the line.

    Example:
        >>> parse_yaml("mount: {x_m: 1, z_m: 1e-1}\nname: on")
        {'mount': {'x_m': 1, 'z_m': 0.1}, 'name': 'on'}
    """
    return _load_text(text, yaml.load)


def parse_yaml_stream(text: str) -> list[Any]:
    """Parse all documents of a YAML text; empty documents are skipped.

    Args:
        text: As in `parse_yaml`, with any number of documents.

    Raises:
        ValueError: As in `parse_yaml`.
    """
    documents = _load_text(text, _load_all)
    return [document for document in documents if document is not None]


def _load_all(text: str, loader: type["_Loader"]) -> list[Any]:
    return list(yaml.load_all(text, loader))


def _load_text(text: str, load: Callable[[str, type["_Loader"]], Any]) -> Any:  # noqa: ANN401
    """Load a text of limited size and describe errors of the parser."""
    max_characters = 1_000_000  # far above hand-written files, and parsed in seconds
    if len(text) > max_characters:
        raise ValueError(f"not a YAML file of {max_characters:,} characters at most; it has {len(text):,}")
    if text.startswith("%YAML:"):  # the directive of OpenCV has a colon that YAML does not allow
        text = "#" + text
    try:
        return load(text, _Loader)  # a SafeLoader with fewer conversions
    except (yaml.YAMLError, ValueError) as error:
        reason = " ".join(str(error).replace('in "<unicode string>", ', "").split())
        raise ValueError(f"not a YAML file: {reason}") from error


def get_builtin_folder(kind: str) -> Path:
    """Return the folder of the built-in documents of a kind.

    Args:
        kind: "scenarios", "rigs", ...; the folders "road_users" and "published" contain tables.
    """
    package = Path(__file__).parents[1]
    # A wheel has the folder inside the package, a checkout has it next to the package.
    installed = package / "_datasets"
    return (installed if installed.is_dir() else package.parent / "datasets") / kind


@cache
def load_road_user_classes() -> Mapping[str, Mapping[str, Any]]:
    """Load the tables that map labels of recordings to road user classes, and describe these classes."""
    path = get_builtin_folder("road_users") / "classes.yaml"
    classes: dict[str, dict[str, Any]] = parse_yaml(path.read_text("utf-8"))
    return classes


def to_yaml(content: Mapping[str, Any]) -> str:
    """Convert a mapping of plain values to YAML that `parse_yaml` reads, with short lists and mappings on one line.

    Args:
        content: Mapping; its order is kept.

    Example:
        >>> print(to_yaml({"name": "roof", "mount": {"x_m": 0.5}}), end="")
        name: roof
        mount: {x_m: 0.5}
    """
    text: str = yaml.dump(
        dict(content), Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=118, allow_unicode=True
    )
    return text


class _Dumper(yaml.SafeDumper):
    """Dumper that quotes strings that YAML 1.1 or `parse_yaml` would read as numbers, booleans or null."""


class _Loader(yaml.SafeLoader):
    """Loader that counts nodes, rejects repeated keys, and converts scalars by `SCALAR_PATTERNS`."""

    yaml_implicit_resolvers: ClassVar[dict[Any, Any]] = {}  # type: ignore[misc]  # the stub has no class variable
    yaml_constructors: ClassVar[dict[Any, Any]] = {}

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = 0
        self._node_count = 0
        self._sizes: dict[int, int] = {}

    def compose_document(self) -> Node | None:
        """Compose a document; sizes of nodes are reset, since later nodes may reuse the ids of earlier ones."""
        self._sizes.clear()
        return super().compose_document()

    def compose_node(self, parent: Node | None, index: Any) -> Node | None:  # noqa: ANN401
        """Compose a node; fail beyond the limits of depth and of the number of nodes."""
        max_depth = 64  # the recursion limit of Python is reached near 300
        # Keys, values and lists, with aliases expanded: anchors that contain aliases double in size with every line.
        max_nodes = 200_000
        line = self.peek_event().start_mark.line + 1  # type: ignore[no-untyped-call]
        is_alias, count_before = self.check_event(yaml.AliasEvent), self._node_count
        self._depth += 1
        if self._depth > max_depth:
            raise ConstructorError(problem=f"more than {max_depth} lists and mappings within each other, line {line}")
        node = super().compose_node(parent, index)
        self._depth -= 1
        if is_alias and id(node) not in self._sizes:
            raise ConstructorError(problem=f"an anchor that holds itself, line {line}")
        self._node_count += self._sizes[id(node)] if is_alias else 1
        if self._node_count > max_nodes:
            raise ConstructorError(problem=f"more than {max_nodes:,} values, those of aliases included, line {line}")
        self._sizes[id(node)] = self._node_count - count_before
        return node

    def construct_mapping(self, node: MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        """Construct a dict without repeated keys; keys that `<<` adds may be overridden."""
        self._check_keys(node)
        return super().construct_mapping(node, deep=deep)

    def construct_yaml_map(self, node: MappingNode) -> Any:  # noqa: ANN401  (a generator, as PyYAML requires)
        content: dict[Hashable, Any] = {}
        yield content
        content.update(self.construct_mapping(node))

    def construct_number(self, node: ScalarNode) -> int | float:
        """Construct an int or a float."""
        kind = node.tag.removeprefix(TAG)
        if not re.fullmatch(SCALAR_PATTERNS[kind], node.value):
            raise ConstructorError(problem=f"{_quote(node.value)} is no {kind}, line {node.start_mark.line + 1}")
        if kind == "int":
            return int(node.value)
        return float(node.value.lower().replace(".inf", "inf").replace(".nan", "nan"))

    def reject_tag(self, node: Node) -> None:
        """Reject all other tags, such as dates and Python objects."""
        raise ConstructorError(problem=f"the tag {_quote(node.tag)} is not read, line {node.start_mark.line + 1}")

    def _check_keys(self, node: MappingNode) -> None:
        lines: dict[tuple[str, Any], int] = {}
        for key, _ in node.value:
            line = key.start_mark.line + 1
            name = (key.tag, key.value) if isinstance(key, ScalarNode) else ("", id(key))
            if name in lines:
                raise ConstructorError(
                    problem=f"the key {_quote(key.value)} is there twice, in line {lines[name]} and in line {line}; "
                    "keep one of them"
                )
            lines[name] = line


for _kind, _pattern in SCALAR_PATTERNS.items():
    _first_characters = {"null": ["~", "n", "N", ""], "bool": list("tTfF")}.get(_kind, list("-+0123456789."))
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(TAG + _kind, re.compile(f"^(?:{_pattern})$"), _first_characters)
_Loader.add_implicit_resolver(TAG + "merge", re.compile("^<<$"), ["<"])
for _kind in ("int", "float"):
    _Loader.add_constructor(TAG + _kind, _Loader.construct_number)
for _kind in ("null", "bool", "str", "seq"):
    _Loader.add_constructor(TAG + _kind, getattr(yaml.SafeLoader, f"construct_yaml_{_kind}"))
_Loader.add_constructor(TAG + "map", _Loader.construct_yaml_map)
_Loader.add_constructor(TAG + "opencv-matrix", _Loader.construct_yaml_map)
_Loader.add_constructor(None, _Loader.reject_tag)


def _quote(value: Any) -> str:  # noqa: ANN401
    """Quote at most 60 characters of a value for a message."""
    text = str(value)
    return repr(text if len(text) <= 60 else f"{text[:60]}...")


def parse_xml(path: Path) -> ElementTree.Element:
    """Parse an XML file to a tree of elements.

    Args:
        path: File in UTF-8.

    Raises:
        ValueError: The file is not XML in UTF-8, declares entities, or its tree would not fit into memory.
    """
    check_memory(20 * path.stat().st_size)  # elements take at most 20 times the size of their text
    text = decode_utf8(path.read_bytes())
    if "<!ENTITY" in text:
        raise ValueError("an XML file without entities is needed")
    return ElementTree.fromstring(text)  # does not load external resources
