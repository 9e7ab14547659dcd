"""Do tests notice? The code is changed in one place at a time, and the tests of its room should fail.

`python -m benchmarks.mutants [room ...] [--seed N] [--count N]`: places are drawn by the seed, from the modules of each
room. A mutant *survives* if all tests of its room pass. Some are equal to what they were made of, which no test can
tell: `EQUAL` has those that were looked at, with the reason. Kernels of numba run as the Python that they are.
"""

import argparse
import ast
import copy
import os
import random
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

from benchmarks.timing import table

ROOT = Path(__file__).parents[1]
# What is changed, and the tests that should notice.
ROOMS = {
    "coverage": (("coverage",), ("coverage",)),
    "neighbors": (("neighbors",), ("neighbors",)),
    "geometry": (("geometry",), ("geometry",)),
    "cameras": (("cameras",), ("cameras",)),
    "detection": (("detection",), ("detection",)),
    "simulation": (
        ("simulation/surface.py", "simulation/surface_points.py", "simulation/local_ground.py",
         "simulation/recorded_returns.py", "simulation/sweep.py", "simulation/raycaster.py"),
        ("simulation",),
    ),
    "evaluation": (
        ("evaluation/checkpoint.py", "evaluation/ranks.py"),
        ("evaluation/test_checkpoint.py", "evaluation/test_ranks.py"),
    ),
}  # fmt: skip
SWAPPED = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Div,
    ast.And: ast.Or, ast.Or: ast.And, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
RENAMED = {"min": "max", "max": "min", "all": "any", "any": "all", "minimum": "maximum", "maximum": "minimum",
           "floor": "ceil", "ceil": "floor", "cos": "sin", "sin": "cos"}  # fmt: skip
# Looked at, and the same as what they were made of: file, line as it is written, what it became.
EQUAL: dict[tuple[str, str], str] = {}
# Of unions of types, which fail where they are made.
OF_TYPES = re.compile(r"\|.*\b(None|str|int|float|bool|[A-Z]\w*)\b|\b(None|str|int|float|bool|[A-Z]\w*)\b.*\|")
# A test that hangs has noticed.
MOST_S = 300.0


class Mutant(NamedTuple):
    """A change: the file, its line, what stood there and stands there now, and the text of the whole file."""

    path: Path
    line: int
    before: str
    after: str
    text: str


def main(words):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rooms", nargs="*", choices=[*ROOMS, []])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=25, help="mutants of each room")
    asked = parser.parse_args(words)
    rows, survivors = [], []
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder)
        listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
        subprocess.run(["tar", "--null", "-T", "-", "-cf", f"{folder}/all.tar"], cwd=ROOT, input=listed, check=True)
        subprocess.run(["tar", "-xf", f"{folder}/all.tar"], cwd=tree, check=True)
        for room in asked.rooms or ROOMS:
            found = list(drawn(room, asked.count, asked.seed))
            survived = [mutant for mutant in found if passes(room, mutant, tree)]
            equal = [mutant for mutant in survived if (mutant.before, mutant.after) in EQUAL]
            killed, valid = len(found) - len(survived), len(found) - len(equal)
            rows.append((room, len(found), len(equal), killed, f"{100 * killed / max(valid, 1):.0f} %"))
            survivors += [mutant for mutant in survived if mutant not in equal]
    table(("room", "mutants", "equal", "killed", "of those not equal"), rows)
    if survivors:
        print()
        named = [(f"{one.path}:{one.line}", f"`{one.before}`", f"`{one.after}`") for one in survivors]
        table(("survived", "was", "became"), named)


def passes(room: str, mutant: Mutant, tree: Path) -> bool:
    """Whether all tests of a room pass with a change; it is undone after them."""
    target = tree / mutant.path
    whole = target.read_text(encoding="utf-8")
    target.write_text(mutant.text, encoding="utf-8")
    first = sorted((tree / "tests").glob(f"**/test_{target.stem}*.py"))
    tests = [str(path) for path in first] + [f"tests/{name}" for name in ROOMS[room][1]]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive", "PYTHONPATH": str(tree),
                   "PYTHONDONTWRITEBYTECODE": "1", "NUMBA_DISABLE_JIT": "1"}  # fmt: skip
    start_s = time.monotonic()
    try:
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
        done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, timeout=MOST_S, check=False)
        passed = done.returncode == 0
    except subprocess.TimeoutExpired:
        passed = False
    finally:
        target.write_text(whole, encoding="utf-8")
    words = f"{mutant.path}:{mutant.line} {mutant.before} -> {mutant.after}"
    ending = f"{'SURVIVED' if passed else 'killed'} in {time.monotonic() - start_s:.0f} s"
    print(f"{ending}: {words}", file=sys.stderr, flush=True)
    return passed


