"""A change of a compiled kernel reaches all kernels that call it, in other files too."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from constraint_geodesics import kernel_digest
from constraint_geodesics.kernel_digest import PACKAGE, ROOMS, are_compiled, kernels_digest

INNER = "from numba import njit\n\n\n@njit(cache=True)\ndef inner(x):\n    return x + {}\n"
OUTER = (
    "from numba import njit\n\nfrom constraint_geodesics.low.inner import inner\n\n\n"
    "@njit(cache=True)\ndef outer(x):\n    return 10 * inner(x)\n"
)
ASK = (
    "from constraint_geodesics.high.outer import outer; "
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
    (package / "unrelated.py").write_text("nothing = 'compiled here'\n")
    assert answer(package) == (30, 1)


def test_a_moved_checkout_keeps_what_is_compiled(package: Path, tmp_path: Path) -> None:
    answer(package)
    moved = shutil.copytree(tmp_path / "src", tmp_path / "moved")
    assert answer(moved / "constraint_geodesics") == (20, 1)


def test_the_first_call_is_known_by_the_kernels_that_are_not_compiled(tmp_path: Path) -> None:
    for room in ROOMS:
        assert any(b"njit" in file.read_bytes() for file in (PACKAGE / room).glob("*.py")), room
        (tmp_path / room / "__pycache__").mkdir(parents=True)
        shutil.copytree(PACKAGE / room, tmp_path / room, dirs_exist_ok=True)
    for cache in tmp_path.rglob("*.nbi"):
        cache.unlink()
    assert not are_compiled(tmp_path)
    for room in ROOMS:
        cache = tmp_path / room / "__pycache__" / "kernels.some-1.py311.nbi"
        cache.write_bytes(b"version" + kernels_digest(tmp_path) + b"overloads")
    assert are_compiled(tmp_path)
    with (tmp_path / ROOMS[0] / "kernels.py").open("a") as file:
        file.write("# another kernel\n")
    kernel_digest.kernels_digest.cache_clear()
    assert not are_compiled(tmp_path)
