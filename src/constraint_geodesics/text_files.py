"""Text files that users name, read with an end in sight."""

from pathlib import Path

MOST_BYTES = 256 * 2**20
"""Of a file: a million waypoints are less."""


def read_text(file: Path, encoding: str = "utf-8") -> str:
    """All of a file.  Raises OSError, with a `strerror`, for one that can't be read or does not end
    within MOST_BYTES, UnicodeError for one that is no text.
    """
    with file.open("rb") as data:
        content = data.read(MOST_BYTES + 1)
    if len(content) > MOST_BYTES:
        raise OSError(None, f"longer than {MOST_BYTES // 2**20} MiB", str(file))
    return content.decode(encoding)
