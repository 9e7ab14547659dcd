"""A hook of MkDocs: the README as the first page, and the pages that are made from the code.

`reference/commands.md` from the help of the commands, `reference/documents.md` from the classes that read YAML,
`reference/columns.md` from those of the table, `reference/api.md` from the public names. Nothing
of it is kept in the repository.
"""

import importlib
import inspect
import json
import re
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path

import typer
from mkdocs.structure.files import File
from pydantic import BaseModel
from typer.main import get_command

import torchcover
from torchcover.cli.app import app
from torchcover.report.records import COLUMNS

ROOT = Path(__file__).parent.parent
ROOMS = (
    "coverage", "evaluation", "placement", "targets", "encounters", "data", "simulation", "cameras", "detection",
    "training", "metrics", "estimation", "neighbors", "report", "geometry",
)  # fmt: skip
# Where the classes of documents are defined.
DOCUMENTS = (
    "torchcover.simulation",
    "torchcover.recordings",
    "torchcover.targets",
    "torchcover.encounters",
    "torchcover.evaluation",
    "torchcover.coverage",
    "torchcover.placement",
)


def on_config(config):
    """All measured tables and the generated pages are in the navigation."""
    measured = sorted(path.name for path in (ROOT / "docs" / "measured").glob("*.md"))
    config.nav.append({"Measured": [f"measured/{name}" for name in measured]})
    config.nav.append({"Reference": [f"reference/{name}.md" for name in ("commands", "documents", "columns", "api")]})
    return config


def on_files(files, config):
    """Add the pages that no file is written for."""
    made = {"index": first_page(), "notebook": notebook(), "reference/commands": commands(),
            "reference/documents": documents(), "reference/columns": columns(), "reference/api": api()}  # fmt: skip
    for name, text in made.items():
        files.append(File.generated(config, f"{name}.md", content=text))
    return files


def on_page_markdown(markdown, **_):
    """On the site, the notebook is a page, and what lies beside `docs` is named, not linked."""
    markdown = re.sub(r"\[([^\]]*)\]\(\.\./(?:SECURITY|THIRD_PARTY_NOTICES)\.md\)", r"\1", markdown)
    return markdown.replace("](notebook.ipynb)", "](notebook.md)")


