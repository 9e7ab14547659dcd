"""Figures of the language of the package: each may improve and must not get worse.

The limits are the values of the last change. A change that improves a figure lowers (or raises) its limit.
"""

import ast
import re
from itertools import chain
from pathlib import Path
from tokenize import COMMENT, DEDENT, ENDMARKER, INDENT, NEWLINE, NL, TokenInfo, generate_tokens

import pytest

ROOT = Path(__file__).parents[1]
MAX_TEST_NAME_WORDS = 8
LIMITS = {
    "functions that begin with a verb (%)": (">=", 95.0),
    "names that name nothing (%)": ("<=", 0.2),
    "names with a word that the glossary replaces (%)": ("<=", 0.05),
    "texts that open with a riddle (%)": ("<=", 0.3),
    "texts with a phrase that no engineer writes (%)": ("<=", 0.4),
    "constants per 1,000 code lines": ("<=", 10.5),
    "constants assigned in tuples": ("<=", 0.0),
    "comprehensions, lambdas, map, filter per 1,000 code lines": ("<=", 45.0),
    "public functions that document their parameters (%)": (">=", 83.0),
    "docstrings and comments per 1,000 code lines": (">=", 129.0),
}

# First words of functions, names that name nothing, and words that the glossary replaces.
VERBS, VAGUE_NAMES, REPLACED_WORDS = (
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
NO_TEXT = re.compile(r"$|!|noqa|type:|pragma|fmt:")  # comments for tools
LAYOUT = {COMMENT, NL, NEWLINE, INDENT, DEDENT, ENDMARKER}
Documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp, ast.Lambda)


class Figures:
    """Counts over all files of a package."""

    def __init__(self, folder: Path) -> None:
        self.code_lines = self.functions = self.verbs = 0
        self.variables = self.vague_variables = self.names = self.replaced_names = 0
        self.constants = self.tuples = self.comprehensions = self.public_functions = self.documented_functions = 0
        self.texts: list[str] = []
        for path in sorted(folder.rglob("*.py")):
            self._add_file(path.read_text(encoding="utf-8"))

    def _add_file(self, source: str) -> None:
        tree = ast.parse(source)
        docstring_lines: set[int] = set()
        for node in ast.walk(tree):
            self._add_node(node)
            if isinstance(node, Documented) and (docstring := ast.get_docstring(node)):
                docstring_lines.update(range(node.body[0].lineno, node.body[0].end_lineno + 1))
                self.texts.append(docstring.split("\n\n")[0].replace("\n", " "))
        code_lines: set[int] = set()
        for token in generate_tokens(iter(source.splitlines(keepends=True)).__next__):
            if token.type not in LAYOUT:
                code_lines.update(range(token.start[0], token.end[0] + 1))
            elif token.type == COMMENT:
                self._add_comment(token)
        self.code_lines += len(code_lines - docstring_lines)

    def _add_comment(self, token: TokenInfo) -> None:
        text = token.string.lstrip("#: ").strip()
        if not NO_TEXT.match(text):
            self.texts.append(text)

    def _add_node(self, node: ast.AST) -> None:
        is_call = isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("map", "filter")
        self.comprehensions += is_call or isinstance(node, COMPREHENSIONS)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            self._add_function(node)
        if isinstance(node, ast.Module | ast.ClassDef):
            for statement in node.body:
                constant_count = count_constants(statement)
                self.constants += constant_count
                self.tuples += constant_count > 1
        if isinstance(node, ast.ClassDef):
            self._add_name(node.name)
        if isinstance(node, ast.arg):
            self._add_variable(node.arg)
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            self._add_variable(node.id)
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            self._add_name(node.attr)

    def _add_function(self, node: ast.FunctionDef | ast.AsyncFunctionDef) -> None:
        self._add_name(node.name)
        parameters = {argument.arg for argument in node.args.args + node.args.kwonlyargs} - {"self", "cls"}
        if not node.name.startswith("_") and parameters:
            self.public_functions += 1
            self.documented_functions += "Args:" in (ast.get_docstring(node) or "")
        decorators = {ast.unparse(decorator).split(".")[-1] for decorator in node.decorator_list}
        if not node.name.startswith("__") and not decorators & {"property", "cached_property", "setter"}:
            self.functions += 1
            self.verbs += split_words(node.name)[0] in VERBS

    def _add_variable(self, name: str) -> None:
        self.variables += 1
        self.vague_variables += name.strip("_") in VAGUE_NAMES
        self._add_name(name)

    def _add_name(self, name: str) -> None:
        self.names += 1
        self.replaced_names += not REPLACED_WORDS.isdisjoint(split_words(name))

    def compute_values(self) -> dict[str, float]:
        """Compute the figures by name, as in `LIMITS`."""
        thousands, text_count = self.code_lines / 1000, len(self.texts)
        riddles = sum(RIDDLES.match(text) is not None for text in self.texts)
        phrases = sum(PHRASES.search(text) is not None for text in self.texts)
        return {
            "functions that begin with a verb (%)": 100 * self.verbs / self.functions,
            "names that name nothing (%)": 100 * self.vague_variables / self.variables,
            "names with a word that the glossary replaces (%)": 100 * self.replaced_names / self.names,
            "texts that open with a riddle (%)": 100 * riddles / text_count,
            "texts with a phrase that no engineer writes (%)": 100 * phrases / text_count,
            "constants per 1,000 code lines": self.constants / thousands,
            "constants assigned in tuples": self.tuples,
            "comprehensions, lambdas, map, filter per 1,000 code lines": self.comprehensions / thousands,
            "public functions that document their parameters (%)": (
                100 * self.documented_functions / self.public_functions
            ),
            "docstrings and comments per 1,000 code lines": text_count / thousands,
        }


