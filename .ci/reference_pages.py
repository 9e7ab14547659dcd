"""MkDocs hook: the README as the first page, and reference pages that are generated from the code.

`reference/commands.md` lists the commands with their options, `reference/documents.md` the keys of YAML documents,
`reference/columns.md` the columns of `summary.csv`, and `reference/api.md` the public Python names. These pages are not
stored in the repository.
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
PACKAGES = (
    "coverage", "evaluation", "placement", "targets", "encounters", "data", "simulation", "cameras", "detection",
    "training", "metrics", "estimation", "neighbors", "report", "geometry",
)  # fmt: skip
# Packages that define documents.
DOCUMENT_PACKAGES = (
    "torchcover.simulation",
    "torchcover.recordings",
    "torchcover.targets",
    "torchcover.encounters",
    "torchcover.evaluation",
    "torchcover.coverage",
    "torchcover.placement",
)


def on_config(config):
    """Add all measured tables and generated pages to the navigation."""
    measured = sorted(path.name for path in (ROOT / "docs" / "measured").glob("*.md"))
    config.nav.append({"Measured": [f"measured/{name}" for name in measured]})
    config.nav.append({"Reference": [f"reference/{name}.md" for name in ("commands", "documents", "columns", "api")]})
    return config


def on_files(files, config):
    """Add the generated pages."""
    pages = {
        "index": build_first_page(),
        "notebook": build_notebook_page(),
        "reference/commands": build_command_page(),
        "reference/documents": build_document_page(),
        "reference/columns": build_column_page(),
        "reference/api": build_api_page(),
    }
    for name, text in pages.items():
        files.append(File.generated(config, f"{name}.md", content=text))
    return files


def on_page_markdown(markdown, **_):
    """Replace links that exist only in the repository."""
    markdown = re.sub(r"\[([^\]]*)\]\(\.\./(?:SECURITY|THIRD_PARTY_NOTICES)\.md\)", r"\1", markdown)
    return markdown.replace("](notebook.ipynb)", "](notebook.md)")


def build_first_page():
    """Build the first page: the README with links relative to `docs`."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    text = re.sub(r"\]\(docs/([^)]*)\)", lambda link: f"]({link[1]})", text)
    text = text.replace("](measured)", "](measured/README.md)")
    # Files outside the site are named, not linked.
    return re.sub(r"\[([^\]]*)\]\((CONTRIBUTING|CHANGELOG|SECURITY|THIRD_PARTY_NOTICES)\.md\)", r"\1 (\2.md)", text)


