"""Pages of measured tables are made by the commands that stand in them."""

import importlib.util
import re
import shlex
import subprocess
from pathlib import Path

import pytest
import typer

import benchmarks.__main__ as measured
from benchmarks import run
from torchcover.cli.app import app

COMMANDS = typer.main.get_command(app)
DOCS = Path(__file__).parent.parent / "docs"


@pytest.mark.parametrize("place", run.WATCHED)
def test_parts_of_the_default_run_exist(place):
    """A part that is called otherwise by now would be counted as another one."""
    owner, name = run.owner_of(place)
    assert callable(getattr(owner, name))


def test_output_of_a_command_replaces_the_old(tmp_path):
    page = tmp_path / "page.md"
    commands = "```console\n$ echo '| a |' > seen\n$ cat \\\n    seen\n```\n"
    block = f"# Page\n\n{commands}\n<!-- printed -->\n{{}}<!-- /printed -->\n\nEnd.\n"
    page.write_text(block.format("\nold\n"), encoding="utf-8")
    for _ in range(2):
        assert measured.make(page, tmp_path) < 5.0
        text = page.read_text(encoding="utf-8")
        commit = measured.STAMP.search(text)["commit"]
        of = f", by the code of {commit}" if commit else ""
        assert text == block.format(f"\n| a |\n\n*Printed in 0 s of processor time{of}.*\n\n")


def test_failed_command_leaves_its_page_unchanged(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "```console\n$ false\n$ echo new\n```\n\n<!-- printed -->\nold\n<!-- /printed -->\n", encoding="utf-8"
    )
    with pytest.raises(measured.subprocess.CalledProcessError):
        measured.make(page, tmp_path)
    assert "old" in page.read_text(encoding="utf-8")


def test_page_age_counts_later_code_changes(tmp_path, monkeypatch):
    def said(*words):
        done = subprocess.run(["git", "-c", "user.name=a", "-c", "user.email=a@b", *words], cwd=tmp_path, check=True,
                              capture_output=True, text=True)  # fmt: skip
        return done.stdout.strip()

    monkeypatch.setattr(measured, "ROOT", tmp_path)
    page, code = tmp_path / "page.md", tmp_path / "torchcover" / "code.py"
    code.parent.mkdir()
    said("init", "--quiet")
    ages = []
    for number, (path, changed) in enumerate([(code, "a"), (page, "text"), (code, "b"), (code, "c")]):
        path.write_text(f"{changed} {number}")
        said("add", ".")
        said("commit", "--quiet", "--message", "x")
        if number == 0:
            stamp = f"*Printed in 3 s of processor time, by the code of {said('rev-parse', '--short', 'HEAD')}.*"
        page.write_text(f"```console\n$ echo 1\n```\n\n<!-- printed -->\n{stamp}\n\n<!-- /printed -->\n")
        ages.append((measured.count_later_changes(page), measured.is_outdated(page)))
    assert ages == [(0, False), (0, False), (1, True), (2, True)]
    assert measured.read_seconds(page) == 3
    page.write_text("text")
    assert measured.count_later_changes(page) is None


def commands_of(page):
    """The lines of its consoles, each as words."""
    blocks = re.findall(r"```console\n([^`]+)```", page.read_text(encoding="utf-8"))
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines() if line.startswith("$ ")]
    return [shlex.split(re.split(r"&&|[|>&]", line[2:])[0], comments=True) for line in lines]


@pytest.mark.parametrize("page", sorted((DOCS / "measured").glob("*.md")), ids=lambda page: page.stem)
def test_commands_of_pages_exist(page):
    assert page.stem == "README" or commands_of(page)
    for words in commands_of(page):
        match words:
            case ["python", "-m", module, *_]:
                assert importlib.util.find_spec(module), module
            case ["python", script, *_]:
                assert (DOCS.parent / script).is_file(), script
            case ["torchcover", name, *options]:
                known = {flag for one in COMMANDS.commands[name].params for flag in (*one.opts, *one.secondary_opts)}
                assert {option for option in options if option.startswith("--")} <= known
            case [name, *_]:
                assert name in ("cp", "rm", "cat", "wait", "make", "chromium"), name


def test_quoted_tables_are_those_of_their_pages():
    for page in DOCS.glob("*.md"):
        for found in measured.TABLE.finditer(page.read_text(encoding="utf-8")):
            assert measured.read_first_table(page.parent / found["page"]) in found[0]


def test_every_picture_is_made_by_a_page():
    pages = [page.read_text(encoding="utf-8") for page in (DOCS / "measured").glob("*.md")]
    made = {name for text in pages for name in re.findall(r"docs/images/(\S+\.png)", text)}
    assert made == {path.name for path in (DOCS / "images").glob("*.png")}
