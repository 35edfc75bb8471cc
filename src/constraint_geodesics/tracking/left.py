"""Folders of the runs that a process works on, and how one whose process is gone is told for sure.

`.geodesics/runs/<key>/` has a file that the run's process holds locked; the lock ends with the
process, however it ends, and nobody else's number or clock is trusted.  A folder that was copied,
to another machine perhaps, is another file, which says nothing of the process.  What the store did
not take lies beside it.

Only the standard library is imported, and what Python 3.8 reads is kept to: `doctor` looks here.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import uuid
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator

RUNS = Path(".geodesics") / "runs"
"""Relative to the checkout."""
HELD, UNSENT, SENT = "process.json", "unsent.jsonl", "sent"


class AtWorkError(RuntimeError):
    """Another process does the same; the message is one line with its number."""


@dataclass(frozen=True)
class Left:
    """A run whose process is gone.  name: its stage and item.  store: where it is."""

    folder: Path
    name: str
    store: str

    @property
    def unsent(self) -> int:
        """How much its store did not take."""
        calls, done = kept_calls(self.folder)
        return len(calls) - done


def kept_calls(folder: Path) -> tuple[list[dict[str, Any]], int]:
    """What a run told its store that this did not take, and how much of it was told since."""
    unsent, sent, calls = folder / UNSENT, folder / SENT, []
    for line in unsent.read_text("utf-8").split("\n") if unsent.is_file() else ():
        with suppress(ValueError):  # blank, or killed while it was written
            calls.append(json.loads(line))
    return calls, int(sent.read_text("utf-8")) if calls and sent.is_file() else 0


def hold(root: Path, name: str, store: str) -> Path:
    """A folder of this process, for a run, until `release` or the end of the process; the same one
    for the same name.  Raises AtWorkError where another process has one of that name: both would
    write the same files.
    """
    runs = root.resolve() / RUNS
    if (str(runs), name) in _held:
        return _held[str(runs), name][0]
    runs.mkdir(parents=True, exist_ok=True)
    with (runs / ".lock").open("w") as one_at_a_time:
        fcntl.flock(one_at_a_time, fcntl.LOCK_EX)
        _refuse_second(runs, name)
        key = uuid.uuid4().hex[:16]
        new = runs / ("." + key)  # nobody looks at it before it is locked
        new.mkdir()
        file = os.open(str(new / HELD), os.O_RDWR | os.O_CREAT, 0o644)
        fcntl.flock(file, fcntl.LOCK_EX)
        told = {"name": name, "store": store, "file": os.fstat(file).st_ino, "pid": os.getpid()}
        os.write(file, json.dumps(told).encode())
        new.rename(runs / key)
    _held[str(runs), name] = runs / key, file
    return runs / key


def _refuse_second(runs: Path, name: str) -> None:
    for folder in runs.glob("[!.]*"):
        file = _locked(folder)
        if file is not None:
            os.close(file)
            continue
        with suppress(OSError, ValueError, KeyError):  # it may be gone by now
            told = json.loads((folder / HELD).read_text("utf-8"))
            if told["name"] == name:
                raise AtWorkError(f"{name}: process {told['pid']} is at work on it already")


_held: dict[tuple[str, str], tuple[Path, int]] = {}


def release(folder: Path) -> None:
    """Of this process no more; the folder goes unless something in it was not sent."""
    own = [place for place, (held, _) in _held.items() if held == folder]
    if not (folder / UNSENT).exists():
        shutil.rmtree(str(folder), ignore_errors=True)
    for place in own:
        os.close(_held.pop(place)[1])


def left_runs(root: Path) -> list[Left]:
    """Runs of this checkout whose process is gone."""
    folders = sorted((root.resolve() / RUNS).glob("[!.]*"))
    return [left for folder in folders for left in _looked_at(folder)]


@contextmanager
def taken(left: Left) -> Iterator[bool]:
    """Whether this process has the run of a gone one to itself for the time of the block."""
    file = _locked(left.folder)
    try:
        yield file is not None
    finally:
        if file is not None:
            os.close(file)


def _looked_at(folder: Path) -> Iterator[Left]:
    file = _locked(folder)
    if file is None:
        return
    try:
        told = json.loads(os.read(file, 2**16))
        if told["file"] == os.fstat(file).st_ino:
            yield Left(folder, told["name"], told["store"])
    except (ValueError, KeyError, TypeError):
        return  # not written by `hold`
    finally:
        os.close(file)


def _locked(folder: Path) -> int | None:
    """The folder's file, locked; None where another process has it."""
    try:
        file = os.open(str(folder / HELD), os.O_RDWR)
    except OSError:
        return None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(file)
        return None
    return file
