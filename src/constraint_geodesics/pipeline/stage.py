"""How a stage starts, and how an error ends a program."""

import inspect
import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from constraint_geodesics.errors import ParamsError, WrongUsageError
from constraint_geodesics.extras import MissingExtraError
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.threads import one_thread
from constraint_geodesics.progress import waiting
from constraint_geodesics.text_files import is_number, read_text, write_text

if TYPE_CHECKING:
    from constraint_geodesics.params import Params

WRONG_USAGE = 2
SHOWN = (ValueError, OSError, RuntimeError, MissingExtraError, MemoryError)
"""Errors that end a program with one line: what went wrong lies in what it was given, or in the
machine.
"""


def run_stage(stage: Callable[..., None], arguments: Sequence[str]) -> None:
    """Run one stage in this checkout: check params.yaml first, and report a bad input in one line.

    What runs in this process computes on one thread, libraries that are loaded already too, so that
    results are those of `make`; more cores are used by `parallel_map`.
    arguments: the names after (params, layout), as dvc.yaml passes them; each must be one that
    params.yaml has.
    """
    from constraint_geodesics.params import load_params
    from constraint_geodesics.pipeline.lock_files import keep_locks

    began, name = time.perf_counter(), Path(sys.argv[0]).stem
    try:
        params = load_params()
        _check_names(params, stage, arguments)
        keep_locks(Layout().root)
        with one_thread(), waiting(" ".join([name, *arguments])):
            stage(params, Layout(), *arguments)
        note_stage_time(Layout().stage_times, name, arguments, time.perf_counter() - began)
    except SHOWN as error:
        if os.environ.get("GEODESICS_TRACEBACK"):
            raise
        raise SystemExit(complain(error)) from None


def note_stage_time(file: Path, stage: str, names: Sequence[str], seconds: float) -> None:
    """Keep how long the last finished run of each stage took, workers and all: what training costs
    is read from it.

    Lines that can't be read, as a merge leaves some, are left out: the work is done, and must not
    fail for them.
    """
    kept = _stage_times(file)
    kept[" ".join([stage, *names])] = f"{seconds:.1f}"
    table = ["stage,seconds", *(f"{own},{kept[own]}" for own in sorted(kept))]
    write_text(file, "\n".join(table) + "\n")


def _stage_times(file: Path) -> dict[str, str]:
    """Seconds by stage, of the lines that can be read."""
    if not file.is_file():
        return {}
    cells = [line.split(",") for line in read_text(file, errors="replace").splitlines()]
    return {own[0]: own[1] for own in cells if len(own) == 2 and own[0] and _is_time(own[1])}


def _is_time(text: str) -> bool:
    return is_number(text) and math.isfinite(float(text))


def complain(error: Exception, code: int | None = None) -> int:
    """Print an error in one line; returns the exit code, by default that of its kind."""
    print(f"error: {_plain(_said(error))}", file=sys.stderr)
    if code is not None:
        return code
    return WRONG_USAGE if isinstance(error, WrongUsageError | MissingExtraError) else 1


def _said(error: Exception) -> str:
    """What it says; Python's own lack of memory says nothing."""
    if not isinstance(error, MemoryError):
        return str(error)
    return f"this machine's memory is not enough: {error}".removesuffix(": ")


def _plain(text: str) -> str:
    """In one line, without what a terminal would obey: a file's name may hold anything."""
    shown = (c if c.isprintable() or c.isspace() else ascii(c)[1:-1] for c in text)
    return " ".join("".join(shown).split())


def _check_names(params: "Params", stage: Callable[..., None], arguments: Sequence[str]) -> None:
    """Each argument must be a name of the kind that the stage's own parameter is called after."""
    kinds = list(inspect.signature(stage).parameters)[2:]
    if len(kinds) != len(arguments):
        names = ", ".join(kinds)
        raise ParamsError(f"this stage takes {len(kinds)} names ({names}), not {len(arguments)}")
    known: dict[str, list[str]] = {
        "constraint": list(params.constraints),
        "manifold": list(params.manifolds),
        "analytic": list(params.geodesics.analytic),
    }
    for kind, name in zip(kinds, arguments, strict=True):
        if name not in known[kind]:
            raise ParamsError(
                f"params.yaml: there is no {kind} {name!r}: must be one of {known[kind]}"
            )