def first_page():
    """The README, with its links seen from `docs`."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    text = re.sub(r"\]\(docs/([^)]*)\)", lambda link: f"]({link[1]})", text)
    text = text.replace("](measured)", "](measured/README.md)")
    # What is not part of the site is named, not linked.
    return re.sub(r"\[([^\]]*)\]\((CONTRIBUTING|CHANGELOG|SECURITY|THIRD_PARTY_NOTICES)\.md\)", r"\1 (\2.md)", text)


def notebook():
    """The notebook with what its cells show."""
    parts = []
    for cell in json.loads((ROOT / "docs" / "notebook.ipynb").read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", ()):
            shown = output.get("data", {"text/plain": output.get("text", "")})
            if "text/html" in shown:
                parts.append(f"<div>{''.join(shown['text/html'])}</div>".replace("\n\n", "\n"))
            elif "image/png" in shown:
                parts.append(
                    f'<img alt="What the cell draws" src="data:image/png;base64,{"".join(shown["image/png"]).strip()}">'
                )
            else:
                parts.append(f"```text\n{''.join(shown['text/plain'])}\n```")
    return "\n\n".join(parts)


def commands():
    """Every command with its arguments and options."""
    lines = ["# Commands", "", "`torchcover COMMAND --help` prints the same."]
    command = get_command(app)
    context = typer.Context(command, info_name="torchcover")
    for name in command.list_commands(context):
        one = command.get_command(context, name)
        inner = typer.Context(one, info_name=name, parent=context)
        lines += ["", f"## torchcover {name}", "", inspect.cleandoc(one.help or "").split("\f")[0], ""]
        lines += ["```console", f"$ {one.get_usage(inner).removeprefix('Usage: ')}", "```", ""]
        lines += ["| | default | |", "|---|---|---|"]
        lines += [option_row(each, inner) for each in one.get_params(inner) if each.name != "help"]
    return "\n".join(lines)


def option_row(option, context):
    """A row of the table of a command."""
    names = option.opts + option.secondary_opts if option.param_type_name == "option" else [option.name.upper()]
    default = option.get_default(context, call=False)
    # What is not said is decided later, or nothing.
    shown = "" if default in (None, False, ()) or callable(default) else f"`{getattr(default, 'value', default)}`"
    words = " ".join((getattr(option, "help", None) or "").split())
    return f"| {', '.join(f'`{each}`' for each in names)} | {shown} | {cell(words)} |"


def documents():
    """Every key of every YAML document."""
    lines = ["# Documents", "", "The keys of all YAML documents; [scenes](../scenes.md) explains them with examples."]
    lines += ["", "An unknown key, NaN or infinity is an error that names the file and the key."]
    for document in document_classes():
        summary, _ = of_docstring(document)
        arguments = {key: words for one in reversed(document.__mro__) for key, words in of_docstring(one)[1].items()}
        lines += ["", f"## {document.__name__}", "", summary, "", "| key | type | default | |", "|---|---|---|---|"]
        for key, field in document.model_fields.items():
            default = "required" if field.is_required() else default_words(field.get_default(call_default_factory=True))
            lines.append(
                f"| `{key}` | {cell(type_words(field.annotation))} | {cell(default)} | {cell(arguments.get(key, ''))} |"
            )
    return "\n".join(lines)


def columns():
    """Every column of `summary.csv` that is no number with an error."""
    lines = ["# Columns", "", "What rows of `summary.csv` and `summary.json` have besides numbers and their errors."]
    lines += ["", "| column | | in tables |", "|---|---|---|"]
    return "\n".join([*lines, *(f"| `{each.key}` | {each.meaning} | {cell(each.heading)} |" for each in COLUMNS)])


def document_classes():
    """The classes of documents, those that a user writes whole first."""
    for name in DOCUMENTS:
        for path in sorted((ROOT / name.replace(".", "/")).rglob("*.py")):
            if re.search(r"\((BaseModel|Document)\):", path.read_text(encoding="utf-8")):
                importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
    found, waiting = [], [BaseModel]
    while waiting:
        each = waiting.pop(0)
        waiting += each.__subclasses__()
        if each.__module__.startswith("torchcover") and each.model_fields and not each.__name__.startswith("_"):
            found.append(each)
    whole = [each for each in found if hasattr(each, "load")]
    return [
        *dict.fromkeys(whole),
        *sorted((each for each in found if each not in whole), key=lambda each: each.__name__),
    ]


def default_words(value):
    """A default as YAML has it."""
    if value is None or value in ((), "", {}):
        return ""
    if isinstance(value, tuple) and any(isinstance(each, BaseModel) for each in value):
        return "one with its defaults"
    return "its defaults" if isinstance(value, BaseModel) else f"`{json.dumps(value, default=str)}`"


def of_docstring(kind):
    """The text before `Args:`, and what that says of each name."""
    text = inspect.cleandoc(kind.__doc__ or "")
    summary, _, rest = text.partition("\nArgs:\n")
    arguments, name = {}, None
    for line in rest.split("\n\n")[0].splitlines():
        if match := re.match(r"    (\w+): (.*)", line):
            name, arguments[match[1]] = match[1], match[2]
        elif name:
            arguments[name] += " " + line.strip()
    return summary.split("\nExample:")[0].strip(), arguments


def type_words(kind):
    """A type as a reader of YAML knows it."""
    parts = typing.get_args(kind)
    match typing.get_origin(kind):
        case typing.Annotated:
            return type_words(parts[0])
        case typing.Literal:
            return " or ".join(f"`{part}`" for part in parts)
        case typing.Union | types.UnionType:
            return " or ".join(dict.fromkeys(type_words(part) for part in parts if part is not types.NoneType))
        case origin if origin in (tuple, list, Sequence):
            kinds = [type_words(part) for part in parts if part is not ...]
            return f"list of {kinds[0]}" if ... in parts or origin is not tuple else f"[{', '.join(kinds)}]"
        case origin if origin in (dict, Mapping):
            return f"mapping of {type_words(parts[0])} to {type_words(parts[1])}"
    plain = {float: "number", int: "whole number", str: "text", bool: "true or false", Path: "file"}
    return plain.get(kind, getattr(kind, "__name__", str(kind)))


def api():
    """Every public name, room by room; what a name of the top also is in its room stands there."""
    lines = ["# Python", "", "What can be imported from `torchcover` itself: "]
    rooms = {name: importlib.import_module(f"torchcover.{name}") for name in ROOMS}
    top = [name for name in torchcover.__all__ if name not in rooms and not name.startswith("__")]
    lines[-1] += ", ".join(f"`{name}`" for name in sorted(top)) + "."
    for room, module in rooms.items():
        lines += ["", f"## torchcover.{room}", "", (inspect.getdoc(module) or "").split("\n")[0]]
        for name in sorted(getattr(module, "__all__", ()), key=str.lower):
            one = getattr(module, name)
            if inspect.isclass(one) or inspect.isfunction(one):
                lines += ["", f"::: {one.__module__}.{one.__qualname__}"]
                if hasattr(one, "__wrapped__"):  # whose arguments are the fields of a document: not in its source
                    lines += ["    options:", "      show_signature: false", *argument_rows(one)]
    return "\n".join(lines)


def argument_rows(function):
    """A table of the arguments of a function."""
    words = of_docstring(function)[1]
    yield from ("", "| argument | default | |", "|---|---|---|")
    for name, one in inspect.signature(function).parameters.items():
        default = "" if one.default is None or callable(one.default) else f"`{one.default!r}`"
        yield f"| `{name}` | {cell(default)} | {cell(words[name])} |"


def cell(text):
    """Words for one cell of a table."""
    return " ".join(str(text).split()).replace("|", "\\|")
