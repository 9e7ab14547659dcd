"""What is shipped of others has a license that allows it, with its text."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
NOTICES = (ROOT / "THIRD_PARTY_NOTICES.md").read_text("utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
LICENSES = {"Apache-2.0", "BSD-3-Clause", "LGPL-3.0", "MIT"}
SOURCE = re.compile(r"([\w.-]+/[\w.-]+)(?: at commit \w+)? ?[(,] ?(Apache-2\.0|BSD[\w -]*|LGPL-3\.0|MIT)\b")


def descriptions():
    for path in sorted((ROOT / "datasets").rglob("*.yaml")):
        content = yaml.safe_load(path.read_text("utf-8"))
        if isinstance(content, dict) and isinstance(content.get("description"), str):
            yield path, " ".join(content["description"].split())


def test_licensed_sources_are_in_the_notices():
    found = {(source, name) for _, text in descriptions() for source, name in SOURCE.findall(text)}
    assert len(found) >= 9
    for source, name in sorted(found):
        (row,) = [row for row in NOTICES.splitlines() if f"| {source} " in row]
        given = "BSD-3-Clause" if name.startswith("BSD") else name
        assert f"| {given}" in row, (source, name)


def test_nothing_is_shipped_without_a_license():
    for path, text in descriptions():
        assert not re.search(r"no licen[cs]e|all rights reserved|non-?commercial", text, re.IGNORECASE), path


def test_tables_in_the_notices_exist():
    tables = re.findall(r"`((?:lidars|rigs|vehicles)/\w+)`", NOTICES)
    assert len(tables) > 20
    assert not [name for name in tables if not (ROOT / "datasets" / f"{name}.yaml").is_file()]


@pytest.mark.parametrize("name", [*sorted(LICENSES), "GPL-3.0"])
def test_texts_are_there_and_travel(name):
    assert "without" in (ROOT / "licenses" / f"{name}.txt").read_text("utf-8").lower()
    assert PROJECT["project"]["license-files"] == ["LICENSE", "THIRD_PARTY_NOTICES.md", "licenses/*.txt"]
    assert {"licenses", "*.md", "LICENSE"} <= set(PROJECT["tool"]["hatch"]["build"]["targets"]["sdist"]["include"])
