"""A change of a compiled kernel reaches all kernels that call it, in other files too."""

import gc
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from numba.core.runtime import _nrt_python, rtsys

from constraint_geodesics import Planner, bundle
from constraint_geodesics.kernel_digest import PACKAGE

INNER = "from numba import njit\n\n\n@njit(cache=True)\ndef inner(x):\n    return x + {}\n"
OUTER = (
    "from numba import njit\n\nfrom constraint_geodesics.low.inner import inner\n\n\n"
    "@njit(cache=True)\ndef outer(x):\n    return 10 * inner(x)\n"
)
ASK = (
    "import numba; from constraint_geodesics.high.outer import outer; "
    "print(outer(1), sum(outer.stats.cache_hits.values()))"
)


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """What this package does about its kernels, with two kernels in two files."""
    folder = tmp_path / "src" / "constraint_geodesics"
    for name in ("low", "high"):
        (folder / name).mkdir(parents=True)
    for name in ("__init__.py", "kernel_digest.py", "kernel_cache.py"):
        shutil.copy(PACKAGE / name, folder / name)
    (folder / "low" / "inner.py").write_text(INNER.format(1))
    (folder / "high" / "outer.py").write_text(OUTER)
    return folder


def answer(package: Path) -> tuple[int, int]:
    """What the outer kernel gives in a new process, and how much of it was compiled before."""
    environment = {**os.environ, "PYTHONPATH": str(package.parent)}
    for name in ("NUMBA_CACHE_DIR", "NUMBA_CACHE_LOCATOR_CLASSES"):
        environment.pop(name, None)
    done = subprocess.run(
        [sys.executable, "-c", ASK], env=environment, capture_output=True, text=True, check=True
    )
    value, hits = map(int, done.stdout.split())
    return value, hits


def test_a_changed_kernel_changes_its_callers_elsewhere(package: Path) -> None:
    assert answer(package) == (20, 0)
    assert answer(package) == (20, 1)
    (package / "low" / "inner.py").write_text(INNER.format(2))
    assert answer(package) == (30, 0), "no cache was deleted"
    assert len(list((package / "high" / "__pycache__").glob("kernels-*"))) == 1
    (package / "unrelated.py").write_text("nothing = 'compiled here'\n")
    assert answer(package) == (30, 1)


def test_a_moved_checkout_keeps_what_is_compiled(package: Path, tmp_path: Path) -> None:
    answer(package)
    moved = shutil.copytree(tmp_path / "src", tmp_path / "moved")
    assert answer(moved / "constraint_geodesics") == (20, 1)


def test_kernels_that_count_no_references_lose_no_memory() -> None:
    # a kernel of `compiled.LEAF` that called what returns an array would never free it
    with Planner.load(bundle.PACKAGED) as planner:
        start, goal = planner.nodes("level_cup")[[0, -1]]
        planner.plan(start, goal, "level_cup")
        _nrt_python.memsys_enable_stats()
        try:
            # what is older than the counting is freed in the first round
            for _ in range(2):
                gc.collect()
                before = rtsys.get_allocation_stats()
                planner.plan(start, goal, "level_cup", budget_s=0.2)
                gc.collect()
                after = rtsys.get_allocation_stats()
        finally:
            _nrt_python.memsys_disable_stats()
    assert after.alloc - before.alloc > 100
    assert after.alloc - before.alloc == after.free - before.free