def split_words(name: str) -> list[str]:
    """Split a name in snake case or camel case into lowercase words."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).strip("_").lower().split("_")


def count_constants(statement: ast.stmt) -> int:
    """Count the names in upper case that a statement of a module or class assigns."""
    targets = []
    if isinstance(statement, ast.Assign):
        targets = statement.targets
    elif isinstance(statement, ast.AnnAssign):
        targets = [statement.target]
    nodes = chain.from_iterable(ast.walk(target) for target in targets)
    return sum(isinstance(node, ast.Name) and node.id.strip("_").isupper() for node in nodes)


def find_long_test_names(folder: Path) -> list[str]:
    """Find tests whose names have more than `MAX_TEST_NAME_WORDS` words after `test_`."""
    names = []
    for path in sorted(folder.glob("**/test_*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            is_test = isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
            if is_test and node.name.count("_") > MAX_TEST_NAME_WORDS:
                names.append(f"{path.relative_to(folder)}: {node.name}")
    return names


@pytest.fixture(scope="module")
def values() -> dict[str, float]:
    return Figures(ROOT / "torchcover").compute_values()


@pytest.mark.parametrize("name", LIMITS)
def test_figure_is_within_its_limit(values, name):
    direction, limit = LIMITS[name]
    assert values[name] >= limit if direction == ">=" else values[name] <= limit


def test_names_of_tests_are_short():
    long_names = find_long_test_names(ROOT / "tests")
    assert not long_names, "\n".join(long_names)


def test_figures_of_a_small_package(tmp_path):
    Path(tmp_path, "module.py").write_text(
        '"""Whoever reads this."""\n\nA, B = 1, 2\n\n\nclass Mover:\n    C: int = 3\n\n\ndef told(found):\n'
        '    """Double it.\n\n    Args:\n        found: Number.\n    """\n'
        "    return [2 * one for one in map(abs, found)]  # so many\n"
    )
    figures = Figures(tmp_path)
    assert (figures.code_lines, figures.names, figures.variables) == (5, 7, 5)
    expected = {
        "functions that begin with a verb (%)": 0,
        "names that name nothing (%)": 40,
        "names with a word that the glossary replaces (%)": 200 / 7,
        "texts that open with a riddle (%)": 100 / 3,
        "texts with a phrase that no engineer writes (%)": 100 / 3,
        "constants per 1,000 code lines": 600,
        "constants assigned in tuples": 1,
        "comprehensions, lambdas, map, filter per 1,000 code lines": 400,
        "public functions that document their parameters (%)": 100,
        "docstrings and comments per 1,000 code lines": 600,
    }
    assert figures.compute_values() == pytest.approx(expected)
    assert expected.keys() == LIMITS.keys()


def test_a_long_test_name_is_found(tmp_path):
    names = ("test_one_two_three_four_five_six_seven_eight", "test_one_two_three_four_five_six_seven_eight_nine")
    Path(tmp_path, "test_names.py").write_text("".join(f"def {name}(): ...\n" for name in names))
    assert find_long_test_names(tmp_path) == [f"test_names.py: {names[1]}"]
