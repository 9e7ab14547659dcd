"""A table as CSV."""

from torchcover.files import csv_text
from torchcover.report.renderers.records import columns_of, records_of
from torchcover.report.table import CoverageTable


def render(table: CoverageTable) -> str:
    """A line for each rig, region and band, under a header; an unknown number is an empty field, infinity is `inf`."""
    return csv_text([columns_of(table), *(record.values() for record in records_of(table))])
