"""A table as CSV."""

import csv
import io
import math

from torchcover.report.renderers.records import columns_of, records_of
from torchcover.report.table import CoverageTable


def render(table: CoverageTable) -> str:
    """A line for each rig, region and band, under a header; an unknown number is an empty field, infinity is `inf`."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns_of(table))
    writer.writerows([_field(value) for value in record.values()] for record in records_of(table))
    return text.getvalue()


def _field(value: object) -> object:
    return "" if isinstance(value, float) and math.isnan(value) else value
