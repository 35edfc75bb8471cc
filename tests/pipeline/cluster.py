"""A real Dask scheduler and its workers: processes of their own, on loopback."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from constraint_geodesics.params import ComputeParams

DEAD = 9
"""The exit code of a worker that dies in a task that is made to."""
ORDERLY = {0, DEAD, -signal.SIGKILL}
_DASK = [sys.executable, "-m", "dask"]
_STARTS_S = 120


@dataclass(frozen=True)
class Cluster:
    """compute: settings with which work goes to it.  log: of all its processes."""

    scheduler: subprocess.Popen[bytes]
    workers: tuple[subprocess.Popen[bytes], ...]
    compute: ComputeParams
    log: Path


@contextmanager
def cluster(
    folder: Path, workers: int = 2, allowed_failures: int = 0, threads: int = 1
) -> Iterator[Cluster]:
    """Whose processes must stop in order when asked to, where none has killed them.

    allowed_failures: how often a task may lose its worker and go to another.
    """
    file, log = folder / "scheduler.json", folder / "log.txt"
    loopback = ["--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", str(file)]
    one = ["--no-nanny", "--nthreads", str(threads), "--local-directory", str(folder)]
    root = Path(__file__).parents[2]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(root), str(root / "src")]),
        "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": str(allowed_failures),
        # workers that someone started with other ideas
        "OMP_NUM_THREADS": "2",
        "OPENBLAS_NUM_THREADS": "2",
    }
    with log.open("w") as output:
        options = {"stdout": output, "stderr": output, "env": environment, "cwd": folder}
        scheduler = subprocess.Popen([*_DASK, "scheduler", "--port", "0", *loopback], **options)
        started = [
            subprocess.Popen([*_DASK, "worker", *one, *loopback], **options) for _ in range(workers)
        ]
        try:
            compute = ComputeParams(backend="dask", workers=0, dask_address=_address(file))
            yield Cluster(scheduler, tuple(started), compute, log)
        finally:
            # workers first: one that is told to stop by its scheduler and by a signal at once may
            # hang
            codes = [_stop(process) for process in (*started, scheduler)]
    # workers that lost their scheduler end by themselves, and not always in order
    assert codes[-1] == -signal.SIGKILL or set(codes) <= ORDERLY, log.read_text()


def _address(file: Path) -> str:
    """Of the scheduler, once its file is written as a whole."""
    deadline = time.monotonic() + _STARTS_S
    while True:
        try:
            return str(json.loads(file.read_text())["address"])
        except (OSError, ValueError):
            if time.monotonic() > deadline:
                raise
            time.sleep(0.05)


def _stop(process: subprocess.Popen[bytes]) -> int:
    process.terminate()
    try:
        return process.wait(20)
    except subprocess.TimeoutExpired:
        process.kill()
        raise
