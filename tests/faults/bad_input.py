"""What bad input must come to: one line of a typed error that names the culprit, soon."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

LONGEST = 500
"""Letters of a message."""
SECONDS = 60
"""That one of them may take, on a machine that does other things."""


class Bad(NamedTuple):
    """A call, and what the line says that refuses it.  said: parts of it, as they are.  refused:
    it must be; else it may also be answered.
    """

    name: str
    ask: Callable[[], object]
    said: tuple[str, ...]
    refused: bool = True


@dataclass
class Tally:
    """What was tried, and what went wrong."""

    cases: int = 0
    tracebacks: int = 0
    accepted: int = 0
    hung: int = 0
    unnamed: int = 0
    wrong: list[str] = field(default_factory=list)

    def judge(self, case: Bad) -> None:
        """Ask, and note what is not as it must be."""
        self.cases += 1
        try:
            with _in_time():
                found = case.ask()
        except _HangsError:
            self.hung += 1
            self.wrong.append(f"{case.name}: is not answered within {SECONDS} s")
        except Exception as error:
            self._refused(case, error)
        else:
            if case.refused:
                self.accepted += 1
                self.wrong.append(f"{case.name}: accepted: {str(found)[:200]}")

    def row(self, *names: str) -> dict[str, int]:
        """Some of the counts by their names."""
        return {name: getattr(self, name) for name in names}

    def _refused(self, case: Bad, error: Exception) -> None:
        line, kind = str(error), type(error)
        typed = kind.__module__.startswith("constraint_geodesics")
        if not (typed and isinstance(error, ValueError)):
            self.tracebacks += 1
            self.wrong.append(f"{case.name}: {kind.__name__}: {line[:200]}")
        elif "\n" in line or len(line) > LONGEST or not all(part in line for part in case.said):
            self.unnamed += 1
            self.wrong.append(f"{case.name}: {case.said} is not in one line: {line[:300]}")


class _HangsError(BaseException):
    pass


@contextmanager
def _in_time() -> Iterator[None]:
    def stop(*_: object) -> None:
        raise _HangsError

    before, left = (
        signal.signal(signal.SIGALRM, stop),
        signal.setitimer(signal.ITIMER_REAL, SECONDS),
    )
    try:
        yield
    finally:
        signal.signal(signal.SIGALRM, before)
        signal.setitimer(signal.ITIMER_REAL, *left)  # the test's own time


def written(folder: Path, name: str, content: str | bytes) -> Path:
    """A file with some content."""
    file = folder / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(content.encode() if isinstance(content, str) else content)
    return file
