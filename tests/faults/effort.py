"""How much a run of these tests tries, and where what was tried is counted."""

import json
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock

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
"""In `make test`."""
FAULTS = Effort("faults", kills=3, requests=3_000, load_s=30.0, faults=200)
"""In `make test-faults`, half an hour at most."""
SOAK = Effort("soak", kills=20, requests=100_000, load_s=300.0, faults=2_000)
"""In `make soak`, hours."""


def count(part: str, effort: Effort, **figures: float | int | str) -> None:
    """Keep figures of one part of these tests, in the place of what the file had of the part.

    A part that fewer were tried of than the file tells of leaves the file as it is: `make soak`'s
    figures stay when `make test-faults` follows.
    """
    if COUNTS not in os.environ:
        return
    file = Path(os.environ[COUNTS])
    with FileLock(Path(tempfile.gettempdir()) / f"{file.name}.lock"):
        counts = json.loads(file.read_text()) if file.exists() else {}
        before = counts.get(part)
        if before and _order(before["effort"]) > _order(effort.name):
            return
        counts[part] = {"effort": effort.name, **figures}
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(dict(sorted(counts.items())), indent=1) + "\n")


def _order(name: str) -> int:
    return [effort.name for effort in (QUICK, FAULTS, SOAK)].index(name)