def build_notebook_page():
    """Build a page of the notebook with the stored outputs of its cells."""
    parts = []
    for cell in json.loads((ROOT / "docs" / "notebook.ipynb").read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", ()):
            data = output.get("data", {"text/plain": output.get("text", "")})
            if "text/html" in data:
                parts.append(f"<div>{''.join(data['text/html'])}</div>".replace("\n\n", "\n"))
            elif "image/png" in data:
                image = "".join(data["image/png"]).strip()
                parts.append(f'<img alt="Plot of the cell" src="data:image/png;base64,{image}">')
            else:
                parts.append(f"```text\n{''.join(data['text/plain'])}\n```")
    return "\n\n".join(parts)


def build_command_page():
    """Build the page of all commands with their arguments and options."""
    lines = ["# Commands", "", "`torchcover COMMAND --help` prints the same text."]
    group = get_command(app)
    context = typer.Context(group, info_name="torchcover")
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        command_context = typer.Context(command, info_name=name, parent=context)
        help_text = inspect.cleandoc(command.help or "").split("\f")[0]
        usage = command.get_usage(command_context).removeprefix("Usage: ")
        lines += ["", f"## torchcover {name}", "", help_text, "", "```console", f"$ {usage}", "```", ""]
        lines += ["| option | default | meaning |", "|---|---|---|"]
        for option in command.get_params(command_context):
            if option.name != "help":
                lines.append(format_option_row(option, command_context))
    return "\n".join(lines)


def format_option_row(option, context):
    """Format the table row of an option or argument."""
    names = option.opts + option.secondary_opts if option.param_type_name == "option" else [option.name.upper()]
    default = option.get_default(context, call=False)
    # Defaults that are computed later are not shown.
    has_default = default not in (None, False, ()) and not callable(default)
    default_text = f"`{getattr(default, 'value', default)}`" if has_default else ""
    name_text = ", ".join(f"`{name}`" for name in names)
    return f"| {name_text} | {default_text} | {format_cell(getattr(option, 'help', None) or '')} |"


def build_document_page():
    """Build the page of the keys of all YAML documents."""
    lines = ["# Documents", "", "Keys of all YAML documents; see [scenes](../scenes.md) for examples."]
    lines += ["", "An unknown key, NaN or infinity is an error that names the file and the key."]
    for document in list_document_classes():
        summary, _ = parse_docstring(document)
        descriptions = collect_descriptions(document)
        lines += ["", f"## {document.__name__}", "", summary, ""]
        lines += ["| key | type | default | meaning |", "|---|---|---|---|"]
        for key, field in document.model_fields.items():
            default = "required"
            if not field.is_required():
                default = format_default(field.get_default(call_default_factory=True))
            description = descriptions.get(key) or field.description or ""
            cells = (f"`{key}`", format_type(field.annotation), default, description)
            lines.append(f"| {' | '.join(format_cell(text) for text in cells)} |")
    return "\n".join(lines)


def build_column_page():
    """Build the page of the columns of `summary.csv` that are not numbers with errors."""
    lines = ["# Columns", "", "Columns of `summary.csv` and `summary.json` besides numbers and their errors."]
    lines += ["", "| column | meaning | heading in tables |", "|---|---|---|"]
    for column in COLUMNS:
        lines.append(f"| `{column.key}` | {column.meaning} | {format_cell(column.heading)} |")
    return "\n".join(lines)


def list_document_classes():
    """List the classes of documents: first those of whole files, then their parts by name."""
    for package in DOCUMENT_PACKAGES:
        for path in sorted((ROOT / package.replace(".", "/")).rglob("*.py")):
            if re.search(r"\((BaseModel|Document)\):", path.read_text(encoding="utf-8")):
                importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
    documents, queue = [], [BaseModel]
    while queue:
        kind = queue.pop(0)
        queue += kind.__subclasses__()
        if kind.__module__.startswith("torchcover") and kind.model_fields and not kind.__name__.startswith("_"):
            documents.append(kind)
    files = list(dict.fromkeys(document for document in documents if hasattr(document, "load")))
    parts = {document for document in documents if document not in files}
    return [*files, *sorted(parts, key=lambda document: document.__name__)]


def collect_descriptions(document):
    """Collect the descriptions of all keys; the text "See `Base`; note" is the description of the base and the note."""
    descriptions = {}
    for base in reversed(document.__mro__):
        for key, text in parse_docstring(base)[1].items():
            if key in descriptions and (match := re.match(r"See `\w+`[;.]? ?(.*)", text)):
                descriptions[key] += f" {match[1][:1].upper()}{match[1][1:]}"
            else:
                descriptions[key] = text
    return descriptions


def format_default(value):
    """Format a default as in YAML."""
    if value is None or value in ((), "", {}):
        return ""
    if isinstance(value, tuple) and any(isinstance(item, BaseModel) for item in value):
        return "one with its defaults"
    return "its defaults" if isinstance(value, BaseModel) else f"`{json.dumps(value, default=str)}`"


def parse_docstring(documented):
    """Split a docstring into the text before `Args:` and the descriptions of the arguments."""
    text = inspect.cleandoc(documented.__doc__ or "")
    summary, _, remaining = text.partition("\nArgs:\n")
    descriptions, name = {}, None
    for line in remaining.split("\n\n")[0].splitlines():
        if match := re.match(r"    (\w[\w, ]*): (.*)", line):
            name = match[1]
            descriptions[name] = match[2]
        elif name:
            descriptions[name] += " " + line.strip()
    separate = {key: text for names, text in descriptions.items() for key in names.split(", ")}
    return summary.split("\nExample:")[0].strip(), separate


def format_type(kind):
    """Format a type in words that describe YAML."""
    parts = typing.get_args(kind)
    match typing.get_origin(kind):
        case typing.Annotated:
            return format_type(parts[0])
        case typing.Literal:
            return " or ".join(f"`{part}`" for part in parts)
        case typing.Union | types.UnionType:
            kinds = [format_type(part) for part in parts if part is not types.NoneType]
            return " or ".join(dict.fromkeys(kinds))
        case origin if origin in (tuple, list, Sequence):
            kinds = [format_type(part) for part in parts if part is not ...]
            return f"list of {kinds[0]}" if ... in parts or origin is not tuple else f"[{', '.join(kinds)}]"
        case origin if origin in (dict, Mapping):
            return f"mapping of {format_type(parts[0])} to {format_type(parts[1])}"
    plain = {float: "number", int: "integer", str: "text", bool: "true or false", Path: "file"}
    return plain.get(kind, getattr(kind, "__name__", str(kind)))


def build_api_page():
    """Build the page of all public names by package."""
    packages = {name: importlib.import_module(f"torchcover.{name}") for name in PACKAGES}
    names = sorted(name for name in torchcover.__all__ if name not in packages and not name.startswith("__"))
    name_list = ", ".join(f"`{name}`" for name in names)
    lines = ["# Python", "", f"Names in `torchcover` itself, documented in their packages: {name_list}."]
    for package, module in packages.items():
        lines += ["", f"## torchcover.{package}", "", (inspect.getdoc(module) or "").split("\n")[0]]
        for name in sorted(getattr(module, "__all__", ()), key=str.lower):
            public = getattr(module, name)
            if inspect.isclass(public) or inspect.isfunction(public):
                lines += ["", f"::: {public.__module__}.{public.__qualname__}"]
                # The arguments of such a function are the fields of a class, which mkdocstrings does not see.
                if hasattr(public, "__wrapped__"):
                    lines += ["    options:", "      show_signature: false", *iterate_argument_rows(public)]
    return "\n".join(lines)


def iterate_argument_rows(function):
    """Yield the table rows of the arguments of a function."""
    descriptions = parse_docstring(function)[1]
    yield from ("", "| argument | default | meaning |", "|---|---|---|")
    for name, parameter in inspect.signature(function).parameters.items():
        has_default = parameter.default is not None and not callable(parameter.default)
        default = f"`{parameter.default!r}`" if has_default else ""
        yield f"| `{name}` | {format_cell(default)} | {format_cell(descriptions[name])} |"


def format_cell(text):
    """Format a text as one table cell."""
    return " ".join(str(text).split()).replace("|", "\\|")
