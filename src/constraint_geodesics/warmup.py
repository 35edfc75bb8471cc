"""Compiling all kernels at once, in several processes, before the first plan: `geodesics warmup`.

The kernels are kept in numba's cache (kernel_cache.py); a mark beside them says that all are there.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from hashlib import sha256
from pathlib import Path

import numba
from numba.core.registry import cpu_target

from constraint_geodesics.robot.kernels import forward_batch

Tell = Callable[[str, float], None]
"""Called with the name of a piece of the work that is done, and the seconds it took."""


class WarmupError(RuntimeError):
    """Kernels that could not be compiled; the message says which and why."""


def is_done() -> bool:
    """Whether everything is compiled, by this numba for this processor: no call compiles more."""
    if not _known_done:
        if not _mark().is_file():
            return False
        _known_done.append(True)
    return True


_known_done: list[bool] = []


def pieces() -> int:
    """How many pieces the work has."""
    from constraint_geodesics.kernel_jobs import JOBS

    return len(JOBS)


def ensure(processes: int | None = None) -> None:
    """Compile what is not compiled yet, with a bar; nothing where all is.  processes: by default as
    many as cores.

    Several callers wait for the first of them.  Raises WarmupError if something can't be compiled.
    """
    if is_done():
        return
    with _alone():
        if is_done():
            return
        from constraint_geodesics.progress import progress  # only where something is shown

        what = "compiling the kernels, once for this environment"
        with progress(what, pieces()) as advance:
            _compile_all(processes or _cores(), lambda *_: advance())
        _mark().touch()


def _mark() -> Path:
    """Named like a file of numba's cache, with which it is copied and deleted."""
    made_by = (sys.version_info[:2], numba.__version__)
    processor = cpu_target.target_context.codegen().magic_tuple()
    key = sha256(repr((made_by, processor)).encode()).hexdigest()[:12]
    return Path(forward_batch.stats.cache_path) / f"all.{key}.nbi"


def _cores() -> int:
    counts = hasattr(os, "sched_getaffinity")  # Linux
    return len(os.sched_getaffinity(0)) if counts else os.cpu_count() or 1


@contextmanager
def _alone() -> Iterator[None]:
    folder = Path(forward_batch.stats.cache_path)
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "warmup.lock").open("w") as file:
        with suppress(ImportError):  # on Windows, where two processes may compile the same
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _compile_all(processes: int, tell: Tell) -> None:
    """Each piece as soon as those that it comes after are done."""
    from constraint_geodesics.kernel_jobs import JOBS

    waiting, done = list(JOBS), set[str]()
    idle, running = list[_Worker](), dict[Future[float], tuple[str, _Worker]]()
    with ThreadPoolExecutor(processes) as threads:
        try:
            while waiting or running:
                ready = [name for name in waiting if done.issuperset(JOBS[name].after)]
                for name in ready[: processes - len(running)]:
                    worker = idle.pop() if idle else _Worker()
                    running[threads.submit(worker.run, name)] = name, worker
                    waiting.remove(name)
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    name, worker = running[future]
                    tell(name, future.result())
                    del running[future]
                    idle.append(worker)
                    done.add(name)
        finally:
            for worker in (*idle, *(worker for _, worker in running.values())):
                worker.close()


class _Worker:
    """A process that runs pieces of the work (kernel_jobs.py), one after another."""

    def __init__(self) -> None:
        from constraint_geodesics.pipeline.threads import ONE_THREAD

        own = ONE_THREAD | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", f"{__package__}.kernel_jobs"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | own,
            text=True,
        )

    def run(self, name: str) -> float:
        """The seconds that it took, when it is done; WarmupError if it failed."""
        from constraint_geodesics.kernel_jobs import DONE, FAILED

        began, process = time.perf_counter(), self._process
        assert process.stdin is not None
        assert process.stdout is not None
        with suppress(BrokenPipeError):  # there is no answer either
            print(name, file=process.stdin, flush=True)
        for line in process.stdout:
            if line.startswith(DONE):
                return time.perf_counter() - began
            if line.startswith(FAILED):
                raise WarmupError(f"{name} can't be compiled: {line.removeprefix(FAILED).strip()}")
        raise WarmupError(f"{name} can't be compiled: its process ended, code {process.wait()}")

    def close(self) -> None:
        """End the process, whatever it does."""
        self._process.kill()
        self._process.communicate()
