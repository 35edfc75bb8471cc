"""The one function through which all parallel work goes: on the cores of this machine, or on a Dask
scheduler's.

A task gets one thread wherever it runs, so that the order of floating-point sums, and with it every
result, is the same on any backend and with any number of workers.
"""

import asyncio
import logging
import os
import reprlib
import socket
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import joblib
from joblib.externals.loky.process_executor import BrokenProcessPool

from constraint_geodesics.params import ComputeParams
from constraint_geodesics.pipeline.threads import one_thread, stay_on_one_thread
from constraint_geodesics.progress import progress

if TYPE_CHECKING:
    from distributed import Client

Item = TypeVar("Item")
Result = TypeVar("Result")

DASK_CONNECT_S = 5
DASK_WORKERS_S = 10
WATCH_S = 1.0


class ComputeError(RuntimeError):
    """Parallel work that failed; the message is one line with the item and what went wrong with
    it.
    """


def parallel_map(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    settings: ComputeParams,
    *,
    description: str = "",
) -> list[Result]:
    """[function(item) for item in items], in parallel; the results come in the order of the items.

    `function` must depend on its item alone (randomness through a seed in the item) and leave the
    item unchanged: then the results are identical for every backend and number of workers.  One
    worker or one item needs no second process.  `description` names the work in the progress on
    standard error; without it there is none. `settings.workers` counts processes on this machine
    (0: one per core this process may use); on Dask all of the scheduler's workers take part, which
    need this package installed and the caller's folder under the same name.
    Raises ComputeError, one line, for the first item that fails, a worker that dies, or a scheduler
    that does not answer; the tasks that have not started are dropped.
    """
    results = dict(as_finished(function, items, settings, description=description))
    return [results[index] for index in range(len(items))]


def as_finished(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    settings: ComputeParams,
    *,
    description: str = "",
) -> Generator[tuple[int, Result], None, None]:
    """The same results, each with its item's place, as soon as it is there: to be kept before the
    next.  The other tasks go on while the caller works with one.
    """
    if not items:
        return
    task = _Task(function, description or getattr(function, "__name__", "parallel work"))
    with (
        progress(description, len(items)) as advance,
        closing(_outcomes(task, items, settings)) as outcomes,
    ):
        for outcome in outcomes:
            advance()
            yield outcome


@dataclass(frozen=True)
class _Task(Generic[Item, Result]):
    """What a worker runs: the function, under a name for its errors."""

    function: Callable[[Item], Result]
    name: str

    def __call__(self, index: int, item: Item) -> tuple[int, Result]:
        try:
            return index, self.function(item)
        except Exception as error:
            reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
            raise ComputeError(
                f"{self.name}, item {index} ({reprlib.repr(item)}): {reason}"
            ) from error

    def in_worker(self, index: int, item: Item) -> tuple[int, Result]:
        # never undone: a Dask worker may run other tasks beside this one
        stay_on_one_thread()
        return self(index, item)

    def below(self, parent: int, folder: str, index: int, item: Item) -> tuple[int, Result]:
        """In a worker on this machine, which may be left from work in another folder."""
        end_after(parent)
        os.chdir(folder)
        return self.in_worker(index, item)

    def elsewhere(self, folder: str, index: int, item: Item) -> tuple[int, Result]:
        """In a Dask worker, which sees the caller's folder too: files are named from there, and
        written into another they would be lost.
        """
        try:
            os.chdir(folder)
        except OSError as error:
            where = f"the Dask worker on {socket.gethostname()} does not see {folder}"
            raise ComputeError(f"{self.name}: {where}: {error.strerror}") from None
        return self.in_worker(index, item)


@cache
def end_after(parent: int) -> None:
    """End this process soon after its parent: a killed run would go on in it, beside the one that
    continues.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _outcomes(
    task: _Task[Item, Result], items: Sequence[Item], settings: ComputeParams
) -> Generator[tuple[int, Result], None, None]:
    workers = min(settings.workers or joblib.cpu_count(), len(items))
    if settings.backend == "dask":
        return _on_dask(task, items, str(settings.dask_address))
    return _in_process(task, items) if workers == 1 else _on_loky(task, items, workers)


def _in_process(
    task: _Task[Item, Result], items: Sequence[Item]
) -> Generator[tuple[int, Result], None, None]:
    for index, item in enumerate(items):
        with one_thread():
            outcome = task(index, item)
        yield outcome


def _on_loky(
    task: _Task[Item, Result], items: Sequence[Item], workers: int
) -> Generator[tuple[int, Result], None, None]:
    calls = (
        joblib.delayed(task.below)(os.getpid(), os.getcwd(), index, item)
        for index, item in enumerate(items)
    )
    # max_nbytes=None: joblib would hand large arrays over read-only, which the other backends don't
    with joblib.parallel_config(
        backend="loky", n_jobs=workers, inner_max_num_threads=1, max_nbytes=None
    ):
        outcomes: Any = joblib.Parallel(return_as="generator_unordered")(calls)
    try:
        with closing(outcomes):
            yield from outcomes
    except BrokenProcessPool as error:
        raise ComputeError(
            f"{task.name}: a worker process died (killed, or out of memory)"
        ) from error


def _on_dask(
    task: _Task[Item, Result], items: Sequence[Item], address: str
) -> Generator[tuple[int, Result], None, None]:
    # not through joblib's own Dask backend: it waits for ever for a task whose worker died (joblib
    # 1.6)
    from distributed import CancelledError, KilledWorker, as_completed

    with _dask_client(address) as client:
        places = [os.getcwd()] * len(items), range(len(items)), items
        futures = client.map(task.elsewhere, *places, pure=False)
        try:
            for future in as_completed(futures, loop=client.loop):
                yield future.result()
        except KilledWorker as error:
            raise ComputeError(
                f"{task.name}: Dask workers died (killed, or out of memory)"
            ) from error
        except (CancelledError, OSError) as error:
            raise ComputeError(f"{task.name}: lost the Dask scheduler at {address}") from error
        finally:
            client.cancel(futures)


@contextmanager
def _dask_client(address: str) -> Iterator["Client"]:
    from distributed import Client

    _check_scheduler(address)
    # of a scheduler that is gone it logs tracebacks, beside the error that says so
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    with Client(address, timeout=DASK_CONNECT_S, set_as_default=False) as client:
        try:
            client.wait_for_workers(1, timeout=DASK_WORKERS_S)
        except TimeoutError as error:
            raise ComputeError(
                f"compute.dask_address={address!r}: the scheduler has no workers"
            ) from error
        if max(client.nthreads().values(), default=1) > 1:
            raise ComputeError(  # they would share the generators of random numbers
                f"compute.dask_address={address!r}: a worker has several threads: start it with "
                "--nthreads 1"
            )
        yield client


def _check_scheduler(address: str) -> None:
    """Ask the scheduler who it is: a Client that finds none there leaves threads behind that time
    out noisily.
    """
    from distributed import Security, rpc

    async def identity() -> None:
        async with rpc(
            address, connection_args=Security().get_connection_args("client")
        ) as scheduler:
            await scheduler.identity()

    async def in_time() -> None:
        await asyncio.wait_for(identity(), DASK_CONNECT_S)

    try:
        asyncio.run(in_time())
    except Exception as error:  # whatever else listens there may answer anything
        reason = " ".join(str(error).split()) or f"no answer in {DASK_CONNECT_S} s"
        raise ComputeError(
            f"compute.dask_address={address!r}: no Dask scheduler: {reason}"
        ) from error
