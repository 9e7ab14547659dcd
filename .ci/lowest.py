"""Print the lowest versions that pyproject.toml promises, for `pip install --constraint`.

Usage: python lowest.py [NAME ...]: these are left out; pip takes what it finds of them.
"""

import re
import sys
import tomllib
from pathlib import Path

EXTRAS = ("av2", "exr", "lightning", "tensorboard")


def main(left_out: list[str]) -> None:
    project = tomllib.loads(Path(__file__).parents[1].joinpath("pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    for requirement in [*project["dependencies"], *(one for name in EXTRAS for one in extras[name])]:
        parts = re.fullmatch(r"([\w-]+)>=([\w.]+)", requirement)
        if not parts:
            sys.exit(f"pyproject.toml: a lower bound alone is needed, NAME>=VERSION; got {requirement}")
        if parts[1] not in left_out:
            print(f"{parts[1]}=={parts[2]}")


if __name__ == "__main__":
    main(sys.argv[1:])
