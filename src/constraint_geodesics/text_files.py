"""Files that others wrote, read with an end in sight."""

from __future__ import annotations

import io
import json
import zlib
from gzip import BadGzipFile, GzipFile
from pathlib import Path
from typing import Any, BinaryIO

MOST_BYTES = 256 * 2**20
"""Of a file: a million waypoints are less."""
MOST_ENTRIES = 10**7
"""Of a file of YAML, its aliases unfolded."""
_GZIP = b"\x1f\x8b"


def read_text(file: Path, encoding: str = "utf-8") -> str:
    """All of a file.  Raises OSError, with a `strerror`, for one that can't be read or does not end
    within MOST_BYTES, UnicodeError for one that is no text.
    """
    with file.open("rb") as data:
        return _bounded(data, file).decode(encoding)


def read_bytes(file: Path) -> bytes:
    """All of a regular file.  Raises OSError, with a `strerror`, for one that can't be read or is
    longer than MOST_BYTES, and for a pipe or device, which may never end.
    """
    if file.exists() and not file.is_file():
        raise OSError(None, "is no regular file", str(file))
    with file.open("rb") as data:
        return _bounded(data, file)


def read_json(file: Path) -> Any:
    """What a JSON file holds.  Raises OSError as `read_bytes`, ValueError for what is no JSON or is
    nested too deeply.
    """
    return parse_json(read_bytes(file))


def parse_json(content: bytes | str) -> Any:
    """What JSON holds.  Raises ValueError, one line, for what is none or is nested too deeply."""
    try:
        return json.loads(content)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def unpacked(content: bytes, file: Path) -> bytes:
    """The content of a file, unpacked where it is gzipped.  Raises OSError, with a `strerror`, for
    a damaged one, and one that grows beyond MOST_BYTES.
    """
    if not content.startswith(_GZIP):
        return content
    try:
        with GzipFile(fileobj=io.BytesIO(content)) as data:
            return _bounded(data, file)
    except (BadGzipFile, EOFError, zlib.error) as error:
        raise OSError(None, f"gzipped, and damaged: {error}", str(file)) from None


def require_few_entries(value: Any) -> None:
    """Raises ValueError for lists and mappings that hold more than MOST_ENTRIES in all, each as
    often as it is named: a few lines of YAML name one another until nothing could print them.
    """
    counts: dict[int, int] = {}

    def entries(own: Any) -> int:
        if not isinstance(own, (dict, list, tuple, set)):
            return 1
        if id(own) not in counts:
            counts[id(own)] = MOST_ENTRIES + 1  # of what is within itself
            inner = own.values() if isinstance(own, dict) else own
            counts[id(own)] = 1 + sum(entries(each) for each in inner)
        return counts[id(own)]

    if entries(value) > MOST_ENTRIES:
        raise ValueError(f"its aliases unfold to more than {MOST_ENTRIES} entries")


def _bounded(data: BinaryIO | GzipFile, file: Path) -> bytes:
    content = data.read(MOST_BYTES + 1)
    if len(content) > MOST_BYTES:
        raise OSError(None, f"longer than {MOST_BYTES // 2**20} MiB", str(file))
    return content
