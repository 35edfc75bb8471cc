"""Tables in Parquet with an end in sight: a few kilobytes may say that they unpack to any size."""

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from constraint_geodesics.text_files import require_short

_NUMBER = 8  # bytes


def read_parquet(file: Path) -> pa.Table:
    """All of a table; a page's checksum is looked at where it has one.

    Raises OSError, with a `strerror`, where it says of itself that it is longer than what is read
    of any file, and what pyarrow raises for none.
    """
    with pq.ParquetFile(file, page_checksum_verification=True) as table:
        about = table.metadata
        groups = [about.row_group(k) for k in range(about.num_row_groups)]
        # a value that repeats takes no room in the file, and is counted here
        values = sum(g.column(k).num_values for g in groups for k in range(g.num_columns))
        unpacked = max(_NUMBER * values, sum(group.total_byte_size for group in groups))
        require_short(unpacked, file, what=", unpacked")
        return table.read()
