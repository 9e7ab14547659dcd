"""Make pages of `docs/measured` again: run the commands that stand there, and put what they print below them.

`python -m benchmarks.measured [page ...]`, as in `heights`; without names, those of `QUOTED`: what README and the pages
on definitions, accuracy and the paper quote and is made within 20 minutes of two cores. A command stands in a block of
`console`; what it prints goes between `<!-- printed -->` and `<!-- /printed -->` behind the block, with the processor
time that it took. A page that quotes the first table of another one has it between `<!-- first table of PAGE -->` and
`<!-- /first table -->`.
"""

import os
import re
import resource
import subprocess
import sys
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).parents[1]
QUOTED = ("heights", "settings", "surface", "error_against_time", "paper", "README")
COMMANDS = re.compile(
    r"(```console\n(?P<commands>[^`]+)```\n\n<!-- printed -->\n)(?:.*?)(<!-- /printed -->\n)", re.DOTALL
)
PICTURES = re.compile(r"docs/images/\S+\.png")
MOST_PIXELS, COLOURS = (1200, 1600), 256
TABLE = re.compile(r"(<!-- first table of (?P<page>\S+) -->\n\n)(?:.*?)(\n<!-- /first table -->\n)", re.DOTALL)


def main(names):
    docs = ROOT / "docs"
    pages = [docs / "measured" / f"{name}.md" for name in names or QUOTED]
    if missing := [page.stem for page in pages if not page.is_file()]:
        sys.exit(f"no page {', '.join(missing)} in docs/measured")
    for page in pages:
        seconds = make(page)
        print(f"{page.relative_to(ROOT)}: {seconds:.0f} s of processor time", flush=True)
    for page in docs.glob("*.md"):
        quote(page)


def make(page, root=ROOT):
    """Run the commands of a page and write down what they print; the processor time that they took."""
    times_s = []

    def printed(found):
        text, seconds = run(found["commands"], root)
        times_s.append(seconds)
        return f"{found[1]}\n{text}*Printed in {seconds:.0f} s of processor time.*\n\n{found[3]}"

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
