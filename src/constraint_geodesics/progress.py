"""How far a long piece of work has come, on standard error."""

import multiprocessing
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # Rich is loaded where there is a terminal, not for `geodesics --help`
    from rich.progress import Progress

LINE_EVERY_S = 15.0
CELL_EVERY_S = 0.2
CELL_WIDTH = 30
"""Of a bar in a notebook [letters]."""
LINE_AFTER_S = 2.0
"""Work that is over sooner says nothing where there is no terminal."""


@contextmanager
def progress(description: str, total: int) -> Iterator[Callable[[], None]]:
    """Show how many of `total` tasks are done; the function it gives is called after each of them.

    On a terminal and in a notebook a bar with the time left.  Elsewhere plain lines: one at every
    quarter, one where 15 s passed since the last, and with CI=true the last line alone.  An empty
    description shows nothing.
    """
    if not description:
        yield lambda: None
        return
    in_notebook = type(sys.stderr).__module__.startswith("ipykernel")
    elsewhere = _cell if in_notebook else _lines
    shown = _bar if sys.stderr.isatty() else elsewhere
    with shown_already(), shown(description, total) as advance:
        yield advance


@contextmanager
def waiting(description: str) -> Iterator[None]:
    """Show that work whose length nobody knows goes on: on a terminal a line with the time it took
    so far, which goes when the work is done and gives way to a bar or another such line within it;
    elsewhere, a notebook too, one plain line after two seconds.  An empty description shows
    nothing.
    """
    if not description or not sys.stderr.isatty():
        with _line_after(f"{description} …" if description else ""):
            yield
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn())
    bar = Progress(*columns, console=Console(stderr=True), transient=True)
    with _given_way(), bar as line:
        line.add_task(description, total=None)
        _waiting.append(line)
        try:
            with shown_already():
                yield
        finally:
            _waiting.remove(line)


def saying_late(description: str) -> AbstractContextManager[None]:
    """Within what people call, and what may take long: one plain line after two seconds, where
    nothing else is shown.
    """
    return _line_after(f"{description} …") if may_show() else nullcontext()


def may_show() -> bool:
    """Workers, threads as processes, leave it to who started them, and what is within something
    that is shown to that.
    """
    alone = multiprocessing.current_process().name == "MainProcess"
    has_bar = type(sys.stderr).__module__ == "rich.file_proxy"  # somebody else's
    is_first = threading.current_thread() is threading.main_thread()
    return alone and is_first and not has_bar and not _showing


_showing = 0
"""How many bars and lines are shown, or will be soon."""


@contextmanager
def shown_already() -> Iterator[None]:
    """Within, what people call shows nothing of its own."""
    global _showing
    _showing += 1
    try:
        yield
    finally:
        _showing -= 1


@contextmanager
def _line_after(line: str) -> Iterator[None]:
    """Write a line if the body is not over soon."""
    if not line:
        yield
        return
    late = threading.Timer(LINE_AFTER_S, print, (line,), {"file": sys.stderr, "flush": True})
    late.daemon = True
    late.start()
    try:
        with shown_already():
            yield
    finally:
        late.cancel()


_waiting: list["Progress"] = []
"""The lines that are shown now: a terminal has one bottom, which what is within them needs."""


@contextmanager
def _given_way() -> Iterator[None]:
    lines = tuple(_waiting)
    for line in lines:
        line.stop()
    try:
        yield
    finally:
        for line in lines:
            line.start()


@contextmanager
def _bar(description: str, total: int) -> Iterator[Callable[[], None]]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[left]}"),
    )
    start = time.monotonic()
    with _given_way(), Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(description, total=total, left="")
        done = 0

        def advance() -> None:
            nonlocal done
            done += 1
            bar.update(task, advance=1, left=_time_left(done, total, start))

        yield advance


@contextmanager
def _cell(description: str, total: int) -> Iterator[Callable[[], None]]:
    """One line that is written again and again: Rich's bars need widgets in a notebook."""
    start = shown = time.monotonic()
    done = longest = 0

    def write(end: str = "") -> None:
        nonlocal longest
        full = CELL_WIDTH * done // max(total, 1)
        bar = "━" * full + "─" * (CELL_WIDTH - full)
        left = f", {_time_left(done, total, start)}" if done else ""
        line = f"{description} {bar} {done}/{total}{left}"
        longest = max(longest, len(line))
        print(f"\r{line:<{longest}}", end=end, file=sys.stderr, flush=True)

    def advance() -> None:
        nonlocal done, shown
        done += 1
        if done == total:
            write("\n")
        elif time.monotonic() - shown >= CELL_EVERY_S:
            shown = time.monotonic()
            write()

    write()
    yield advance


@contextmanager
def _lines(description: str, total: int) -> Iterator[Callable[[], None]]:
    only_last = os.environ.get("CI", "").lower() in ("true", "1")
    start = shown = time.monotonic()
    done = 0

    def advance() -> None:
        nonlocal done, shown
        done += 1
        quarter = 4 * done // total > 4 * (done - 1) // total
        due = (quarter or time.monotonic() - shown >= LINE_EVERY_S) and not only_last
        if due or done == total:
            shown = time.monotonic()
            print(
                f"{description}: {done}/{total}, {_time_left(done, total, start)}",
                file=sys.stderr,
                flush=True,
            )

    yield advance


def _time_left(done: int, total: int, start: float) -> str:
    """The mean time a task took so far, for those that remain."""
    elapsed = time.monotonic() - start
    if done == total:
        return f"took {_clock(elapsed)}"
    return f"about {_clock(elapsed / done * (total - done))} left"


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d} min" if minutes else f"{rest} s"