def drawn(room: str, count: int, seed: int) -> Iterator[Mutant]:
    """Mutants of a room, no two at one place."""
    paths = []
    for name in ROOMS[room][0]:
        path = ROOT / "torchcover" / name
        paths += [path] if path.suffix else sorted(path.rglob("*.py"))
    every = [(path, number) for path in paths for number in range(len(places(ast.parse(path.read_text("utf-8")))))]
    for path, number in random.Random(f"{room} {seed}").sample(every, min(count, len(every))):
        mutant = mutated(path, number, random.Random(f"{path.name} {number} {seed}"))
        if mutant is not None:
            yield mutant


def places(tree: ast.Module) -> list[tuple[ast.AST, str]]:
    """What can be changed: nodes and how, but for what is only told: annotations, docstrings, messages of errors."""
    told = set()
    for node in ast.walk(tree):
        hidden: list[ast.AST | None] = []
        if isinstance(node, ast.Raise | ast.Assert):
            hidden = [node]
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            every = (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs, node.args.vararg, node.args.kwarg)
            hidden = [node.returns, *node.decorator_list, *(one.annotation for one in every if one)]
        elif isinstance(node, ast.AnnAssign):
            hidden = [node.annotation]
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            hidden = [node]
        for one in hidden:
            told |= {id(each) for each in ast.walk(one)} if one is not None else set()
    return [(node, way) for node in ast.walk(tree) if id(node) not in told for way in ways_of(node)]


def ways_of(node: ast.AST) -> Iterator[str]:
    """How a node can be changed."""
    match node:
        case ast.Compare(ops=[operator]) if type(operator) in SWAPPED:
            yield "compare"
        case ast.BinOp() if type(node.op) in SWAPPED and not OF_TYPES.search(ast.unparse(node)):
            yield "operator"
        case ast.BoolOp():
            yield "operator"
        case ast.UnaryOp():
            yield "sign"
        case ast.Constant() if type(node.value) in (int, float, bool):
            yield "constant"
        case ast.AugAssign() | ast.Expr(value=ast.Call()):
            yield "drop"
        case ast.Call():
            yield from ways_of_call(node)


def ways_of_call(node: ast.Call) -> Iterator[str]:
    """How a call can be changed."""
    if name_of(node.func) in RENAMED:
        yield "name"
    if any(one.arg for one in node.keywords):
        yield "keyword"
    if len(node.args) > 1 and not any(isinstance(one, ast.Starred) for one in node.args[:2]):
        yield "swap"


def name_of(function: ast.expr) -> str:
    """What is called, without what it is a part of."""
    return ast.unparse(function).rpartition(".")[2]


def mutated(path: Path, number: int, draw: random.Random) -> Mutant | None:
    """The change of this number; None if it is none."""
    text = path.read_text(encoding="utf-8")
    node, way = places(ast.parse(text))[number]
    before, after = ast.unparse(node), changed(copy.deepcopy(node), way, draw)
    lines = [0, *accumulate(len(line.encode()) for line in text.splitlines(keepends=True))]
    start, stop = lines[node.lineno - 1] + node.col_offset, lines[node.end_lineno - 1] + node.end_col_offset
    whole = (text.encode()[:start] + after.encode() + text.encode()[stop:]).decode()
    try:
        compile(whole, str(path), "exec")
    except SyntaxError:  # within an f-string
        return None
    same = ast.dump(ast.parse(whole)) == ast.dump(ast.parse(text))
    return None if same else Mutant(path.relative_to(ROOT), node.lineno, before, after, whole)


def changed(node: ast.AST, way: str, draw: random.Random) -> str:  # noqa: C901  (a case each)
    """What stands in its place."""
    match way:
        case "compare":
            node.ops[0] = SWAPPED[type(node.ops[0])]()
        case "operator":
            node.op = SWAPPED[type(node.op)]()
        case "sign":
            node = node.operand
        case "constant" if isinstance(node.value, bool):
            node.value = not node.value
        case "constant" if isinstance(node.value, int):
            node.value += draw.choice((-1, 1))
        case "constant":
            node.value = 2.0 * node.value if node.value else 1.0
        case "name":
            node.func = ast.parse(ast.unparse(node.func).removesuffix(name_of(node.func)) + RENAMED[name_of(node.func)])
        case "keyword":
            node.keywords.remove(draw.choice([one for one in node.keywords if one.arg]))
        case "swap":
            node.args[:2] = node.args[1::-1]
        case "drop":
            return "pass"
    return ast.unparse(node) if isinstance(node, ast.Call | ast.Constant | ast.Name) else f"({ast.unparse(node)})"


if __name__ == "__main__":
    main(sys.argv[1:])
