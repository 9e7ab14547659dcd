"""YAML and XML without their traps: every key once, numbers that look like numbers, no entities, and an end."""

import re
from collections.abc import Callable, Hashable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, ClassVar
from xml.etree import ElementTree

import yaml
from yaml.constructor import ConstructorError
from yaml.nodes import MappingNode, Node, ScalarNode

from torchcover.files.bad_file import check_memory, decode

MAX_CHARACTERS = 1_000_000  # far above what people write, and read in seconds
# Keys, values and lists, each alias counted as what it stands for: anchors of anchors double with every line.
MAX_NODES = 200_000
MAX_DEPTH = 64  # of lists and mappings within each other; Python's own limit is near 300
MAX_QUOTED = 60  # characters of what arrived, in a message

TAG = "tag:yaml.org,2002:"
# As YAML 1.2 and JSON write them. YAML 1.1 would read 0100 as 64, 1:40 as 100, and 1e-3 and `on` as what they are not.
_WHOLE = r"(?:0|[1-9][0-9]{0,300})"  # Python reads no more than 4,300 digits
SCALARS = {
    "null": r"~|null|Null|NULL|",
    "bool": r"true|True|TRUE|false|False|FALSE",
    "int": rf"[-+]?{_WHOLE}",
    "float": rf"[-+]?(?:{_WHOLE}(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?i:inf)|\.(?i:nan)",
}


def parse_yaml(text: str) -> Any:  # noqa: ANN401  (YAML knows no types)
    r"""What a YAML text holds: dicts, lists, str, int, float, bool and None.

    Scalars are those of YAML 1.2; what looks like a number to YAML 1.1 alone is a string. Anchors, aliases and `<<` are
    read, and so are OpenCV's tag for matrices and its first line, `%YAML:1.0`.

    ValueError: not YAML, a key that is there twice, another tag, or a text that is too long, too deep or grows too
    large by its aliases; the message has the line.

    Example:
        >>> parse_yaml("mount: {x_m: 1, z_m: 1e-1}\nname: on")
        {'mount': {'x_m': 1, 'z_m': 0.1}, 'name': 'on'}
    """
    return _parse(text, yaml.load)


def _parse(text: str, load: Callable[[str, type["_Loader"]], Any]) -> Any:  # noqa: ANN401
    if len(text) > MAX_CHARACTERS:
        raise ValueError(f"not a YAML file of {MAX_CHARACTERS:,} characters at most; it has {len(text):,}")
    if text.startswith("%YAML:"):  # OpenCV's directive has a colon that YAML does not allow
        text = "#" + text
    try:
        return load(text, _Loader)  # a SafeLoader with fewer traps
    except (yaml.YAMLError, ValueError) as error:
        reason = " ".join(str(error).replace('in "<unicode string>", ', "").split())
        raise ValueError(f"not a YAML file: {reason}") from error


def parse_yaml_stream(text: str) -> list[Any]:
    """Read all documents of a YAML text, each as `parse_yaml` does; empty ones are left out.

    Raises:
        ValueError: As `parse_yaml`.
    """
    documents = _parse(text, lambda text, loader: list(yaml.load_all(text, loader)))
    return [document for document in documents if document is not None]


def builtin_folder(kind: str) -> Path:
    """Where the built-in documents of a kind lie.

    Args:
        kind: As `builtin_documents` takes it, or "road_users" and "published", which have tables.
    """
    package = Path(__file__).parents[1]
    # In a wheel the folder lies inside the package; in a checkout beside it.
    installed = package / "_datasets"
    return (installed if installed.is_dir() else package.parent / "datasets") / kind


@cache
def road_user_classes() -> Mapping[str, Mapping[str, Any]]:
    """What is said of road users by words of recordings, and by classes."""
    found: dict[str, dict[str, Any]] = parse_yaml((builtin_folder("road_users") / "classes.yaml").read_text("utf-8"))
    return found


def as_yaml(content: Mapping[str, Any]) -> str:
    """What `parse_yaml` reads as a mapping of plain values: keys in their order, short lists and mappings in one line.

    Example:
        >>> print(as_yaml({"name": "roof", "mount": {"x_m": 0.5}}), end="")
        name: roof
        mount: {x_m: 0.5}
    """
    text: str = yaml.dump(
        dict(content), Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=118, allow_unicode=True
    )
    return text


class _Dumper(yaml.SafeDumper):
    """Puts quotes around a text that would be a number, true or nothing to YAML 1.1 or to `parse_yaml`."""


