"""Files that users name, read with an end in sight."""

import os
import select
import stat
from pathlib import Path

MOST_BYTES = 256 * 2**20
"""Of a file: a million waypoints are less."""
PATIENCE_S = 60.0
"""For so long a pipe may say nothing: longer than a planner takes that writes to it."""
_BLOCK = 2**20


def read_text(
    file: Path, encoding: str = "utf-8", errors: str = "strict", most: int = MOST_BYTES
) -> str:
    """All of a file.  Raises OSError as `read_content`, UnicodeError for one that is no text."""
    return read_content(file, most).decode(encoding, errors)


def read_content(file: Path, most: int = MOST_BYTES) -> bytes:
    """All of a file.  Raises OSError, with a `strerror`, for one that can't be read, has more than
    `most` bytes, or is a pipe that nothing comes from for PATIENCE_S.
    """
    with open(file, "rb", opener=_at_once) as data:
        if stat.S_ISREG(os.fstat(data.fileno()).st_mode):
            content = data.read(most + 1)
        else:
            content = _from_pipe(data.fileno(), file, most)
    if len(content) > most:
        raise OSError(None, f"longer than {most / 2**20:g} MiB", str(file))
    return content


def _at_once(name: str, flags: int) -> int:
    """Opens it; a pipe that nobody writes to would keep us here already."""
    return os.open(name, flags | os.O_NONBLOCK)


def _from_pipe(pipe: int, file: Path, most: int) -> bytes:
    """What comes out of a pipe or a device."""
    found, waiting = bytearray(), select.poll()
    waiting.register(pipe, select.POLLIN)
    while len(found) <= most:
        if not waiting.poll(1e3 * PATIENCE_S):
            raise OSError(None, f"nothing came from it for {PATIENCE_S:g} s", str(file))
        block = os.read(pipe, _BLOCK)
        if not block:
            break
        found += block
    return bytes(found)
