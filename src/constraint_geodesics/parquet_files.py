"""Tables in Parquet with an end in sight: a few kilobytes may say that they unpack to any size."""

from pathlib import Path

import pandas as pd
import pyarrow.parquet as pq

from constraint_geodesics.text_files import require_short

_NUMBER = 8  # bytes
_TEXTS = ("BYTE_ARRAY", "FIXED_LEN_BYTE_ARRAY")


def read_parquet(file: Path) -> pd.DataFrame:
    """The columns of numbers; a page's checksum is looked at where it has one.

    Raises OSError, with a `strerror`, where they say of themselves that they are longer than what
    is read of any file, and what pyarrow raises for none.
    """
    with pq.ParquetFile(file, page_checksum_verification=True) as table:
        columns = [table.schema.column(k) for k in range(len(table.schema))]
        numbers = [k for k, own in enumerate(columns) if own.physical_type not in _TEXTS]
        about = table.metadata
        groups = [about.row_group(k) for k in range(about.num_row_groups)]
        # a value that repeats takes no room in the file, and is counted here
        values = sum(group.column(k).num_values for group in groups for k in numbers)
        require_short(_NUMBER * values, file, what=", unpacked")
        return table.read(columns=[columns[k].path for k in numbers]).to_pandas()