class _Loader(yaml.SafeLoader):
    """Composes nodes that are counted, and resolves and constructs the scalars above."""

    yaml_implicit_resolvers: ClassVar[dict[Any, Any]] = {}  # type: ignore[misc]  # the stub knows no class variable
    yaml_constructors: ClassVar[dict[Any, Any]] = {}

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = 0
        self._nodes = 0
        self._sizes: dict[int, int] = {}

    def compose_document(self) -> Node | None:
        """A document; nodes of the one before, whose places in memory others may take, are forgotten."""
        self._sizes.clear()
        return super().compose_document()

    def compose_node(self, parent: Node | None, index: Any) -> Node | None:  # noqa: ANN401
        """A node; none that is too deep, and none that makes the document too large."""
        line = self.peek_event().start_mark.line + 1  # type: ignore[no-untyped-call]
        is_alias, before = self.check_event(yaml.AliasEvent), self._nodes
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise ConstructorError(problem=f"more than {MAX_DEPTH} lists and mappings within each other, line {line}")
        node = super().compose_node(parent, index)
        self._depth -= 1
        if is_alias and id(node) not in self._sizes:
            raise ConstructorError(problem=f"an anchor that holds itself, line {line}")
        self._nodes += self._sizes[id(node)] if is_alias else 1
        if self._nodes > MAX_NODES:
            raise ConstructorError(problem=f"more than {MAX_NODES:,} values, those of aliases included, line {line}")
        self._sizes[id(node)] = self._nodes - before
        return node

    def construct_mapping(self, node: MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        """A dict, if no key is there twice; what `<<` brings along may be."""
        self._check_keys(node)
        return super().construct_mapping(node, deep=deep)

    def construct_yaml_map(self, node: MappingNode) -> Any:  # noqa: ANN401  (a generator, as PyYAML wants it)
        content: dict[Hashable, Any] = {}
        yield content
        content.update(self.construct_mapping(node))

    def construct_number(self, node: ScalarNode) -> int | float:
        """An int or a float."""
        kind = node.tag.removeprefix(TAG)
        if not re.fullmatch(SCALARS[kind], node.value):
            raise ConstructorError(problem=f"{_quoted(node.value)} is no {kind}, line {node.start_mark.line + 1}")
        if kind == "int":
            return int(node.value)
        return float(node.value.lower().replace(".inf", "inf").replace(".nan", "nan"))

    def refuse(self, node: Node) -> None:
        """Any other tag: a date, a Python object."""
        raise ConstructorError(problem=f"the tag {_quoted(node.tag)} is not read, line {node.start_mark.line + 1}")

    def _check_keys(self, node: MappingNode) -> None:
        lines: dict[tuple[str, Any], int] = {}
        for key, _ in node.value:
            line = key.start_mark.line + 1
            name = (key.tag, key.value) if isinstance(key, ScalarNode) else ("", id(key))
            if name in lines:
                raise ConstructorError(
                    problem=f"the key {_quoted(key.value)} is there twice, in line {lines[name]} and in line {line}; "
                    "keep one of them"
                )
            lines[name] = line


for _kind, _pattern in SCALARS.items():
    _firsts = {"null": ["~", "n", "N", ""], "bool": list("tTfF")}.get(_kind, list("-+0123456789."))
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(TAG + _kind, re.compile(f"^(?:{_pattern})$"), _firsts)
_Loader.add_implicit_resolver(TAG + "merge", re.compile("^<<$"), ["<"])
for _kind in ("int", "float"):
    _Loader.add_constructor(TAG + _kind, _Loader.construct_number)
for _kind in ("null", "bool", "str", "seq"):
    _Loader.add_constructor(TAG + _kind, getattr(yaml.SafeLoader, f"construct_yaml_{_kind}"))
_Loader.add_constructor(TAG + "map", _Loader.construct_yaml_map)
_Loader.add_constructor(TAG + "opencv-matrix", _Loader.construct_yaml_map)
_Loader.add_constructor(None, _Loader.refuse)


def _quoted(value: Any) -> str:  # noqa: ANN401
    text = str(value)
    return repr(text if len(text) <= MAX_QUOTED else f"{text[:MAX_QUOTED]}...")


TREE_PER_BYTE = 20  # memory of a tree of elements for each byte of its text


def parse_xml(path: Path) -> ElementTree.Element:
    """The tree of an XML file.

    ValueError: not XML in UTF-8, it declares entities, or its tree would not fit into memory.
    """
    check_memory(TREE_PER_BYTE * path.stat().st_size)
    text = decode(path.read_bytes())
    if "<!ENTITY" in text:
        raise ValueError("an XML file without entities is needed")
    return ElementTree.fromstring(text)  # which resolves nothing that lies outside
