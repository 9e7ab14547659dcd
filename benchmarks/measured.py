"""Make pages of `docs/measured` again: run the commands that stand there, and put what they print below them.

`python -m benchmarks.measured [page ...]`, as in `heights`; without names, all that are older than the code, the
cheapest first, but for those whose commands need recordings (`SWEEPS`). What was made is not made again, so that it may
be ended at any time and goes on. `--ages` says how old each is. A command stands in a block of `console`; what it
prints goes between `<!-- printed -->` and `<!-- /printed -->` behind the block, with the processor time that it took
and the last commit that changed what is measured. A page that quotes the first table of another one has it between
`<!-- first table of PAGE -->` and `<!-- /first table -->`.
"""

import argparse
import os
import re
import resource
import subprocess
import sys
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).parents[1]
# What is measured; whoever changes it makes pages old.
CODE = ("torchcover", "datasets")
COMMANDS = re.compile(
    r"(```console\n(?P<commands>[^`]+)```\n\n<!-- printed -->\n)(?:.*?)(<!-- /printed -->\n)", re.DOTALL
)
STAMP = re.compile(r"\*Printed in (?P<seconds>\d+) s of processor time(?:, by the code of (?P<commit>[0-9a-f]+))?\.\*")
# Files that whoever runs the command has to give.
NEEDED = re.compile(r"(?<![\w/.-])[A-Z]{3,}(?![\w=])")
# Hours, of versions as root; and what needs another machine.
BY_HAND = ("versions", "mutants", "gpu")
PICTURES = re.compile(r"docs/images/\S+\.png")
MOST_PIXELS, COLOURS = (1200, 1600), 256
TABLE = re.compile(r"(<!-- first table of (?P<page>\S+) -->\n\n)(?:.*?)(\n<!-- /first table -->\n)", re.DOTALL)


def main(words):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="*")
    parser.add_argument("--ages", action="store_true", help="say how old each page is, and make none")
    asked = parser.parse_args(words)
    folder = ROOT / "docs" / "measured"
    pages = [folder / f"{name}.md" for name in asked.pages]
    if missing := [page.stem for page in pages if not page.is_file()]:
        sys.exit(f"no page {', '.join(missing)} in docs/measured")
    if asked.ages:
        for page in pages or sorted(folder.glob("*.md")):
            print(f"{page.stem}: {age_words(page)}")
        return
    for page in pages or sorted(filter(is_due, folder.glob("*.md")), key=seconds_of):
        print(f"{page.relative_to(ROOT)}: {make(page):.0f} s of processor time", flush=True)
        for quoting in folder.parent.glob("*.md"):
            quote(quoting)


def is_due(page):
    """Whether a page can be made here, and its tables are older than the code."""
    blocks = [found["commands"] for found in COMMANDS.finditer(page.read_text(encoding="utf-8"))]
    can_be = bool(blocks) and page.stem not in BY_HAND and not any(map(NEEDED.search, blocks))
    return can_be and age(page) != 0


def seconds_of(page):
    """What its tables took, when they were printed; those that were never are last."""
    stamps = [int(found["seconds"]) for found in STAMP.finditer(page.read_text(encoding="utf-8"))]
    return sum(stamps) if stamps else float("inf")


def age(page):
    """How many changes of the code are younger than its tables; None if unknown."""
    commits = [found["commit"] for found in STAMP.finditer(page.read_text(encoding="utf-8"))]
    counts = [git("rev-list", "--count", f"{commit}..HEAD", "--", *CODE) if commit else "" for commit in commits]
    return max(map(int, counts)) if counts and all(counts) else None


def age_words(page):
    changes = age(page)
    if changes is None:
        return "of unknown age"
    return f"{changes} changes of the code are younger" if changes else "as new as the code"


def git(*words):
    """What git says; nothing where it does not know."""
    try:
        done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return ""
    return "" if done.returncode else done.stdout.strip()


def make(page, root=ROOT):
    """Run the commands of a page and write down what they print; the processor time that they took."""
    times_s, commit = [], git("log", "-1", "--format=%h", "--", *CODE)

    def printed(found):
        text, seconds = run(found["commands"], root)
        times_s.append(seconds)
        of = f", by the code of {commit}" if commit else ""
        return f"{found[1]}\n{text}*Printed in {seconds:.0f} s of processor time{of}.*\n\n{found[3]}"

    text = COMMANDS.sub(printed, page.read_text(encoding="utf-8"))
    for picture in PICTURES.findall(text):
        shrink(root / picture)
    page.write_text(text, encoding="utf-8")
    return sum(times_s)


def run(commands, root):
    """What the lines of a block print, and the processor time of it and its processes in seconds."""
    script = "\n".join(line.removeprefix("$ ") for line in commands.splitlines())
    search_path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {
        **os.environ,
        "PATH": search_path,
        "PYTHONPATH": str(root),
        "OMP_WAIT_POLICY": "passive",
        "COLUMNS": "120",
    }
    (root / "out").mkdir(exist_ok=True)  # where the commands write
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        ["bash", "-euc", script], cwd=root, env=environment, stdout=subprocess.PIPE, text=True, check=True
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    text = done.stdout.strip()
    if "│" in text:  # tables of a terminal
        text = f"```text\n{text}\n```"
    text = f"{text}\n\n" if text else ""
    return text, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def shrink(picture):
    """No page needs more pixels and colours, and a clone of the repository has all pictures."""
    with Image.open(picture) as drawn:
        small = drawn.convert("RGB")
    small.thumbnail(MOST_PIXELS)
    small.quantize(COLOURS).save(picture, optimize=True)


def quote(page):
    """Put the first tables of other pages into a page that quotes them."""
    text = page.read_text(encoding="utf-8")
    if TABLE.search(text):
        page.write_text(
            TABLE.sub(lambda found: f"{found[1]}{first_table(page.parent / found['page'])}{found[3]}", text)
        )


def first_table(page):
    """The first table between lines that a command has printed, or anywhere else in a page."""
    lines = page.read_text(encoding="utf-8").splitlines()
    start = next(number for number, line in enumerate(lines) if line.startswith("|"))
    end = next((number for number in range(start, len(lines)) if not lines[number].startswith("|")), len(lines))
    return "\n".join(lines[start:end]) + "\n"


if __name__ == "__main__":
    main(sys.argv[1:])
