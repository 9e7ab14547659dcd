"""Names mean one thing, and records stay as they are: what a reader has learnt in a room holds in all others."""

import ast
from collections import defaultdict
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "torchcover"
# Records that grow while they are made.
GROWING = {"RigMounts", "Run", "_Element", "_ObservationLoop"}


def public_classes(folder):
    """Name of each public class -> the files that define one."""
    found = defaultdict(list)
    for path in sorted(folder.rglob("*.py")):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                found[node.name].append(path.relative_to(folder).as_posix())
    return found


def test_no_two_public_classes_share_a_name():
    found = public_classes(PACKAGE)
    assert len(found) > 200
    assert {name: files for name, files in found.items() if len(files) > 1} == {}


def test_repeated_class_names_are_found(tmp_path):
    for file in ("one.py", "other.py"):
        Path(tmp_path, file).write_text("class Scan: ...\nclass _Own: ...\n", encoding="utf-8")
    assert public_classes(tmp_path) == {"Scan": ["one.py", "other.py"]}


def test_records_are_frozen():
    found = {}
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            for made in map(ast.unparse, node.decorator_list if isinstance(node, ast.ClassDef) else ()):
                if "dataclass" in made:
                    found[node.name] = made
    assert len(found) > 100
    assert {name for name, made in found.items() if "frozen=True" not in made} == GROWING
