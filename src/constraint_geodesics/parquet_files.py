"""Tables in Parquet with an end in sight: a few kilobytes may say that they unpack to any size."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import pyarrow.parquet as pq

from constraint_geodesics.text_files import open_at_once, require_short

_NUMBER = 8  # bytes
_TEXTS = ("BYTE_ARRAY", "FIXED_LEN_BYTE_ARRAY")


def read_parquet(file: Path, wanted: Sequence[str] = ()) -> pd.DataFrame:
    """Columns of numbers, those that are there of `wanted`, else all; a page's checksum is looked
    at where it has one.

    Raises OSError, with a `strerror`, for no plain file and where they say of themselves that they
    are longer than what is read of any file, ValueError for a column of texts, and what pyarrow
    raises for no table.
    """
    with (
        open_at_once(file) as content,
        pq.ParquetFile(content, page_checksum_verification=True) as table,
    ):
        columns = [table.schema.column(k) for k in range(len(table.schema))]
        asked = [
            k
            for k, own in enumerate(columns)
            if not wanted or any(f"{own.path}.".startswith(f"{name}.") for name in wanted)
        ]
        for k in asked:
            if columns[k].physical_type in _TEXTS:
                raise ValueError(f"column {columns[k].path!r} holds texts, not numbers")
        about = table.metadata
        groups = [about.row_group(k) for k in range(about.num_row_groups)]
        # a value that repeats takes no room in the file, and is counted here
        values = sum(group.column(k).num_values for group in groups for k in asked)
        require_short(_NUMBER * values, file, what=", unpacked")
        return table.read(columns=[columns[k].path for k in asked]).to_pandas()
