"""What every reader of a file shares: its door, its error, the memory it may take, and NumPy's files, tables."""

from torchcover.files.bad_file import BadFileError, TooLargeError, check_memory, decode, naming, read_short_text, reads
from torchcover.files.csv_tables import read_csv
from torchcover.files.durable import write_durably
from torchcover.files.feather import read_feather
from torchcover.files.json_tables import read_json_table
from torchcover.files.numpy_files import DEFLATE_MAX_RATIO, NpyHeader, npz_headers, read_npy, read_npz, write_npz
from torchcover.files.xml_text import feed_xml, parse_xml
from torchcover.files.yaml_text import as_yaml, parse_yaml

__all__ = [
    "DEFLATE_MAX_RATIO",
    "BadFileError",
    "NpyHeader",
    "TooLargeError",
    "as_yaml",
    "check_memory",
    "decode",
    "feed_xml",
    "naming",
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
    "write_durably",
    "write_npz",
]
