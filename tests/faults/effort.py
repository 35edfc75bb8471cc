"""How much a run of these tests tries, and where what was tried is counted."""

import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock

from constraint_geodesics.pipeline.machine import git_says, machine
from constraint_geodesics.text_files import write_text

ROOT = Path(__file__).resolve().parents[2]

COUNTS = "GEODESICS_RELIABILITY"
"""The environment's name of the JSON file that counts are written to; without it there are none."""


@dataclass(frozen=True)
class Effort:
    """kills: of each stage.  requests: random ones.  load_s: seconds under load of each number of
    clients.  faults: injected into one write at most.  name: as the counts have it.
    """

    name: str
    kills: int
    requests: int
    load_s: float
    faults: int


QUICK = Effort("quick", kills=1, requests=300, load_s=5.0, faults=20)
"""In `make test` and `make test-experiments`."""
FAULTS = Effort("faults", kills=3, requests=1_000, load_s=30.0, faults=200)
"""In `make test-faults`, which is to take half an hour at most."""
SOAK = Effort("soak", kills=20, requests=100_000, load_s=300.0, faults=2_000)
"""In `make soak`, hours."""


Row = dict[str, Any]
"""What the file has of one part of these tests."""


@contextmanager
def counting(part: str, effort: Effort) -> Iterator[Row]:
    """Within, the figures of one part of these tests are measured; they take the place of its row.

    The row is taken out of the file first, and a body that fails, is interrupted or killed, or
    measures nothing leaves none: no figure outlives the test that it rests on.  A row of more
    effort comes back when the body has passed, so `make soak`'s figures, with their commit, stay
    when `make test-faults` follows.  It comes back also where the body is skipped.
    """
    before, row, began = _exchanged(part, None), Row(), time.monotonic()
    commit = _commit() if COUNTS in os.environ else ""
    try:
        yield row
    except pytest.skip.Exception:
        _exchanged(part, before)
        raise
    if not row:
        return
    if before and _order(before["effort"]) > _order(effort.name):
        _exchanged(part, before)
        return
    about = {
        "commit": commit,
        "seconds": round(time.monotonic() - began, 1),
        "processor": machine()["processor"],
    }
    _exchanged(part, {"effort": effort.name, **about, **row})


@contextmanager
def counted_at_end(
    part: str, effort: Effort, session: pytest.Session, found: Callable[[], Row]
) -> Iterator[None]:
    """Around all tests of a file: their figures are its row if none failed and nobody interrupted
    them.
    """
    failed = session.testsfailed
    with counting(part, effort) as row:
        yield
        if session.testsfailed == failed and session.exitstatus != pytest.ExitCode.INTERRUPTED:
            row |= found()


def _exchanged(part: str, row: Row | None) -> Row | None:
    """Put a row in the place of what the file has of a part, none where it is None; returns what
    the file had.
    """
    if COUNTS not in os.environ:
        return None
    file = ROOT / os.environ[COUNTS]  # wherever a test has gone by now
    with FileLock(Path(tempfile.gettempdir()) / f"{file.name}.lock"):
        rows: dict[str, Row] = json.loads(file.read_text()) if file.exists() else {}
        before = rows.pop(part, None)
        if row is not None:
            rows[part] = row
        if row != before:
            write_text(file, json.dumps(dict(sorted(rows.items())), indent=1) + "\n")
    return before


def _commit() -> str:
    """Its short hash, with a + where files besides reports are not as it has them; blank where
    there is no Git.
    """
    found = git_says(ROOT, "rev-parse", "--short", "HEAD")
    changed = found and git_says(ROOT, "status", "--porcelain", "--", ".", ":!reports")
    return found + "+" * bool(changed)


def _order(name: str) -> int:
    return [effort.name for effort in (QUICK, FAULTS, SOAK)].index(name)
