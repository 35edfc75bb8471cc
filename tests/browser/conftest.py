"""The browser and the pages that its tests look at."""

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.browser.chromium import ROOT, chromium, free_port, missing, served
from tests.end_to_end import smoke

if TYPE_CHECKING:
    from playwright.sync_api import Browser


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """All that is below this folder is skipped where there is no browser."""
    if reason := missing():
        for item in items:
            if Path(__file__).parent in item.path.parents:
                item.add_marker(pytest.mark.skip(reason=reason))


@pytest.fixture(scope="session")
def browser() -> "Iterator[Browser]":
    with chromium() as opened:
        yield opened


@pytest.fixture(scope="session")
def small_checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of this checkout in which one stage has run: policy search on the plane, a child for
    each of two seeds.
    """
    folder = tmp_path_factory.mktemp("checkout")
    smoke.copy_checkout(folder)
    smoke.shrink_params(folder)
    stage = [sys.executable, "stages/train_analytic.py", "plane"]
    subprocess.run(stage, cwd=folder, env=smoke.environment(folder), check=True)
    return folder


@pytest.fixture(scope="session")
def own_runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a copy of this checkout's own runs, so that the dashboard can't change them."""
    if not (ROOT / "mlflow.db").is_file():
        pytest.skip("this checkout has no runs yet: `make repro` makes them")
    folder = tmp_path_factory.mktemp("own")
    shutil.copy2(ROOT / "mlflow.db", folder)
    return folder


@pytest.fixture(scope="session")
def small_dashboard(small_checkout: Path) -> Iterator[str]:
    yield from _dashboard(small_checkout)


@pytest.fixture(scope="session")
def own_dashboard(own_runs: Path) -> Iterator[str]:
    yield from _dashboard(own_runs)


def _dashboard(folder: Path) -> Iterator[str]:
    command = [sys.executable, "-m", "constraint_geodesics.cli", "ui", "--port", str(free_port())]
    with served(command, folder, smoke.environment(ROOT)) as address:
        yield address
