"""One thread for numerical work: another number of them rounds sums differently, and results would
differ with it.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)
"""Read by the libraries that are loaded after it is set."""


@contextmanager
def one_thread() -> Iterator[None]:
    """Inside, libraries that are loaded and those that will be compute on one thread, whatever the
    environment says.
    """
    from threadpoolctl import threadpool_limits

    before = {name: os.environ[name] for name in ONE_THREAD if name in os.environ}
    torch_threads = sys.modules["torch"].get_num_threads() if "torch" in sys.modules else None
    os.environ.update(ONE_THREAD)
    try:
        with threadpool_limits(1):
            set_torch_threads(1)
            yield
    finally:
        for name in ONE_THREAD:
            os.environ.pop(name, None)
        os.environ.update(before)
        if torch_threads is not None:
            set_torch_threads(torch_threads)


def stay_on_one_thread() -> None:
    """From now on, in a process that does nothing else."""
    from threadpoolctl import threadpool_limits

    os.environ.update(ONE_THREAD)
    threadpool_limits(1)
    set_torch_threads(1)


def set_torch_threads(count: int) -> None:
    """Torch's own count, where something has loaded torch; loading it for this alone would take
    seconds.
    """
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(count)
