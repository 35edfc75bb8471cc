"""One run of the whole pipeline on small parameters that the tests of this folder look at."""

from pathlib import Path

import pytest

from tests.end_to_end import smoke


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("checkout")
    assert smoke.main(folder) == 0
    return folder
