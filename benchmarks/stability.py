"""The stability cases, as docs/measured/stability.md has them: our error, its bound, and the error of the naive way."""

import subprocess
import sys

from benchmarks import table
from tests.stability import faces, ground, lenses, metric, motion, poses, rays, returns, search, sums
from tests.stability.case import CPU_SEARCHES

ROOMS = {
    "Nearest neighbours": search,
    "Bins and sums": metric,
    "Ray casting": rays,
    "Faces": faces,
    "Ground of recordings": ground,
    "Lenses": lenses,
    "Poses": poses,
    "Returns": returns,
    "Sums and mixtures": sums,
    "Motion and encounters": motion,
}
SEARCHING = ("Nearest neighbours", "Bins and sums")
# In a process of its own, so that the peak of the memory is the case's.
LARGE = """
import resource, time
from tests.stability import {room} as room
from tests.stability.case import CPU_SEARCHES
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
before, begin = peak(), time.perf_counter()
error = room.CASES[{at}].ours(*CPU_SEARCHES[{searches}])
print(error, time.perf_counter() - begin, peak() - before)
"""


def show(error, unit):
    """A count as a whole number; two digits of anything else."""
    if unit.startswith(("of ", "points")):
        return f"{error:.0f}"
    return "0" if error == 0 else f"{error:.1e}"


def row(case, searches):
    """One case with every backend, or once where there is no search."""
    errors = [case.ours(search) for search in searches] if searches else [case.ours()]
    numbers = [show(error, case.unit) for error in (case.bound, *errors)]
    return (case.name, case.expected, case.unit, *numbers, case.naive_way, show(case.naive(), case.unit))


def cost(room, at, searches):
    """A large case: its error, and the time and memory of all of it, the making of the input included."""
    program = LARGE.format(room=room.__name__.split(".")[-1], at=at, searches=searches)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    error, seconds, megabytes = (float(number) for number in done.stdout.split()[-3:])
    return show(error, room.CASES[at].unit), f"{seconds:.1f}", f"{megabytes:.0f}"


def large_rows():
    """The cases that are too large for the tests."""
    for title, room in ROOMS.items():
        for at, case in enumerate(room.CASES):
            if case.benchmark_only and title in SEARCHING:
                for k, search in enumerate(CPU_SEARCHES):
                    yield case.name, search, case.unit, show(case.bound, case.unit), *cost(room, at, f"{k}:{k + 1}")
            elif case.benchmark_only:
                yield case.name, "", case.unit, show(case.bound, case.unit), *cost(room, at, "0:0")


def main():
    """Print a table for each room, and one of the large cases."""
    for title, room in ROOMS.items():
        searches = CPU_SEARCHES if title in SEARCHING else ()
        print(f"## {title}\n")
        header = (
            "case",
            "expected",
            "unit",
            "bound",
            *(map(str, searches) if searches else ["error"]),
            "naive way",
            "its error",
        )
        table(header, [row(case, searches) for case in room.CASES if not case.benchmark_only])
        print(flush=True)
    print("## Large\n")
    table(("case", "backend", "unit", "bound", "error", "seconds", "MB"), list(large_rows()))


if __name__ == "__main__":
    main()
