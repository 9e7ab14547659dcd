"""Import cycles: modules, also inside a package, in functions and under `TYPE_CHECKING`, never import each other."""

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import torchcover


def list_imports(path, module):
    """List all imports of a file as (module, name); the name is empty for `import module`."""
    imports = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            imports += [(alias.name, "") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            parents = module.split(".")[: -node.level] if node.level else []
            source = ".".join([*parents, *filter(None, [node.module])])
            imports += [(source, alias.name) for alias in node.names]
    return imports


def build_import_graph(root):
    """Build the graph of a package: module -> modules that it imports.

    Names of a package lead to the module that defines them, by `__init__.py` or its stub `__init__.pyi`. Packages
    themselves are no modules of the graph, since a lazy one imports nothing.
    """
    paths = {".".join(path.relative_to(root.parent).with_suffix("").parts): path for path in root.rglob("*.py")}
    modules = {module for module in paths if not module.endswith(".__init__")}
    exports = {}
    for path in (*root.rglob("__init__.py"), *root.rglob("__init__.pyi")):
        package = ".".join(path.parent.relative_to(root.parent).parts)
        for source, name in list_imports(path, f"{package}.__init__"):
            exports[package, name] = source

    def find_module(source, name):
        if f"{source}.{name}" in modules:
            return f"{source}.{name}"
        exporter = exports.get((source, name), source)
        return source if exporter == source else find_module(exporter, name)

    graph = {}
    for module in modules:
        targets = {find_module(source, name) for source, name in list_imports(paths[module], module)}
        graph[module] = sorted((targets & modules) - {module})
    return graph


def find_cycle(graph):
    """Find one cycle of a graph: the modules along it, of which the first is also the last; empty without a cycle."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1][::-1]
    return []


def test_no_modules_import_each_other():
    cycle = find_cycle(build_import_graph(Path(torchcover.__file__).parent))
    assert not cycle, "these modules import each other: " + " -> ".join(cycle)


@pytest.mark.parametrize(
    "text",
    [
        "from package.low import b",
        "import package.low.b",
        "def compute():\n    from package.low.b import Value",
        "if TYPE_CHECKING:\n    from package.low import Value",
        "from package import Value",
        "from .low import Value",
    ],
)
def test_cycles_are_found_in_any_form(text, tmp_path):
    root = tmp_path / "package"
    (root / "low").mkdir(parents=True)
    (root / "__init__.py").write_text("from package.low import Value\n")
    (root / "low" / "__init__.py").write_text("")
    (root / "low" / "__init__.pyi").write_text("from .b import Value as Value\n")
    (root / "low" / "b.py").write_text("from package.a import Base\n")
    (root / "a.py").write_text("import math\n")
    assert find_cycle(build_import_graph(root)) == []
    (root / "a.py").write_text(text)
    cycle = find_cycle(build_import_graph(root))
    assert (cycle[0], set(cycle)) == (cycle[-1], {"package.a", "package.low.b"})
