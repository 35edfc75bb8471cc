"""Files that users and stages read: texts with an end in sight, any kind written whole or not at
all.
"""

import io
import json
import os
import select
import stat
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from gzip import BadGzipFile, GzipFile
from pathlib import Path
from typing import Any, BinaryIO

MOST_BYTES = 256 * 2**20
"""Of a file: a million waypoints are less."""
PATIENCE_S = 60.0
"""For so long a pipe may say nothing: longer than a planner takes that writes to it."""
_BLOCK = 2**20
_GZIP = b"\x1f\x8b"


def read_text(
    file: Path, encoding: str = "utf-8", errors: str = "strict", most: int = MOST_BYTES
) -> str:
    """All of a file.  Raises OSError as `read_content`, UnicodeError for one that is no text."""
    return read_content(file, most).decode(encoding, errors)


def read_content(file: Path, most: int = MOST_BYTES, *, piped: bool = True) -> bytes:
    """All of a file.

    piped: whether it may come out of a pipe or a device, which nobody keeps anything in.  Raises
    OSError, with a `strerror`, for one that can't be read, has more than `most` bytes, or is a pipe
    that nothing comes from for PATIENCE_S.
    """
    with open_at_once(file, piped=piped) as data:
        plain = _is_plain(data)
        content = data.read(most + 1) if plain else _from_pipe(data.fileno(), file, most)
    require_short(len(content), file, most)
    return content


@contextmanager
def open_at_once(file: Path, *, piped: bool = False) -> Iterator[BinaryIO]:
    """A file, open to be read; a pipe that nobody writes to would keep a plain `open`.

    Raises OSError, with a `strerror`, for one that can't be read, and a pipe or a device unless it
    may be `piped`.
    """
    with open(file, "rb", opener=lambda name, how: os.open(name, how | os.O_NONBLOCK)) as data:
        if not (piped or _is_plain(data)):
            raise OSError(None, "is no regular file", str(file))
        yield data


def _is_plain(data: BinaryIO) -> bool:
    return stat.S_ISREG(os.fstat(data.fileno()).st_mode)


def require_short(size: int, file: Path, most: int = MOST_BYTES, what: str = "") -> None:
    """Raises OSError, with a `strerror`, where a file has more bytes than are read."""
    if size > most:
        raise OSError(None, f"longer than {most / 2**20:g} MiB{what}", str(file))


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
        raise DamagedFileError(f"{file}: damaged: {reason_of(error)}") from error


def reason_of(error: BaseException) -> str:
    """What an error says, in one line, without the name of its file."""
    said = (error.strerror if isinstance(error, OSError) else None) or str(error)
    return " ".join(said.split())[:200] or type(error).__name__


def is_number(word: str) -> bool:
    """Whether Python reads it as a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True


def kept_json(file: Path) -> Any:
    """What was kept in a file of JSON; None where it is missing or damaged, and is made again."""
    try:
        with reading(file):
            return read_json(file)
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


def read_json(file: Path) -> Any:
    """What a JSON file holds that this project wrote.

    Raises OSError as `read_content`, ValueError for what is no JSON or is nested too deeply.
    """
    return parse_json(read_content(file, piped=False))


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
            plain = data.read(MOST_BYTES + 1)
    except (BadGzipFile, EOFError, zlib.error) as error:
        raise OSError(None, f"gzipped, and damaged: {error}", str(file)) from None
    require_short(len(plain), file, what=", unpacked")
    return plain
