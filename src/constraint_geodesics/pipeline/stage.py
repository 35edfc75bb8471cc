"""How a stage starts, and how an error ends a program."""

import inspect
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
from constraint_geodesics.text_files import reading, write_text

if TYPE_CHECKING:
    from constraint_geodesics.params import Params

WRONG_USAGE = 2


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
    except (ValueError, OSError, RuntimeError, MissingExtraError) as error:
        if os.environ.get("GEODESICS_TRACEBACK"):
            raise
        raise SystemExit(complain(error)) from None


def note_stage_time(file: Path, stage: str, names: Sequence[str], seconds: float) -> None:
    """Keep how long the last finished run of each stage took, workers and all: what training costs
    is read from it.
    """
    with reading(file):
        lines = file.read_text().splitlines()[1:] if file.is_file() else []
        kept = dict(line.split(",") for line in lines)
    kept[" ".join([stage, *names])] = f"{seconds:.1f}"
    table = ["stage,seconds", *(f"{own},{kept[own]}" for own in sorted(kept))]
    write_text(file, "\n".join(table) + "\n")


def complain(error: Exception, code: int | None = None) -> int:
    """Print an error in one line; returns the exit code, by default that of its kind."""
    print(f"error: {_plain(str(error))}", file=sys.stderr)
    if code is not None:
        return code
    return WRONG_USAGE if isinstance(error, WrongUsageError | MissingExtraError) else 1


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
