"""Files that users and stages read: texts with an end in sight, any kind written whole or not at
all.
"""

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

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


class DamagedFileError(ValueError):
    """A file is not what was written; the message is one line with its name."""


@contextmanager
def reading(file: Path) -> Iterator[None]:
    """Within, all ways in which a library fails on a damaged file are a DamagedFileError.

    Raises OSError as it is where the file is missing or can't be opened.
    """
    try:
        yield
    except DamagedFileError:
        raise
    except Exception as error:  # readers of a format have kinds of their own, or none at all
        if isinstance(error, OSError) and error.filename is not None:
            raise
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise DamagedFileError(f"{file}: damaged: {reason}") from error


def kept_json(file: Path) -> Any:
    """What was kept in a file of JSON; None where it is missing or damaged, and is made again."""
    try:
        with reading(file):
            return json.loads(file.read_text("utf-8"))
    except (DamagedFileError, OSError):
        return None


@contextmanager
def written(file: Path) -> Iterator[Path]:
    """The path of the same name, in a folder of its own beside `file`, at which the body writes; it
    takes the place of `file` at the end.  If anything fails, or the process is killed, `file` is
    what it was.

    Its folder is made.  What is no plain file, as a terminal or a pipe, is written to directly.
    Raises OSError with the name of `file` if it can't be written, besides what the body raises.
    """
    if file.exists() and not file.is_file():
        yield file
        return
    whole = Path(os.path.realpath(file))  # a link stays, and what it leads to is written
    try:
        whole.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(".part", ".", whole.parent) as beside:
            part = Path(beside) / file.name
            yield part
            with part.open("rb") as content:
                os.fsync(content.fileno())  # else a power cut could leave the name without content
            part.replace(whole)
    except OSError as error:
        if error.filename is None or ".part" in str(error.filename):
            raise OSError(error.errno, error.strerror or str(error), str(file)) from error
        raise


def write_text(file: Path, text: str) -> None:
    """A text in UTF-8, whole or not at all, as `written` does."""
    write_bytes(file, text.encode())


def write_bytes(file: Path, content: bytes) -> None:
    """Bytes, whole or not at all, as `written` does."""
    with written(file) as part:
        part.write_bytes(content)
