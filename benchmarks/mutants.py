"""Do tests notice? The code is changed in one place at a time, and the tests of its room should fail.

`python -m benchmarks.mutants [room ...] [--seed N] [--count N]`: places are drawn by the seed, from the modules of each
room, which pass without a change. A mutant *survives* if all of them pass. Some are equal to what they were made of,
which no test can tell: `EQUAL` has those that were looked at, with the reason. Kernels of numba are compiled again.
"""

import argparse
import ast
import copy
import json
import multiprocessing
import os
import random
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from itertools import accumulate, count
from multiprocessing.forkserver import _forkserver
from pathlib import Path
from typing import NamedTuple

import pytest

from benchmarks.timing import table

ROOT = Path(__file__).parents[1]
# What is changed, and the tests that should notice.
ROOMS = {
    "coverage": (("coverage",), ("coverage", "evaluation/test_bodies.py", "evaluation/test_mixed.py")),
    "neighbors": (("neighbors",), ("neighbors",)),
    "geometry": (("geometry",), ("geometry",)),
    "cameras": (("cameras",), ("cameras",)),
    "detection": (("detection",), ("detection", "frames/test_visible_targets.py")),
    "simulation": (
        ("simulation/surface.py", "simulation/surface_points.py", "simulation/local_ground.py",
         "simulation/recorded_returns.py", "simulation/sweep.py", "simulation/raycaster.py"),
        tuple(f"simulation/test_{name}.py" for name in (
            "surface_reference", "local_ground", "recorded_returns", "sweep", "raycaster", "sound", "returns",
            "visible_area", "spared_rays", "simulator", "mounts",
        )),
    ),
    "evaluation": (
        ("evaluation/checkpoint.py", "evaluation/ranks.py"),
        ("evaluation/test_checkpoint.py", "evaluation/test_ranks.py"),
    ),
}  # fmt: skip
OF_ALL = ("test_names.py",)
SWAPPED = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Div,
    ast.And: ast.Or, ast.Or: ast.And, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
RENAMED = {"min": "max", "max": "min", "all": "any", "any": "all", "minimum": "maximum", "maximum": "minimum",
           "floor": "ceil", "ceil": "floor", "cos": "sin", "sin": "cos"}  # fmt: skip
