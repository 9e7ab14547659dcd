"""Regenerate the pages of `docs/measured`: `python -m benchmarks [PAGE ...]`, without names all that are outdated.

A page has commands in blocks of `console`. Each block is run, and its output replaces the text between
`<!-- printed -->` and `<!-- /printed -->` behind it, with the processor time and the last commit that changed the
measured code. A page is outdated if that code changed later. A block without these marks is run by hand: it needs
recordings or another machine. Finished pages stay, so an interrupted run can be repeated. `--ages` only lists how old
each page is. A page that quotes the first table of another one has it between `<!-- first table of PAGE -->` and
`<!-- /first table -->`.
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
PAGES = ROOT / "docs" / "measured"
# A change of these folders makes a page outdated.
CODE = ("torchcover", "datasets")
COMMANDS = re.compile(
    r"(```console\n(?P<commands>[^`]+)```\n\n<!-- printed -->\n)(?:.*?)(<!-- /printed -->\n)", re.DOTALL
)
STAMP = re.compile(r"\*Printed in (?P<seconds>\d+) s of processor time(?:, by the code of (?P<commit>[0-9a-f]+))?\.\*")
PICTURES = re.compile(r"docs/images/\S+\.png")
# Large enough for a page; every clone of the repository has all pictures.
PICTURE_SIZE = (1200, 1600)
PICTURE_COLORS = 256
TABLE = re.compile(r"(<!-- first table of (?P<page>\S+) -->\n\n)(?:.*?)(\n<!-- /first table -->\n)", re.DOTALL)


def main(words):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="*")
    parser.add_argument("--ages", action="store_true", help="list how old each page is, and run nothing")
    options = parser.parse_args(words)
    pages = [PAGES / f"{name}.md" for name in options.pages] or sorted(PAGES.glob("*.md"))
    if missing := [page.stem for page in pages if not page.is_file()]:
        sys.exit(f"no page {', '.join(missing)} in docs/measured")
    if options.ages:
        for page in pages:
            print(f"{page.stem}: {describe_age(page)}")
        return
    if not options.pages:
        pages = [page for page in pages if is_outdated(page)]
    for page in sorted(pages, key=read_seconds):
        print(f"{page.relative_to(ROOT)}: {make(page):.0f} s of processor time", flush=True)
        for quoting in PAGES.parent.glob("*.md"):
            quote_tables(quoting)


def is_outdated(page):
    """Whether the tables of a page are older than the code and can be made here."""
    has_commands = COMMANDS.search(page.read_text(encoding="utf-8")) is not None
    return has_commands and count_later_changes(page) != 0


def read_seconds(page):
    """Processor time that the tables of a page took last; infinite if they were never printed."""
    stamps = [int(match["seconds"]) for match in STAMP.finditer(page.read_text(encoding="utf-8"))]
    return sum(stamps) if stamps else float("inf")


def count_later_changes(page):
    """Number of commits to the code after the tables of a page were printed; None if unknown."""
    commits = [match["commit"] for match in STAMP.finditer(page.read_text(encoding="utf-8"))]
    counts = [git("rev-list", "--count", f"{commit}..HEAD", "--", *CODE) if commit else "" for commit in commits]
    return max(map(int, counts)) if counts and all(counts) else None


def describe_age(page):
    changes = count_later_changes(page)
    if changes is None:
        return "of unknown age"
    return f"{changes} later changes of the code" if changes else "as new as the code"


def git(*words):
    """Output of a git command; empty if it fails."""
    try:
        done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return ""
    return "" if done.returncode else done.stdout.strip()


def make(page, root=ROOT):
    """Run the commands of a page, write their output into it and return the processor time in seconds."""
    times_s, commit = [], git("log", "-1", "--format=%h", "--", *CODE)

    def replace_output(match):
        text, seconds = run(match["commands"], root)
        times_s.append(seconds)
        code = f", by the code of {commit}" if commit else ""
        return f"{match[1]}\n{text}*Printed in {seconds:.0f} s of processor time{code}.*\n\n{match[3]}"

    text = COMMANDS.sub(replace_output, page.read_text(encoding="utf-8"))
    for picture in PICTURES.findall(text):
        shrink_picture(root / picture)
    page.write_text(text, encoding="utf-8")
    return sum(times_s)


def run(commands, root):
    """Run the lines of a block; return their output and processor time in seconds."""
    script = "\n".join(line.removeprefix("$ ") for line in commands.splitlines())
    environment = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(root),
        "OMP_WAIT_POLICY": "passive",
        "COLUMNS": "120",
    }
    (root / "out").mkdir(exist_ok=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        ["bash", "-euc", script], cwd=root, env=environment, stdout=subprocess.PIPE, text=True, check=True
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    text = done.stdout.strip()
    if "│" in text:  # a table as the terminal shows it
        text = f"```text\n{text}\n```"
    text = f"{text}\n\n" if text else ""
    return text, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def shrink_picture(path):
    with Image.open(path) as picture:
        small = picture.convert("RGB")
    small.thumbnail(PICTURE_SIZE)
    small.quantize(PICTURE_COLORS).save(path, optimize=True)


def quote_tables(page):
    """Update the tables that a page quotes from other pages."""
    text = page.read_text(encoding="utf-8")
    if TABLE.search(text):
        quoted = TABLE.sub(lambda match: f"{match[1]}{read_first_table(page.parent / match['page'])}{match[3]}", text)
        page.write_text(quoted, encoding="utf-8")


def read_first_table(page):
    lines = page.read_text(encoding="utf-8").splitlines()
    start = next(number for number, line in enumerate(lines) if line.startswith("|"))
    end = next((number for number in range(start, len(lines)) if not lines[number].startswith("|")), len(lines))
    return "\n".join(lines[start:end]) + "\n"


if __name__ == "__main__":
    main(sys.argv[1:])
