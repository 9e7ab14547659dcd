"""Pages of measured tables are made by the commands that stand in them."""

import re
from pathlib import Path

import pytest

from benchmarks import measured

DOCS = Path(__file__).parent.parent / "docs"


def test_what_a_command_prints_takes_the_place_of_what_it_printed_before(tmp_path):
    page = tmp_path / "page.md"
    commands = "```console\n$ echo '| a |' > seen\n$ cat \\\n    seen\n```\n"
    block = f"# Page\n\n{commands}\n<!-- printed -->\n{{}}<!-- /printed -->\n\nEnd.\n"
    page.write_text(block.format("\nold\n"), encoding="utf-8")
    for _ in range(2):
        assert measured.make(page, tmp_path) < 5.0
        assert page.read_text(encoding="utf-8") == block.format("\n| a |\n\n*Printed in 0 s of processor time.*\n\n")


def test_a_command_that_fails_leaves_its_page_as_it_was(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "```console\n$ false\n$ echo new\n```\n\n<!-- printed -->\nold\n<!-- /printed -->\n", encoding="utf-8"
    )
    with pytest.raises(measured.subprocess.CalledProcessError):
        measured.make(page, tmp_path)
    assert "old" in page.read_text(encoding="utf-8")


@pytest.mark.parametrize("name", measured.QUOTED)
def test_pages_that_are_quoted_say_how_they_were_made(name):
    text = (DOCS / "measured" / f"{name}.md").read_text(encoding="utf-8")
    assert measured.COMMANDS.search(text)
    assert len(measured.COMMANDS.findall(text)) == text.count("<!-- printed -->") == text.count("processor time.*")


def test_quoted_tables_are_those_of_their_pages():
    for page in DOCS.glob("*.md"):
        for found in measured.TABLE.finditer(page.read_text(encoding="utf-8")):
            assert measured.first_table(page.parent / found["page"]) in found[0]


def test_every_picture_is_made_by_a_page():
    pages = [page.read_text(encoding="utf-8") for page in (DOCS / "measured").glob("*.md")]
    made = {name for text in pages for name in re.findall(r"docs/images/(\S+\.png)", text)}
    assert made == {path.name for path in (DOCS / "images").glob("*.png")}