# Whose arguments may come in any order.
COMMUTATIVE = ("min", "max", "minimum", "maximum", "equal", "promote_types")
# Looked at, and the same as what they were made of: file, line, what became of it; and why.
EQUAL = {
    ("redundancy.py", "for radius, *others in zip(*map(_without_each, of_sensors), strict=True):",
     "zip(*map(_without_each, of_sensors))"): "each has a row a sensor",
    ("packets.py", "better = (squared < least) | ((squared == least) & (index < found[i]))",
     "(index <= found[i])"): "at equal indices nothing changes",
    ("packets.py", "boxes[node, axis + 3] = max(boxes[left, axis + 3], boxes[right, axis + 3])",
     "(axis - 3)"): "of six columns the third from the end is the fourth",
    ("packets.py", "around[axis + 3] = max(around[axis + 3], value)",
     "(axis - 3)"): "of six numbers the third from the end is the fourth",
    ("kdtree.py", "_, index = KDTree(coordinates, leafsize=leaf).query(np.ascontiguousarray(query.numpy()), "
     "distance_upper_bound=bound)", "KDTree(coordinates)"): "only decides about the speed",
    ("warp.py", "least = bound + (x - x)", "(bound - (x - x))"): "nothing is added",
    ("warp.py", "node = 0", "-1"): "the walk ends at either",
    ("choice.py", "_search_of(backend)(point, point, 1.0, 1.0)", "2.0"): "a point that is asked for itself",
    ("compiled.py", "return numba.njit(signature, cache=True, **options)(function)  # type: ignore[no-any-return]",
     "numba.njit(signature, **options)"): "compiled anew by each process",
    ("packets.py", "nearer, as_near = np.int32(0), np.int32(0)", "1"): "more boxes are looked into for one answer",
    ("valid_region.py", "_PLANE_RADII = np.concatenate([np.tan(np.linspace(0.0, np.pi / 2, 512, endpoint=False)), "
     "np.geomspace(400.0, 1e8, 32)])", "513"): "one radius more is looked at",
    ("raycaster.py", "scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))",
     "4"): "a ray to begin with, whose answer nobody looks at",
    ("rigid.py", "np.matmul(points_m[rows].astype(np.float64, copy=False) + shift, rotation.T, out=moved[rows])",
     "points_m[rows].astype(np.float64)"): "a copy more, of the same numbers",
    ("query.py", "memory_mb: float = 256.0,", "512.0"): "only decides about the memory",
    ("query.py", "return parts[0] if len(parts) == 1 else Nearest(*map(torch.cat, zip(*parts, strict=True)))",
     "-1"): "the only one is the last one",
    ("query.py", "return parts[0] if len(parts) == 1 else Nearest(*map(torch.cat, zip(*parts, strict=True)))",
     "False"): "each has a distance and an index",
    ("visibility.py", "steps = (torch.arange(SIDE_POINTS, device=number.device).double() + 0.5) * 2 / SIDE_POINTS - 1",
     "torch.arange(SIDE_POINTS)"): "the same on a CPU; tests that need a GPU notice",
    ("warp.py", "wp.overload(_walk, [_floats, _floats, _integers, _floats, _integers, _scalar, _integers])",
     "pass"): "compiled when it is used first, in two modules",
    ("visibility.py", "side_m2 = 4 * half_m[facing, one] * half_m[facing, other]",
     "5"): "sides of a box are only weighed against each other",
    ("cdist.py", "closer = distance < best", "(distance <= best)"): "of points as near any is right",
    ("warp.py", "wp.config.quiet = True", "False"): "asked by older Warps alone",
    ("box_tree.py", "scale = (AXIS_CELLS / extent).nan_to_num(0.0, posinf=0.0)",
     "1.0"): "points that are all one are in the first cell by any scale, and no quotient is NaN",
    ("packets.py", "last = -1", "0"): "the first packet begins with the first leaf, once all the same",
    ("trajectory.py", "return max(after - 1, 0), max(after - 1, 0), 0.0",
     "1.0"): "between a pose and itself lies no other",
    ("height_field.py", "left_m, layers = heights_m - base(across_m), HeightField(np.zeros(2), np.zeros((2, 2)), 1.0)",
     "2.0"): "0 everywhere, whatever its squares",
    ("voxel_walk.py", "way = np.asarray(directions, dtype=np.float64)",
     "np.asarray(directions)"): "all that they are combined with is float64",
    ("lens.py", "near_real = np.abs(roots.imag) < 1e-6 * (1.0 + np.abs(roots.real))",
     "2.0"): "a radius more is looked at",
    ("mixture.py", "known_cells = round(sum(weight * row.known_cells for weight, row in zip(weights, rows, "
     "strict=True)))", "False"): "each part has a row",
    ("checkpoint.py", "np.lib.format.write_array(member, array, allow_pickle=False)",
     "True"): "arrays of bytes and of text are written, which need no pickle",
    ("ranks.py", "while not self.store.check(keys) and time.monotonic() < end_s:",
     "(time.monotonic() <= end_s)"): "the clock does not stand at that very moment",
    ("ranks.py", "EVERYBODY = -1", "1"): "rank 0, which writes to everybody, writes to no single rank",
    ("recall.py", "for (name, given), highest in zip(borders.items(), (1.0, math.inf), strict=True):",
     "zip(borders.items(), (1.0, math.inf))"): "there are always two",
}  # fmt: skip
# Of unions of types, which fail where they are made.
OF_TYPES = re.compile(r"\|.*\b(None|str|int|float|bool|[A-Z]\w*)\b|\b(None|str|int|float|bool|[A-Z]\w*)\b.*\|")
# A test that hangs has noticed: it takes this many times what all tests take without a change.
MOST_TIMES = 3.0
# Slower tests come last.
SLOW_S = 1.0
TIMES_S = count(1_000_000_000)
# What all tests load, once.
SERVER = multiprocessing.get_context("forkserver")
LOADED = ["kornia", "lightning", "matplotlib.pyplot", "numba", "pydantic", "pytest", "scipy", "torch",
          "torchmetrics", "trimesh", "typer"]  # fmt: skip


class Mutant(NamedTuple):
    """A change: the file, its line, what stood there and stands there now, and the text of the whole file."""

    path: Path
    line: int
    before: str
    after: str
    text: str

    @property
    def key(self) -> tuple[str, str, str]:
        """What `EQUAL` knows it by."""
        line = (ROOT / self.path).read_text(encoding="utf-8").splitlines()[self.line - 1]
        return self.path.name, line.strip(), self.after


def main(words):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rooms", nargs="*", choices=[*ROOMS, []])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=25, help="mutants of each room")
    asked = parser.parse_args(words)
    rows, survivors, every_equal = [], [], []
    os.environ |= {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}
    SERVER.set_forkserver_preload(LOADED)
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder)
        listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
        subprocess.run(["tar", "--null", "-T", "-", "-cf", f"{folder}/all.tar"], cwd=ROOT, input=listed, check=True)
        subprocess.run(["tar", "-xf", f"{folder}/all.tar"], cwd=tree, check=True)
        for room in asked.rooms or ROOMS:
            found = list(drawn(room, asked.count, asked.seed))
            kept = tree / "tests.json"
            kept.unlink(missing_ok=True)
            start_s = time.monotonic()
            if told := failures(room, "", tree):
                sys.exit(f"tests of {room} fail without a change:\n{told}")
            most_s = MOST_TIMES * (time.monotonic() - start_s)
            survived = [mutant for mutant in found if survives(room, mutant, tree, most_s)]
            equal = [one for one in survived if one.key in EQUAL]
            killed, others = len(found) - len(survived), len(found) - len(equal)
            rows.append((room, asked.seed, len(found), len(equal), killed, f"{100 * killed / max(others, 1):.0f} %"))
            survivors += [(*cells(one), "") for one in survived if one not in equal]
            every_equal += [(*cells(one), EQUAL[one.key]) for one in equal]
    _forkserver._stop()  # nobody else waits for it, and its processor time would be nobody's
    table(("room", "seed", "valid", "equal", "killed", "of those not equal"), rows)
    if shown := survivors + every_equal:
        print()
        table(("not killed", "was", "became", "equal because"), shown)


