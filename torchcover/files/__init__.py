"""What the system gives: the door of all readers, its error, files that are whole, NumPy's, tables, processes."""

from torchcover.files.bad_file import (
    BadFileError,
    TooLargeError,
    check_memory,
    decode,
    naming,
    read_short_text,
    reads,
    said_gb,
)
from torchcover.files.csv_tables import csv_text, read_csv
from torchcover.files.feather import read_feather
from torchcover.files.json_tables import read_json_table
from torchcover.files.numpy_files import DEFLATE_MAX_RATIO, NpyHeader, npz_headers, read_npy, read_npz, write_npz
from torchcover.files.processes import end_with_parent
from torchcover.files.publishing import (
    RECORDING,
    SUMMARY,
    Publication,
    claimed,
    noted,
    settled,
    write_durably,
    written_since,
)
from torchcover.files.shown import shown
from torchcover.files.xml_text import feed_xml, parse_xml
from torchcover.files.yaml_text import as_yaml, parse_yaml

__all__ = [
    "DEFLATE_MAX_RATIO",
    "RECORDING",
    "SUMMARY",
    "BadFileError",
    "NpyHeader",
    "Publication",
    "TooLargeError",
    "as_yaml",
    "check_memory",
    "claimed",
    "csv_text",
    "decode",
    "end_with_parent",
    "feed_xml",
    "naming",
    "noted",
    "npz_headers",
    "parse_xml",
    "parse_yaml",
    "read_csv",
    "read_feather",
    "read_json_table",
    "read_npy",
    "read_npz",
    "read_short_text",
    "reads",
    "said_gb",
    "settled",
    "shown",
    "write_durably",
    "write_npz",
    "written_since",
]
