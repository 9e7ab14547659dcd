"""Every block of code in the documentation runs, each on its own; commands and documents are those that exist."""

import doctest
import re
import shlex
from itertools import takewhile
from pathlib import Path

import pytest
import typer
from typer.main import get_command

from torchcover.cli.app import app
from torchcover.data import RegionsOfInterest
from torchcover.data.recordings.folder_settings import read_folder_settings
from torchcover.simulation import Rig, Scenario
from torchcover.targets import Requirements

ROOT = Path(__file__).parent.parent
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
BLOCK = re.compile(r"^(?P<indent> *)```(?P<language>\w+)\n(?P<code>.*?)^ *```", re.MULTILINE | re.DOTALL)


def blocks(language):
    """Each block with its place, without the indentation of a list."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for block in BLOCK.finditer(text):
            if block["language"] == language:
                line = text.count("\n", 0, block.start()) + 1
                code = re.sub(rf"(?m)^{block['indent']}", "", block["code"])
                yield pytest.param(code, id=f"{page.relative_to(ROOT)}:{line}")


@pytest.mark.parametrize("code", [each for each in blocks("python") if ">>>" in each.values[0]])
def test_an_example_prints_what_it_says(code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = []
    example = doctest.DocTestParser().get_doctest(code, {"__name__": "example"}, "example", None, 0)
    assert doctest.DocTestRunner(verbose=False).run(example, out=said.append).failed == 0, "".join(said)


def commands():
    for parameter in blocks("console"):
        for line in re.sub(r"\\\n", " ", parameter.values[0]).splitlines():
            if line.startswith("$ "):
                words = list(takewhile(lambda word: word not in (">", "|"), shlex.split(line[2:], comments=True)))
                yield pytest.param(words, id=f"{parameter.id} {' '.join(words)}"[:80])


@pytest.mark.parametrize("words", list(commands()))
def test_a_command_can_be_given(words):
    """Its options exist and take such values; what it would measure, others measure."""
    if "torchcover" in words:
        group = get_command(app)
        context = typer.Context(group, info_name="torchcover")
        name, command, rest = group.resolve_command(context, words[words.index("torchcover") + 1 :])
        command.make_context(name, list(rest), parent=context)
    elif words[:2] == ["make", *words[1:2]]:
        assert re.search(rf"(?m)^{words[1]}:", (ROOT / "Makefile").read_text())
    elif words[:2] == ["python", "-m"]:
        module = words[2].replace(".", "/")
        assert (ROOT / f"{module}.py").exists() or (ROOT / module / "__main__.py").exists()
    elif words[0] == "python":
        assert (ROOT / words[1]).exists()
    else:
        assert words[0] in ("pip", "uv", "git", "cd", "sudo", "bash"), words


# Whatever reads a document of YAML.
READERS = (Rig.load, Scenario.load, RegionsOfInterest.load, Requirements.load, read_folder_settings)


@pytest.mark.parametrize("text", list(blocks("yaml")))
def test_a_document_is_valid_for_one_of_its_readers(text, tmp_path):
    path = tmp_path / "document.yaml"
    path.write_text(text, encoding="utf-8")
    refusals = []
    for read in READERS:
        try:
            read(path)
            return
        except ValueError as error:
            refusals.append(str(error))
    pytest.fail("\n".join(refusals))
