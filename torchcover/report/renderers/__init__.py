"""Renderers: a table written down. One file each; a new one is a file and a line here."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

from torchcover.report.renderers import csv_file, json_file, markdown_file, text_file
from torchcover.report.table import CoverageTable

RENDERERS: Mapping[str, Callable[[CoverageTable], str]] = MappingProxyType(
    {"text": text_file.render, "csv": csv_file.render, "json": json_file.render, "markdown": markdown_file.render}
)