def cells(mutant: Mutant) -> list[str]:
    """A change as cells of a table."""
    texts = (" ".join(text.replace("|", r"\|").split()) for text in (mutant.before, mutant.after))
    return [f"{mutant.path}:{mutant.line}", *(f"`{text}`" for text in texts)]


def survives(room: str, mutant: Mutant, tree: Path, most_s: float) -> bool:
    """Whether all tests of a room pass with a change; it is undone after them."""
    target, start_s = tree / mutant.path, time.monotonic()
    within = f"{mutant.path}:{function_at(mutant)}"
    whole = target.read_text(encoding="utf-8")
    write(target, mutant.text)
    if target.stem == "compiled":  # what others were compiled with
        for kept in tree.rglob("*.nbi"):
            kept.unlink()
    try:
        survived = not failures(room, within, tree, most_s)
    finally:
        write(target, whole)
    words = f"{mutant.path}:{mutant.line} {mutant.before} -> {mutant.after}"
    ending = f"{'SURVIVED' if survived else 'killed'} in {time.monotonic() - start_s:.0f} s"
    print(f"{ending}: {words}", file=sys.stderr, flush=True)
    return survived


def write(target: Path, text: str) -> None:
    """Write a module at a time at which none was written before, as what was compiled is known by."""
    target.write_text(text, encoding="utf-8")
    os.utime(target, (at_s := next(TIMES_S), at_s))


def function_at(mutant: Mutant) -> str:
    """The name of the innermost function that a change is in; of the module if in none."""
    functions = (one for one in ast.walk(ast.parse(mutant.text)) if isinstance(one, ast.FunctionDef))
    around = [one for one in functions if one.lineno <= mutant.line <= one.end_lineno]
    return max(around, key=lambda one: one.lineno).name if around else "<module>"


def failures(room: str, within: str, tree: Path, most_s: float | None = None) -> str:
    """What the tests of a room print if they do not pass, first those that call what is within; else nothing."""
    printed = tree / "printed.txt"
    tests = [f"tests/{name}" for name in (*ROOMS[room][1], *OF_ALL)]
    run = SERVER.Process(target=tested, args=(str(tree), str(printed), tests, within))
    run.start()
    run.join(most_s)
    if run.is_alive():
        run.kill()
        run.join()
        return "too slow"
    return printed.read_text(encoding="utf-8", errors="replace") if run.exitcode else ""


def tested(tree: str, printed: str, tests: list[str], within: str) -> None:
    """Run tests until the first fails, in a process that has loaded the packages of others but nothing of ours."""
    output = os.open(printed, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    os.chdir(tree)
    sys.path.insert(0, tree)
    multiprocessing.set_start_method(None, force=True)  # that of a process that nobody serves
    for name in [name for name in sys.modules if name.split(".")[0] in ("benchmarks", "tests", "torchcover")]:
        del sys.modules[name]
    order = Likeliest(Path(tree, "tests.json"), within)
    os._exit(pytest.main(["-x", "-q", "-p", "no:cacheprovider", *tests], plugins=[order]))


class Likeliest:
    """Run the tests first that call a changed function, then those of its module, the slow ones last: a plugin."""

    def __init__(self, kept: Path, within: str) -> None:
        self._kept, self._within = kept, within
        # Of each test the seconds, and the functions that it calls.
        self._known = json.loads(kept.read_text(encoding="utf-8")) if kept.exists() else {}

    def pytest_collection_modifyitems(self, items):
        items.sort(key=self._place)

    def _place(self, item):
        seconds, called = self._known.get(item.nodeid, (0.0, ()))
        module = self._within.partition(":")[0]
        named = item.path.stem.removeprefix("test_") == Path(module).stem
        beside = named or any(one.startswith(f"{module}:") for one in called)
        return self._within not in called, not beside, seconds > SLOW_S

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        if self._within:
            return (yield)
        codes, start_s = {}, time.monotonic()

        def note(frame, event, _):
            if event == "call":
                codes[id(frame.f_code)] = frame.f_code

        threading.setprofile(note)
        sys.setprofile(note)
        try:
            return (yield)
        finally:
            sys.setprofile(None)
            threading.setprofile(None)
            called = [(Path(one.co_filename), one.co_name) for one in codes.values()]
            within = self._kept.parent / "torchcover"
            ours = {f"torchcover/{at.relative_to(within)}:{name}" for at, name in called if at.is_relative_to(within)}
            self._known[item.nodeid] = time.monotonic() - start_s, sorted(ours)

    def pytest_sessionfinish(self):
        if not self._within:
            self._kept.write_text(json.dumps(self._known), encoding="utf-8")


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
    if way == "swap" and name_of(node.func) in COMMUTATIVE:
        return None
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
