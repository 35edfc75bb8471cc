"""The browser and the pages that its tests look at."""

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from constraint_geodesics.params import load_params
from tests.browser.chromium import ROOT, chromium, missing
from tests.browser.dashboard import base_of, dashboard_of, log_committed_rows
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
    with dashboard_of(small_checkout) as page:
        yield base_of(page)


@pytest.fixture(scope="session")
def own_dashboard(own_runs: Path) -> Iterator[str]:
    with dashboard_of(own_runs) as page:
        yield base_of(page)


@pytest.fixture(scope="session")
def compared_page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """What `geodesics ui` prints for a store with the runs that the committed rows are of."""
    folder = tmp_path_factory.mktemp("compared")
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        log_committed_rows(load_params(ROOT / "params.yaml"), folder)
    with dashboard_of(folder) as page:
        yield page
