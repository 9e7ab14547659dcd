"""Feather tables with invalid lengths and offsets."""

import numpy as np
import pytest

from torchcover.files import BadFileError
from torchcover.recordings.isolated_readers import read_feather

pa = pytest.importorskip("pyarrow")


def test_feather_texts_beyond_the_file_are_refused(tmp_path):
    from pyarrow import feather

    path = tmp_path / "table.feather"
    feather.write_feather(pa.table({"category": ["car", "bus"]}), path, compression="uncompressed")
    ends = np.array([0, 3, 6], dtype="<i4").tobytes()
    written = path.read_bytes()
    assert written.count(ends) == 1
    path.write_bytes(written.replace(ends, np.array([0, 3, 1 << 30], dtype="<i4").tobytes()))
    with pytest.raises(BadFileError, match=r"table.feather"):
        read_feather(path, ["category"])
